"""Walks over Mitsuba's parsed list of nodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from torchtransient.plugins import kind_of
from torchtransient.plugins.properties import count_bad, numbers_of, refuse

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


def check_finite(state: Any) -> None:
    """Raise ``SceneError`` with the keys of all numbers of a parsed scene that are NaN or infinite."""
    bad: dict[str, str] = {}
    waiting, seen, by_id = [(state.root, "")], set(), state.id_to_index
    while waiting:
        node, path = waiting.pop()
        for key, value in node.props.items():
            array = numbers_of(value)
            if array is not None:
                count_bad(bad, f"{path}{key}", array)
        for key, index in children(state, node, by_id):
            if index not in seen:
                seen.add(index)
                waiting.append((state.nodes[index], f"{path}{key}."))
    refuse(bad)


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
