"""Depth maps of hidden surfaces against the truth, where there is a surface."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchtransient.losses.comparison import Reduction, check_mask, check_pair, check_reduction, counted, reduce
from torchtransient.losses.measured import DEPTH, DepthMap, reads


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


class DepthLoss(nn.Module):
    """`depth_loss(input, target)` with its reduction held."""

    def __init__(self, reduction: Reduction = "mean") -> None:
        super().__init__()
        check_reduction(reduction, "DepthLoss")
        self.reduction = reduction

    def forward(self, input: DepthMap, target: DepthMap, mask: Tensor | None = None) -> Tensor:
        return depth_loss(input, target, mask=mask, reduction=self.reduction)
