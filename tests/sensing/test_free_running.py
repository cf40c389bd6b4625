"""Free-running detection against photons one by one, a dense Markov matrix, and closed forms of constant light."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from support.marks import long_rows
from support.sensing.event_driven import dense_limit
from torchtransient.errors import GradientError
from torchtransient.sensing import coates, free_running_rate, nonparalyzable_histogram, paralyzable_histogram

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


@pytest.mark.parametrize("dead", [30.0, 64.0, 700.0])
@pytest.mark.parametrize("rate", [1e-3, 1.0, 50.0])
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
    long_rows([(20.7, nonparalyzable_histogram), (5.3, paralyzable_histogram)], [(5.3, paralyzable_histogram)]),
)
def test_gradients(solve, dead):
    x = as_image(pulse(2.0, 12)).clone().requires_grad_()
    d = torch.tensor(dead, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(solve, (x, d), check_forward_ad=True)


@pytest.mark.parametrize("dead", [3.0, 3.75])
def test_gradients_in_bins_without_light(dead):
    """Light is compared with that of next to none, where no rounding is in the way."""
    lit = torch.tensor([0.0, 0.11, 0, 0, 0.54, 0, 0.28, 0.16, 0, 0.1, 0.08, 0], dtype=torch.float64).view(1, -1, 1, 1)

    def slopes(x):
        return torch.autograd.functional.jacobian(lambda rate: nonparalyzable_histogram(rate, dead), x)

    torch.testing.assert_close(slopes(lit), slopes(lit.clamp_min(1e-7)), rtol=1e-5, atol=1e-5)


def test_second_derivatives_are_refused():
    """By `torch.autograd.grad` as well, which leaves nodes of torch's own refusal out."""
    x = as_image(pulse(2.0, 12)).clone().requires_grad_()
    for rate in (nonparalyzable_histogram(x, 3.4), coates(30 * x, 100, 2.3).rate):
        (gradient,) = torch.autograd.grad(rate.square().sum(), x, create_graph=True)
        with pytest.raises(GradientError, match="second derivatives"):
            torch.autograd.grad(gradient.sum(), x)
    # a gradient's derivative by its weights, which would be half of the tangent
    with pytest.raises(GradientError, match="forward_ad"):
        torch.autograd.functional.jvp(lambda rate: nonparalyzable_histogram(rate, 3.4), x.detach(), torch.ones_like(x))


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


@pytest.mark.parametrize("dead", [1.0, 7.9])
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
