"""What metrics make of pictures without pixels, the highest numbers, and ranges that are just met."""

from __future__ import annotations

import dataclasses
import warnings

import pytest
import torch

from torchtransient import metrics
from torchtransient.errors import UnitError
from torchtransient.reconstruction import HiddenVolume, VoxelGrid


def test_bins_near_the_highest_number():
    """Their sum is more than single precision holds, their shares are not."""
    x = torch.tensor([0.0, 3e38, 3e38, 3e38]).reshape(1, 4, 1, 1)
    y = torch.tensor([3e38, 3e38, 0.0, 0.0]).reshape(1, 4, 1, 1)
    for a, b in ((x, y), (x, y / 1e38), (x / 1e38, y)):
        assert metrics.histogram_total_variation(a, b).item() == pytest.approx(2 / 3)


GRID = VoxelGrid.bounds([[-0.4, -0.3, 0.5], [0.4, 0.3, 1.1]], (8, 6, 12))


def test_points_are_found_without_gradient():
    place = torch.tensor([0.03, 0.02, 0.8], dtype=torch.float64)
    values = torch.exp(-(GRID.points - place).square().sum(-1) / 0.01).float().requires_grad_()
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # torch's, where numbers are taken of what has a gradient
        found = metrics.localization_rmse(HiddenVolume(values[None], GRID, "fk"), place[None].numpy(), radius_m=0.2)
    assert found.item() < 0.02 and not found.requires_grad


@pytest.mark.parametrize(
    "change",
    [
        {"along_x": -GRID.along_x},
        {"along_y": -GRID.along_y},
        {"pitch": (1.01 * GRID.pitch[0], GRID.pitch[1])},
        {"pitch": (GRID.pitch[0], 1.01 * GRID.pitch[1])},
        {"depths": GRID.depths + 0.01},
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


def test_a_floor_of_polarization_has_to_be_exceeded():
    """Light as dim as the floor does not count."""
    stokes = torch.tensor([[0.5, 1.0], [0.5, 0.0], [0.0, 0.0], [0.0, 0.0]]).reshape(4, 1, 1, 2)
    other = torch.zeros(4, 1, 1, 2)
    other[0] = stokes[0]
    each = metrics.dop_mae(other, stokes, floor=0.5, reduction="none")
    assert each.isnan().flatten().tolist() == [True, False]
    each = metrics.dop_mae(other, stokes, floor=0.499, reduction="none")
    assert each.flatten().tolist() == [1.0, 0.0]
    # nor does light of fewer digits than numbers have, whatever the floor
    tiny = torch.finfo(torch.float32).tiny
    for metric in (metrics.dop_mae, metrics.aolp_mae):
        faint = stokes.clone()
        faint[:2, ..., 0] = tiny
        each = metric(faint, faint, floor=0.0, reduction="none")
        assert each.isnan().flatten().tolist()[0]
        faint[:2, ..., 0] = 4 * tiny
        assert metric(faint, faint, floor=0.0, reduction="none").flatten().tolist()[0] == 0.0


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


@pytest.mark.parametrize("axes", [(0, 1), (0, 2), (1, 2)])
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
