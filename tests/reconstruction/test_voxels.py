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
    with pytest.raises(UnitError, match="extent"):
        VoxelGrid.before(SCAN, [0.1], extent=-1.0)
    with pytest.raises(SceneError, match="size"):
        VoxelGrid.before(SCAN, [0.1], size=0)
    listed = Scan.points([[0, 0, 0], [1, 0, 0]], kind="confocal", sensor_origin=(0, 0, 1), laser_origin=(0, 0, 1))
    with pytest.raises(SceneError, match=r"extent=\(width, height\)"):
        VoxelGrid.before(listed, [0.1], size=3)
    with pytest.raises(ShapeError, match="as a grid"):
        VoxelGrid.before(listed, [0.1])
    with pytest.raises(UnitError):
        VoxelGrid.bounds([[0, 0, 0], [1, 0, 1]], 3)
    grid = VoxelGrid.before(SCAN, [0.1])
    with pytest.raises(ShapeError, match="right angles"):
        replace(grid, along_y=grid.along_x)
    with pytest.raises(ShapeError, match="size and pitch"):
        replace(grid, size=(2, 3, 4))


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


def test_voxels_stand_where_their_axes_say():
    # Along axes of the world in another order, so that nothing can be exchanged.
    grid = VoxelGrid(
        [0.25, 1.0, 4.0], (2, 3), (0.5, 2.0), first=[10.0, 20.0, 30.0], along_x=[0, 1, 0], along_y=[0, 0, 1],
        normal=[1, 0, 0],
    )  # fmt: skip
    assert grid.shape == (3, 2, 3) and grid.points.shape == (3, 2, 3, 3) and grid.extent == (6.0, 1.0)
    for k, j, i in np.ndindex(3, 2, 3):
        depth = (0.25, 1.0, 4.0)[k]
        assert grid.points[k, j, i].tolist() == [10.0 + depth, 20.0 + 2.0 * i, 30.0 + 0.5 * j]
    assert repr(grid) == "VoxelGrid((3, 2, 3), 0.5 x 2 m apart, depths 0.25 to 4 m)"


def test_one_row_of_points_takes_the_axes_of_its_wall():
    row = Scan.points(SCAN.sensor_points[:1], kind="confocal", sensor_origin=(1.6, 2.0, 3.8),
                      laser_origin=(1.6, 2.0, 3.8), wall=WALL)  # fmt: skip
    grid = VoxelGrid.before(row, [0.5], extent=(1.2, 0.2))
    expected = SCAN.sensor_points[:1] + 0.5 * NORMAL
    torch.testing.assert_close(grid.points[0], expected, rtol=0, atol=1e-12)
    assert VoxelGrid.before(row, [0.5], size=3, extent=(1.2, 0.2)).pitch == pytest.approx((0.2 / 3, 0.4))
    with pytest.raises(SceneError, match="extent"):
        VoxelGrid.before(row, [0.5], size=3)


def test_lists_that_know_no_wall_have_upright_planes_across_their_normal():
    """Of a wall turned about y, of points on one line in it, and of one that lies flat; columns run upwards."""
    turn, generator = 0.5, torch.Generator().manual_seed(0)
    normal = torch.tensor([math.sin(turn), 0.0, math.cos(turn)], dtype=F64)
    across, up = torch.tensor([math.cos(turn), 0.0, -math.sin(turn)], dtype=F64), torch.eye(3, dtype=F64)[1]
    u, v = 2 * torch.rand(2, 9, generator=generator, dtype=F64) - 1
    origins = {"sensor_origin": 0.5 * normal, "laser_origin": 0.5 * normal}
    for heights, known in ((v, None), (v, normal.expand(9, 3)), (0 * v, None)):
        points = u[:, None] * across + heights[:, None] * up
        grid = VoxelGrid.before(
            Scan.points(points, kind="confocal", normals=known, **origins), [0.5], size=2, extent=(1.0, 2.0)
        )
        for found, expected in ((grid.along_x, across), (grid.along_y, up), (grid.normal, normal)):
            torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)
    on_it = Scan.points([[0.0, 0, 0], [1, 0, 0]], kind="confocal", sensor_origin=(2, 0, 0), laser_origin=(2, 0, 0))
    with pytest.raises(ShapeError, match="Give their normals"):
        VoxelGrid.before(on_it, [0.5], size=2, extent=1.0)
    floor = torch.stack([u, 0 * u, v], -1)
    above = {"sensor_origin": (0.0, 0.5, 0.0), "laser_origin": (0.0, 0.5, 0.0)}
    grid = VoxelGrid.before(Scan.points(floor, kind="confocal", **above), [0.5], size=2)
    torch.testing.assert_close(torch.stack([grid.along_y, grid.normal]), torch.eye(3, dtype=F64)[[2, 1]])
    assert grid.extent == pytest.approx((float(u.max() - u.min()), float(v.max() - v.min())))


def test_planes_of_a_bent_wall_are_parallel_to_its_mean_one():
    across, up = torch.tensor([0.0, 1.0, 2.0, 4.0], dtype=F64), torch.tensor([-1.0, 0.0, 2.0], dtype=F64)
    x, y = torch.meshgrid(across, up, indexing="xy")
    points = torch.stack([x, y, 0.1 * x * y + 0.05 * x], -1)
    scan = Scan.points(points, kind="confocal", sensor_origin=(0, 0, 9.0), laser_origin=(0, 0, 9.0))
    across, up = (points[:, -1] - points[:, 0]).mean(0), (points[-1] - points[0]).mean(0)
    along_x = across / across.norm()
    along_y = torch.nn.functional.normalize(up - (up @ along_x) * along_x, dim=0)
    normal = torch.linalg.cross(along_x, along_y)
    grid = VoxelGrid.before(scan, [0.5, 0.75], size=(5, 4), extent=(2.0, 6.0))
    for found, expected in ((grid.along_x, along_x), (grid.along_y, along_y), (grid.normal, normal)):
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-14)
    # Around the middle between the outermost points, depths from the mean of all.
    u, v, w = (points.reshape(-1, 3) @ axis for axis in (along_x, along_y, normal))
    middle = (u.max() + u.min()) / 2 * along_x + (v.max() + v.min()) / 2 * along_y + w.mean() * normal
    expected = middle + torch.tensor([[0.5], [0.75]]) * normal
    torch.testing.assert_close(grid.points.mean((1, 2)), expected, rtol=0, atol=1e-13)
    assert grid.pitch == pytest.approx((1.5, 0.4)) and grid.size == (4, 5)
    with pytest.raises(ShapeError, match="without size and extent: expected sensor points on a regular"):
        VoxelGrid.before(scan, [0.5])
