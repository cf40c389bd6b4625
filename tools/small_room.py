"""A scene that renders in milliseconds, for tests of everything around the integrator. Lengths in metres.

A wall seen frontally through 4 x 3 pixels, a coloured cube before it, a point light beside the camera: arrivals lie
between 6 and 12 m. Plain data; no Mitsuba variant is needed.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np

VARIANT = "llvm_ad_rgb"


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0, scale: float = 1.0) -> np.ndarray:
    """A (4, 4) matrix that scales and then translates."""
    matrix = np.diag([scale, scale, scale, 1.0])
    matrix[:3, 3] = x, y, z
    return matrix


CAMERA = np.array([[-1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 4], [0, 0, 0, 1]])

_ROOM = {
    "type": "scene",
    "integrator": {"type": "transient_path", "max_depth": 3},
    "sensor": {
        "type": "perspective",
        "fov": 20.0,
        "to_world": CAMERA,
        "film": {
            "type": "transient_hdr_film",
            "width": 4,
            "height": 3,
            "rfilter": {"type": "box"},
            "temporal_bins": 24,
            "start_opl": 6.0,
            "bin_width_opl": 0.25,
        },
        "sampler": {"type": "independent", "sample_count": 16},
    },
    "light": {"type": "point", "position": [-0.5, 0.25, 4.0], "intensity": 10.0},
    "wall": {"type": "rectangle", "to_world": pose(scale=3.0), "bsdf": {"type": "diffuse", "reflectance": 0.5}},
    "box": {
        "type": "cube",
        "to_world": pose(0.4, 0.0, 0.5, 0.3),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.5, 0.2]}},
    },
}


def make_room() -> dict[str, Any]:
    """A wall seen frontally, a coloured cube before it, a point light beside the camera."""
    return copy.deepcopy(_ROOM)


COLOUR, GREY, WALL_POSE = "box.bsdf.reflectance.value", "wall.bsdf.reflectance.value", "wall.to_world"
