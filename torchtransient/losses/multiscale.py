"""Any loss of two records over time, of the same records in coarser bins as well: two pulses that miss each other in
bins of 2 cm meet in bins of half a metre, and the sum over all widths has a slope from there to the last millimetre.

Sums of s neighbouring bins are what a sensor with bins s times as wide would have measured: counts stay Poisson counts,
and the first photons of cycles stay first photons, so that each scale of a likelihood is one. Coarse bins begin at each
of the s places they can begin at: with one of them a pulse would have a slope at the borders of coarse bins only.
"""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Callable, Sequence
from typing import Protocol, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from torchtransient.errors import ShapeError
from torchtransient.losses.comparison import (
    Reduction,
    check_function,
    check_mask,
    check_pair,
    check_whole,
    counted,
    reduce,
)
from torchtransient.losses.layouts import bins_dim, check_held
from torchtransient.losses.measured import TRANSIENT, Transient, reads
from torchtransient.losses.measurement import squared_loss
from torchtransient.quantities import shown

# Options in bins of the record, or of its axis, that would mean something else at each scale.
_OF_BINS = ("dead_bins", "bin_width_opl", "axis", "spacing")


class RecordLoss(Protocol):
    """A loss of this room that compares two records bin by bin; `functools.partial` holds further options of one."""

    def __call__(self, input: Tensor, target: Tensor, *, mask: Tensor | None, reduction: Reduction) -> Tensor: ...


@reads(input=TRANSIENT, target=TRANSIENT)
def multiscale_loss(
    input: Transient,
    target: Transient,
    compare: RecordLoss = squared_loss,
    *,
    scales: Sequence[int] | None = None,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Mean over `scales` of `compare` of two transients (..., C, T, Y, X) in bins that many times as wide.

    `compare`: a loss (input, target, mask=, reduction=) of this room that has a value for each bin, such as
    `root_loss` or `functools.partial(first_photon_loss, cycles=n)`. Coarse bins are sums; those at both ends of the
    record, which reach beyond it, hold what is there. A scale's value is the sum over its bins, averaged over the
    places where coarse bins may begin, over the number of bins of the record: per bin of the record, as at scale one.
    Squares of sums grow with the scale and let the coarse ones lead; likelihoods and roots of counts weigh all alike.

    `scales`: whole numbers; None: 1, 2, 4, ... as long as they are below T. Pulses are pulled from a distance of about
    the largest one. `dim`: where time is (`losses.layouts`). `mask` (..., C, T, Y, X): bins that do not count are empty
    in both, and take no cycles of detectors; a coarse bin counts if one of its own does. `reduction="none"`: without
    time, (..., C, Y, X). Time and memory are those of `compare` times the number of scales.

    Not supported: `compare` with options in bins or lengths (`dead_bins`, `bin_width_opl`, `axis`), of
    detectors that are armed again within a cycle, or as a module. Raises ShapeError, UnitError, and what `compare`
    does.
    """
    where = "multiscale_loss"
    check_held(reduction, dim, where)
    steps = _check_scales(scales, where)
    known = _check_compare(compare, where)
    input, target = check_pair(input, target, where)
    dim = bins_dim(input, dim, where)
    mask = check_mask(mask, input, where)
    bins = input.shape[dim]
    if steps is None:
        steps = [2**k for k in range(max(1, math.ceil(math.log2(bins))))]
    pixels = None if mask is None else mask.any(dim)
    if not input.numel():
        return reduce((input + target).sum(dim), reduction, where, pixels)
    number = torch.full((), bins) if mask is None else mask.sum(dim).clamp_min(1)
    records = [counted(input, mask), counted(target, mask)]
    each: Callable[..., Tensor] = functools.partial(compare, dim=-3) if known else compare  # type: ignore[call-arg]
    values = [_at_scale(s, records, mask, dim, each) for s in steps]
    mean = torch.stack(values).mean(0) / number.to(input)
    return reduce(mean, reduction, where, pixels)


def _at_scale(
    scale: int, records: list[Tensor], mask: Tensor | None, dim: int, compare: Callable[..., Tensor]
) -> Tensor:
    """`compare` summed over coarse bins and averaged over the places where they begin: without time."""
    first, second = (_coarse(x, scale, dim) for x in records)
    # those that hold no bin of the record do not count either
    seen = torch.ones_like(records[0]) if mask is None else mask.to(first.dtype)
    kept = _coarse(seen, scale, dim) > 0
    value = compare(first, second, mask=kept, reduction="none")
    if not isinstance(value, Tensor) or value.shape != first.shape:
        got = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
        raise ShapeError(
            f"multiscale_loss: expected compare to give a value for each bin, {tuple(first.shape)}, got {got}. Losses "
            "of whole records, such as wasserstein_loss, need no scales."
        )
    like = records[0].select(dim, 0)
    return value.sum(-3).reshape(scale, *like.shape).mean(0)


def _coarse(x: Tensor, scale: int, dim: int) -> Tensor:
    """(scale x batch, C, J, places, 1): sums of `scale` bins for each of the places where coarse bins begin.

    An item for each of them, so that losses that look at whole records see proper ones.
    """
    lead, bins, trail = x.shape[: dim + x.ndim], x.shape[dim], x.shape[dim + x.ndim + 1 :]
    batch, channels = (math.prod(lead[:-1]), lead[-1]) if lead else (1, 1)
    number = math.ceil((bins + scale - 1) / scale)
    padding = (0, 0, scale - 1, number * scale - bins)
    sums = _sliding(functional.pad(x.reshape(batch, channels, bins, math.prod(trail)), padding), scale)
    each = sums.reshape(batch, channels, number, scale, -1).movedim(3, 0)
    return each.reshape(scale * batch, channels, number, -1, 1)


def _sliding(x: Tensor, width: int) -> Tensor:
    """Sums of `width` neighbours along the third dimension, by windows of 1, 2, 4, ...: no cancellation as of
    differences of running sums.
    """
    length = x.shape[2] - width + 1
    total, start, size, window = torch.zeros_like(x[:, :, :length]), 0, 1, x
    while True:
        if width & size:
            total, start = total + window[:, :, start : start + length], start + size
        if 2 * size > width:
            return total
        window = window[:, :, : window.shape[2] - size] + window[:, :, size:]
        size *= 2


def _check_scales(scales: Sequence[int] | None, where: str) -> list[int] | None:
    if scales is None:
        return None
    if not hasattr(scales, "__len__") or isinstance(scales, str) or not len(scales):
        raise ShapeError(f"{where}: expected scales as one or more whole numbers, got {shown(scales)}.")
    return [check_whole("scales", s, where) for s in scales]


def _check_compare(compare: object, where: str) -> bool:
    """Whether it takes `dim`. Raises ShapeError for what is no loss of bins with what is in bins left out."""
    check_function("compare", compare, where)
    title = getattr(compare, "__name__", None) or getattr(getattr(compare, "func", compare), "__name__", shown(compare))
    if isinstance(compare, nn.Module):
        raise ShapeError(f"{where}: expected compare to be a function, got the module {type(compare).__name__}.")
    try:
        signature = inspect.signature(cast(Callable[..., object], compare))
        signature.bind(None, None, mask=None, reduction="none")
    except (TypeError, ValueError) as error:
        raise ShapeError(
            f"{where}: expected compare to take (input, target, mask=, reduction=) and no more, got {title}: {error}. "
            "functools.partial holds further arguments of a loss of tt.losses."
        ) from None
    known = signature.parameters
    for name in _OF_BINS:
        if name in known and known[name].default not in (None, inspect.Parameter.empty):
            raise ShapeError(
                f"{where}: expected compare without options in bins, got {title} with {name}={known[name].default}: "
                "bins are others at each scale."
            )
    return "dim" in known and known["dim"].default is None


class MultiscaleLoss(nn.Module):
    """`multiscale_loss(input, target)` with its options held."""

    def __init__(
        self,
        compare: RecordLoss = squared_loss,
        scales: Sequence[int] | None = None,
        dim: int | None = None,
        reduction: Reduction = "mean",
    ) -> None:
        super().__init__()
        check_held(reduction, dim, "MultiscaleLoss")
        _check_compare(compare, "MultiscaleLoss")
        self.compare, self.scales = compare, _check_scales(scales, "MultiscaleLoss")
        self.dim, self.reduction = dim, reduction

    def forward(self, input: Transient, target: Transient, mask: Tensor | None = None) -> Tensor:
        return multiscale_loss(
            input, target, self.compare, scales=self.scales, dim=self.dim, mask=mask, reduction=self.reduction
        )
