"""Shapes in groups are met as those outside of them are."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.gradient_cases.cases_instances import grouped
from support.gradient_cases.cases_media import block, clouds
from support.gradient_cases.scenes import instances
from support.gradient_cases.unknowns import rotate
from torchtransient import plugins


@pytest.fixture(autouse=True)
def mono():
    mi.set_variant("llvm_ad_mono")
    plugins.sync()


@pytest.mark.slow
def test_light_passes_open_boundaries_in_a_group():
    """A block of fog whose boundary has the BSDF ``null``: an instance of it was opaque."""
    images = []
    for scene in (block(clouds()), grouped(block(clouds()), "block")):
        scene = mi.load_dict(scene, optimize=False)
        images.append(np.array(scene.integrator().render(scene, seed=1, spp=64)[0]))
    assert images[0].mean() > 0
    np.testing.assert_allclose(images[1], images[0], rtol=1e-3)


@pytest.mark.slow
def test_an_instance_is_as_attached_after_a_derivative_as_before():
    scene = mi.load_dict(instances({"type": "diffuse"}), optimize=False)
    params = mi.traverse(scene)
    x = mi.Float(0)
    dr.enable_grad(x)
    rotate("copy.to_world", (0, 1, 0))(params, x)
    params.update()
    attached = params["copy.to_world"].matrix.index_ad if hasattr(x, "index_ad") else None
    film = scene.sensors()[0].film()
    ones = mi.TensorXf(np.ones(film.cube_shape(), dtype=np.float32))
    scene.integrator().render_backward(scene, params, (None, ones), seed=0, spp=16)
    pose = params["copy.to_world"]
    assert dr.grad_enabled(pose)
    assert attached is None or pose.matrix.index_ad == attached
    dr.enqueue(dr.ADMode.Backward, pose)
    dr.traverse(dr.ADMode.Backward)
    assert dr.grad(x)[0] != 0
