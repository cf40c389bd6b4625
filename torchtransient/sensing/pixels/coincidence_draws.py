"""Coincidences drawn event by event: every SPAD of a pixel through every cycle, and the lines that are up.

A train is one SPAD through one block of periods: a cycle in step with the laser, or several periods of a detector that
runs free, which begin a few periods before they count. The next detection of an armed detector comes when the flux
since then has reached a number drawn from the exponential distribution.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

_AT_ONCE = 1 << 19  # trains, so that memory is bounded
_PERIODS = 16  # of a free-running detector in a block, and at least half of them before it counts
_DEAD_TIMES = 4  # before a block counts
_NO_LIGHT = torch.finfo(torch.float64).tiny


@dataclass(frozen=True)
class Trains:
    """`number` SPADs alike in each of P pixels: `rate` (P, T) float64 of one of them per period and bin.

    `dead_bins`: infinite for one detection per cycle.
    """

    rate: Tensor
    dead_bins: float
    number: int


@dataclass(frozen=True)
class Seen:
    """Detections of trains, and time in bins that they were armed, (P, T) each: what their score is made of."""

    detected: Tensor
    armed: Tensor


def draw_coincidences(
    groups: Sequence[Trains],
    cycles: int,
    coincidence: int,
    window: float,
    *,
    free: bool,
    generator: torch.Generator | None,
    seen: Sequence[Seen] | None = None,
    weights: Tensor | None = None,
) -> Tensor:
    """Coincidences (P, T) of `cycles` periods; `window` in bins, `seen` of each group is added to where it is given.

    A coincidence is a detection that brings the number of those within `window` up to `coincidence`. `free`: trains go
    on over periods, and lines stay up from one to the next. `weights` (P, M): what a coincidence of the periods
    m, m + M, ... counts instead of one.
    """
    pixels, bins = groups[0].rate.shape
    lead = max(_PERIODS // 2, math.ceil(_DEAD_TIMES * groups[0].dead_bins / bins)) if free else 0
    length = min(max(_PERIODS, 2 * lead), cycles) if free else 1
    counts = torch.zeros_like(groups[0].rate)
    blocks, spads = -(-cycles // length), sum(group.number for group in groups)
    step = min(blocks, max(1, _AT_ONCE // spads))
    rows = max(1, _AT_ONCE // (spads * step))
    for first in range(0, pixels, rows):
        at = slice(first, min(first + rows, pixels))
        for begin in range(0, blocks, step):
            some = min(step, blocks - begin)
            parts = []
            for i, group in enumerate(groups):
                part = Trains(group.rate[at], group.dead_bins, group.number)
                known = None if seen is None else Seen(seen[i].detected[at], seen[i].armed[at])
                parts.append(_detections(part, some, lead, length, generator, known))
            owner, time = (torch.cat(columns) for columns in zip(*parts, strict=True))
            row, period, place = _coincidences(owner, time, some, bins, length, coincidence, window)
            period += begin * length
            counted = period < cycles  # the last block is cut off
            row, period, place = row[counted], period[counted], place[counted]
            each = None if weights is None else weights[at][row, period % weights.shape[1]]
            counts[at] += torch.bincount(row * bins + place, each, counts[at].numel()).view_as(counts[at])
    return counts


def _coincidences(
    owner: Tensor, time: Tensor, blocks: int, bins: int, length: int, coincidence: int, window: float
) -> tuple[Tensor, Tensor, Tensor]:
    """(pixel, period, bin) of coincidences among detections, those that count; `owner`: pixel times blocks plus block.

    Periods count from that of the first block on.
    """
    # owners know nothing of one another: farther apart than a window, and than what happens before a block counts
    first, last = time.aminmax() if len(time) else (time.new_zeros(()), time.new_zeros(()))
    clock, order = (owner * (float(last - first) + window + 1) + time).sort()
    up = torch.arange(len(clock), device=clock.device) - torch.searchsorted(clock, clock - window, right=True)
    chosen = order[(up == coincidence - 1) & (time[order] >= 0)]
    owner, time = owner[chosen], time[chosen]
    period = (time / bins).floor()
    place = (time - period * bins).long().clamp_max(bins - 1)
    pixel = owner.div(blocks, rounding_mode="floor")
    return pixel, (owner - pixel * blocks) * length + period.long(), place


def _detections(
    trains: Trains, blocks: int, lead: int, length: int, generator: torch.Generator | None, seen: Seen | None
) -> tuple[Tensor, Tensor]:
    """(owner, time) of all detections, in bins from the start of a block on; adds to what was `seen`."""
    rate, dead = trains.rate, trains.dead_bins
    pixels, bins = rate.shape
    flux = _Flux(rate)
    end = float(length * bins)
    owner = torch.arange(pixels * blocks * trains.number, device=rate.device).div(
        trains.number, rounding_mode="floor"
    )
    armed = torch.zeros(owner.shape, dtype=torch.float64, device=rate.device)
    if lead:
        # A bright pulse keeps a detector of long dead time in step with every n-th period: all n have to be drawn.
        turns = max(1, math.ceil(dead / bins))
        armed += _uniform(armed, generator) * (turns * bins) - lead * bins
    owners, times = [], []
    while len(owner):
        pixel = owner.div(blocks, rounding_mode="floor")
        fired = flux.time(pixel, flux.before(pixel, armed) - torch.log1p(-_uniform(armed, generator))).maximum(armed)
        if seen is not None:
            _look(seen, pixel, armed, fired, end)
        hit = fired < end
        owner, fired = owner[hit], fired[hit]
        owners.append(owner)
        times.append(fired)
        armed = fired + dead
        owner, armed = owner[armed < end], armed[armed < end]
    return torch.cat(owners), torch.cat(times)


def _uniform(like: Tensor, generator: torch.Generator | None) -> Tensor:
    return torch.rand(like.shape, dtype=like.dtype, device=like.device, generator=generator)


class _Flux:
    """Photons of pixels over time, in bins from the start of a period on, with periods that repeat; rows (P, T)."""

    def __init__(self, rate: Tensor) -> None:
        self.bins = rate.shape[1]
        self.edges = torch.nn.functional.pad(rate.cumsum(1), (1, 0))
        self.total = self.edges[:, -1]
        # all pixels in one increasing list, each from its number to the next
        number = torch.arange(len(rate), dtype=torch.float64, device=rate.device).unsqueeze(1)
        self.line = (number + self.edges / self.edges[:, -1:].clamp_min(_NO_LIGHT)).flatten()
        self.edges = self.edges.flatten()

    def before(self, pixel: Tensor, time: Tensor) -> Tensor:
        """Photons before a time, counted from time 0 on."""
        period, whole, part = _parts(time, self.bins)
        place = pixel * (self.bins + 1) + whole
        low = self.edges[place]
        return period * self.total[pixel] + low + (self.edges[place + 1] - low) * part

    def time(self, pixel: Tensor, photons: Tensor) -> Tensor:
        """The time before which so many photons come, counted from time 0 on; infinite without light."""
        periods = photons / self.total[pixel]
        whole = periods.floor()
        first = pixel * (self.bins + 1)
        upper = torch.searchsorted(self.line, pixel + (periods - whole)).maximum(first + 1).minimum(first + self.bins)
        low = self.edges[upper - 1]
        width = self.edges[upper] - low
        left = photons - whole * self.total[pixel] - low
        part = (left / torch.where(width > 0, width, torch.ones_like(width))).clamp(0, 1)
        found = whole * self.bins + (upper - 1 - first) + part
        return torch.where(torch.isfinite(periods), found, math.inf)


def _parts(time: Tensor, bins: int) -> tuple[Tensor, Tensor, Tensor]:
    """Whole periods before a time, whole bins after these, and the part of a bin that is left."""
    period = (time / bins).floor()
    phase = (time - period * bins).clamp(0, bins)
    whole = phase.long().clamp_max(bins - 1)
    return period, whole, phase - whole


def _look(seen: Seen, pixel: Tensor, begin: Tensor, fired: Tensor, end: float) -> None:
    """Add detections, and the time from `begin` until then in which detectors were armed, bin by bin."""
    bins, size = seen.armed.shape[1], seen.armed.numel()
    hit = fired < end
    place = pixel[hit] * bins + _parts(fired[hit], bins)[1]
    seen.detected.add_(torch.bincount(place, minlength=size).view_as(seen.detected))
    for time, sign in ((fired.clamp_max(end), 1.0), (begin, -1.0)):
        period, whole, part = _parts(time, bins)
        place = pixel * bins + whole
        # the part of its own bin, and all of those before that
        own, reached = (torch.bincount(place, w, size).view_as(seen.armed) for w in (part, torch.ones_like(part)))
        periods = torch.bincount(pixel, period, len(seen.armed)).unsqueeze(1)
        seen.armed.add_(sign * (own + reached.flip(1).cumsum(1).flip(1) - reached + periods))
