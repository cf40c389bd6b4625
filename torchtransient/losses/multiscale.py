"""Losses over many scales: any loss of two records over time, of the same records in coarser bins as well.

Two pulses that miss each other in bins of 2 cm meet in bins of half a metre, and the sum over all widths has a slope
from there to the last millimetre. Sums of s neighboring bins are what a sensor with bins s times as wide measures:
counts stay Poisson counts and first photons stay first photons, so each scale of a likelihood is a likelihood. Coarse
bins begin at each of their s possible places: with one of them a pulse would have a slope at the borders of coarse bins
only.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from torchtransient.errors import ArgumentError
from torchtransient.losses.checks import Reduction, check_level, counted, masked_pair, reduce
from torchtransient.losses.layouts import bins_dim
from torchtransient.losses.likelihoods import divisor, parts_of
from torchtransient.losses.loss_module import LossModule
from torchtransient.losses.measurement import PairLoss, shared_dim, takes_dim
from torchtransient.losses.results import BINNED, Binned, reads
from torchtransient.losses.squared import squared_loss

# Options in bins or of an axis, which would mean something else at each scale.
_OF_BINS = ("dead_bins", "bin_width_opl", "axis", "spacing")
# Options that are light of a bin, which is summed as bins are; True if zero is allowed.
_LIGHT_OF_BINS = {"floor": True, "background": False}
# Dimension of time in the tensors that `compare` receives.
_BINS = -3


@reads(input=BINNED, target=BINNED)
def multiscale_loss(
    input: Binned,
    target: Binned,
    compare: PairLoss = squared_loss,
    *,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Average a loss of two transients over scales 1, 2, 4, ... below T, in bins that many times as wide. ::

        multiscale_loss(rates, histogram, functools.partial(first_photon_nll, cycles=n))

    The value of a scale is the sum over its coarse bins, averaged over the places where they can begin, over the number
    of bins of the record: per bin of the record, as at scale one. Squares of sums grow with the scale, so the coarse
    ones lead; likelihoods and roots of counts weigh all alike. Coarse bins that reach beyond the record hold the part
    inside. Time and memory are those of `compare` times the number of scales.

    Args:
        input: transient (..., C, T, Y, X), or another layout with `dim`.
        target: transient of the same shape.
        compare: loss `(input, target, *, mask, reduction)` with a value for each bin, called with (..., C, bins,
            places, 1) and its `dim` set. A `floor` or `background` that `functools.partial` holds is light of a bin of
            the record (number or tensor that broadcasts), and is summed as bins are. Not supported: modules, and
            options in bins or lengths (`dead_bins`, `bin_width_opl`, `axis`). All other options are the same at each
            scale, those in units of light too, such as the read noise of a `root` or a threshold, though light grows
            with the scale.
        dim: dimension of time (`losses.layouts`).
        mask: bins that count. The others are empty in both, and take no cycles of detectors; a coarse bin counts if one
            of its bins does.
        reduction: "mean" over pixels that count, "sum", or "none".

    Returns:
        Unit of `compare`, per bin; scalar, or (..., C, Y, X) for "none".

    Raises:
        ArgumentError: for a `compare` that is not supported.
        ShapeError: for two shapes, or without `dim` where the shape is ambiguous.
    """
    where = "multiscale_loss"
    held = compare.keywords if isinstance(compare, functools.partial) else {}
    for name in _OF_BINS:
        if held.get(name) is not None:
            raise ArgumentError(f"{where}: expected compare without {name}=: bins are others at each scale.")
    given = input
    input, target, mask = masked_pair(input, target, mask, where)
    dim = bins_dim(input, shared_dim(compare, dim, input, where), where)
    bins = input.shape[dim]
    pixels = None if mask is None else mask.any(dim)
    if not input.numel():
        return reduce((input + target).sum(dim), reduction, where, pixels)
    number = torch.full((), bins) if mask is None else mask.sum(dim).clamp_min(1)
    seen = input.new_ones((1, 1, bins, 1)) if mask is None else _flat(mask.to(input.dtype), dim)
    windows = [_flat(input, dim), _flat(target, dim), seen]
    light = _levels(held, input, mask, seen, dim, where)
    options: dict[str, Any] = {"dim": _BINS} if takes_dim(compare) else {}
    each: Callable[..., Tensor] = functools.partial(compare, **options)
    # each bin has the mean of the slopes of its coarse ones
    averaged = number.amin().to(input.device) * divisor(input.select(dim, 0), pixels, reduction)
    values = []
    with parts_of(given, averaged):
        for scale in (2**k for k in range(max(1, math.ceil(math.log2(bins))))):
            if scale > 1:
                windows = [_doubled(x, scale // 2) for x in windows]
                light = {name: _doubled(x, scale // 2) for name, x in light.items()}
            values.append(_at_scale(scale, windows, light, input.select(dim, 0), each))
    mean = torch.stack(values).mean(0) / number.to(input)
    return reduce(mean, reduction, where, pixels)


class MultiscaleLoss(LossModule, function=multiscale_loss, by_place=("compare",)):
    """`multiscale_loss` with its options held."""


def _doubled(sums: Tensor, width: int) -> Tensor:
    """Return the sums of all windows of twice the width that hold a bin of a record.

    Args:
        sums: sums of all windows of `width` bins, (batch, C, T + width - 1, places). Unlike differences of running sums
            they do not cancel.
    """
    # padding, since the backward of slices fills a tensor of zeros for each
    return functional.pad(sums, (0, 0, 0, width)) + functional.pad(sums, (0, 0, width, 0))


def _coarse(sums: Tensor, scale: int) -> Tensor:
    """Sums of `scale` bins (scale x batch, C, J, places, 1), an item for each place where coarse bins begin."""
    batch, channels, length, places = sums.shape
    number = math.ceil(length / scale)
    sums = functional.pad(sums, (0, 0, 0, number * scale - length))
    each = sums.reshape(batch, channels, number, scale, places).movedim(3, 0)
    return each.reshape(scale * batch, channels, number, places, 1)


def _flat(x: Tensor, dim: int) -> Tensor:
    """Reshape a tensor with time in dimension `dim` to (batch, C, T, places)."""
    lead, bins, trail = x.shape[: dim + x.ndim], x.shape[dim], x.shape[dim + x.ndim + 1 :]
    batch, channels = (math.prod(lead[:-1]), lead[-1]) if lead else (1, 1)
    return x.reshape(batch, channels, bins, math.prod(trail))


def _levels(
    held: dict[str, Any], input: Tensor, mask: Tensor | None, seen: Tensor, dim: int, where: str
) -> dict[str, Tensor]:
    """Levels that `compare` holds as records (batch, C, T, places) or (1, 1, T, 1), 0 in masked bins."""
    records = {}
    for name, zero in _LIGHT_OF_BINS.items():
        if held.get(name) is None:
            continue
        level = check_level(name, held[name], input, where, zero=zero)
        records[name] = level * seen if level.ndim == 0 else _flat(counted(level.expand(input.shape), mask), dim)
    return records


def _at_scale(
    scale: int, windows: list[Tensor], light: dict[str, Tensor], like: Tensor, compare: Callable[..., Tensor]
) -> Tensor:
    """Sum `compare` over coarse bins and average it over the places where they begin."""
    first, second, seen = (_coarse(w, scale) for w in windows)

    def spread(x: Tensor) -> Tensor:
        """Expand a record that all pixels share."""
        return x.repeat_interleave(len(first) // len(x), 0).expand(first.shape)

    kept = spread(seen > 0)
    levels = {name: torch.where(kept, spread(_coarse(w, scale)), 1.0) for name, w in light.items()}
    value = compare(first, second, mask=kept, reduction="none", **levels)
    if value.shape != first.shape:
        raise ArgumentError(
            f"multiscale_loss: expected compare to give a value for each bin, {tuple(first.shape)}, got "
            f"{tuple(value.shape)}. Losses of whole records, such as wasserstein_loss, need no scales."
        )
    return value.sum(-3).reshape(scale, *like.shape).mean(0)
