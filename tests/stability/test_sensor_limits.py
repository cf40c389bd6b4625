"""Sensors and likelihoods at the limits of their numbers: empty bins, saturation, huge counts, faint tails.

Float32 unless the test says otherwise, since that is what is trained with.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from torchtransient import losses, sensing

PS = 1e-12


def column(values, dtype=torch.float32):
    return torch.as_tensor(values, dtype=dtype).view(1, -1, 1, 1)


# --- empty bins in likelihoods -----------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    "loss",
    [
        losses.poisson_nll,
        lambda r, n: losses.first_photon_nll(r, n, 100),
        lambda r, n: losses.free_running_nll(r, n, periods=100, dead_bins=2.5),
        lambda r, n: losses.read_noise_nll(r, n, 1.0),
    ],
    ids=["poisson", "first photon", "free running", "read noise"],
)
def test_likelihoods_with_counts_where_the_model_is_dark(loss, dtype):
    n = column([0.0, 3.0, 0.0, 0.0, 1.0, 0.0], dtype)
    r = column([0.0, 0.0, 0.2, 0.0, 0.3, 1e-30], dtype).requires_grad_()
    value = loss(r, n)
    value.backward()
    assert bool(torch.isfinite(value)) and bool(torch.isfinite(r.grad).all())
    # the tangent at 1e-9 of the counts, per cycle of 100: its square is a number of single precision, too
    assert float(r.grad.abs().max()) < 1.001e11 / n.numel() and bool(torch.isfinite(r.grad.float().square().sum()))
    dark = torch.zeros_like(r).requires_grad_()
    loss(dark, torch.zeros_like(n)).backward()
    assert bool(torch.isfinite(dark.grad).all())


# --- counts and their surrogates ---------------------------------------------------------------------------------


def test_gaussian_surrogate_at_zero():
    x = torch.zeros(1, 8, 2, 2, requires_grad=True)
    for module in (
        sensing.ShotNoise(grad="gaussian"),
        sensing.SynchronousSPAD(1000, grad="gaussian"),
        sensing.BinaryFrames(1000, grad="gaussian"),
    ):
        y = module(x, generator=torch.Generator().manual_seed(0))
        assert float(y.abs().max()) == 0.0
        (gradient,) = torch.autograd.grad(y.sum(), x)
        assert bool(torch.isfinite(gradient).all())


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


@pytest.mark.parametrize("flux", [0.0, 1e-30, 1e-12, 1e-6, 1.0, 50.0, 900.0])
@pytest.mark.parametrize("dead_bins", [0.5, 7.3, 24.0, 24.5, 70.2])
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


def test_no_echo_before_time_zero():
    x = torch.zeros(1, 64, 1, 1)
    x[0, 60] = 1e6
    response = sensing.emg_response(40 * PS, 400 * PS)
    for method in ("direct", "fft"):
        open_window = sensing.ImpulseResponse(response, bin_width_s=20 * PS, method=method)(x)
        assert float(open_window[0, :50].abs().max()) < 1e-9
        periodic = sensing.ImpulseResponse(response, bin_width_s=20 * PS, method=method, boundary="periodic")(x)
        assert float(periodic[0, :10].sum()) > 1e5
        assert float(periodic.sum()) == pytest.approx(1e6, rel=1e-6)
        assert float(open_window.sum()) < 0.6e6


@pytest.mark.parametrize("method", ["direct", "fft"])
def test_late_tails_survive_a_dynamic_range_of_a_million(method):
    x = torch.zeros(1, 512, 1, 1)
    x[0, 40] = 1e6
    x[0, 400] = 1e-3
    layer = sensing.ImpulseResponse(sensing.GaussianResponse(60 * PS), bin_width_s=16 * PS, method=method)
    y, exact = layer(x), layer(x.double())
    assert float(y.min()) >= -1e-9
    torch.testing.assert_close(y[0, 390:410].double(), exact[0, 390:410], rtol=1e-5, atol=1e-9)
    naive = torch.fft.irfft(torch.fft.rfft(x[0, :, 0, 0]) * torch.fft.rfft(torch.ones(3) / 3, n=512), n=512)
    assert float((naive[200:300]).abs().max()) > 1e-3  # what a float32 transform leaves there


def test_responses_are_normalised_however_narrow_or_wide():
    for response in (
        sensing.GaussianResponse(0.001 * PS),
        sensing.GaussianResponse(5e4 * PS),
        sensing.emg_response(30 * PS, 0.02 * PS),
        sensing.emg_response(0.02 * PS, 400 * PS),
        sensing.TailedResponse(30 * PS, [1 * PS, 5000 * PS], [0.5, 0.4]),
    ):
        first, kernel = response.kernel(16 * PS)
        assert float(kernel.sum()) == pytest.approx(1, abs=1e-12)
        assert float(kernel.min()) >= 0
        assert first <= 0
