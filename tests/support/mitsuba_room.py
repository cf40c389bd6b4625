"""The small room as Mitsuba's own scene, for functions that hold one."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from tools.small_room import make_room

# Of a film that has a slope in time and few bins.
FILM = {"temporal_filter": "tent", "temporal_bins": 6, "start_opl": 6.0, "bin_width_opl": 1.0}


def as_mitsuba(description: dict) -> dict:
    """A dictionary of this library as ``mi.load_dict`` takes it: transforms of Mitsuba's for arrays."""
    taken = {}
    for key, value in description.items():
        if isinstance(value, dict):
            taken[key] = as_mitsuba(value)
        else:
            taken[key] = mi.ScalarTransform4f(value) if key == "to_world" else value
    return taken


def load_room(*, without: str = "") -> tuple[Any, Any]:
    """A scene of one's own and its parameters, (3, 4) pixels and six bins."""
    room = make_room()
    room["sensor"]["film"] |= FILM
    room.pop(without, None)
    scene = mi.load_dict(as_mitsuba(room))
    return scene, mi.traverse(scene)
