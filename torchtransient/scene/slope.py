"""Slope in time of temporal filters, which derivatives by parameters that change path lengths need.

A box has none; a tent and a Gaussian have one, and a pulse or an impulse response gives one to every filter. Films
without a filter have a response of their own: a gate that opens at once has no slope either.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from torchtransient.plugins.parameters import check_slope


def has_slope(temporal_filter: str, pulsed: bool) -> bool:
    """Return True if a film with a temporal filter has a slope in time.

    Args:
        temporal_filter: name of the filter, empty for a film without one.
        pulsed: the film has a pulse or an impulse response.
    """
    return pulsed or temporal_filter != "box"


def response_of(films: Iterable[Any]) -> tuple[bool, str, str]:
    """Return the slope of the films without a temporal filter.

    Args:
        films: built films.

    Returns:
        (all of them have a slope, name of the first response without one, remedy); the texts are for messages, and
        empty if all have one.
    """
    lacking = (film for film in films if not film.temporal_filter and not film.has_slope)
    return next(((False, film.response_name, film.slope_remedy) for film in lacking), (True, "", ""))


def filter_for(moving: Sequence[str], own: str, pulsed: bool) -> str:
    """Return the temporal filter of "auto".

    Args:
        moving: keys of parameters that change path lengths.
        own: filter of the scene, which stays unless ``moving`` keys need a slope that it has not.
        pulsed: the film has a pulse or an impulse response.
    """
    return own if not moving or has_slope(own, pulsed) else "tent"


def check_filter(moving: Sequence[str], temporal_filter: str, pulsed: bool) -> None:
    """Raise ``GradientError`` for a filter without a slope, if parameters need one.

    Args:
        moving: keys of parameters that change path lengths.
        temporal_filter: name of the filter.
        pulsed: the film has a pulse or an impulse response.
    """
    remedy = "Use temporal_filter='auto', 'tent' or 'gaussian'."
    check_slope(moving, has_slope(temporal_filter, pulsed), temporal_filter, remedy)
