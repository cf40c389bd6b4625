"""How far light has to be moved in time to make one record of another: the Wasserstein-1 distance, in metres of path.

Squared differences of two pulses that do not overlap say nothing of how far they are apart. The Wasserstein distance
is that shift, and its gradient points the right way from any distance (Vallender 1974 for the formula by cumulative
sums; Rubner, Tomasi and Guibas 2000 as a distance of histograms).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchtransient.losses.comparison import (
    Reduction,
    check_level,
    check_mask,
    check_option,
    check_pair,
    counted,
    item_scale,
    reduce,
)
from torchtransient.losses.layouts import bin_width, bins_dim, check_held, item_dims
from torchtransient.losses.results import TRANSIENT, Transient, reads

# Pixels below this share of the mean light of a pixel of their item have no shape of their own.
_MASS_FLOOR = 1e-3


@reads(input=TRANSIENT, target=TRANSIENT)
def wasserstein_loss(
    input: Transient,
    target: Transient,
    bin_width_opl: float | None = None,
    *,
    creation_cost_opl: float | None = None,
    floor: Tensor | float | None = None,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Wasserstein-1 distance over time of each pixel of two transients (..., C, T, Y, X). Symmetric.

    `creation_cost_opl` None: of records normalised to one, in metres of optical path; brightness has no part. A pixel
    whose light is below `floor` (in the unit of the transient summed over its bins; None: 1e-3 of the mean pixel of
    each item of each) is filled up to it with light spread evenly over its bins: an empty one is as far from the other
    as that is, without a jump and with gradients of at most T bin_width_opl / floor.

    With `creation_cost_opl`, a length L: unbalanced, in metres times light. The brighter record gives off its excess,
    evenly in all bins, at L a unit; the rest is moved: `m W1(a, b) + L |mass(a) - mass(b)|`, m the mass of the darker
    one. Take L as the length above which light is rather missing than late. Exact, with finite gradients at empty
    pixels. This is the cost of one way to do it, at least that of the cheapest (partial optimal transport).

    Light counts as at the middle of its bin; negative bins, of captures less their background, enter the same formula.
    Computed by cumulative sums of differences. `bin_width_opl`: None takes that of results with an axis. `dim`: where
    time is (`losses.layouts`), or another axis of equal bins, whose width and unit the distance then has: -4 of rates
    (C, R, T, Y, X), with the width of their bins in m/s. `mask` (..., C, T, Y, X): bins that do not count are empty in
    both. `reduction="none"`: without time, (..., C, Y, X). Raises ShapeError, UnitError.
    """
    where = "wasserstein_loss"
    check_held(reduction, dim, where)
    check_option("floor", floor, where)
    input, target = check_pair(input, target, where)
    dim = bins_dim(input, dim, where)
    mask = check_mask(mask, input, where)
    width = bin_width(bin_width_opl, input, where)
    pixels = None if mask is None else mask.any(dim)
    a, b = counted(input, mask), counted(target, mask)
    if creation_cost_opl is not None:
        cost = check_level("creation_cost_opl", creation_cost_opl, width, where)
        return reduce(_unbalanced(a, b, width, cost, dim), reduction, where, pixels)
    mass_a, mass_b = a.sum(dim, keepdim=True), b.sum(dim, keepdim=True)
    kept = None if pixels is None else pixels.unsqueeze(dim)
    if floor is None:
        item = item_dims(input, dim, where)
        floor_a, floor_b = (_MASS_FLOOR * item_scale(*m, item, kept) for m in ((mass_a, mass_b), (mass_b, mass_a)))
    else:
        floor_a = floor_b = check_level("floor", floor, mass_a, where)
    counts = torch.ones_like(a) if mask is None else mask.to(a.dtype)
    even = counts / counts.sum(dim, keepdim=True).clamp_min(1)
    difference = _normalised(a, mass_a, even, floor_a) - _normalised(b, mass_b, even, floor_b)
    return reduce(width * _moved(difference, dim), reduction, where, pixels)


def _normalised(x: Tensor, mass: Tensor, even: Tensor, floor: Tensor) -> Tensor:
    """Records of mass one: those below the floor are filled up to it evenly."""
    least = floor.clamp_min(torch.finfo(x.dtype).tiny)
    lacking = (least - mass).clamp_min(0)
    return (x + lacking * even) / torch.maximum(mass, least)


def _moved(difference: Tensor, dim: int) -> Tensor:
    """Bins that light is moved by, times how much: the sum of the moduli of cumulative sums."""
    # The last one is zero but for rounding, whose sign would be a gradient.
    bins = difference.shape[dim]
    return difference.narrow(dim, 0, bins - 1).cumsum(dim).abs().sum(dim)


def _unbalanced(a: Tensor, b: Tensor, width: Tensor, cost: Tensor, dim: int) -> Tensor:
    mass_a, mass_b = a.sum(dim, keepdim=True), b.sum(dim, keepdim=True)
    darker = torch.minimum(mass_a, mass_b).clamp_min(0)

    def shortened(x: Tensor, mass: Tensor) -> Tensor:
        """`x` to the mass of the darker one; the darker one as it is, which divides by nothing."""
        longer = mass > darker
        share = torch.where(longer, darker, torch.ones_like(mass)) / torch.where(longer, mass, torch.ones_like(mass))
        return x * share

    moved = _moved(shortened(a, mass_a) - shortened(b, mass_b), dim)
    return width * moved + cost * (mass_a - mass_b).abs().squeeze(dim)


class WassersteinLoss(nn.Module):
    """`wasserstein_loss(input, target, bin_width_opl)` with its options held."""

    def __init__(
        self,
        bin_width_opl: float | None = None,
        *,
        creation_cost_opl: float | None = None,
        floor: float | None = None,
        dim: int | None = None,
        reduction: Reduction = "mean",
    ) -> None:
        super().__init__()
        check_held(reduction, dim, "WassersteinLoss")
        check_option("bin_width_opl", bin_width_opl, "WassersteinLoss")
        check_option("creation_cost_opl", creation_cost_opl, "WassersteinLoss")
        check_option("floor", floor, "WassersteinLoss")
        self.bin_width_opl, self.creation_cost_opl = bin_width_opl, creation_cost_opl
        self.floor, self.dim, self.reduction = floor, dim, reduction

    def forward(self, input: Transient, target: Transient, mask: Tensor | None = None) -> Tensor:
        return wasserstein_loss(
            input,
            target,
            self.bin_width_opl,
            creation_cost_opl=self.creation_cost_opl,
            floor=self.floor,
            dim=self.dim,
            mask=mask,
            reduction=self.reduction,
        )
