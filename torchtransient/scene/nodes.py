"""Walks over Mitsuba's parsed list of nodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from torchtransient.plugins import kind_of

# Direct children of the scene that matter only where something refers to them.
_DECLARATIONS = ("BSDF", "Medium", "Texture", "Volume", "PhaseFunction", "ReconstructionFilter", "Film", "Sampler")

# Mitsuba's own integrators that are written in Python.
_PYTHON_INTEGRATORS = (
    "prb", "prb_basic", "prb_projective", "prbvolpath", "direct_projective", "volprim_rf_basic",
)  # fmt: skip


def children(state: Any, node: Any, by_id: Mapping[str, int] | None = None) -> list[tuple[str, int]]:
    """(property, node index) for every child object of a node, references by id included. ``by_id``: the state's
    ``id_to_index``, which is a copy of all of it at each look.
    """
    import mitsuba as mi

    result = []
    for key, value in node.props.items():
        if isinstance(value, mi.Properties.ResolvedReference):
            result.append((key, value.index()))
        elif isinstance(value, mi.Properties.Reference):
            by_id = state.id_to_index if by_id is None else by_id
            if value.id() in by_id:
                result.append((key, by_id[value.id()]))
    return result


def descendants(state: Any, node: Any) -> list[Any]:
    """The nodes below a node, each once."""
    found: dict[int, Any] = {}
    waiting, by_id = [node], state.id_to_index
    while waiting:
        for _, index in children(state, waiting.pop(), by_id):
            if index not in found:
                found[index] = state.nodes[index]
                waiting.append(found[index])
    return list(found.values())


def find_child(state: Any, node: Any, matches: Callable[[Any], bool]) -> int | None:
    """Index of the first child that ``matches``, None when none does."""
    for _, index in children(state, node):
        if matches(state.nodes[index]):
            return index
    return None


def is_film(node: Any) -> bool:
    """In dictionaries Mitsuba does not know the kind of plugins written in Python; those are told by our registry or
    their name.
    """
    import mitsuba as mi

    plugin = node.props.plugin_name()
    named = plugin.endswith("_film") or kind_of(plugin) == "film"
    return bool(node.type == mi.ObjectType.Film or (named and node.type == mi.ObjectType.Unknown))


def is_integrator(node: Any) -> bool:
    """As :func:`is_film`, for integrators."""
    import mitsuba as mi

    plugin = node.props.plugin_name()
    named = is_transient_integrator(plugin) or plugin in _PYTHON_INTEGRATORS
    return node.type == mi.ObjectType.Integrator or (named and node.type == mi.ObjectType.Unknown)


def is_transient_integrator(plugin: str) -> bool:
    """Whether an integrator is this library's, or one that a user has made known to it."""
    return plugin.startswith("transient_") or kind_of(plugin) == "integrator"


def kind_of_node(node: Any) -> str:
    """Mitsuba's kind of a node. It does not know plugins written in Python, whose kind our registry knows."""
    kind = str(node.type).rsplit(".", 1)[-1]
    if kind != "Unknown":
        return kind
    found = kind_of(node.props.plugin_name())
    return {"bsdf": "BSDF", "medium": "Medium", "texture": "Texture", "film": "Film"}.get(found or "", "Unknown")


def roots(state: Any) -> list[int]:
    """Direct children of the scene that matter even when nothing refers to them."""
    return [index for _, index in children(state, state.root) if kind_of_node(state.nodes[index]) not in _DECLARATIONS]


def reachable(state: Any, starts: list[int]) -> list[int]:
    """Nodes that can be met from some nodes, those included, through nested plugins and references."""
    seen: dict[int, None] = {}
    waiting, by_id = list(reversed(starts)), state.id_to_index
    while waiting:
        index = waiting.pop()
        if index not in seen:
            seen[index] = None
            waiting.extend(child for _, child in reversed(children(state, state.nodes[index], by_id)))
    return list(seen)


def media_in_use(state: Any) -> bool:
    """Whether a shape, sensor or emitter that is rendered has a participating medium."""
    return any(kind_of_node(state.nodes[index]) == "Medium" for index in reachable(state, roots(state)))


def take_merged_apart(state: Any) -> None:
    """Put the shapes inside a ``merge`` where it stands itself.

    Mitsuba joins them to meshes without a name, whose keys would be addresses in memory and whose order is chance.
    Apart, each has its own parameters. A shape keeps its name where no other has it; otherwise it is called after both.
    """
    for parent in list(state.nodes):
        while (found := _first_merge(state, parent)) is not None:
            _take_apart(state, parent, *found)


def _first_merge(state: Any, parent: Any) -> tuple[str, int] | None:
    merges = (pair for pair in children(state, parent) if state.nodes[pair[1]].props.plugin_name() == "merge")
    return next(merges, None)


def _take_apart(state: Any, parent: Any, key: str, index: int) -> None:
    import mitsuba as mi

    own, taken = state.nodes[index].props.id(), [node.props.id() for node in state.nodes]
    del parent.props[key]
    for number, (_, inner) in enumerate(children(state, state.nodes[index])):
        props = state.nodes[inner].props
        if own and (not props.id() or taken.count(props.id()) > 1):
            props.set_id(_free_name(f"{own}_{props.id() or number}", taken))
            taken.append(props.id())
        free = _free_name(f"{key}_{number}", list(parent.props.keys()))
        parent.props[free] = mi.Properties.ResolvedReference(inner)


def _free_name(name: str, taken: list[str]) -> str:
    number, free = 1, name
    while free in taken:
        free, number = f"{name}_{number}", number + 1
    return free


def name_nodes(state: Any) -> None:
    """Give the nameless children of the scene names that do not change from run to run: ``sensor``, ``shape_0``,
    ``shape_1``.
    """
    direct = [state.nodes[index] for _, index in children(state, state.root)]
    taken = {node.props.id() for node in direct}
    nameless = [node for node in direct if not node.props.id()]
    count: dict[str, int] = {}
    for node in nameless:
        kind = str(node.type).rsplit(".", 1)[-1].lower()
        count[kind] = count.get(kind, 0) + 1
    seen: dict[str, int] = {}
    for node in nameless:
        kind = str(node.type).rsplit(".", 1)[-1].lower()
        number = seen.get(kind, 0)
        name = kind if count[kind] == 1 else f"{kind}_{number}"
        while name in taken:
            number += 1
            name = f"{kind}_{number}"
        seen[kind] = number + 1
        taken.add(name)
        node.props.set_id(name)


def names_of_textures(state: Any) -> list[str]:
    """Of the textures and volumes that the scene itself holds, for others to refer to, in order."""
    import mitsuba as mi

    direct = [state.nodes[index] for _, index in children(state, state.root)]
    return [n.props.id() for n in direct if n.type in (mi.ObjectType.Texture, mi.ObjectType.Volume)]


def name_instantiated(scene: Any, names: list[str]) -> None:
    """Give such textures their names where Mitsuba has made other objects of them (a ``bitmap``, for one): they have
    lost them, and would be called after their addresses.
    """
    import mitsuba as mi

    from torchtransient.plugins.node_walk import objects_of

    held = [value for _, value in objects_of(scene)]
    taken = {value.id() for value in held}
    lost = [name for name in names if name not in taken]
    nameless = [value for value in held if not value.id() and isinstance(value, mi.Texture | mi.Volume)]
    if len(lost) == len(nameless):
        for name, value in zip(lost, nameless, strict=True):
            value.set_id(name)


def name_nested(state: Any) -> None:
    """Unique names for materials inside shapes and other materials, so that one of them can be substituted, and for
    nameless shapes inside groups, so that the transform of each is known.
    """
    import mitsuba as mi

    direct = {index for _, index in children(state, state.root)}
    taken = {node.props.id() for node in state.nodes}
    for index, node in enumerate(state.nodes):
        if node.type == mi.ObjectType.Shape and not node.props.id():
            # Mitsuba takes such a name for none: the keys stay those of a nameless shape.
            node.props.set_id(f"_unnamed_{index}")
        if node.type == mi.ObjectType.BSDF and index not in direct:
            name = f"{node.props.id()}#{index}"
            while name in taken:
                name += "'"
            taken.add(name)
            node.props.set_id(name)


def mesh_transforms(state: Any) -> dict[str, np.ndarray]:
    """``to_world`` as described, by the name of the shape: meshes apply it while loading and forget it."""
    import mitsuba as mi

    result = {}
    for node in state.nodes:
        if node.type == mi.ObjectType.Shape and node.props.id():
            matrix = np.eye(4)
            if "to_world" in node.props:
                matrix = np.array(node.props["to_world"].matrix, dtype=np.float64)
            result[node.props.id()] = matrix
    return result


def placements(state: Any) -> dict[str, np.ndarray]:
    """Every ``to_world`` of the description, by its key."""
    found = {}
    for node in state.nodes:
        if "to_world" in node.props:
            name = node.props.id() or node.props.plugin_name()
            found[f"{name}.to_world"] = np.array(node.props["to_world"].matrix, dtype=np.float64)
    return found
