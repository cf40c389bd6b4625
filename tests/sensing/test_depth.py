"""Depth from histograms: exact cases, the Cramer-Rao bound, gradients, several returns."""

from __future__ import annotations

import math

import pytest
import torch

from torchtransient.axes import TimeAxis
from torchtransient.sensing import GaussianResponse, depth, ml_position
from torchtransient.units import SPEED_OF_LIGHT

BINS, WIDTH_S = 64, 100e-12


def pulse(position, sigma_bins=2.0, bins=BINS):
    """(1, T, 1, P): normal pulses of area one around positions in bins, integrated over bins."""
    edges = torch.arange(bins + 1, dtype=torch.float64).reshape(-1, 1, 1)
    u = (edges - position) / sigma_bins / math.sqrt(2)
    return (0.5 * torch.erf(u)).diff(dim=0).unsqueeze(0)


def test_matched_filter_is_the_likelihood():
    """Scores differ from the Poisson log-likelihood of signal plus background by a constant."""
    g = torch.Generator().manual_seed(0)
    first, kernel = GaussianResponse(400e-12, delay_s=150e-12).kernel(WIDTH_S)
    histogram = torch.poisson(torch.full((1, BINS, 1, 3), 2.0, dtype=torch.float64), generator=g)
    signal, background = 40.0, 0.5
    scores = depth.log_matched_filter(histogram, kernel, first, signal_to_background=signal / background)
    for t in (20, 31, 40):  # far from the rims, where the whole kernel is inside
        mean = torch.full((BINS,), background, dtype=torch.float64)
        for j, share in enumerate(kernel):
            if 0 <= t + first + j < BINS:
                mean[t + first + j] += signal * share
        likelihood = torch.einsum("cthw,t->chw", histogram, (mean / background).log())
        torch.testing.assert_close(scores[:, t], likelihood, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("position", [20.5, 20.75, 21.13])
def test_peak_of_the_matched_filter_is_exact_for_normal_pulses(position):
    scores = depth.log_matched_filter(pulse(position), *reversed(GaussianResponse(471e-12).kernel(WIDTH_S)))
    assert abs(float(depth.peak_position(scores)) - position) < 0.01


def test_positions_of_a_pulse():
    position = torch.tensor([12.5, 30.2, 45.9], dtype=torch.float64)
    x = pulse(position)
    torch.testing.assert_close(depth.center_of_mass(x)[0, 0], position, rtol=0, atol=1e-6)
    windowed = depth.center_of_mass(x + 3.0, background=3.0, half_width_bins=8)
    torch.testing.assert_close(windowed[0, 0], position, rtol=0, atol=0.01)
    scores = depth.log_matched_filter(10 * x, *reversed(GaussianResponse(471e-12).kernel(WIDTH_S)))
    torch.testing.assert_close(depth.soft_argmax(scores)[0, 0], position, rtol=0, atol=0.02)
    pulled = depth.center_of_mass(x + 0.1)[0, 0] - position
    assert bool((pulled.sign() == (BINS / 2 - position).sign()).all())  # background left in pulls to the middle


@pytest.mark.parametrize("detections", [30.0, 300.0])
def test_matched_filter_reaches_the_cramer_rao_bound(detections):
    count, position = 20_000, 31.4
    g = torch.Generator().manual_seed(4)
    x = torch.poisson((detections * pulse(torch.full((1,), position))).expand(1, BINS, 1, count), generator=g)
    scores = depth.log_matched_filter(x, *reversed(GaussianResponse(471e-12).kernel(WIDTH_S)))
    found = depth.distance_of_position(depth.peak_position(scores), TimeAxis.from_seconds(0.0, WIDTH_S, BINS))
    bound = depth.range_deviation_m(471e-12, torch.tensor(detections))
    # Detections vary from shot to shot (+ 1 / N in the mean of 1 / N) and a bin adds 1 / 12 to the variance of 4.
    assert 0.97 < float(found.std() / bound) < 1.06
    assert abs(float(found.mean()) - position * WIDTH_S * SPEED_OF_LIGHT / 2) < 5 * float(bound) / count**0.5 + 1e-4


def test_gradients():
    x = (5 * pulse(torch.tensor([20.3, 33.8], dtype=torch.float64)) + 0.1).requires_grad_()
    kernel = GaussianResponse(471e-12).kernel(WIDTH_S)[1]
    for f in (
        lambda h: depth.peak_position(h),
        lambda h: depth.center_of_mass(h, background=0.1),
        lambda h: depth.center_of_mass(h, half_width_bins=5),
        lambda h: depth.soft_argmax(h, 0.3),
        lambda h: depth.log_matched_filter(h, kernel),
        lambda h: depth.first_return(h, 0.4).position,
        lambda h: depth.multi_return(h, 1, threshold=0.4).position,
    ):
        assert torch.autograd.gradcheck(f, x, fast_mode=True)
    position = torch.tensor([20.3], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(depth.center_of_mass(pulse(position)).sum(), position)
    assert abs(float(slope) - 1) < 1e-6


def test_first_return_is_the_leading_edge():
    x = torch.zeros(1, 10, 1, 2, dtype=torch.float64)
    x[0, 3:6, 0, 0] = torch.tensor([2.0, 6.0, 1.0])
    x[0, 0, 0, 1] = 9.0
    found = depth.first_return(x, 4.0)
    assert found.position.flatten().tolist() == [4.0, 0.5]  # half way between the middles of bins 3 and 4
    assert found.strength.flatten().tolist() == [6.0, 9.0]


def test_several_returns():
    x = 3 * pulse(torch.tensor(12.4)) + 8 * pulse(torch.tensor(40.6)) + 1 * pulse(torch.tensor(55.5))
    found = depth.multi_return(x, 4, threshold=0.1, min_separation_bins=4)
    assert found.valid.flatten().tolist() == [True, True, True, False]
    torch.testing.assert_close(
        found.position.flatten()[:3], torch.tensor([12.4, 40.6, 55.5], dtype=torch.float64), rtol=0, atol=0.02
    )
    two = depth.multi_return(x, 2, threshold=0.1, min_separation_bins=4).position.flatten()
    torch.testing.assert_close(two, torch.tensor([12.4, 40.6], dtype=torch.float64), rtol=0, atol=0.02)
    close = 3 * pulse(torch.tensor(12.4)) + 8 * pulse(torch.tensor(20.6))
    assert int(depth.multi_return(close, 3, threshold=0.1, min_separation_bins=12).valid.sum()) == 1


def test_distances_and_points():
    axis = TimeAxis(2.0, 0.1, 100)
    assert abs(float(depth.distance_of_position(torch.tensor(10.0, dtype=torch.float64), axis)) - 1.5) < 1e-12
    assert abs(float(depth.distance_of_position(torch.tensor(10), axis)) - 1.5) < 1e-6
    intrinsics = torch.tensor([[50.0, 0, 3.5], [0, 50.0, 2.5], [0, 0, 1]], dtype=torch.float64)
    # A plane at z = 2: distances along the rays are longer away from the axis, its points have z = 2 everywhere.
    v, u = torch.meshgrid(torch.arange(6.0), torch.arange(8.0), indexing="ij")
    rays = torch.stack([(u - 3.5) / 50, (v - 2.5) / 50, torch.ones_like(u)], -1).double()
    distance = (2 * rays.norm(dim=-1)).requires_grad_()
    points = depth.distance_to_points(distance, intrinsics)
    torch.testing.assert_close(points, 2 * rays)
    stacked = depth.distance_to_points(distance.expand(2, 3, 6, 8), intrinsics)
    torch.testing.assert_close(stacked[1, 2], points)
    batched = depth.distance_to_points(distance.expand(2, 6, 8), intrinsics.expand(2, 3, 3))
    torch.testing.assert_close(batched[1], points)
    assert torch.autograd.gradcheck(lambda d: depth.distance_to_points(d, intrinsics), distance, fast_mode=True)


# ------------------------------------------------------------------------------------------- weak and negative light

WINDOW = 128
ESTIMATORS = {
    "mass": depth.center_of_mass,
    "mass, background off": lambda h: depth.center_of_mass(h, background=0.05),
    "mass near": lambda h: depth.center_of_mass(h, half_width_bins=6),
    "peak": depth.peak_position,
    "peak of scores": lambda h: depth.peak_position(
        depth.log_matched_filter(h, *reversed(GaussianResponse(471e-12).kernel(WIDTH_S)))
    ),
    "likeliest": lambda h: ml_position(h, GaussianResponse(471e-12), bin_width_s=WIDTH_S, signal_to_background=100.0),
    "soft": depth.soft_argmax,
    "first": lambda h: depth.first_return(h, 0.5).position.squeeze(-3),
    "first, any light": lambda h: depth.first_return(h, -1.0).position.squeeze(-3),
    "several": lambda h: depth.multi_return(h, 3, threshold=0.1).position.amax(-3),
}


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float16, torch.float64], ids=str)
@pytest.mark.parametrize("estimate", ESTIMATORS.values(), ids=ESTIMATORS.keys())
def test_positions_stay_in_the_window(estimate, dtype):
    """Six counts under the normal surrogate reached +-38000 bins of 128; totals of any sign, none, and huge ones."""
    g = torch.Generator().manual_seed(0)
    mean = (torch.tensor([0.0, 1.0, 6.0, 30.0, 1e4], dtype=torch.float64) * pulse(90.3, bins=WINDOW) + 0.05).expand(
        1, WINDOW, 400, 5
    )
    noise = torch.randn(mean.shape, generator=g, dtype=torch.float64)
    surrogate = mean + mean.sqrt() * noise
    for x in (surrogate, torch.poisson(mean, generator=g), noise, -mean, surrogate - surrogate.mean(1, keepdim=True)):
        found = estimate(x.to(dtype))
        assert found.dtype == torch.promote_types(dtype, torch.float32) and bool(torch.isfinite(found).all())
        assert bool((found >= 0).all()) and bool((found <= WINDOW).all()), (float(found.min()), float(found.max()))


def test_a_mass_stays_inside_of_the_window():
    """Excess [6, 0, 0, -3] around its largest bin has its mass at 1/2 - 9 3 / 45 = -1/10: before the first bin."""
    x = torch.tensor([10.0, 4.0, 4.0, 1.0], dtype=torch.float64).view(1, 4, 1, 1)
    given = {"background": 4.0, "half_width_bins": 3}
    assert float(depth.center_of_mass(x, **given)) == 0.0
    assert float(depth.center_of_mass(x.flip(1), **given)) == 4.0
    # the bins that count end sooner: -3 at a distance of 1
    near = torch.tensor([4.0, 4.0, 10.0, 1.0], dtype=torch.float64).view(1, 4, 1, 1)
    assert float(depth.center_of_mass(near, background=4.0, half_width_bins=1)) == pytest.approx(2.5 - 9 / 45)


@pytest.mark.parametrize("half_width", [None, 6])
def test_the_slope_of_a_mass_of_weak_light_is_bounded(half_width):
    """(reach + 2 reach) over the noise of what counts, N >= the largest entry: none larger, of any total.

    d(M S / N^2) = (x S + M) / N^2 - 2 M S e / N^4 for S < N, with |M| <= reach sqrt(bins) N.
    """
    g = torch.Generator().manual_seed(1)
    mean = (6 * pulse(90.3, bins=WINDOW) + 0.05).expand(1, WINDOW, 40, 100)
    x = (mean + mean.sqrt() * torch.randn(mean.shape, generator=g, dtype=torch.float64)).requires_grad_()
    (slope,) = torch.autograd.grad(depth.center_of_mass(x, half_width_bins=half_width).sum(), x)
    reach, bins = (WINDOW / 2, WINDOW) if half_width is None else (half_width, 2 * half_width + 1)
    if half_width is None:
        noise = x.detach().square().sum(1, keepdim=True).sqrt()
        assert bool((slope.abs() * noise <= reach * (1 + 3 * bins**0.5)).all())
    assert float(slope.abs().max()) < 3 * reach * bins**0.5


def test_light_that_is_no_light_has_no_returns():
    """An empty pixel under a threshold that is a share of its largest entry; an even one."""
    for x in (torch.zeros(1, 12, 1, 2), -torch.ones(1, 12, 1, 2)):
        assert not bool(depth.first_return(x, 0.5 * x.amax(1)).valid.any())
        assert not bool(depth.multi_return(x, 2, threshold=-2.0).valid.any())
    assert not bool(depth.multi_return(torch.ones(1, 12, 1, 1), 2, threshold=0.0).valid.any())
    x = torch.zeros(1, 12, 1, 1)
    x[0, 5] = 2.0
    assert float(depth.first_return(x, 0.0).position) == 4.5  # where it leaves zero
    assert float(depth.first_return(x, 1.0).position) == 5.0
