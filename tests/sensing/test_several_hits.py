"""Several detections in one cycle against events: means, draws, covariances, scores and the way back to the light."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from support.sensing.event_driven import compare, detect
from torchtransient import sensing

BINS = 24
WIDTH_S = 1e-10


def shapes(bins=BINS):
    """Rows with sum 1: a pulse in ambient light, light in the first and the last bin, one bright bin in the dark."""
    t = np.arange(bins)
    pulse = 0.3 / bins + np.exp(-0.5 * ((t - 0.6 * bins) / 2) ** 2) / 7
    ends = 0.3 / bins + 1.0 * ((t == 0) | (t == bins - 1))
    spike = (t == 5) * 1.0
    return {name: row / row.sum() for name, row in (("pulse", pulse), ("ends", ends), ("spike", spike))}


def image(row):
    return torch.as_tensor(np.asarray(row), dtype=torch.float64).reshape(1, -1, 1, 1)


def spad(dead, cycles=50, grad="expected"):
    return sensing.SynchronousSPAD(cycles, dead_time_s=dead * WIDTH_S, bin_width_s=WIDTH_S, grad=grad)


def slow(*values):
    return pytest.param(*values, marks=pytest.mark.slow)


CASES = [
    ("pulse", 1.0, 6.5), ("ends", 100.0, 0.6),
    *(slow(s, r, d) for s in ("ends", "spike") for r in (1.0, 100.0) for d in (0.83, 23.7)),
]  # fmt: skip


@pytest.mark.parametrize("shape, total, dead", CASES)
def test_means_and_draws_against_events(shape, total, dead, request):
    cycles = 40_000 if request.node.get_closest_marker("slow") else 6000
    rate = total * shapes()[shape]
    events = detect(np.random.default_rng(1), rate, cycles, 1, dead)
    sensor = spad(dead)
    agreement = compare(events, sensor.probabilities(image(rate)))
    assert agreement.within(1.5, exact=1e-5), agreement
    repeats = cycles // 50
    x = image(rate).unsqueeze(0).expand(repeats, 1, BINS, 1, 1)
    h = sensor.sample(x, torch.Generator().manual_seed(0)).view(repeats, BINS)
    assert torch.equal(h, h.round())
    # two noises of the same size; what was seen in none of the cycles may well happen three times in as many
    agreement = compare(events, h.mean(0).numpy() / 50)
    assert agreement.within(1.5 * 2**0.5, exact=1e-5 + 0.5 * 3 / len(events)), agreement
    # variance of bins and of totals, per cycle; a normal estimate has an error of sqrt(2 / n), rare counts more
    variance = sensor.variance(image(rate)).flatten().numpy() / 50
    seen = events.variance()
    fourth = ((events.counts - events.counts.mean(0)) ** 4).mean(0)
    assert np.all(np.abs(seen - variance) < 5 * np.sqrt(fourth / cycles) + 5 / cycles)
    totals = events.counts.sum(1)
    spread = ((totals - totals.mean()) ** 4).mean() / cycles
    error = 5 * (np.sqrt(spread) + totals.var() * np.sqrt(2 / repeats)) + 1e-3 * totals.mean()
    assert abs(h.sum(1).var().item() / 50 - totals.var()) < error


@pytest.mark.slow
@pytest.mark.parametrize("shape, total, dead", [("pulse", 30.0, 7.0), ("ends", 100.0, 0.6), ("spike", 60.0, 1.3)])
def test_bins_cut_or_not_give_the_same(shape, total, dead):
    """The solution with bins cut finer and finer, by hand."""
    row, pieces = total * shapes()[shape], 32
    fine = (
        sensing.detections_with_dead_time(image(np.repeat(row / pieces, pieces)), dead * pieces)
        .view(BINS, pieces)
        .sum(-1)
    )
    found = sensing.detections_with_dead_time(image(row), dead).flatten()
    assert float((found - fine).abs().sum() / fine.sum()) < 1e-5


def test_closed_form_of_constant_light():
    """Expected detections before the second can happen, and after it, are integrals that one can do by hand."""
    n, dead = 0.7, 3.4
    found = sensing.detections_with_dead_time(image(np.full(8, n)), dead).flatten().double()
    t = torch.arange(9, dtype=torch.float64)
    late = (t - dead).clamp_min(0)
    once = 1 - torch.exp(-n * t)
    twice = 1 - (1 + n * late) * torch.exp(-n * late)
    rest = (t - 2 * dead).clamp_min(0)
    thrice = 1 - (1 + n * rest + (n * rest) ** 2 / 2) * torch.exp(-n * rest)
    torch.testing.assert_close(found, (once + twice + thrice).diff(), rtol=0, atol=2e-5)


def test_gaussian_has_the_covariance_of_the_cycles():
    rate, cycles, draws, dead = 20 * shapes(10)["pulse"], 400, 6000, 1.3
    sensor = spad(dead, cycles, "gaussian")
    x = image(rate).unsqueeze(0).expand(draws, 1, 10, 1, 1)
    y = sensor(x, generator=torch.Generator().manual_seed(0)).view(draws, 10)
    counts = detect(np.random.default_rng(3), rate, 40_000, 1, dead).counts
    wanted = torch.as_tensor(np.cov(counts.T)) * cycles
    scale = torch.outer(wanted.diag(), wanted.diag()).sqrt()
    # noise of both, and what the smooth root near 0 takes
    assert bool(((torch.cov(y.T) - wanted).abs() < 5 * scale * (2 / draws) ** 0.5 + 0.05 * scale.diag().mean()).all())
    total = float(y.sum(1).var())
    assert total == pytest.approx(cycles * counts.sum(1).var(), rel=0.08)
    assert total < 0.75 * float(y.var(0).sum())  # independent bins would be wrong


def mixed(requires_grad=False):
    """Pixels whose bins are cut in 1, 4 and 32 pieces, and a dark one."""
    x = torch.stack([image(r * shapes(8)["ends"]).squeeze(0) for r in (0.5, 8.0, 60.0, 0.0)], -1).view(1, 8, 1, 4)
    return x.requires_grad_(requires_grad)


def test_pixels_of_all_levels():
    x = mixed()
    together = sensing.detections_with_dead_time(x, 1.3)
    for k in range(4):
        torch.testing.assert_close(
            together[..., k : k + 1], sensing.detections_with_dead_time(x[..., k : k + 1], 1.3), rtol=1e-12, atol=1e-14
        )
    stacked = torch.stack([x, x.flip(-1)])
    mapped = torch.func.vmap(lambda v: sensing.detections_with_dead_time(v, 1.3))(stacked)
    torch.testing.assert_close(mapped, sensing.detections_with_dead_time(stacked, 1.3), rtol=1e-12, atol=1e-14)
    with torch.no_grad():
        assert torch.equal(torch.func.vmap(lambda v: sensing.detections_with_dead_time(v, 1.3))(stacked), mapped)
    by_func = torch.func.grad(lambda v: sensing.detections_with_dead_time(v, 1.3).square().sum())(x)
    leaf = mixed(True)
    sensing.detections_with_dead_time(leaf, 1.3).square().sum().backward()
    torch.testing.assert_close(by_func, leaf.grad, rtol=1e-10, atol=1e-12)
    assert sensing.detections_with_dead_time(torch.zeros(0, 1, 8, 2, 2), 1.3).shape == (0, 1, 8, 2, 2)
    assert sensing.sample_detections(torch.zeros(0, 1, 8, 2, 2), 10, 1.3).shape == (0, 1, 8, 2, 2)


@pytest.mark.slow
def test_gradients():
    dead = 1.3
    x = mixed()[..., :2] + 0.01  # not cut, and cut
    x.requires_grad_()
    d = torch.tensor(dead, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(sensing.detections_with_dead_time, (x, d), check_forward_ad=True, fast_mode=True)
    assert torch.autograd.gradgradcheck(lambda v: sensing.detections_with_dead_time(v, dead), (x,), fast_mode=True)

    def noisy(v):
        return spad(dead, 50, "gaussian")(v, generator=torch.Generator().manual_seed(0))

    assert torch.autograd.gradcheck(noisy, (x,), fast_mode=True, nondet_tol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("total, dead", [(1.0, 1.3), (30.0, 7.9), (100.0, 2.2)])
def test_coates_undoes_the_mean(total, dead):
    rate, cycles = image(total * shapes()["pulse"]), 10_000
    sensor = spad(dead, cycles)
    estimate = sensor.inverse(sensor(rate))
    certain = rate < 20
    torch.testing.assert_close(estimate.rate[certain], rate[certain], rtol=1e-6, atol=1e-9)
    assert bool(estimate.valid[certain].all())
    if total == 1.0:  # nothing to put right: the gradient is that of the estimate
        counts = sensor(rate).requires_grad_()
        assert torch.autograd.gradcheck(
            lambda c: sensing.coates(c, cycles, dead).rate, (counts,), eps=1e-3, fast_mode=True
        )


def test_estimates_have_gradients_where_no_cycle_is_armed():
    """All ten are dead for three bins: nothing is known of these, and nothing is infinite."""
    counts = image([10.0, 0.4, 0.0, 6.0, 1.0]).requires_grad_()
    rate, valid = sensing.coates(counts, 10, 3.0)
    assert valid.flatten().tolist() == [False, False, False, True, True] and rate.flatten()[1:3].tolist() == [0.0, 0.0]
    assert bool(rate.isfinite().all())
    (slope,) = torch.autograd.grad(rate.sum(), counts)
    assert bool(slope.isfinite().all()) and bool((slope[:, 3:] != 0).all())


@pytest.mark.parametrize("total, dead, error", [(1.0, 0.6, 2e-3), (5.0, 2.6, 0.03), (20.0, 30.4, 2e-6)])
def test_the_likelihood_is_greatest_near_the_light(total, dead, error):
    """Newton's step from the truth, in counts without noise; second order in the photons of a bin.

    With a dead time beyond the window the formula is exact. What is left of the cycles, a share exp(-20), is then a
    difference of 1 and sums: eps exp(20) = 1e-7 of it is rounding.
    """
    rate = image(total * shapes()["pulse"]).requires_grad_()
    counts = spad(dead, 10_000)(rate).detach()
    (slope,) = torch.autograd.grad(
        sensing.first_photon_log_prob(counts, rate, 10_000, dead_bins=dead).sum(), rate, create_graph=True
    )
    (bend,) = torch.autograd.grad(slope.sum(), rate)
    step = (slope / bend / rate).detach().abs()
    assert float(step.max()) < error
    assert bool((bend < 0).all())


def test_log_prob_at_the_ends():
    """Nothing seen in the dark, and everything where all fire; nothing else is certain."""
    dark = sensing.first_photon_log_prob(torch.zeros(1, 6, 1, 1), torch.zeros(1, 6, 1, 1), 10, dead_bins=1.5)
    assert not dark.any()
    impossible = sensing.first_photon_log_prob(
        image([0, 1.0, 0, 0]), image([0, 0.0, 0, 0]), 10, dead_bins=1.5
    ).flatten()
    assert impossible[1] == -torch.inf
    sure = sensing.first_photon_log_prob(image([10.0, 0, 0, 0]), image([50.0, 0, 0, 0]), 10, dead_bins=2.0)
    assert abs(float(sure.flatten()[0])) < 1e-12


@pytest.mark.parametrize("total", [1.0, 15.0])
def test_the_derivative_of_coates_is_the_inverse_one(total):
    rate = total / 10 * (0.5 + torch.rand(1, 10, 1, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(1)))
    counts = 1000 * sensing.detections_with_dead_time(rate, 2.3)
    there = torch.autograd.functional.jacobian(lambda r: 1000 * sensing.detections_with_dead_time(r, 2.3), rate)
    back = torch.autograd.functional.jacobian(lambda n: sensing.coates(n, 1000, 2.3).rate, counts)
    product = back.reshape(10, 10) @ there.reshape(10, 10)
    torch.testing.assert_close(product, torch.eye(10, dtype=torch.float64), rtol=0, atol=1e-5)


@pytest.mark.parametrize("dead_bins", [None, 2.3])
def test_the_derivative_of_coates_in_bins_that_counted_nothing(dead_bins):
    def rate(n):
        return sensing.coates(n, 1000, dead_bins).rate.flatten()

    counts = torch.tensor([0.0, 40.0, 0.0, 0.0, 9.0, 0.0]).double().reshape(1, 6, 1, 1)
    found = torch.autograd.functional.jacobian(rate, counts).reshape(6, 6)
    for k, column in enumerate(found.T):
        step = torch.zeros_like(counts)
        step[0, k] = 1e-2
        # counts are not negative: one-sided, of second order
        wanted = (4 * rate(counts + step) - rate(counts + 2 * step) - 3 * rate(counts)) / 2e-2
        torch.testing.assert_close(column, wanted, rtol=1e-5, atol=1e-8)
