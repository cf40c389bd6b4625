"""Memory of methods, default grids, wavelengths and cameras in numbers that were counted by hand."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

import torchtransient as tt
from support.scalars import no_gradient_is_lost
from torchtransient.errors import ShapeError, UnitError

N = tt.nlos
F64 = torch.float64
AXIS = tt.TimeAxis(0.0, 0.02, 64)
WALL = N.Wall.plane(1.0, 0.6)
SCANS = {kind: N.Scan.grid(WALL, (5, 6), kind=kind) for kind in ("confocal", "single")}
SCANS["exhaustive"] = N.Scan.grid(WALL, (5, 6), kind="exhaustive", laser_grid=(2, 1))


def wavelength_of(capture):
    """The default."""
    grid = N.default_grid(capture, depths=(0.25, 0.5), planes=1, size=1, extent=0.1)
    return N.reconstruct(capture, "fbp", grid=grid, progress=False).metadata["settings"]["wavelength"]


def captured(kind="confocal", lead=(), dtype=torch.float32, axis=AXIS, channels=1):
    scan = SCANS[kind]
    return N.Capture(torch.zeros(*lead, channels, axis.num_bins, *scan.shape, dtype=dtype), axis, scan)


# -------------------------------------------------------------------------------------------------------- default grids


@pytest.mark.parametrize(("start", "depths", "planes", "first", "last", "count"), [
    # Half the record, a plane for each bin; from a fiftieth of its end on where it begins at zero.
    (1.0, None, None, 0.5, 0.9, 20), (0.0, None, None, 0.008, 0.4, 20), (-0.2, None, None, 0.006, 0.3, 15),
    (1.0, (0.25, 0.5), None, 0.25, 0.5, 13), (1.0, (0.25, 0.5), 4, 0.25, 0.5, 4), (1.0, (0.0, 9.0), None, 0.0, 9.0, 64),
    (1.0, (0.25, 0.26), None, 0.25, 0.26, 2), (1.0, (0.25, 0.5), 1, 0.25, 0.5, 1),
])  # fmt: skip
def test_planes_that_nobody_gave(start, depths, planes, first, last, count):
    capture = captured(axis=tt.TimeAxis(start, 0.04, 20))
    found = N.default_grid(capture, depths=depths, planes=planes)
    expected = first + (last - first) * (torch.arange(count, dtype=F64) + 0.5) / count
    torch.testing.assert_close(found.depths, expected, rtol=0, atol=1e-12)
    assert found.size == (6, 5)


def test_legs_come_off_the_depths():
    scan = replace(SCANS["confocal"], first_and_last_leg=True)
    legs = float(scan.legs.min())
    axis = tt.TimeAxis(legs + 0.4, 0.04, 10)
    found = N.default_grid(N.Capture(torch.zeros(1, 10, *scan.shape), axis, scan))
    torch.testing.assert_close(found.depths, 0.2 + 0.02 * (torch.arange(10, dtype=F64) + 0.5), rtol=0, atol=1e-12)
    for start in (-1.0, legs - 0.41):
        early = N.Capture(torch.zeros(1, 10, *scan.shape), tt.TimeAxis(start, 0.04, 10), scan)
        with pytest.raises(UnitError, match=f"longer than its legs, {legs:.4g} m"):
            N.default_grid(early)
    # Two metres of legs, and a record that ends there.
    one = listed([[0.0, 0.0, 0.0]], first_and_last_leg=True)
    with pytest.raises(UnitError, match="longer than its legs, 2 m, got 2 m"):
        N.default_grid(N.Capture(torch.zeros(1, 8, 1), tt.TimeAxis(0.0, 0.25, 8), one))


def test_scans_that_carry_gradients_have_plain_numbers():
    scan = replace(SCANS["confocal"], first_and_last_leg=True)
    axis = tt.TimeAxis(float(scan.legs.min()) + 0.4, 0.04, 10)
    plain = N.Capture(torch.zeros(1, 10, *scan.shape), axis, scan)
    points = scan.sensor_points.clone().requires_grad_()
    carrying = replace(plain, scan=replace(scan, sensor_points=points, laser_points=points))
    lists = [listed(scan.sensor_points.reshape(-1, 3)[:5].clone().requires_grad_(keep)) for keep in (True, False)]
    with no_gradient_is_lost():
        assert N.default_grid(carrying) == N.default_grid(plain)
        waves = [wavelength_of(N.Capture(torch.rand(1, 64, 5), AXIS, one)) for one in lists]
    assert waves[0] == waves[1] > 4 * AXIS.bin_width_opl


def test_voxels_stand_before_the_points_of_a_flat_grid():
    scan = SCANS["confocal"]
    found = N.default_grid(captured(), depths=(0.25, 0.5), planes=2)
    assert found == N.VoxelGrid.before(scan, [0.3125, 0.4375])
    # As many on a wall that is not flat, rows first.
    corners = [[-0.5, -0.3, 0.0], [0.5, -0.3, 0.0], [0.5, 0.3, 0.1], [-0.5, 0.3, 0.0]]
    bent = N.Scan.grid((corners, [[0, 1, 2], [0, 2, 3]]), (5, 6), kind="confocal")
    assert N.default_grid(N.Capture(torch.zeros(1, 64, 6, 5), AXIS, bent), depths=(0.2, 0.4)).size == (6, 5)


def listed(points, **changes):
    origins = {"sensor_origin": (0.0, 0.0, 1.0), "laser_origin": (0.0, 0.0, 1.0)}
    return N.Scan.points(torch.as_tensor(points, dtype=F64), kind="confocal", **{**origins, **changes})


@pytest.mark.parametrize(("count", "side"), [(4, 2), (5, 3)])
def test_lists_have_as_many_voxels_as_a_square_of_them(count, side):
    points = SCANS["confocal"].sensor_points.reshape(-1, 3)[7 : 7 + count]
    scan = listed(points, wall=WALL)
    capture = N.Capture(torch.zeros(1, 64, count), AXIS, scan)
    assert N.default_grid(capture, depths=(0.2, 0.4)).size == (side, side)
    assert N.default_grid(capture, depths=(0.2, 0.4), size=(7, 2)).size == (2, 7)
    assert N.default_grid(capture, depths=(0.2, 0.4), size=3, extent=(0.3, 0.6)).pitch == pytest.approx((0.2, 0.1))
    wide = N.default_grid(capture, depths=(0.2, 0.4), extent=(0.25, 0.5))
    assert wide.size == (side, side) and wide.pitch == pytest.approx((0.5 / side, 0.25 / side))


def test_captures_without_a_transient_have_no_grid():
    phasors = N.Capture(None, None, SCANS["single"], phasor=torch.zeros(1, 1, 6, 5, dtype=torch.complex64),
                        frequencies=tt.FrequencyAxis((1.0,)))  # fmt: skip
    for call in (lambda: N.default_grid(phasors), lambda: N.reconstruct(phasors)):
        with pytest.raises(ShapeError, match="expected a capture with a transient, got phasors alone"):
            call()


# ---------------------------------------------------------------------------------------------- pitches and wavelengths


@pytest.mark.parametrize(("kind", "width", "expected"), [
    ("confocal", 0.02, 0.8), ("single", 0.02, 0.4), ("single", 0.125, 0.5), ("exhaustive", 0.02, 0.4),
])  # fmt: skip
def test_wavelengths_of_pitches_and_of_bins(kind, width, expected):
    assert wavelength_of(captured(kind, axis=tt.TimeAxis(0.0, width, 64))) == pytest.approx(expected)


# ----------------------------------------------------------------------------------------------------- normals, bins


def test_normals_are_those_of_the_brightest_voxel_behind_a_pixel():
    voxels = replace(N.VoxelGrid.before(SCANS["confocal"], [0.1, 0.2]), size=(1, 2))
    vectors = torch.zeros(5, 2, 3, 2, 1, 2)
    # Of the first item both channels together: (0, 3, -4) in the second plane, (0, 0, -2) in the first.
    vectors[0, 0, :, 1, 0, 0], vectors[0, 1, :, 1, 0, 0] = torch.tensor([0, 3.0, 0]), torch.tensor([0, 0, -4.0])
    vectors[0, 0, :, 0, 0, 0] = torch.tensor([0, 0, 4.5])
    vectors[0, 1, :, 0, 0, 1] = torch.tensor([0, 0, -2.0])
    vectors[1] = 7.0
    volume = N.HiddenVolume(vectors.norm(dim=2), voxels, "directional-lct", directions=vectors)
    found = N.normals_of(volume)
    torch.testing.assert_close(found[:, 0], torch.tensor([[0.0, 0], [0.6, 0], [-0.8, -1]]))
    one = N.HiddenVolume(vectors[0].norm(dim=1), voxels, "directional-lct", directions=vectors[0])
    torch.testing.assert_close(N.normals_of(one), found)
    dark = N.HiddenVolume(torch.zeros(1, 2, 1, 2), voxels, "x", directions=torch.zeros(1, 3, 2, 1, 2))
    assert not N.normals_of(dark).any()
    with pytest.raises(ShapeError, match="normals_of: expected a volume with directions"):
        N.normals_of(N.HiddenVolume(torch.zeros(1, 2, 1, 2), voxels, "fk"))


@pytest.mark.parametrize("kind", ["confocal", "exhaustive"])
def test_neighbouring_bins_are_added_up(kind):
    scan = N.Scan.grid(WALL, (3, 2), kind=kind, laser_grid=(1, 2) if kind == "exhaustive" else None)
    light = torch.rand(2, 7, *scan.shape, generator=torch.Generator().manual_seed(0))
    capture = N.Capture(light, tt.TimeAxis(0.5, 0.25, 7), scan)
    found = N.sum_bins(capture, 3)
    assert found.axis == tt.TimeAxis(0.5, 0.75, 2)
    torch.testing.assert_close(found.transient, torch.stack([light[:, :3].sum(1), light[:, 3:6].sum(1)], 1))
    assert N.sum_bins(capture, 1) is capture and N.sum_bins(capture, 7).axis == tt.TimeAxis(0.5, 1.75, 1)
    with pytest.raises(ShapeError, match="expected 7 bins at most, got 8"):
        N.sum_bins(capture, 8)


@pytest.mark.parametrize(("start", "kept"), [(-0.09, 59), (-1e-9, 64), (-0.02, 63)])
def test_light_before_time_zero_is_left_out(start, kept):
    axis = tt.TimeAxis(start, 0.02, 64)
    light = torch.rand(1, 64, *SCANS["confocal"].shape, generator=torch.Generator().manual_seed(0))
    found = N.reconstruct(N.Capture(light, axis, SCANS["confocal"]), "fk", progress=False)
    assert len(found.grid.depths) == kept and found.grid.depths[0] > 0
    cut = tt.TimeAxis(max(0.0, start + 0.02 * (64 - kept)), 0.02, kept)
    expected = N.FK(SCANS["confocal"], time_axis=cut).reconstruct(light[:, 64 - kept :])
    torch.testing.assert_close(found.values, expected, rtol=1e-4, atol=1e-4 * float(expected.max()))


def test_planes_within_the_depths_are_kept():
    capture = captured(axis=tt.TimeAxis(0.0, 0.5, 8))
    found = N.reconstruct(capture, "lct", depths=(0.375, 0.875), progress=False)
    # Of 0.125, 0.375, ... those from the one to the other, both of them too.
    assert found.grid.depths.tolist() == [0.375, 0.625, 0.875] and found.values.shape == (1, 3, 6, 5)
    with pytest.raises(UnitError, match=r"within the record's, 0\.125 to 1\.875 m"):
        N.reconstruct(capture, "lct", depths=(0.4, 0.6), progress=False)


# ---------------------------------------------------------------------------------------------------------------- slabs


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_light_without_a_slab_is_not_negative(dtype):
    scan, axis = N.Scan.grid(WALL, (3, 2), kind="confocal"), tt.TimeAxis(0.0, 0.02, 32)
    light = torch.rand(2, 4, 1, 32, 2, 3, generator=torch.Generator().manual_seed(0), dtype=dtype)
    steady = torch.ones(2, 4, 1, 2, 3)
    stokes = N.Capture(light, axis, scan, polarized=True, steady=steady)
    found = N.without_slab(stokes, 0.02, 10.0)
    slab = N.DiffusionDeconvolution(scan, time_axis=axis, thickness=0.02, snr=10.0, dtype=F64)
    clear = slab.reconstruct(light.double())
    assert bool((clear[:, 0] < 0).any()) and bool((clear[:, 1:] < 0).any())
    expected = torch.cat([clear[:, :1].clamp_min(0), clear[:, 1:]], 1).to(dtype)
    assert found.polarized and found.steady is None and found.transient.dtype == dtype
    torch.testing.assert_close(found.transient, expected)
    plain = N.without_slab(N.Capture(light[:, 1], axis, scan), 0.02, 10.0)
    torch.testing.assert_close(plain.transient, clear[:, 1].clamp_min(0).to(dtype))
