"""Range-Doppler maps and pictures of speeds, against light that is known."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

import torchtransient as tt
from torchtransient.errors import ArgumentError, ShapeError, UnitError

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
