"""Surfaces in a reconstructed volume: depth, confidence and normals.

Volumes are (..., Z, Y, X) of real values, higher at surfaces, on a :class:`VoxelGrid` or on planes at given depths.
Everything is differentiable by the volume. Volumes in half precision are taken, and their depths and normals returned,
in float32.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchtransient.checks import share, shown
from torchtransient.errors import ShapeError
from torchtransient.reconstruction.capture_checks import within
from torchtransient.reconstruction.voxels import VoxelGrid, checked_depths


@dataclass(frozen=True)
class DepthMap:
    """Result of :func:`depth_map`.

    Attributes:
        depth: (..., Y, X) metres; a number everywhere, which means nothing outside of the mask.
        confidence: (..., Y, X) in [0, 1].
        mask: (..., Y, X), True where the confidence suffices.
    """

    depth: Tensor
    confidence: Tensor
    mask: Tensor


def depth_map(volume: Tensor, depths: VoxelGrid | Any, *, threshold: float = 0.1) -> DepthMap:
    """Find the depth of the highest value behind each pixel, between planes by a parabola through its neighbours.

    The top of the parabola lies within half a step, evenly spaced planes or not; on the first and the last plane the
    depth is the plane's. Gradients go through the three values of each parabola.

    Args:
        volume: (..., Z, Y, X), real. A pixel with a value that is not finite counts as empty.
        depths: grid, or (Z,) in metres.
        threshold: confidence from which the mask is True, 0 to 1.

    Returns:
        Depth, confidence (the maximum over that of the whole volume, zero where a volume holds nothing above zero),
            mask.

    Raises:
        ShapeError: for a volume that does not fit the planes or is not real.
        UnitError: for depths that do not increase, and a threshold beyond 0 to 1.
    """
    z, volume = _checked(volume, depths, "depth_map")
    threshold = share("depth_map: threshold", threshold)
    if volume.numel() == 0:
        nothing = volume.sum(-3)
        return DepthMap(nothing, nothing.clone(), torch.zeros_like(nothing, dtype=torch.bool))
    volume = torch.where(volume.isfinite().all(-3, keepdim=True), volume, torch.zeros_like(volume))
    highest, index = volume.max(-3, keepdim=True)
    top = highest.amax((-2, -1), keepdim=True)
    confidence = torch.where(top > 0, highest / torch.where(top > 0, top, torch.ones_like(top)), 0.0).clamp(0, 1)
    count, steps = volume.shape[-3], z.diff().to(volume.dtype)
    depth = z.to(volume.dtype)[index]
    if count > 2:
        middle = index.clamp(1, count - 2)
        low, mid, high = (volume.gather(-3, middle + step) for step in (-1, 0, 1))
        before, after = steps[middle - 1], steps[middle]
        # Slopes to both sides of the maximum: the top is where the line between them is zero.
        rise, fall = (mid - low) / before, (mid - high) / after
        inside = (index == middle) & (rise + fall > 0)
        curvature = torch.where(inside, rise + fall, torch.ones_like(mid))
        # f' at the middle is (rise after - fall before) / (before + after), f'' is -2 (rise + fall) / (before + after).
        offset = (rise * after - fall * before) / (2 * curvature)
        offset = torch.minimum(torch.maximum(offset, -before / 2), after / 2)
        depth = torch.where(inside, depth + offset, depth)
    confidence, depth = confidence.squeeze(-3), depth.squeeze(-3)
    return DepthMap(depth, confidence, (confidence >= threshold) & (confidence > 0))


def soft_depth(volume: Tensor, depths: VoxelGrid | Any, *, sharpness: float = 20.0) -> Tensor:
    """Return the mean depth behind each pixel under softmax(``sharpness`` times value over the pixel's maximum).

    Smooth in every value, unlike :func:`depth_map`, and independent of the scale of the volume. Pixels with nothing
    above zero have the mean of all planes.

    Args:
        volume: (..., Z, Y, X), real.
        depths: grid, or (Z,) in metres.
        sharpness: the higher the closer to :func:`depth_map`, and the smaller the gradients of planes next to the
            maximum.

    Returns:
        (..., Y, X), metres.

    Raises:
        ShapeError, UnitError: as :func:`depth_map`.
    """
    z, volume = _checked(volume, depths, "soft_depth")
    sharpness = within("soft_depth: sharpness", sharpness, 1e-30, 1e30)
    if volume.numel() == 0:
        return volume.sum(-3)
    highest = volume.amax(-3, keepdim=True)
    scale = torch.where(highest > 0, highest, torch.ones_like(highest))
    level = torch.where(highest > 0, volume / scale, torch.zeros_like(volume))
    # From the first plane on: far away, single precision has few digits left between planes.
    behind = (z - z[0]).to(volume.dtype)[:, None, None]
    return (torch.softmax(sharpness * level, -3) * behind).sum(-3) + float(z[0])


def normals_from_depth(depth: Tensor, grid: VoxelGrid) -> Tensor:
    """Return unit normals of a depth map, by central differences, one-sided at the borders.

    Normals next to the border of a mask are worth as little as the depth beyond it.

    Args:
        depth: (..., Y, X), metres.
        grid: of the volume.

    Returns:
        (..., 3, Y, X) in world coordinates, towards the wall.

    Raises:
        ShapeError: for depths that do not fit the grid.
    """
    _check_grid(grid, "normals_from_depth")
    if not isinstance(depth, Tensor) or depth.ndim < 2 or tuple(depth.shape[-2:]) != grid.size:
        got = tuple(depth.shape) if isinstance(depth, Tensor) else shown(depth)
        raise ShapeError(f"normals_from_depth: expected depths (..., {grid.size[0]}, {grid.size[1]}), got {got}.")
    if not depth.is_floating_point():
        raise ShapeError(f"normals_from_depth: expected depths of real numbers, got {depth.dtype}.")
    slope_y, slope_x = _slope(depth, -2, grid.pitch[0]), _slope(depth, -1, grid.pitch[1])
    return _world(slope_x, slope_y, -torch.ones_like(depth), grid)


def normals_from_volume(volume: Tensor, grid: VoxelGrid) -> Tensor:
    """Return unit normals from the gradient of a volume, summed from the first plane to the highest value behind each
    pixel.

    Of a brightness f(z - s(x, y)) that sum is f(0) times (-ds/dx, -ds/dy, 1), whatever its profile. More robust than
    :func:`normals_from_depth`, since it uses all planes. Where nothing is above zero it is the wall's own direction.

    Args:
        volume: (..., Z, Y, X), real.
        grid: of the volume.

    Returns:
        (..., 3, Y, X) in world coordinates, towards the wall.

    Raises:
        ShapeError: for a volume that does not fit, and fewer than two planes, rows or columns.
    """
    _check_grid(grid, "normals_from_volume")
    z, volume = _checked(volume, grid, "normals_from_volume")
    if min(grid.shape) < 2:
        raise ShapeError(f"normals_from_volume: expected two planes, rows and columns at least, got {grid.shape}.")
    if volume.numel() == 0:
        return volume.sum(-3)[..., None, :, :].expand(*volume.shape[:-3], 3, *grid.size)
    front = torch.arange(len(z), device=volume.device)[:, None, None] <= volume.argmax(-3, keepdim=True)
    steps = torch.gradient(z)[0].to(volume.dtype)[:, None, None]
    gradients = (
        _slope(volume, -1, grid.pitch[1]),
        _slope(volume, -2, grid.pitch[0]),
        torch.gradient(volume, spacing=((z - z[0]).to(volume.dtype),), dim=-3)[0],
    )
    lit = volume.amax(-3) > 0
    sums = [(gradient * steps * front).sum(-3) * lit for gradient in gradients]
    # The gradient points into the surface.
    return _world(-sums[0], -sums[1], -sums[2], grid)


# ------------------------------------------------------------------------------------------------------------- parts


def _world(x: Tensor, y: Tensor, z: Tensor, grid: VoxelGrid) -> Tensor:
    axes = torch.stack([grid.along_x, grid.along_y, grid.normal]).to(x.device, x.dtype)
    local = torch.stack([x, y, z], -3)
    # Lengths do not matter, and squares of small ones vanish.
    scale = local.detach().abs().amax(-3, keepdim=True)
    local = local / torch.where(scale > 0, scale, torch.ones_like(scale))
    squares = local.square().sum(-3, keepdim=True)
    # Where there is no gradient nothing says how the surface lies: it faces the wall. The root has no slope at zero.
    known = squares > 0
    facing = torch.tensor([0.0, 0.0, -1.0], device=x.device, dtype=x.dtype)[:, None, None]
    unit = torch.where(known, local * torch.where(known, squares, torch.ones_like(squares)).rsqrt(), facing)
    # No product of matrices, which autocast would round.
    return (unit.unsqueeze(-3) * axes[:, :, None, None]).sum(-4)


def _slope(field: Tensor, dim: int, step: float) -> Tensor:
    if field.shape[dim] < 2:
        return torch.zeros_like(field)
    return torch.gradient(field, spacing=step, dim=dim)[0]


def _check_grid(grid: Any, who: str) -> None:
    if not isinstance(grid, VoxelGrid):
        raise ShapeError(f"{who}: expected a VoxelGrid, which knows its axes, got {shown(grid)}.")


def _checked(volume: Any, depths: Any, who: str) -> tuple[Tensor, Tensor]:
    """Depths in double precision where the volume is, and the volume, real, in single precision at least."""
    z = depths.depths if isinstance(depths, VoxelGrid) else checked_depths(depths, who)
    shape = depths.shape if isinstance(depths, VoxelGrid) else (len(z), "Y", "X")
    fits = isinstance(volume, Tensor) and volume.ndim >= 3 and volume.shape[-3] == len(z)
    if not fits or (isinstance(depths, VoxelGrid) and tuple(volume.shape[-3:]) != shape):
        got = tuple(volume.shape) if isinstance(volume, Tensor) else shown(volume)
        raise ShapeError(f"{who}: expected a volume (..., {shape[0]}, {shape[1]}, {shape[2]}), got {got}.")
    if not volume.is_floating_point():
        remedy = "Give its squared modulus" if volume.is_complex() else "Give volume.float()"
        raise ShapeError(f"{who}: expected a volume of real numbers, got {volume.dtype}. {remedy}.")
    return z.to(volume.device), volume if volume.dtype == torch.float64 else volume.float()
