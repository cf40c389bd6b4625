"""Textures that are exactly zero below a normal or bump map keep their derivatives."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.gradient_cases.scenes import area_light, room
from torchtransient.errors import GradientError

VARIANT = "llvm_ad_mono"
ZERO = {"type": "uniform", "value": 0.0}
MAPS = {
    "normalmap": {"normalmap": {"type": "rgb", "value": [0.55, 0.48, 0.98]}},
    "bumpmap": {"arbitrary": {"type": "uniform", "value": 0.1}},
}
NESTED = {
    "diffuse": ("reflectance", {"type": "diffuse", "reflectance": ZERO}),
    "rough metal": ("specular_reflectance", {"type": "roughconductor", "alpha": 0.4, "specular_reflectance": ZERO}),
    "plastic": ("diffuse_reflectance", {"type": "plastic", "diffuse_reflectance": ZERO}),
    "principled": ("spec_trans", {"type": "principled", "roughness": 0.5, "spec_trans": ZERO, "base_color": 0.7}),
}


def described(kind, nested):
    """A wall under a lamp with a bright panel beside it: much of its light comes from there."""
    wall = {"type": kind, **MAPS[kind], "nested": nested}
    return room(bsdf=wall, light=area_light(), side_reflectance=0.95)


@pytest.mark.parametrize("name", NESTED)
@pytest.mark.parametrize("kind", MAPS)
def test_slope_at_zero(kind, name):
    slot, nested = NESTED[name]
    scene = tt.load(described(kind, nested), variant=VARIANT)
    key = f"wall.bsdf.nested_bsdf.{slot}.value"
    assert not scene.parameters()[key].biased
    renderer = tt.TransientRenderer(scene, parameters=[key], spp=8192, grad_seed="same")

    def brightness(x, seed):
        return renderer(values={key: x}, seed=seed).steady.double().sum()

    found, expected = [], []
    for seed in range(6):
        x = torch.zeros((), requires_grad=True)
        brightness(x, seed).backward()
        found.append(float(x.grad))
        with torch.no_grad():
            here, near, far = (brightness(torch.tensor(0.1 * k), seed) for k in range(3))
        expected.append(float(4 * near - 3 * here - far) / 0.2)
    found, expected = np.array(found), np.array(expected)
    error = (found - expected).std(ddof=1) / np.sqrt(6)
    assert abs(found.mean() - expected.mean()) < 4 * error + 0.02 * abs(expected.mean())
    assert error < 0.1 * abs(expected.mean())


def test_a_scene_of_mitsuba_is_refused():
    scene = mi.load_dict(described("normalmap", NESTED["diffuse"][1]), optimize=False)
    params = mi.traverse(scene)
    key = "wall.bsdf.nested_bsdf.reflectance.value"
    value = type(params[key])(0.0)
    dr.enable_grad(value)
    params[key] = value
    params.update()
    adjoint = dr.ones(mi.TensorXf, scene.sensors()[0].film().cube_shape())
    with pytest.raises(GradientError, match="1e-30"):
        scene.integrator().render_backward(scene, params, (None, adjoint), spp=4)
