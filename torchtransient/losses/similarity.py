"""Structural similarity of pictures, and of volumes by their projections. Windows by kornia."""

from __future__ import annotations

import torch
from torch import Tensor

from torchtransient.errors import ShapeError
from torchtransient.losses.checks import Reduction, check_level, check_whole, masked_pair, reduce
from torchtransient.losses.loss_module import LossModule
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
    """Compute the structural dissimilarity of each pixel, `1 - SSIM`, from 0 to 2.

    Args:
        input: picture (..., C, Y, X). Single precision holds values up to 1e9 times the range.
        target: picture of the same shape.
        window: width in pixels of the Gaussian window (standard deviation 1.5), odd, reflected at the borders; Y and X
            are larger than half of it.
        value_range: range of the values, whose first and third percent stabilize dark and flat places. None: the
            highest modulus of each target picture (1 for a dark one), detached, which is not symmetric.
        mask: pixels that count. The others are 0 in both pictures for the windows that reach them.
        reduction: "mean" over pixels that count, "sum", or "none".

    Returns:
        Scalar, or the shape of the input for "none".

    Raises:
        ShapeError: for pictures smaller than the window, an even window, or two shapes.
        UnitError: for a range that is not above zero.

    Source: Wang, Bovik, Sheikh and Simoncelli 2004.
    """
    from kornia.metrics import ssim

    where = "ssim_loss"
    a, b, mask = masked_pair(input, target, mask, where)
    window = check_whole("window", window, where)
    if window % 2 == 0 or a.ndim < 3 or min(a.shape[-2:]) <= window // 2:
        raise ShapeError(
            f"{where}: expected pictures (..., C, Y, X) and an odd window below twice Y and X, got {tuple(a.shape)} "
            f"and {window}."
        )
    if value_range is None:
        peak = b.detach().abs().amax((-3, -2, -1), keepdim=True)
        scale = torch.where(peak > 0, peak, torch.ones_like(peak))
    else:
        scale = check_level("value_range", value_range, a[..., :1, :1, :1], where)
    shape = (a.shape[:-3].numel(), *a.shape[-3:])
    # eps 0: with a range of 1 the constants of kornia keep the denominator from zero
    similarity = ssim((a / scale).reshape(shape), (b / scale).reshape(shape), window, max_val=1.0, eps=0.0)
    return reduce(1 - similarity.reshape(a.shape), reduction, where, mask)


class SSIMLoss(LossModule, function=ssim_loss, by_place=("window", "value_range", "reduction")):
    """`ssim_loss` with its options held."""


def maximum_projections(volume: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Project the maxima of a volume along Z, Y and X.

    Args:
        volume: real volume (..., Z, Y, X).

    Returns:
        Front (..., Y, X), top (..., Z, X) and side (..., Z, Y). Gradients go to the brightest voxel of each line, in
        equal parts to equal ones.
    """
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
    """Average `ssim_loss` over the front, top and side `maximum_projections` of two volumes.

    Args:
        input: volume (..., C, Z, Y, X), real and not negative.
        target: volume of the same shape.
        window: width in pixels of the Gaussian window, odd, see `ssim_loss`.
        value_range: range of the values, None for the highest modulus of each target picture, see `ssim_loss`.
        mask: voxels that count. The others are dark in both; pixels whose whole line is masked do not count.
        reduction: "mean" or "sum" over each view, of which the mean is taken, or "none".

    Returns:
        Scalar, or the mean of each volume and channel (..., C) for "none".

    Raises:
        ShapeError: for volumes smaller than the window, an even window, or two shapes.
    """
    where = "projection_ssim_loss"
    input, target, mask = masked_pair(input, target, mask, where)
    if input.ndim < 4:
        raise ShapeError(f"{where}: expected volumes (..., C, Z, Y, X), got {tuple(input.shape)}.")
    ours, theirs = maximum_projections(input), maximum_projections(target)
    masks = (None,) * 3 if mask is None else tuple(mask.any(dim) for dim in (-3, -2, -1))
    values = []
    for a, b, seen in zip(ours, theirs, masks, strict=True):
        value = ssim_loss(a, b, window=window, value_range=value_range, mask=seen, reduction=reduction)
        if reduction == "none":
            number = value.shape[-2] * value.shape[-1] if seen is None else seen.sum((-2, -1)).clamp_min(1)
            value = value.sum((-2, -1)) / number
        values.append(value)
    return torch.stack(values).mean(0)


class ProjectionSSIMLoss(LossModule, function=projection_ssim_loss, by_place=("window", "value_range", "reduction")):
    """`projection_ssim_loss` with its options held."""
