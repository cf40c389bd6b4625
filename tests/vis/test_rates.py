"""Range-Doppler maps and pictures of speeds, against light that is known."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

import torchtransient as tt
from torchtransient.errors import ArgumentError, ShapeError, StorageError, UnitError
from torchtransient.vis.sources import images_of, steady_of, transient_of

AXIS, RATES = tt.TimeAxis(2.0, 0.5, 6), tt.RateAxis(-2.0, 0.5, 8)


def light():
    """(1, 8, 6, 2, 2): 1.25 m/s at 3.25 m; the same and as much at -0.75 m/s; -1.75 m/s; dark."""
    cube = torch.zeros(1, 8, 6, 2, 2)
    cube[0, 6, 2, 0, 0] = 3.0
    cube[0, 6, 2, 0, 1] = cube[0, 2, 4, 0, 1] = 1.0
    cube[0, 0, 1, 1, 0] = 0.5
    return cube


def image_of(figure):
    return np.ma.filled(figure.axes[0].images[0].get_array(), np.nan)


def test_map_of_a_pixel(tmp_path):
    path = tmp_path / "map.png"
    figure = tt.vis.range_doppler(light(), path, axis=AXIS, rate_axis=RATES, pixel=(0, 0), decades=3)
    assert path.read_bytes()[:4] == b"\x89PNG"
    image = image_of(figure)  # lengths upwards, rates to the right
    assert image.shape == (6, 8) and image[2, 6] == 3.0
    assert np.count_nonzero(image > 0.01) == 1
    assert figure.axes[0].images[0].get_extent() == [-2.0, 2.0, 2.0, 5.0]
    assert figure.axes[0].images[0].get_clim() == pytest.approx((0.003, 3.0))


def test_map_of_all_pixels():
    whole = tt.vis.range_doppler(light(), axis=AXIS, rate_axis=RATES)
    np.testing.assert_allclose(image_of(whole)[[2, 4, 1], [6, 2, 0]], [1.0, 0.25, 0.125])
    result = SimpleNamespace(rates=light(), axis=AXIS, rate_axis=RATES)
    np.testing.assert_array_equal(image_of(tt.vis.range_doppler(result)), image_of(whole))
    tt.vis.range_doppler(torch.zeros(1, 8, 6, 2, 2), axis=AXIS, rate_axis=RATES)  # no light at all


@pytest.mark.parametrize(("reading", "wanted"), [("mean", [-0.625, -0.125, 0.875]), ("peak", [-0.625, 0.375, 0.875])])
def test_speeds(reading, wanted):
    """Half the rate with its sign changed; of equal light, the first bin."""
    image = image_of(tt.vis.speed_picture(light(), rate_axis=RATES, reading=reading)).ravel()
    np.testing.assert_allclose(image[:3], wanted)
    assert np.isnan(image[3])


def test_scale_and_colours():
    figure = tt.vis.speed_picture(light(), rate_axis=RATES, limit=0.5)
    panel = figure.axes[0].images[0]
    assert panel.get_clim() == (-0.5, 0.5)
    near, far = panel.cmap(1.0), panel.cmap(0.0)
    assert near[2] > near[0] and far[0] > far[2]  # blue comes nearer


def test_speeds_that_were_found():
    found = torch.tensor([[[1.0, float("nan")], [-2.0, 0.0]]])
    for speeds in (found, found[0]):
        np.testing.assert_array_equal(image_of(tt.vis.speed_picture(speeds)), found[0])


@pytest.mark.parametrize(
    ("function", "arguments", "error", "message"),
    [
        ("range_doppler", {"rate_axis": RATES}, ShapeError, "needs axis=TimeAxis"),
        ("range_doppler", {"axis": AXIS}, ShapeError, "needs rate_axis=RateAxis"),
        ("range_doppler", {"axis": tt.TimeAxis(0.0, 1.0, 5), "rate_axis": RATES}, ShapeError, "as the axes have it"),
        ("range_doppler", {"axis": AXIS, "rate_axis": RATES, "pixel": (2, 0)}, ShapeError, "pixel"),
        ("range_doppler", {"axis": AXIS, "rate_axis": RATES, "decades": 0.0}, UnitError, "decades"),
        ("range_doppler", {"axis": RATES, "rate_axis": RATES}, ArgumentError, "TimeAxis"),
        ("range_doppler", {"source": torch.ones(1, 6, 2, 2), "rate_axis": RATES}, ShapeError, "C, R, T, H, W"),
        ("speed_picture", {}, ShapeError, "needs rate_axis=RateAxis"),
        ("speed_picture", {"rate_axis": RATES, "reading": "median"}, ArgumentError, "mean, peak"),
        ("speed_picture", {"rate_axis": RATES, "limit": -1.0}, UnitError, "limit"),
        ("speed_picture", {"source": torch.ones(3, 2, 2)}, ShapeError, "C, R, T, H, W"),
    ],
)
def test_what_is_refused(function, arguments, error, message):
    source = arguments.pop("source", light())
    with pytest.raises(error, match=message):
        getattr(tt.vis, function)(source, **arguments)


def written(tmp_path, ending, **tensors):
    """A result as files have it, by the names that they give."""
    values = {
        "start_opl": 2.0, "bin_width_opl": 0.5, "num_bins": 6, "rates_start": -2.0, "rates_bin_width": 0.5,
        "rates_num_bins": 8, "format": "torchtransient result 1", **tensors,
    }  # fmt: skip
    path = tmp_path / f"out.{ending}"
    if ending == "npz":
        np.savez(path, **values)
        return path
    import h5py

    with h5py.File(path, "w") as file:
        for name, value in values.items():
            if isinstance(value, np.ndarray):
                file[name] = value
            else:
                file.attrs[name] = value
    return path


@pytest.mark.parametrize("ending", ["npz", "h5"])
def test_files_are_drawn_as_what_they_hold(tmp_path, ending):
    path = written(tmp_path, ending, rates=light().numpy(), steady=light().sum((1, 2)).numpy())
    found = tt.vis.range_doppler(str(path))
    np.testing.assert_array_equal(image_of(found), image_of(tt.vis.range_doppler(light(), axis=AXIS, rate_axis=RATES)))


@pytest.mark.parametrize("source", ["file", "result"])
def test_other_pictures_show_the_sum_over_rates(tmp_path, source):
    cube, steady = light(), light().sum((1, 2))
    given = written(tmp_path, "npz", rates=cube.numpy(), steady=steady.numpy())
    if source == "result":
        given = SimpleNamespace(rates=cube, steady=steady, axis=AXIS, transient=None)
    images, axis, word = images_of(given)
    assert torch.equal(images, cube.sum(1)) and axis == AXIS and word == "bin"
    assert torch.equal(steady_of(given), steady)
    with pytest.raises(ShapeError, match="choose one entry"):
        transient_of(SimpleNamespace(rates=torch.stack([cube] * 4), transient=None, polarized=False))


def test_beats_are_no_times_of_arrival():
    beats = SimpleNamespace(beats=torch.rand(1, 2, 6, 2, 2), steady=torch.ones(1, 2, 2), axis=AXIS, transient=None)
    with pytest.raises(ShapeError, match="spectra of beats"):
        transient_of(beats)
    assert torch.equal(steady_of(beats), beats.steady)


def test_files_without_rates(tmp_path):
    path = tmp_path / "out.npz"
    np.savez(path, transient=light().sum(1).numpy(), start_opl=2.0, bin_width_opl=0.5, num_bins=6)
    with pytest.raises(StorageError, match="holds no light by rates"):
        tt.vis.range_doppler(path)
    with pytest.raises(StorageError, match="expected a result"):
        tt.vis.range_doppler(tmp_path / "out.npy")
