"""Lights that emit along their normals alone: dark to every path from the sensor; nothing else breaks beside them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.plain_scenes import as_mitsuba
from tools.gradient_sweep.lights import area_emitters
from tools.gradient_sweep.shapes import lamp_shapes
from tools.gradient_sweep.stages import lit_by, matte, move, stretch, turn
from torchtransient import plugins
from torchtransient.errors import GradientError

VARIANT = "llvm_ad_rgb"
REFLECTANCE = "plate.bsdf.reflectance.value"


def scene(folder, beside, dark):
    """A plate under a lamp of some shape, a directional area light beside it or its black shape alone."""
    panel = {"type": "rectangle", "to_world": move(-0.8, 0.3, 2.5) @ turn(1, 170) @ stretch(0.3), "bsdf": matte(0.0)}
    lamp = lamp_shapes()[beside](folder) | {"emitter": area_emitters()["area"]()}
    light = {"emitter": area_emitters()["directionalarea"]()} if dark else {}
    return lit_by(lamp) | {"dark": panel | light}


@pytest.mark.slow
def test_other_lights_and_their_derivatives_beside_one(tmp_path):
    """Mitsuba's raises in every kernel that asks lights for their emission in a direction."""
    found = []
    for dark in (True, False):
        loaded = tt.load(scene(tmp_path, "sphere", dark), variant="llvm_ad_rgb")
        value = torch.tensor(0.5, requires_grad=True)
        total = tt.render(loaded, {REFLECTANCE: value}, spp=4096, seed=0).transient.sum()
        total.backward()
        found.append((total.item(), value.grad.item()))
    np.testing.assert_allclose(found[0], found[1], rtol=0.02)
    assert min(map(abs, found[0])) > 0.01


def test_its_radiance_has_no_derivative(tmp_path):
    loaded = tt.load(scene(tmp_path, "rectangle", True), variant="llvm_ad_rgb")
    info = loaded.parameters()["dark.emitter.radiance.value"]
    assert not info.differentiable and "dark" in info.reason
    with pytest.raises(GradientError, match="dark"):
        tt.render(loaded, {info.key: torch.ones(3, requires_grad=True)}, spp=4, seed=0)


def test_scenes_with_mitsubas_own_are_refused_by_derivatives(tmp_path):
    mi.set_variant("llvm_ad_rgb")
    plugins.sync()
    bare = mi.load_dict(as_mitsuba(scene(tmp_path, "rectangle", True)), optimize=False)
    params = mi.traverse(bare)
    value = type(params[REFLECTANCE])(0.5)
    dr.enable_grad(value)
    params[REFLECTANCE] = value
    params.update()
    adjoint = dr.ones(mi.TensorXf, bare.sensors()[0].film().cube_shape())
    with pytest.raises(GradientError, match="diff_directionalarea"):
        bare.integrator().render_backward(bare, params, (None, adjoint), spp=4)


def shapes_with_lights():
    """With Mitsuba's, with ours."""
    radiance = {"type": "d65", "scale": 5.0}
    pose = mi.ScalarTransform4f().scale(2)
    names = ("directionalarea", "diff_directionalarea")
    lights = [{"type": name, "radiance": radiance} for name in names]
    return [mi.load_dict({"type": "rectangle", "to_world": pose, "emitter": light}) for light in lights]


def test_rays_that_leave_it_are_those_of_mitsuba():
    mi.set_variant("llvm_ad_mono_polarized")
    plugins.sync()
    u, shapes = mi.Point2f([0.2, 0.7], [0.4, 0.9]), shapes_with_lights()
    (ray, weight), (expected, expected_weight) = (s.emitter().sample_ray(0.0, 0.3, u, u)[:2] for s in shapes)
    for found, right in [(ray.o, expected.o), (ray.d, expected.d), (ray.wavelengths, expected.wavelengths)]:
        np.testing.assert_allclose(np.array(found), np.array(right), rtol=1e-6)
    np.testing.assert_allclose(np.array(weight), np.array(expected_weight), rtol=1e-6)
