"""Scenes around a corner as Mitsuba dictionaries: a flat relay wall at z = 0 that is seen and lit from z > 0."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

ORIGIN = (-0.5, 0.0, 0.25)


def transform():
    return mi.ScalarTransform4f()


def plane(z=1.0, size=1.0, x=0.0, y=0.0, albedo=0.7):
    """A square that faces the wall."""
    to_world = transform().translate([x, y, z]).scale([size / 2, size / 2, 1]).rotate([0, 1, 0], 180)
    return {"type": "rectangle", "to_world": to_world, "bsdf": {"type": "diffuse", "reflectance": albedo}}


def side(x=0.6, z=0.8, size=0.6, albedo=0.6):
    """A square that faces the axis from the right, lit by the others alone but for grazing light."""
    to_world = transform().translate([x, 0, z]).rotate([0, 1, 0], -90).scale([size / 2, size / 2, 1])
    return {"type": "rectangle", "to_world": to_world, "bsdf": {"type": "diffuse", "reflectance": albedo}}


def film(points=4, start=1.6, width=0.02, bins=150, kind="confocal", **changes):
    result = {
        "type": "transient_hdr_film", "width": points, "height": points, "rfilter": {"type": "box"},
        "temporal_bins": bins, "bin_width_opl": width, "start_opl": start,
    }  # fmt: skip
    if kind == "exhaustive":
        result |= {"exhaustive_scan": True, "laser_scan_width": points, "laser_scan_height": points}
    return result | changes


def scan_scene(hidden, kind="confocal", film=None, spot=(-0.2, 0.1, 0.0), laser=None, wall=None, **integrator):
    """A capture of ``hidden`` (shapes by name); ``integrator``: its properties."""
    look = transform().look_at(ORIGIN, list(spot), [0, 1, 0])
    wall = wall or {"type": "rectangle", "to_world": transform().scale([0.5, 0.5, 1])}
    meter = {
        "type": "nlos_capture_meter", "sensor_origin": list(ORIGIN), "film": film or globals()["film"](kind=kind),
        "sampler": {"type": "independent"},
    }  # fmt: skip
    settings = {
        "type": "transient_nlos_path", "capture_type": kind, "nlos_laser_sampling": True,
        "nlos_hidden_geometry_sampling": True, "max_depth": 3,
    }  # fmt: skip
    return {
        "type": "scene",
        "integrator": settings | integrator,
        "laser": (laser or {"type": "laser_beam"}) | {"to_world": look},
        "wall": {"bsdf": {"type": "diffuse", "reflectance": 0.9}} | wall | {"sensor": meter},
        **hidden,
    }


def captures(description, spp, seeds, first=0):
    """The film's array for several seeds, float64."""
    scene = mi.load_dict(description)
    runs = []
    for seed in range(first, first + seeds):
        _, cube = scene.integrator().render(scene, seed=seed, spp=spp)
        runs.append(np.array(cube, dtype=np.float64))
    dr.sync_thread()
    return np.array(runs)


def ratio(a, b):
    """(ratio of the sums over everything, its standard error) of two sets of runs."""
    a, b = (x.reshape(len(x), -1).sum(1) for x in (a, b))
    errors = [x.std(ddof=1) / len(x) ** 0.5 / x.mean() for x in (a, b)]
    value = a.mean() / b.mean()
    return value, value * float(np.hypot(*errors))


def worst_of_blocks(a, b, size=10):
    """Largest number of standard errors between two sets of runs, over blocks of bins summed over points."""
    sums = [x.sum(tuple(range(1, x.ndim - 2)))[..., 0] for x in (a, b)]
    blocks = [s[:, : s.shape[1] // size * size].reshape(len(s), -1, size).sum(2) for s in sums]
    variance = sum(x.var(0, ddof=1) / len(x) for x in blocks)
    seen = variance > 0
    return float((np.abs(blocks[0].mean(0) - blocks[1].mean(0))[seen] / np.sqrt(variance[seen])).max())
