"""Temporal filters of histograms, and the derivatives of parameters that change path lengths.

A box has no slope in time; a tent and a Gaussian have one, and a pulse or an impulse response gives one to every
filter. Films without a filter have a response of their own: a gate that opens at once has no slope either.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from torchtransient.plugins.parameters import check_slope


def has_slope(temporal_filter: str, pulsed: bool) -> bool:
    """Whether a film with this filter has a slope in time. ``temporal_filter`` is empty for a film that has none."""
    return pulsed or temporal_filter != "box"


def response_of(films: Iterable[Any]) -> tuple[bool, str, str]:
    """Whether all those films that have no temporal filter have a slope; if not, what messages call the response of the
    first one without, and what to do.
    """
    lacking = (film for film in films if not film.temporal_filter and not film.has_slope)
    return next(((False, film.response_name, film.slope_remedy) for film in lacking), (True, "", ""))


def filter_for(moving: Sequence[str], own: str, pulsed: bool) -> str:
    """The filter that "auto" stands for: the scene's ``own``, unless that has no slope and ``moving`` parameters, which
    change path lengths, need one.
    """
    return own if not moving or has_slope(own, pulsed) else "tent"


def check_filter(moving: Sequence[str], temporal_filter: str, pulsed: bool) -> None:
    """Raise ``GradientError`` for a filter without the slope that ``moving`` parameters need."""
    remedy = "Use temporal_filter='auto', 'tent' or 'gaussian'."
    check_slope(moving, has_slope(temporal_filter, pulsed), temporal_filter, remedy)
