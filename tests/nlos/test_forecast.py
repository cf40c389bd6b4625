"""Forecasts in words, seeds of parts, pairs as pixels of a sensor."""

from __future__ import annotations

import importlib

import torch

import torchtransient as tt
from torchtransient.nlos.renderer import measured
from torchtransient.nlos.work import seed_of
from torchtransient.sensing import Device

N = tt.nlos
simulation = importlib.import_module("torchtransient.nlos.simulation")
WALL = N.Wall.plane(2.0, 1.6)
SCAN = N.Scan.grid(WALL, (4, 3), kind="confocal")


def test_forecasts_are_a_few_lines():
    told = simulation.Forecast(
        "Scan(...)", (1, 300, 32, 32), 2**20, 150.1, 64, 4, "llvm_ad_mono, as asked for", "paths"
    )
    assert str(told).splitlines() == [
        "Scan(...)", "1 x 300 x 32 x 32: 1 MiB, about 3 min, 64 samples a point, in 4 parts",
        "variant: llvm_ad_mono, as asked for", "light: paths",
    ]  # fmt: skip
    short = simulation.Forecast("Scan(...)", (2,), 512, None, 64, 1, "v", "l")
    assert str(short).splitlines()[1] == "2: 0.5 KiB, 64 samples a point"


def test_seeds_of_parts_are_their_own():
    seeds = [seed_of(seed, number) for seed in (0, 1, 2**32 - 1) for number in range(100)]
    assert len(set(seeds)) == 300 and all(0 <= seed < 2**32 for seed in seeds)
    # Bits of all places are drawn.
    assert max(seeds) > 2**31 and min(seeds) < 2**25 and seed_of(1, 11) != seed_of(11, 1)


class Across(torch.nn.Module):
    """Adds up along the rows of a film, and says its shape."""

    def forward(self, transient, generator=None):
        self.shape, self.generator = tuple(transient.shape), generator
        return transient.cumsum(-1)


def test_every_pair_is_a_pixel_of_a_sensor():
    scan, generator = N.Scan.grid(WALL, (4, 3), kind="exhaustive", laser_grid=(2, 5)), torch.Generator()
    light = torch.rand(2, 1, 7, 5, 2, 3, 4, generator=torch.Generator().manual_seed(0))
    sensor = Across()
    found = measured(light, scan, sensor, generator)
    # Ten spots in a column, twelve sensor points in a row.
    assert sensor.shape == (2, 1, 7, 10, 12) and sensor.generator is generator and found.shape == light.shape
    torch.testing.assert_close(found.flatten(-2), light.flatten(-2).cumsum(-1))
    torch.testing.assert_close(measured(light[:, :, :, 0, 0], SCAN, sensor, None), light[:, :, :, 0, 0].cumsum(-1))
    assert sensor.shape == (2, 1, 7, 3, 4) and not isinstance(sensor, Device)
