"""Phasor fields against sums that are written out, against filtered backprojection, and in time."""

import math
from dataclasses import replace

import pytest
import torch

from support.scan_operators import AXIS, DEPTHS, PULSE, SCANS, WALL, bent_scan
from tools.point_captures import point_capture
from torchtransient.axes import TimeAxis
from torchtransient.capture import Scan
from torchtransient.errors import ArgumentError, SceneError, ShapeError, UnitError
from torchtransient.reconstruction import (
    ConfocalCamera,
    FilteredBackprojection,
    PhasorField,
    PhasorFilter,
    TransientCamera,
    VoxelGrid,
    phasor_field,
    phasor_image,
)

F64 = torch.float64


def noise(*shape, seed=0):
    return torch.randn(shape, dtype=F64, generator=torch.Generator().manual_seed(seed))


def written_out(scan, points, light, operator, falloff, moments=None):
    """Sum over frequencies and pairs of phasor times wave, at points (V, 3); light (T, *scan.shape)."""
    spots, sensors = scan.laser_points.reshape(-1, 3), scan.sensor_points.reshape(-1, 3)
    legs = scan.first_and_last_leg
    first, last = scan.laser_legs.reshape(-1) * legs, scan.sensor_legs.reshape(-1) * legs
    to_spot, to_sensor = (torch.cdist(points, p) for p in (spots, sensors))
    if scan.kind == "exhaustive":
        lengths = to_spot[:, :, None] + to_sensor[:, None, :]
        weights = (to_spot[:, :, None] * to_sensor[:, None, :]) ** -falloff
        offsets = first[:, None] + last
    else:
        lengths, weights, offsets = to_spot + to_sensor, (to_spot * to_sensor) ** -falloff, first + last
    if moments is not None:
        lengths, weights = to_sensor, to_sensor**-falloff
    lengths, weights = lengths.reshape(len(points), -1), weights.reshape(len(points), -1)
    found = 0
    for f, w in zip(operator.frequencies, operator.band_weights, strict=True):
        arrivals = operator.axis.centers_opl[:, None] - offsets.reshape(-1)
        phasors = (light.flatten(1) * torch.exp(-2j * math.pi * f * arrivals)).sum(0)
        field = (weights * phasors * torch.exp(2j * math.pi * f * lengths)).sum(1)
        if moments is not None:
            field = torch.exp(2j * math.pi * f * moments)[:, None] * field
        found = found + w * field
    return found


@pytest.mark.parametrize("name", [*SCANS, "single, elsewhere"])
@pytest.mark.parametrize("falloff", [0.0, 1.0])
def test_is_the_sum_that_is_written_out(name, falloff):
    scan = SCANS[name.removesuffix(", elsewhere")]
    grid = VoxelGrid.before(scan, DEPTHS)
    if "elsewhere" in name:  # more rows and columns of the scan's pitch, behind each other as they like
        dy, dx = 0.2 / 3, 0.06
        grid = VoxelGrid.before(scan, [0.12, 0.13, 0.31], size=(7, 2), extent=(7 * dx, 2 * dy))
    operator = PhasorField(scan, grid, time_axis=AXIS, pulse=PULSE, falloff=falloff, dtype=F64)
    light = noise(*operator.data_shape)
    expected = written_out(scan, grid.points.reshape(-1, 3), light, operator, falloff).reshape(grid.shape)
    most = float(expected.abs().max())
    torch.testing.assert_close(operator.adjoint(light), expected, rtol=0, atol=1e-11 * most)
    # The picture is the intensity.
    torch.testing.assert_close(operator.reconstruct(light), expected.abs().square(), rtol=0, atol=1e-10 * most**2)


def test_transient_camera_is_the_sum_that_is_written_out():
    scan, moments = SCANS["single"], torch.tensor([0.1, 0.2, 0.35], dtype=F64)
    grid = VoxelGrid.before(scan, DEPTHS)
    operator = PhasorField(scan, grid, time_axis=AXIS, pulse=PULSE, camera=TransientCamera(moments), dtype=F64)
    light = noise(*operator.data_shape)
    expected = written_out(scan, grid.points.reshape(-1, 3), light, operator, 0.0, moments).reshape(3, *grid.shape)
    torch.testing.assert_close(operator.adjoint(light), expected, rtol=0, atol=1e-11 * float(expected.abs().max()))


@pytest.mark.parametrize("name", [*SCANS][::3])
def test_pieces_do_not_show(name, monkeypatch):
    scan = SCANS[name]
    operator = PhasorField(scan, VoxelGrid.before(scan, DEPTHS), time_axis=AXIS, pulse=PULSE, dtype=F64)
    light = noise(2, *operator.data_shape)
    whole = operator.adjoint(light)
    forward = operator(whole)
    for budget in (1, 2 * math.prod(operator.shape_fft) * (len(operator.frequencies) + 1)):
        monkeypatch.setattr(phasor_field, "CPU_CHUNK", budget)
        torch.testing.assert_close(operator.adjoint(light), whole, rtol=1e-11, atol=1e-11)
        torch.testing.assert_close(operator(whole), forward, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("cycles", [1.0, 2.0, 3.9])
def test_short_pulses_have_all_their_frequencies(cycles):
    # The definition: the pulse at the exact length of every pair, from the middle of every bin.
    scan, axis, pulse = SCANS["confocal"], TimeAxis(0.1, 0.02, 60), PhasorFilter(0.2, cycles)
    grid = VoxelGrid.before(scan, [0.2, 0.3])
    light = point_capture(scan, [(0.0, 0.02, 0.25)], time_axis=axis).transient[0] + 1e-3
    lengths = 2 * torch.cdist(grid.points.reshape(-1, 3), scan.sensor_points.reshape(-1, 3))
    off = lengths[..., None] - axis.centers_opl
    height = torch.exp(-(off**2) / (2 * pulse.sigma**2)) * 0.02 / (pulse.sigma * math.sqrt(2 * math.pi))
    matrix = torch.polar(height, 2 * math.pi * off / pulse.wavelength)
    expected = torch.einsum("vpt,tp->v", matrix, light.flatten(1).to(matrix)).reshape(grid.shape)
    found = PhasorField(scan, grid, time_axis=axis, pulse=pulse, dtype=F64).adjoint(light)
    assert (found - expected).norm() < 2e-3 * expected.norm()


def test_records_do_not_wrap():
    # Light at the very end of a record, planes at whose lengths it has begun: nothing comes around. The band ends at
    # 3e-4 of its height, which is what is left far from a pulse, in 1 of 14 parts.
    scan = SCANS["confocal"]
    axis = TimeAxis(0.2, 0.01, 200)
    light = torch.zeros(200, *scan.shape, dtype=F64)
    light[-1] = 1.0
    of = {"time_axis": axis, "pulse": PhasorFilter(0.1), "dtype": F64}
    operator = PhasorField(scan, VoxelGrid.before(scan, [0.1, 0.11]), **of)
    late = PhasorField(scan, VoxelGrid.before(scan, [1.08]), **of)
    assert operator.adjoint(light).abs().max() < 3e-4 * late.adjoint(light).abs().max()


def test_a_point_is_brightest_where_it_is():
    wall_scan = Scan.grid(WALL, 12, kind="exhaustive", laser_grid=3)
    grid = VoxelGrid.before(wall_scan, torch.linspace(0.1, 0.2, 11))
    capture = point_capture(wall_scan, grid.points[6, 4, 7][None], time_axis=TimeAxis(0.1, 0.01, 50))
    picture = phasor_image(capture, grid, pulse=PhasorFilter(0.04, 3.0))
    assert picture.shape == (1, 11, 12, 12)
    assert int(picture.argmax()) == (6 * 12 + 4) * 12 + 7


def test_confocal_camera_begins_with_direct_light():
    scan = SCANS["exhaustive, legs"]
    grid = VoxelGrid.before(scan, DEPTHS)
    of = {"time_axis": AXIS, "pulse": PULSE, "dtype": F64}
    still = PhasorField(scan, grid, **of)
    video = PhasorField(scan, grid, camera=ConfocalCamera([0.0, 0.05]), **of)
    # Longer videos need denser frequencies: the same field by another quadrature.
    light = noise(*still.data_shape)
    first = video.adjoint(light)[0]
    assert (first - still.adjoint(light)).norm() < 1e-3 * first.norm()


def test_what_cannot_be_taken():
    scan, grid = SCANS["confocal"], VoxelGrid.before(SCANS["confocal"], DEPTHS)
    of = {"time_axis": AXIS, "pulse": PULSE}
    with pytest.raises(ArgumentError, match="FilteredBackprojection takes points"):
        PhasorField(scan, grid.points, **of)
    with pytest.raises(ArgumentError, match="expected a DirectLight"):
        PhasorField(scan, grid, camera="direct", **of)
    with pytest.raises(SceneError, match="one laser spot"):
        PhasorField(scan, grid, camera=TransientCamera([0.1]), **of)
    with pytest.raises(ShapeError, match="with its pitch"):
        PhasorField(scan, VoxelGrid.before(scan, DEPTHS, size=5), **of)
    with pytest.raises(ShapeError, match="with its pitch"):
        PhasorField(scan, VoxelGrid.bounds([[-1, -1, 0.1], [1, 1, 0.3]], 3), **of)
    with pytest.raises(ShapeError, match="regular, rectangular grid"):
        PhasorField(bent_scan(), grid, **of)
    for depths in ([0.0, 0.1], [-0.2, -0.1, 0.1], [-0.2, -0.1]):
        with pytest.raises(ShapeError, match="planes before the wall"):
            PhasorField(scan, grid.at_depths(depths), **of)


def test_planes_that_touch_the_wall_fall_off_as_half_a_bin_does():
    scan = SCANS["confocal"]
    grid = VoxelGrid.before(scan, [1e-30, 0.1])
    axis = TimeAxis(-0.2, 0.02, 48)
    of = {"time_axis": axis, "falloff": 2.0, "dtype": F64}
    light = noise(axis.num_bins, *scan.shape)
    field = PhasorField(scan, grid, pulse=PULSE, **of).reconstruct(light)
    other = FilteredBackprojection(scan, grid, filter=PULSE, **of).reconstruct(light)
    assert field.isfinite().all()
    assert (field - other).norm() < 0.02 * other.norm()


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
