"""Distances along rays that single precision can tell from none."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

# Of the largest coordinate: a few ulp.
SHORTEST = 1e-6


def past(p: Any) -> Any:
    """How far behind a hit ``p`` a ray goes on, so that it does not meet the same surface again. Mitsuba's own rays
    start as far off a surface.
    """
    return (1 + dr.max(dr.abs(p))) * mi.math.RayEpsilon


def shortest(o: Any) -> Any:
    """The shortest distance from ``o`` to a point that has a direction seen from there."""
    return (1 + dr.max(dr.abs(o))) * SHORTEST
