"""Derivatives by weights of lobes and parts that are zero or almost: asked for in place, shared, and not noisier there.

For one seed the random numbers are the same at 0 and at 1e-4, and so are the derivatives as long as as many samples go
to the lobe.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.gradient_cases.scenes import area_light, room, transform
from torchtransient import plugins

DIFFUSE = {"type": "diffuse", "reflectance": 0.5}
MIRROR = {"type": "conductor"}


@pytest.fixture(autouse=True)
def mono():
    mi.set_variant("llvm_ad_mono")
    plugins.sync()


def number(value):
    return {"type": "uniform", "value": value}


def scene_of(bsdf, **more):
    """A wall with another one behind it, which light reaches that goes around."""
    behind = {"type": "rectangle", "to_world": transform().translate([0, 0, -1]).scale(3)}
    scene = room(bsdf=bsdf, light=area_light(), depth=3, behind=behind, sky={"type": "constant"}, **more)
    scene["sensor"]["film"] |= {"temporal_bins": 4, "bin_width_opl": 4.0, "start_opl": 0.0}
    return mi.load_dict(scene, optimize=False)


def backward(scene, spp, seed):
    adjoint = dr.ones(mi.TensorXf, scene.sensors()[0].film().cube_shape())
    scene.integrator().render_backward(scene, None, (None, adjoint), spp=spp, seed=seed)


def derivative(scene, keys, value, seed=0, spp=1024):
    """By one number that is written to all of ``keys``."""
    params, x = mi.traverse(scene), mi.Float(value)
    dr.enable_grad(x)
    for key in keys:
        params[key] = x + 0
    params.update()
    backward(scene, spp, seed)
    for key in keys:
        dr.enqueue(dr.ADMode.Backward, params[key])
    dr.traverse(dr.ADMode.Backward)
    found = float(dr.grad(x)[0])
    for key in keys:
        params[key] = mi.Float(value)
    params.update()
    return found


def derivative_in_place(scene, key, spp=1024):
    """As :func:`derivative`, of the value that is there, without ``params.update()``."""
    value = mi.traverse(scene)[key]
    dr.enable_grad(value)
    backward(scene, spp, 0)
    return float(dr.grad(value)[0])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("bsdf", "key", "end"),
    [
        ({"type": "diff_principled", "spec_trans": number(0.0), "roughness": 0.4}, "spec_trans.value", 0.0),
        ({"type": "diff_principled", "metallic": number(0.0)}, "metallic.value", 1.0),
        ({"type": "diff_principled_thin", "diff_trans": number(0.0)}, "diff_trans.value", 2.0),
        ({"type": "diff_plastic", "specular_reflectance": number(0.0)}, "specular_reflectance.value", 0.0),
        ({"type": "blendbsdf", "weight": number(0.0), "a": DIFFUSE, "b": MIRROR}, "weight.value", 1.0),
        ({"type": "mask", "opacity": number(0.0), "nested": DIFFUSE}, "opacity.value", 0.0),
    ],
)
def test_no_noisier_beside_an_end_than_at_it(bsdf, key, end):
    scene = scene_of(bsdf)
    inside = end + (1e-4 if end == 0 else -1e-4)
    at_end, beside = ([derivative(scene, [f"wall.bsdf.{key}"], x, seed) for seed in range(3)] for x in (end, inside))
    assert min(np.abs(at_end)) > 1e-3
    np.testing.assert_allclose(beside, at_end, rtol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("bsdf", "key"),
    [
        ({"type": "diff_principled", "clearcoat": 0.0}, "clearcoat.value"),
        ({"type": "diff_principled", "spec_trans": 0.5, "eta": 1.4}, "eta"),
        ({"type": "diff_plastic", "specular_reflectance": number(0.0)}, "specular_reflectance.value"),
    ],
)
def test_derivatives_that_are_switched_on_in_place(bsdf, key):
    """Mitsuba tells a plugin nothing of it."""
    key = f"wall.bsdf.{key}"
    value = float(mi.traverse(scene_of(bsdf))[key][0])
    expected = derivative(scene_of(bsdf), [key], value)
    assert abs(expected) > 1e-3
    assert derivative_in_place(scene_of(bsdf), key) == pytest.approx(expected, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "slot", "value"), [("diff_principled", "spec_trans", 0.0), ("diff_plastic", "specular_reflectance", 1e-3)]
)
def test_two_surfaces_with_one_texture(kind, slot, value):
    """Mitsuba tells only one of them that it changes."""
    rates = []
    for shared in (True, False):
        texture = mi.load_dict(number(0.0))
        ours, theirs = texture, texture if shared else mi.load_dict(number(0.0))
        half = {
            "type": "rectangle", "to_world": transform().translate([1, 0, 0.05]), "bsdf": {"type": kind, slot: theirs}
        }  # fmt: skip
        scene = scene_of({"type": kind, slot: ours}, half=half)
        keys = [key for key in mi.traverse(scene).properties if key.endswith(f"{slot}.value")]
        assert len(keys) == (1 if shared else 2)
        rates.append(derivative(scene, keys, value))
    assert abs(rates[1]) > 1e-3 and rates[0] == pytest.approx(rates[1], rel=1e-3)


