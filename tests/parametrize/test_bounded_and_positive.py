"""Bounds, margins, and what stands at the ends; smooth spectra: splines against their definition."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from support.sweeps import together
from torchtransient import parametrize
from torchtransient.errors import ShapeError, UnitError
from torchtransient.parametrize import (
    bounded,
    bounded_inverse,
    positive,
    positive_inverse,
    simplex_inverse,
    spline_basis,
)


@together("dtype", [torch.float32, torch.float64, torch.float16, torch.bfloat16])
@together("low, high", [(0.0, 1.0), (0.1, 0.3), (-0.99, 0.99), (-7.0, -3.0)])
def test_never_beyond_its_bounds(dtype, low, high):
    x = torch.cat([torch.linspace(-60, 60, 2401), torch.tensor([-1e4, 1e4, -math.inf, math.inf])]).to(dtype)
    value = bounded(x, low, high)
    ends = torch.tensor([low, high], dtype=torch.float64).to(dtype)
    assert bool((value >= ends[0]).all()) and bool((value <= ends[1]).all())
    ordered = value[:2401]
    assert bool((ordered[1:] >= ordered[:-1] - torch.finfo(dtype).eps * max(abs(low), abs(high))).all())


def test_it_is_the_logistic_function():
    """Of 1e-6 from either end the distance survives, to what single precision has near one; of a bound at zero all
    digits.
    """
    x = torch.linspace(-5, 5, 21, dtype=torch.float64)
    assert torch.allclose(bounded(x, 2.0, 5.0), 2 + 3 / (1 + torch.exp(-x)), rtol=1e-14)
    value = torch.tensor([1e-30, 1e-6, 1 - 2.0**-20])
    back = bounded(bounded_inverse(value))
    assert torch.allclose(back, value, rtol=1e-6)
    assert (1 - back[2]).item() == pytest.approx(2.0**-20, rel=0.1)
    for sign in (1, -1):
        found = bounded(torch.tensor(-23.0 * sign), *sorted((0.0, 3.0 * sign)))
        assert found.item() == pytest.approx(sign * 3 / (1 + math.exp(23)), rel=1e-6)


def test_the_ends_need_a_margin():
    for value in (0.0, 1.0, -1e-7, 1 + 1e-6):
        both = torch.tensor([0.5, value])
        with pytest.raises(UnitError, match="margin=1e-3"):
            bounded_inverse(both)
        moved = bounded(bounded_inverse(both, margin=0.01))
        assert moved.tolist() == pytest.approx([0.5, 0.01 if value < 0.5 else 0.99], rel=1e-5)
    for value in (-0.01, 1.01, math.nan, math.inf):
        for margin in (None, 0.1):
            with pytest.raises(UnitError, match=r"Albedo: expected values between 0 and 1"):
                parametrize.Albedo(margin=margin).right_inverse(torch.tensor([0.5, value]))


@together("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
@together("low, high", [(0.0, 1.0), (-0.99, 0.99), (-7.0, -3.0), (1e-4, 1.0), (0.0, 500.0)])
@together("margin", [1e-30, 1e-4, 0.1])
def test_a_margin_below_the_rounding(dtype, margin, low, high):
    """No nearer than the dtype tells from the bound, and at most as far as two of its steps, or the margin."""
    ends = torch.tensor([low, high], dtype=torch.float64).to(dtype)
    x = bounded_inverse(ends, low, high, margin=margin)
    assert bool(torch.isfinite(x).all())
    moved = (bounded(x, low, high) - ends).double().abs()
    step = 2 * torch.finfo(dtype).eps * ends.double().abs() + torch.finfo(dtype).tiny
    slack = 1 + 16 * torch.finfo(dtype).eps  # the number behind is up to 16, and rounded
    assert bool((moved <= slack * step.clamp_min(margin * (high - low)) + step).all())
    assert bool(torch.isfinite(simplex_inverse(torch.tensor([0.0, 1.0], dtype=dtype), margin=margin)).all())


@together("low, high", [(1.0, 1.0), (2.0, 1.0), (0.0, math.inf), (math.nan, 1.0), ("0", 1.0)])
def test_bounds_that_are_none(low, high):
    tensors = () if isinstance(low, str) else ((torch.tensor([low]), torch.tensor([high])),)
    for ends in ((low, high), *tensors):
        for call in (parametrize.Bounded, lambda *ends: bounded(torch.zeros(2), *ends)):
            with pytest.raises(UnitError, match="bounds"):
                call(*ends)


def test_positive_at_its_limits():
    assert positive(torch.tensor([-1e4, -20.0]))[0] >= 0
    # Above the bound as far as the docstring says, and on it below.
    assert positive(torch.tensor(-103.0)) > 0 and positive(torch.tensor(-15.0), low=1.0) > 1
    assert positive(torch.tensor(-110.0)) == 0 and positive(torch.tensor(-20.0), low=1.0) == 1
    found = positive(torch.tensor([88.0, 89.0]), function="exp")
    assert found[0] < math.inf and found[1] == math.inf
    value = torch.tensor([1e-30, 1e-3, 1.0, 1e4, 1e30])
    for function in ("softplus", "exp"):
        back = positive(positive_inverse(value, function=function), function=function)
        # The logarithm of 1e30 is 69: what its last digit is worth, the value has 69-fold.
        assert torch.allclose(back, value, rtol=69 * 2**-23), function
    for wrong in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(UnitError, match="Positive: expected finite values above 0"):
            parametrize.Positive().right_inverse(torch.tensor([1.0, wrong]))
    for settings in ({"scale": 0.0}, {"low": math.inf}, {"function": "square"}):
        with pytest.raises(UnitError, match="expected"):
            parametrize.Positive(**settings)


def test_simplex():
    with pytest.raises(UnitError, match="sum 1"):
        simplex_inverse(torch.tensor([0.5, 0.6]))
    with pytest.raises(UnitError, match="margin=1e-3"):
        simplex_inverse(torch.tensor([0.0, 1.0]))
    weights = parametrize.Simplex(0, margin=0.01)
    found = weights(weights.right_inverse(torch.tensor([[0.0, 0.5], [1.0, 0.5]])))
    assert torch.allclose(found.sum(0), torch.ones(2)) and found[0, 0].item() == pytest.approx(0.005, rel=0.01)
    # The numbers behind are the logarithms of the weights, zero on average.
    x = simplex_inverse(torch.tensor([[0.125, 0.625, 0.25]], dtype=torch.float64))
    assert x.mean().item() == pytest.approx(0, abs=1e-15) and (x[0, 1] - x[0, 0]).item() == pytest.approx(math.log(5))
    with pytest.raises(ShapeError, match="along dimension 2"):
        parametrize.simplex(torch.zeros(3), 2)


# -------------------------------------------------------------------------------------------------------------- spectra


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


def test_what_spectra_refuse():
    with pytest.raises(UnitError, match="rising order"):
        spline_basis(WAVELENGTHS[::-1], 5)
    with pytest.raises(ShapeError, match="at most 4"):
        spline_basis([400, 500, 600, 700], 5)
    with pytest.raises(ShapeError, match="at least 4"):
        spline_basis(WAVELENGTHS, 3)
    with pytest.raises(UnitError, match="real numbers"):
        spline_basis("visible", 3)
    with pytest.raises(ShapeError, match=r"expected coefficients \(\.\.\., 6\)"):
        parametrize.PositiveSpectrum(WAVELENGTHS, 6)(torch.zeros(5))
    with pytest.raises(ShapeError, match="95 wavelengths"):
        parametrize.PositiveSpectrum(WAVELENGTHS, 6).right_inverse(torch.ones(94))
