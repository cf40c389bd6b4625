"""Structural similarity of pictures, and of volumes by what is seen of them from three sides. Windows by kornia."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchtransient.errors import ShapeError
from torchtransient.losses.comparison import (
    Reduction,
    check_level,
    check_mask,
    check_option,
    check_pair,
    check_reduction,
    check_whole,
    counted,
    reduce,
)
from torchtransient.losses.results import STEADY, VALUES, Picture, Volume, reads

WINDOW = 11


@reads(input=STEADY, target=STEADY)
def ssim_loss(
    input: Picture,
    target: Picture,
    *,
    window: int = WINDOW,
    value_range: float | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """`1 - SSIM` of each pixel of two pictures (..., C, Y, X), between 0 and 2 (Wang, Bovik, Sheikh, Simoncelli 2004).

    Means, variances and the covariance are those of a Gaussian window of `window` pixels (odd; standard deviation 1.5),
    reflected at the borders; Y and X are larger than half of it. `value_range`: of the values, whose first and third
    percent stabilise dark and flat places; None: the highest modulus of each target (its C, Y, X; 1 for a dark one),
    without gradient, which is not symmetric. `mask`: pixels that count; the others are 0 in both for the windows that
    reach them, so a mask is not quite a smaller picture. Single precision holds values up to 1e9 times the range.
    Raises ShapeError, UnitError.
    """
    return _ssim(input, target, (window, value_range), mask, reduction, "ssim_loss")


def _check_window(window: int, where: str) -> int:
    number = check_whole("an odd window", window, where)
    if number % 2 == 0:
        raise ShapeError(f"{where}: expected an odd window, got {number}.")
    return number


def _ssim(
    ours: object,
    theirs: object,
    options: tuple[int, float | None],
    mask: Tensor | None,
    reduction: Reduction,
    where: str,
) -> Tensor:
    from kornia.metrics import ssim

    check_reduction(reduction, where)
    input, target = check_pair(ours, theirs, where)
    window, value_range = _check_window(options[0], where), options[1]
    half = window // 2
    if input.ndim < 3 or min(input.shape[-2:]) <= half:
        raise ShapeError(
            f"{where}: expected pictures (..., C, Y, X) with Y and X above {half} for a window of {window}, got "
            f"{tuple(input.shape)}. Take a smaller window."
        )
    mask = check_mask(mask, input, where)
    a, b = counted(input, mask), counted(target, mask)
    if not input.numel():
        return reduce((a - b).abs(), reduction, where, mask)
    if value_range is None:
        peak = b.detach().abs().amax((-3, -2, -1), keepdim=True)
        scale = torch.where(peak > 0, peak, torch.ones_like(peak))
    else:
        scale = check_level("value_range", value_range, a[..., :1, :1, :1], where)
    shape = (-1, *a.shape[-3:])
    # No further number in the denominator: with a range of 1 its own constants keep it from zero.
    similarity = ssim((a / scale).reshape(shape), (b / scale).reshape(shape), window, max_val=1.0, eps=0.0)
    return reduce(1 - similarity.reshape(a.shape), reduction, where, mask)


def maximum_projections(volume: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Front (..., Y, X), top (..., Z, X), side (..., Z, Y) of a real volume (..., Z, Y, X): maxima along Z, Y, X.

    Gradients go to the brightest voxel of each line, in equal parts to equal ones. Raises ShapeError.
    """
    return _projections(volume, "maximum_projections")


def _projections(volume: Tensor, where: str) -> tuple[Tensor, Tensor, Tensor]:
    if not isinstance(volume, Tensor) or volume.ndim < 3 or volume.is_complex() or not all(volume.shape[-3:]):
        got = f"{tuple(volume.shape)} {volume.dtype}" if isinstance(volume, Tensor) else type(volume).__name__
        raise ShapeError(f"{where}: expected a real volume (..., Z, Y, X), got {got}.")
    return volume.amax(-3), volume.amax(-2), volume.amax(-1)


@reads(input=VALUES, target=VALUES)
def projection_ssim_loss(
    input: Volume,
    target: Volume,
    *,
    window: int = WINDOW,
    value_range: float | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Mean of `ssim_loss` of the front, top and side maxima of two volumes (..., C, Z, Y, X), real and not negative.

    Voxels that `mask` leaves out are dark in both; pixels whose whole line is left out do not count. `reduction`: over
    each view, of which the mean is taken; `"none"`, the mean of each volume and channel, (..., C). Raises ShapeError.
    """
    where = "projection_ssim_loss"
    check_reduction(reduction, where)
    input, target = check_pair(input, target, where)
    if input.ndim < 4:
        raise ShapeError(f"{where}: expected volumes (..., C, Z, Y, X), got {tuple(input.shape)}.")
    mask = check_mask(mask, input, where)
    ours, theirs = (_projections(counted(x, mask), where) for x in (input, target))
    masks = (None,) * 3 if mask is None else tuple(mask.any(dim) for dim in (-3, -2, -1))
    values = []
    for a, b, seen in zip(ours, theirs, masks, strict=True):
        each = _ssim(a, b, (window, value_range), seen, "none", where)
        if reduction == "none":
            number = each.shape[-2] * each.shape[-1] if seen is None else seen.sum((-2, -1)).clamp_min(1)
            values.append(each.sum((-2, -1)) / number)
        else:
            values.append(reduce(each, reduction, where, seen))
    return torch.stack(values).mean(0)


class SSIMLoss(nn.Module):
    """`ssim_loss(input, target)` with its options held."""

    def __init__(self, window: int = WINDOW, value_range: float | None = None, reduction: Reduction = "mean") -> None:
        super().__init__()
        check_reduction(reduction, "SSIMLoss")
        check_option("value_range", value_range, "SSIMLoss")
        self.window, self.value_range, self.reduction = _check_window(window, "SSIMLoss"), value_range, reduction

    def forward(self, input: Picture, target: Picture, mask: Tensor | None = None) -> Tensor:
        return ssim_loss(
            input, target, window=self.window, value_range=self.value_range, mask=mask, reduction=self.reduction
        )


class ProjectionSSIMLoss(nn.Module):
    """`projection_ssim_loss(input, target)` with its options held."""

    def __init__(self, window: int = WINDOW, value_range: float | None = None, reduction: Reduction = "mean") -> None:
        super().__init__()
        check_reduction(reduction, "ProjectionSSIMLoss")
        check_option("value_range", value_range, "ProjectionSSIMLoss")
        self.window = _check_window(window, "ProjectionSSIMLoss")
        self.value_range, self.reduction = value_range, reduction

    def forward(self, input: Volume, target: Volume, mask: Tensor | None = None) -> Tensor:
        return projection_ssim_loss(
            input, target, window=self.window, value_range=self.value_range, mask=mask, reduction=self.reduction
        )
