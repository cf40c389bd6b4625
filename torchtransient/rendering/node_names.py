"""Names of nodes that have none, or that Mitsuba would call after their address in memory."""

from __future__ import annotations

from typing import Any

from torchtransient.rendering.nodes import children


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
