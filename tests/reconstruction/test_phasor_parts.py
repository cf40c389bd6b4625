"""What phasor fields are made of: frequencies that are dense enough, pieces of a size, planes along the wall."""

import math
from dataclasses import replace

import pytest
import torch

from support.scan_operators import AXIS, DEPTHS, PULSE, SCANS
from torchtransient.errors import ShapeError, UnitError
from torchtransient.reconstruction import (
    ConfocalCamera,
    PhasorField,
    TransientCamera,
    VoxelGrid,
)

F64 = torch.float64


def noise(*shape, seed=0):
    return torch.randn(shape, dtype=F64, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("name", ["along_x", "along_y"])
def test_planes_are_parallel_to_the_wall(name):
    scan = SCANS["confocal"]
    grid = VoxelGrid.before(scan, DEPTHS)
    for angle, taken in ((1e-3, True), (2e-3, False)):
        turned = math.cos(angle) * getattr(grid, name) + math.sin(angle) * grid.normal
        normal = math.cos(angle) * grid.normal - math.sin(angle) * getattr(grid, name)
        other = replace(grid, **{name: turned, "normal": normal})
        if taken:
            PhasorField(scan, other, time_axis=AXIS, pulse=PULSE)
            continue
        with pytest.raises(ShapeError, match="planes along the wall's rows and columns"):
            PhasorField(scan, other, time_axis=AXIS, pulse=PULSE)
    # In the opposite direction they are parallel no more.
    mirrored = replace(grid, **{name: -getattr(grid, name)})
    with pytest.raises(ShapeError, match="planes along the wall's rows and columns"):
        PhasorField(scan, mirrored, time_axis=AXIS, pulse=PULSE)


def test_without_normals_planes_are_on_either_side():
    scan = replace(SCANS["confocal"], wall=None, sensor_normals=None, laser_normals=None)
    grid = VoxelGrid.before(scan, DEPTHS)
    light = noise(AXIS.num_bins, *scan.shape)
    fields = [
        PhasorField(scan, at, time_axis=AXIS, pulse=PULSE, falloff=1.0, dtype=F64).adjoint(light)
        for at in (grid, grid.at_depths([-d for d in reversed(DEPTHS)]))
    ]
    torch.testing.assert_close(fields[1], fields[0].flip(0), rtol=0, atol=1e-12 * float(fields[0].abs().max()))
    for depths in ([-0.1, 0.1], [0.0, 0.1], [-0.1, 0.0]):
        with pytest.raises(ShapeError, match="planes before the wall"):
            PhasorField(scan, grid.at_depths(depths), time_axis=AXIS, pulse=PULSE)


@pytest.mark.parametrize("camera", [ConfocalCamera, TransientCamera])
def test_times_of_cameras_are_a_list_of_finite_numbers(camera):
    assert camera([0.1, 0.2]).times.tolist() == [0.1, 0.2] and camera(torch.tensor([1, 2])).times.dtype == F64
    for times in ([], [[0.1]], 0.1, None, "now"):
        with pytest.raises(ShapeError, match=rf"{camera.__name__}: expected times \(N,\)"):
            camera(times)
    with pytest.raises(UnitError, match=rf"{camera.__name__}: expected finite times"):
        camera([0.1, math.nan])
