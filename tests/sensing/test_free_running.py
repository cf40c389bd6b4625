"""Free-running detection against photons one by one, a dense Markov matrix, and closed forms of constant light."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from support.marks import long, long_rows
from support.sensing.event_driven import arrivals, chi2_per_dof, dense_limit, detections, histogram, total_variation
from torchtransient.sensing import (
    FreeRunningSPAD,
    free_running_rate,
    nonparalyzable_histogram,
    paralyzable_histogram,
)

BINS = 64


def pulse(total=1.5, bins=BINS):
    t = np.arange(bins)
    shape = 0.5 / bins + np.exp(-0.5 * ((t - 0.4 * bins) / 3) ** 2) / 12
    return total * shape / shape.sum()


def as_image(row):
    return torch.as_tensor(row, dtype=torch.float64).reshape(1, -1, 1, 1)


@pytest.mark.parametrize("dead", [6.8, 64.2, 150.3])
def test_against_the_dense_markov_matrix(dead):
    rate = pulse(2.5)
    found = nonparalyzable_histogram(as_image(rate), dead).flatten().numpy()
    wanted, error = dense_limit(rate, dead, 4)
    # the straight lines add an error of third order in the rate of a bin, 0.25 here: r^3/600 measured, r^2/12 without
    np.testing.assert_allclose(found, wanted, rtol=0, atol=error + rate.max() ** 3 / 200 * wanted.max())


@pytest.mark.parametrize("kind", ["non_paralyzable", "paralyzable"])
@pytest.mark.parametrize("total, dead", [(1.5, 100.0), (4.0, 17.3)])
def test_against_photons_one_by_one(kind, total, dead):
    rate, periods = pulse(total), 45_000 if dead == 100.0 else 30_000
    rng = np.random.default_rng(7)
    spad = FreeRunningSPAD(periods, dead * 1e-10, bin_width_s=1e-10, kind=kind)
    expected = spad(as_image(rate)).flatten().numpy()
    seen = histogram(detections(arrivals(rng, rate, periods), dead, kind), BINS)
    if kind == "non_paralyzable":
        assert seen.sum() > 15_000
        assert total_variation(seen, expected) < 0.03
    # the noise of the oracle alone: TV of about sum sqrt(2 p (1-p) / (pi n)) / 2
    p = expected / expected.sum()
    noise = 0.5 * np.sqrt(2 * p * (1 - p) / (np.pi * seen.sum())).sum()
    assert total_variation(seen, expected) < 1.6 * noise
    assert chi2_per_dof(seen, expected) < 1 + 5 * (2 / BINS) ** 0.5
    assert seen.sum() == pytest.approx(expected.sum(), rel=4 / seen.sum() ** 0.5)
    if kind == "non_paralyzable" and dead == 40.0:
        assert total_variation(seen, rate) > 0.05  # the light itself is no answer


def test_tv_at_the_figure_of_the_reference():
    """1.5e4 detections: total variation below 0.03."""
    bins = 40
    rate, rng = pulse(1.2, bins), np.random.default_rng(0)
    seen = histogram(detections(arrivals(rng, rate, 26_000), 30.0)[:15_000], bins)
    expected = nonparalyzable_histogram(as_image(rate), 30.0).flatten().numpy()
    assert seen.sum() == 15_000
    assert total_variation(seen, expected) < 0.03
    assert total_variation(seen, rate) > 0.06


@pytest.mark.parametrize("dead", [30.0, 64.0, 700.0])
@pytest.mark.parametrize("rate", [1e-3, 0.02, 1.0, 50.0])
def test_constant_light(rate, dead):
    x = torch.full((1, BINS, 1, 1), rate, dtype=torch.float64)
    steady = torch.tensor(rate / 1e-10, dtype=torch.float64)
    for kind, found in (
        ("non_paralyzable", nonparalyzable_histogram(x, dead)),
        ("paralyzable", paralyzable_histogram(x, dead)),
    ):
        wanted = float(free_running_rate(steady, dead * 1e-10, kind)) * 1e-10
        torch.testing.assert_close(found, torch.full_like(x, wanted), rtol=1e-10, atol=0)


@pytest.mark.parametrize(
    ("dead", "solve"),
    # That of the other is in test_bright_light.py, by random directions.
    long_rows(
        itertools.product([5.3, 20.7], [nonparalyzable_histogram, paralyzable_histogram]),
        [(5.3, paralyzable_histogram)],
    ),
)
def test_gradients(solve, dead):
    x = as_image(pulse(2.0, 12)).clone().requires_grad_()
    d = torch.tensor(dead, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(solve, (x, d), check_forward_ad=True)


@pytest.mark.slow
def test_learnable_dead_time_is_found():
    rate = as_image(pulse(2.0))
    data = FreeRunningSPAD(1000, 40e-10, bin_width_s=1e-10)(rate)
    spad = FreeRunningSPAD(1000, 30e-10, bin_width_s=1e-10, learnable=True)
    optimiser = torch.optim.Adam(spad.parameters(), lr=0.03)
    for _ in range(120):
        optimiser.zero_grad()
        ((spad(rate) - data) ** 2).mean().backward()
        optimiser.step()
    assert float(spad.dead_time_s.detach()) == pytest.approx(40e-10, rel=0.01)


@pytest.mark.parametrize("dead", long([10.5, 25.2, 80.5], [10.5]))
def test_samples(dead):
    rate, cycles, repeats = as_image(pulse(2.0)), 300, 800
    spad = FreeRunningSPAD(cycles, dead * 1e-10, bin_width_s=1e-10, grad="straight_through")
    h = spad(rate.unsqueeze(0).expand(repeats, 1, BINS, 1, 1), generator=torch.Generator().manual_seed(0)).squeeze()
    mean, variance = spad.expected(rate).flatten(), spad.variance(rate).flatten()
    assert torch.equal(h, h.round())
    assert bool(((h.mean(0) - mean).abs() <= 5 * (variance / repeats).sqrt()).all())
    # every bin is binomial over the periods
    assert bool(((h.var(0) - variance).abs() <= 6 * variance * (2 / repeats) ** 0.5 + 0.05).all())


def test_dark_and_saturated_pixels():
    x = torch.zeros(1, 32, 1, 3, dtype=torch.float64)
    x[..., 1] = 1e-9
    x[..., 2] = 3.0
    x.requires_grad_()
    y = nonparalyzable_histogram(x, 20.0)
    assert not y[..., 0].any()
    torch.testing.assert_close(y[..., 1], x[..., 1], rtol=1e-6, atol=0)
    y.sum().backward()
    assert bool(torch.isfinite(x.grad).all())
    torch.testing.assert_close(x.grad[..., 0], torch.ones(1, 32, 1, dtype=torch.float64))


@pytest.mark.parametrize("dead", [0.5, 1.0, 2.5, 7.9])
def test_gradients_in_constant_light(dead):
    """Where neighbouring bins are equal, as under ambient light alone and in the dark."""
    for level in (0.3, 0.0):
        rate = torch.full((1, 5, 1, 1), level, dtype=torch.float64)
        rate[0, 3] += 0.2
        found = torch.autograd.functional.jacobian(lambda x: paralyzable_histogram(x, dead), rate)
        step, expected = 1e-5, []
        for k in range(5):
            change = torch.zeros_like(rate)
            change[0, k] = step
            # To one side alone: rates are not negative.
            one, two = (paralyzable_histogram(rate + n * change, dead) for n in (1, 2))
            here = paralyzable_histogram(rate, dead)
            expected.append((4 * one - two - 3 * here).flatten() / (2 * step))
        torch.testing.assert_close(found.view(5, 5), torch.stack(expected, 1), rtol=1e-6, atol=1e-8)
