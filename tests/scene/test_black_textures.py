"""Textures that are exactly zero keep their derivatives: below a normal or bump map, and in lights."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.gradient_cases.scenes import area_light, room

VARIANT = "llvm_ad_mono"
ZERO = {"type": "uniform", "value": 0.0}
MAPS = {
    "normalmap": {"normalmap": {"type": "rgb", "value": [0.55, 0.48, 0.98]}},
    "bumpmap": {"arbitrary": {"type": "uniform", "value": 0.1}},
}
NESTED = {
    "diffuse": ("reflectance", {"type": "diffuse", "reflectance": ZERO}),
    "mirror": (
        "specular_reflectance",
        {"type": "conductor", "material": "none", "specular_reflectance": ZERO},
    ),
    "plastic": ("diffuse_reflectance", {"type": "plastic", "diffuse_reflectance": ZERO}),
    "principled": ("spec_trans", {"type": "principled", "roughness": 0.5, "spec_trans": ZERO, "base_color": 0.7}),
}


# What mirrors the lamp must not lean.
LEVEL = {"normalmap": {"type": "bitmap", "data": np.full((2, 2, 3), (0.5, 0.5, 1.0), np.float32), "raw": True}}


def described(kind, nested):
    """A wall under a lamp with a bright panel beside it: much of its light comes from there."""
    wall = {"type": kind, **(LEVEL if nested["type"] == "conductor" else MAPS[kind]), "nested": nested}
    return room(bsdf=wall, light=area_light(), side_reflectance=0.95)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "name"), [
    ("normalmap", "diffuse"), ("bumpmap", "plastic"), ("normalmap", "mirror"), ("bumpmap", "principled"),
])  # fmt: skip
def test_slope_at_zero(kind, name):
    slot, nested = NESTED[name]
    scene = tt.load(described(kind, nested), variant=VARIANT)
    key = f"wall.bsdf.nested_bsdf.{slot}.value"
    assert not scene.parameters()[key].biased
    compare(scene, key, 2048)


def compare(scene, key, spp, step=0.1):
    """The slope at a value of zero, from above; of four seeds where they agree to float32, else of sixteen.

    Four are too few to know their own spread: the differences of a bumpy plastic have a deviation of 0.23, four of them
    had one of 0.03. Of sixteen Student's t is above 4 once in 900 tests.
    """
    renderer = tt.TransientRenderer(scene, parameters=[key], spp=spp, grad_seed="same")
    zero = torch.zeros_like(renderer.values[key])

    def brightness(x, seed):
        return renderer(values={key: x}, seed=seed).steady.double().sum()

    found, expected = [], []
    for seed in range(16):
        x = zero.clone().requires_grad_()
        brightness(x, seed).backward()
        found.append(float(x.grad.sum()))
        with torch.no_grad():
            here, near, far = (brightness(zero + step * k, seed) for k in range(3))
        expected.append(float(4 * near - 3 * here - far) / (2 * step))
        if seed == 3 and np.std(np.subtract(found, expected)) < 1e-3 * abs(np.mean(expected)):
            break
    found, expected = np.array(found), np.array(expected)
    error = (found - expected).std(ddof=1) / np.sqrt(len(found))
    assert abs(found.mean() - expected.mean()) < 4 * error + 0.02 * abs(expected.mean())
    assert error < 0.1 * abs(expected.mean())


def picture(value, channels=1):
    return np.full((4, 4, channels), value, np.float32)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["lamp", "sky"])
def test_a_light_without_light(kind):
    if kind == "sky":
        light, key = {"type": "envmap", "bitmap": mi.Bitmap(picture(0.0, 3))}, "light.data"
    else:
        radiance = {"type": "bitmap", "bitmap": mi.Bitmap(picture(0.0)), "raw": True}
        light, key = (
            area_light("sphere") | {"emitter": {"type": "area", "radiance": radiance}},
            "light.emitter.radiance.data",
        )
    compare(tt.load(room(light=light), variant=VARIANT), key, 1024)


@pytest.mark.slow
def test_black_that_weighs_elsewhere():
    """One texture in a normal map and as the weight of a mixture."""
    shared = {"type": "ref", "id": "nothing"}
    wall = {"type": "normalmap", **MAPS["normalmap"], "nested": {"type": "diffuse", "reflectance": shared}}
    side = {"type": "blendbsdf", "weight": shared, "a": {"type": "diffuse", "reflectance": 0.95}, "b": {"type": "null"}}
    scene = {"nothing": ZERO | {"id": "nothing"}, **room(bsdf=wall, light=area_light())}
    scene["side"] = scene["side"] | {"bsdf": side}
    compare(tt.load(scene, variant=VARIANT), "nothing.value", 2048)
