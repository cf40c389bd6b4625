"""Cameras, loading and comparisons for the tests of `transient_path`."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from support.runs import T, steady_runs
from torchtransient import plugins
from torchtransient.accuracy import two_sample_z_test


def camera(
    width=8, height=6, start=0.0, bins=200, bin_width=0.05, fov=30.0, origin=(0, 0, 4), transient=True, **arguments
):
    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
    if transient:
        film |= {"type": "transient_hdr_film", "temporal_bins": bins, "bin_width_opl": bin_width, "start_opl": start}
    return {
        "type": "perspective",
        "fov": fov,
        "near_clip": 0.1,
        "film": film,
        "to_world": T().look_at(origin=list(origin), target=[origin[0], origin[1], 0], up=[0, 1, 0]),
        **arguments,
    }


def load(sensor, objects, integrator="transient_path", **arguments):
    with plugins.plugin_errors():
        node = {"type": integrator, **({"max_depth": 4} | arguments)}
        return mi.load_dict({"type": "scene", "integrator": node, "sensor": sensor, **objects})


def mitsuba_runs(sensor, objects, count=6, spp=64, **arguments):
    """Images of Mitsuba's `path`."""
    return steady_runs(load(sensor, objects, "path", **arguments), count, spp)


def check(a, b):
    result = two_sample_z_test(a, b, rounding=1e-5)
    assert result.passed, str(result)
    assert result.chi2_z < 4.5, str(result)  # equal channels make it small


def as_mitsuba(value):
    """A scene dictionary of ``tt.scenes`` as ``mi.load_dict`` takes it: 4 x 4 arrays become transforms."""
    if isinstance(value, dict):
        return {key: as_mitsuba(child) for key, child in value.items()}
    return mi.ScalarTransform4f(value) if isinstance(value, np.ndarray) and value.shape == (4, 4) else value
