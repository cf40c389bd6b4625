"""Samplers of sensors: those that scenes name, or others in their place."""

from __future__ import annotations

from collections.abc import Iterable

from torchtransient.plugins.mitsuba_compat import CORRELATED_SAMPLERS

# What scenes name by habit, and what takes its place.
NAMED_BY_HABIT, DEFAULT = "independent", "owen"
# Values of `sampler=` that are no plugin: those of the scene, and the same but for those that are named by habit.
OF_SCENE, AUTO = "scene", "auto"


def sampler_for(named: str | None, asked: str | None = None) -> str:
    """Return the plugin name of the sampler of a sensor.

    Args:
        named: plugin name in the scene, None if there is none.
        asked: a plugin name, "scene", "auto" or None, which is "auto".
    """
    named = named or NAMED_BY_HABIT
    if asked not in (None, AUTO, OF_SCENE):
        return str(asked)
    return DEFAULT if named == NAMED_BY_HABIT and asked != OF_SCENE else named


def sampler_for_all(named: Iterable[str | None]) -> str:
    """Return the plugin name of the sampler of several sensors, "auto" where they have different ones.

    Args:
        named: plugin name of each sensor in the scene, None where there is none.
    """
    found = {sampler_for(name) for name in named}
    return found.pop() if len(found) == 1 else AUTO


def reason_for(named: str | None) -> str:
    """Return the line of a plan that says which sampler a scene gets, and why.

    Args:
        named: plugin name in the scene, None if there is none.
    """
    plugin = sampler_for(named)
    if plugin == named:
        why = "as the scene names it"
    else:
        why = f"in place of the scene's {named}" if named else "since the scene names none"
    warning = correlation_warning(plugin)
    return f"sampler: {plugin}, {why}" + (f"; {warning}" if warning else "")


def correlation_warning(plugin: str) -> str:
    """Return a warning of a sampler whose numbers depend on each other, empty for others.

    Args:
        plugin: plugin name.
    """
    if plugin not in CORRELATED_SAMPLERS:
        return ""
    return (
        "this sampler of Mitsuba draws dependent numbers at consecutive vertices, which biases light that scatters "
        "twice and more, and derivatives (1 % in the Cornell box). Take 'owen', the default, or 'independent'"
    )
