"""A plain histogram has no derivative in time."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.marks import long
from torchtransient import plugins
from torchtransient.errors import GradientError


def problem(filter):
    """A wall at z = 0 that can move, camera and light at z = 4: the mean arrival is 8 - 2 z."""
    mi.set_variant("llvm_ad_mono")
    plugins.sync()
    t = mi.ScalarTransform4f()
    film = {
        "type": "transient_hdr_film",
        "width": 1,
        "height": 1,
        "rfilter": {"type": "box"},
        "temporal_bins": 100,
        "bin_width_opl": 0.05,
        "start_opl": 5.513,
        "temporal_filter": filter,
        "gaussian_stddev": 1.5,
    }
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "transient_path", "max_depth": 2},
            "sensor": {
                "type": "perspective",
                "fov": 0.1,
                "near_clip": 0.5,
                "film": film,
                "to_world": t.look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
            },
            "wall": {"type": "rectangle"},
            "light": {"type": "point", "position": [0.0, 0.0, 4.0], "intensity": 5.0},
        }
    )


def attach(scene):
    z = mi.Float(0.0)
    dr.enable_grad(z)
    params = mi.traverse(scene)
    params["wall.to_world"] = mi.AffineTransform4f().translate(mi.Vector3f(0, 0, z)) @ mi.AffineTransform4f(
        params["wall.to_world"]
    )
    params.update()
    return params, z


def test_box_filter_refuses_gradients_of_path_lengths():
    """Guards against the silent zero: binning by floor has a derivative of zero almost everywhere."""
    scene = problem("box")
    params, _ = attach(scene)
    adjoint = mi.TensorXf(np.ones((1, 1, 100, 1)))
    with pytest.raises(GradientError, match="tent"):
        scene.integrator().render_backward(scene, params, (None, adjoint), spp=4)
    with pytest.raises(GradientError, match="tent"):
        scene.integrator().render_forward(scene, params, spp=4)


def test_box_filter_keeps_gradients_of_light():
    scene = problem("box")
    params = mi.traverse(scene)
    key = "light.intensity.value"
    steady, _ = scene.integrator().render(scene, spp=64)
    dr.enable_grad(params[key])
    params.update()
    scene.integrator().render_backward(scene, params, (None, mi.TensorXf(np.ones((1, 1, 100, 1)))), spp=64)
    assert float(dr.grad(params[key])[0]) == pytest.approx(float(steady.array[0]) / 5.0, rel=1e-5)


@pytest.mark.parametrize("filter", long(["tent", "gaussian"], ["tent"]))
def test_mean_arrival_of_a_moving_wall(filter):
    """d (mean arrival) / dz = -2 exactly, in reverse and in forward mode."""
    scene = problem(filter)
    _, transient = scene.integrator().render(scene, spp=256)
    bins = np.array(transient, dtype=float)[0, 0, :, 0]
    centers = 5.513 + (np.arange(100) + 0.5) * 0.05
    total, mean = bins.sum(), centers @ bins / bins.sum()
    assert mean == pytest.approx(8.0, abs=0.025)
    weight = (centers - mean) / total  # of the mean arrival, by the quotient rule
    params, z = attach(scene)
    adjoint = mi.TensorXf(weight.reshape(1, 1, 100, 1))
    scene.integrator().render_backward(scene, params, (None, adjoint), spp=256)
    dr.enqueue(dr.ADMode.Backward, params["wall.to_world"])
    dr.traverse(dr.ADMode.Backward)
    # the gaussian is cut at four standard deviations, where it is 3e-4 of its height
    assert float(dr.grad(z)[0]) == pytest.approx(-2, abs=2e-3)
    scene = problem(filter)
    params, z = attach(scene)
    dr.set_grad(z, 1.0)
    dr.enqueue(dr.ADMode.Forward, z)
    dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges)
    _, forward = scene.integrator().render_forward(scene, params, spp=256)
    assert np.array(forward, dtype=float)[0, 0, :, 0] @ weight == pytest.approx(-2, abs=2e-3)
