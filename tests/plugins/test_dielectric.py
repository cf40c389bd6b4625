"""``diff_dielectric`` and ``diff_rough_dielectric`` against Mitsuba's plugins, and their derivatives against the
textbook."""

from __future__ import annotations

from itertools import product

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

from support.dielectric_reference import fresnel_reflectance, refracted_direction, rough_dielectric
from support.marks import long, long_rows
from support.surface_samples import activate
from support.sweeps import together

LANES = 4000

MATERIALS = [
    {"int_ior": 1.5, "ext_ior": 1.0},
    {},
    {"int_ior": "water", "ext_ior": "diamond"},
    {"int_ior": 1.33, "specular_reflectance": 0.3, "specular_transmittance": 0.7},
]
ROUGHNESSES = [
    {"alpha": 0.3},
    {"alpha": 0.02, "distribution": "ggx"},
    {"alpha_u": 0.1, "alpha_v": 0.5, "distribution": "ggx"},
    {"alpha_u": 0.1, "alpha_v": 0.5},
]


def directions(count: int, seed: int) -> np.ndarray:
    """Directions over the whole sphere; one in ten is close to the surface."""
    d = np.random.default_rng(seed).normal(size=(count, 3))
    d[::10, 2] *= 1e-2
    return (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)


def interaction(wi):
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = wi
    if mi.is_spectral:
        si.wavelengths = mi.UnpolarizedSpectrum(550)
    return si


def inputs(count: int):
    rng = np.random.default_rng(7)
    wi, wo = directions(count, 1), directions(count, 2)
    return wi, wo, rng.random(count, dtype=np.float32), rng.random((count, 2), dtype=np.float32)


def evaluate_all(bsdf, ctx):
    """Every result of ``sample``, ``eval``, ``pdf`` and ``eval_pdf`` as arrays with the lane last."""

    def call(wi, wo, u1, u2):
        si = interaction(wi)
        bs, weight = bsdf.sample(ctx, si, u1, u2, True)
        f, pdf = bsdf.eval_pdf(ctx, si, wo, True)
        rest = (weight, f, pdf, bsdf.eval(ctx, si, wo, True), bsdf.pdf(ctx, si, wo, True))
        return (bs.wo, bs.pdf, bs.eta, bs.sampled_type, bs.sampled_component, *rest)

    wi, wo, u1, u2 = inputs(LANES)
    result = call(mi.Vector3f(wi.T), mi.Vector3f(wo.T), mi.Float(u1), mi.Point2f(u2.T))
    dr.eval(result)  # in one kernel
    arrays = [np.asarray(np.array(x), dtype=float) for x in result]
    return [np.broadcast_to(a, (*a.shape[:-1], LANES)) for a in arrays]  # constants come as one entry


def contexts():
    for mode, component in product((mi.TransportMode.Radiance, mi.TransportMode.Importance), (None, 0, 1)):
        ctx = mi.BSDFContext(mode)
        if component is not None:
            ctx.component = component
        yield ctx


def asked(materials):
    """All materials for paths from the sensor, the last one in other contexts, too."""
    materials = list(materials)
    return [*((one, mi.BSDFContext()) for one in materials), *((materials[-1], ctx) for ctx in [*contexts()][1::2])]


def compare(ours, theirs, ctx, power_alone=False):
    """``power_alone``: of Mueller matrices compare the first entry only."""
    for i in range(2):
        assert ours.flags(i) == theirs.flags(i)
    got, expected = evaluate_all(ours, ctx), evaluate_all(theirs, ctx)
    # Where the weight is zero (a facet seen from behind) direction, density and index have no meaning.
    weight = expected[5]
    lit = weight.reshape(-1, weight.shape[-1]).max(0) > 0
    # Mitsuba computes Mueller matrices of refraction from the refracted cosine, which loses up to a quarter at grazing
    # incidence (the matrix's first entry must be 1 / eta^2 here).
    steep = np.abs(inputs(weight.shape[-1])[0][:, 2]) > 0.05
    for k, (a, b) in enumerate(zip(got, expected, strict=True)):
        assert np.isfinite(a).all()
        if power_alone and a.ndim == 4:
            a, b = a[0, 0], b[0, 0]
        if k < 5:
            a, b = a[..., lit], b[..., lit]
        elif k == 5 and mi.is_polarized:
            a, b = a[..., steep], b[..., steep]
        error = np.abs(a - b) / (np.abs(b) + 2e-3)
        # Within a few parts in 1e7 of the critical angle, and at a lobe's boundary, rounding of the inputs decides.
        assert np.quantile(error, 0.998) < 2e-3, k
        assert error.max() < 0.6 or (error > 2e-3).sum() <= 2, k


VARIANTS = ["llvm_ad_mono", "llvm_ad_mono_polarized"]


@pytest.mark.parametrize("variant", long(VARIANTS, ["llvm_ad_mono_polarized"]))
def test_smooth_equals_mitsuba(variant):
    activate(variant)
    for material, ctx in asked(MATERIALS):
        compare(
            mi.load_dict({"type": "diff_dielectric", **material}), mi.load_dict({"type": "dielectric", **material}), ctx
        )


@pytest.mark.parametrize("variant", long(VARIANTS, ["llvm_ad_mono"]))
def test_rough_equals_mitsuba(variant):
    activate(variant)
    for (material, roughness), ctx in asked(zip(MATERIALS, ROUGHNESSES, strict=True)):
        both = {**material, **roughness}
        ours = mi.load_dict({"type": "diff_rough_dielectric", **both})
        # Mitsuba's depolarises
        compare(ours, mi.load_dict({"type": "roughdielectric", **both}), ctx, power_alone=mi.is_polarized)


# ------------------------------------------------------------------------------------------------ derivatives


def test_smooth_sample_is_attached():
    """Direction, index, probability and weight of both lobes against autograd in double precision."""
    activate("llvm_ad_mono")
    bsdf = mi.load_dict({"type": "diff_dielectric", "int_ior": 1.5, "ext_ior": 1.0})
    wi, _, u1, _u2 = inputs(LANES)
    steep = np.abs(wi[:, 2]) > 0.8  # no total internal reflection
    wi, u1 = wi[steep], u1[steep]
    u1[::2] *= 0.04  # many reflections
    params = mi.traverse(bsdf)
    dr.enable_grad(params["eta"])
    params.update()
    bs, weight = bsdf.sample(mi.BSDFContext(), interaction(mi.Vector3f(wi.T)), mi.Float(u1), mi.Point2f(0.5))
    reflected = bs.sampled_component.numpy() == 0
    assert 0.1 < reflected.mean() < 0.9

    w = torch.tensor(wi, dtype=torch.float64)
    eta = torch.full((len(wi),), 1.5, dtype=torch.float64, requires_grad=True)
    eta_it = torch.where(w[:, 2] > 0, eta, 1 / eta)
    F = fresnel_reflectance(w[:, 2], eta)
    mask = torch.tensor(reflected)
    mirror = w * torch.tensor([-1.0, -1.0, 1.0])
    wo = torch.where(mask[:, None], mirror, refracted_direction(w, eta))
    probability = torch.where(mask, F, 1 - F)
    # Mitsuba's convention: the probability is detached, and the weight is the attached value over it.
    value_over_probability = probability / probability.detach() * torch.where(mask, 1.0, eta_it**-2)
    expected = [*wo.T, torch.where(mask, 1.0, eta_it), value_over_probability]
    np.testing.assert_allclose(bs.pdf.numpy(), probability.detach().numpy(), rtol=2e-5, atol=2e-6)
    assert not dr.grad_enabled(bs.pdf)

    outputs = [*bs.wo, bs.eta, weight[0]]
    dr.set_grad(params["eta"], 1)
    dr.forward_to(outputs)
    for got, value in zip(outputs, expected, strict=True):
        np.testing.assert_allclose(dr.detach(got).numpy(), value.detach().numpy(), rtol=2e-5, atol=2e-6)
        (slope,) = torch.autograd.grad(value.sum(), eta, retain_graph=True, allow_unused=False)
        np.testing.assert_allclose(
            np.broadcast_to(dr.grad(got).numpy(), slope.shape), slope.numpy(), rtol=1e-3, atol=2e-5
        )


@together("n", [0.5, 0.9, 1.1, 1.5, 2.4])
def test_reflectance_at_all_angles(n):
    """Fresnel's, from both sides, by the probability of the reflected lobe, and its slopes by index and cosine; all
    light and no slope where reflection is total.
    """
    activate("llvm_ad_mono")
    bsdf = mi.load_dict({"type": "diff_dielectric", "int_ior": n, "ext_ior": 1.0})
    cosines = np.linspace(0.005, 1, 400, dtype=np.float32)
    cosines = np.concatenate([-cosines, cosines])
    n = np.float32(mi.traverse(bsdf)["eta"][0])
    inside = np.where(cosines > 0, n, 1 / n)
    beyond = cosines**2 + inside**2 - 1
    cosines, beyond = cosines[np.abs(beyond) > 1e-3], beyond[np.abs(beyond) > 1e-3]
    c = torch.tensor(cosines.astype(np.float64), requires_grad=True)
    eta = torch.full_like(c, float(n)).detach().requires_grad_()
    expected = fresnel_reflectance(c, eta)
    slopes = [slope.numpy() for slope in torch.autograd.grad(expected.sum(), (c, eta))]
    expected = expected.detach().numpy()
    assert (expected[beyond < 0] == 1).all() and (beyond < 0).any()
    unknowns = mi.Float(cosines), dr.full(mi.Float, n, len(cosines))
    dr.enable_grad(*unknowns)
    params = mi.traverse(bsdf)
    params["eta"] = unknowns[1]
    params.update()
    wi = mi.Vector3f(dr.sqrt(1 - dr.square(dr.detach(unknowns[0]))), 0, unknowns[0])
    bs, weight = bsdf.sample(mi.BSDFContext(), interaction(wi), mi.Float(0), mi.Point2f(0.5))
    np.testing.assert_allclose(bs.pdf.numpy(), expected, rtol=2e-5, atol=1e-7)
    dr.backward(weight[0])  # its value over the detached probability
    for x, slope in zip(unknowns, slopes, strict=True):
        found = dr.grad(x).numpy() * expected
        np.testing.assert_allclose(found, slope, rtol=1e-3, atol=1e-5 * np.abs(slope).max())
        assert (found[beyond < 0] == 0).all()


ATTACHED = [(True, (0.1, 0.5)), (False, (0.02, 0.02))]


@pytest.mark.parametrize(("ggx", "alphas"), long_rows(ATTACHED, ATTACHED[:1]))
def test_rough_eval_and_pdf_are_attached(ggx, alphas):
    """Derivatives in the index, both roughnesses and both directions against autograd in double precision."""
    activate("llvm_ad_mono")
    bsdf = mi.load_dict({
        "type": "diff_rough_dielectric", "int_ior": 1.5, "ext_ior": 1.0, "alpha_u": alphas[0], "alpha_v": alphas[1],
        "distribution": "ggx" if ggx else "beckmann",
    })  # fmt: skip
    wi, _, u1, u2 = inputs(LANES)
    keep = np.abs(wi[:, 2]) > 0.1
    wi, u1, u2 = wi[keep], u1[keep], u2[keep]
    u1[::2] *= 0.05
    # Directions that matter: where the plugin scatters to, for a somewhat wider lobe.
    wide = mi.load_dict({"type": "roughdielectric", "int_ior": 1.5, "ext_ior": 1.0, "alpha": 1.2 * max(alphas)})
    bs, weight = wide.sample(mi.BSDFContext(), interaction(mi.Vector3f(wi.T)), mi.Float(u1), mi.Point2f(u2.T))
    wo = bs.wo.numpy().T
    good = (weight[0].numpy() > 0) & (np.abs(wo[:, 2]) > 0.1)
    wi, wo = wi[good], wo[good]

    def f64(x):
        return torch.tensor(np.asarray(x, dtype=np.float64)).requires_grad_()

    n = len(wi)
    reference = [f64(wi), f64(wo), f64(np.full(n, 1.5))] + [f64(np.full(n, np.float32(a))) for a in alphas]
    expected = rough_dielectric(*reference, ggx)

    params = mi.traverse(bsdf)
    arguments = [mi.Vector3f(wi.T), mi.Vector3f(wo.T)]
    for key in ("eta", "alpha_u.value", "alpha_v.value"):
        params[key] = dr.full(mi.Float, params[key][0], n) if key == "eta" else params[key]
    params.update()
    checked = 0
    for k, value in enumerate(expected):
        slopes = torch.autograd.grad(value.sum(), reference, retain_graph=True)
        leaves = [*arguments, params["eta"], params["alpha_u.value"], params["alpha_v.value"]]
        for leaf, slope in zip(leaves, slopes, strict=True):
            dr.enable_grad(leaf)
            params.update()
            got = bsdf.eval_pdf(mi.BSDFContext(), interaction(arguments[0]), arguments[1])[k]
            dr.backward(dr.sum(got))
            a, b = dr.grad(leaf).numpy(), slope.numpy()
            dr.disable_grad(leaf)
            if a.ndim == 2:
                # Only turning a unit vector means something: compare along the sphere.
                d = leaf.numpy().T
                a, b = (g - d * (g * d).sum(1, keepdims=True) for g in (a.T, b))
            if a.shape[0] == 1:  # a uniform roughness collects the sum over all lanes
                assert a.sum() == pytest.approx(b.sum(), rel=1e-3)
            else:
                scale = np.abs(b) + 1e-3 * np.abs(b).max()
                assert np.quantile(np.abs(a - b) / scale, 0.99) < 2e-3
            checked += 1
    assert checked == 10


# ----------------------------------------------------------------------------------------------------- parameters


@pytest.mark.parametrize(
    ("plugin", "message"),
    [
        ({"type": "diff_dielectric", "int_ior": 0.0}, "above 0"),
        ({"type": "diff_dielectric", "int_ior": "unobtainium"}, "Valid choices are"),
        ({"type": "diff_rough_dielectric", "int_ior": 1.3, "ext_ior": 1.3}, "must differ"),
        ({"type": "diff_rough_dielectric", "distribution": "phong"}, "'beckmann' or 'ggx'"),
        ({"type": "diff_rough_dielectric", "alpha_u": 0.1}, "both 'alpha_u' and 'alpha_v'"),
    ],
)
def test_wrong_parameters(plugin, message):
    activate("llvm_ad_mono")
    with pytest.raises(RuntimeError, match=message):
        mi.load_dict(plugin)
