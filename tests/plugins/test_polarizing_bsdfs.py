"""Metals, thin elements and rough glass in polarized variants: values against Mitsuba's plugins, derivatives."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.surface_samples import activate, directions, interaction

MONO = "llvm_ad_mono_polarized"
LANES = 500


def entries(value):
    """The numbers of a BSDF value as an array with the lane last."""
    dr.eval(value)  # in one kernel
    values = [value[i, j] for i in range(4) for j in range(4)] if mi.is_polarized else [value]
    return np.stack([np.broadcast_to(np.array(x), (len(x), LANES)) for x in values]).astype(float)


def sampled(bsdf, wi, mode=None):
    ctx = mi.BSDFContext() if mode is None else mi.BSDFContext(mode)
    bs, weight = bsdf.sample(ctx, interaction(wi), mi.Float(0.3), mi.Point2f(0.2, 0.4), True)
    dr.eval(bs, weight)
    return np.array(bs.wo), entries(weight)


METALS = [{"material": "Au"}, {"material": "none"}, {"material": "Al", "specular_reflectance": 0.5}]
INDICES = [{"eta": 1.5, "k": 0.0}, {"eta": 0.2, "k": 3.0}, {"eta": 1.2, "k": 1e-3}]


def test_metal_equals_mitsubas():
    activate(MONO)
    for metal in METALS + INDICES:
        ours, theirs = (mi.load_dict({"type": name, **metal}) for name in ("diff_conductor", "conductor"))
        assert list(mi.traverse(ours).keys()) == list(mi.traverse(theirs).keys())
        for mode in (mi.TransportMode.Radiance, mi.TransportMode.Importance):
            (_, got), (_, expected) = (sampled(bsdf, directions(1, LANES), mode) for bsdf in (ours, theirs))
            assert expected.max() > 0.04
            np.testing.assert_allclose(got, expected, atol=5e-6)


@pytest.mark.parametrize("name", ["polarizer", "retarder", "circular"])
@pytest.mark.parametrize("variant", [MONO, "llvm_ad_mono"])
def test_thin_element_equals_mitsubas(variant, name):
    activate(variant)
    settings = {
        "polarizer": [{"theta": 33.0, "transmittance": 0.7}, {"polarizing": False}],
        "retarder": [{"theta": 33.0, "delta": 70.0, "transmittance": 0.7}],
        "circular": [{}, {"left_handed": True}],
    }[name]
    # Mitsuba's wave plate is right where the axes of its frames lie across the light.
    wi = mi.Vector3f(0, 0, mi.Float(np.repeat([1.0, -1.0], LANES // 2))) if name == "retarder" else directions(2, LANES)
    for setting in settings:
        pair = [mi.load_dict({"type": plugin, **setting}) for plugin in (f"diff_{name}", name)]
        assert list(mi.traverse(pair[0]).keys()) == list(mi.traverse(pair[1]).keys())
        assert pair[0].flags() == pair[1].flags()
        (wo, got), (expected_wo, expected) = (sampled(bsdf, wi) for bsdf in pair)
        np.testing.assert_array_equal(wo, expected_wo)
        np.testing.assert_allclose(got, expected, atol=1e-6)


def test_wave_plate_has_no_jump():
    """Across a plane in which Mitsuba's turns by tens of degrees."""
    activate(MONO)
    wi = mi.Vector3f(0.34, mi.Float([1e-4, -1e-4] * (LANES // 2)), 0.94)
    jump = {}
    for name in ("diff_retarder", "retarder"):
        values = sampled(mi.load_dict({"type": name, "theta": 30.0, "delta": 90.0}), wi)[1]
        jump[name] = np.abs(values[..., 0] - values[..., 1]).max()
    assert jump["retarder"] > 0.5
    assert jump["diff_retarder"] < 1e-3


def test_tilted_half_wave_plate():
    """It mirrors the plane of oscillation at its fast axis, which is projected across the light: here the axis lies in
    the plane of the tilt, so that light along it stays along it, at any tilt.
    """
    activate(MONO)
    for tilt in (0.0, 0.3, 0.9):
        wi = mi.Vector3f(math.sin(tilt), 0.0, math.cos(tilt))
        _, m = sampled(mi.load_dict({"type": "diff_retarder", "theta": 0.0, "delta": 180.0}), wi)
        # The implicit frame of a direction in the plane y = 0 has its x in that plane.
        np.testing.assert_allclose(m.reshape(4, 4, -1)[:2, :2, 0], np.eye(2), atol=1e-6)


def test_rough_glass_reflects_as_a_rough_metal_without_absorption():
    """Mitsuba's ``roughconductor`` with a real index has the reflected lobe of rough glass, matrices included."""
    activate(MONO)
    wi, wo = directions(3, LANES, 0.0), directions(4, LANES, 0.0)
    for shape in ({"alpha": 0.3, "distribution": "ggx"}, {"alpha_u": 0.1, "alpha_v": 0.5}):
        glass = mi.load_dict({"type": "diff_rough_dielectric", "int_ior": 1.5, "ext_ior": 1.0, **shape})
        metal = mi.load_dict({"type": "roughconductor", "eta": 1.5, "k": 0.0, **shape})
        got, expected = (entries(b.eval(mi.BSDFContext(), interaction(wi), wo, True)) for b in (glass, metal))
        assert np.abs(expected[5]).max() > 1e-2
        np.testing.assert_allclose(got, expected, atol=3e-5 * np.abs(expected).max())


@pytest.mark.slow
def test_rough_glass_samples_what_it_evaluates():
    """The weight of a sample is value over density, for all entries of the matrix."""
    wi_z = -0.4
    activate(MONO)
    rng = np.random.default_rng(5)
    bsdf = mi.load_dict({"type": "diff_rough_dielectric", "int_ior": 1.5, "ext_ior": 1.0, "alpha": 0.3})
    wi = mi.Vector3f(math.sqrt(1 - wi_z**2), 0, wi_z) + dr.zeros(mi.Vector3f, LANES)
    si = interaction(wi)
    u = rng.random((3, LANES)).astype(np.float32)
    bs, weight = bsdf.sample(mi.BSDFContext(), si, mi.Float(u[0]), mi.Point2f(u[1], u[2]), True)
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, bs.wo, True)
    w, v, density = entries(weight)[:, 0], entries(value)[:, 0], np.array(pdf)
    lit = (w[0] > 1e-3) & (density > 1e-2)
    assert lit.sum() > LANES / 4
    np.testing.assert_allclose((v / np.where(lit, density, 1))[:, lit], w[:, lit], atol=3e-3)


# -------------------------------------------------------------------------------------------------- derivatives


def weighted_sum(bsdf, wi):
    """A sum over the entries of the sampled matrix in which no two weigh the same."""
    _, weight = bsdf.sample(mi.BSDFContext(), interaction(wi), mi.Float(0.01), mi.Point2f(0.2, 0.4), True)
    return sum(weight[i, j][0] * (1 + 0.37 * i - 0.23 * j) for i in range(4) for j in range(4))


PLUGINS = {
    "diff_conductor": ({"eta": 0.5, "k": 2.0}, ("eta.value", "k.value")),
    "diff_polarizer": ({"theta": 20.0, "transmittance": 0.9}, ("theta.value", "transmittance.value")),
    "absorber": ({"theta": 20.0, "transmittance": 0.0}, ("theta.value", "transmittance.value")),
    "diff_retarder": ({"theta": 30.0, "delta": 80.0}, ("theta.value", "delta.value")),
}


@pytest.mark.parametrize(
    ("plugin", "wi"),
    [("diff_retarder", (0, 0, 1)), ("diff_conductor", (0, 0, 1)), *((name, (0.3, -0.2, 0.93)) for name in PLUGINS)],
)
def test_derivatives(plugin, wi):
    """Reverse mode against central differences, by every parameter and by the direction's two angles."""
    activate(MONO)
    settings, keys = PLUGINS[plugin]
    wi = np.array(wi) / np.linalg.norm(wi)
    tangents = np.linalg.svd(wi[None])[2][1:]

    def evaluate(unknown, key, tangent, differentiate):
        bsdf = mi.load_dict({"type": "diff_polarizer" if plugin == "absorber" else plugin, **settings})
        x = mi.Float(unknown)
        if differentiate:
            dr.enable_grad(x)
        direction = mi.Vector3f(*wi.tolist())
        if key is not None:
            params = mi.traverse(bsdf)
            params[key] = params[key] + x
            params.update()
        else:
            direction = dr.normalize(direction + mi.Vector3f(*tangent.tolist()) * x)
        total = weighted_sum(bsdf, direction)
        if not differentiate:
            return float(total[0])
        # Edges of weight zero are dropped: at normal incidence nothing is left of the direction.
        dr.backward(total, flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
        return float(dr.grad(x)[0])

    for key, tangent in [(key, None) for key in keys] + [(None, t) for t in tangents]:
        h = 0.2 if key and key.startswith(("theta", "delta")) else 5e-3
        # Fourth order: the error of the differences is below that of single precision.
        d1, d2 = ((evaluate(s, key, tangent, False) - evaluate(-s, key, tangent, False)) / (2 * s) for s in (h, 2 * h))
        expected = (4 * d1 - d2) / 3
        assert evaluate(0.0, key, tangent, True) == pytest.approx(expected, rel=2e-3, abs=3e-4)
