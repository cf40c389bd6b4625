"""Sensors at the limits of their numbers: empty bins, saturation, huge counts, faint tails.

Float32 unless the test says otherwise, since that is what is trained with.
"""

import math

import numpy as np
import pytest
import torch

from torchtransient import sensing

PS = 1e-12


def column(values, dtype=torch.float32):
    return torch.as_tensor(values, dtype=dtype).view(1, -1, 1, 1)


# --- counts and their surrogates ---------------------------------------------------------------------------------


def test_counts_beyond_the_whole_numbers_of_float32():
    mean = torch.full((1, 4, 32, 32), 1e9)
    n = sensing.poisson(mean, torch.Generator().manual_seed(0))
    assert n.dtype == torch.float32
    assert abs(float(n.double().mean()) / 1e9 - 1) < 5 / (1e9 * 4096) ** 0.5 + 6e-8
    spread = float(n.double().std()) / 1e9**0.5
    assert spread == pytest.approx(1.0, abs=0.06)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_hundred_million_cycles(dtype):
    """Never a draw per cycle: 1e8 cycles take no longer than 100, and keep totals and variance."""
    rate = torch.full((1, 8, 64, 64), 0.05, dtype=dtype)
    h = sensing.sample_detections(rate, 10**8, generator=torch.Generator().manual_seed(0)).double()
    p = 1 - math.exp(-0.4)
    totals = h.sum(1)
    assert abs(float(totals.mean()) - 1e8 * p) < 5 * (1e8 * p * (1 - p) / 4096) ** 0.5 + 1e8 * 1e-7
    assert float(totals.std()) / (1e8 * p * (1 - p)) ** 0.5 == pytest.approx(1, abs=0.06)


# --- pile-up -----------------------------------------------------------------------------------------------------


def test_sums_over_ten_thousand_bins_keep_their_digits():
    rate = torch.full((1, 10_000, 1, 1), 1e-4)
    exact = torch.arange(10_000, dtype=torch.float64) * float(rate[0, 0, 0, 0].double())
    p, none = sensing.first_photon_probabilities(rate)
    assert float(p.double().sum() + none.double().sum()) == pytest.approx(1, abs=1e-7)
    single = np.cumsum(rate.flatten().numpy(), dtype=np.float32)
    assert np.abs(single[:-1] - exact[1:].numpy()).max() > 1e-6  # what float32 sums lose


def test_saturated_pixel():
    rate = torch.cat([torch.full((1, 4, 1, 1), 0.1), torch.full((1, 4, 1, 1), 400.0), torch.full((1, 4, 1, 1), 1.0)], 1)
    rate.requires_grad_()
    spad = sensing.SynchronousSPAD(10_000)
    h = spad(rate)
    assert bool((h[:, 5:] == 0).all())  # nobody is armed behind the flash
    h.square().sum().backward()
    assert bool(torch.isfinite(rate.grad).all())
    assert not rate.grad[:, 5:].any()
    estimate = spad.inverse(h.detach().round())
    assert bool(torch.isfinite(estimate.rate).all())
    assert bool(estimate.valid[:, :4].all())
    assert not estimate.valid[:, 4:].any()
    torch.testing.assert_close(estimate.rate[:, :4], torch.full((1, 4, 1, 1), 0.1), rtol=2e-3, atol=0)


def test_coates_where_every_cycle_fired():
    counts = column([3.0, 7.0, 0.0, 0.0]).requires_grad_()
    estimate = sensing.coates(counts, 10)
    assert bool(torch.isfinite(estimate.rate).all())
    assert estimate.valid.flatten().tolist() == [True, False, False, False]
    assert float(estimate.rate[0, 1]) == pytest.approx(math.log(20))
    estimate.rate.sum().backward()
    assert bool(torch.isfinite(counts.grad).all())


# --- dead time ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("flux", [0.0, 1e-30, 1e-6, 50.0, 900.0])
@pytest.mark.parametrize("dead_bins", [0.5, 24.0, 70.2])
def test_free_running_from_dark_to_blinding(flux, dead_bins):
    """Nothing divides by zero in the dark, overflows in the light, or trips over dead times beyond a period."""
    shape = torch.exp(-0.5 * ((torch.arange(24.0) - 9) / 2) ** 2) + 0.05
    rate = (flux * shape / shape.sum()).view(1, -1, 1, 1).requires_grad_()
    for solve in (sensing.nonparalyzable_histogram, sensing.paralyzable_histogram):
        detected = solve(rate, dead_bins)
        assert bool(torch.isfinite(detected).all())
        assert float(detected.min()) >= 0
        assert float(detected.sum()) <= min(flux, 24 / dead_bins) * 1.0001 + 1e-12
        if 0 < flux <= 1e-6:
            torch.testing.assert_close(detected, rate, rtol=1e-3, atol=0)
        (gradient,) = torch.autograd.grad(detected.sum(), rate)
        assert bool(torch.isfinite(gradient).all())


def test_dead_time_beyond_the_period_is_taken_modulo():
    """Light that repeats: detection phases depend on the dead time modulo the period, the rate does not."""
    shape = torch.exp(-0.5 * ((torch.arange(32.0, dtype=torch.float64) - 9) / 2) ** 2) + 0.05
    rate = (2 * shape / shape.sum()).view(1, -1, 1, 1)
    short, long = (sensing.nonparalyzable_histogram(rate, d) for d in (11.3, 11.3 + 3 * 32))
    torch.testing.assert_close(short / short.sum(), long / long.sum(), rtol=1e-9, atol=1e-12)
    assert float(long.sum()) < 0.4 * float(short.sum())


# --- convolution -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fwhm_ps", [60, 720], ids=["direct", "transform"])
def test_late_tails_survive_a_dynamic_range_of_a_million(fwhm_ps):
    x = torch.zeros(1, 512, 1, 1)
    x[0, 40] = 1e6
    x[0, 400] = 1e-3
    layer = sensing.ImpulseResponse(sensing.GaussianResponse(fwhm_ps * PS), bin_width_s=16 * PS)
    y, exact = layer(x), layer(x.double())
    assert float(y.min()) >= -1e-9
    torch.testing.assert_close(y[0, 390:410].double(), exact[0, 390:410], rtol=1e-5, atol=1e-9)
    naive = torch.fft.irfft(torch.fft.rfft(x[0, :, 0, 0]) * torch.fft.rfft(torch.ones(3) / 3, n=512), n=512)
    assert float((naive[200:300]).abs().max()) > 1e-3  # what a float32 transform leaves there
