"""What a contact sheet shows of a sample and what a forecast says, number by number. Nothing is rendered."""

from __future__ import annotations

import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from torchtransient.array_files.part_files import sweep_parts
from torchtransient.data.generation import latest_picture
from torchtransient.data.generation.latest_picture import LatestPicture, picture_of
from torchtransient.data.recipes import contact_sheet as contact_sheets
from torchtransient.data.recipes import forecast as forecasts
from torchtransient.data.recipes.contact_sheet import behind_time, cell_of, sheet_of
from torchtransient.data.recipes.forecast import Cost, StructureCost, _bytes, _duration, forecast
from torchtransient.data.recipes.outside_light import OutsideLight
from torchtransient.data.recipes.sample import Sample, in_order
from torchtransient.data.recipes.structures import Structure
from torchtransient.data.storage.shard_writing import ShardWriter
from torchtransient.errors import TorchTransientWarning
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


# ------------------------------------------------------------------------------------------------------------ titles


def test_titles_name_three_values():
    values = {
        "red.reflectance.value": np.array([0.123, 0.4, 5.0]),
        "wall.bsdf.alpha.value": np.array(0.25),
        "grid.data": np.zeros(4),
        "value.data": np.array(1234.0),
        "box.inner.filename": "a.ply",
    }
    assert cell_of(sample(values)).title == "7  red 0.12, 0.4, 5, wall.alpha 0.25, value.data 1.2e+03"
    assert cell_of(sample({"box.inner.filename": "a.ply"}, index=12)).title == "12  box.filename a.ply"
    assert cell_of(sample({"a": "x" * 24})).title == "7  a " + "x" * 24
    assert cell_of(sample({"a": "0123" + "x" * 21})).title == "7  a ..." + "x" * 21


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


def test_without_light_the_picture_is_black():
    found = cell_of(sample(depth=numbers(4, 5)))
    assert found.images["light"].tolist() == [[[0, 0, 0]]] and found.curve is None


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
    np.testing.assert_allclose(cell_of(sample(measurement=cube[0]), 1).curve, cube[0].sum((0, 2)), rtol=1e-6)


def test_a_sheet_of_samples(monkeypatch):
    """Over the edges of the bins, in metres."""
    drawn = []
    monkeypatch.setattr(contact_sheets, "draw", lambda cells, path, **more: drawn.append((cells, path, more)))
    axis = {"start_opl": 1.0, "bin_width_opl": 0.5, "num_bins": 3}
    for given in (axis, None):
        sheet_of([sample(transient=numbers(3, 7, 2)), sample(index=9)], "path", given, "title", 1)
        (first, second), path, more = drawn.pop()
        assert (first.title, second.title, path, more["title"]) == ("7  ", "9  ", "path", "title")
        assert first.curve.shape == (7,)
        assert more["times"] is None if given is None else more["times"].tolist() == [1, 1.5, 2, 2.5]
    assert behind_time({}) == 2 and behind_time({"behind_time": 4}) == 4


# -------------------------------------------------------------------------------------------------------- last picture


def test_the_last_picture_is_about_256_pixels_wide():
    """Every pixel as a square of whole pixels; pictures that are larger stay as they are."""
    assert picture_of(sample(steady=numbers(3, 20, 33))).shape == (140, 231, 3)
    assert picture_of(sample(steady=numbers(3, 300, 2))).shape == (300, 2, 3)
    assert picture_of(sample(steady=numbers(3, 2, 1))).shape == (256, 128, 3)


def test_the_last_picture_is_written_every_ten_seconds(tmp_path, monkeypatch):
    clock, saved = SimpleNamespace(now=50.0), []
    monkeypatch.setattr(latest_picture.time, "monotonic", lambda: clock.now)
    monkeypatch.setattr(latest_picture, "picture_of", lambda one: one)

    def save(one, path):
        if one == "broken":
            path.write_text("half")
            raise ValueError("no picture")
        saved.append((one, clock.now))
        path.write_text(one)

    monkeypatch.setattr(latest_picture, "_save", save)
    picture = LatestPicture(tmp_path)
    for now, one in ((50.0, "a"), (59.9, "b"), (60.0, "broken"), (659.0, "c")):
        clock.now = now
        monkeypatch.setattr(latest_picture.time, "time", lambda: (tmp_path / "latest.png").stat().st_mtime + 11)
        picture(one)
    assert saved == [("a", 50.0)]
    assert [path.name for path in tmp_path.iterdir()] == ["latest.png"]
    clock.now = 660.0
    picture("d")
    assert (tmp_path / "latest.png").read_text() == "d"
    # Another process has just written one, or has a clock that is behind.
    for offset, expected in ((9.9, "d"), (-9.9, "d"), (-10.0, "e")):
        clock.now += 10
        monkeypatch.setattr(latest_picture.time, "time", lambda by=offset: latest_time(tmp_path) + by)
        picture("e")
        assert (tmp_path / "latest.png").read_text() == expected
    clock.now += 10
    monkeypatch.setattr(latest_picture.time, "time", lambda: latest_time(tmp_path) + 10)
    picture("f")
    assert (tmp_path / "latest.png").read_text() == "f"


def test_a_last_picture_whose_writer_was_killed_is_swept(tmp_path, monkeypatch):
    """And not while its writer lives."""
    (tmp_path / "killed").mkdir()
    swept = []

    def save(_, path):
        path.write_text("half")
        shutil.copy(path, tmp_path / "killed")
        swept.extend([sweep_parts(tmp_path), [found.name for found in sweep_parts(tmp_path / "killed")], [path.name]])

    monkeypatch.setattr(latest_picture, "picture_of", lambda one: one)
    monkeypatch.setattr(latest_picture, "_save", save)
    LatestPicture(tmp_path)("a")
    assert swept[0] == [] and swept[1] == swept[2]
    assert (tmp_path / "latest.png").read_text() == "half"


def latest_time(folder):
    return (folder / "latest.png").stat().st_mtime


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


def test_a_forecast_in_words():
    assert str(cost()).splitlines() == [
        "only values       a, b",
        "built when new    c; 2 structures in 64 samples",
        "seconds           3.00 for the first sample, then 0.5000 each (c=x)",
        "seconds           1.00 for the first sample, then 0.2500 each",
        "bytes a sample    2 kB before compression",
        "  store='exact'    1.5 kB, 1.3 times smaller",
        "  store='rounded'  500 B, 4.0 times smaller",
        "light outside     more than 1% in 16 of 64 samples, 1.23% on average, 25.00% at most; more than 1% in 16.0% "
        "to 36.8% of all samples (95% confidence)",
        "standard error    12.5% of a sample's numbers (root mean square)",
        "7200 samples    47.3 minutes of one worker, 3.6 MB to 14.4 MB",
    ]
    alone = str(cost(values=(), exchanged=(), n=None)).splitlines()
    assert alone[0].endswith("none") and alone[1].endswith("nothing: one structure for all samples")
    assert len(alone) == 9
    unseen = OutsideLight.of([], ["sample 0: bad", "sample 1: bad"])
    assert "light outside     not looked at; 2 of 2 samples failed" in str(cost(outside=unseen))
    with pytest.warns(TorchTransientWarning, match="recipe: 2 of 2 samples .* failed .*The first one: sample 0: bad"):
        unseen.warn("recipe")


@pytest.mark.parametrize(
    ("hours", "words"),
    [
        (1.0, "1.00 hours"),
        (30.5, "30.50 hours"),
        (0.75, "45.0 minutes"),
        (1 / 60, "1.0 minutes"),
        (0.0125, "45 seconds"),
    ],
)
def test_durations(hours, words):
    assert _duration(hours) == words


@pytest.mark.parametrize(
    ("size", "words"), [(999, "999 B"), (1000, "1 kB"), (2.5e6, "2.5 MB"), (999e9, "999 GB"), (3.25e15, "3.25e+03 TB")]
)
def test_sizes(size, words):
    assert _bytes(size) == words


def test_a_forecast_is_of_what_was_measured(monkeypatch):
    """From nothing to the first sample of a structure, then the median of those that are launched."""
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(forecasts.time, "perf_counter", lambda: clock.now)
    monkeypatch.setattr(forecasts, "_stored", lambda samples, maker: {"exact": float(len(samples))})
    called = []
    seconds = iter([9.0, 5.0, 4.0, 1.0, 2.0, 4.0, 8.0, 5.0, 4.0, 3.0, 0.5, 0.25, 7.0, 1.0, 1.0, 2.0, 2.0, 2.0])

    def make(index):
        clock.now += next(seconds)
        called.append(index)
        return Sample(index, 0, arrays={"a": np.zeros((2, 3 + index), np.float32), "b": np.zeros(5)})

    def of(index):
        return 2 if index == 63 else index % 2

    bars = []
    bar = SimpleNamespace(update=lambda: bars.append("one more"), close=lambda: bars.append("closed"))
    monkeypatch.setattr("tqdm.auto.tqdm", lambda total, **more: bars.append(total) or bar)
    recipe = SimpleNamespace(
        vary={"a": 1, "c": 2}, exchanged=["c"], n=5, scenes=SimpleNamespace(names=[""]),
        structure=lambda index: Structure("", f"c={of(index)}", (("c", of(index)),)),
    )  # fmt: skip
    maker = SimpleNamespace(sample=make, forget=lambda structure: called.append(structure.text),
                            standard_error=lambda index: 0.5 + index)  # fmt: skip
    outside = OutsideLight.of([])
    found = forecast(recipe, maker, 3, progress=True, outside=outside)
    assert called == ["c=0", 0, 2, 4, 6, 8, 10, "c=1", 1, 3, 5, 7, 9, 11, "c=2", *[63] * 6]
    assert bars == [18, *["one more"] * 18, "closed"]
    assert found == Cost(
        values=("a",), exchanged=("c",), seen=3, sample_bytes=24 + 40, stored_bytes={"exact": 18.0}, n=5,
        structures=(StructureCost("c=0", 9.0, 2.0), StructureCost("c=1", 8.0, 0.5), StructureCost("c=2", 7.0, 2.0)),
        outside=outside, standard_error=0.5,
    )  # fmt: skip


def test_bytes_on_disk_are_those_of_a_shard(tmp_path):
    """Of different samples, each once; histograms of radiances cannot be stored as counts."""
    samples = [sample(index=n, transient=numbers(2, 16, 4, 5)) for n in (3, 4)]
    maker = SimpleNamespace(about=lambda: {"behind_time": 2})
    found = forecasts._stored([*samples, samples[0]], maker)
    assert set(found) == {"exact", "rounded", "counts"} and found["counts"] is None
    for store in ("exact", "rounded"):
        with ShardWriter(tmp_path / store, 2, {"about": {"behind_time": 2}}, store=store) as shard:
            for row, one in enumerate(samples):
                shard.put(row, one)
        assert found[store] == (tmp_path / store).stat().st_size / 2


# ------------------------------------------------------------------------------------------------------------- arrays


@pytest.mark.parametrize("shape", [(2, 3, 5, 7), (2, 700, 8, 9), (2, 300, 13, 11), (40000,), (200, 300)])
def test_arrays_in_order_are_those_of_the_film(shape):
    """The pixels first in memory, by blocks of 64 that need not come out even."""
    film = torch.rand(*shape[-2:], *shape[:-2]) if len(shape) > 2 else torch.rand(shape)
    tensor = film.movedim((0, 1), (-2, -1)) if len(shape) > 2 else film
    for given in (tensor, tensor.contiguous(), torch.rand(*shape[:-1], 2 * shape[-1])[..., ::2]):
        found = in_order(given)
        assert found.flags.c_contiguous and np.array_equal(found, given.numpy())
