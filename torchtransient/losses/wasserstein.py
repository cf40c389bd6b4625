"""Distances of arrival times by running sums: the Wasserstein-1 distance and the area between two records.

Squared differences of two pulses that do not overlap are blind to how far apart they are. Both losses here have a slope
towards home from any distance. The Wasserstein distance compares shapes; the area compares brightness too, and does not
amplify the noise of dark pixels.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchtransient.losses.checks import Reduction, check_level, counted, item_scale, masked_pair, reduce
from torchtransient.losses.layouts import bin_width, bins_dim, item_dims
from torchtransient.losses.loss_module import LossModule
from torchtransient.losses.results import BINNED, Binned, reads

# Pixels with less than this share of the light of the mean pixel of their item have no shape of their own.
_MASS_FLOOR = 1e-3


@reads(input=BINNED, target=BINNED)
def wasserstein_loss(
    input: Binned,
    target: Binned,
    bin_width_opl: float | None = None,
    *,
    creation_cost_opl: float | None = None,
    floor: Tensor | float | None = None,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Compute the Wasserstein-1 distance over time of each pixel: how far light has to be moved. Symmetric.

    Records are normalized to one, so that brightness has no part, and light counts as at the middle of its bin. A pixel
    with less light than `floor` is filled up to it evenly over its bins: without a jump, with gradients of at most
    `T bin_width_opl / floor`.

    With `creation_cost_opl` L the distance is unbalanced, `m W1 + L |mass(input) - mass(target)|` with the mass m of
    the darker record: the brighter one gives off its excess evenly in all bins, and the rest is moved. Exact, with
    finite gradients at empty pixels; an upper bound of partial optimal transport.

    Args:
        input: transient (..., C, T, Y, X), or another layout with `dim`; negative bins are allowed.
        target: transient of the same shape.
        bin_width_opl: width of a bin, metres of optical path; None: that of results with an axis.
        creation_cost_opl: length in metres above which light is rather missing than late; None: normalized records.
        floor: light of a pixel summed over its bins, above zero; None: 1e-3 of the mean pixel of each item of each.
        dim: dimension of time (`losses.layouts`), or another axis of equal bins, whose width and unit the distance then
            has: -4 of rates (C, R, T, Y, X), with the width of their bins in m/s. Results with `rates` have both.
        mask: bins that count; the others are empty in both.
        reduction: "mean" over pixels that count, "sum", or "none".

    Returns:
        Metres of path (unbalanced: metres times light); scalar, or (..., C, Y, X) for "none".

    Raises:
        UnitError: for a width or cost below 0.3 fs (seconds), a floor that is not above zero, or tensors without width.
        ShapeError: for two shapes, or without `dim` where the shape is ambiguous.

    Source: Vallender 1974 for cumulative sums; Rubner, Tomasi and Guibas 2000.
    """
    where = "wasserstein_loss"
    a, b, mask = masked_pair(input, target, mask, where)
    dim = bins_dim(a, dim, where)
    width = bin_width(bin_width_opl, a, where)
    pixels = None if mask is None else mask.any(dim)
    if creation_cost_opl is not None:
        cost = check_level("creation_cost_opl", creation_cost_opl, width, where)
        return reduce(_unbalanced(a, b, width, cost, dim), reduction, where, pixels)
    mass_a, mass_b = a.sum(dim, keepdim=True), b.sum(dim, keepdim=True)
    kept = None if pixels is None else pixels.unsqueeze(dim)
    if floor is None:
        item = item_dims(a, dim, where)
        floor_a, floor_b = (_MASS_FLOOR * item_scale(*m, item, kept) for m in ((mass_a, mass_b), (mass_b, mass_a)))
    else:
        floor_a = floor_b = check_level("floor", floor, mass_a, where)
    counts = torch.ones_like(a) if mask is None else mask.to(a.dtype)
    even = counts / counts.sum(dim, keepdim=True).clamp_min(1)
    difference = _normalized(a, mass_a, even, floor_a) - _normalized(b, mass_b, even, floor_b)
    return reduce(width * moved_bins(difference, dim), reduction, where, pixels)


class WassersteinLoss(LossModule, function=wasserstein_loss, by_place=("bin_width_opl",)):
    """`wasserstein_loss` with its options held."""


@reads(input=BINNED, target=BINNED)
def cumulative_loss(
    input: Binned,
    target: Binned,
    bin_width_opl: float | None = None,
    *,
    per_root_count: bool = False,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Compute the area between running sums of transients, `bin_width_opl sum |cumsum(input - target)|`. Symmetric.

    Light that is late by d costs d; light that is missing, or too much, costs its distance to the end of the window.
    Records with background need a model with background. Gradients are at most `T bin_width_opl` per bin.

    Args:
        input: transient (..., C, T, Y, X), or another layout with `dim`.
        target: transient of the same shape.
        bin_width_opl: width of a bin, metres of optical path; None: that of results with an axis.
        per_root_count: divide by the root of the target's total in each pixel (at least one), the noise of its running
            sum where the target is photon counts. Without gradient, not symmetric.
        dim: dimension of time (`losses.layouts`).
        mask: bins that count; the others are empty in both and have no width.
        reduction: "mean" over pixels that count, "sum", or "none".

    Returns:
        Metres of path times the unit of the light; scalar, or (..., C, Y, X) for "none".

    Raises:
        UnitError: for a width below 0.3 fs (seconds), or tensors without width.
        ShapeError: for two shapes, or without `dim` where the shape is ambiguous.
    """
    where = "cumulative_loss"
    a, b, mask = masked_pair(input, target, mask, where)
    dim = bins_dim(a, dim, where)
    width = bin_width(bin_width_opl, a, where)
    area = width * counted((a - b).cumsum(dim).abs(), mask).sum(dim)
    if per_root_count:
        area = area / b.detach().sum(dim).clamp_min(1).sqrt()
    return reduce(area, reduction, where, None if mask is None else mask.any(dim))


class CumulativeLoss(LossModule, function=cumulative_loss, by_place=("bin_width_opl",)):
    """`cumulative_loss` with its options held."""


def _normalized(x: Tensor, mass: Tensor, even: Tensor, floor: Tensor) -> Tensor:
    """Records of mass one, filled up evenly to the floor where they are below it."""
    least = floor.clamp_min(torch.finfo(x.dtype).tiny)
    lacking = (least - mass).clamp_min(0)
    return (x + lacking * even) / torch.maximum(mass, least)


def moved_bins(difference: Tensor, dim: int) -> Tensor:
    """Return light times the bins that it is moved by: the sum of the moduli of cumulative sums.

    Args:
        difference: difference of two records with the same sum.
        dim: dimension of time.
    """
    # without the last sum, which is zero but for rounding, whose sign would be a gradient
    bins = difference.shape[dim]
    return difference.narrow(dim, 0, bins - 1).cumsum(dim).abs().sum(dim)


def _unbalanced(a: Tensor, b: Tensor, width: Tensor, cost: Tensor, dim: int) -> Tensor:
    mass_a, mass_b = a.sum(dim, keepdim=True), b.sum(dim, keepdim=True)
    darker = torch.minimum(mass_a, mass_b).clamp_min(0)

    def shortened(x: Tensor, mass: Tensor) -> Tensor:
        """`x` scaled to the mass of the darker record; the darker one unchanged, without a division."""
        longer = mass > darker
        share = torch.where(longer, darker, torch.ones_like(mass)) / torch.where(longer, mass, torch.ones_like(mass))
        return x * share

    moved = moved_bins(shortened(a, mass_a) - shortened(b, mass_b), dim)
    return width * moved + cost * (mass_a - mass_b).abs().squeeze(dim)
