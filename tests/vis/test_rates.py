"""Range-Doppler maps against light that is known, and other pictures of light by rates."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.sweeps import together
from torchtransient.errors import ShapeError, UnitError
from torchtransient.files.result_file import Result, write_result

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


def test_other_pictures_show_the_sum_over_rates(tmp_path):
    cube, file = light(), tmp_path / "out.npz"
    write_result(file, Result(None, cube.sum((1, 2)), AXIS, rates=cube, rate_axis=RATES))
    whole = tt.vis.range_doppler(cube, axis=AXIS, rate_axis=RATES)
    np.testing.assert_array_equal(image_of(tt.vis.range_doppler(file)), image_of(whole))
    expected = image_of(tt.vis.peak_time_picture(cube.sum(1), axis=AXIS))
    for given in (file, SimpleNamespace(rates=cube, steady=cube.sum((1, 2)), axis=AXIS, transient=None)):
        np.testing.assert_array_equal(image_of(tt.vis.peak_time_picture(given)), expected)


@together("arguments, error", [
    ({"rate_axis": RATES}, ShapeError), ({"axis": AXIS}, ShapeError),
    ({"axis": tt.TimeAxis(0.0, 1.0, 5), "rate_axis": RATES}, ShapeError),
    ({"axis": AXIS, "rate_axis": RATES, "pixel": (2, 0)}, ShapeError),
    ({"axis": AXIS, "rate_axis": RATES, "decades": 0.0}, UnitError),
])  # fmt: skip
def test_what_is_refused(arguments, error):
    with pytest.raises(error):
        tt.vis.range_doppler(light(), **arguments)


def test_beats_and_batches_are_no_times_of_arrival(tmp_path):
    beats = SimpleNamespace(beats=torch.rand(1, 2, 6, 2, 2), steady=torch.ones(1, 2, 2), axis=AXIS, transient=None)
    with pytest.raises(ShapeError, match="beats"):
        tt.vis.rainbow(beats)
    beats.rates = None
    with pytest.raises(ShapeError, match=r"without.*Beats are read by tt\.sensing\.range_and_speed"):
        tt.vis.range_doppler(beats)
    batch = SimpleNamespace(rates=torch.stack([light()] * 4), transient=None, polarized=False, axis=AXIS)
    with pytest.raises(ShapeError, match="batch"):
        tt.vis.rainbow(batch)
    write_result(tmp_path / "out.npz", Result(light().sum(1), light().sum((1, 2)), AXIS))
    with pytest.raises(ShapeError, match="expected light by rates"):
        tt.vis.range_doppler(tmp_path / "out.npz")
