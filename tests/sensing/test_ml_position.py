"""The place of a return by the likelihood of its response: at the bound for tails and in wide bins, differentiable."""

from __future__ import annotations

import math

import pytest
import torch

from torchtransient import TimeAxis, sensing

PS = 1e-12
AXIS = TimeAxis.from_seconds(0.0, 100 * PS, 64)
DRAWS = 2000
SHAPES = {
    "tail of 2 bins": sensing.emg_response(200 * PS, 200 * PS),
    "tail of 4 bins": sensing.emg_response(200 * PS, 400 * PS),
    "rectangle": sensing.UniformResponse(500 * PS),
    "narrow": sensing.GaussianResponse(60 * PS),
    "wide": sensing.GaussianResponse(500 * PS),
    # in bins that are fine beside those of the counts: corners have no regular bound
    "measured": sensing.MeasuredResponse(sensing.emg_response(180 * PS, 300 * PS).kernel(10 * PS)[1], 10 * PS),
}


def planes(draws=DRAWS, seed=0):
    g = torch.Generator().manual_seed(seed)
    return 0.5 * AXIS.bin_width_opl * (20 + 12 * torch.rand(1, 1, draws, generator=g, dtype=torch.float64))


def counts_of(response, truth, photons, background, seed=1):
    mean = sensing.return_rates(response, AXIS, distance_m=truth, signal=photons, background=background).movedim(-1, -3)
    return torch.poisson(mean, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(("shape", "background"), [("tail of 2 bins", 0.6), ("rectangle", 0.0), ("wide", 0.6)])
def test_at_the_bound_in_any_shape(shape, background):
    """1000 photons. The ratio of 2000 draws has a deviation of 1.6 %: four of them, and 2 % above the bound."""
    response, truth, photons = SHAPES[shape], planes(), 1000.0
    counts = counts_of(response, truth, photons, background)
    ratio = photons / background if background else 1e3
    bound = sensing.crlb(response, AXIS, distance_m=truth, signal=photons, background=background).distance_m

    def error(position):
        return (sensing.distance_of_position(position, AXIS) - truth) / bound

    found = error(sensing.ml_position(counts, response, AXIS, signal_to_background=ratio))
    assert float(found.square().mean().sqrt()) < 1.02 + 4 * 0.016
    # of the second order of the noise, which is 1/sqrt(photons) of it
    assert abs(float(found.mean())) < 4 / DRAWS**0.5 + 4 / photons**0.5
    first, kernel = response.kernel(AXIS.bin_width_s)
    scores = sensing.log_matched_filter(counts, kernel, first, signal_to_background=ratio)
    if shape != "wide":  # the parabola has no likelihood of that shape
        assert float(error(sensing.peak_position(scores)).square().mean().sqrt()) > 1.15


def test_means_are_found_to_a_thousandth_of_a_bin():
    """Without noise the greatest likelihood is where the light is: at any place of a bin, early and late."""
    places = torch.linspace(14, 40, 91, dtype=torch.float64) + torch.linspace(0, 1, 91, dtype=torch.float64)
    truth = 0.5 * AXIS.bin_width_opl * places.view(1, 1, -1)
    for name in ("tail of 2 bins", "narrow", "wide"):
        mean = sensing.return_rates(SHAPES[name], AXIS, distance_m=truth, signal=1000.0, background=1.0).movedim(-1, -3)
        found = sensing.ml_position(mean, SHAPES[name], AXIS, signal_to_background=1000.0).flatten()
        torch.testing.assert_close(found, places, rtol=0, atol=1e-3)


def test_derivatives():
    """In the counts and in the numbers of the response: how the top moves."""
    counts = counts_of(SHAPES["tail of 2 bins"], planes(3), 500.0, 0.5).requires_grad_()
    response = sensing.emg_response(210 * PS, 190 * PS, learnable=True)

    def place(x):
        return sensing.ml_position(x, response, AXIS, signal_to_background=1000.0)

    assert torch.autograd.gradcheck(place, (counts,), fast_mode=True)
    moved = dict(response.named_parameters())
    for name in ("log_fwhm_s", "log_tails_s", "delay_ps"):

        def of(value, name=name):
            return torch.func.functional_call(Place(response), {f"response.{name}": value}, (counts.detach(),))

        assert torch.autograd.gradcheck(of, (moved[name],), fast_mode=True, eps=1e-5, atol=1e-4)


class Place(torch.nn.Module):
    def __init__(self, response):
        super().__init__()
        self.response = response

    def forward(self, counts):
        return sensing.ml_position(counts, self.response, AXIS, signal_to_background=1000.0)


def test_dtypes_batches_and_what_has_no_place():
    response = SHAPES["tail of 4 bins"]
    counts = counts_of(response, planes(8), 200.0, 0.3)
    exact = sensing.ml_position(counts, response, AXIS, signal_to_background=600.0)
    assert exact.dtype == torch.float64
    for dtype in (torch.float16, torch.bfloat16, torch.float32):
        found = sensing.ml_position(counts.to(dtype), response, AXIS, signal_to_background=600.0)
        assert found.dtype == torch.float32  # whole numbers below 256 are the same in all
        torch.testing.assert_close(found.double(), exact, rtol=1e-6, atol=0)
    by_width = sensing.ml_position(counts, response, bin_width_s=100 * PS, signal_to_background=600.0)
    torch.testing.assert_close(by_width, exact, rtol=0, atol=1e-9)
    alone = torch.cat([sensing.ml_position(counts[..., i : i + 1], response, AXIS, signal_to_background=600.0)
                       for i in range(8)], -1)  # fmt: skip
    torch.testing.assert_close(alone, exact, rtol=0, atol=1e-9)
    assert sensing.ml_position(counts[None][:0], response, AXIS).shape == (0, 1, 1, 8)
    assert sensing.ml_position(torch.zeros_like(counts), response, AXIS).eq(0.5).all()
    broken = counts.clone()
    broken[0, 3, 0, 2] = math.nan
    found = sensing.ml_position(broken, response, AXIS, signal_to_background=600.0).flatten()
    assert found.isnan().tolist() == [i == 2 for i in range(8)]
    torch.testing.assert_close(found[3:], exact.flatten()[3:], rtol=0, atol=1e-9)


def test_flat_tops_and_ends_of_the_window():
    """A pulse of a tenth of a bin that lies in one bin may be anywhere in it; places outside the window are none."""
    narrow = sensing.UniformResponse(10 * PS)
    for bin_ in (0, 1, 30, 63):
        counts = torch.zeros(1, 64, 1, 1, dtype=torch.float64)
        counts[:, bin_] = 7
        found = sensing.ml_position(counts.requires_grad_(), narrow, AXIS)
        assert float(found.detach()) == pytest.approx(bin_ + 0.5, abs=1 / 64)
        (slope,) = torch.autograd.grad(found.sum(), counts)
        assert bool(slope.isfinite().all()) and float(slope.abs().max()) == 0
        for response in SHAPES.values():
            assert 0 <= float(sensing.ml_position(counts.detach(), response, AXIS)) <= 64


@pytest.mark.parametrize("delay", [370 * PS, -640 * PS])
@pytest.mark.parametrize("shape", ["tail", "even", "narrow"])
def test_few_photons_against_every_place(shape, delay):
    """The greatest likelihood of all places of the bins around the best one, looked at one by one, at both ends too."""
    bins, ratio = 20, 50.0
    response = {"tail": sensing.emg_response(150 * PS, 300 * PS, delay_s=delay),
                "even": sensing.UniformResponse(230 * PS, delay_s=delay),
                "narrow": sensing.GaussianResponse(90 * PS, delay_s=delay)}[shape]  # fmt: skip
    mean = torch.full((1, bins, 1, 150), 0.3, dtype=torch.float64)
    counts = torch.poisson(mean, generator=torch.Generator().manual_seed(0))
    found = sensing.ml_position(counts, response, bin_width_s=100 * PS, signal_to_background=ratio).flatten()
    first, kernel = response.kernel(100 * PS)
    best = sensing.log_matched_filter(counts, kernel, first, signal_to_background=ratio).argmax(-3).flatten()
    places = torch.arange(bins * 64 + 1, dtype=torch.float64) / 64
    edges = (torch.arange(bins + 1, dtype=torch.float64) - places.unsqueeze(1)) * 100 * PS
    shares = response.cdf(edges.flatten()).view(edges.shape).diff(dim=1)
    likely = torch.log1p(ratio * shares) @ counts[0, :, 0]
    apart = places.unsqueeze(1) - best
    likely = likely.masked_fill((apart < -1) | (apart > 2), -math.inf)
    highest = likely.amax(0)
    # between the places that were looked at the likelihood is hardly higher; light outside of a response says nothing
    at = (found * 64).round().long().clamp(0, bins * 64)
    seen = counts.sum(1).flatten() > 0
    assert bool((likely.gather(0, at.unsqueeze(0))[0] >= highest - 0.05 * (1 + highest.abs()))[seen].all())
    strict = likely.gather(0, at.unsqueeze(0))[0] >= highest - 1e-3
    assert float(strict[seen].double().mean()) > 0.9
