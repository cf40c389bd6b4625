"""Metrics of hidden volumes: as seen from the wall, voxel by voxel, and by the depth of their surfaces.

Volumes are (..., Z, Y, X), or a `HiddenVolume`, both on one grid. Values are higher where there is something, on a
scale of their own.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchtransient.checks import share, shown
from torchtransient.errors import ShapeError, UnitError
from torchtransient.losses.checks import check_dense, check_mask, check_pair
from torchtransient.losses.results import Volume
from torchtransient.metrics.tally import Reduction, Tally, check_finite, check_reduction
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

    Raises:
        UnitError: for complex values.
    """
    values = _values(volume, "front_view")
    return values.clamp_min(0).amax(-3)


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
        UnitError: for complex values.
    """
    where = "front_depth"
    values = _values(volume, where)
    planes = getattr(volume, "grid", None) if depths is None else depths
    if planes is None:
        raise ShapeError(f"{where}: expected depths= with a tensor, a grid or (Z,) metres, got None.")
    found = depth_map(values, planes, threshold=threshold)
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
        target: of the same shape.
        depths, threshold: as in `front_depth`.
        mask: places that count, (..., Y, X).
        reduction: "mean" of all places, "item" of each volume, or "none".

    Returns:
        Metres; scalar, (...) for "item", (..., Y, X) for "none"; NaN where nothing counts.

    Raises:
        UnitError: for volumes on two grids.
        ShapeError: for two shapes, or tensors without depths.
    """
    where = "front_depth_mae"
    check_reduction(reduction, where)
    _check_grids(input, target, where)
    planes = next((g for g in (getattr(x, "grid", None) for x in (input, target)) if g is not None), None)
    planes = planes if depths is None else depths
    ours, theirs = check_pair(_taken(input, where), _taken(target, where), where)
    x, y = (front_depth(volume, planes, threshold=threshold) for volume in (ours, theirs))
    seen = torch.isfinite(x) & torch.isfinite(y)
    given = check_mask(mask, x, where)
    return Tally((x - y).abs(), seen if given is None else given & seen, _PICTURE).result(reduction, where)


def picture_correlation(
    input: Tensor,
    target: Tensor,
    *,
    centered: bool = True,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Compute the correlation of pictures, such as front views, in [-1, 1]; independent of brightness.

    Args:
        input: pictures (..., Y, X). A flat one counts as 0.
        target: of the same shape. A flat one (`centered=False`: a dark one) does not count.
        centered: Pearson's coefficient; False: the cosine.
        mask: pixels that count.
        reduction: "mean" over pictures, "item" or "none" of each.

    Returns:
        Scalar, or (...) for "item" and "none"; NaN where nothing counts.

    Raises:
        UnitError: for values that are not finite.
        ShapeError: for two shapes.
    """
    return _correlation(input, target, _PICTURE, centered, mask, "picture_correlation").result(
        reduction, "picture_correlation"
    )


def volume_correlation(
    input: Volume,
    target: Volume,
    *,
    centered: bool = True,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Compute the correlation of volumes (..., Z, Y, X), voxel by voxel.

    Strict: a surface that is one plane off does not correlate.

    Args:
        input, target, centered, mask, reduction: as in `picture_correlation`.

    Raises:
        UnitError: for volumes on two grids.
    """
    where = "volume_correlation"
    x, y = _volumes(input, target, where)
    return _correlation(x, y, _VOLUME, centered, mask, where).result(reduction, where)


def picture_iou(
    input: Tensor,
    target: Tensor,
    *,
    threshold: float = 0.5,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Compute the intersection over union of the shapes in pictures, such as front views, in [0, 1].

    Args:
        input: pictures (..., Y, X), or boolean masks. A shape is where a pixel is above zero and reaches the threshold.
        target: of the same shape. Pictures in which neither has a shape do not count.
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
    input: Volume,
    target: Volume,
    *,
    threshold: float = 0.5,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Compute the intersection over union of volumes (..., Z, Y, X), voxel by voxel.

    Args:
        input, target, threshold, mask, reduction: as in `picture_iou`.

    Raises:
        UnitError: for volumes on two grids.
    """
    where = "volume_iou"
    x, y = _volumes(input, target, where)
    return _iou(x, y, _VOLUME, threshold, mask, where).result(reduction, where)


def _correlation(
    input: object, target: object, dims: int, centered: bool, mask: Tensor | None, where: str
) -> Tally:
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
    top = x.amax(-1, keepdim=True) if x.shape[-1] else x.sum(-1, keepdim=True)
    return torch.where(top > 0, top, torch.ones_like(top))


def _spread(x: Tensor, kept: Tensor) -> Tensor:
    """Return the highest less the lowest counted value, 0 without any."""
    if not x.shape[-1]:
        return x.sum(-1)
    high, low = (torch.where(kept, x, sign * torch.inf) for sign in (-1, 1))
    return (high.amax(-1) - low.amin(-1)).clamp_min(0)


def _iou(input: object, target: object, dims: int, threshold: float, mask: Tensor | None, where: str) -> Tally:
    least = share(f"{where}: threshold", threshold)
    a, b = (x.float() if isinstance(x, Tensor) and x.dtype == torch.bool else x for x in (input, target))
    x, y, _ = _compared(a, b, dims, mask, where)
    ours, theirs = (_there(one.flatten(-dims), least) for one in (x, y))
    both, either = (ours & theirs).sum(-1), (ours | theirs).sum(-1)
    return Tally(both.to(x.dtype) / either.clamp_min(1), either > 0)


def _there(x: Tensor, least: float) -> Tensor:
    return (x > 0) & (x >= least * _highest(x))


def _compared(
    input: object, target: object, dims: int, mask: Tensor | None, where: str
) -> tuple[Tensor, Tensor, Tensor]:
    """Return both, 0 where nothing counts, and the mask."""
    x, y = check_pair(input, target, where)
    if x.ndim < dims:
        layout = "(..., Y, X)" if dims == _PICTURE else "(..., Z, Y, X)"
        raise ShapeError(f"{where}: expected tensors {layout}, got {tuple(x.shape)}.")
    given = check_mask(mask, x, where)
    kept = torch.ones_like(x, dtype=torch.bool) if given is None else given
    check_finite(x, kept, "input", where)
    check_finite(y, kept, "target", where)
    return torch.where(kept, x, torch.zeros_like(x)), torch.where(kept, y, torch.zeros_like(y)), kept


# ----------------------------------------------------------------------------------------------------------- volumes


def _taken(x: object, where: str) -> Tensor:
    """Return the tensor of a volume."""
    values = x if isinstance(x, Tensor) else getattr(x, "values", None)
    if not isinstance(values, Tensor):
        raise ShapeError(f"{where}: expected a volume (..., Z, Y, X) or a HiddenVolume, got {shown(x)}.")
    return values


def _values(x: object, where: str) -> Tensor:
    """Return the tensor of a real volume, in single precision or better."""
    (values,) = check_dense((_taken(x, where),), where)
    if values.is_complex():
        raise UnitError(f"{where}: expected a volume of real numbers, got {values.dtype}. Give its modulus.")
    if values.ndim < _VOLUME or not all(values.shape[-_VOLUME:]):
        raise ShapeError(f"{where}: expected a volume (..., Z, Y, X) of voxels, got {tuple(values.shape)}.")
    return values if values.dtype == torch.float64 else values.float()


def _volumes(input: object, target: object, where: str) -> tuple[Tensor, Tensor]:
    _check_grids(input, target, where)
    return _taken(input, where), _taken(target, where)


def _check_grids(input: object, target: object, where: str) -> None:
    """Raise UnitError for volumes on two grids."""
    a, b = (getattr(x, "grid", None) for x in (input, target))
    if not (isinstance(a, VoxelGrid) and isinstance(b, VoxelGrid)):
        return
    near = _ROUNDING * min(*a.pitch, *b.pitch)
    if a.shape != b.shape or float((_frame(a) - _frame(b)).abs().max()) > near:
        raise UnitError(
            f"{where}: expected volumes on one grid, got {a!r} from {a.first.tolist()} m and {b!r} from "
            f"{b.first.tolist()} m. Reconstruct both on one, or give tensors."
        )


def _frame(grid: VoxelGrid) -> Tensor:
    """Positions (Z + 2, 3) of a corner of every plane and of two corners of the wall, which determine a grid."""
    rows, columns = ((n - 1) * step for n, step in zip(grid.size, grid.pitch, strict=True))
    first = grid.first + grid.depths[:, None] * grid.normal
    return torch.cat([first, torch.stack([grid.first + rows * grid.along_y, grid.first + columns * grid.along_x])])
