"""Nodes of a scene that Mitsuba has parsed: walks over them, their kinds, their names.

``state`` is a ``mitsuba.parser.ParserState``: the list of all nodes, each with the properties of one plugin.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from torchtransient.plugins import kind_of

# Children of the scene that matter only where something refers to them.
_DECLARATIONS = ("BSDF", "Medium", "Texture", "Volume", "PhaseFunction", "ReconstructionFilter", "Film", "Sampler")

# Mitsuba's own integrators that are written in Python.
_PYTHON_INTEGRATORS = (
    "prb", "prb_basic", "prb_projective", "prbvolpath", "direct_projective", "volprim_rf_basic",
)  # fmt: skip


# --------------------------------------------------------------------------------------------------------------- walks


def children(state: Any, node: Any, by_id: Mapping[str, int] | None = None) -> list[tuple[str, int]]:
    """Return (property, node index) of every child of a node, references by id included.

    Args:
        state: the parsed scene.
        node: one of its nodes.
        by_id: the state's ``id_to_index``, None to read it. Mitsuba copies it at each access.
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


def find_child(state: Any, node: Any, matches: Callable[[Any], bool]) -> int | None:
    """Return the index of the first child for which ``matches(node)`` is true, None without one.

    Args:
        state: parsed scene (``mitsuba.parser.ParserState``).
        node: one of its nodes.
        matches: function of a node.
    """
    return next((index for _, index in children(state, node) if matches(state.nodes[index])), None)


def reachable(state: Any, starts: list[int]) -> list[int]:
    """Return the indices of ``starts`` and of all nodes below them, through children and references, each once.

    Args:
        state: parsed scene (``mitsuba.parser.ParserState``).
        starts: indices of nodes.
    """
    seen: dict[int, None] = {}
    waiting, by_id = list(reversed(starts)), state.id_to_index
    while waiting:
        index = waiting.pop()
        if index not in seen:
            seen[index] = None
            waiting.extend(child for _, child in reversed(children(state, state.nodes[index], by_id)))
    return list(seen)


def descendants(state: Any, node: Any) -> list[Any]:
    """Return the nodes below a node, each once.

    Args:
        state: parsed scene (``mitsuba.parser.ParserState``).
        node: one of its nodes.
    """
    return [state.nodes[index] for index in reachable(state, [index for _, index in children(state, node)])]


def rendered_children(state: Any) -> list[int]:
    """Return the children of the scene that matter even when nothing refers to them.

    Args:
        state: parsed scene (``mitsuba.parser.ParserState``).
    """
    return [index for _, index in children(state, state.root) if node_kind(state.nodes[index]) not in _DECLARATIONS]


def has_media(state: Any) -> bool:
    """Return whether a shape, sensor or emitter that is rendered has a participating medium.

    Args:
        state: parsed scene (``mitsuba.parser.ParserState``).
    """
    return any(node_kind(state.nodes[index]) == "Medium" for index in reachable(state, rendered_children(state)))


def described_transforms(state: Any) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return ``to_world`` (4, 4) of the named shapes by name, and every ``to_world`` by its key.

    Meshes apply their transform while they are loaded, and forget it.

    Args:
        state: parsed scene (``mitsuba.parser.ParserState``).
    """
    import mitsuba as mi

    shapes, by_key = {}, {}
    for node in state.nodes:
        name, given = node.props.id(), node.props.get("to_world", None)
        # Other values are left to Mitsuba, which refuses them.
        matrix = np.array(given.matrix, dtype=np.float64) if hasattr(given, "matrix") else None
        if matrix is not None:
            by_key[f"{name or node.props.plugin_name()}.to_world"] = matrix
        if node.type == mi.ObjectType.Shape and name:
            shapes[name] = np.eye(4) if matrix is None else matrix
    return shapes, by_key


# --------------------------------------------------------------------------------------------------------------- kinds


def is_film(node: Any) -> bool:
    """Return whether a node is a film.

    In dictionaries Mitsuba does not know the kind of plugins written in Python: the registry or the name tells.

    Args:
        node: node of a parsed scene.
    """
    import mitsuba as mi

    plugin = node.props.plugin_name()
    named = plugin.endswith("_film") or kind_of(plugin) == "film"
    return bool(node.type == mi.ObjectType.Film or (named and node.type == mi.ObjectType.Unknown))


def is_integrator(node: Any) -> bool:
    """Return whether a node is an integrator, one written in Python included.

    Args:
        node: node of a parsed scene.
    """
    import mitsuba as mi

    plugin = node.props.plugin_name()
    named = is_transient_integrator(plugin) or plugin in _PYTHON_INTEGRATORS
    return node.type == mi.ObjectType.Integrator or (named and node.type == mi.ObjectType.Unknown)


def is_transient_integrator(plugin: str) -> bool:
    """Return whether an integrator is one of this library, or registered with it.

    Args:
        plugin: plugin name.
    """
    return plugin.startswith("transient_") or kind_of(plugin) == "integrator"


def node_kind(node: Any) -> str:
    """Return Mitsuba's kind of a node; of plugins written in Python that of the registry.

    Args:
        node: node of a parsed scene.
    """
    kind = str(node.type).rsplit(".", 1)[-1]
    if kind != "Unknown":
        return kind
    found = kind_of(node.props.plugin_name())
    return {"bsdf": "BSDF", "medium": "Medium", "texture": "Texture", "film": "Film"}.get(found or "", "Unknown")


# --------------------------------------------------------------------------------------------------------------- names


def node_label(state: Any, index: int) -> str:
    """Return a node's plugin, name and place in the file or dictionary, for messages.

    Args:
        state: parsed scene (``mitsuba.parser.ParserState``).
        index: index of the node.
    """
    import mitsuba as mi

    node = state.nodes[index]
    plugin, name = node.props.plugin_name(), node.props.id()
    label = f"{plugin} {name!r}" if name and not name.startswith("_unnamed") else plugin
    if len(state.node_paths) > index and state.node_paths[index]:
        return f"{label} at {state.node_paths[index]!r}"
    where = mi.parser.file_location(state, node).rsplit("/", 1)[-1].rsplit("\\", 1)[-1]
    return f"{label}, {where}" if where else label


def name_children(state: Any) -> None:
    """Name the nameless children of the scene ``sensor``, ``shape_0``, ``shape_1``: the same in every process.

    Args:
        state: parsed scene (``mitsuba.parser.ParserState``).
    """
    direct = [state.nodes[index] for _, index in children(state, state.root)]
    used = {node.props.id() for node in direct}
    nameless = [node for node in direct if not node.props.id()]
    kinds = [str(node.type).rsplit(".", 1)[-1].lower() for node in nameless]
    following: dict[str, int] = {}
    for node, kind in zip(nameless, kinds, strict=True):
        number = following.get(kind, 0)
        name = kind if kinds.count(kind) == 1 else f"{kind}_{number}"
        while name in used:
            number += 1
            name = f"{kind}_{number}"
        following[kind] = number + 1
        used.add(name)
        node.props.set_id(name)


def name_nested(state: Any) -> None:
    """Give materials inside shapes and other materials unique names, so that one of them can be substituted.

    Nameless shapes inside groups get one too, so that the transform of each is known.

    Args:
        state: parsed scene (``mitsuba.parser.ParserState``).
    """
    import mitsuba as mi

    direct = {index for _, index in children(state, state.root)}
    used = {node.props.id() for node in state.nodes}
    for index, node in enumerate(state.nodes):
        if node.type == mi.ObjectType.Shape and not node.props.id():
            # Mitsuba takes such a name for none: the keys stay those of a nameless shape.
            node.props.set_id(f"_unnamed_{index}")
        if node.type == mi.ObjectType.BSDF and index not in direct:
            name = f"{node.props.id()}#{index}"
            while name in used:
                name += "'"
            used.add(name)
            node.props.set_id(name)


def split_merged_shapes(state: Any) -> None:
    """Replace every ``merge`` by the shapes inside it.

    Mitsuba joins them to meshes without a name, whose keys are addresses in memory and whose order is chance. A shape
    keeps its name where no other has it; otherwise its name follows that of the merge.

    Args:
        state: parsed scene (``mitsuba.parser.ParserState``).
    """
    for parent in list(state.nodes):
        while (found := _first_merge(state, parent)) is not None:
            _split(state, parent, *found)


def _first_merge(state: Any, parent: Any) -> tuple[str, int] | None:
    merges = (pair for pair in children(state, parent) if state.nodes[pair[1]].props.plugin_name() == "merge")
    return next(merges, None)


def _split(state: Any, parent: Any, key: str, index: int) -> None:
    import mitsuba as mi

    own, used = state.nodes[index].props.id(), [node.props.id() for node in state.nodes]
    del parent.props[key]
    for number, (_, inner) in enumerate(children(state, state.nodes[index])):
        props = state.nodes[inner].props
        if own and (not props.id() or used.count(props.id()) > 1):
            props.set_id(_free_name(f"{own}_{props.id() or number}", used))
            used.append(props.id())
        free = _free_name(f"{key}_{number}", list(parent.props.keys()))
        parent.props[free] = mi.Properties.ResolvedReference(inner)


def _free_name(name: str, used: list[str]) -> str:
    number, free = 1, name
    while free in used:
        free, number = f"{name}_{number}", number + 1
    return free


def texture_names(state: Any) -> list[str]:
    """Return the names of the textures and volumes that the scene itself holds, in order.

    Args:
        state: parsed scene (``mitsuba.parser.ParserState``).
    """
    import mitsuba as mi

    direct = [state.nodes[index] for _, index in children(state, state.root)]
    return [n.props.id() for n in direct if n.type in (mi.ObjectType.Texture, mi.ObjectType.Volume)]


def restore_texture_names(scene: Any, names: list[str]) -> None:
    """Give textures of a built scene their names back, without which their keys are addresses in memory.

    Mitsuba replaces some by other objects without a name when it builds them, a ``bitmap`` for instance.

    Args:
        scene: built scene.
        names: names of :func:`texture_names`, in order.
    """
    import mitsuba as mi

    from torchtransient.plugins.node_walk import objects_of

    held = [value for _, value in objects_of(scene)]
    present = {value.id() for value in held}
    lost = [name for name in names if name not in present]
    nameless = [value for value in held if not value.id() and isinstance(value, mi.Texture | mi.Volume)]
    if len(lost) == len(nameless):
        for name, value in zip(lost, nameless, strict=True):
            value.set_id(name)
