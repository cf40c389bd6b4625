"""Hidden volumes against the truth: as seen from the wall, voxel by voxel, and by the depth of their surfaces.

Volumes are (..., Z, Y, X), or a `HiddenVolume`, whose grid has to be that of the other. Values are higher where
something is, on a scale of their own.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchtransient.checks import flag, share, shown
from torchtransient.errors import ShapeError, UnitError
from torchtransient.losses.comparison import check_dense, check_mask, check_pair
from torchtransient.losses.results import Volume
from torchtransient.metrics.tally import Reduction, Tally, check_finite, check_reduction
from torchtransient.reconstruction.surfaces import depth_map
from torchtransient.reconstruction.voxels import VoxelGrid

_PICTURE, _VOLUME = 2, 3
# Of the pitch of voxels: grids that went through files are equal but for rounding.
_ROUNDING = 1e-3


def front_view(volume: Volume) -> Tensor:
    """(..., Y, X): the highest value behind each place of the wall of volumes (..., Z, Y, X), nothing below zero.

    Differentiable by the volume. Half precision is taken in float32. Raises ShapeError, UnitError for complex values.
    """
    values = _values(volume, "front_view")
    return values.clamp_min(0).amax(-3)


def front_depth(volume: Volume, depths: Any = None, *, threshold: float = 0.1) -> Tensor:
    """(..., Y, X): depth of the highest value behind each place of the wall, metres; NaN where there is no surface.

    `tt.nlos.depth_map` of volumes (..., Z, Y, X): a parabola through the highest plane and its neighbors, and a surface
    where the value reaches `threshold`, a share of the volume's highest. `depths`: a grid or (Z,) metres; None: those
    of a `HiddenVolume`. What is NaN is no surface for the metrics of depth. Raises ShapeError, UnitError.
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
    """Mean of `|input - target|` of the front depths of two volumes (..., Z, Y, X), metres, where both have a surface.

    Where only one of them has one is not measured here: say it with `picture_iou` of the front views beside this.
    `depths` and `threshold` as in `front_depth`; `mask` (..., Y, X): places that count. `reduction`: "mean" of all
    places, (); "item", of each volume, (...); "none", of each place. NaN where nothing counts. Raises ShapeError,
    UnitError.
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
    """Mean correlation of pictures (..., Y, X), front views for instance, in [-1, 1].

    `centered`: Pearson's coefficient; False: the cosine, of the pictures as they are. Neither knows brightness. A
    target that is flat (`centered=False`: dark) is like nothing, and does not count; an input that is, with another
    target, counts as 0. `mask`: pixels that count. `reduction`: "mean" of all pictures, (); "item" or "none", of each,
    (...). NaN where nothing counts. Raises ShapeError; UnitError for NaN and infinite values.
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
    """Mean correlation of volumes (..., Z, Y, X), voxel by voxel; otherwise as `picture_correlation`.

    Strict: a surface that is one plane off is like nothing. UnitError for volumes on two grids.
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
    """Mean intersection over union of what is seen in pictures (..., Y, X), front views for instance, in [0, 1].

    Something is where a pixel is above zero and reaches `threshold`, a share of the highest value of its picture;
    truth values are taken as they are. The mean is over pictures, not pixels; a picture in which neither shows
    anything does not count. `mask`: pixels that count. `reduction`: "mean" of all pictures, (); "item" or "none", of
    each, (...). NaN where nothing counts. Raises ShapeError; UnitError for NaN and infinite values.
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
    """Mean intersection over union of volumes (..., Z, Y, X), voxel by voxel; otherwise as `picture_iou`.

    UnitError for volumes on two grids.
    """
    where = "volume_iou"
    x, y = _volumes(input, target, where)
    return _iou(x, y, _VOLUME, threshold, mask, where).result(reduction, where)


def _correlation(
    input: object, target: object, dims: int, centered: bool, mask: Tensor | None, where: str
) -> Tally:
    subtract = flag(f"{where}: centered", centered)
    x, y, kept = _compared(input, target, dims, mask, where)
    x, y, kept = (one.flatten(-dims) for one in (x, y, kept))
    dtype, number = x.dtype, kept.sum(-1, keepdim=True).clamp_min(1)
    # relative to the highest values, of which no square leaves double precision
    x, y = (one.double() / _highest(one.double().abs()) for one in (x, y))
    if subtract:
        flat_x, flat_y = (_spread(one, kept) == 0 for one in (x, y))
        x, y = (torch.where(kept, one - one.sum(-1, keepdim=True) / number, 0.0) for one in (x, y))
    else:
        flat_x, flat_y = ((one == 0).all(-1) for one in (x, y))
    defined = ~flat_x & ~flat_y
    # chosen before the root, whose slope at 0 would be infinite
    norms = torch.where(defined, x.square().sum(-1) * y.square().sum(-1), 1.0).sqrt()
    found = torch.where(defined, (x * y).sum(-1) / norms, 0.0).clamp(-1, 1)
    return Tally(found.to(dtype), ~flat_y)


def _highest(x: Tensor) -> Tensor:
    top = x.amax(-1, keepdim=True) if x.shape[-1] else x.sum(-1, keepdim=True)
    return torch.where(top > 0, top, torch.ones_like(top))


def _spread(x: Tensor, kept: Tensor) -> Tensor:
    """Highest less lowest of what counts; 0 of nothing."""
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
    """Both, 0 where nothing counts, and what counts."""
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
    """The tensor of a volume."""
    values = x if isinstance(x, Tensor) else getattr(x, "values", None)
    if not isinstance(values, Tensor):
        raise ShapeError(f"{where}: expected a volume (..., Z, Y, X) or a HiddenVolume, got {shown(x)}.")
    return values


def _values(x: object, where: str) -> Tensor:
    """The same, real, in single precision or better."""
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
    """Raises UnitError for two volumes whose voxels stand in two places."""
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
    """(Z + 2, 3): where one corner of every plane and two of the wall stand, which says where all voxels do."""
    rows, columns = ((n - 1) * step for n, step in zip(grid.size, grid.pitch, strict=True))
    first = grid.first + grid.depths[:, None] * grid.normal
    return torch.cat([first, torch.stack([grid.first + rows * grid.along_y, grid.first + columns * grid.along_x])])
