"""Depths of volumes whose surfaces are known."""

import math

import numpy as np
import pytest
import torch

from torchtransient.capture import Scan, Wall
from torchtransient.errors import ShapeError, UnitError
from torchtransient.reconstruction import VoxelGrid, depth_map

F64 = torch.float64
UNEVEN = torch.tensor([0.5, 0.52, 0.55, 0.6, 0.62, 0.66, 0.7, 0.75], dtype=F64)


def grid_of(depths, size=9):
    """On a wall that does not stand along the axes of the world."""
    wall = Wall.plane(1.0, 0.8, center=(1.0, 2.0, 3.0), normal=(0.6, 0.0, 0.8))
    return VoxelGrid.before(Scan.grid(wall, size, kind="confocal"), depths)


def slanted(grid, slope_x, slope_y, width):
    """A plane's brightness (Z, Y, X) under a Gaussian profile along depth, and its depth (Y, X)."""
    y, x = (torch.arange(n, dtype=F64) - (n - 1) / 2 for n in grid.size)
    depth = 0.6 + slope_x * grid.pitch[1] * x + slope_y * grid.pitch[0] * y[:, None]
    return torch.exp(-((grid.depths[:, None, None] - depth) ** 2) / (2 * width**2)), depth


def test_tops_beyond_the_planes_stay_on_them():
    volume = 2 - (UNEVEN[:, None, None] - torch.tensor([[0.3, 0.9]], dtype=F64)) ** 2
    torch.testing.assert_close(depth_map(volume, UNEVEN).depth, torch.tensor([[0.5, 0.75]], dtype=F64))


def test_confidence_and_mask():
    volume = torch.zeros(2, 3, 1, 4)
    volume[0, 1, 0] = torch.tensor([1.0, 0.5, 0.09, 0.0])
    found = depth_map(volume, [0.1, 0.2, 0.3])
    assert torch.equal(found.confidence[0, 0], volume[0, 1, 0])
    assert found.mask[0, 0].tolist() == [True, True, False, False]
    assert not found.mask[1].any()
    assert torch.isfinite(found.depth).all()
    assert depth_map(volume, [0.1, 0.2, 0.3], threshold=0.01).mask[0, 0].tolist() == [True, True, True, False]
    assert not depth_map(-volume - 1, [0.1, 0.2, 0.3]).mask.any()


def test_derivatives_of_depth():
    generator = torch.Generator().manual_seed(3)
    bumps = 1 - 20 * (UNEVEN[:, None, None] - (0.56 + 0.1 * torch.rand(2, 3, dtype=F64, generator=generator))) ** 2
    volume = bumps.requires_grad_()
    assert torch.autograd.gradcheck(lambda v: depth_map(v, UNEVEN).depth, volume)


def test_depths_as_a_tensor_inside_of_torch_func():
    volume, planes = torch.rand(4, 2, 3, generator=torch.Generator().manual_seed(0)), torch.tensor([0.1, 0.2, 0.4, 0.5])
    leaf = volume.clone().requires_grad_()
    (wanted,) = torch.autograd.grad(depth_map(leaf, planes).depth.sum(), leaf)
    found = torch.func.grad(lambda v: depth_map(v, planes).depth.sum())(volume)
    torch.testing.assert_close(found, wanted)


def test_gradients_of_empty_volumes_are_finite():
    grid = grid_of(UNEVEN, 3)
    volume = torch.zeros(2, *grid.shape, requires_grad=True)
    result = depth_map(volume, grid).depth
    assert torch.isfinite(result).all()
    (gradient,) = torch.autograd.grad(result.sum(), volume)
    assert torch.isfinite(gradient).all()


@pytest.mark.parametrize("slopes", [(0.3, 0.0), (0.25, -0.2)])
def test_depths_of_planes(slopes):
    grid = grid_of(torch.linspace(0.3, 0.9, 61, dtype=F64))
    volume, depth = slanted(grid, *slopes, 0.06)
    # A Gaussian is no parabola: some thousandths of a step of 1 cm.
    assert (depth_map(volume, grid).depth - depth).abs().max() < 1e-4


def test_what_cannot_be_taken():
    grid = grid_of(UNEVEN)
    with pytest.raises(ShapeError, match="expected a volume"):
        depth_map(torch.zeros(3, 3, 3), grid)
    with pytest.raises(ShapeError, match="squared modulus"):
        depth_map(torch.zeros(grid.shape, dtype=torch.complex64), grid)
    with pytest.raises(ShapeError, match="expected depths"):
        depth_map(torch.zeros(grid.shape), None)
    with pytest.raises(UnitError, match="increase"):
        depth_map(torch.zeros(2, 2, 2), [0.2, 0.1])
    with pytest.raises(UnitError, match="threshold"):
        depth_map(torch.zeros(grid.shape), grid, threshold=2.0)


def test_planes_that_single_precision_does_not_tell_apart():
    # A hundred metres away, where neighbouring numbers are 8e-6 m apart.
    grid = grid_of(100 + 2.5e-6 * torch.arange(64, dtype=F64))
    volume = torch.rand(grid.shape, generator=torch.Generator().manual_seed(1))
    found, expected = depth_map(volume, grid).depth, depth_map(volume.double(), grid).depth
    assert (found.double() - expected).abs().max() < 1e-5


@pytest.mark.parametrize("strange", [math.nan, -math.inf])
def test_what_is_not_finite_makes_its_own_pixel_empty(strange):
    volume = torch.rand(2, 8, 3, 3, generator=torch.Generator().manual_seed(1)).requires_grad_()
    broken = volume.clone()
    broken[0, 2, 1, 1] = strange
    found, whole = depth_map(broken, UNEVEN), depth_map(volume, UNEVEN)
    other = torch.ones(2, 3, 3, dtype=torch.bool)
    other[0, 1, 1] = False
    assert found.confidence[0, 1, 1] == 0 and not found.mask[0, 1, 1] and found.depth[0, 1, 1].isfinite()
    torch.testing.assert_close(found.depth[other], whole.depth[other], rtol=0, atol=0)
    assert torch.equal(found.mask[1], whole.mask[1]) and found.mask[0].sum() >= 7
    (slope,) = torch.autograd.grad(found.depth.sum() + found.confidence.sum(), volume)
    assert slope.isfinite().all()


@pytest.mark.parametrize("scale", [1e-38, 1e-12, 1e25])
def test_nothing_depends_on_the_unit_of_the_volume(scale):
    grid = grid_of(UNEVEN)
    volume = slanted(grid, 0.2, 0.1, 0.1)[0].float()
    found, expected = depth_map(volume * scale, grid).depth, depth_map(volume, grid).depth
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)


def lumpy(seed=0, size=(6, 5, 7)):
    """A volume on uneven planes of a grid whose rows and columns are not as far apart."""
    wall = Wall.plane(0.9, 0.4, center=(1.0, 2.0, 3.0), normal=(0.6, 0.0, 0.8))
    grid = VoxelGrid.before(Scan.grid(wall, size[:0:-1], kind="confocal"), UNEVEN[: size[0]])
    return torch.rand(size, dtype=F64, generator=torch.Generator().manual_seed(seed)), grid


def test_depths_of_any_volume_are_tops_of_parabolas():
    volume, grid = lumpy(2, (8, 5, 7))
    z, plain = grid.depths.numpy(), volume.numpy()
    found = depth_map(volume, grid, threshold=0.9)
    for j, i in np.ndindex(*grid.size):
        k = int(plain[:, j, i].argmax())
        expected = z[k]
        if 0 < k < 7:
            a, b, _ = np.polyfit(z[k - 1 : k + 2] - z[k], plain[k - 1 : k + 2, j, i], 2)
            expected = z[k] - b / (2 * a)
        assert float(found.depth[j, i]) == pytest.approx(expected, abs=1e-12)
    share = volume.amax(0) / volume.max()
    torch.testing.assert_close(found.confidence, share, rtol=0, atol=1e-15)
    assert torch.equal(found.mask, share >= 0.9) and 0 < int(found.mask.sum()) < 35
