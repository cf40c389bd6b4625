"""Fresnel's equations in single precision against the textbook in double precision."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

from support.dielectric_reference import fresnel_reflectance
from support.sweeps import together
from torchtransient.plugins.bsdfs.fresnel import fresnel

VARIANT = "llvm_ad_mono"
INDICES = [0.5, 0.9, 1.1, 1.5, 2.4]


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


@together("eta", INDICES)
def test_values(eta):
    cosines, eta = grid(eta, 1e-3)
    expected, _, _ = reference(cosines, eta)
    terms = fresnel(mi.Float(cosines), mi.Float(eta))
    np.testing.assert_allclose(terms.reflectance.numpy(), expected, rtol=2e-5, atol=1e-7)
    np.testing.assert_allclose(terms.transmittance.numpy(), 1 - expected, rtol=1e-4, atol=1e-9)


@together("eta", INDICES)
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


@together("n", [1.33, 1.5, 2.4])
def test_brewster_angle(n):
    # R_p = 0 and R_s = ((n^2 - 1) / (n^2 + 1))^2 at tan(theta) = n.
    c = np.cos(np.arctan(n))
    expected = 0.5 * ((n * n - 1) / (n * n + 1)) ** 2
    r = fresnel(mi.Float(c), mi.Float(n)).reflectance[0]
    assert r == pytest.approx(expected, rel=1e-5)


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


