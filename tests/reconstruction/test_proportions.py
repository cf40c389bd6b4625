"""What a wall, a record, points and waves may be in size: the last number that is taken and the first that is not."""

from dataclasses import replace

import pytest
import torch

from support.sweeps import together
from torchtransient.axes import TimeAxis
from torchtransient.capture import Scan
from torchtransient.errors import UnitError
from torchtransient.reconstruction import PlanarScan, VoxelGrid, proportions

F64 = torch.float64
UP = {"sensor_origin": (0.0, 4.0, 0.0), "laser_origin": (3.0, 4.0, 12.0)}
NORTH = {"sensor_origin": (0.0, 0.0, 2.0), "laser_origin": (0.0, 0.0, 3.0)}
# Five metres wide with its spot, three without; legs of 12 + 4 and of 12 + 5 m.
PAIR = Scan.points([[0, 0, 0], [3, 0, 0]], kind="single", laser_points=[3, 4, 0], **UP)
LEGS = replace(PAIR, first_and_last_leg=True)
POINT = Scan.points([[0, 0, 0]], kind="confocal", **NORTH)
# The same legs there and back: 2 + 3 m.
POINT_LEGS = replace(POINT, first_and_last_leg=True)
GRID = PlanarScan.of(
    torch.tensor([[[x, y, 7.0] for x in (0.0, 1.5, 3.0)] for y in (-4.0, 0.0)], dtype=F64), who="test"
)


def says(check, words):
    """That a check passes, for None, or what it raises."""
    if words is None:
        check()
        return
    with pytest.raises(UnitError, match=words):
        check()


SIZES = [
    # Records that end before time zero: ten walls of 5 m, or ten records.
    (PAIR, (-52.0, 1.0, 2), None), (PAIR, (-52.5, 1.0, 2), "goes on after time zero"),
    (PAIR, (-88.0, 4.0, 2), None), (PAIR, (-88.5, 4.0, 2), "goes on after time zero"),
    (LEGS, (-36.0, 1.0, 2), None), (LEGS, (-36.5, 1.0, 2), "with legs of 16 m"),
    # Walls of ten records, from time zero or from their beginning on.
    (PAIR, (0.0, 0.25, 2), None), (PAIR, (0.0, 0.125, 3), "points up to 5 m apart and light of 0.375 m"),
    (PAIR, (-0.5, 0.25, 2), None), (PAIR, (0.25, 0.125, 2), None), (PAIR, (0.125, 0.125, 2), "one size"),
    (LEGS, (16.25, 0.125, 2), None), (LEGS, (16.125, 0.125, 2), "one size"),
    # Bins as long as the wall is wide; one point has no width.
    (PAIR, (0.0, 5.0, 2), None), (PAIR, (0.0, 5.5, 2), "bins of 5.5 m"), (POINT, (0.0, 5.5, 2), None),
    # Records that begin ten thousand walls, or bins, behind the legs.
    (PAIR, (50000.0, 0.5, 2), None), (PAIR, (50000.5, 0.5, 2), "begins at 5e"),
    (LEGS, (50017.0, 0.5, 2), None), (LEGS, (50017.5, 0.5, 2), "things near the wall"),
    (POINT, (5000.0, 0.5, 2), None), (POINT, (5000.5, 0.5, 2), "things near the wall"),
    (GRID, (-52.0, 1.0, 2), None), (GRID, (-52.5, 1.0, 2), "with legs of 0 m"),
    (GRID, (0.0, 0.25, 2), None), (GRID, (0.0, 0.125, 3), "points up to 5 m apart"),
]  # fmt: skip


@together("scan, axis, words", SIZES)
def test_walls_and_records_of_one_size(scan, axis, words):
    says(lambda: proportions.check_proportions(scan, TimeAxis(*axis), "test"), words)


def test_a_spot_in_the_wall_counts_as_much_as_a_sensor_point():
    # Three metres between sensor points: a record of 0.4 m would do for them alone.
    only = replace(PAIR, laser_points=PAIR.sensor_points[1])
    proportions.check_proportions(only, TimeAxis(0.0, 0.125, 3), "test")
    apart = Scan.points(PAIR.sensor_points[:1], kind="single", laser_points=[3, 4, 0], **UP)
    with pytest.raises(UnitError, match="up to 5 m apart"):
        proportions.check_proportions(apart, TimeAxis(0.0, 0.125, 3), "test")


WIDE = Scan.points([[0, 0, 0], [2, 0, 0]], kind="confocal", **NORTH)
ASIDE = Scan.points([[0, 0, 0], [2, 0, 0]], kind="single", laser_points=[2, 0, 0], **NORTH)
REACHES = [
    # Ten times the end, or the length of the record: what comes back from twice that depth.
    (POINT, (0, 0, 5), (0.0, 0.5, 2), None), (POINT, (0, 0, 5.25), (0.0, 0.5, 2), "0 to 0.5 m .* after 10.5 m of path"),
    (POINT, (0, 0, 10), (-1.0, 0.5, 4), None), (POINT, (0, 0, 10.25), (-1.0, 0.5, 4), "0 to 0.5 m .* 20.5 m of path"),
    # Legs come before the record's own length.
    (POINT_LEGS, (0, 0, 10), (4.0, 0.5, 4), None), (POINT_LEGS, (0, 0, 10.25), (4.0, 0.5, 4), "after 25.5 m of path"),
    (POINT_LEGS, (0, 0, 15), (5.5, 0.5, 5), None),
    (POINT_LEGS, (0, 0, 15.25), (5.5, 0.5, 5), "0.25 to 1.5 m before the wall.* 35.5 m of path"),
    # The nearest point of the wall counts: straight before it, beside it on both sides, on either side of the plane.
    (WIDE, (1, 0, 5), (0.0, 0.5, 2), None), (WIDE, (1, 0, -5), (0.0, 0.5, 2), None),
    (WIDE, (5, 0, 4), (0.0, 0.5, 2), None), (WIDE, (5.25, 0, 4), (0.0, 0.5, 2), "path"),
    (WIDE, (-3, 0, 4), (0.0, 0.5, 2), None), (WIDE, (-3.25, 0, 4), (0.0, 0.5, 2), "path"),
    (WIDE, (1, -3, 4), (0.0, 0.5, 2), None), (WIDE, (1, -3.25, 4), (0.0, 0.5, 2), "path"),
    # 5 m from the spot, 3 m from the other wall point's side.
    (ASIDE, (2, 3, 4), (0.0, 0.5, 2), None), (ASIDE, (2, 3.25, 4), (0.0, 0.5, 2), "path"),
    (ASIDE, (-1, 0, 4), (0.0, 0.5, 2), None), (ASIDE, (-1.25, 0, 4), (0.0, 0.5, 2), None),
    (ASIDE, (-3, 0, 4), (0.0, 0.5, 2), "11.4 m of path"),
]  # fmt: skip


@together("scan, point, axis, words", REACHES)
def test_points_whose_light_comes_within_ten_records(scan, point, axis, words):
    points = torch.tensor([[0.0, 0.0, 0.125], list(map(float, point))], dtype=F64)
    says(lambda: proportions.check_reach(scan, points, TimeAxis(*axis), "test"), words)


# From 3 m beside the wall, 4 m before it, to 8 m aside, 9 m up and 12 m before it: 5 and 17 m away.
VOXELS = VoxelGrid(
    [4.0, 5.0, 12.0], (4, 2), (3.0, 3.0), first=[5.0, 0.0, 0.0], along_x=[1.0, 0.0, 0.0], along_y=[0.0, 1.0, 0.0],
    normal=[0.0, 0.0, 1.0],
)  # fmt: skip
SEEN = [
    (WIDE, (8.0, 0.5, 4), None), (WIDE, (7.75, 0.5, 4), "after 10 to 34 m of path"),
    (WIDE, (34.0, 0.5, 4), None), (WIDE, (34.25, 0.5, 4), "17.12 to 18.12 m .* after 10 to 34 m of path"),
    # Legs of 5 m from the first sensor point, of sqrt(8) + sqrt(13) m from the other.
    (replace(WIDE, first_and_last_leg=True), (13.0, 0.5, 4), None),
    (replace(WIDE, first_and_last_leg=True), (12.75, 0.5, 4), "after 15 to 40.43 m of path"),
    (replace(WIDE, first_and_last_leg=True), (40.25, 0.5, 4), None),
    (replace(WIDE, first_and_last_leg=True), (40.5, 0.5, 4), "after 15 to 40.43 m of path"),
    # To a spot at 2 m: 5 m, and sqrt(261) m to the farthest voxel.
    (ASIDE, (8.0, 0.5, 4), None), (ASIDE, (33.0, 0.5, 4), None),
    (ASIDE, (33.25, 0.5, 4), "after 10 to 33.16 m of path"),
]  # fmt: skip


@together("points", [VOXELS, VOXELS.points])
@together("scan, axis, words", SEEN)
def test_voxels_that_a_record_sees(points, scan, axis, words):
    says(lambda: proportions.check_reach(scan, points, TimeAxis(*axis), "test", seen=True), words)
    # What is not seen may stand there nevertheless.
    proportions.check_reach(scan, points, TimeAxis(*axis), "test")


def test_points_on_either_side_of_a_wall_and_around_it_are_near():
    around = torch.tensor([[-3.0, 0.0, -4.0], [5.0, 0.0, 4.0]], dtype=F64)
    # The box around them holds the wall: light comes from zero on, up to the far end of the wall.
    proportions.check_reach(WIDE, around, TimeAxis(-2.0, 0.5, 4), "test", seen=True)
    with pytest.raises(UnitError, match=r"after 0 to 12\.81 m"):
        proportions.check_reach(WIDE, around, TimeAxis(13.0, 0.5, 4), "test", seen=True)
    for side in (-1.0, 1.0):
        beside = torch.tensor([[1.0 + 4.0 * side, 3.0 * side, 12.0 * side]], dtype=F64)
        # 3 m, 3 m and 12 m off the box of the wall.
        with pytest.raises(UnitError, match=r"after 25\.46 to"):
            proportions.check_reach(WIDE, beside, TimeAxis(23.25, 0.5, 4), "test", seen=True)


@pytest.mark.parametrize(
    "scan, axis, longest",
    [(PAIR, (3.0, 0.5, 4), 2.0), (PAIR, (0.0, 2.0, 32), 50.0), (POINT, (0.0, 2.0, 32), 64.0)],
)
def test_waves_of_a_record_or_ten_walls(scan, axis, longest):
    proportions.check_wavelength(longest, scan, TimeAxis(*axis), "test")
    with pytest.raises(UnitError, match=f"wavelength of {longest:.4g} m at most"):
        proportions.check_wavelength(longest + 0.25, scan, TimeAxis(*axis), "test")


@pytest.mark.parametrize("scan", [PAIR, GRID], ids=["scan", "grid"])
def test_slabs_twice_as_thick_as_the_scan_is_wide(scan):
    proportions.check_thickness(10.0, scan, "test")
    with pytest.raises(UnitError, match=r"scan is wide, 5 m, got 10\.25 m"):
        proportions.check_thickness(10.25, scan, "test")


def test_parts_that_end_ten_records_behind_their_beginning():
    axis = TimeAxis(1.0, 0.5, 4)
    proportions.check_record(axis, 21.0, "test")
    proportions.check_record(None, 1e9, "test")
    with pytest.raises(UnitError, match=r"1 to 3 m, got 21\.25 m"):
        proportions.check_record(axis, 21.25, "test")


def test_points_that_carry_gradients_are_measured_all_the_same():
    points = LEGS.sensor_points.clone().requires_grad_()
    spot, origin = LEGS.laser_points.clone().requires_grad_(), LEGS.sensor_origin.clone().requires_grad_()
    scan = replace(LEGS, sensor_points=points, laser_points=spot, sensor_origin=origin, laser_origin=origin.clone())
    axis = TimeAxis(10.0, 0.5, 60)
    proportions.check_proportions(scan, axis, "test")
    proportions.check_reach(scan, VOXELS, axis, "test", seen=True)
    proportions.check_wavelength(1.0, scan, axis, "test")
    proportions.check_thickness(1.0, scan, "test")
