"""Depth maps of hidden surfaces against the truth, where there is a surface."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchtransient.checks import shown
from torchtransient.errors import ShapeError, UnitError
from torchtransient.losses.comparison import (
    Reduction,
    check_level,
    check_mask,
    check_number,
    check_option,
    check_pair,
    check_reduction,
    counted,
    reduce,
)
from torchtransient.losses.results import DEPTH, DepthMap, reads


@reads(input=DEPTH, target=DEPTH)
def depth_loss(
    input: DepthMap, target: DepthMap, *, mask: Tensor | None = None, reduction: Reduction = "mean"
) -> Tensor:
    """`|input - target|` of each pixel of two depth maps (..., Y, X), in their unit (metres). Symmetric where finite.

    Pixels whose target is not finite (NaN or infinite: no surface there) do not count, nor those that `mask` leaves
    out; without any that counts the loss is 0. The gradient is 0 where the two agree. Raises ShapeError, UnitError.
    """
    where = "depth_loss"
    check_reduction(reduction, where)
    input, target = check_pair(input, target, where)
    surface = torch.isfinite(target)
    given = check_mask(mask, target, where)
    mask = surface if given is None else given & surface
    return reduce((counted(input, mask) - counted(target, mask)).abs(), reduction, where, mask)


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
    """`mean(d^2) - balance mean(d)^2` of `d = log(input / target)` over each depth map (..., Y, X). Symmetric.

    Eigen, Puhrsch and Fergus 2014. `balance` 1: a factor that all pixels share has no part, as where the distance of a
    scene cannot be known; 0: the mean squared logarithm; 1/2, as they trained. Both maps in one unit, metres.
    Depths of the input below `floor`, in that unit, continue the tangent of the logarithm there, so that gradients lead
    out of what has none. Pixels whose target is not finite or not above zero (no surface there) do not count, nor
    those that `mask` leaves out. `reduction="none"`: a value for each map, (...); maps without a pixel that counts
    are 0 and left out of the mean. Raises ShapeError; UnitError, also for a balance outside of [0, 1].
    """
    where = "scale_invariant_depth_loss"
    check_reduction(reduction, where)
    share = _check_balance(balance, where)
    input, target = check_pair(input, target, where)
    if input.ndim < 2:
        raise ShapeError(f"{where}: expected depth maps (..., Y, X), got {tuple(input.shape)}.")
    least = check_level("floor", floor, input.new_empty(()), where)
    surface = torch.isfinite(target) & (target > 0)
    given = check_mask(mask, target, where)
    mask = surface if given is None else given & surface
    d = _log(counted(input, mask, 1.0), least) - _log(counted(target, mask, 1.0), least)
    number = mask.sum((-2, -1)).clamp_min(1)
    mean = d.sum((-2, -1)) / number
    # a variance and what is left of the squared mean: the difference of both squares loses what they have in common
    variance = counted(d - mean[..., None, None], mask).square().sum((-2, -1)) / number
    return reduce(variance + (1 - share) * mean.square(), reduction, where, mask.any(-1).any(-1))


def _log(x: Tensor, least: Tensor) -> Tensor:
    """The logarithm, and its tangent at `least` below that."""
    # chosen, not a difference to the larger one: its two slopes of 1/least would cancel but for their rounding
    below = x < least
    return torch.where(below, least, x).log() + torch.where(below, x - least, 0.0) / least


def _check_balance(balance: float, where: str) -> float:
    number = check_number("balance", balance, where)
    if isinstance(balance, bool) or not 0 <= number <= 1:
        raise UnitError(f"{where}: expected balance between 0 and 1, got {shown(balance)}.")
    return number


class DepthLoss(nn.Module):
    """`depth_loss(input, target)` with its reduction held."""

    def __init__(self, reduction: Reduction = "mean") -> None:
        super().__init__()
        check_reduction(reduction, "DepthLoss")
        self.reduction = reduction

    def forward(self, input: DepthMap, target: DepthMap, mask: Tensor | None = None) -> Tensor:
        return depth_loss(input, target, mask=mask, reduction=self.reduction)


class ScaleInvariantDepthLoss(nn.Module):
    """`scale_invariant_depth_loss(input, target)` with its options held."""

    def __init__(self, balance: float = 0.5, floor: float = 1e-3, reduction: Reduction = "mean") -> None:
        super().__init__()
        check_reduction(reduction, "ScaleInvariantDepthLoss")
        _check_balance(balance, "ScaleInvariantDepthLoss")
        check_option("floor", floor, "ScaleInvariantDepthLoss", needed=True)
        self.balance, self.floor, self.reduction = balance, floor, reduction

    def forward(self, input: DepthMap, target: DepthMap, mask: Tensor | None = None) -> Tensor:
        return scale_invariant_depth_loss(
            input, target, balance=self.balance, floor=self.floor, mask=mask, reduction=self.reduction
        )
