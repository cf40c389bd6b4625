"""Hidden volumes: front views, depths, overlap, correlation, points."""

import dataclasses
import math

import pytest
import torch

from torchtransient import metrics, nlos
from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.reconstruction import HiddenVolume, VoxelGrid

GRID = VoxelGrid.bounds([[-0.4, -0.3, 0.5], [0.4, 0.3, 1.1]], (8, 6, 12))  # voxels of 0.1 x 0.1 x 0.05 m


def blob(center, width=0.08, grid=GRID):
    """A Gaussian around a point, whose logarithm is a parabola."""
    return torch.exp(-(grid.points - torch.tensor(center, dtype=torch.float64)).square().sum(-1) / (2 * width**2))


def found(values, grid=GRID):
    return HiddenVolume(values[None].float(), grid, "fk")


def test_front_views_and_depths():
    volume = torch.zeros(12, 6, 8)
    volume[4, 2, 3], volume[7, 2, 3], volume[6, 1, 1], volume[2, 5, 5] = 1.0, 2.0, -5.0, 0.1
    view = metrics.front_view(volume)
    assert view[2, 3] == 2 and view[1, 1] == 0 and view.sum() == pytest.approx(2.1)
    assert not metrics.front_view(-1 - volume.abs()).any()
    depth = metrics.front_depth(found(volume), threshold=0.06)
    assert depth.isfinite().sum() == 1
    assert float(depth[0, 2, 3]) == pytest.approx(float(GRID.depths[7]), abs=0.01)
    torch.testing.assert_close(metrics.front_depth(volume, GRID.depths, threshold=0.06), depth[0], equal_nan=True)
    assert metrics.front_depth(volume, GRID, threshold=0.04).isfinite().sum() == 2
    with pytest.raises(ShapeError, match="depths="):
        metrics.front_depth(volume)


def test_depths_of_surfaces():
    """A plane 0.03 m behind another, and one place where only the truth has a surface."""
    z = GRID.depths[:, None, None]
    near, far = (torch.exp(-(z - at).square() / 0.005).expand(12, 6, 8).clone() for at in (0.80, 0.83))
    assert float(metrics.front_depth_mae(found(far), found(near))) == pytest.approx(0.03, abs=2e-3)
    far[:, 2, 2] = 0
    each = metrics.front_depth_mae(found(far), found(near), reduction="none")
    assert each.isnan().sum() == 1 and bool(each[0, 2, 2].isnan())
    iou = metrics.picture_iou(metrics.front_view(found(far)), metrics.front_view(found(near)))
    assert float(iou) == pytest.approx(47 / 48)
    # the same as a depth map, of which the places without an estimate are left out
    ours, truth = metrics.front_depth(found(far)), metrics.front_depth(found(near))
    with pytest.raises(UnitError, match="got 1 of 48"):
        metrics.depth_mae(ours, truth)
    torch.testing.assert_close(
        metrics.depth_mae(ours, truth, mask=ours.isfinite()), metrics.front_depth_mae(found(far), found(near))
    )


def test_overlap_by_hand():
    x, y = torch.zeros(2, 4, 4), torch.zeros(2, 4, 4)
    x[0, 0], y[0, :2] = torch.tensor([4.0, 4.0, 2.0, 1.9]), 1.0
    each = metrics.picture_iou(x, y, reduction="item")
    assert float(each[0]) == pytest.approx(3 / 8) and bool(each[1].isnan())
    assert float(metrics.picture_iou(x, y)) == pytest.approx(3 / 8)
    assert float(metrics.picture_iou(x > 0, y > 0)) == 0.5
    assert float(metrics.picture_iou(x > 0, y)) == 0.5
    assert float(metrics.volume_iou(x, y)) == pytest.approx(3 / 8)
    assert float(metrics.picture_iou(-x, y)) == 0.0
    with pytest.raises(UnitError, match="threshold"):
        metrics.picture_iou(x, y, threshold=1.5)
    # zero and less is nothing, of the lowest threshold too
    signed = torch.tensor([[-2.0, 0.0, 0.5, 3.0]])
    assert float(metrics.picture_iou(signed, torch.tensor([[0.0, 4.0, 1.0, 2.0]]), threshold=0)) == pytest.approx(2 / 3)


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
def test_correlation_by_hand(scale):
    x = torch.tensor([[1.0, 2.0, 3.0, 4.0]]) * scale
    y = torch.tensor([[1.0, 3.0, 2.0, 4.0]])
    assert float(metrics.picture_correlation(x, y)) == pytest.approx(0.8)
    assert float(metrics.picture_correlation(-x, y)) == pytest.approx(-0.8)
    assert float(metrics.picture_correlation(x, y, centered=False)) == pytest.approx(29 / 30)
    wanted = torch.corrcoef(torch.stack([x[0], y[0]]))[0, 1] if scale == 1 else torch.tensor(0.8)
    torch.testing.assert_close(metrics.picture_correlation(x, y), wanted)
    assert float(metrics.picture_correlation(x, y, mask=torch.tensor([[True, False, False, True]]))) == 1.0


def test_flat_pictures():
    flat, slope = torch.full((3, 4), 0.1), torch.linspace(0, 1, 12).view(3, 4)
    assert float(metrics.picture_correlation(flat, slope)) == 0.0
    assert math.isnan(float(metrics.picture_correlation(slope, flat)))
    assert float(metrics.picture_correlation(0 * flat, slope, centered=False)) == 0.0
    assert math.isnan(float(metrics.picture_correlation(slope, 0 * flat, centered=False)))
    both = metrics.picture_correlation(torch.stack([slope, slope]), torch.stack([flat, slope]))
    assert float(both) == 1.0


def test_volumes_on_two_grids():
    x = blob([0.0, 0.0, 0.8])
    moved = dataclasses.replace(GRID, first=GRID.first + torch.tensor([0.01, 0.0, 0.0], dtype=torch.float64))
    assert float(metrics.volume_correlation(found(x), found(x))) == pytest.approx(1)
    near = dataclasses.replace(GRID, first=GRID.first + 1e-6)  # rounding of files
    for function in (metrics.volume_correlation, metrics.volume_iou, metrics.front_depth_mae):
        with pytest.raises(UnitError, match="on one grid"):
            function(found(x), found(x, moved))
        assert math.isfinite(float(function(found(x), found(x, near))))


# ------------------------------------------------------------------------------------------------------------- points

POINTS = [[-0.21, -0.06, 0.72], [0.23, 0.12, 0.93]]


def test_points_between_voxels_are_found():
    """A parabola misses the top of a Gaussian by a small part of a voxel; the voxel itself by up to half of one."""
    volume = blob(POINTS[0]) + 0.5 * blob(POINTS[1])
    each = metrics.localization_rmse(volume.requires_grad_(), POINTS, radius_m=0.2, grid=GRID, reduction="none")
    assert each.shape == (2,) and float(each.max()) < 0.012 and not each.requires_grad
    volume = volume.detach()
    both = metrics.localization_rmse(found(volume), torch.tensor(POINTS), radius_m=0.2)
    assert float(both) == pytest.approx(math.sqrt(float(each.square().mean())), rel=1e-4)
    alone = (8 + blob(POINTS[0]).log()).clamp_min(0)
    assert float(metrics.localization_rmse(alone, POINTS[:1], radius_m=0.2, grid=GRID)) < 1e-9
    batch = torch.stack([volume, volume.roll(1, 2)])
    item = metrics.localization_rmse(batch, POINTS, radius_m=0.2, grid=GRID, reduction="item")
    assert item.shape == (2,) and float(item[1]) == pytest.approx(0.1, abs=0.02)


def test_uneven_planes():
    depths = torch.cumsum(torch.linspace(0.03, 0.09, 10, dtype=torch.float64), 0) + 0.5
    grid = dataclasses.replace(GRID, depths=depths)
    top = 3 - (grid.points - torch.tensor([0.02, 0.01, 0.9], dtype=torch.float64)).square().sum(-1)
    assert float(metrics.localization_rmse(top, [[0.02, 0.01, 0.9]], radius_m=0.3, grid=grid)) < 1e-9


def test_points_that_are_not_found():
    dark = torch.zeros(GRID.shape)
    assert float(metrics.localization_rmse(dark, POINTS, radius_m=0.15, grid=GRID)) == pytest.approx(0.15)
    with pytest.raises(UnitError, match=r"a voxel within 0\.1 m"):
        metrics.localization_rmse(dark, [[5.0, 0, 0]], radius_m=0.1, grid=GRID)
    with pytest.raises(ArgumentError, match="grid="):
        metrics.localization_rmse(dark, POINTS, radius_m=0.1)
    with pytest.raises(ShapeError, match="on its grid"):
        metrics.localization_rmse(dark[1:], POINTS, radius_m=0.1, grid=GRID)
    with pytest.raises(ShapeError, match="points"):
        metrics.localization_rmse(dark, [[1.0, 2.0]], radius_m=0.1, grid=GRID)
    with pytest.raises(UnitError, match="points"):
        metrics.localization_rmse(dark, [[math.nan, 0, 0]], radius_m=0.1, grid=GRID)
    with pytest.raises(UnitError, match="input of finite"):
        metrics.localization_rmse(dark + math.nan, POINTS, radius_m=0.1, grid=GRID)
    running = metrics.Running(metrics.localization_rmse, radius_m=0.15)
    running.update(found(dark), POINTS)
    assert float(running.compute()) == pytest.approx(0.15)


def test_depth_maps_of_the_library():
    volume = blob([0.0, 0.0, 0.8])
    theirs = nlos.depth_map(volume, GRID)
    ours = metrics.front_depth(volume, GRID)
    torch.testing.assert_close(ours[theirs.mask], theirs.depth[theirs.mask])
    assert bool((ours.isfinite() == theirs.mask).all())


@pytest.mark.parametrize(
    "change",
    [
        {"along_x": -GRID.along_x},
        {"pitch": (GRID.pitch[0], 1.01 * GRID.pitch[1])},
        {"depths": GRID.depths + 0.01 * (GRID.depths - GRID.depths[0])},
        {"normal": -GRID.normal},
    ],
    ids=lambda change: next(iter(change)),
)
def test_every_number_of_a_grid_says_where_voxels_are(change):
    values = torch.rand(1, 12, 6, 8, generator=torch.Generator().manual_seed(0))
    here, there = (HiddenVolume(values, grid, "fk") for grid in (GRID, dataclasses.replace(GRID, **change)))
    assert metrics.volume_iou(here, here).item() == 1
    with pytest.raises(UnitError, match="on one grid"):
        metrics.volume_iou(here, there)


# Voxels of a quarter of a metre, whose numbers are exact.
COARSE = VoxelGrid.bounds([[-1.0, -1.0, 1.0], [1.0, 1.0, 3.0]], (8, 8, 8))


def test_a_voxel_at_the_radius_is_found():
    """And none behind it: the point is in the middle of a voxel, with dim light one voxel beside it and bright light
    three voxels beside it.
    """
    z, y, x = (int(n) // 2 for n in COARSE.shape)
    for axis in range(3):
        place, point = [z, y, x], COARSE.points[z, y, x]
        place[axis] -= 3
        values = torch.zeros(1, 8, 8, 8)
        values[(0, *place)] = 1.0
        place[axis] += 2
        values[(0, *place)] = 0.5
        given = HiddenVolume(values, COARSE, "fk")
        found = metrics.localization_rmse(given, point[None].numpy(), radius_m=0.75)
        assert found.item() == pytest.approx(0.75)
        nearer = metrics.localization_rmse(given, point[None].numpy(), radius_m=0.74)
        assert nearer.item() == pytest.approx(0.25)


@pytest.mark.parametrize("axes", [(0, 1), (1, 2)])
def test_the_radius_is_that_of_a_ball(axes):
    """Bright light in the cube around it alone, 0.71 m away, is not looked at; dim light beside the point is."""
    values, place = torch.zeros(1, 8, 8, 8), [4, 4, 4]
    values[0, 4, 4, 4] = 0.5
    for axis in axes:
        place[axis] -= 2
    values[(0, *place)] = 1.0
    given, point = HiddenVolume(values, COARSE, "fk"), COARSE.points[4, 4, 4]
    assert metrics.localization_rmse(given, point[None].numpy(), radius_m=0.6).item() == 0
    assert metrics.localization_rmse(given, point[None].numpy(), radius_m=0.71).item() == pytest.approx(0.5**0.5)


@pytest.mark.parametrize("centered", [False, True])
@pytest.mark.parametrize("name", ["picture_correlation", "volume_correlation"])
def test_flat_pictures_have_slope_zero(name, centered):
    flat = torch.zeros(2, 4, 4, 4, dtype=torch.float64)
    target = torch.rand(flat.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    flat[1] = target[1] ** 2
    flat.requires_grad_()
    getattr(metrics, name)(flat, target, centered=centered).backward()
    assert torch.equal(flat.grad[0], torch.zeros_like(flat.grad[0]))
    assert flat.grad[1].isfinite().all()
    assert flat.grad[1].abs().max() > 0
