"""What phasor fields are made of: frequencies that are dense enough, pieces of a size, planes along the wall."""

import math
from dataclasses import replace

import pytest
import torch

from support.scan_operators import AXIS, DEPTHS, PULSE, SCANS, WALL
from support.sweeps import together
from torchtransient.axes import TimeAxis
from torchtransient.capture import Scan
from torchtransient.errors import ShapeError, UnitError
from torchtransient.reconstruction import (
    ConfocalCamera,
    PhasorField,
    PlanarScan,
    TransientCamera,
    VoxelGrid,
    phasor_field,
)

F64 = torch.float64


def noise(*shape, seed=0):
    return torch.randn(shape, dtype=F64, generator=torch.Generator().manual_seed(seed))


def lengths_by_all_pairs(operator):
    """What the record and the volume hold, without legs, of all voxels and all points: (low, high), (start, end)."""
    scan, points = operator.scan, operator.grid.points.reshape(-1, 3)
    height = float(((points - scan.sensor_points.reshape(-1, 3)[0]) @ operator.wall.normal).abs().min())
    far = float(torch.cdist(points, scan.sensor_points.reshape(-1, 3)).max())
    far_spot = float(torch.cdist(points, scan.laser_points.reshape(-1, 3)).max())
    legs = scan.legs if scan.first_and_last_leg else torch.zeros(1, dtype=F64)
    low, high = height, far
    if scan.kind == "confocal":
        low, high = 2 * height, 2 * far
    elif operator.camera.focuses_laser:
        high = far + far_spot
    if operator.camera.times is not None:
        low, high = low + float(operator.camera.times.min()), high + float(operator.camera.times.max())
    record = operator.axis.start_opl - float(legs.max()), operator.axis.end_opl - float(legs.min())
    return (low, high), record


CAMERAS = {
    "still": None, "confocal camera": ConfocalCamera([-0.2, 0.7, 0.1]), "transient camera": TransientCamera([0.3, 0.9])
}  # fmt: skip


@together("name", SCANS)
@together("camera", CAMERAS)
@together("axis", [AXIS, TimeAxis(1.5, 0.02, 8), TimeAxis(-1.0, 0.02, 60)])
def test_frequencies_are_as_dense_as_records_and_volumes_are_long(name, camera, axis):
    scan = SCANS[name]
    if camera == "transient camera" and scan.kind != "single":
        return
    size, (dy, dx) = (7, 2), PlanarScan.of_scan(scan, "test").pitch
    grid = VoxelGrid.before(scan, [0.12, 0.13, 0.31], size=size, extent=(7 * dx, 2 * dy))
    operator = PhasorField(scan, grid, time_axis=axis, pulse=PULSE, camera=CAMERAS[camera], dtype=F64)
    (low, high), (start, end) = lengths_by_all_pairs(operator)
    # From the earliest length to the last one, and a pulse: nothing of one record comes back.
    period = max(high, end) - min(low, start) + PULSE.cycles * PULSE.wavelength
    spread = 1 / (2 * math.pi * PULSE.sigma)
    numbers = operator.frequencies * period
    assert float(numbers.diff().min()) == pytest.approx(1.0, rel=1e-9) == float(numbers.diff().max())
    torch.testing.assert_close(numbers, numbers.round(), rtol=0, atol=1e-7)
    # Four standard deviations to both sides, and no frequency beyond them.
    off = (operator.frequencies - 1 / PULSE.wavelength) / spread
    assert -4.0 <= float(off[0]) < -4.0 + 1 / (period * spread) and 4.0 >= float(off[-1]) > 4.0 - 1 / (period * spread)
    weights = torch.exp(-(off**2) / 2) * 0.02 / period
    torch.testing.assert_close(operator.band_weights, weights, rtol=1e-9, atol=0)


@pytest.mark.parametrize("budget, items", [(1, 1), (4000, 1), (4000, 3), (30000, 2), (1 << 20, 1)])
@pytest.mark.parametrize("name", ["single", "exhaustive"])
def test_pieces_are_as_large_as_they_may_be_and_all_there_is(name, budget, items, monkeypatch):
    monkeypatch.setattr(phasor_field, "CPU_CHUNK", budget)
    operator = PhasorField(SCANS[name], VoxelGrid.before(SCANS[name], DEPTHS), time_axis=AXIS, pulse=PULSE)
    count, spots = len(operator.frequencies), 4 if name == "exhaustive" else 1
    one = items * math.prod(operator.shape_fft)
    seen = torch.zeros(count, spots, dtype=torch.int64)
    largest = 0
    for band, some in operator._chunks(items, torch.device("cpu")):
        seen[band, some] += 1
        largest = max(largest, (band.stop - band.start) * (some.stop - some.start))
    assert (seen == 1).all()
    assert largest * one <= max(budget, one)
    # All frequencies of one spot before a second spot.
    assert largest == max(1, min(count, budget // one)) * max(1, min(spots, budget // one // count))


def test_transforms_are_no_longer_than_a_convolution():
    scan = Scan.grid(WALL, (5, 8), kind="confocal")
    grid = VoxelGrid.before(scan, DEPTHS, size=(2, 3), extent=(2 * 0.048, 3 * 0.025))
    operator = PhasorField(scan, grid, time_axis=AXIS, pulse=PULSE)
    # 8 + 3 - 1 and 5 + 2 - 1.
    assert operator.shape_fft == (10, 6)


@pytest.mark.parametrize("dim", [0, 1])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_planes_have_the_pitch_of_the_wall_to_a_thousandth_over_their_width(dim, sign):
    scan = SCANS["confocal"]
    grid = VoxelGrid.before(scan, DEPTHS)
    for share, taken in ((0.9, True), (1.1, False)):
        pitch = list(grid.pitch)
        pitch[dim] *= 1 + sign * share * 1e-3 / grid.size[dim]
        other = replace(grid, pitch=tuple(pitch))
        if taken:
            PhasorField(scan, other, time_axis=AXIS, pulse=PULSE)
            continue
        with pytest.raises(ShapeError, match=r"with its pitch of 0\.066667 x 0\.06 m"):
            PhasorField(scan, other, time_axis=AXIS, pulse=PULSE)


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
