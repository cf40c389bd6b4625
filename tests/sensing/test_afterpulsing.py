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
    afterpulse_kernel,
    hot_pixel_rates,
)

BINS = 40


@pytest.mark.parametrize("tau, dead", [(7.0, 3.2), (300.0, 55.0), (0.01, 2.0), (25.0, 0.0)])
def test_kernel_against_random_delays(tau, dead):
    kernel = afterpulse_kernel(tau * 1e-10, dead * 1e-10, 1e-10, BINS)
    assert float(kernel.sum()) == pytest.approx(1, abs=1e-12)
    delays = 0.5 + dead + np.random.default_rng(0).exponential(tau, 400_000)
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
    total, times = h.copy(), np.full(counts, 5.5)
    while times.size:
        # as in the model, every generation counts from the middle of its bin
        times = np.floor(times[rng.random(times.size) < p]) + 0.5
        times = times + dead + rng.exponential(tau, times.size)
        total += np.bincount(np.floor(times).astype(int) % BINS, minlength=BINS)
    kernel = afterpulse_kernel(tau * 1e-10, dead * 1e-10, 1e-10, BINS)
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
    "make",
    [
        lambda **k: Afterpulsing(0.05, 30e-10, 20e-10, bin_width_s=1e-10, learnable=True, **k),
        lambda **k: Crosstalk(0.05, learnable=True, **k),
    ],
    ids=["afterpulsing", "crosstalk"],
)
@pytest.mark.parametrize("policy", ["gaussian", "score"])
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
