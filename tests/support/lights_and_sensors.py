"""Every emitter and every sensor over one plane: descriptions, and what arrives when, in closed form.

The plane z = 0 has albedo RHO. Sensors look at its origin O; emitters light it. Distant light is timed by the sphere
around the scene, whose centre is O and whose radius is SPHERE, since a small square far below and the plane's size
decide it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from support.runs import T
from torchtransient import plugins

RHO = 0.5
HALF = 3.0
SPHERE = HALF * math.sqrt(2.0)


def plane():
    bsdf = {"type": "twosided", "nested": {"type": "diffuse", "reflectance": RHO}}
    return {"type": "rectangle", "to_world": T().scale(HALF), "bsdf": bsdf}


def film(start=0.0, bins=16000, width=1e-3, size=(1, 1), steady=False):
    shape = {"width": size[0], "height": size[1], "rfilter": {"type": "box"}}
    if steady:
        return {"type": "hdrfilm", **shape}
    return {
        "type": "transient_hdr_film", "temporal_bins": bins, "bin_width_opl": width, "start_opl": start, **shape,
    }  # fmt: skip


# ----------------------------------------------------------------------------------------------------- emitters


@dataclass(frozen=True)
class Light:
    """``make()``: the description. ``radiance``: of O towards anything above. ``opl``: from departure to O.

    ``key``: a parameter that the emitted light is proportional to, empty if none is differentiable. ``tolerance``: of
    the radiance.
    """

    make: Callable[[], dict[str, Any]]
    radiance: float
    opl: float
    key: str
    tolerance: float = 1e-4


def facing_down(height, half, emitter):
    """A square above O that faces it."""
    to_world = T().translate([0, 0, height]).rotate([1, 0, 0], 180).scale(half)
    return {"type": "rectangle", "to_world": to_world, **emitter}


def beside(half, emitter):
    """A small square 2 m from O, out of the way of sensors above it, that faces O under a cosine of 0.8."""
    to_world = T().look_at(origin=[1.2, 0, 1.6], target=[0, 0, 0], up=[0, 1, 0]) @ T().scale(half)
    return {"type": "rectangle", "to_world": to_world, **emitter}


def from_above(direction=(0.6, 0.0, 0.8)):
    """Unit vector from O towards distant light."""
    return np.array(direction) / np.linalg.norm(direction)


LIGHTS = {
    "point": Light(
        lambda: {"type": "point", "position": [0.6, 0.0, 0.8], "intensity": 3.0},
        radiance=RHO / math.pi * 3.0 * 0.8, opl=1.0, key="light.intensity.value",
    ),
    "spot": Light(
        lambda: {
            "type": "spot", "intensity": 3.0, "cutoff_angle": 20.0, "beam_width": 10.0,
            "to_world": T().look_at(origin=[1.2, 0, 1.6], target=[0, 0, 0], up=[0, 1, 0]),
        },
        radiance=RHO / math.pi * 3.0 * 0.8 / 4.0, opl=2.0, key="light.intensity.value",
    ),
    "area": Light(
        lambda: beside(0.01, {"emitter": {"type": "area", "radiance": 1e4}}),
        radiance=RHO / math.pi * 1e4 * 4e-4 / 4.0 * 0.8, opl=2.0, key="light.emitter.radiance.value", tolerance=2e-4,
    ),
    "angulararea": Light(
        lambda: beside(0.01, {"emitter": {"type": "angulararea", "radiance": 1e4, "cutoff_angle": 30.0}}),
        radiance=RHO / math.pi * 1e4 * 4e-4 / 4.0 * 0.8, opl=2.0, key="light.emitter.radiance.value", tolerance=2e-4,
    ),
    "projector": Light(
        # a texture of one value over a field of 30 degrees; "irradiance" is what arrives at unit distance, times pi
        lambda: {
            "type": "projector", "scale": 3.0, "fov": 30.0,
            "irradiance": {"type": "bitmap", "bitmap": mi.Bitmap(np.ones((4, 4, 3), np.float32)), "raw": True},
            "to_world": T().look_at(origin=[0, 0, 2], target=[0, 0, 0], up=[0, 1, 0]),
        },
        radiance=RHO / math.pi * math.pi * 3.0 / 4.0, opl=2.0, key="light.scale",
    ),
    "directional": Light(
        lambda: {"type": "directional", "direction": [-0.6, 0.0, -0.8], "irradiance": 2.0},
        radiance=RHO / math.pi * 2.0 * 0.8, opl=SPHERE, key="light.irradiance.value",
    ),
    "constant": Light(
        lambda: {"type": "constant", "radiance": 2.0},
        radiance=RHO * 2.0, opl=SPHERE, key="light.radiance.value", tolerance=0.02,
    ),
    "envmap": Light(
        lambda: {
            "type": "envmap", "bitmap": mi.Bitmap(np.full((4, 8, 3), 2.0, np.float32)),
            "to_world": T().rotate([1, 0, 0], 90),
        },
        radiance=RHO * 2.0, opl=SPHERE, key="light.scale", tolerance=0.02,
    ),
    "sunsky": Light(
        # The sun alone, so small that it is a direction; its radiance is a table of Mitsuba's.
        lambda: {
            "type": "sunsky", "sun_direction": [0.6, 0.0, 0.8], "sky_scale": 0.0, "sun_scale": 1.0, "turbidity": 3.0,
        },
        radiance=math.nan, opl=SPHERE, key="",  # Mitsuba does not differentiate its scales
    ),
}  # fmt: skip


# ------------------------------------------------------------------------------------------------------ sensors


@dataclass(frozen=True)
class Sensor:
    """``make(film)``: the description (or that of a shape with a sensor). ``opl``: from O to the sensor.

    ``weight``: what the sensor makes of a radiance of one that leaves the plane around O.
    """

    make: Callable[[dict[str, Any]], dict[str, Any]]
    opl: float
    weight: float = 1.0


def looking_down(height, **arguments):
    return {"to_world": T().look_at(origin=[0, 0, height], target=[0, 0, 0], up=[0, 1, 0]), **arguments}


SENSORS = {
    "perspective": Sensor(
        lambda f: {"type": "perspective", "fov": 0.01, "near_clip": 1.5, "film": f, **looking_down(4.0)}, opl=4.0
    ),
    "thinlens": Sensor(
        lambda f: {
            "type": "thinlens", "fov": 0.01, "near_clip": 1.5, "aperture_radius": 0.01, "focus_distance": 4.0,
            "film": f, **looking_down(4.0),
        },
        opl=4.0,
    ),
    "orthographic": Sensor(
        lambda f: {
            "type": "orthographic", "near_clip": 0.5, "far_clip": 100.0, "film": f,
            "to_world": T().look_at(origin=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0]) @ T().scale([1e-3, 1e-3, 1]),
        },
        opl=4.0,
    ),
    "orthographic, scaled along its axis": Sensor(
        lambda f: {
            "type": "orthographic", "near_clip": 0.5, "far_clip": 100.0, "film": f,
            "to_world": T().look_at(origin=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0]) @ T().scale([1e-3, 1e-3, 4]),
        },
        opl=4.0,
    ),
    "radiancemeter": Sensor(lambda f: {"type": "radiancemeter", "film": f, **looking_down(4.0)}, opl=4.0),
    "distant": Sensor(
        lambda f: {
            "type": "distant", "film": f, "target": [0.0, 0.0, 0.0],
            "to_world": T().look_at(origin=[0, 0, 0], target=[-0.6, 0, -0.8], up=[0, 1, 0]),
        },
        opl=SPHERE,
    ),
}  # fmt: skip


def scene(sensor, light, integrator="transient_path", depth=2, **objects):
    """A scene dictionary of one plane, one light and one sensor."""
    return {
        "type": "scene",
        "integrator": {"type": integrator, "max_depth": depth},
        "sensor": sensor,
        "plane": plane(),
        **({"light": light} if light is not None else {}),
        **objects,
    }


def load(description):
    """The scene with every shape and material kept apart."""
    with plugins.plugin_errors():
        return mi.load_dict(description, optimize=False)


def arrivals(loaded, spp=16, seed=0):
    """Bins (H, W, T) and their centres; nothing may fall outside of the window."""
    camera_film = loaded.sensors()[0].film()
    bins = np.array(loaded.integrator().render(loaded, spp=spp, seed=seed)[1], dtype=float)[..., 0]
    assert camera_film.energy_before == 0.0 and camera_film.energy_after == 0.0
    return bins, camera_film.start_opl + (np.arange(bins.shape[-1]) + 0.5) * camera_film.bin_width_opl


def one_arrival(loaded, spp=16, seed=0):
    """Mean arrival, total, and width of what a film of one pixel sees."""
    bins, centers = arrivals(loaded, spp, seed)
    bins = bins[0, 0]
    lit = np.flatnonzero(bins)
    return centers @ bins / bins.sum(), bins.sum(), centers[lit[-1]] - centers[lit[0]]
