"""What a contact sheet shows of a sample, what a forecast says, number by number; arrays of samples."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch
from PIL import Image

import torchtransient as tt
from torchtransient.data import Sample
from torchtransient.data.checks import Cost, StructureCost
from torchtransient.data.overview import cell_of
from torchtransient.data.sample import OutsideLight, in_order
from torchtransient.errors import SceneError
from torchtransient.vis.tone_mapping import tone_map

RANDOM = np.random.default_rng(3)


def sample(values=None, index=7, **arrays):
    return Sample(index, 1, arrays=arrays, values=values or {})


def numbers(*shape):
    return RANDOM.random(shape, dtype=np.float32) + 0.1


def shown(light):
    """Linear light (3, H, W) as it is shown, (H, W, 3)."""
    return np.asarray(tone_map(torch.from_numpy(np.ascontiguousarray(light, np.float32))))


def grey(light):
    return shown(np.stack([light.mean(0)] * 3))


# ---------------------------------------------------------------------------------------------------------- pictures


def test_the_steady_image_is_the_picture():
    three, two = numbers(3, 4, 5), numbers(2, 4, 5)
    assert np.array_equal(cell_of(sample(steady=three, transient=numbers(3, 2, 4, 5))).images["light"], shown(three))
    assert np.array_equal(cell_of(sample(steady=two)).images["light"], grey(two))
    # The first sensor's, and of Stokes vectors the intensity.
    several = numbers(2, 4, 3, 4, 5)
    assert np.array_equal(cell_of(sample(steady=several)).images["light"], shown(several[0, 0]))


@pytest.mark.parametrize("name", ["transient", "phasor", "gated", "measurement"])
def test_light_of_all_times_is_the_picture_otherwise(name):
    cube = numbers(3, 6, 4, 5) - 0.6
    if name == "phasor":
        cube = cube + 1j * numbers(3, 6, 4, 5)
    expected = shown(np.abs(cube).sum(1))
    assert np.array_equal(cell_of(sample(**{name: cube})).images["light"], expected)
    stokes = np.stack([cube, 2 * cube, cube, cube])
    assert np.array_equal(cell_of(sample(**{name: stokes})).images["light"], expected)
    assert list(cell_of(sample(**{name: cube})).images) == ["light"]


def test_scans_are_tables():
    """Pairs of points by laser and sensor; a list of points is a row. What such a film calls steady is not shown."""
    pairs, points = numbers(1, 6, 2, 3, 4, 5), numbers(1, 6, 7)
    light = cell_of(sample(transient=pairs), 4).images["light"]
    assert np.array_equal(light, grey(pairs.sum(1).reshape(1, 6, 20)))
    assert np.array_equal(cell_of(sample(transient=points), 1).images["light"], grey(points.sum(1)[:, None]))
    with_steady = sample(transient=points, steady=numbers(1, 4, 5))
    assert np.array_equal(cell_of(with_steady, 1).images["light"], grey(points.sum(1)[:, None]))


def test_labels():
    normals, albedo = numbers(3, 4, 5) * 3 - 1.7, numbers(3, 4, 5) * 2 - 0.5
    two, depth = numbers(2, 4, 5), numbers(3, 4, 5)
    images = cell_of(
        sample(normals=np.stack([normals, -normals]), albedo=albedo, depth=depth, shape=depth[0], uv=two, position=two,
               place=numbers(3))
    ).images  # fmt: skip
    assert list(images) == ["light", "normals", "albedo", "depth", "shape"]
    assert np.array_equal(images["normals"], np.clip((normals + 1) / 2, 0, 1).transpose(1, 2, 0))
    assert np.array_equal(images["albedo"], np.clip(albedo, 0, 1).transpose(1, 2, 0))
    assert np.array_equal(images["depth"], depth[0]) and np.array_equal(images["shape"], depth[0])
    found = cell_of(sample(albedo=two)).images["albedo"]
    assert found.shape == (4, 5, 3)
    assert np.array_equal(found, np.clip(np.repeat(two.mean(0)[..., None], 3, -1), 0, 1))


def test_curves_are_sums_over_channels_and_pixels():
    cube = numbers(3, 6, 4, 5)
    for arrays in ({"transient": cube, "measurement": 2 * cube}, {"transient": cube[None]}, {"measurement": cube}):
        curve = cell_of(sample(**arrays)).curve
        assert curve.dtype == np.float64
        np.testing.assert_allclose(curve, cube.sum((0, 2, 3), dtype=np.float64), rtol=1e-12)
    assert cell_of(sample(phasor=cube)).curve is None
    assert cell_of(sample(transient=cube), 4).curve is None


@pytest.mark.parametrize("name", ["rates", "beats"])
def test_rows_are_added_up(name):
    light = numbers(1, 4, 6, 2, 3)
    velocity = np.stack([np.full((2, 3), v, np.float32) for v in (0.0, 3.0, 4.0)])
    cell, plain = cell_of(sample(velocity=velocity, **{name: light})), cell_of(sample(transient=light.sum(1)))
    np.testing.assert_allclose(cell.curve, plain.curve, rtol=1e-6)
    np.testing.assert_allclose(cell.images["light"], plain.images["light"], atol=1e-5)
    np.testing.assert_allclose(cell.images["velocity"], 5.0)


# Of films, whose pixels come first in memory: colour in large blocks, of several cameras, rows and columns that are no
# axis, and small ones.
FILMS = [
    ((16, 24, 64, 3), (3, 2, 0, 1)), ((4, 16, 24, 64, 3), (0, 4, 3, 1, 2)), ((24, 16, 128, 1), (3, 2, 1, 0)),
    ((160, 120, 3), (2, 0, 1)), ((4, 4, 8, 1), (3, 2, 0, 1)), ((1, 128, 16, 24), (0, 1, 2, 3)),
]  # fmt: skip


@pytest.mark.parametrize(("shape", "order"), FILMS)
def test_arrays_are_in_the_order_of_c(shape, order):
    tensor = torch.randn(shape, generator=torch.Generator().manual_seed(1)).permute(order)
    found = in_order(tensor)
    assert found.flags.c_contiguous and np.array_equal(found, tensor.contiguous().numpy())


# -------------------------------------------------------------------------------------------------------------- costs


def cost(**more):
    settings = {
        "values": ("a", "b"), "exchanged": ("c",), "seen": 2, "sample_bytes": 2000,
        "outside": OutsideLight(samples=64, cut=16, mean=0.0123, most=0.25),
        "structures": (StructureCost("c=x", 3.0, 0.5), StructureCost("", 1.0, 0.25)), "n": 7200,
        "standard_error": 0.125, "stored_bytes": {"exact": 1500.0, "rounded": 500.0, "counts": None},
    }  # fmt: skip
    return Cost(**settings | more)


def test_seconds_of_a_sample():
    """Of two structures in 64 samples each is built once in a shard of 64; the first one may have compiled."""
    assert cost().sample_s == pytest.approx(2 / 64 * 1.0 + 62 / 64 * 0.375)
    assert cost(seen=1).sample_s == 0.375
    three = (*cost().structures, StructureCost("", 2.0, 0.75))
    assert cost(seen=32, structures=three).sample_s == pytest.approx(0.5 * 1.5 + 0.5 * 0.5)


@pytest.mark.parametrize("n", [1, 10, 100, 270, 1000, 7200, 10**6])
def test_time_and_bytes_of_a_data_set_are_those_of_its_samples(n):
    """In plain numbers of two figures and three; bytes from the smallest store to what is not compressed."""
    units = {"seconds": 1, "minutes": 60, "hours": 3600, "B": 1, "kB": 1e3, "MB": 1e6, "GB": 1e9}
    said = re.findall(rf"([\d.]+) ({'|'.join(units)})\b", str(cost(n=n)).splitlines()[-1])
    seconds, least, most = (float(number) * units[unit] for number, unit in said)
    assert seconds == pytest.approx(n * cost().sample_s, rel=0.05)
    assert (least, most) == pytest.approx((n * 500.0, n * 2000.0), rel=0.005)


# ----------------------------------------------------------------------------------------------------------- of recipes


D = tt.data


@pytest.fixture(scope="module")
def recipe():
    scene = tt.scenes.cornell_box(resolution=16, num_bins=64, bin_width_opl=0.2, start_opl=2.0)
    vary = {
        "red.reflectance.value": D.Uniform(0.05, 0.9),
        "small-box.to_world": D.Turn(),
        "small-box.type": D.Choice(["cube", "sphere"]),
    }
    return D.Recipe(scene, vary, variant="llvm_ad_rgb", spp=4, labels=("depth", "normals"), n=1000)


@pytest.mark.slow
def test_cost(recipe):
    cost = recipe.cost(2)
    assert cost.values == ("red.reflectance.value", "small-box.to_world") and cost.exchanged == ("small-box.type",)
    assert cost.seen == 2 and [one.text for one in cost.structures] == ["small-box.type=cube", "small-box.type=sphere"]
    sample = recipe.sample(0)
    assert cost.sample_bytes == sum(array.nbytes for array in sample.arrays.values())
    assert 0 < cost.stored_bytes["rounded"] < cost.stored_bytes["exact"] < cost.sample_bytes
    # A histogram of radiances is no number of photons.
    assert cost.stored_bytes["counts"] is None
    assert cost.outside.samples == 64 and 0 <= cost.outside.mean <= cost.outside.most < 1
    assert 0 < cost.standard_error < 3 and all(one.sample_s > 0 for one in cost.structures)
    assert "built when new    small-box.type; 2 structures in 64 samples" in str(cost)


@pytest.mark.slow
def test_preview_is_a_picture(recipe, tmp_path):
    recipe.preview(4, tmp_path / "sheet.png")
    picture = np.asarray(Image.open(tmp_path / "sheet.png").convert("RGB"))
    assert min(picture.shape[:2]) > 200 and picture.std() > 20
    with pytest.raises(SceneError, match="whole number"):
        recipe.preview(0)
