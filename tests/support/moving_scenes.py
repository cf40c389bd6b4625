"""Walls that move before a camera, for tests of `tt.over_time`. Lengths in metres."""

from __future__ import annotations

import numpy as np

import torchtransient as tt
from torchtransient.scenes import look_at, scale
from torchtransient.units import SPEED_OF_LIGHT

MODULATION_HZ, EXPOSURE_S = 30e6, 1.5e-3
BEAT_HZ = 1 / EXPOSURE_S
FREQUENCIES = tt.FrequencyAxis.from_hertz([MODULATION_HZ])
PER_METRE = MODULATION_HZ / SPEED_OF_LIGHT
LAMP = {"type": "point", "position": [0.0, 0.0, 0.0], "intensity": 1.0}


def wall(center, towards, half=1.0):
    """A square of albedo 0.5 that faces a point."""
    matrix = look_at(center, towards) @ scale(half)
    color = {"type": "rgb", "value": [0.5, 0.5, 0.5]}
    return {"type": "rectangle", "to_world": matrix, "bsdf": {"type": "diffuse", "reflectance": color}}


def moving_scene(size=1, fov=0.05, depth=2, **nodes):
    """A camera at the origin that looks along z; a lamp beside it unless another one is given."""
    film = {"type": "transient_hdr_film", "width": size, "height": size, "rfilter": {"type": "box"},
            "temporal_bins": 40, "bin_width_opl": 0.2}  # fmt: skip
    camera = {"type": "perspective", "fov": fov, "near_clip": 1e-3, "film": film,
              "to_world": look_at((0, 0, 0), (0, 0, 1)), "sampler": {"type": "independent"}}  # fmt: skip
    integrator = {"type": "transient_path", "max_depth": depth, "rr_depth": 99}
    return {"type": "scene", "integrator": integrator, "sensor": camera, "lamp": LAMP, **nodes}


def corner():
    """Two walls of which the camera sees the first, so near the middle of both that no edge is in play: (scene, motion
    of the second).
    """
    lamp = {"type": "point", "position": [-0.5, 0.3, 0.2], "intensity": 1.0}
    first, second = wall((0, 0, 2), (0.3, 0.2, 0), 0.9), wall((1.3, 0, 1.0), (0, 0, 1.2), 40.0)
    motion = {"linear": (-8.0, 4.0, 3.0), "angular": (0.0, 30.0, 0.0), "center": (1.3, 0.0, 1.0)}
    return moving_scene(depth=3, first=first, second=second, lamp=lamp), motion


def plate():
    """A plate before a wall, whose outline crosses pixels: (scene, motion)."""
    front, back = wall((0.05, 0, 1.5), (0.05, 0, 0), 0.11), wall((0, 0, 2.5), (0, 0, 0), 2.0)
    return moving_scene(size=8, fov=12.0, front=front, back=back), {"linear": (6.0, 0.0, -6.0)}


def wall_phasor(z):
    """Phasor of a wall that faces camera and lamp from the distance z."""
    z = np.asarray(z)
    return 0.5 / np.pi / z**2 * np.exp(-2j * np.pi * PER_METRE * 2 * z)
