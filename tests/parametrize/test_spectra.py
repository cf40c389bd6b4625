"""Smooth spectra: splines against their definition, and what is smoothed."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchtransient import parametrize
from torchtransient.errors import ShapeError, UnitError
from torchtransient.parametrize import spline_basis

WAVELENGTHS = np.linspace(360.0, 830.0, 95)


def test_splines_are_scipys():
    interpolate = pytest.importorskip("scipy.interpolate")
    step = (830.0 - 360.0) / 5
    knots = 360.0 + step * np.arange(-3, 9)
    known = interpolate.BSpline(knots, np.eye(8), 3)(WAVELENGTHS)
    np.testing.assert_allclose(spline_basis(WAVELENGTHS, 8), known, atol=1e-12)


def test_straight_logarithms_are_kept():
    """Splines have all polynomials up to the third degree."""
    x = torch.tensor((WAVELENGTHS - 600) / 200)
    for values in (torch.full_like(x, 0.3), torch.exp(x), torch.exp(1 - x + 2 * x**2 - x**3)):
        spectrum = parametrize.PositiveSpectrum(WAVELENGTHS, 5, scale=2.0)
        assert torch.allclose(spectrum(spectrum.right_inverse(values)), values, rtol=1e-10)


def test_noise_is_smoothed():
    generator = torch.Generator().manual_seed(3)
    x = torch.tensor((WAVELENGTHS - 600) / 200)
    noisy = torch.exp(torch.sin(2 * x) + 0.2 * torch.randn(95, generator=generator, dtype=torch.float64))
    spectrum = parametrize.PositiveSpectrum(WAVELENGTHS, 6)
    found = spectrum(spectrum.right_inverse(noisy))
    # Six coefficients of 95 take sqrt(6/95) of the noise, 0.05; what the splines miss of the sine is less.
    assert (found.log() - torch.sin(2 * x)).pow(2).mean().sqrt().item() < 0.07
    rough = torch.diff(found.log(), n=2).abs().max()
    assert rough < 0.05 * torch.diff(noisy.log(), n=2).abs().max()


def test_reflectances_stay_below_one():
    spectrum = parametrize.ReflectanceSpectrum(WAVELENGTHS, 6)
    found = spectrum(torch.full((2, 6), 30.0))
    assert found.shape == (2, 95) and bool((found <= 1).all())
    with pytest.raises(UnitError, match="margin"):
        spectrum.right_inverse(torch.ones(95))


def test_what_it_refuses():
    with pytest.raises(UnitError, match="rising order"):
        spline_basis(WAVELENGTHS[::-1], 5)
    with pytest.raises(ShapeError, match="at most one coefficient"):
        spline_basis([400, 500, 600, 700], 5)
    with pytest.raises(ShapeError, match="at least 4"):
        spline_basis(WAVELENGTHS, 3)
    with pytest.raises(ShapeError, match="four wavelengths"):
        spline_basis("visible", 3)
    with pytest.raises(ShapeError, match=r"expected coefficients \(\.\.\., 6\)"):
        parametrize.PositiveSpectrum(WAVELENGTHS, 6)(torch.zeros(5))
    with pytest.raises(ShapeError, match="95 wavelengths"):
        parametrize.PositiveSpectrum(WAVELENGTHS, 6).right_inverse(torch.ones(94))
