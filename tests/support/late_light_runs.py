"""Scans of whole scenes for tests of late light, and the chains of a scan by themselves."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.stats import t as student

from support.third_bounce_runs import captured
from torchtransient.interfaces import CaptureType
from torchtransient.plugins.around_corner.late_light import LateLight
from torchtransient.plugins.around_corner.launches import ScanJob
from torchtransient.plugins.around_corner.shared_light import late_density

ORIGIN = [-0.5, 0.0, 0.25]


def wall_rectangle(albedo=0.9):
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().scale([0.7, 0.7, 1]),
        "bsdf": {"type": "diffuse", "reflectance": albedo},
    }


def scan_scene(
    shapes, kind="confocal", size=(3, 2), film=None, wall=None, spot=(-0.2, 0.1, 0.0), points=None, **integrator
):
    """A loaded scene: built ``shapes`` before a wall of one metre and a half (or ``wall``, a dictionary); ``points``
    (N, 3): the scanned ones, where the wall does not say which.
    """
    film = {
        "type": "transient_hdr_film", "temporal_bins": 60, "bin_width_opl": 0.1, "start_opl": 1.0,
        "width": size[0], "height": size[1], "rfilter": {"type": "box"}, **(film or {}),
    }  # fmt: skip
    if film["type"] != "transient_hdr_film":
        film = {k: v for k, v in film.items() if k not in ("temporal_bins", "bin_width_opl")}
    if kind == "exhaustive":
        film |= {"exhaustive_scan": True, "laser_scan_width": size[0], "laser_scan_height": size[1]}
    sensor = {"type": "nlos_capture_meter", "sensor_origin": ORIGIN, "film": film}
    if points is not None:
        sensor["points"] = mi.TensorXf(np.asarray(points, dtype=np.float32))
    look = mi.ScalarTransform4f().look_at(ORIGIN, list(spot), [0, 1, 0])
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {
                "type": "transient_nlos_path", "capture_type": kind, "nlos_laser_sampling": True,
                "nlos_hidden_geometry_sampling": True, **integrator,
            },
            "laser": {"type": "laser_beam", "to_world": look},
            "wall": {**(wall or wall_rectangle()), "sensor": sensor},
            **{f"hidden{i}": shape for i, shape in enumerate(shapes)},
        },
        optimize=False,
    )  # fmt: skip


def rendered(scene, spp, seeds, first=0):
    """Transients ``(seeds, points, bins)`` or ``(seeds, points, spots, bins)``, channels first where there are some."""
    runs = []
    for seed in range(first, first + seeds):
        cube = np.array(scene.integrator().render(scene, seed=seed, spp=spp)[1], dtype=float)
        runs.append(cube)
    return np.array(runs)


def agree(a, b, blocks=10, total=1e-3, block=1e-5):
    """Whether the means of runs ``(seeds, ..., bins, channels)`` agree: totals, and each of some blocks of time, by
    Welch's test. ``total``, ``block``: chances of a difference as large where there is none; of a hundred tests of ten
    blocks one fails in a hundred. Returns (whether they do, the differences over their standard errors).
    """
    a, b = (x.sum(tuple(range(1, x.ndim - 2))).sum(-1) for x in (a, b))
    a, b = (np.concatenate([x.sum(1)[:, None], x.reshape(len(x), blocks, -1).sum(2)], 1) for x in (a, b))
    squares = [x.var(0, ddof=1) / len(x) for x in (a, b)]
    error = np.sqrt(sum(squares))
    z = (a.mean(0) - b.mean(0)) / np.where(error > 0, error, 1)
    spread = sum(square**2 / (len(x) - 1) for square, x in zip(squares, (a, b), strict=True))
    freedom = np.where(spread > 0, error**4 / np.where(spread > 0, spread, 1), 1)
    chance = 2 * student.sf(np.abs(z), freedom)
    return bool(chance[0] > total and chance[1:].min() > block), z


def chains(scene, elements, film, sensors, lasers, kind, count, seed=0, bounces=(4, 5), **choices):
    """(steady, array) of the late light of a scan of :class:`.WallPoints`."""

    def add():
        job = ScanJob(scene, film, sensors)
        LateLight(job, elements, lasers, CaptureType[kind.upper()], bounces, **choices).add(count, seed)

    with dr.suspend_grad():
        return captured(film, add, count)


def density_of(scene, elements, points, normals):
    return late_density(scene, elements, np.asarray(points, float), np.asarray(normals, float))
