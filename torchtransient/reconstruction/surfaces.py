"""Surfaces in a reconstructed volume: depth and confidence.

Volumes are (..., Z, Y, X) of real values, higher at surfaces, on a :class:`VoxelGrid` or on planes at given depths.
Everything is differentiable by the volume. Volumes in half precision are taken, and their depths returned, in float32.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchtransient.checks import share
from torchtransient.errors import ShapeError
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
    z, volume = _checked(volume, depths)
    threshold = share("depth_map: threshold", threshold)
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


def _checked(volume: Tensor, depths: Any) -> tuple[Tensor, Tensor]:
    """Depths in double precision where the volume is, and the volume, real, in single precision at least."""
    on_grid = isinstance(depths, VoxelGrid)
    z = depths.depths if on_grid else checked_depths(depths, "depth_map")
    expected = depths.shape if on_grid else (len(z), *volume.shape[-2:])
    if volume.ndim < 3 or tuple(volume.shape[-3:]) != expected:
        raise ShapeError(
            f"depth_map: expected a volume (..., {len(z)}, Y, X) for {depths if on_grid else 'its depths'}, got "
            f"{tuple(volume.shape)}."
        )
    if not volume.is_floating_point():
        raise ShapeError(f"depth_map: expected real numbers, the squared modulus of a field, got {volume.dtype}.")
    return z.to(volume.device), volume if volume.dtype == torch.float64 else volume.float()
