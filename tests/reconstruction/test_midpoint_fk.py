"""f-k migration of single and exhaustive captures by their midpoints."""

import math

import numpy as np
import pytest
import torch

from torchtransient.axes import TimeAxis
from torchtransient.capture import Scan, Wall
from torchtransient.errors import ShapeError, UnitError
from torchtransient.reconstruction import MidpointFK

F64 = torch.float64
WALL = Wall.plane(1.0, 1.0)
AXIS = TimeAxis(0.0, 0.0192, 192)


def capture_of(points, scan):
    """(T, *scan.shape): light (r_laser r_sensor)^-2 of points, Gaussian pulses of two bins."""
    spots, sensors = scan.laser_points.reshape(-1, 1, 3), scan.sensor_points.reshape(1, -1, 3)
    light = torch.zeros(AXIS.num_bins, spots.shape[0], sensors.shape[1], dtype=F64)
    for point in torch.tensor(points, dtype=F64):
        near, far = (spots - point).norm(dim=-1), (sensors - point).norm(dim=-1)
        steps = (AXIS.edges_opl[:, None, None] - near - far) / (2 * AXIS.bin_width_opl)
        light += (near * far) ** -2 * torch.special.ndtr(steps).diff(dim=0)
    return light.reshape(AXIS.num_bins, *scan.shape)


SCANS = {
    "single": Scan.grid(WALL, 24, kind="single", laser=(0.5, 0.5)),
    "single, aside": Scan.grid(WALL, 24, kind="single", laser=(0.3, 0.62)),
    "exhaustive": Scan.grid(WALL, 12, kind="exhaustive", laser_grid=4),
}


def midpoints_of(scan, axis):
    """The operator that brings pairs to their midpoints."""
    return MidpointFK(scan, time_axis=axis, dtype=F64).midpoints


@pytest.mark.parametrize("name", SCANS)
def test_midpoints_stand_between_spot_and_sensor_point(name):
    scan = SCANS[name]
    midpoints = midpoints_of(scan, TimeAxis(0.3, 0.04, 25))
    grid = midpoints.wall.points.reshape(-1, 3)
    spots, sensors = scan.laser_points.reshape(-1, 1, 3), scan.sensor_points.reshape(1, -1, 3)
    off = (grid[midpoints.place] - ((spots + sensors) / 2).reshape(-1, 3)).norm(dim=-1)
    # Exactly where one spot has all midpoints on a grid; else within half a step of it in each direction.
    assert float(off.max()) < (1e-9 if scan.kind == "single" else math.hypot(*midpoints.grid.pitch) / 2 + 1e-9)


@pytest.mark.parametrize("name", SCANS)
def test_moveout_is_linear_interpolation_with_nothing_outside_of_the_record(name):
    # Written out for every pair; many lengths lie behind a record this short.
    axis = TimeAxis(0.3, 0.04, 25)
    midpoints = midpoints_of(SCANS[name], axis)
    light = 1 + torch.rand(midpoints.data_shape, dtype=F64, generator=torch.Generator().manual_seed(0))
    places, centers = math.prod(midpoints.wall.size), axis.centers_opl.numpy()
    padded = np.concatenate([[centers[0] - 0.04], centers, [centers[-1] + 0.04]])
    expected, pairs = np.zeros((25, places)), np.zeros(places)
    columns = light.reshape(25, -1).numpy()
    for pair, place in enumerate(midpoints.place.tolist()):
        later = np.sqrt(centers**2 + float(midpoints.distance_squared[pair]))
        row = np.concatenate([[0.0], columns[:, pair], [0.0]])
        expected[:, place] += np.interp(later, padded, row, left=0.0, right=0.0)
        pairs[place] += 1
    expected = torch.from_numpy(expected / pairs.clip(1)).reshape(midpoints.volume_shape)
    assert (expected[-1] == 0).any() and (expected[:, expected.sum(0) > 0] == 0).any()
    torch.testing.assert_close(midpoints.adjoint(light), expected, rtol=0, atol=1e-12)
    # Dark bins behind a record are the same record; what stands in its last bin does not reach beyond it.
    longer = midpoints_of(SCANS[name], TimeAxis(0.3, 0.04, 40))
    dark = torch.cat([light, torch.zeros(15, *light.shape[1:], dtype=F64)])
    torch.testing.assert_close(longer.adjoint(dark)[:25], midpoints.adjoint(light), rtol=0, atol=1e-12)
    light[-1] = math.nan
    behind = np.sqrt(centers[-1] ** 2 + midpoints.distance_squared.numpy()) > centers[-1] + 0.041
    last = midpoints.adjoint(light)[-1].flatten()
    alone = [p for p in range(places) if behind[midpoints.place.numpy() == p].all()]
    assert len(alone) and not last[alone].isnan().any()


def test_points_come_out_where_they_are():
    place, scan = (0.1, -0.1, 0.9), SCANS["exhaustive"]
    operator = MidpointFK(scan, time_axis=AXIS, dtype=F64)
    volume = operator.reconstruct(capture_of([place], scan))
    found = operator.points.reshape(-1, 3)[volume.argmax()]
    # Within a step of the fine grid, and a bin.
    assert float((found - torch.tensor(place)).abs().max()) < 0.045


def test_what_it_cannot_take_is_refused():
    with pytest.raises(ShapeError, match="Use FK"):
        MidpointFK(Scan.grid(WALL, 8, kind="confocal"), time_axis=AXIS)
    with pytest.raises(ShapeError, match="first and last"):
        MidpointFK(Scan.grid(WALL, 8, kind="single", first_and_last_leg=True), time_axis=AXIS)
    with pytest.raises(ShapeError, match="within their rectangle"):
        MidpointFK(Scan.grid(WALL, 8, kind="single", laser=(0.9, 0.9), extent=(0, 0, 0.5, 0.5)), time_axis=AXIS)
    with pytest.raises(UnitError, match="from zero on"):
        MidpointFK(SCANS["single"], time_axis=TimeAxis(-0.1, 0.02, 32))
    with pytest.raises(UnitError, match="dtype"):
        MidpointFK(SCANS["single"], time_axis=AXIS, dtype=torch.float16)
