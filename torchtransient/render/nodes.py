"""Walks over Mitsuba's parsed list of nodes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


def children(state: Any, node: Any) -> list[tuple[str, int]]:
    """(property, node index) for every child object of a node, references by id included."""
    import mitsuba as mi

    result, by_id = [], state.id_to_index
    for key, value in node.props.items():
        if isinstance(value, mi.Properties.ResolvedReference):
            result.append((key, value.index()))
        elif isinstance(value, mi.Properties.Reference) and value.id() in by_id:
            result.append((key, by_id[value.id()]))
    return result


def find_child(state: Any, node: Any, matches: Callable[[Any], bool]) -> int | None:
    """Index of the first child that ``matches``, None when none does."""
    for _, index in children(state, node):
        if matches(state.nodes[index]):
            return index
    return None


def is_film(node: Any) -> bool:
    """In dictionaries Mitsuba does not know the kind of plugins written in Python; those are told by their name."""
    import mitsuba as mi

    unknown = node.type == mi.ObjectType.Unknown and node.props.plugin_name().endswith("_film")
    return unknown or node.type == mi.ObjectType.Film


def is_integrator(node: Any) -> bool:
    """As :func:`is_film`, for integrators."""
    import mitsuba as mi

    unknown = node.type == mi.ObjectType.Unknown and node.props.plugin_name().startswith("transient_")
    return unknown or node.type == mi.ObjectType.Integrator
