"""Rough interfaces that are almost smooth."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

from support.dielectric_reference import rough_dielectric

VARIANT = "llvm_ad_mono"
ALPHA_MIN = 1e-3  # below it roughness is clamped


def plugin(alpha, **more):
    with_log = {"type": "diff_rough_dielectric", "int_ior": 1.5, "ext_ior": 1.0, "alpha": alpha, **more}
    logger, level = mi.logger(), mi.logger().log_level()
    logger.set_log_level(mi.LogLevel.Error)  # the clamp's warning has its own test
    try:
        return mi.load_dict(with_log)
    finally:
        logger.set_log_level(level)


def interaction(wi):
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = wi
    return si


def hard_directions(count: int) -> np.ndarray:
    """All over the sphere, along the normal, at the critical angle, and down to 1e-12 from the surface."""
    rng = np.random.default_rng(5)
    z = np.concatenate([rng.uniform(-1, 1, count), [1, -1], -np.sqrt(1 - 1 / 2.25) * np.linspace(0.999, 1.001, 51)])
    z = np.concatenate([z, *[s * 10.0 ** np.arange(-12, 0) for s in (1, -1)]])
    phi = rng.uniform(0, 2 * np.pi, len(z))
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], 1).astype(np.float32)


@pytest.mark.parametrize(("distribution", "alpha"), [("ggx", 0.0), ("beckmann", 1e-3), ("beckmann", 1.0)])
def test_values_and_derivatives_are_finite(distribution, alpha):
    """Guards against overflow: the density grows as 1 / alpha^2 and its derivative as 1 / alpha^3, exponentials
    underflow next to infinite arguments, masking divides by cosines that vanish. One such lane turns a whole
    gradient into NaN."""
    wi = hard_directions(3000)
    n = len(wi)
    rng = np.random.default_rng(6)
    u1, u2 = mi.Float(rng.random(n)), mi.Point2f(rng.random((2, n)))
    scattered, _ = plugin(alpha, distribution=distribution).sample(
        mi.BSDFContext(), interaction(mi.Vector3f(wi.T)), u1, u2
    )
    anywhere = hard_directions(3000)[rng.permutation(n)]
    bsdf = plugin(alpha, distribution=distribution)
    params = mi.traverse(bsdf)
    # Scattered, anywhere, straight on and back.
    wo = np.concatenate([scattered.wo.numpy(), anywhere.T, -wi.T, wi.T], axis=1)
    v, w = mi.Vector3f(np.tile(wi.T, 4)), mi.Vector3f(wo)
    dr.enable_grad(v, w, params["eta"], params["alpha.value"])
    params.update()
    f, pdf = bsdf.eval_pdf(mi.BSDFContext(), interaction(v), w)
    bs, weight = bsdf.sample(mi.BSDFContext(), interaction(v), dr.tile(u1, 4), dr.tile(u2, 4))
    outputs = (f[0], pdf, bs.pdf, bs.eta, weight[0])
    dr.backward(sum(outputs))
    leaves = [dr.grad(leaf) for leaf in (v, w, params["eta"], params["alpha.value"])]
    for found in (*dr.detach(outputs), *leaves):
        assert np.isfinite(found.numpy()).all()


@pytest.mark.parametrize("distribution", ["ggx", "beckmann"])
def test_smallest_roughness_is_still_accurate(distribution):
    """Guards against a lobe that is finite but wrong: at alpha = 1e-3 the half vector must keep enough digits for the
    density of the sampled directions to be that of double precision."""
    bsdf = plugin(ALPHA_MIN, distribution=distribution)
    rng = np.random.default_rng(8)
    wi = rng.normal(size=(4000, 3))
    wi[:, 2] += 2 * np.sign(wi[:, 2])
    wi = (wi / np.linalg.norm(wi, axis=1, keepdims=True)).astype(np.float32)
    n = len(wi)
    si = interaction(mi.Vector3f(wi.T))
    bs, weight = bsdf.sample(mi.BSDFContext(), si, mi.Float(rng.random(n)), mi.Point2f(rng.random((2, n))))
    wo = bs.wo.numpy().T

    def f64(x):
        return torch.tensor(np.asarray(x, dtype=np.float64))

    alpha = f64(np.full(n, np.float32(ALPHA_MIN)))
    # Directions of unit length in double precision, as the equations assume.
    a, b = (f64(x) / f64(x).norm(dim=1, keepdim=True) for x in (wi, wo))
    _, expected = rough_dielectric(a, b, f64(np.full(n, 1.5)), alpha, alpha, distribution == "ggx")
    lit = weight[0].numpy() > 0
    assert lit.mean() > 0.99
    error = np.abs(bs.pdf.numpy() / expected.numpy() - 1)[lit]
    assert np.quantile(error, 0.95) < 0.02
    _, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, bs.wo)
    assert np.quantile(np.abs(pdf.numpy() / expected.numpy() - 1)[lit], 0.95) < 0.02


def test_roughness_below_the_clamp_is_said():
    """Guards against silence: a roughness below the clamp renders as the clamp and has no derivative."""
    logger = mi.logger()
    level = logger.error_level()
    logger.set_error_level(mi.LogLevel.Warn)
    try:
        with pytest.raises(RuntimeError, match=r"'alpha_v' is clamped to 0\.001"):
            mi.load_dict({"type": "diff_rough_dielectric", "alpha_u": 0.1, "alpha_v": 5e-4})
        mi.load_dict({"type": "diff_rough_dielectric", "alpha": 2e-3})
    finally:
        logger.set_error_level(level)


@pytest.mark.slow
def test_index_passing_through_one():
    """Guards against 0 / 0 when an optimiser moves an index through exactly one, where the refracted lobe is a
    delta function."""
    bsdf = plugin(0.1)
    wi = hard_directions(1000)
    n = len(wi)
    rng = np.random.default_rng(9)
    u1, u2 = mi.Float(rng.random(n)), mi.Point2f(rng.random((2, n)))
    params = mi.traverse(bsdf)
    for eta in (1 - 1e-6, 1.0, 1 + 1e-6):
        params["eta"] = dr.opaque(mi.Float, eta)
        dr.enable_grad(params["eta"])
        params.update()
        v = mi.Vector3f(wi.T)
        dr.enable_grad(v)
        bs, weight = bsdf.sample(mi.BSDFContext(), interaction(v), u1, u2)
        f, pdf = bsdf.eval_pdf(mi.BSDFContext(), interaction(v), -v)
        outputs = (bs.pdf, weight[0], f[0], pdf)
        dr.backward(sum(outputs))
        for found in (*dr.detach(outputs), dr.grad(params["eta"]), dr.grad(v)):
            assert np.isfinite(found.numpy()).all()
