"""Distances of histograms over time, pixel by pixel, of records normalized to one.

Pixels without light in the target do not count. An input without light where the target has some raises UnitError,
since no distance of it is right: leave it out by `mask`, or take a loss that compares brightness.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.checks import share
from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.floating import is_true
from torchtransient.losses.layouts import bins_dim
from torchtransient.losses.results import TRANSIENT, Transient, reads
from torchtransient.losses.wasserstein import moved_bins
from torchtransient.metrics.tally import Reduction, Tally, measured_pair


@reads(input=TRANSIENT, target=TRANSIENT)
def histogram_total_variation(
    input: Transient,
    target: Transient,
    *,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Compute the total variation distance of each pixel, `sum |p - q| / 2`: the share of light in wrong bins.

    Args:
        input: transients (..., C, T, Y, X), or another layout with `dim`, not negative; normalized to p.
        target: transients of the same shape; normalized to q.
        dim: dimension of time, see `tt.losses`.
        mask: bins that count; the others are empty in both.
        reduction: "mean" of all pixels, "item" of each item of a batch (its channels and pixels), or "none".

    Returns:
        In [0, 1]; scalar, (...) for "item", (..., C, Y, X) for "none"; NaN where nothing counts.

    Raises:
        UnitError: for negative bins, for bins that are not finite, and for a dark input where the target has light.
        ShapeError: for two shapes, or without `dim` where the shape is ambiguous.
    """
    where = "histogram_total_variation"
    p, q, lit, place = _distributions(input, target, dim, mask, where)
    return Tally((p - q).abs().sum(place) / 2, lit, -place).result(reduction, where)


@reads(input=TRANSIENT, target=TRANSIENT)
def histogram_wasserstein_opl(
    input: Transient,
    target: Transient,
    axis: TimeAxis | None = None,
    *,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Compute the Wasserstein-1 distance over time of each pixel, metres of path: how far light has to move.

    Light counts as at the middle of its bin. `tt.losses.wasserstein_loss` fills up dark pixels instead of refusing
    them.

    Args:
        axis: time axis; None: that of results. For the other arguments see `histogram_total_variation`.

    Raises:
        ArgumentError: for tensors without an axis.

    Source: Vallender 1974, the area between cumulative distributions.
    """
    where = "histogram_wasserstein_opl"
    known = _axis(axis, where)
    moved, lit, place = _moved(input, target, known, dim, mask, where)
    return Tally(moved * known.bin_width_opl, lit, -place).result(reduction, where)


@reads(input=TRANSIENT, target=TRANSIENT)
def histogram_wasserstein_s(
    input: Transient,
    target: Transient,
    axis: TimeAxis | None = None,
    *,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Compute the Wasserstein-1 distance over time of each pixel, seconds.

    Args:
        input, target: transients (..., C, T, Y, X), or another layout with `dim`, not negative.
        axis: time axis; None: that of results.
        dim: dimension of time, see `tt.losses`.
        mask: bins that count; the others are empty in both.
        reduction: "mean" of all pixels, "item" of each item of a batch (its channels and pixels), or "none".
    """
    where = "histogram_wasserstein_s"
    known = _axis(axis, where)
    moved, lit, place = _moved(input, target, known, dim, mask, where)
    return Tally(moved * known.bin_width_s, lit, -place).result(reduction, where)


@reads(input=TRANSIENT, target=TRANSIENT)
def histogram_kl(
    input: Transient,
    target: Transient,
    *,
    smoothing: float = 0.0,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Compute the Kullback-Leibler divergence of each pixel, `KL(q || p) = sum q log(q / p)`, nats. Not symmetric.

    Infinite where the target has light in a bin that is empty in the input.

    Args:
        smoothing: s in [0, 1]; the input is taken as `(1 - s) p + s / T` over the T bins that count. Other arguments as
            in `histogram_total_variation`.

    Source: Kullback and Leibler 1951.
    """
    where = "histogram_kl"
    part = share(f"{where}: smoothing", smoothing)
    p, q, lit, place = _distributions(input, target, dim, mask, where)
    if part:
        bins = torch.ones_like(p) if mask is None else mask.expand(p.shape).to(p.dtype)
        p = (1 - part) * p + part * bins / bins.sum(place, keepdim=True).clamp_min(1)
    there = q > 0
    # the difference of two logarithms is zero for equal ones, and finite where the quotient is not
    logs = torch.where(there, q, torch.ones_like(q)).log() - torch.where(there, p, torch.ones_like(p)).log()
    return Tally((q * logs).sum(place), lit, -place).result(reduction, where)


def _axis(axis: TimeAxis | None, where: str) -> TimeAxis:
    if axis is None:
        raise ArgumentError(f"{where}: expected axis=, a tt.TimeAxis, or results that have one, got None.")
    return axis


def _moved(
    input: object, target: object, axis: TimeAxis, dim: int | None, mask: Tensor | None, where: str
) -> tuple[Tensor, Tensor, int]:
    """Return the bins that light has to be moved by in each pixel, the pixels that count, the dimension of time."""
    p, q, lit, place = _distributions(input, target, dim, mask, where)
    if p.shape[place] != axis.num_bins:
        raise ShapeError(
            f"{where}: expected the {axis.num_bins} bins of the axis in dimension {place}, got {tuple(p.shape)}."
        )
    return moved_bins(p - q, place), lit, place


def _distributions(
    input: object, target: object, dim: int | None, mask: Tensor | None, where: str
) -> tuple[Tensor, Tensor, Tensor, int]:
    """Return normalized records (zero for dark pixels), the pixels that count, the dimension of time."""
    x, y, _ = measured_pair(input, target, mask, where)
    place = bins_dim(x, dim, where)
    records = []
    for kept, name in ((x, "input"), (y, "target")):
        if not is_true(kept >= 0):
            raise UnitError(
                f"{where}: expected {name} without negative bins, got {int((kept < 0).sum())} of them. A record less "
                "its background is no distribution: use .clamp_min(0), or a loss of tt.losses."
            )
        # over the highest bin first: sums may overflow single precision
        top = kept.amax(place, keepdim=True)
        records.append(kept / torch.where(top > 0, top, torch.ones_like(top)))
    ours, theirs = (record.sum(place, keepdim=True) for record in records)
    lit = theirs > 0
    dark = lit & (ours <= 0)
    if not is_true(~dark):
        raise UnitError(
            f"{where}: expected light in the input wherever the target has some, got {int(dark.sum())} pixels without. "
            "Leave them out with mask=, and say how many those are; tt.losses.wasserstein_loss fills them up."
        )
    p, q = (
        record / torch.where(mass > 0, mass, torch.ones_like(mass))
        for record, mass in zip(records, (ours, theirs), strict=True)
    )
    return p, q, lit.squeeze(place), place
