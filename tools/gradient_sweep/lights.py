"""The emitters and sensors of the sweep."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tools.gradient_sweep.bsdfs import picture, rgb
from tools.gradient_sweep.stages import Description, camera, film, look, move, stretch, turn

# Their light departs from the sphere around the scene.
DISTANT = ("directional", "constant", "envmap", "sunsky", "sunsky (by date)", "timed_sunsky")
_POSE = look((0.8, 0.3, 3.5), (0.1, 0.0, 0.0))


def sky() -> Description:
    """An environment map that varies slowly."""
    rows, columns = np.meshgrid(np.arange(8), np.arange(16), indexing="ij")
    image = 1.0 + 0.5 * np.sin(0.8 * rows + 0.4)[..., None] * np.cos(2 * np.pi * columns / 16)[..., None]
    return {"type": "envmap", "bitmap": np.repeat(image, 3, axis=2).astype(np.float32)}


def emitters() -> dict[str, Callable[[], Description]]:
    """Emitters that stand alone."""
    return {
        "point": lambda: {"type": "point", "position": [0.8, 0.5, 3.0], "intensity": rgb(10.0, 8.0, 6.0)},
        "spot": lambda: {
            "type": "spot", "intensity": rgb(10.0, 8.0, 6.0), "cutoff_angle": 40.0, "beam_width": 2.0,
            "texture": picture(3), "to_world": _POSE,
        },
        "projector": lambda: {
            "type": "projector", "irradiance": picture(3), "fov": 60.0, "scale": 3.0, "to_world": _POSE,
        },
        "directional": lambda: {
            "type": "directional", "direction": [-0.3, 0.1, -1.0], "irradiance": rgb(3.0, 2.0, 1.0),
        },
        "constant": lambda: {"type": "constant", "radiance": rgb(1.0, 0.8, 0.6)},
        "envmap": sky,
        "sunsky": lambda: {"type": "sunsky", "sun_direction": [0.3, 0.4, 1.0], "to_world": np.eye(4)},
        "sunsky (by date)": lambda: {"type": "sunsky"},
        "timed_sunsky": lambda: {"type": "timed_sunsky"},
    }  # fmt: skip


def area_emitters() -> dict[str, Callable[[], Description]]:
    """Emitters that a shape carries."""
    return {
        "area": lambda: {"type": "area", "radiance": rgb(9.0, 8.0, 7.0)},
        "directionalarea": lambda: {"type": "directionalarea", "radiance": rgb(9.0, 8.0, 7.0)},
        "angulararea": lambda: {
            "type": "angulararea", "radiance": rgb(9.0, 8.0, 7.0), "cutoff_angle": 60.0, "beam_width": 5.0,
        },
    }  # fmt: skip


def sensors() -> dict[str, Description]:
    """Sensors in front of the plate."""
    plain = camera()
    pose = look((0.3, 0.0, 3.0))
    plane = {key: value for key, value in plain.items() if key != "fov"}
    first, second = camera(), camera(origin=(0.4, 0.2, 3.5))
    meter_film = {**film(), "width": 1, "height": 1}
    batch = {"type": "batch", "film": film(), "sampler": {"type": "independent"}, "first": first, "second": second}
    return {
        "perspective": plain | {"principal_point_offset_x": 0.1, "principal_point_offset_y": -0.05},
        "thinlens": plain | {"type": "thinlens", "aperture_radius": 0.2, "focus_distance": 2.5},
        "orthographic": plane | {"type": "orthographic", "to_world": pose @ stretch(0.4, 0.4, 1.0)},
        "radiancemeter": {"type": "radiancemeter", "film": meter_film, "to_world": pose},
        "distant": {"type": "distant", "film": meter_film, "direction": [0.1, 0.0, -1.0], "target": [0.0, 0.0, 0.0]},
        "batch": batch,
        "irradiancemeter": {
            "type": "rectangle",
            "to_world": move(0.2, 0.1, 2.0) @ turn(1, 180) @ stretch(0.2),
            "sensor": {"type": "irradiancemeter", "film": meter_film},
        },
    }
