"""Scans and points that carry gradients: operators take them as they are, and lose nothing without a word."""

from dataclasses import replace

import pytest
import torch

from support import grid_operators, scan_operators
from support.scalars import no_gradient_is_lost
from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.reconstruction import (
    FK,
    LCT,
    Backprojection,
    FilteredBackprojection,
    MidpointFK,
    PhasorField,
    PlanarScan,
    VoxelGrid,
    subtract_legs,
)

F64 = torch.float64
CONFOCAL, SINGLE = grid_operators.SCAN, grid_operators.SINGLE
SCANS, PULSE, DEPTHS = scan_operators.SCANS, scan_operators.PULSE, scan_operators.DEPTHS
TENSORS = ("sensor_points", "laser_points", "sensor_origin", "laser_origin", "sensor_normals", "laser_normals")


def carrying(scan):
    """The scan with gradients in all of its tensors, none of which is a leaf."""
    zero = torch.zeros((), dtype=F64, requires_grad=True)
    moved = {name: getattr(scan, name) + zero for name in TENSORS if getattr(scan, name) is not None}
    if scan.kind == "confocal":
        moved["laser_points"] = moved["sensor_points"]
    return replace(scan, **moved)


def of_grid(kind, scan):
    return scan, lambda s: kind(s, time_axis=grid_operators.AXIS, dtype=F64)


def of_scan(kind, name, **options):
    scan = SCANS[name]
    return scan, lambda s: kind(s, VoxelGrid.before(s, DEPTHS), time_axis=scan_operators.AXIS, dtype=F64, **options)


MADE = {
    "fk": of_grid(FK, CONFOCAL),
    "lct": of_grid(LCT, CONFOCAL),
    "midpoint fk": of_grid(MidpointFK, SINGLE),
    "backprojection, legs": of_scan(Backprojection, "exhaustive, legs"),
    "filtered backprojection": of_scan(FilteredBackprojection, "single", filter=PULSE),
    "phasor field, confocal legs": of_scan(PhasorField, "confocal, legs", pulse=PULSE),
}


def tensors_of(record):
    """Those of a record, and of the records in it."""
    for value in vars(record).values():
        if isinstance(value, torch.Tensor):
            yield value
        elif isinstance(value, Scan | PlanarScan | VoxelGrid):
            yield from tensors_of(value)


@pytest.mark.parametrize("name", MADE)
def test_operators_take_them_as_they_are(name):
    scan, make = MADE[name]
    expected = make(scan)
    data = torch.ones(2, *expected.data_shape, dtype=F64)
    given = carrying(scan)
    with no_gradient_is_lost():
        operator = make(given)
        found = operator.adjoint(data)
        state = operator.state_dict()
        picture = operator.reconstruct(Capture(data, operator.axis, given))
    assert torch.equal(found, expected.adjoint(data)) and not found.requires_grad and not picture.requires_grad
    parts = list(operator.modules())
    assert not any(table.requires_grad for part in parts for table in (*part.buffers(), *tensors_of(part)))
    assert not operator.points.requires_grad
    expected.load_state_dict(state)


@pytest.mark.parametrize("normals", [True, False])
def test_grids_know_nothing_of_them(normals):
    scan = carrying(SCANS["confocal"] if normals else replace(
        SCANS["confocal"], wall=None, sensor_normals=None, laser_normals=None
    ))  # fmt: skip
    with no_gradient_is_lost():
        wall = PlanarScan.of_scan(scan, "test")
        bare = PlanarScan.of(scan.sensor_points, who="test")
        made = [VoxelGrid.before(scan, DEPTHS), VoxelGrid.before(scan, DEPTHS, size=(4, 3), extent=(0.2, 0.1))]
        place = wall.local(scan.sensor_points)
    assert not any(tensor.requires_grad for grid in (wall, bare, *made) for tensor in tensors_of(grid))
    assert not place.requires_grad
    assert made[0] == VoxelGrid.before(SCANS["confocal"], DEPTHS)


def test_captures_without_legs_depend_on_their_light_alone():
    scan = carrying(SCANS["confocal, legs"])
    capture = Capture(torch.ones(1, 40, *scan.shape), TimeAxis(0.5, 0.02, 40), scan)
    with no_gradient_is_lost():
        found = subtract_legs(capture)
    assert not found.transient.requires_grad and found.scan.sensor_points.requires_grad
