"""What a simulation is said to take, against a clock that counts samples; parts of a scan and of its samples."""

from __future__ import annotations

import importlib
import math
import warnings
from types import SimpleNamespace

import pytest
import torch

import torchtransient as tt
from torchtransient.errors import PhysicsWarning, StorageError
from torchtransient.nlos.answers import measured
from torchtransient.nlos.work import SceneWork, _listed, seed_of
from torchtransient.sensing import Device

N = tt.nlos
# Beside the function of that name.
forecast = importlib.import_module("torchtransient.nlos.forecast")
WALL = N.Wall.plane(2.0, 1.6)
SCAN = N.Scan.grid(WALL, (4, 3), kind="confocal")


@pytest.mark.parametrize(("count", "words"), [
    (0, "0 KiB"), (512, "0.5 KiB"), (2**20 - 2**10, "1023 KiB"), (2**20, "1 MiB"), (3 * 2**19, "1.5 MiB"),
    (2**30 - 2**20, "1023 MiB"), (2**30, "1 GiB"), (2**40 - 2**30, "1023 GiB"), (2**40, "1 TiB"), (5 * 2**42, "20 TiB"),
])  # fmt: skip
def test_bytes_in_words(count, words):
    assert forecast.size(count) == words


@pytest.mark.parametrize(("seconds", "words"), [
    (0.123, "0.12 s"), (2.345, "2.3 s"), (99.4, "99 s"), (100, "2 min"), (150.1, "3 min"), (5399, "90 min"),
    (5400, "1.5 h"), (36000, "10.0 h"),
])  # fmt: skip
def test_seconds_in_words(seconds, words):
    assert forecast.duration(seconds) == words


class Clocked:
    """Work whose clock goes on by a start and the cost of each sample."""

    def __init__(self, monkeypatch, spp, count, sums, start=0.5, cost=0.25, points=12):
        self.film, self.count, self.sums, self.scan = SimpleNamespace(spp=spp), count, sums, SCAN
        self.now, self.start, self.cost, self.asked, self.told = 100.0, start, cost, [], {"before"}
        self._points = points
        monkeypatch.setattr(forecast.time, "perf_counter", lambda: self.now)

    def run(self, number):
        return (0, math.prod(SCAN.sensor_shape)) if self.sums or self.count == 1 else (0, 12 // self.count)

    def renderer(self, number):
        return SimpleNamespace(scene=SimpleNamespace(warned=self.told))

    def render(self, number, seed, *, spp):
        warnings.warn("few samples see little", PhysicsWarning, stacklevel=2)
        self.told.add("of few samples")
        self.asked.append(spp)
        # Kernels are compiled in the first run of a number of samples.
        self.now += self.start + self.cost * spp + (7.0 if self.asked.count(spp) == 1 else 0.0)


@pytest.mark.parametrize(("spp", "count", "sums", "asked", "expected"), [
    # A whole scan: a 512th and a 128th of its samples.
    (16384, 1, False, [32, 128, 32, 128], 0.5 + 0.25 * 16384),
    # Four parts of three points each take as long as all of them four times.
    (16384, 4, False, [32, 128, 32, 128], 4 * (0.5 + 0.25 * 16384)),
    # Passes share the samples, and begin anew.
    (65536, 4, True, [32, 128, 32, 128], 4 * (0.5 + 0.25 * 16384)),
    # Sixteen are the fewest that tell something; of fewer all are rendered.
    (4096, 1, False, [16, 32, 16, 32], 0.5 + 0.25 * 4096), (2048, 1, False, [2048, 2048], 0.5 + 0.25 * 2048),
    (4, 1, False, [4, 4], 0.5 + 0.25 * 4), (6, 4, True, [1, 1], 4 * (0.5 + 0.25)),
])  # fmt: skip
def test_seconds_follow_from_few_samples(monkeypatch, recwarn, spp, count, sums, asked, expected):
    work = Clocked(monkeypatch, spp, count, sums)
    assert forecast._seconds(work) == pytest.approx(expected, rel=1e-12)
    assert work.asked == asked and work.told == {"before"} and len(recwarn) == 0


def test_seconds_do_not_fall_with_samples(monkeypatch):
    assert forecast._seconds(Clocked(monkeypatch, 16384, 1, False, cost=-1e-3)) == pytest.approx(0.5 - 0.128)


@pytest.mark.parametrize(("count", "sums", "most"), [(1, False, 1200), (4, False, 1500), (4, True, 2400)])
def test_captures_fit_beside_the_part_that_is_rendered(monkeypatch, count, sums, most):
    # A fourth of a capture in four parts, and as much again where passes are added up.
    work = Clocked(monkeypatch, 64, count, sums)
    monkeypatch.setattr(forecast, "available_bytes", lambda variant: most)
    forecast._check_fits(1200, (1, 25, 3, 4), work)
    monkeypatch.setattr(forecast, "available_bytes", lambda variant: most - 1)
    with pytest.raises(StorageError, match=rf"would take {most / 1024:.4g} KiB \(1 x 25 x 3 x 4 numbers\)"):
        forecast._check_fits(1200, (1, 25, 3, 4), work)
    monkeypatch.setattr(forecast, "available_bytes", lambda variant: None)
    forecast._check_fits(2**60, (1,), work)


def test_forecasts_are_a_few_lines():
    told = forecast.Forecast("Scan(...)", (1, 300, 32, 32), 2**20, 150.1, 64, 4, "llvm_ad_mono, as asked for", "paths")
    assert str(told).splitlines() == [
        "Scan(...)", "1 x 300 x 32 x 32: 1 MiB, about 3 min, 64 samples a point, in 4 parts",
        "variant: llvm_ad_mono, as asked for", "light: paths",
    ]  # fmt: skip
    short = forecast.Forecast("Scan(...)", (2,), 512, None, 64, 1, "v", "l")
    assert str(short).splitlines()[1] == "2: 0.5 KiB, 64 samples a point"


@pytest.mark.parametrize("spp, count", [(10, 4), (8, 4), (3, 3), (5, 1), (7, 2)])
def test_passes_share_all_samples(spp, count):
    work = object.__new__(SceneWork)
    work.film, work.count = SimpleNamespace(spp=spp), count
    shares = [work.share(number) for number in range(count)]
    assert sum(shares) == spp and max(shares) - min(shares) <= 1 and shares == sorted(shares, reverse=True)
    assert sum(work.weight(number) for number in range(count)) == pytest.approx(1.0, rel=1e-15)
    assert [work.weight(number) * spp for number in range(count)] == pytest.approx(shares)


def test_seeds_of_parts_are_their_own():
    seeds = [seed_of(seed, number) for seed in (0, 1, 2**32 - 1) for number in range(100)]
    assert len(set(seeds)) == 300 and all(0 <= seed < 2**32 for seed in seeds)
    # Bits of all places are drawn.
    assert max(seeds) > 2**31 and min(seeds) < 2**25 and seed_of(1, 11) != seed_of(11, 1)


@pytest.mark.parametrize("kind", ["single", "confocal", "exhaustive"])
def test_runs_of_points_are_lists(kind):
    scan = N.Scan.grid(WALL, (4, 3), kind=kind, laser_grid=(2, 1) if kind == "exhaustive" else None)
    part = _listed(scan, 5, 8)
    points = scan.sensor_points.reshape(-1, 3)[5:8]
    assert torch.equal(part.sensor_points, points) and part.kind == kind and part.wall is scan.wall
    assert torch.equal(part.sensor_normals, scan.sensor_normals.reshape(-1, 3)[5:8])
    if kind == "confocal":
        assert part.laser_points is part.sensor_points and torch.equal(part.laser_normals, part.sensor_normals)
    else:
        assert torch.equal(part.laser_points, scan.laser_points)
    bare = N.Scan.points(scan.sensor_points, kind="confocal", sensor_origin=(0, 0, 1), laser_origin=(0, 0, 1))
    assert _listed(bare, 0, 2).sensor_normals is None


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
