"""Where the voxels of a grid stand."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from torchtransient.axes import TimeAxis
from torchtransient.capture import Scan, Wall
from torchtransient.errors import SceneError, ShapeError, UnitError
from torchtransient.reconstruction import FK, VoxelGrid

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
        VoxelGrid(
            grid.depths,
            grid.size,
            grid.pitch,
            first=grid.first,
            along_x=grid.along_x,
            along_y=grid.along_x,
            normal=grid.normal,
        )


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


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_without_normals_voxels_stand_where_sensor_and_laser_do(turned, side):
    points = SCAN.sensor_points.flip(1) if turned else SCAN.sensor_points
    middle = points.mean((0, 1))
    at, aside = middle + side * 0.7 * NORMAL, middle + side * 0.2 * NORMAL
    scan = Scan.points(points, kind="confocal", sensor_origin=at, laser_origin=aside)
    for grid in (
        VoxelGrid.before(scan, [0.5]), VoxelGrid.before(scan, [0.5], size=3),
        FK(scan, time_axis=TimeAxis(0.0, 0.1, 8)).grid,
    ):  # fmt: skip
        heights = (grid.points - middle) @ NORMAL
        assert (side * heights > 0).all()
    # Normals say it themselves; origins in the wall or on both sides do not.
    assert (VoxelGrid.before(SCAN, [0.5]).normal - NORMAL).norm() < 1e-12
    for sensor, laser in ((at, middle), (middle, middle), (at, middle - side * 0.2 * NORMAL)):
        unknown = Scan.points(points, kind="confocal", sensor_origin=sensor, laser_origin=laser)
        grid = VoxelGrid.before(unknown, [0.5])
        assert torch.equal(grid.normal, torch.linalg.cross(grid.along_x, grid.along_y))


def test_numbers_of_other_kinds():
    box = [[0, 0, 0], [1, 1, 1]]
    assert VoxelGrid.bounds(box, np.int64(2)) == VoxelGrid.bounds(box, 2.0) == VoxelGrid.bounds(box, (2, 2, 2))
    assert VoxelGrid.bounds(box, torch.tensor([2, 3, 4])).shape == (4, 3, 2)
    for size in ("2", None, [[1, 2, 3]], {}):
        with pytest.raises(ShapeError, match="size"):
            VoxelGrid.bounds(box, size)
    for size in (2.5, True, math.nan, -1):
        with pytest.raises((SceneError, ShapeError), match="size"):
            VoxelGrid.bounds(box, size)
    grid = VoxelGrid.before(SCAN, [0.1])
    for name, value in (("size", 2), ("pitch", 0.1), ("size", (2, 2, 2)), ("pitch", None), ("size", "ab")):
        with pytest.raises(ShapeError, match=f"VoxelGrid: {name}"):
            replace(grid, **{name: value})
    for name in ("first", "along_x", "normal"):
        with pytest.raises(UnitError, match=f"{name} of finite"):
            replace(grid, **{name: [math.nan, 0.0, 0.0]})
