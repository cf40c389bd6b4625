"""Hit points that are attached here: the tables behind them follow what is installed."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from support.gradient_cases.cases_curves import DIFFUSE, ellipsoid, seen_wall

VARIANT = "llvm_ad_mono"
OUT_OF_SIGHT = [5.0, 0.0, 30.0, 0.1, 0.1, 0.1, 0.0, 0.0, 0.0, 1.0]


def scene_with(count):
    """A wall that is an ellipsoid, and as many small ones out of sight, which come first."""
    data = mi.TensorXf(np.array([OUT_OF_SIGHT] * count, dtype=np.float32))
    scene = {"behind": {"type": "ellipsoids", "data": data, "bsdf": DIFFUSE}} | seen_wall(ellipsoid())
    return mi.load_dict(scene, optimize=False)


def slope(scene):
    """Sum of the derivative of the image by a growing wall."""
    params = mi.traverse(scene)
    x = mi.Float(0)
    dr.enable_grad(x)
    dr.set_grad(x, 1)
    params["wall.data"] = dr.detach(params["wall.data"]) + mi.Float([0, 0, 1, 0, 0, 0, 0, 0, 0, 0]) * x
    params.update()
    found = scene.integrator().render_forward(scene, params, seed=0, spp=256)
    return np.array(found[1] if isinstance(found, tuple) else found)


def test_ellipsoids_that_become_more():
    """Guards against rows of a table that begin where they began when the scene was first seen."""
    expected = slope(scene_with(3))
    grown = scene_with(1)
    slope(grown)
    params = mi.traverse(grown)
    params["behind.data"] = mi.Float(OUT_OF_SIGHT * 3)
    params.update()
    assert np.abs(expected).max() > 0
    np.testing.assert_allclose(slope(grown), expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max())
