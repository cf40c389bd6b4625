"""Images whose pixels are different detectors: every pixel is measured as an image of its own would be."""

from __future__ import annotations

import pytest
import torch

from torchtransient.errors import ShapeError
from torchtransient.sensing import (
    Afterpulsing,
    AfterpulsingSPAD,
    FreeRunningSPAD,
    MacroPixel,
    PixelGroups,
    PixelSkew,
    SynchronousSPAD,
)

WIDTH, BINS = 1e-10, 20
DEAD = torch.tensor([[12.3, 7.0, 12.3], [30.0, 7.0, 9.9]], dtype=torch.float64)  # bins


def light(batch=2, scale=0.3):
    g = torch.Generator().manual_seed(0)
    return scale * torch.rand(batch, 1, BINS, 2, 3, dtype=torch.float64, generator=g)


def synchronous(cycles=300):
    return lambda d: SynchronousSPAD(cycles, dead_time_s=d, bin_width_s=WIDTH)


def free(d):
    return FreeRunningSPAD(300, d, bin_width_s=WIDTH)


def pulsing(d):
    return AfterpulsingSPAD(free(d), Afterpulsing([0.02, 0.03], [2e-9, 9e-9], d, bin_width_s=WIDTH))


@pytest.mark.parametrize(
    "make", [synchronous(), free, pytest.param(pulsing, marks=pytest.mark.slow), lambda d: MacroPixel(free(d), 9)]
)
def test_a_map_of_dead_times_is_a_detector_for_every_pixel(make):
    x = light(1)
    found = PixelGroups.by_value(DEAD * WIDTH, make).expected(x)
    for i in range(2):
        for j in range(3):
            alone = make(float(DEAD[i, j] * WIDTH)).expected(x[..., i : i + 1, j : j + 1])
            torch.testing.assert_close(found[..., i, j], alone[..., 0, 0], rtol=1e-9, atol=1e-12)


def test_draws_have_the_mean_of_their_pixel():
    sensor = PixelGroups.by_value(DEAD * WIDTH, synchronous(20))
    x = light(1).expand(3000, 1, BINS, 2, 3)
    y, mean = sensor.sample(x, torch.Generator().manual_seed(0)), sensor.expected(x[:1])
    assert torch.equal(y, y.round())
    assert bool(((y.mean(0) - mean[0]).abs() < 5 * (y.var(0) / 3000).sqrt() + 2e-3).all())


def test_probability_of_a_measurement():
    sensor, x = PixelGroups.by_value((DEAD + 0.5).floor() * WIDTH, synchronous(50)), light(1)
    counts = sensor.sample(x, torch.Generator().manual_seed(0))
    found = sensor.log_prob(counts, x)
    alone = synchronous(50)(30.0 * WIDTH).log_prob(counts[..., 1:, :1], x[..., 1:, :1])
    torch.testing.assert_close(found[..., 1, 0], alone[..., 0, 0])


def test_sensors_that_are_not_random():
    late = PixelGroups([PixelSkew(0.0, bin_width_s=WIDTH), PixelSkew(WIDTH, bin_width_s=WIDTH)], DEAD > 10)
    y = late(light())
    torch.testing.assert_close(y[..., 0, 1], light()[..., 0, 1])
    torch.testing.assert_close(y[..., 0, 0], light()[..., 0, 0].roll(1, -1))
    assert PixelGroups([PixelSkew(0.0, bin_width_s=WIDTH)], torch.zeros(2, 3))(light(0)).shape == (0, 1, BINS, 2, 3)


def test_images_that_do_not_fit():
    sensor = PixelGroups.by_value(DEAD * WIDTH, synchronous())
    with pytest.raises(ShapeError, match="which"):
        sensor(torch.ones(1, BINS, 3, 2))
