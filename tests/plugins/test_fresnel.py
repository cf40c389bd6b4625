"""Fresnel's equations in single precision against the textbook in double precision."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

from support.dielectric_reference import fresnel_reflectance, refracted_direction
from torchtransient.plugins.bsdfs.fresnel import fresnel, refract

VARIANT = "llvm_ad_mono"
INDICES = [0.5, 1 / 1.5, 0.9, 1.1, 1.33, 1.5, 2.4]


def grid(eta: float, margin: float) -> tuple[np.ndarray, np.float32]:
    """Cosines of both signs, at least ``margin`` away from the critical angle in the squared cosine."""
    cosines = np.linspace(0.005, 1, 400, dtype=np.float32)
    cosines = np.concatenate([-cosines, cosines])
    eta = np.float32(eta)
    m = np.where(cosines > 0, eta, 1 / eta)
    return cosines[np.abs(cosines**2 + m * m - 1) > margin], eta


def reference(cosines: np.ndarray, eta: np.float32) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    c = torch.tensor(cosines.astype(np.float64), requires_grad=True)
    n = torch.full_like(c, float(eta)).detach().requires_grad_()
    r = fresnel_reflectance(c, n)
    d_c, d_n = torch.autograd.grad(r.sum(), (c, n))
    return r.detach().numpy(), d_c.numpy(), d_n.numpy()


@pytest.mark.parametrize("eta", INDICES)
def test_values(eta):
    cosines, eta = grid(eta, 1e-3)
    expected, _, _ = reference(cosines, eta)
    terms = fresnel(mi.Float(cosines), mi.Float(eta))
    np.testing.assert_allclose(terms.reflectance.numpy(), expected, rtol=2e-5, atol=1e-7)
    np.testing.assert_allclose(terms.transmittance.numpy(), 1 - expected, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("eta", INDICES)
def test_agrees_with_mitsuba(eta):
    cosines, eta = grid(eta, 1e-3)
    c, n = mi.Float(cosines), mi.Float(eta)
    ours, theirs = fresnel(c, n), mi.fresnel(c, n)
    got = [ours.reflectance, ours.cos_theta_t, ours.eta_it, ours.eta_ti]
    for a, b in zip(got, theirs, strict=True):
        np.testing.assert_allclose(a.numpy(), b.numpy(), rtol=1e-4, atol=2e-5)


@pytest.mark.parametrize("eta", INDICES)
def test_derivatives(eta):
    cosines, eta = grid(eta, 1e-3)
    _, d_c, d_n = reference(cosines, eta)
    for which, expected in ((0, d_c), (1, d_n)):
        arguments = [mi.Float(cosines), dr.full(mi.Float, eta, len(cosines))]
        dr.enable_grad(arguments[which])
        terms = fresnel(*arguments)
        dr.backward(terms.reflectance)
        scale = np.abs(expected).max()
        np.testing.assert_allclose(dr.grad(arguments[which]).numpy(), expected, rtol=1e-3, atol=1e-5 * scale)
        dr.set_grad(arguments[which], 0)
        dr.backward(fresnel(*arguments).transmittance)
        np.testing.assert_allclose(dr.grad(arguments[which]).numpy(), -expected, rtol=1e-3, atol=1e-5 * scale)


@pytest.mark.parametrize("n", [1.33, 1.5, 2.4])
def test_brewster_angle(n):
    # R_p = 0 and R_s = ((n^2 - 1) / (n^2 + 1))^2 at tan(theta) = n.
    c = np.cos(np.arctan(n))
    expected = 0.5 * ((n * n - 1) / (n * n + 1)) ** 2
    r = fresnel(mi.Float(c), mi.Float(n)).reflectance[0]
    assert r == pytest.approx(expected, rel=1e-5)
    if n == 1.5:
        assert r == pytest.approx(0.14793 / 2, rel=1e-4)


@pytest.mark.parametrize("n", [1.33, 1.5, 2.4])
def test_normal_incidence(n):
    for c in (1, -1):
        assert fresnel(mi.Float(c), mi.Float(n)).reflectance[0] == pytest.approx(((n - 1) / (n + 1)) ** 2, rel=1e-5)


def test_total_internal_reflection():
    c, n = mi.Float(np.linspace(-np.sqrt(1 - 1 / 1.5**2) + 1e-4, -1e-6, 100)), mi.Float(1.5)
    dr.enable_grad(c, n)
    terms = fresnel(c, n)
    assert dr.all(terms.reflectance == 1)
    assert dr.all(terms.transmittance == 0)
    assert dr.all(terms.cos_theta_t == 0)
    dr.backward(terms.reflectance + terms.transmittance + terms.cos_theta_t)
    assert dr.all(dr.grad(c) == 0)
    assert dr.all(dr.grad(n) == 0)


@pytest.mark.parametrize("n", [1.1, 1.5, 2.4])
def test_same_reflectance_from_both_sides(n):
    sin_out = np.linspace(0, 0.99, 50)
    cos_out, cos_in = np.sqrt(1 - sin_out**2), np.sqrt(1 - (sin_out / n) ** 2)
    outside = fresnel(mi.Float(cos_out), mi.Float(n))
    inside = fresnel(mi.Float(-cos_in), mi.Float(n))
    np.testing.assert_allclose(outside.reflectance.numpy(), inside.reflectance.numpy(), rtol=2e-4)
    np.testing.assert_allclose(outside.cos_theta_t.numpy(), -cos_in, rtol=1e-5)
    np.testing.assert_allclose(inside.cos_theta_t.numpy(), cos_out, rtol=2e-4)


@pytest.mark.parametrize("n", [1.1, 1.5])
def test_refracted_direction_and_its_derivative(n):
    rng = np.random.default_rng(1)
    wi = rng.normal(size=(200, 3))
    wi[:100, 2] = np.abs(wi[:100, 2])
    wi[100:, 2] = -2 * n - np.abs(wi[100:, 2])  # steep enough to leave the glass
    wi = (wi / np.linalg.norm(wi, axis=1, keepdims=True)).astype(np.float32)

    eta_t = torch.full((200,), float(np.float32(n)), dtype=torch.float64, requires_grad=True)
    expected = refracted_direction(torch.tensor(wi, dtype=torch.float64), eta_t)
    eta = mi.Float(n)
    dr.enable_grad(eta)
    v = mi.Vector3f(wi.T)
    terms = fresnel(v.z, eta)
    got = refract(v, mi.Vector3f(0, 0, 1), terms.cos_theta_t, terms.eta_ti)
    np.testing.assert_allclose(got.numpy().T, expected.detach().numpy(), atol=3e-6)
    dr.set_grad(eta, 1)
    derivative = dr.forward_to(got).numpy().T
    for axis in range(3):
        (d,) = torch.autograd.grad(expected[:, axis].sum(), eta_t, retain_graph=True)
        np.testing.assert_allclose(derivative[:, axis], d.numpy(), rtol=2e-4, atol=1e-5)
