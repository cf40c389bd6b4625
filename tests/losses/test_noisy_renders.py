"""Losses for noisy renders: expected roots against sums over all counts, residuals of two renders, running sums."""

from __future__ import annotations

import math

import pytest
import torch

from torchtransient import losses
from torchtransient.errors import UnitError


def over_counts(mean, function):
    """Mean of a function of Poisson counts of each mean (N,), summed over all counts that matter."""
    n = torch.arange(900, dtype=torch.float64)
    probability = (torch.xlogy(n, mean[:, None]) - mean[:, None] - torch.lgamma(n + 1)).exp()
    return (probability * function(n)).sum(1)


def test_expected_roots_are_means_over_counts():
    """From the dark over the end of the table, at 63.6, to 500 counts: values and slopes."""
    mean = torch.cat([torch.zeros(1), torch.logspace(-9, math.log10(500), 501), torch.linspace(63.5, 63.8, 31)])
    mean = mean.double().requires_grad_()
    found = losses.expected_anscombe(mean)
    torch.testing.assert_close(found, over_counts(mean, losses.anscombe), rtol=0, atol=1e-10)
    (slope,) = torch.autograd.grad(found.sum(), mean)
    wanted = over_counts(mean.detach(), lambda n: losses.anscombe(n + 1) - losses.anscombe(n))
    torch.testing.assert_close(slope, wanted, rtol=0, atol=1e-9)
    # single precision: four of its steps of the value
    single = losses.expected_anscombe(mean.detach().float())
    torch.testing.assert_close(single.double(), found.detach(), rtol=4 * 2**-24, atol=4 * 2**-24)


def test_expected_roots_of_many_counts():
    """Anscombe's expansion, whose next term is 1/(64 m^1.5) of the root."""
    mean = torch.tensor([1e3, 1e5, 1e8], dtype=torch.float64)
    wanted = 2 * (mean + 3 / 8).sqrt() - 1 / (4 * mean.sqrt())
    torch.testing.assert_close(losses.expected_anscombe(mean), wanted, rtol=0, atol=1e-5)
    assert float(losses.expected_anscombe(torch.tensor(math.inf))) == math.inf
    assert math.isnan(float(losses.expected_anscombe(torch.tensor(math.nan))))


def test_expected_roots_below_zero_and_derivatives():
    x = torch.tensor([-2.0, -1e-3, 0.0, 1e-12, 0.3, 5.0, 63.6, 63.7, 100.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(losses.expected_anscombe, x)
    slope = 2 * (math.sqrt(11 / 8) - math.sqrt(3 / 8))
    torch.testing.assert_close(
        losses.expected_anscombe(x[:1]), torch.tensor([2 * math.sqrt(3 / 8) - 2 * slope], dtype=torch.float64)
    )
    for dtype in (torch.uint8, torch.int64, torch.float16):
        found = losses.expected_anscombe(torch.tensor([0, 3, 90]).to(dtype))
        torch.testing.assert_close(found, losses.expected_anscombe(torch.tensor([0.0, 3.0, 90.0])))


@pytest.mark.parametrize("mean", [0.05, 40.0])
def test_which_mean_is_best(mean):
    """On average over counts the expected root's loss is least at the right mean, the plain root's beside it."""
    truth = torch.tensor([mean], dtype=torch.float64)
    variance = float(over_counts(truth, lambda n: losses.anscombe(n) ** 2) - over_counts(truth, losses.anscombe) ** 2)

    def slope(root):
        m = truth.clone().requires_grad_()
        (root(m) - over_counts(truth, losses.anscombe)).square().backward()
        return float(m.grad) / variance

    assert abs(slope(losses.expected_anscombe)) < 1e-9
    # of the plain root: 2 (m^-1/2)(1/(4 sqrt m)) = 1/(2 m) to first order
    assert slope(losses.anscombe) > 0.2 / max(mean, 1)


# ---------------------------------------------------------------------------------------------------------- two renders


def noisy(truth, seed, sigma=0.5):
    noise = torch.randn(truth.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return truth + sigma * noise


@pytest.mark.parametrize("dtype", [torch.float64, torch.complex128], ids=str)
def test_two_renders_are_unbiased(dtype):
    """100,000 elements: the squared error of the truth, where one render has its variance on top."""
    n = 100_000
    truth, target = torch.full((n,), 1.0, dtype=dtype), torch.full((n,), 0.7 if dtype.is_floating_point else 1 - 0.3j)
    target = target.to(dtype)

    def render(seed):
        if dtype.is_floating_point:
            return noisy(truth, seed)
        return torch.complex(noisy(truth.real, seed), noisy(truth.imag, seed + 100))

    parts = 1 if dtype.is_floating_point else 2
    # variance of (d + e)(d + f), both parts: 2 d^2 s^2 + s^4
    spread = math.sqrt((2 * 0.09 * 0.25 + parts * 0.0625) / n)
    assert float(losses.two_render_loss(render(1), render(2), target)) == pytest.approx(0.09, abs=4 * spread)
    alone = float(losses.squared_loss(render(1), target))
    assert alone == pytest.approx(0.09 + parts * 0.25, abs=8 * spread)
    assert float(losses.two_render_loss(render(1), render(2), truth).abs()) < 4 * spread  # near zero of either sign


# --------------------------------------------------------------------------------------------------------- the schedule


def test_the_schedule_doubles():
    schedule = losses.SampleSchedule(64, 512, 100)
    assert [schedule(k) for k in (0, 59, 60, 73, 74, 87, 99, 100, 1000)] == [64, 64, 128, 128, 256, 512, 512, 512, 512]
    assert [losses.SampleSchedule(16, 100, 10, hold=0.0)(k) for k in (0, 4, 7, 9)] == [32, 64, 100, 100]
    assert losses.SampleSchedule(64, 100, 10)(10) == 100  # no power of two times 64: the end is what was asked for
    assert losses.SampleSchedule(32, 32, 5)(3) == 32 and losses.SampleSchedule(32, 64, 5, hold=1.0)(4) == 32


def test_samples_that_are_needed():
    needed = losses.SampleSchedule.needed
    assert [needed(64, bias, 1.0) for bias in (-3.0, 0.0, 1.0, 1.5, 2.0, 7.9)] == [64, 64, 64, 128, 128, 512]
    assert needed(64, 2.0**26, 1.0) == 2**32 and needed(64, -1e300, 1e-300) == 64
    for call in (
        lambda: needed(64, 1e300, 1e-300),  # more than there are; the quotient is infinite
        lambda: needed(64, 2.0**27, 1.0),
        lambda: needed(64, 1.0, 0.0),
        lambda: losses.SampleSchedule(64, 32, 10),
        lambda: losses.SampleSchedule(1, 32, 10, hold=1.5),
    ):
        with pytest.raises(UnitError, match="SampleSchedule"):
            call()


# --------------------------------------------------------------------------------------------------------- running sums


def test_the_area_between_running_sums():
    """Light that is late costs its delay, light that is missing its way to the end of the window."""
    a, b = torch.zeros(1, 1, 10, 1, 1), torch.zeros(1, 1, 10, 1, 1)
    a[0, 0, 2], b[0, 0, 5] = 3.0, 3.0
    assert float(losses.cumulative_loss(a, b, 0.02)) == pytest.approx(3 * 3 * 0.02)
    assert float(losses.cumulative_loss(a, 0 * b, 0.02)) == pytest.approx(3 * 8 * 0.02)
    assert float(losses.cumulative_loss(a, 2 * a, 0.02)) == pytest.approx(3 * 8 * 0.02)
    assert float(losses.cumulative_loss(a, b, 0.02, per_root_count=True)) == pytest.approx(9 * 0.02 / math.sqrt(3))
    assert float(losses.cumulative_loss(a, 0 * b, 0.02, per_root_count=True)) == pytest.approx(24 * 0.02)
    # of equal sums the Wasserstein distance times the light
    torch.testing.assert_close(losses.cumulative_loss(a, b, 0.02), 3 * losses.wasserstein_loss(a, b, 0.02))


def test_running_sums_pull_from_any_distance():
    """The slope of a pulse that is 90 bins off is that of one at 10 bins, and that of a squared difference none."""
    t = torch.arange(100, dtype=torch.float64)

    def pulse(at):
        return torch.exp(-0.5 * (t - at) ** 2).reshape(1, 100, 1, 1)

    for offset in (10.0, 40.0, 85.0):
        at = torch.tensor(5.0 + offset, dtype=torch.float64, requires_grad=True)
        (pull,) = torch.autograd.grad(losses.cumulative_loss(pulse(at), pulse(5.0), 0.02), at)
        assert float(pull) == pytest.approx(0.02 * math.sqrt(2 * math.pi), rel=1e-6)
        (none,) = torch.autograd.grad(losses.squared_loss(pulse(at), pulse(5.0), reduction="sum"), at)
        assert abs(float(none)) < 1e-8
