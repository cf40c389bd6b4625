"""The area between the running sums of two records: how late light is and how much of it is missing, in one number.

Without normalisation, unlike the Wasserstein distance: brightness counts, and noise of dark pixels is not blown up. The
gradient points the right way from any distance, as that of a squared difference of two pulses that do not overlap does
not.
"""

from __future__ import annotations

from torch import Tensor, nn

from torchtransient.checks import flag
from torchtransient.losses.comparison import (
    Reduction,
    check_mask,
    check_option,
    check_pair,
    counted,
    reduce,
)
from torchtransient.losses.layouts import bin_width, bins_dim, check_held
from torchtransient.losses.results import TRANSIENT, Transient, reads


@reads(input=TRANSIENT, target=TRANSIENT)
def cumulative_loss(
    input: Transient,
    target: Transient,
    bin_width_opl: float | None = None,
    *,
    per_root_count: bool = False,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """`bin_width_opl sum |cumsum(input - target)|` over time of each pixel of two transients (..., C, T, Y, X).

    In metres of optical path times the unit of the transient. Light of one that is late by d costs d; light of one that
    is missing, or too much, costs its distance to the end of the window. Records with background want a model with
    background. Symmetric; gradients of at most `T bin_width_opl` per bin.

    `per_root_count`: over the root of the target's total in each pixel (at least one), the noise of its running sum
    where the target is photon counts, so that bright pixels do not outvote dark ones; without gradient, not symmetric.
    `dim`: where time is (`losses.layouts`). `mask` (..., C, T, Y, X): bins that do not count are empty in both and
    have no width. `reduction="none"`: without time, (..., C, Y, X). Raises ShapeError, UnitError.
    """
    where = "cumulative_loss"
    check_held(reduction, dim, where)
    flag(f"{where}: per_root_count", per_root_count)
    input, target = check_pair(input, target, where)
    dim = bins_dim(input, dim, where)
    mask = check_mask(mask, input, where)
    width = bin_width(bin_width_opl, input, where)
    a, b = counted(input, mask), counted(target, mask)
    area = width * counted((a - b).cumsum(dim).abs(), mask).sum(dim)
    if per_root_count:
        area = area / b.detach().sum(dim).clamp_min(1).sqrt()
    return reduce(area, reduction, where, None if mask is None else mask.any(dim))


class CumulativeLoss(nn.Module):
    """`cumulative_loss(input, target, bin_width_opl)` with its options held."""

    def __init__(
        self,
        bin_width_opl: float | None = None,
        *,
        per_root_count: bool = False,
        dim: int | None = None,
        reduction: Reduction = "mean",
    ) -> None:
        super().__init__()
        check_held(reduction, dim, "CumulativeLoss")
        check_option("bin_width_opl", bin_width_opl, "CumulativeLoss")
        flag("CumulativeLoss: per_root_count", per_root_count)
        self.bin_width_opl, self.per_root_count = bin_width_opl, per_root_count
        self.dim, self.reduction = dim, reduction

    def forward(self, input: Transient, target: Transient, mask: Tensor | None = None) -> Tensor:
        return cumulative_loss(
            input,
            target,
            self.bin_width_opl,
            per_root_count=self.per_root_count,
            dim=self.dim,
            mask=mask,
            reduction=self.reduction,
        )
