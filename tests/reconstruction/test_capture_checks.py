"""What operators ask of numbers, choices, captures and states: the last value that is taken, the first that is not."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from support.grid_operators import SCAN
from support.scan_operators import SCANS
from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.reconstruction import FK, Backprojection, PlanarScan, VoxelGrid, capture_checks, lct
from torchtransient.reconstruction.operator_state import check_same, plain

F64 = torch.float64
AXIS, FINE = TimeAxis(0.5, 0.25, 8), TimeAxis(0.5, 0.125, 8)


def test_numbers_between_two():
    assert capture_checks.within("x", 2, 2.0, 3.0) == 2.0 and capture_checks.within("x", 3, 2.0, 3.0) == 3.0
    for value in (math.nextafter(2.0, 0.0), math.nextafter(3.0, 4.0)):
        with pytest.raises(UnitError, match="x: expected a number from 2 to 3"):
            capture_checks.within("x", value, 2.0, 3.0)


def test_choices_are_texts_or_whole_numbers():
    assert capture_checks.one_of("taps", np.int64(4), (2, 4)) == 4
    assert capture_checks.one_of("target", "b", {"a": 1, "b": 2}) == "b"
    for value in (4.0, True, "4", 3, None):
        with pytest.raises(ArgumentError, match="taps: expected one of 1, 2, 4, got"):
            capture_checks.one_of("taps", value, (1, 2, 4))


@pytest.mark.parametrize(
    "points", [torch.zeros(3), torch.zeros(0, 3), torch.zeros(5, 2), torch.zeros(3, 4), [[0, 0, 1]]]
)
def test_points_that_are_none(points):
    with pytest.raises(ShapeError, match=r"Method: expected a VoxelGrid or points \(\.\.\., 3\)"):
        capture_checks.checked_points(points, "Method")


def test_points_are_copied():
    points = torch.ones(2, 3, dtype=F64)
    found = capture_checks.checked_points(points, "Method")
    points += 1
    assert torch.equal(found, torch.ones(2, 3, dtype=F64))
    assert capture_checks.checked_points(torch.ones(1, 3, dtype=torch.int32), "Method").dtype == F64


@pytest.mark.parametrize("falloff", [4.0, -4.0])
@pytest.mark.parametrize("dtype, digits", [(torch.float32, 30.825), (F64, 246.6)])
def test_falloffs_use_eight_tenths_of_a_precisions_range(falloff, dtype, digits):
    # Products of distances of 10^-d or 10^d to the fourth power.
    for less, more in (((digits - 0.01) / 4, (digits + 0.02) / 4),):
        for near, far in ((10**-less, 1.0), (1.0, 10**less), (10**-less, 0.0), (10**-less, 10**less)):
            capture_checks.check_falloff(falloff, near, far, dtype, "Method")
        for near, far in ((10**-more, 1.0), (1.0, 10**more), (10**-more, 0.0), (10**more, 1.0)):
            with pytest.raises(UnitError, match=f"got {falloff:g} at distances"):
                capture_checks.check_falloff(falloff, near, far, dtype, "Method")
    capture_checks.check_falloff(0.0, 1e-300, 1e300, dtype, "Method")


def test_time_axes_may_begin_a_millionth_of_a_bin_early():
    capture_checks.check_from_zero(replace(AXIS, start_opl=-0.9e-6 * 0.25), "Method")
    with pytest.raises(UnitError, match="from zero on"):
        capture_checks.check_from_zero(replace(AXIS, start_opl=-1.1e-6 * 0.25), "Method")


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_axes_are_the_same_to_a_millionth_of_a_bin(sign):
    def taken(axis):
        capture = Capture(torch.ones(1, axis.num_bins, 6, 5), axis, SCAN)
        return capture_checks.checked_intensities(capture, AXIS, "Method")

    step = sign * 1e-6 * 0.25
    # The start alone, the width alone: eight bins end eight steps later.
    for axis in (replace(AXIS, start_opl=0.5 + 0.9 * step), replace(AXIS, bin_width_opl=0.25 + 0.9 * step / 8)):
        assert taken(axis).shape == (1, 8, 6, 5)
    for axis in (
        replace(AXIS, start_opl=0.5 + 1.1 * step), replace(AXIS, bin_width_opl=0.25 + 1.1 * step / 8),
        TimeAxis(0.5 + 1.1 * step, 0.25 - 1.1 * step / 8, 8), TimeAxis(0.5, 0.5, 4),
    ):  # fmt: skip
        with pytest.raises(ShapeError, match="Method: expected a capture with TimeAxis"):
            taken(axis)


def test_what_is_no_capture_is_told_what_to_do():
    for given, words in (
        ("a.hdf5", r"reads files\.$"), (torch.ones(3), "operators such as tt.nlos.FK take tensors"),
        (3, r"expected a tt\.nlos\.Capture, got 3\.$"),
    ):  # fmt: skip
        with pytest.raises(ShapeError, match=words):
            lct(given)
    phasors = Capture(None, None, SCAN, phasor=torch.ones(1, 1, 6, 5, dtype=torch.complex64),
                      frequencies=FrequencyAxis((1.0,)))  # fmt: skip
    with pytest.raises(ShapeError, match="lct: expected a capture with a transient, got phasors alone"):
        lct(phasors)


def test_scans_measure_the_same_light():
    scan = SCANS["single"]
    same = capture_checks.same_light
    other = replace(scan, sensor_origin=scan.sensor_origin + 0.01, laser_origin=scan.laser_origin + 0.01)
    # Origins count with the legs alone, normals never.
    assert same(scan, scan) and same(scan, replace(scan)) and same(scan, other)
    assert same(scan, replace(scan, sensor_normals=None, laser_normals=None, wall=None))
    legs = replace(scan, first_and_last_leg=True)
    assert same(legs, replace(legs)) and not same(legs, scan)
    for name in ("sensor_origin", "laser_origin"):
        assert not same(legs, replace(legs, **{name: getattr(other, name)}))
    for name in ("sensor_points", "laser_points"):
        assert not same(scan, replace(scan, **{name: getattr(scan, name) + 1e-9}))
    flat = replace(scan, sensor_points=scan.sensor_points.flip(0))
    assert not same(scan, flat) and not same(scan, SCANS["confocal"])
    listed = Scan.points(
        scan.sensor_points.reshape(-1, 3), kind="single", laser_points=scan.laser_points,
        sensor_origin=scan.sensor_origin, laser_origin=scan.laser_origin,
    )  # fmt: skip
    assert not same(scan, listed)


def test_grids_of_a_wall_take_captures_of_scans_on_it():
    operator = FK(PlanarScan.of_scan(SCAN, "test"), time_axis=FINE)
    light = torch.ones(1, *operator.data_shape)
    assert operator.reconstruct(Capture(light, FINE, SCAN)).shape == (1, *operator.volume_shape)
    with pytest.raises(ShapeError, match="expected a confocal scan, got a single one"):
        operator.reconstruct(Capture(light, FINE, Scan.grid(SCAN.wall, (5, 6), kind="single")))
    anywhere = Backprojection(SCAN, VoxelGrid.before(SCAN, [0.5]), time_axis=FINE)
    with pytest.raises(ShapeError, match="own scan"):
        anywhere.reconstruct(Capture(light, FINE, replace(SCAN, first_and_last_leg=True)))


# --------------------------------------------------------------------------------------------------------------- states


def says(mine, theirs, words):
    if words is None:
        check_same(mine, theirs, "Method")
        check_same(theirs, mine, "Method")
        return
    for a, b in ((mine, theirs), (theirs, mine)):
        with pytest.raises(ShapeError, match=f"Method: .*with {words} "):
            check_same(a, b, "Method")


@pytest.mark.parametrize("mine, theirs, words", [
    ({"floor": 2.0}, {"floor": 2.0 * (1 + 0.9e-6)}, None), ({"floor": 2.0}, {"floor": 2.0 * (1 + 1.1e-6)}, "floor"),
    ({"floor": 0.0}, {"floor": 0.9e-9}, None), ({"floor": 0.0}, {"floor": 1.1e-9}, "floor"),
    ({"floor": 1}, {"floor": 1.0}, None), ({"floor": True}, {"floor": 1}, None),
    ({"floor": True}, {"floor": 0}, "floor"),
    ({"floor": 0}, {"floor": False}, None), ({"floor": 1e-10}, {"floor": False}, "floor"),
    ({"floor": "a"}, {"floor": "b"}, "floor"), ({"floor": None}, {"floor": 0.0}, "floor"),
    ({"axis": [1.0, 2.0]}, {"axis": [1.0, 2.0]}, None), ({"axis": [1.0, 2.0]}, {"axis": [1.0, 3.0]}, "axis"),
    ({"axis": [1.0, 2.0]}, {"axis": [1.0]}, "axis"), ({"axis": [1.0]}, {"axis": 1.0}, "axis"),
    ({"pulse": {"cycles": 3.0}}, {"pulse": {"cycles": 4.0}}, "pulse.cycles"),
    ({"pulse": {"cycles": 3.0}}, {"pulse": {"sigma": 3.0}}, "pulse"), ({"pulse": {}}, {"pulse": None}, "pulse"),
])  # fmt: skip
def test_settings_are_the_same_to_a_millionth(mine, theirs, words):
    says(mine, theirs, words)


def test_tensors_of_a_state_are_told_by_their_shape_and_values():
    values = torch.tensor([3.0, -8.0, 2.0, 5.0], dtype=F64)
    told = plain(values)
    # A millionth of the largest value, times the root of how many there are: 1.6e-5 for the first, as cos(1) has it.
    for off, words in ((1e-5, None), (-1e-5, None), (1e-3, "points"), (-1e-3, "points")):
        moved = values.clone()
        moved[0] += off
        says({"points": told}, {"points": plain(moved)}, words)
    for other in (values.flip(0), values.reshape(2, 2), values[:3], 2 * values):
        says({"points": told}, {"points": plain(other)}, r"points(\.shape)?")
    # The slack is a millionth of the larger one, 2 of the root of four: 1.6e-5 and not more in any sum.
    assert len(told["sums"]) == 4 and told["size"] == 8.0 and told["shape"] == [4]
    for slack, words in ((0.99, None), (1.01, "points"), (-0.99, None), (-1.01, "points")):
        says({"points": told}, {"points": {**told, "sums": [s + slack * 1.6e-5 for s in told["sums"]]}}, words)
    k, n = torch.arange(1, 5, dtype=F64)[:, None], torch.arange(1, 5, dtype=F64)
    assert told["sums"] == pytest.approx((torch.cos(k * n) * values).sum(1).tolist(), rel=1e-14)
    empty = plain(torch.zeros(0, 3))
    assert empty["size"] == 0.0
    says({"points": empty}, {"points": plain(torch.zeros(0, 3))}, None)


def test_settings_are_plain():
    assert plain([1, (2.5, None)]) == [1, [2.5, None]] and plain("a") == "a" and plain(True) is True
    assert plain(AXIS) == {"type": "TimeAxis", "start_opl": 0.5, "bin_width_opl": 0.25, "num_bins": 8}
    assert plain(object()) == {"type": "object"}
