"""``diff_rough_plastic`` against Mitsuba's ``roughplastic``, and the derivatives of its tables."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.gradient_cases.scenes import area_light, room
from support.marks import long
from torchtransient import plugins
from torchtransient.errors import GradientError
from torchtransient.plugins.bsdfs import rough_coating
from torchtransient.plugins.bsdfs.rough_coating import external_transmittance, internal_reflectance

CASES = [
    {"alpha": 0.01, "int_ior": 1.5},
    {"alpha": 0.1, "int_ior": 1.3, "distribution": "ggx", "nonlinear": True},
    {"alpha": 0.3, "int_ior": 2.0, "sample_visible": False},
    {"alpha": 0.7, "int_ior": 0.7, "distribution": "ggx", "specular_reflectance": 0.5},
]


@pytest.fixture(autouse=True)
def mono():
    mi.set_variant("llvm_ad_mono")
    plugins.sync()


def pair(**settings):
    return [mi.load_dict({"type": name, "ext_ior": 1.0, **settings}) for name in ("roughplastic", "diff_rough_plastic")]


@pytest.mark.parametrize("settings", long(CASES, CASES[1:2]), ids=lambda s: str(s["alpha"]))
def test_values_densities_and_samples_are_those_of_mitsuba(settings):
    theirs, ours = pair(diffuse_reflectance=0.6, **settings)
    count = 20000
    rng = mi.PCG32(count)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.wi = mi.warp.square_to_cosine_hemisphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
    u, v = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
    for component in (None, 0, 1):
        ctx = mi.BSDFContext()
        if component is not None:
            ctx.component = component
        (a, weight_a), (b, weight_b) = (bsdf.sample(ctx, si, u, v) for bsdf in (theirs, ours))
        above = a.wo.z > 1e-3
        (value_a, pdf_a), (value_b, pdf_b) = (bsdf.eval_pdf(ctx, si, a.wo, above) for bsdf in (theirs, ours))
        dr.eval(a, weight_a, b, weight_b, value_a, pdf_a, value_b, pdf_b)  # in one kernel
        pairs = [(weight_a[0], weight_b[0]), (value_a[0], value_b[0]), (pdf_a, pdf_b)]
        for one, other in pairs:
            one, other = (np.array(dr.select(above, x, 0)) for x in (one, other))
            # Random numbers next to the border between the lobes fall to either side of it.
            assert np.quantile(np.abs(one - other) / (1e-3 + np.abs(one)), 0.999) < 5e-4
        assert np.mean(np.array(a.sampled_component) != np.array(b.sampled_component)) < 1e-3


TABLES = [
    (external_transmittance, True, 0.6, 1.9), (external_transmittance, False, 0.1, 1.5),
    (internal_reflectance, True, 0.3, 1.3), (internal_reflectance, False, 0.6, 1.9),
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("table", "ggx", "alpha", "eta"), TABLES)
def test_derivatives_of_the_tables(monkeypatch, table, ggx, alpha, eta):
    """Against differences of the fourth order on a quadrature that is fine enough for them."""

    def value(a, e):
        return np.array(table(mi.Float(a), mi.Float(e), ggx), dtype=float)

    def derivative(key):
        numbers = {"alpha": mi.Float(alpha), "eta": mi.Float(eta)}
        dr.enable_grad(numbers[key])
        result = table(numbers["alpha"], numbers["eta"], ggx)
        dr.forward(numbers[key])
        return np.array(dr.grad(result), dtype=float)

    def difference(f, h):
        return (8 * (f(h) - f(-h)) - (f(2 * h) - f(-2 * h))) / (12 * h)

    found = derivative("alpha"), derivative("eta")
    monkeypatch.setattr(rough_coating, "_NODES", 192)
    monkeypatch.setattr(rough_coating, "_NODES_TOTAL_REFLECTION", 384)
    by_alpha = difference(lambda h: value(alpha + h, eta), 0.1 * alpha)
    by_eta = difference(lambda h: value(alpha, eta + h), 0.1 * (eta - 1))
    for one, expected in zip(found, (by_alpha, by_eta), strict=True):
        assert np.abs(one - expected).max() < 0.01 * np.abs(expected).max()


def test_tables_follow_an_update():
    _, ours = pair(alpha=0.1, int_ior=1.5)
    params = mi.traverse(ours)
    before = np.array(ours.transmittance)
    params["alpha"] = mi.Float(0.4)
    params.update()
    _, expected = pair(alpha=0.4, int_ior=1.5)
    assert np.abs(np.array(ours.transmittance) - before).max() > 1e-2
    np.testing.assert_allclose(np.array(ours.transmittance), np.array(expected.transmittance), atol=1e-6)
    np.testing.assert_allclose(np.array(ours.thrown_back), np.array(expected.thrown_back), atol=1e-6)


def test_the_derivative_of_mitsubas_own_is_refused():
    key = "eta"
    scene = mi.load_dict(room(bsdf={"type": "roughplastic", "alpha": 0.3}, light=area_light()), optimize=False)
    params = mi.traverse(scene)
    value = mi.Float(params[f"wall.bsdf.{key}"])
    dr.enable_grad(value)
    params[f"wall.bsdf.{key}"] = value
    params.update()
    adjoint = dr.ones(mi.TensorXf, scene.sensors()[0].film().cube_shape())
    with pytest.raises(GradientError, match="diff_rough_plastic"):
        scene.integrator().render_backward(scene, params, (None, adjoint), spp=4)
    params[f"wall.bsdf.{key}"] = dr.detach(value)
    params.update()


@pytest.mark.slow
@pytest.mark.parametrize("table", [external_transmittance, internal_reflectance])
def test_slopes_at_an_index_of_exactly_one(table):
    """An optimizer may come to it: they lie between those of indices that are nearer to one and farther from it."""
    for alpha in (0.02, 0.3):
        slopes = []
        for number in (1 + 2e-6, 1.0, 1 + 5e-5):
            eta = mi.Float(number)
            dr.enable_grad(eta)
            found = table(mi.Float(alpha), eta, True)
            dr.forward(eta)
            slopes.append(dr.grad(found).numpy())
        near, here, far = (np.abs(slope).max() for slope in slopes)
        assert np.isfinite(slopes).all() and here > 1e-4
        assert min(near, far) <= here <= max(near, far)
