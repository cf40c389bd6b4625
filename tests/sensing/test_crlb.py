"""The Cramer-Rao bound: Hessians of the likelihoods, limits, any response and chain, and estimators that reach it."""

from __future__ import annotations

import math

import pytest
import torch

import torchtransient as tt
from torchtransient import sensing
from torchtransient.losses import first_photon_nll, poisson_nll
from torchtransient.sensing import covariance_bound, crlb, return_rates
from torchtransient.units import SPEED_OF_LIGHT

PS = 1e-12
AXIS = tt.TimeAxis.from_seconds(1e-9, 100 * PS, 64)
NORMAL = sensing.GaussianResponse(400 * PS)
MEASURED = torch.tensor([0.0, 1, 6, 20, 33, 24, 12, 7, 4, 2, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0])
RESPONSES = {
    "normal": NORMAL,
    "tail": sensing.emg_response(250 * PS, 300 * PS, delay_s=-200 * PS),
    "two tails": sensing.TailedResponse(250 * PS, [200 * PS, 700 * PS], [0.2, 0.1]),
    "even": sensing.UniformResponse(630 * PS),
    "measured": sensing.MeasuredResponse(MEASURED, 90 * PS),
    "composed": sensing.ComposedResponse([NORMAL, sensing.UniformResponse(300 * PS)]),
}
by_response = pytest.mark.parametrize("response", RESPONSES.values(), ids=RESPONSES.keys())


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def place(position):
    """Metres of positions in bins."""
    return 0.5 * (AXIS.start_opl + torch.as_tensor(position, dtype=torch.float64) * AXIS.bin_width_opl)


def named(unknowns):
    """Distance, signal and background as arguments."""
    return dict(zip(("distance_m", "signal", "background"), unknowns, strict=True))


def as_histogram(x):
    """(..., T) of pixels (...) as (1, T, 1, N)."""
    return x.reshape(-1, x.shape[-1]).T.reshape(1, x.shape[-1], 1, -1)


@pytest.mark.parametrize(("name", "cycles"), [(name, (None, 500)[n % 2]) for n, name in enumerate(RESPONSES)])
def test_is_the_hessian_of_the_likelihood_at_the_mean(name, cycles):
    """Of `poisson_nll` and `first_photon_nll`, both linear in the counts: their expectation is that at the mean."""
    response, truth = RESPONSES[name], torch.tensor([float(place(20.3)), 1.7, 2e-3], dtype=torch.float64)
    if cycles is None:
        truth = truth * torch.tensor([1.0, 100.0, 100.0])
    rates = return_rates(response, AXIS, **named(truth))
    counts = as_histogram(rates)
    if cycles is not None:
        counts = sensing.SynchronousSPAD(cycles).expected(counts)

    def loss(p):
        model = as_histogram(return_rates(response, AXIS, **named(p)))
        if cycles is None:
            return poisson_nll(model, counts, reduction="sum")
        return first_photon_nll(model, counts, cycles, reduction="sum")

    wanted = torch.linalg.inv(torch.func.hessian(loss)(truth))
    found = crlb(response, AXIS, **named(truth), cycles=cycles)
    torch.testing.assert_close(found.covariance, wanted, rtol=1e-6, atol=0)
    torch.testing.assert_close(found.distance_m, wanted[0, 0].sqrt(), rtol=1e-6, atol=0)
    torch.testing.assert_close(found.delay_s, wanted[0, 0].sqrt() * 2 / SPEED_OF_LIGHT, rtol=1e-6, atol=0)
    others = torch.stack([found.signal, found.background])
    torch.testing.assert_close(others, wanted.diagonal()[1:].sqrt(), rtol=1e-6, atol=0)


def test_limits():
    """One normal pulse without background in narrow bins; with everything else known; many photons per cycle."""
    fine = tt.TimeAxis.from_seconds(0.0, 10 * PS, 800)
    detections = torch.tensor([1.0, 30.0, 1e5], dtype=torch.float64)
    found = crlb(NORMAL, fine, distance_m=0.6, signal=detections)
    # bins of width w add w^2 / 12 to the variance
    wider = 1 + (10 / (400 / 2.3548)) ** 2 / 24
    wanted = sensing.range_deviation_m(400 * PS, detections)
    torch.testing.assert_close(found.distance_m, wanted * wider, rtol=1e-5, atol=0)
    torch.testing.assert_close(found.signal, detections.sqrt(), rtol=1e-9, atol=0)
    # few photons per cycle: those of all cycles
    dim = crlb(NORMAL, fine, distance_m=0.6, signal=1e-5, background=1e-8, cycles=10**8)
    summed = crlb(NORMAL, fine, distance_m=0.6, signal=1e3, background=1.0)
    assert float(dim.distance_m) == pytest.approx(float(summed.distance_m), rel=2e-5)
    assert float(dim.signal) == pytest.approx(1e-8 * float(summed.signal), rel=2e-5)


def test_what_is_in_the_way():
    levels = torch.tensor([0.0, 0.01, 0.1, 1.0, 10.0])
    by_background = crlb(NORMAL, AXIS, distance_m=place(20.0), signal=40.0, background=levels).distance_m
    assert bool((by_background.diff() > 0).all())
    # pile-up: more light helps up to about one photon per cycle, behind background it does not
    light = torch.logspace(-3, 2, 26, dtype=torch.float64)
    seen = crlb(NORMAL, AXIS, distance_m=place(50.0), signal=light, background=1e-3 * light, cycles=1000).distance_m
    best = int(seen.argmin())
    assert 0 < best < 25 and 0.5 < float(light[best]) < 30 and float(seen[-1]) > 5 * float(seen[best])


def test_pixels_of_any_shape_and_precision():
    distance = place(torch.tensor([[10.2], [30.7]]))
    signal = torch.tensor([5.0, 50.0, 500.0])
    whole = crlb(NORMAL, AXIS, distance_m=distance, signal=signal, background=0.1, cycles=None)
    assert whole.distance_m.shape == (2, 3) and whole.covariance.shape == (2, 3, 3, 3)
    for i in range(2):
        for j in range(3):
            alone = crlb(NORMAL, AXIS, distance_m=distance[i, 0], signal=float(signal[j]), background=0.1)
            torch.testing.assert_close(whole.distance_m[i, j], alone.distance_m, rtol=1e-12, atol=0)
    assert whole.distance_m.dtype == torch.float64
    for dtype in (torch.float16, torch.bfloat16, torch.float32):
        found = crlb(NORMAL, AXIS, distance_m=0.6, signal=signal.to(dtype), background=0.1)
        assert found.distance_m.dtype == torch.float32
    assert crlb(NORMAL, AXIS, distance_m=0.6, signal=30, background=1).distance_m.dtype == torch.float32
    assert crlb(NORMAL, AXIS, distance_m=0.6, signal=torch.zeros(0, 4)).distance_m.shape == (0, 4)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        torch.testing.assert_close(
            crlb(NORMAL, AXIS, distance_m=distance, signal=signal, background=0.1).covariance, whole.covariance
        )


def test_gradients():
    """In the pixels and in the device: pulses can be designed by it."""
    values = [place(torch.tensor([20.3, 31.9])), torch.tensor([0.4, 6.0], dtype=torch.float64),
              torch.tensor([1e-3, 0.02], dtype=torch.float64)]  # fmt: skip
    response = sensing.emg_response(250 * PS, 300 * PS, learnable=True)

    def bound(d, s, b, fwhm, tails):
        names = {"log_fwhm_s": fwhm, "log_tails_s": tails, "delay_ps": response.delay_ps.detach(),
                 "fraction_logits": response.fraction_logits.detach()}  # fmt: skip
        with torch.nn.utils.stateless._reparametrize_module(response, names):
            found = crlb(response, AXIS, distance_m=d, signal=s, background=b, cycles=200)
        return found.distance_m * 1e2, found.signal

    leaves = [v.clone().requires_grad_() for v in values]
    leaves += [p.detach().clone().requires_grad_() for p in (response.log_fwhm_s, response.log_tails_s)]
    assert torch.autograd.gradcheck(bound, leaves, rtol=1e-4, atol=1e-7, fast_mode=True)


@pytest.mark.parametrize("cycles", [None, 200])
def test_pixels_without_light(cycles):
    """Nothing is known of where nothing returns, of what returns outside, and their neighbours do not mind."""
    signal = torch.tensor([0.0, 0.3, 0.3], dtype=torch.float64, requires_grad=True)
    distance = torch.tensor([float(place(20.0)), 500.0, float(place(20.0))], dtype=torch.float64)
    for background in (0.0, 0.01):
        found = crlb(NORMAL, AXIS, distance_m=distance, signal=signal, background=background, cycles=cycles)
        assert found.distance_m.isinf().tolist() == [True, True, False]
        assert found.signal.isinf().tolist() == [False, True, False]
        (slope,) = torch.autograd.grad(found.distance_m[2], signal)
        assert bool(torch.isfinite(slope).all()) and float(slope[2]) < 0
    assert bool(torch.isfinite(found.background).all())
    two = tt.TimeAxis.from_seconds(0.0, 100 * PS, 2)  # three unknowns, two numbers
    assert float(crlb(NORMAL, two, distance_m=0.015, signal=5.0, background=0.1).distance_m) == math.inf


@by_response
def test_rates_are_those_of_the_sensor_model(response):
    """All light arrives, and moves by as much as the plane does."""
    long = tt.TimeAxis.from_seconds(1e-9, 100 * PS, 300)
    rates = return_rates(response, long, distance_m=place(torch.tensor([20.25, 31.5])), signal=3.0, background=0.5)
    assert rates.shape == (2, 300) and rates.dtype == torch.float64
    torch.testing.assert_close((rates - 0.5).sum(-1), torch.full((2,), 3.0, dtype=torch.float64), rtol=1e-6, atol=0)
    bins = torch.arange(300, dtype=torch.float64) + 0.5
    arrival = ((rates - 0.5) * bins).sum(-1) / 3
    assert float(arrival[1] - arrival[0]) == pytest.approx(11.25, abs=0.02)


# ------------------------------------------------------------------------------------------------------------- chains


def maps(*values):
    columns = torch.tensor([1.0, 1.05], dtype=torch.float64)
    return [torch.full((1, 2, 2), v, dtype=torch.float64) * columns for v in values]


def light(d, s, b):
    return return_rates(NORMAL, AXIS, distance_m=d, signal=s, background=b).movedim(-1, -3)


def test_of_chains():
    """A detector alone, as by the closed form; losses and blur behind it only widen the bound."""
    given = maps(float(place(20.3)), 1.2, 1e-3)
    spad = sensing.SynchronousSPAD(300)
    direct = crlb(NORMAL, AXIS, **named(given), cycles=300).covariance
    found = covariance_bound(lambda *p: spad.expected(light(*p)), given, cycles=300)
    torch.testing.assert_close(found, direct, rtol=1e-8, atol=0)
    counts = [given[0], *(100 * g for g in given[1:])]
    wanted = crlb(NORMAL, AXIS, **named(counts)).covariance
    torch.testing.assert_close(covariance_bound(light, counts), wanted, rtol=1e-9, atol=0)
    blur = sensing.DetectionJitter(sensing.GaussianResponse(300 * PS), AXIS, within_bin="center")
    # as if the response had been wider, where no pile-up is
    dim = [given[0], 1e-3 * given[1], 1e-3 * given[2]]
    wider = covariance_bound(lambda *p: blur.expected(spad.expected(light(*p))), dim, cycles=300)[..., 0, 0]
    both = crlb(sensing.GaussianResponse(500 * PS), AXIS, **named(dim), cycles=300).covariance[..., 0, 0]
    torch.testing.assert_close(wider, both, rtol=0.02, atol=0)
    leaves = [g.clone().requires_grad_() for g in given]
    value = covariance_bound(lambda *p: spad.expected(light(*p)), leaves, cycles=300)[..., 0, 0].sum()
    slopes = torch.autograd.grad(value, leaves)
    exact = torch.autograd.grad(crlb(NORMAL, AXIS, **named(leaves), cycles=300).covariance[..., 0, 0].sum(), leaves)
    for slope, wanted in zip(slopes, exact, strict=True):
        torch.testing.assert_close(slope, wanted, rtol=1e-6, atol=0)


def test_of_chains_without_light_or_without_a_cycle_left():
    """Bins that stay dark tell nothing; a detector that fires in every cycle tells no brightness, and is no NaN."""
    given = maps(float(place(20.3)), 100.0)
    even = sensing.UniformResponse(630 * PS)

    def dark(d, s):
        return return_rates(even, AXIS, distance_m=d, signal=s).movedim(-1, -3)

    # dark bins tell that there is no background
    wanted = crlb(even, AXIS, distance_m=given[0], signal=given[1]).covariance[..., :2, :2]
    assert int((dark(*given) == 0).sum()) > 50
    torch.testing.assert_close(covariance_bound(dark, given), wanted, rtol=1e-9, atol=1e-16)  # of products of some 1e-2
    halves = maps(0.5)
    full = covariance_bound(lambda p: torch.stack([4 * p, 4 * (1 - p)], -3), halves, cycles=4)
    # a coin tossed four times: p (1 - p) / 4
    p = halves[0].flatten()
    torch.testing.assert_close(full.flatten(), p * (1 - p) / 4, rtol=1e-6, atol=0)


# ---------------------------------------------------------------------------------------------------------- estimators


def test_first_photons_reach_the_bound():
    """Maximum likelihood of distance, signal and background together, from a peak of Coates' estimate on."""
    pixels, cycles, per_cycle = 400, 4000, 1.0
    g = seeded(2)
    distance = place(20 + 20 * torch.rand(pixels, generator=g, dtype=torch.float64))
    truth = torch.stack([distance, torch.full_like(distance, per_cycle), torch.full_like(distance, 2e-3)], -1)
    rates = as_histogram(return_rates(NORMAL, AXIS, **named(truth.unbind(-1))))
    counts = sensing.SynchronousSPAD(cycles).sample(rates, g)
    smooth = sensing.convolve_time(sensing.coates(counts, cycles).rate, torch.ones(5).double(), -2)
    start = sensing.distance_of_position(sensing.peak_position(smooth), AXIS)
    bound = crlb(NORMAL, AXIS, **named(truth.unbind(-1)), cycles=cycles)
    found = torch.stack([start.flatten(), truth[:, 1] * 0.8, truth[:, 2] * 1.3], -1)
    for _ in range(8):  # Fisher scoring: the inverse of the information is the covariance of the bound
        leaf = found.clone().requires_grad_()
        model = as_histogram(return_rates(NORMAL, AXIS, **named(leaf.unbind(-1))))
        loss = first_photon_nll(model, counts, cycles, reduction="sum")
        (slope,) = torch.autograd.grad(loss, leaf)
        covariance = crlb(NORMAL, AXIS, **named(found.unbind(-1)), cycles=cycles).covariance
        step = (covariance @ slope[..., None])[..., 0]
        found = torch.maximum(found - step, 0.3 * found)
    error = found - truth
    wanted = torch.stack([bound.distance_m, bound.signal, bound.background], -1)
    ratio = (error / wanted).square().mean(0).sqrt()
    assert bool((ratio < 1.1).all()) and bool((ratio > 0.9).all()), ratio
    assert bool((((error / wanted).mean(0)).abs() < 4 / pixels**0.5).all())
