"""A film's storage laid out for a test: as many pixels as there are arrivals, whatever the film's size."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi


def storage(film: Any, entries: int) -> Any:
    """Give ``film`` one band of ``entries`` zeros, number 0, and return its array."""
    film.bands = [(0, 1, dr.zeros(mi.Float, entries))]
    return film.band_array(0)
