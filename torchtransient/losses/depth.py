"""Losses of depth maps, over the pixels where the target has a surface."""

from __future__ import annotations

import torch
from torch import Tensor

from torchtransient.checks import shown
from torchtransient.errors import ShapeError, UnitError
from torchtransient.losses.checks import Reduction, check_level, check_mask, check_number, check_pair, counted, reduce
from torchtransient.losses.loss_module import LossModule
from torchtransient.losses.results import DEPTH, DepthMap, reads


def on_surfaces(
    input: object, target: object, mask: Tensor | None, where: str, *, above_zero: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """Return two depth maps of one shape, and the mask of pixels that count: where the target has a surface.

    Args:
        input, target: dense real tensors, see `check_pair`.
        mask: pixels that may count, None for all, see `check_mask`.
        where: begins the message.
        above_zero: a target of zero or below is no surface.
    """
    ours, theirs = check_pair(input, target, where)
    surface = torch.isfinite(theirs) & (theirs > 0) if above_zero else torch.isfinite(theirs)
    given = check_mask(mask, theirs, where)
    return ours, theirs, surface if given is None else given & surface


@reads(input=DEPTH, target=DEPTH)
def depth_loss(
    input: DepthMap, target: DepthMap, *, mask: Tensor | None = None, reduction: Reduction = "mean"
) -> Tensor:
    """Compute the absolute error of depths, `|input - target|`. Symmetric where both are finite.

    Args:
        input: depth map (..., Y, X), metres.
        target: true depth map, of the same shape and unit. Pixels that are not finite (no surface) do not count.
        mask: pixels that count.
        reduction: "mean" over pixels that count (0 without any), "sum", or "none".

    Returns:
        Metres; scalar, or the shape of the input for "none".

    Raises:
        ShapeError: for two shapes.
    """
    where = "depth_loss"
    input, target, mask = on_surfaces(input, target, mask, where)
    return reduce((counted(input, mask) - counted(target, mask)).abs(), reduction, where, mask)


class DepthLoss(LossModule, function=depth_loss, by_place=("reduction",)):
    """`depth_loss` with its reduction held."""


@reads(input=DEPTH, target=DEPTH)
def scale_invariant_depth_loss(
    input: DepthMap,
    target: DepthMap,
    *,
    balance: float = 0.5,
    floor: float = 1e-3,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Scale-invariant error of each depth map, `mean(d^2) - balance mean(d)^2` with `d = log(input / target)`.

    Symmetric.

    Args:
        input: depth map (..., Y, X), metres.
        target: true depth map, of the same shape and unit. Pixels that are not finite or not above zero (no surface) do
            not count.
        balance: weight of the squared mean, in [0, 1]. 1: a common factor is ignored; 0: the mean squared logarithm;
            0.5: as in the source.
        floor: depth below which the logarithm continues as its tangent, so that gradients lead out of zero.
        mask: pixels that count.
        reduction: "mean" over maps with a pixel that counts, "sum", or "none".

    Returns:
        Scalar, or a value per map (...) for "none", 0 for maps without a pixel that counts.

    Raises:
        UnitError: for a balance outside of [0, 1], and a floor that is not above zero.
        ShapeError: for two shapes.

    Source: Eigen, Puhrsch and Fergus 2014.
    """
    where = "scale_invariant_depth_loss"
    share = check_number("balance", balance, where)
    if not 0 <= share <= 1:
        raise UnitError(f"{where}: expected balance between 0 and 1, got {shown(balance)}.")
    input, target, mask = on_surfaces(input, target, mask, where, above_zero=True)
    if input.ndim < 2:
        raise ShapeError(f"{where}: expected depth maps (..., Y, X), got {tuple(input.shape)}.")
    least = check_level("floor", floor, input.new_empty(()), where)
    d = _log(counted(input, mask, 1.0), least) - _log(counted(target, mask, 1.0), least)
    number = mask.sum((-2, -1)).clamp_min(1)
    mean = d.sum((-2, -1)) / number
    # a variance and the rest of the squared mean: the difference of both squares cancels
    variance = counted(d - mean[..., None, None], mask).square().sum((-2, -1)) / number
    return reduce(variance + (1 - share) * mean.square(), reduction, where, mask.any(-1).any(-1))


class ScaleInvariantDepthLoss(
    LossModule, function=scale_invariant_depth_loss, by_place=("balance", "floor", "reduction")
):
    """`scale_invariant_depth_loss` with its options held."""


def _log(x: Tensor, least: Tensor) -> Tensor:
    """The logarithm, and its tangent at `least` below that."""
    # chosen by where: as a sum of clamped terms the two slopes of 1/least would cancel but for their rounding
    below = x < least
    return torch.where(below, least, x).log() + torch.where(below, x - least, 0.0) / least
