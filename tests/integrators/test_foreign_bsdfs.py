"""Surfaces that users write in Python: what they hold counts as it does without them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support import foreign_bsdfs
from support.gradient_cases.cases_mixtures import (
    DIFFUSE,
    METAL,
    MIRROR,
    ROUGH_GLASS,
    THIN_GLASS,
    blend,
    mask,
    mirror_room,
    transform,
    two_sided,
)
from torchtransient import plugins
from torchtransient.errors import GradientError, SceneError

MONO, POLARIZED = "llvm_ad_mono", "llvm_ad_mono_polarized"


def activate(variant):
    mi.set_variant(variant)
    plugins.sync()
    foreign_bsdfs.register()


def load(bsdf, behind=False):
    """A room whose paths meet the wall once, so that light is linear in what it scatters."""
    scene = mirror_room(bsdf)
    scene["integrator"]["max_depth"] = 3
    if behind:
        scene["wall"]["to_world"] = transform().rotate([0, 1, 0], 180)
    return mi.load_dict(scene, optimize=False)


def tint(nested):
    return {"type": "tint", "inner": nested}


def image(bsdf, behind=False):
    scene = load(bsdf, behind)
    return np.array(scene.integrator().render(scene, seed=3, spp=256)[1])


def slope(bsdf, key, value=None, spp=256):
    """Derivative of the light in the film by a parameter of the wall's BSDF, in reverse mode."""
    scene = load(bsdf)
    params = mi.traverse(scene)
    x = mi.Float(params[f"wall.bsdf.{key}"] if value is None else value)
    dr.enable_grad(x)
    params[f"wall.bsdf.{key}"] = x
    params.update()
    adjoint = dr.ones(mi.TensorXf, scene.sensors()[0].film().cube_shape())
    scene.integrator().render_backward(scene, params, (None, adjoint), seed=3, spp=spp)
    return float(dr.grad(x)[0])


@pytest.mark.slow
def test_lobe_probabilities_that_a_nested_bsdf_hides():
    activate(MONO)
    assert slope(tint(THIN_GLASS), "inner.eta") == pytest.approx(0.5 * slope(THIN_GLASS, "eta"), rel=1e-4)


@pytest.mark.slow
def test_matrices_of_a_nested_two_sided_surface_from_behind():
    activate(POLARIZED)
    metal = two_sided({**METAL, "alpha": 0.3, "eta": 0.5, "k": 2.0})
    direct, tinted = image(metal, behind=True), image(tint(metal), behind=True)
    assert np.abs(direct[..., 1:]).max() > 1e-3 * direct.max(), "no polarization: the test would prove nothing"
    np.testing.assert_allclose(tinted, 0.5 * direct, rtol=1e-3, atol=1e-5 * direct.max())


@pytest.mark.slow
def test_a_surface_that_does_not_describe_itself():
    activate(MONO)
    np.testing.assert_allclose(image({"type": "nameless"}), image(DIFFUSE), rtol=1e-4, atol=1e-6)


def test_mixtures_inside_that_mitsuba_samples_rightly():
    activate(MONO)
    mixture = mask(THIN_GLASS)
    np.testing.assert_allclose(image(tint(mixture)), 0.5 * image(mixture), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    "mixture", [two_sided(tint(blend(DIFFUSE, MIRROR))), tint(blend(DIFFUSE, ROUGH_GLASS))], ids=["mirror", "glass"]
)
def test_mixtures_inside_that_mitsuba_samples_wrongly_are_refused(mixture):
    activate(MONO)
    with pytest.raises(SceneError, match=r"Tint .* holds BlendBSDF .* into the parts of the mixture"):
        image(mixture)


@pytest.mark.parametrize(
    ("mixture", "key", "value", "reason"),
    [
        (mask(THIN_GLASS), "inner.nested_bsdf.eta", None, "hides the derivative of its probability"),
        (blend(DIFFUSE, METAL), "inner.weight.value", 0.0, "exactly 0 or 1"),
    ],
)
def test_lost_derivatives_of_mixtures_inside_are_refused(mixture, key, value, reason):
    activate(MONO)
    with pytest.raises(GradientError, match=reason):
        slope(tint(mixture), key, value)
    if key.endswith("eta"):
        assert slope(tint(mixture), "tint") > 0
