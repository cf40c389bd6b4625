"""What metrics make of pictures without pixels, the highest numbers, and ranges that are just met."""

from __future__ import annotations

import dataclasses
import warnings

import pytest
import torch

from torchtransient import metrics
from torchtransient.errors import UnitError
from torchtransient.reconstruction import HiddenVolume, VoxelGrid


@pytest.mark.parametrize("shape", [(2, 3, 0, 4), (0, 4), (2, 1, 3, 0)])
def test_pictures_without_pixels(shape):
    """Nothing counts, in each of them."""
    empty = torch.zeros(shape)
    for metric in (metrics.picture_correlation, metrics.picture_iou):
        assert metric(empty, empty).isnan()
        each = metric(empty, empty, reduction="none")
        assert each.shape == shape[:-2] and bool(each.isnan().all())


def test_bins_near_the_highest_number():
    """Their sum is more than single precision holds, their shares are not."""
    x = torch.tensor([0.0, 3e38, 3e38, 3e38]).reshape(1, 4, 1, 1)
    y = torch.tensor([3e38, 3e38, 0.0, 0.0]).reshape(1, 4, 1, 1)
    for a, b in ((x, y), (x, y / 1e38), (x / 1e38, y)):
        assert metrics.histogram_total_variation(a, b).item() == pytest.approx(2 / 3)


def test_a_range_that_is_just_met():
    """Numbers of single precision that span the range are within it, whatever they round to; a percent more is not."""
    for k in range(1, 60):
        high, low = 0.1 * k, -0.07 * (k % 7)
        target = torch.tensor([high, low], dtype=torch.float32).expand(1, 8, 2)
        assert metrics.psnr(target + 0.01, target, value_range=high - low).isfinite(), k
        with pytest.raises(UnitError, match="within value_range"):
            metrics.psnr(target, 1.01 * target, value_range=high - low)


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
