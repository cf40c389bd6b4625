"""Fits of weak light by the likelihoods as they are: unbiased, at the Cramer-Rao bound, and stable where nothing is."""

from __future__ import annotations

import functools
import itertools
import math

import pytest
import torch

from torchtransient import losses
from torchtransient.losses import armed_periods
from torchtransient.sensing import FreeRunningSPAD, SynchronousSPAD

BINS = 64
EACH = {"reduction": "none"}
SINGLE = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def fitted(loss, start, *, steps=14):
    """The least of a loss of each item: `loss(parameters)` for parameters (items, P), convex or nearly so.

    Newton's method in the logarithms of the parameters, with the curvature by differences of its gradient, both as
    they come out of the precision that is asked for.
    """
    x = start.clone().log()
    for _ in range(steps):
        columns = []
        for k in range(x.shape[1] + 1):
            at = x.detach().clone()
            if k:
                at[:, k - 1] += 1e-2
            leaf = at.requires_grad_()
            columns.append(torch.autograd.grad(loss(leaf.exp()).sum(), leaf)[0].double())
        slope, curvature = columns[0], torch.stack([(c - columns[0]) / 1e-2 for c in columns[1:]], -1)
        curvature = 0.5 * (curvature + curvature.mT)
        # away from the least the curvature in logarithms may vanish: a step is bounded, and downhill
        values, vectors = torch.linalg.eigh(curvature)
        values = values.abs().clamp_min(1e-6 * values.abs().amax(-1, keepdim=True).clamp_min(1e-9))
        step = (vectors @ ((vectors.mT @ slope[..., None]) / values[..., None]))[..., 0]
        x = (x.double() - step.clamp(-1, 1)).to(x.dtype)
    return x.exp()


def pulse(position, sigma=1.5, bins=BINS):
    """Shares of a normal pulse, (..., T, 1, 1); exactly 0 far out in single precision."""
    edges = torch.arange(bins + 1, dtype=torch.float64)
    return (0.5 * torch.erf((edges - position) / (sigma * math.sqrt(2)))).diff().reshape(1, -1, 1, 1)


@pytest.mark.slow
def test_background_under_a_bright_peak():
    """0.2 counts a bin beside 2000 in a peak: a floor of 1e-3 of the mean bin, 0.03, took a seventh of them away.

    Signal and background together; the error of the mean of 2000 fits is their spread over its root.
    """
    items, truth, dtype = 2000, (2000.0, 0.2), torch.float32
    shares = pulse(20.3)
    mean = truth[0] * shares + truth[1]
    counts = torch.poisson(mean.expand(items, -1, -1, -1), generator=seeded(1)).to(dtype)

    def model(p):
        s, b = p[:, 0].reshape(-1, 1, 1, 1), p[:, 1].reshape(-1, 1, 1, 1)
        return s * shares.to(dtype) + b

    start = torch.tensor([[1000.0, 1.0]], dtype=dtype).expand(items, -1)
    found = fitted(lambda p: losses.poisson_nll(model(p), counts, reduction="none"), start).double()
    fisher = torch.stack([shares / mean * shares, shares / mean, shares / mean, 1 / mean]).sum((1, 2, 3, 4))
    bound = torch.linalg.inv(fisher.reshape(2, 2)).diagonal().sqrt()
    error = found.mean(0) - torch.tensor(truth, dtype=torch.float64)
    assert bool((error.abs() < 4 * bound / items**0.5).all()), error / bound * items**0.5
    assert bool((found.std(0) < 1.05 * bound).all()), found.std(0) / bound
    # what docs/losses.md says of a floor of 1e-3 of the mean bin
    floor = 1e-3 * float(mean.mean())
    biased = fitted(lambda p: losses.poisson_nll(model(p), counts, floor=floor, reduction="none"), start).double()
    assert float(biased[:, 1].mean()) / truth[1] - 1 == pytest.approx(-0.16, abs=0.01)


@pytest.mark.slow
def test_background_behind_a_strong_return_of_first_photons():
    """Light of 1e-3 a bin before and behind a return that stops nearly all cycles.

    The bound of one parameter is 1 over the root of the information, sum of armed / expm1(r) times dr^2.
    """
    items, cycles, weak, photons, dtype = 1500, 20_000, 1e-3, 20.0, torch.float32
    shares = pulse(40.2)
    rate = photons * shares + weak
    spad = SynchronousSPAD(cycles)
    counts = spad.sample(rate.expand(items, -1, -1, -1), seeded(2)).to(dtype)

    def model(p):
        return (photons * shares).to(dtype) + p.reshape(-1, 1, 1, 1)

    start = torch.full((items, 1), 1e-2, dtype=dtype)
    found = fitted(lambda p: losses.first_photon_nll(model(p), counts, cycles, reduction="none"), start).double()
    armed = cycles * torch.exp(rate - rate.cumsum(1))
    bound = float((armed / torch.expm1(rate)).sum()) ** -0.5
    assert abs(float(found.mean()) - weak) < 4 * bound / items**0.5
    assert float(found.std()) < 1.06 * bound
    floor = 1e-3 * float(rate.mean())
    biased = fitted(lambda p: losses.first_photon_nll(model(p), counts, cycles, floor=floor, **EACH), start)
    assert float(biased.double().mean()) / weak - 1 == pytest.approx(-0.31, abs=0.01)


@SINGLE
def test_background_of_a_free_running_detector(dtype):
    """0.2 counts a bin beside a peak, a dead time of 20 bins: the mean histogram gives the mean back."""
    periods, weak, dead = 1000, 2e-4, 20.0
    shares = pulse(30.5)
    rate = 0.8 * shares + weak
    counts = FreeRunningSPAD(periods, dead * 1e-10, bin_width_s=1e-10)(rate).to(dtype)

    def model(p):
        return (0.8 * shares).to(dtype) + p.reshape(-1, 1, 1, 1)

    start = torch.full((1, 1), 1e-2, dtype=dtype)
    found = fitted(
        lambda p: losses.free_running_nll(model(p), counts, periods=periods, dead_bins=dead, reduction="none"), start
    )
    # second order in the counts of a bin per period, 0.2 here
    assert float(found) == pytest.approx(weak, rel=0.1)
    best = counts.double() / armed_periods(counts, periods, dead)
    assert float(best[:, :20].mean()) == pytest.approx(weak, rel=1e-3)


@SINGLE
def test_a_background_of_few_counts_in_a_large_image(dtype):
    """Two counts in half a million bins: 4e-6 a bin. The score there is that of the formula."""
    counts = torch.zeros(1, 128, 64, 64, dtype=dtype)
    counts[0, 5, 3, 3] = counts[0, 70, 40, 2] = 1
    n = counts.numel()
    level = torch.tensor(2 / n, dtype=dtype, requires_grad=True)
    for loss, unit in (
        (lambda m: losses.poisson_nll(m, counts, reduction="sum"), 1),
        (lambda m: losses.first_photon_nll(m, counts, 10**6, reduction="sum"), 1e6),
        (lambda m: losses.free_running_nll(m, counts, periods=10**6, dead_bins=3.0, reduction="sum"), 1e6),
    ):
        leaf = (level.detach() / unit).requires_grad_()
        (slope,) = torch.autograd.grad(loss(leaf * torch.ones_like(counts)), leaf)
        # both parts of it are `n` times the unit; single precision sums that many numbers
        assert abs(float(slope)) < 1e-4 * n * unit


LOSSES = {
    "poisson": (lambda m, n: losses.poisson_nll(m, n, **EACH), 1),
    "first photon": (lambda m, n: losses.first_photon_nll(m, n, 1000, **EACH), 1000),
    "first photon, dead time": (lambda m, n: losses.first_photon_nll(m, n, 1000, dead_bins=2.5, **EACH), 1000),
    "free running": (lambda m, n: losses.free_running_nll(m, n, periods=1000, dead_bins=2.5, **EACH), 1000),
}
each = pytest.mark.parametrize("loss, exposures", LOSSES.values(), ids=LOSSES.keys())


@each
@SINGLE
def test_a_bin_without_counts_has_its_mean_as_value_and_one_as_slope(loss, exposures, dtype):
    m = torch.tensor([0.0, 1e-40, 1e-12, 0.3, 40.0], dtype=dtype).reshape(1, -1, 1, 1).requires_grad_()
    value = loss(m, torch.zeros_like(m))
    (slope,) = torch.autograd.grad(value.sum(), m)
    torch.testing.assert_close(value.detach(), exposures * m.detach(), rtol=1e-6, atol=0)
    assert bool((slope == exposures).all())


@each
def test_the_tangent_in_the_dark(loss, exposures):
    """Continuous in value and slope where it begins, straight below, convex, and the formula above."""
    for n in (1.0, 7.0, 300.0):
        counts = torch.tensor([0.0, n, 0.0, 0.0, 0.0], dtype=torch.float64).reshape(1, -1, 1, 1)
        edge = 1e-9 * n / exposures

        def at(level, counts=counts):
            m = torch.full_like(counts, level, requires_grad=True)
            value = loss(m, counts)[0, 1, 0, 0]
            return float(value.detach()), float(torch.autograd.grad(value, m)[0][0, 1, 0, 0])

        (below, slope_below), (above, slope_above) = at(edge * (1 - 1e-12)), at(edge * (1 + 1e-12))
        assert below == pytest.approx(above, rel=1e-9) and slope_below == pytest.approx(slope_above, rel=1e-8)
        found = [at(level) for level in (0.0, 1e-30, 0.3 * edge, 0.9 * edge, 3 * edge, 1e3 * edge, 1e8 * edge)]
        slopes = [slope for _, slope in found]
        assert slopes[0] == slopes[1] == pytest.approx(slopes[3], rel=1e-8)
        assert all(a <= b + 1e-9 * abs(a) for a, b in itertools.pairwise(slopes))
        assert found[0][0] - found[2][0] == pytest.approx(-0.3 * edge * slopes[0], rel=1e-6)
        # n (log m) of the formula, 1e8 times brighter: 8 log 10 less for each count, and 1 more at the tangent's end
        assert at(edge)[0] - at(1e3 * edge)[0] == pytest.approx(n * math.log(1e3), rel=1e-4)


@SINGLE
def test_first_photons_of_tiny_and_huge_rates(dtype):
    """log(1 - exp(-r)) against its series and its limit: what is nearly 0 to 1e-15."""
    r = torch.tensor([1e-8, 1e-4, 1.0, 30.0, 200.0, 5e3], dtype=dtype).reshape(-1, 1, 1, 1, 1).requires_grad_()
    counts = torch.full_like(r, 5.0).detach()
    # all cycles fire: nothing but the logarithm is left
    value = losses.first_photon_nll(r, counts, 5, dim=-3, reduction="none")
    (slope,) = torch.autograd.grad(value.sum(), r)
    exact = r.detach().double()
    wanted = torch.where(exact > 1, torch.exp(-exact) + 0.5 * torch.exp(-2 * exact), -torch.log(-torch.expm1(-exact)))
    torch.testing.assert_close(value.detach().double(), 5 * wanted, rtol=1e-5, atol=1e-15)
    torch.testing.assert_close(slope.double(), -5 / torch.expm1(exact), rtol=1e-5, atol=1e-15)


@pytest.mark.parametrize(
    "cycles, reduction, masked", [(40, "mean", False), (1000, "sum", True), (30_000, "sum", False)]
)
def test_slopes_of_half_precision_are_numbers_whatever_the_cycles(cycles, reduction, masked):
    """Slopes are counts over the level, times cycles: -inf of float16 from three cycles on, and of coarse bins."""
    n = torch.zeros(1, 8, 1, 2)
    n[0, 2], n[0, 6, 0, 0] = 5.0, 1.0
    free, first = losses.free_running_nll, functools.partial(losses.first_photon_nll, cycles=cycles)
    each = {
        "first": first,
        "dead time": functools.partial(first, dead_bins=2.5),
        "free": functools.partial(free, periods=cycles, dead_bins=2.5),
        "poisson": losses.poisson_nll,
        "first, coarse": functools.partial(losses.multiscale_loss, compare=first),
        "poisson, coarse": functools.partial(losses.multiscale_loss, compare=losses.poisson_nll, scales=[3, 8]),
    }
    mask = torch.tensor([1, 1, 1, 0, 1, 1, 1, 0]).bool().view(1, 8, 1, 1) if masked else None
    for name, loss in each.items():
        for rate in (0.0, 1e-7, 1e-3):
            leaf = torch.full(n.shape, rate, dtype=torch.float16, requires_grad=True)
            (slope,) = torch.autograd.grad(loss(leaf, n, mask=mask, reduction=reduction), leaf)
            assert bool(slope.isfinite().all()), name
            assert float(slope[0, 2, 0, 0]) < 0 or rate > 0, name
