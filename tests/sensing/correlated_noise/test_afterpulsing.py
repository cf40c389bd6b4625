"""Afterpulses against detections followed one by one, crosstalk against plain loops, gradients by policy."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from torchtransient.errors import UnitError
from torchtransient.sensing import (
    Afterpulsing,
    Crosstalk,
    ScoreFunction,
    add_afterpulses,
    add_crosstalk,
    hot_pixel_rates,
)

BINS = 40


def kernel_of(tau, dead, period=BINS):
    """Delays of one afterpulse, in bins."""
    return Afterpulsing(0.5, tau * 1e-10, dead * 1e-10, bin_width_s=1e-10).kernel(period) / 0.5


@pytest.mark.parametrize("tau, dead", [(7.0, 3.2), (300.0, 55.0), (0.01, 2.0), (25.0, 0.0)])
def test_kernel_against_random_delays(tau, dead):
    kernel = kernel_of(tau, dead)
    assert float(kernel.sum()) == pytest.approx(1, abs=1e-12)
    rng = np.random.default_rng(0)
    delays = rng.random(400_000) + dead + rng.exponential(tau, 400_000)
    seen = np.bincount(np.floor(delays).astype(int) % BINS, minlength=BINS)
    expected = 400_000 * kernel.numpy()
    use = expected > 5
    assert (((seen - expected) ** 2 / np.maximum(expected, 1))[use]).sum() / use.sum() < 1 + 5 * (2 / BINS) ** 0.5 + (
        use.sum() < 5
    )
    assert seen[~use].sum() <= 20


def test_geometric_sum_against_a_branching_process():
    rng, p, tau, dead, counts = np.random.default_rng(1), 0.2, 6.0, 4.0, 300_000
    h = np.zeros(BINS)
    h[5] = counts
    total, times = h.copy(), np.full(counts, 5)
    while times.size:
        # as in the model, every generation is spread evenly over its bin
        times = np.floor(times[rng.random(times.size) < p])
        times = times + rng.random(times.size) + dead + rng.exponential(tau, times.size)
        total += np.bincount(np.floor(times).astype(int) % BINS, minlength=BINS)
    kernel = kernel_of(tau, dead)
    found = add_afterpulses(torch.as_tensor(h).view(1, -1, 1, 1), p, kernel).flatten().numpy()
    assert found.sum() == pytest.approx(counts / (1 - p), rel=1e-12)
    z = (total - found)[found < counts] / np.sqrt(found[found < counts])
    assert np.abs(z).max() < 5


def test_window_shorter_than_the_period_loses_what_falls_outside():
    x = torch.zeros(1, 10, 1, 1, dtype=torch.float64)
    x[0, 2] = 1.0
    ap = Afterpulsing(0.1, 50e-10, 0.0, bin_width_s=1e-10, period_s=1e-7)
    y = ap(x)
    inside = 0.1 * (1 - math.exp(-7.5 / 50))  # from the middle of bin 2 to the end of the window
    assert float(y.sum() - 1) == pytest.approx(inside, rel=0.03)
    assert float(y.sum() - 1) > inside  # second generation and later periods
    with pytest.raises(UnitError, match="period"):
        Afterpulsing(0.1, 50e-10, 0.0, bin_width_s=1e-10, period_s=5e-10)(x)


def test_long_periods_are_wrapped_round_the_window():
    """A period longer than two windows is not transformed whole; the means are those of the whole period."""
    x = torch.rand(1, 16, 2, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    for period in (16, 32, 33, 40, 100):
        kernel = kernel_of(70, 20, period)
        whole = add_afterpulses(torch.nn.functional.pad(x, (0, 0, 0, 0, 0, period - 16)), 0.3, kernel)
        torch.testing.assert_close(add_afterpulses(x, 0.3, kernel), whole[:, :16])


def test_float32_keeps_the_faint_bins():
    x = torch.zeros(1, 1024, 1, 1)
    x[0, 100] = 1e6
    x[0, 500] = 1e-3
    ap = Afterpulsing(0.001, 10e-10, 20e-10, bin_width_s=1e-10)
    assert float(ap(x)[0, 500]) == pytest.approx(float(ap(x.double())[0, 500]), abs=1e-3)


def test_crosstalk_against_loops():
    x = torch.rand(2, 1, 3, 4, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    wanted = x.clone()
    for i in range(4):
        for j in range(5):
            for di in (-1, 0, 1):
                for dj in (-1, 0, 1):
                    weight = (0, 0.03, 0.01)[abs(di) + abs(dj)]
                    if 0 <= i + di < 4 and 0 <= j + dj < 5 and (di or dj):
                        wanted[..., i, j] += weight * x[..., i + di, j + dj]
    torch.testing.assert_close(add_crosstalk(x, 0.03, 0.01), wanted)


@pytest.mark.parametrize(
    "make, policy",
    [
        (lambda **k: Afterpulsing(0.05, 30e-10, 20e-10, bin_width_s=1e-10, learnable=True, **k), "gaussian"),
        (lambda **k: Crosstalk(0.05, learnable=True, **k), "score"),
    ],
    ids=["afterpulsing", "crosstalk"],
)
def test_policies_keep_the_gradient_of_what_passes(make, policy):
    """Loss: square of one bin. Exact: 2 y + (variance of what is added)', in the probability's logit."""
    module, draws = make(grad=policy), 30_000
    x = torch.full((draws, 1, 4, 2, 2), 40.0, dtype=torch.float64, requires_grad=True)
    with ScoreFunction() as score:
        y = module(x, generator=torch.Generator().manual_seed(0))
        losses = y[:, 0, 1, 0, 0] ** 2
    total = score.surrogate(losses, baseline="leave_one_out") if policy == "score" else losses
    (in_x, in_logit) = torch.autograd.grad(total.sum() / draws, [x, module.logit_probability], retain_graph=True)
    value = x[:1].detach().requires_grad_()
    extra = module.extra(value)[:, 0, 1, 0, 0]
    exact = ((value[:, 0, 1, 0, 0] + extra) ** 2 + extra).sum()
    wanted_x, wanted_logit = torch.autograd.grad(exact, [value, module.logit_probability])
    assert float(in_logit) == pytest.approx(float(wanted_logit), rel=0.06)
    assert float(in_x.sum(0)[0, 1, 0, 0]) == pytest.approx(float(wanted_x[0, 0, 1, 0, 0]), rel=0.02)


def test_samples_add_whole_counts():
    x = torch.full((1, BINS, 8, 8), 200.0)
    module = Afterpulsing(0.05, 30e-10, 20e-10, bin_width_s=1e-10, grad="straight_through")
    y = module(x, generator=torch.Generator().manual_seed(0))
    assert torch.equal(y, y.round())
    assert bool((y >= x).all())
    assert float(y.mean() / 200) == pytest.approx(1 / 0.95, rel=2e-3)


def test_hot_pixels():
    rates = hot_pixel_rates(200, 200, median_hz=50.0, hot_fraction=0.02, generator=torch.Generator().manual_seed(0))
    assert float(rates.median()) == pytest.approx(50.0, rel=0.03)
    assert float((rates > 1000).double().mean()) == pytest.approx(0.02, abs=0.004)
    with pytest.raises(UnitError, match="hot_fraction"):
        hot_pixel_rates(2, 2, median_hz=1.0, hot_fraction=2.0)


def test_crosstalk_is_a_binomial_number_of_every_neighbour():
    """Each of 4 neighbours is triggered with its own probability, independently; the rim sends nothing back."""
    n, p, ratio, images = 40, 0.2, 0.5, 30_000
    x = torch.zeros(images, 1, 1, 3, 3)
    x[..., 1, 1] = n
    x[..., 0, 2] = 7
    module = Crosstalk(p, diagonal_ratio=ratio)
    added = (module.sample(x, torch.Generator().manual_seed(0)) - x).double().view(images, 9)
    edges = {1: (n, 7), 5: (n, 7), 3: (n, 0), 7: (n, 0)}
    for pixel, (near, other) in edges.items():
        variance = (near + other) * p * (1 - p)
        assert float(added[:, pixel].mean()) == pytest.approx((near + other) * p, abs=5 * (variance / images) ** 0.5)
        # a Poisson number would have a variance larger by 1/(1 - p), 25 %
        assert float(added[:, pixel].var()) == pytest.approx(variance, rel=5 * (2 / images) ** 0.5)
    assert float(added[:, 0].var()) == pytest.approx(n * 0.1 * 0.9, rel=5 * (2 / images) ** 0.5)
    correlation = torch.corrcoef(added[:, [0, 3, 6, 7, 8]].T) - torch.eye(5)
    assert float(correlation.abs().max()) < 5 / images**0.5
    assert float(added[:, 4].mean()) == pytest.approx(7 * 0.1, rel=0.05)
    torch.testing.assert_close(module.variance(x)[0].flatten()[1], torch.tensor((n + 7) * p * (1 - p)))


@pytest.mark.parametrize("period_bins, tau, dead", [
        (40, 6.0, 4.0), pytest.param(64, 30.0, 2.5, marks=pytest.mark.slow),
        pytest.param(100, 0.4, 1.0, marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_afterpulses_are_followed_one_by_one(period_bins, tau, dead):
    """Mean of every bin, and the variance of the total: a geometric number per detection, p / (1 - p)^2."""
    n, p, pixels = 300, 0.3, 16_384
    x = torch.zeros(1, BINS, 128, 128)
    x[:, 5] = n
    x[:, 20] = 50
    module = Afterpulsing(p, tau * 1e-10, dead * 1e-10, bin_width_s=1e-10, period_s=period_bins * 1e-10)
    added = (module.sample(x, torch.Generator().manual_seed(0)) - x).double()
    assert float(added.min()) >= 0
    mean = module.extra(x.double()).mean((0, 2, 3)).clamp_min(0)
    assert bool(((added.mean((0, 2, 3)) - mean).abs() < 5.5 * (1.5 * mean / pixels).sqrt() + 1e-3).all())
    if period_bins == BINS:
        total = added.sum(1)
        assert float(total.mean()) == pytest.approx((n + 50) * p / (1 - p), rel=2e-3)
        assert float(total.var()) == pytest.approx((n + 50) * p / (1 - p) ** 2, rel=5 * (2 / pixels) ** 0.5)


def test_long_periods_are_placed_exactly():
    """Periods too long for single precision, and delays of many periods."""
    x = torch.zeros(1, 8, 64, 64)
    x[:, 0] = 100
    module = Afterpulsing(0.2, 1e-6, 1e-8, bin_width_s=1e-12, period_s=3e-7)
    added = module.sample(x, torch.Generator().manual_seed(0)) - x
    assert float(added.sum()) == pytest.approx(
        float(module.extra(x).sum()), abs=5 * float(module.extra(x).sum()) ** 0.5
    )
    assert torch.equal(added, added.round())


@pytest.mark.parametrize("make", [lambda: Crosstalk(0.05), lambda: Afterpulsing(0.05, 30e-10, 0.0, bin_width_s=1e-10)])
def test_means_and_floods_take_poisson_numbers(make):
    """Counts that are not whole, and too many to follow, still get whole numbers of the right mean."""
    for level in (0.7, 1e6):
        x = torch.full((1, BINS, 16, 16), level)
        added = make().sample(x, torch.Generator().manual_seed(0)).double() - x
        mean = make().extra(x.double())
        assert float(added.sum()) == pytest.approx(float(mean.sum()), abs=5 * float(mean.sum()) ** 0.5 + 1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "make", [lambda: Crosstalk(0.02), lambda: Afterpulsing(0.05, 30e-10, 20e-10, bin_width_s=1e-10)]
)
def test_draws_do_not_depend_on_the_number_of_threads(make):
    x = torch.poisson(torch.full((1, BINS, 64, 64), 5.0), generator=torch.Generator().manual_seed(1))
    threads, results = torch.get_num_threads(), []
    try:
        for n in (1, 2, 3):
            torch.set_num_threads(n)
            results.append(make().sample(x, torch.Generator().manual_seed(0)))
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(results[0], results[1]) and torch.equal(results[0], results[2])
