"""Limits in which the textbook form of Fresnel's equations loses its digits or its derivatives."""

from __future__ import annotations

from decimal import Decimal, getcontext

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from torchtransient.plugins.bsdfs.fresnel import fresnel

VARIANT = "llvm_ad_mono"
getcontext().prec = 60


def reflectance(cosine: float, eta: Decimal) -> Decimal:
    """Fresnel's equations with 60 digits."""
    c = abs(Decimal(cosine))
    m = eta if cosine >= 0 else 1 / eta
    cos_t = (1 - (1 - c * c) / (m * m)).sqrt()
    r_s = (c - m * cos_t) / (c + m * cos_t)
    r_p = (m * c - cos_t) / (m * c + cos_t)
    return (r_s * r_s + r_p * r_p) / 2


def slope(cosine: float, eta: float) -> float:
    h = Decimal("1e-20")
    return float((reflectance(cosine, Decimal(eta) + h) - reflectance(cosine, Decimal(eta) - h)) / (2 * h))


@pytest.mark.parametrize("offset", [1e-6, -1e-6, 1e-4, 1e-2])
def test_index_near_one(offset):
    """Guards against cancellation as the index approaches one.

    At n = 1 + 1e-6 the amplitudes are differences of numbers that agree to six digits: the textbook form in single
    precision is wrong by several per cent, and its derivative too.
    """
    eta = np.float32(1 + offset)
    # Below this cosine the interface reflects totally from one of its sides.
    cosines = [c * sign for c in (1.0, 0.9, 0.7, 0.5, 0.3) for sign in (1, -1)]
    c = mi.Float(cosines)
    n = dr.full(mi.Float, eta, len(cosines))
    dr.enable_grad(n)
    terms = fresnel(c, n)
    dr.backward(terms.reflectance)
    used = [float(x) for x in c.numpy()]
    expected = [float(reflectance(x, Decimal(float(eta)))) for x in used]
    np.testing.assert_allclose(terms.reflectance.numpy(), expected, rtol=1e-5)
    np.testing.assert_allclose(dr.grad(n).numpy(), [slope(x, float(eta)) for x in used], rtol=1e-5)


def test_index_of_exactly_one():
    """Guards against 0 / 0: an interface between equal media is invisible in every direction, with zero slope."""
    c = mi.Float(np.concatenate([np.linspace(-1, 1, 101), [1e-3, 1e-10, 1e-30, -1e-10, 0]]))
    n = dr.full(mi.Float, 1, dr.width(c))
    dr.enable_grad(c, n)
    terms = fresnel(c, n)
    assert dr.all(terms.reflectance == 0)
    np.testing.assert_allclose(terms.transmittance.numpy(), 1, atol=1e-6)
    np.testing.assert_allclose(terms.cos_theta_t.numpy(), -c.numpy(), atol=1e-6)
    dr.backward(terms.reflectance)
    assert np.all(dr.grad(n).numpy() == 0)
    assert np.all(dr.grad(c).numpy() == 0)


@pytest.mark.parametrize("eta", [1.5, 1 / 1.5, 1.0003])
def test_critical_angle(eta):
    """Guards against sqrt'(0): at the critical angle the slope of the reflectance diverges, and one infinite derivative
    among a million paths makes the whole gradient infinite or NaN."""
    critical = np.float32(np.sqrt(1 - min(eta, 1 / eta) ** 2))
    steps = np.concatenate([np.arange(-64, 65) * np.spacing(critical), np.linspace(-1e-4, 1e-4, 101)])
    c = mi.Float((critical + steps) * (-1 if eta > 1 else 1))
    n = dr.full(mi.Float, eta, dr.width(c))
    for term in range(3):
        dr.enable_grad(c, n)
        terms = fresnel(c, n)
        dr.backward(terms[term])
        assert np.isfinite(terms[term].numpy()).all()
        assert np.isfinite(dr.grad(c).numpy()).all()
        assert np.isfinite(dr.grad(n).numpy()).all()
        dr.disable_grad(c, n)
    # Just outside the clamp the derivative is the true one: it must not have been flattened where it is finite.
    c = mi.Float(float(critical + 1e-3) * (-1 if eta > 1 else 1))
    n = mi.Float(eta)
    dr.enable_grad(n)
    dr.backward(fresnel(c, n).reflectance)
    assert dr.grad(n)[0] == pytest.approx(slope(float(c.numpy()[0]), float(n.numpy()[0])), rel=2e-3)


@pytest.mark.parametrize("eta", [0.5, 1 / 1.0003, 1.0003, 1.5, 2.4])
def test_grazing_incidence(eta):
    """Guards against losing what is transmitted at grazing incidence: 1 - R is zero in single precision long before the
    transmitted power is, and its relative derivative, which the integrator multiplies with, becomes 0 / 0."""
    cosines = np.float32([1e-3, 1e-5, 1e-8, 1e-12, 1e-20])
    for sign in (1, -1):
        c = mi.Float(sign * cosines)
        n = dr.full(mi.Float, eta, len(cosines))
        dr.enable_grad(c, n)
        terms = fresnel(c, n)
        expected = []
        for x in c.numpy():
            m = Decimal(float(np.float32(eta)))
            total = (m if sign > 0 else 1 / m) ** 2 - 1 + Decimal(float(x)) ** 2 <= 0
            expected.append(0.0 if total else float(1 - reflectance(float(x), m)))
        np.testing.assert_allclose(terms.transmittance.numpy(), expected, rtol=1e-4)
        dr.backward(terms.transmittance)
        assert np.isfinite(dr.grad(c).numpy()).all()
        assert np.isfinite(dr.grad(n).numpy()).all()
