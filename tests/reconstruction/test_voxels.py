"""Where the voxels of a grid stand."""

import math

import pytest
import torch

from torchtransient.capture import Scan, Wall
from torchtransient.errors import SceneError, ShapeError, UnitError
from torchtransient.reconstruction import VoxelGrid

F64 = torch.float64
WALL = Wall.plane(1.2, 0.8, center=(1.0, 2.0, 3.0), normal=(0.6, 0.0, 0.8))
SCAN = Scan.grid(WALL, (6, 4), kind="confocal")
NORMAL = torch.tensor([0.6, 0.0, 0.8], dtype=F64)


def test_before_each_sensor_point():
    grid = VoxelGrid.before(SCAN, [0.5, 0.7])
    assert grid.shape == (2, 4, 6)
    expected = SCAN.sensor_points + torch.tensor([0.5, 0.7], dtype=F64)[:, None, None, None] * NORMAL
    torch.testing.assert_close(grid.points, expected, rtol=0, atol=1e-12)
    assert grid.extent == pytest.approx((1.2, 0.8))


def test_size_and_extent():
    grid = VoxelGrid.before(SCAN, [0.5], size=(3, 2))
    # The same area in other cells.
    assert grid.extent == pytest.approx((1.2, 0.8))
    assert grid.pitch == pytest.approx((0.4, 0.4))
    center = torch.from_numpy(WALL.center) + 0.5 * NORMAL
    torch.testing.assert_close(grid.points.mean((0, 1, 2)), center, rtol=0, atol=1e-12)
    wide = VoxelGrid.before(SCAN, [0.5], size=5, extent=2.0)
    assert wide.pitch == pytest.approx((0.4, 0.4))
    torch.testing.assert_close(wide.points.mean((0, 1, 2)), center, rtol=0, atol=1e-12)
    kept = VoxelGrid.before(SCAN, [0.5], extent=(0.6, 0.4))
    assert kept.size == (4, 6)


def test_lists_of_points_take_the_axes_of_their_wall():
    listed = Scan.points(
        SCAN.sensor_points.reshape(-1, 3), kind="confocal", sensor_origin=(1.6, 2.0, 3.8), laser_origin=(1.6, 2.0, 3.8),
        wall=WALL,
    )  # fmt: skip
    grid = VoxelGrid.before(listed, [0.5], size=4, extent=0.4)
    twin = VoxelGrid.before(SCAN, [0.5], size=4, extent=0.4)
    torch.testing.assert_close(grid.points, twin.points, rtol=0, atol=1e-9)


def test_bounds():
    grid = VoxelGrid.bounds([[0.0, -1.0, 2.0], [1.0, 1.0, 3.0]], (2, 4, 5))
    assert grid.shape == (5, 4, 2)
    assert grid.points[0, 0, 0].tolist() == pytest.approx([0.25, -0.75, 2.1])
    assert grid.points[-1, -1, -1].tolist() == pytest.approx([0.75, 0.75, 2.9])
    assert VoxelGrid.bounds([[0, 0, 0], [1, 1, 1]], 3).shape == (3, 3, 3)


def test_equality_and_other_planes():
    grid = VoxelGrid.before(SCAN, [0.5, 0.7])
    assert grid == VoxelGrid.before(SCAN, torch.tensor([0.5, 0.7], dtype=F64))
    assert hash(grid) == hash(VoxelGrid.before(SCAN, [0.5, 0.7]))
    assert grid != grid.at_depths([0.5, 0.8])
    assert "0.5 to 0.7 m" in repr(grid)


def test_what_is_no_grid():
    for depths in ([], [[0.1]], None, "near"):
        with pytest.raises(ShapeError, match="depths"):
            VoxelGrid.before(SCAN, depths)
    for depths in ([0.2, 0.1], [0.1, 0.1], [math.nan]):
        with pytest.raises(UnitError, match="increase"):
            VoxelGrid.before(SCAN, depths)
    with pytest.raises(ShapeError, match="Scan"):
        VoxelGrid.before(WALL, [0.1])
    with pytest.raises(UnitError, match="extent"):
        VoxelGrid.before(SCAN, [0.1], extent=-1.0)
    with pytest.raises(ShapeError, match="extent"):
        VoxelGrid.before(SCAN, [0.1], extent=(1, 2, 3))
    with pytest.raises(SceneError, match="size"):
        VoxelGrid.before(SCAN, [0.1], size=0)
    listed = Scan.points([[0, 0, 0], [1, 0, 0]], kind="confocal", sensor_origin=(0, 0, 1), laser_origin=(0, 0, 1))
    with pytest.raises(ShapeError, match=r"say where x and y are"):
        VoxelGrid.before(listed, [0.1], size=3, extent=1.0)
    with pytest.raises(ShapeError, match="as a grid"):
        VoxelGrid.before(listed, [0.1])
    with pytest.raises(ShapeError, match="bounds"):
        VoxelGrid.bounds([[0, 0], [1, 1]], 3)
    with pytest.raises(UnitError):
        VoxelGrid.bounds([[0, 0, 0], [1, 0, 1]], 3)
    with pytest.raises(ShapeError, match=r"\(X, Y, Z\)"):
        VoxelGrid.bounds([[0, 0, 0], [1, 1, 1]], (3, 3))
    grid = VoxelGrid.before(SCAN, [0.1])
    with pytest.raises(ShapeError, match="right angles"):
        VoxelGrid(grid.depths, grid.size, grid.pitch, grid.first, grid.along_x, grid.along_x, grid.normal)


def test_walls_that_are_at_right_angles_to_a_share_of_their_pitch_have_voxels():
    # Rows that lean by 5e-4, as points in single precision do: within what a grid may be off.
    points = Scan.grid(Wall.plane(1.0, 1.0), 8, kind="confocal").sensor_points.clone()
    points[..., 0] += 5e-4 * points[..., 1]
    scan = Scan.points(points, kind="confocal", sensor_origin=(0, 0, 1), laser_origin=(0, 0, 1))
    grid = VoxelGrid.before(scan, [0.5, 1.0])
    off = (grid.points[..., :2] - points[..., :2]).norm(dim=-1)
    # The lean itself over seven rows; lengths along it are longer by its square.
    assert float(off.max()) == pytest.approx(5e-4 * 7 / 8, rel=5e-4)
    assert float(grid.along_x @ grid.along_y) == pytest.approx(0.0, abs=1e-15)
