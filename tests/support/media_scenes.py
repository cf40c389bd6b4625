"""Scenes with participating media for the tests of `transient_prbvolpath`."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from support.runs import T
from torchtransient import plugins


def homogeneous(sigma_t=1.0, albedo=0.8, g=None, **arguments):
    medium = {"type": "homogeneous", "sigma_t": sigma_t, "albedo": albedo, **arguments}
    return medium if g is None else medium | {"phase": {"type": "hg", "g": g}}


def rgb(*values):
    return {"type": "rgb", "value": list(values)}


def volume(data, low=-1.0, size=2.0):
    """A grid over the cube that begins at ``low`` in every coordinate."""
    data = np.asarray(data, dtype=np.float32)
    data = data.reshape(*data.shape[:3], -1)
    return {"type": "gridvolume", "data": mi.TensorXf(data), "to_world": T().translate(low).scale(size)}


def clouds(shape=(4, 4, 4, 1), seed=0, **arguments):
    """A medium whose density differs from cell to cell."""
    data = np.random.default_rng(seed).uniform(0, 1, shape)
    return {"type": "heterogeneous", "sigma_t": volume(data), "scale": 2.0, "albedo": 0.8} | arguments


def film(width=4, height=4, start=0.0, bins=200, bin_width=0.1, filter="box"):
    return {
        "type": "transient_hdr_film",
        "width": width,
        "height": height,
        "rfilter": {"type": "box"},
        "temporal_bins": bins,
        "bin_width_opl": bin_width,
        "start_opl": start,
        "temporal_filter": filter,
    }


def camera(origin=(0, 0, 4), target=(0, 0, 0), fov=45.0, transient=True, **arguments):
    plain = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}}
    return {
        "type": "perspective",
        "fov": fov,
        "near_clip": 0.01,
        "to_world": T().look_at(list(origin), list(target), [0, 1, 0]),
        "film": film(**arguments) if transient else plain,
    }


def block(medium, bsdf=None):
    """A block of medium over a floor, lit by a lamp above."""
    return {
        "floor": {
            "type": "rectangle",
            "to_world": T().translate([0, 0, -2]).scale(3),
            "bsdf": {"type": "diffuse", "reflectance": 0.6},
        },
        "lamp": {
            "type": "rectangle",
            "to_world": T().translate([0, 1.6, 2.5]).rotate([1, 0, 0], 140),
            "emitter": {"type": "area", "radiance": 5.0},
        },
        "block": {"type": "cube", "bsdf": bsdf or {"type": "null"}, "interior": medium},
    }


def load(objects, sensor=None, integrator="transient_prbvolpath", **arguments):
    node = {"type": integrator, **({"max_depth": 12, "rr_depth": 1000} | arguments)}
    transient = integrator.startswith("transient")
    with plugins.plugin_errors():
        return mi.load_dict(
            {"type": "scene", "integrator": node, "sensor": sensor or camera(transient=transient), **objects}
        )
