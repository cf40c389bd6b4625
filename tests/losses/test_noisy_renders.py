"""Residuals of two renders, and schedules of samples."""

import math

import pytest
import torch

from torchtransient import losses
from torchtransient.errors import UnitError

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
