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
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from torchtransient.checks import shown
from torchtransient.errors import ArgumentError, ShapeError
from torchtransient.losses.comparison import (
    Reduction,
    check_level,
    check_mask,
    check_option,
    check_pair,
    check_whole,
    counted,
    reduce,
)
from torchtransient.losses.layouts import bins_dim, check_held
from torchtransient.losses.likelihoods import averaged_over, in_the_name_of
from torchtransient.losses.measurement import squared_loss
from torchtransient.losses.pair_losses import PairLoss, check_compare, shared_dim
from torchtransient.losses.results import TRANSIENT, Transient, reads

# Options in bins of the record, or of its axis, that would mean something else at each scale.
_OF_BINS = ("dead_bins", "bin_width_opl", "axis", "spacing")
# Options that are light of a bin, which adds up over those of a coarser one; may they be zero?
_LIGHT_OF_BINS = {"floor": True, "background": False}
# Where the bins are in what `compare` is given.
_BINS = -3


@reads(input=TRANSIENT, target=TRANSIENT)
def multiscale_loss(
    input: Transient,
    target: Transient,
    compare: PairLoss = squared_loss,
    *,
    scales: Sequence[int] | None = None,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Mean over `scales` of `compare` of two transients (..., C, T, Y, X) in bins that many times as wide.

    `compare`: a loss (input, target, mask=, reduction=) of this room that has a value for each bin, such as
    `root_loss` or `functools.partial(first_photon_nll, cycles=n)`. It is called with tensors (..., C, bins, places,
    1), its `dim` being set. A `floor` or a `background` that the partial holds is that of a bin of the record, a number
    or a tensor that broadcasts to it, and is added up as bins are. Coarse bins are sums; those at both ends of the
    record, which reach beyond it, hold what is there. A scale's value is the sum over its bins, averaged over the
    places where coarse bins may begin, over the number of bins of the record: per bin of the record, as at scale one.
    Squares of sums grow with the scale and let the coarse ones lead; likelihoods and roots of counts weigh all alike.

    `scales`: whole numbers; None: 1, 2, 4, ... as long as they are below T. Pulses are pulled from a distance of about
    the largest one. `dim`: where time is (`losses.layouts`). `mask` (..., C, T, Y, X): bins that do not count are empty
    in both, and take no cycles of detectors; a coarse bin counts if one of its own does. `reduction="none"`: without
    time, (..., C, Y, X). Time and memory are those of `compare` times the number of scales.

    Not supported: `compare` with options in bins or lengths (`dead_bins`, `bin_width_opl`, `axis`), of
    detectors that are armed again within a cycle, or as a module. Options of a `root` that it holds, such as a read
    noise, are the same at each scale. Raises ShapeError, UnitError, and what `compare`
    does.
    """
    where = "multiscale_loss"
    check_held(reduction, dim, where)
    steps = _check_scales(scales, where)
    known = _check_compare(compare, where)
    given = input
    input, target = check_pair(input, target, where)
    dim = bins_dim(input, shared_dim(compare, known, dim, input, where), where)
    mask = check_mask(mask, input, where)
    bins = input.shape[dim]
    if steps is None:
        steps = [2**k for k in range(max(1, math.ceil(math.log2(bins))))]
    pixels = None if mask is None else mask.any(dim)
    if not input.numel():
        return reduce((input + target).sum(dim), reduction, where, pixels)
    number = torch.full((), bins) if mask is None else mask.sum(dim).clamp_min(1)
    seen = input.new_ones((1, 1, bins, 1)) if mask is None else _flat(mask.to(input.dtype), dim)
    records = [_flat(counted(x, mask), dim) for x in (input, target)]
    windows = _Windows(records[0]), _Windows(records[1]), _Windows(seen)
    light = {name: _Windows(level) for name, level in _levels(compare, input, mask, seen, dim, where).items()}
    each: Callable[..., Tensor] = functools.partial(compare, dim=_BINS) if "dim" in known else compare  # type: ignore[call-arg]
    # each bin has the mean of the slopes of its coarse ones
    averaged = number.amin().to(input.device) * averaged_over(input.select(dim, 0), pixels, reduction)
    with in_the_name_of(given, averaged):
        values = [_at_scale(s, windows, light, input.select(dim, 0), each) for s in steps]
    mean = torch.stack(values).mean(0) / number.to(input)
    return reduce(mean, reduction, where, pixels)


class _Windows:
    """Sums of neighbouring bins of a record (batch, C, T, places), from windows of 1, 2, 4, ... that all scales share:
    no cancellation as of differences of running sums.
    """

    def __init__(self, record: Tensor) -> None:
        self._doubled = {1: record}

    def coarse(self, scale: int) -> Tensor:
        """(scale x batch, C, J, places, 1): sums of `scale` bins for each of the places where coarse bins begin.

        An item for each of them, so that losses that look at whole records see proper ones.
        """
        sums = self._sums(scale)
        batch, channels, length, places = sums.shape
        number = math.ceil(length / scale)
        sums = functional.pad(sums, (0, 0, 0, number * scale - length))
        each = sums.reshape(batch, channels, number, scale, places).movedim(3, 0)
        return each.reshape(scale * batch, channels, number, places, 1)

    def _sums(self, scale: int) -> Tensor:
        """Of every window that holds a bin of the record: T + scale - 1 of them."""
        total, width, size = None, 0, 1
        while True:
            window = self._doubled[size]
            if scale & size:
                total = window if total is None else _both(total, window, width)
                width += size
            if 2 * size > scale:
                return cast(Tensor, total)
            if 2 * size not in self._doubled:
                self._doubled[2 * size] = _both(window, window, size)
            size *= 2


def _both(first: Tensor, second: Tensor, later: int) -> Tensor:
    """A window and the one that ends `later` bins before it."""
    # padding rather than slices, whose backward fills a tensor of zeros for each
    length = max(first.shape[2], second.shape[2] + later)
    before = functional.pad(second, (0, 0, later, length - later - second.shape[2]))
    return functional.pad(first, (0, 0, 0, length - first.shape[2])) + before


def _flat(x: Tensor, dim: int) -> Tensor:
    """(batch, C, T, places) of a tensor with time as its dimension `dim`."""
    lead, bins, trail = x.shape[: dim + x.ndim], x.shape[dim], x.shape[dim + x.ndim + 1 :]
    batch, channels = (math.prod(lead[:-1]), lead[-1]) if lead else (1, 1)
    return x.reshape(batch, channels, bins, math.prod(trail))


def _held(compare: object) -> dict[str, object]:
    """The options of `_LIGHT_OF_BINS` that a partial holds."""
    held = compare.keywords if isinstance(compare, functools.partial) else {}
    return {name: held[name] for name in _LIGHT_OF_BINS if held.get(name) is not None}


def _levels(
    compare: object, input: Tensor, mask: Tensor | None, seen: Tensor, dim: int, where: str
) -> dict[str, Tensor]:
    """What `_held` has, as records (batch, C, T, places), or (1, 1, T, 1) where all are alike; 0 in bins that do not
    count.
    """
    records = {}
    for name, value in _held(compare).items():
        level = check_level(name, cast(Tensor, value), input, where, zero=_LIGHT_OF_BINS[name])
        records[name] = level * seen if level.ndim == 0 else _flat(counted(level.expand(input.shape), mask), dim)
    return records


def _at_scale(
    scale: int,
    windows: tuple[_Windows, _Windows, _Windows],
    light: dict[str, _Windows],
    like: Tensor,
    compare: Callable[..., Tensor],
) -> Tensor:
    """`compare` summed over coarse bins and averaged over the places where they begin: without time."""
    first, second, seen = (w.coarse(scale) for w in windows)

    def spread(x: Tensor) -> Tensor:
        """All pixels hold the same bins where nothing is masked."""
        return x.repeat_interleave(len(first) // len(x), 0).expand(first.shape)

    # those that hold no bin of the record do not count either
    kept = spread(seen > 0)
    levels = {name: torch.where(kept, spread(w.coarse(scale)), 1.0) for name, w in light.items()}
    value = compare(first, second, mask=kept, reduction="none", **levels)
    if not isinstance(value, Tensor) or value.shape != first.shape:
        got = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
        raise ArgumentError(
            f"multiscale_loss: expected compare to give a value for each bin, {tuple(first.shape)}, got {got}. Losses "
            "of whole records, such as wasserstein_loss, need no scales."
        )
    return value.sum(-3).reshape(scale, *like.shape).mean(0)


def _check_scales(scales: Sequence[int] | None, where: str) -> list[int] | None:
    if scales is None:
        return None
    if not hasattr(scales, "__len__") or isinstance(scales, str) or not len(scales):
        raise ShapeError(f"{where}: expected scales as one or more whole numbers, got {shown(scales)}.")
    return [check_whole("scales", s, where) for s in scales]


def _check_compare(compare: object, where: str) -> dict[str, inspect.Parameter]:
    """Its parameters. Raises ArgumentError for what is no loss of bins with what is in bins left out, UnitError for
    levels that are none.
    """
    if isinstance(compare, nn.Module):
        raise ArgumentError(f"{where}: expected compare to be a function, got the module {type(compare).__name__}.")
    known = check_compare(compare, where, "none")
    for name in _OF_BINS:
        if name in known and known[name].default not in (None, inspect.Parameter.empty):
            raise ArgumentError(
                f"{where}: expected compare without options in bins, got {name}={known[name].default}: bins are others "
                "at each scale."
            )
    for name, value in _held(compare).items():
        check_option(name, cast(Tensor, value), where, zero=_LIGHT_OF_BINS[name])
    return known


class MultiscaleLoss(nn.Module):
    """`multiscale_loss(input, target)` with its options held."""

    def __init__(
        self,
        compare: PairLoss = squared_loss,
        scales: Sequence[int] | None = None,
        *,
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
