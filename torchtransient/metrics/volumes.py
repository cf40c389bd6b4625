"""Metrics of hidden volumes: as seen from the wall, voxel by voxel, and by the depth of their surfaces.

Volumes are (..., Z, Y, X), or a `HiddenVolume`, both on one grid. Values are higher where there is something, on a
scale of their own.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchtransient.checks import share
from torchtransient.errors import ShapeError, UnitError
from torchtransient.losses.checks import check_mask, check_pair
from torchtransient.losses.results import Volume
from torchtransient.metrics.tally import Reduction, Tally, measured_pair
from torchtransient.reconstruction.surfaces import depth_map
from torchtransient.reconstruction.voxels import VoxelGrid

_PICTURE, _VOLUME = 2, 3
# Relative to the pitch of voxels: grids read from files are rounded.
_ROUNDING = 1e-3


def front_view(volume: Volume) -> Tensor:
    """Project a volume to the wall: the highest value behind each place, at least zero.

    Args:
        volume: real volumes (..., Z, Y, X) or a `HiddenVolume`.

    Returns:
        Pictures (..., Y, X), differentiable, float32 or float64.
    """
    return _values(volume).clamp_min(0).amax(-3)


def front_depth(volume: Volume, depths: Any = None, *, threshold: float = 0.1) -> Tensor:
    """Find the depth of the highest value behind each place of the wall, by a parabola through its plane and neighbors.

    As `tt.nlos.depth_map`. Metrics of depth take NaN for no surface.

    Args:
        volume: volumes (..., Z, Y, X) or a `HiddenVolume`.
        depths: grid or (Z,) metres; None: those of a `HiddenVolume`.
        threshold: share of the highest value of the volume that a surface reaches.

    Returns:
        Metres, (..., Y, X), NaN where there is no surface.

    Raises:
        ShapeError: for a tensor without depths.
    """
    planes = getattr(volume, "grid", None) if depths is None else depths
    if planes is None:
        raise ShapeError("front_depth: expected depths= with a tensor, a grid or (Z,) metres, got None.")
    found = depth_map(_values(volume), planes, threshold=threshold)
    return torch.where(found.mask, found.depth, torch.full_like(found.depth, torch.nan))


def front_depth_mae(
    input: Volume,
    target: Volume,
    depths: Any = None,
    *,
    threshold: float = 0.1,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Compute the mean absolute error of the front depths of two volumes, metres, where both have a surface.

    `picture_iou` of the front views is its companion, and measures where only one of them has one.

    Args:
        input: volumes (..., Z, Y, X) or a `HiddenVolume`.
        target: volumes of the same shape.
        depths: grid or (Z,) metres; None: those of a `HiddenVolume`.
        threshold: share of the highest value of a volume that a surface reaches, see `front_depth`.
        mask: places that count, (..., Y, X).
        reduction: "mean" of all places, "item" of each volume, or "none".

    Returns:
        Metres; scalar, (...) for "item", (..., Y, X) for "none"; NaN where nothing counts.

    Raises:
        UnitError: for volumes on two grids.
        ShapeError: for two shapes, or tensors without depths.
    """
    where = "front_depth_mae"
    if depths is None:
        depths = next((g for g in (getattr(x, "grid", None) for x in (input, target)) if g is not None), None)
    ours, theirs = check_pair(*_volumes(input, target, where), where)
    x, y = (front_depth(volume, depths, threshold=threshold) for volume in (ours, theirs))
    seen = torch.isfinite(x) & torch.isfinite(y)
    given = check_mask(mask, x, where)
    return Tally((x - y).abs(), seen if given is None else given & seen, _PICTURE).result(reduction, where)


def picture_correlation(
    input: Tensor, target: Tensor, *, centered: bool = True, mask: Tensor | None = None, reduction: Reduction = "mean"
) -> Tensor:
    """Compute the correlation of pictures, such as front views, in [-1, 1]; independent of brightness.

    Args:
        input: pictures (..., Y, X). A flat one counts as 0.
        target: pictures of the same shape. A flat one (`centered=False`: a dark one) does not count.
        centered: compute Pearson's coefficient; False: the cosine.
        mask: pixels that count.
        reduction: "mean" over pictures, "item" or "none" of each.

    Returns:
        Scalar, or (...) for "item" and "none"; NaN where nothing counts.

    Raises:
        UnitError: for values that are not finite.
        ShapeError: for two shapes.
    """
    where = "picture_correlation"
    return _correlation(input, target, _PICTURE, centered, mask, where).result(reduction, where)


def volume_correlation(
    input: Volume, target: Volume, *, centered: bool = True, mask: Tensor | None = None, reduction: Reduction = "mean"
) -> Tensor:
    """Compute the correlation of volumes (..., Z, Y, X), voxel by voxel.

    Strict: a surface that is one plane off does not correlate.

    Args:
        input, target: volumes (..., Z, Y, X) or `HiddenVolume`, compared as in `picture_correlation`.
        centered: compute Pearson's coefficient; False: the cosine.
        mask: voxels that count.
        reduction: "mean" over volumes, "item" or "none" of each.

    Raises:
        UnitError: for volumes on two grids.
    """
    where = "volume_correlation"
    x, y = _volumes(input, target, where)
    return _correlation(x, y, _VOLUME, centered, mask, where).result(reduction, where)


def picture_iou(
    input: Tensor, target: Tensor, *, threshold: float = 0.5, mask: Tensor | None = None, reduction: Reduction = "mean"
) -> Tensor:
    """Compute the intersection over union of the shapes in pictures, such as front views, in [0, 1].

    Args:
        input: pictures (..., Y, X), or boolean masks. A shape is where a pixel is above zero and reaches the threshold.
        target: pictures of the same shape, or boolean masks. Pairs of pictures in which neither has a shape do not
            count.
        threshold: share of the highest value of a picture.
        mask: pixels that count.
        reduction: "mean" over pictures, "item" or "none" of each.

    Returns:
        Scalar, or (...) for "item" and "none"; NaN where nothing counts.

    Raises:
        UnitError: for values that are not finite.
        ShapeError: for two shapes.
    """
    where = "picture_iou"
    return _iou(input, target, _PICTURE, threshold, mask, where).result(reduction, where)


def volume_iou(
    input: Volume, target: Volume, *, threshold: float = 0.5, mask: Tensor | None = None, reduction: Reduction = "mean"
) -> Tensor:
    """Compute the intersection over union of volumes (..., Z, Y, X), voxel by voxel.

    Args:
        input, target: volumes (..., Z, Y, X) or `HiddenVolume`, compared as in `picture_iou`.
        threshold: share of the highest value of a volume.
        mask: voxels that count.
        reduction: "mean" over volumes, "item" or "none" of each.

    Raises:
        UnitError: for volumes on two grids.
    """
    where = "volume_iou"
    x, y = _volumes(input, target, where)
    return _iou(x, y, _VOLUME, threshold, mask, where).result(reduction, where)


def _correlation(input: object, target: object, dims: int, centered: bool, mask: Tensor | None, where: str) -> Tally:
    x, y, kept = _compared(input, target, dims, mask, where)
    x, y, kept = (one.flatten(-dims) for one in (x, y, kept))
    dtype, number = x.dtype, kept.sum(-1, keepdim=True).clamp_min(1)
    # relative to the highest values, whose squares double precision holds
    x, y = (one.double() / _highest(one.double().abs()) for one in (x, y))
    if centered:
        flat_x, flat_y = (_spread(one, kept) == 0 for one in (x, y))
        x, y = (torch.where(kept, one - one.sum(-1, keepdim=True) / number, 0.0) for one in (x, y))
    else:
        flat_x, flat_y = ((one == 0).all(-1) for one in (x, y))
    defined = ~flat_x & ~flat_y
    # before the root, whose slope at 0 is infinite
    norms = torch.where(defined, x.square().sum(-1) * y.square().sum(-1), 1.0).sqrt()
    found = torch.where(defined, (x * y).sum(-1) / norms, 0.0).clamp(-1, 1)
    return Tally(found.to(dtype), ~flat_y)


def _highest(x: Tensor) -> Tensor:
    top = x.amax(-1, keepdim=True)
    return torch.where(top > 0, top, torch.ones_like(top))


def _spread(x: Tensor, kept: Tensor) -> Tensor:
    """Return the highest less the lowest counted value, 0 without any."""
    high, low = (torch.where(kept, x, sign * torch.inf) for sign in (-1, 1))
    return (high.amax(-1) - low.amin(-1)).clamp_min(0)


def _iou(input: object, target: object, dims: int, threshold: float, mask: Tensor | None, where: str) -> Tally:
    least = share(f"{where}: threshold", threshold)
    a, b = (x.float() if isinstance(x, Tensor) and x.dtype == torch.bool else x for x in (input, target))
    x, y, _ = _compared(a, b, dims, mask, where)
    flat = [one.flatten(-dims) for one in (x, y)]
    ours, theirs = ((one > 0) & (one >= least * _highest(one)) for one in flat)
    both, either = (ours & theirs).sum(-1), (ours | theirs).sum(-1)
    return Tally(both.to(x.dtype) / either.clamp_min(1), either > 0)


def _compared(
    input: object, target: object, dims: int, mask: Tensor | None, where: str
) -> tuple[Tensor, Tensor, Tensor]:
    """Return both, 0 where nothing counts, and the mask."""
    x, y, given = measured_pair(input, target, mask, where)
    if x.ndim < dims:
        raise ShapeError(f"{where}: expected (..., {'Y, X' if dims == _PICTURE else 'Z, Y, X'}), got {tuple(x.shape)}.")
    return x, y, torch.ones_like(x, dtype=torch.bool) if given is None else given


# ----------------------------------------------------------------------------------------------------------- volumes


def _values(x: Volume) -> Tensor:
    """Return the tensor of a volume, in single precision or better."""
    values = x if isinstance(x, Tensor) else x.values
    return values if values.dtype == torch.float64 or values.is_complex() else values.float()


def _volumes(input: Volume, target: Volume, where: str) -> tuple[Tensor, Tensor]:
    """Return the tensors of two volumes. Raises UnitError for two grids."""
    a, b = (getattr(x, "grid", None) for x in (input, target))
    if isinstance(a, VoxelGrid) and isinstance(b, VoxelGrid):
        near = _ROUNDING * min(*a.pitch, *b.pitch)
        if a.shape != b.shape or float((_frame(a) - _frame(b)).abs().max()) > near:
            raise UnitError(
                f"{where}: expected volumes on one grid, got {a!r} from {a.first.tolist()} m and {b!r} from "
                f"{b.first.tolist()} m. Reconstruct both on one, or give tensors."
            )
    return input if isinstance(input, Tensor) else input.values, target if isinstance(target, Tensor) else target.values


def _frame(grid: VoxelGrid) -> Tensor:
    """Positions (Z + 2, 3) of a corner of every plane and of two corners of the wall, which determine a grid."""
    rows, columns = ((n - 1) * step for n, step in zip(grid.size, grid.pitch, strict=True))
    first = grid.first + grid.depths[:, None] * grid.normal
    return torch.cat([first, torch.stack([grid.first + rows * grid.along_y, grid.first + columns * grid.along_x])])
