"""Samples of recipes in shards: windows of time are cut where the time is, whatever the film, the sensors, the scan."""

from __future__ import annotations

import numpy as np
import pytest

import torchtransient as tt

D = tt.data
VARIANT = "llvm_ad_mono"


def box(**more):
    scene = tt.scenes.cornell_box(resolution=8, num_bins=8, bin_width_opl=1.5, start_opl=2.0)
    return scene | more


def scans(kind):
    wall = tt.nlos.Wall.plane(width=1.0, height=1.0)
    return tt.nlos.Scan.grid(wall, (8, 2), kind=kind)


def plate(scan, **settings):
    facing_the_wall = tt.scenes.transforms.translate([0, 0, 0.8]) @ tt.scenes.transforms.rotate([0, 1, 0], 180)
    hidden = {"plate": {"type": "rectangle", "to_world": facing_the_wall}}
    return D.Recipe(hidden, {}, scan=scan, variant=VARIANT, time_axis=tt.TimeAxis(0, 0.5, 8), spp=4, **settings)


# As many bins as rows: sizes do not tell which axis is the time.
RECIPES = {
    "one sensor": lambda: D.Recipe(box(), {}, variant=VARIANT, spp=2, labels=["depth"]),
    "polarized, two sensors": lambda: D.Recipe(
        box(eye=box()["sensor"]), {}, variant=f"{VARIANT}_polarized", spp=2, sensors="all"
    ),
    "confocal": lambda: plate(scans("confocal")),
    "exhaustive": lambda: plate(scans("exhaustive")),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", RECIPES)
def test_windows(kind, tmp_path):
    recipe = RECIPES[kind]()
    maker = recipe.maker()
    sample = maker.sample(0)
    with D.ShardWriter(tmp_path / "shard-000000.h5", 1, {"about": maker.about(), "shard": 0}) as shard:
        shard.put(0, sample)
    data = D.TransientDataset(tmp_path, window=slice(2, 5))
    place = sample.arrays["transient"].ndim - 1 - maker.about()["behind_time"]
    assert sample.arrays["transient"].shape[place] == 8 and data.axis.num_bins == 3
    expected = np.take(sample.arrays["transient"], range(2, 5), axis=place)
    assert np.array_equal(data[0]["transient"].numpy(), expected) and expected.any()
    for name in set(sample.arrays) - {"transient"}:
        assert data[0][name].shape == sample.arrays[name].shape, name
