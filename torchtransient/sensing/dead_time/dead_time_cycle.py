"""Several detections in one laser cycle: a detector that is armed at the start and dead for a while after each.

Detections inside a bin follow a straight line (two coefficients, as in `renewal_chain`), and so do those that the dead
time hands on, by fractions of a bin too. Where a bin holds many photons it is cut into pieces of at most a quarter of
one, so that any number of detections, dead times and waits fit into a bin. Nothing that comes back within one dead time
depends on what happens in it: a stretch of that length is one step.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchtransient.errors import TorchTransientError, UnitError
from torchtransient.sensing.base.layout import one_number
from torchtransient.sensing.dead_time.renewal_chain import BinResponse, bin_response

PHOTONS = 0.25  # of the brightest piece, at most: the total variation of means is then below 1e-5
MOST_PIECES = 1 << 14
_AT_ONCE = 1 << 15  # pieces
_STRETCH = 1000  # pieces, over which exp(flux) stays inside float64
_ROOT = math.sqrt(3.0)


@dataclass(frozen=True)
class Cycle:
    """Rows (P, N) of pieces of bins, per cycle, float64, differentiable."""

    armed: Tensor  # probability at the start of the piece
    count: Tensor  # detections in it
    slope: Tensor  # of their density, coefficient of sqrt(3) (2 y - 1)
    whole: int  # pieces of the dead time,
    part: Tensor  # and the rest of it, of a piece
    pieces: int  # of a bin

    @property
    def late(self) -> Tensor:
        """Of the detections: those that are armed again `whole` + 1 pieces later; the others after `whole`."""
        first = 1 - self.part
        soon = first * self.count - _ROOT * first * self.part * self.slope
        return torch.minimum((self.count - soon).clamp_min(0), self.count)


def check_dead_bins(dead_bins: Tensor | float, where: str = "dead time") -> float:
    """A dead time in bins as a number. Raises UnitError below half a bin, or where it is not finite."""
    given = one_number(dead_bins, "dead_bins", where)
    value = float(given.detach()) if isinstance(given, Tensor) else given
    if not 0.5 - 1e-9 <= value < 1e9:
        raise UnitError(
            f"dead time: expected at least half a bin, got {value:g} bins. Use narrower bins, or no dead time "
            "(ShotNoise) where it does not matter."
        )
    return value


def whole_and_part(dead: Tensor) -> tuple[int, Tensor]:
    """Whole pieces of a dead time and the rest of it, differentiable."""
    # a whole number that rounding has put just below itself is still that number
    whole = math.floor(float(dead.detach()) + 1e-9)
    part = dead - whole
    return whole, part - part.detach().clamp_max(0)


class _Levels(torch.autograd.Function):
    """How many rows are to be cut in 1, 2, 4, ... pieces, and whether torch.func.vmap hides which they are."""

    @staticmethod
    def forward(level: Tensor, mapped: bool) -> Tensor:
        number = torch.bincount(level.reshape(-1), minlength=1)
        return torch.cat([number.new_full((1,), int(mapped)), number])

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.mark_non_differentiable(output)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[None, None]:
        return None, None

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], level: Tensor, mapped: bool) -> tuple[Tensor, None]:
        # of all that is mapped over: a number that can be looked at
        return _Levels.apply(level, True), None  # type: ignore[no-untyped-call]


def _numbers_of_levels(level: Tensor) -> list[int]:
    """`_Levels`, straight away where nothing is mapped over: calls of autograd take as long as small images."""
    if torch._C._functorch.is_functorch_wrapped_tensor(level):
        # One by one: torch 2.6 makes no list inside of torch.func.
        hidden: Tensor = _Levels.apply(level, False)  # type: ignore[no-untyped-call]
        return [int(number) for number in hidden.unbind()]
    return _Levels.forward(level, False).tolist()


def row_levels(rate: Tensor, least: int, photons: float = PHOTONS) -> tuple[Tensor, list[int], bool]:
    """(level of each row (P,), levels that there are, whether they are hidden): rows are cut in `least` 2^level."""
    peak = torch.nan_to_num(rate.detach().amax(-1), nan=0.0) / (photons * least)
    level = torch.ceil(torch.log2(peak.clamp(1, 2.0**40)) - 1e-9).long()
    found = _numbers_of_levels(level)
    present = [k for k, number in enumerate(found[1:]) if number]
    if present and (least << present[-1]) > MOST_PIECES:
        raise TorchTransientError(
            f"detections_with_dead_time: expected at most {photons * MOST_PIECES:g} photons in a bin, got "
            f"{float(peak.amax()) * photons * least:g}. Use narrower bins, or less light."
        )
    return level, present, bool(found[0])


def highest_level(level: Tensor) -> int:
    """The largest of whole numbers >= 0, of all that is mapped over inside of torch.func.vmap; 0 of none."""
    return len(_numbers_of_levels(level)) - 2


def rows_by_level(rate: Tensor, dead: float, photons: float = PHOTONS) -> Iterator[tuple[Tensor | None, int]]:
    """(indices of rows, None for all; pieces of their bins) of every level that there is."""
    least = 1 if dead >= 1 - 1e-9 else 2
    level, present, _ = row_levels(rate, least, photons)
    for k in present:
        yield (None if len(present) == 1 else (level == k).nonzero().squeeze(-1)), least << k


class BlockWalk:
    """Stretches of one dead time each: what comes back in one, out of the lines of the two before it."""

    def __init__(self, bins: int, whole: int, pieces: int) -> None:
        self.pieces, self.whole, self.size = pieces, whole, bins * pieces
        self._before: tuple[Tensor, Tensor] | None = None
        self._last: tuple[Tensor, Tensor] | None = None

    def stretches(self) -> Iterator[tuple[int, int]]:
        for begin in range(0, self.size, self.whole):
            yield begin, min(begin + self.whole, self.size)

    def taken(self, value: Tensor, begin: int, end: int) -> Tensor:
        """Columns of pieces out of values of bins."""
        if self.pieces == 1:
            return value[..., begin:end]
        index = torch.arange(begin, end, device=value.device).div(self.pieces, rounding_mode="floor")
        return value.index_select(-1, index)

    def inflow(self, length: int) -> Tensor | None:
        """(P, 4, length), or None before the first dead time is over."""
        if self._before is None:
            return None
        young = torch.stack(self._before, 1)
        last = torch.zeros_like(young[..., :1]) if self._last is None else torch.stack(self._last, 1)
        old = torch.cat([last, young[..., :-1]], -1)
        return torch.cat([young, old], 1)[..., :length]

    def keep(self, count: Tensor, slope: Tensor) -> None:
        if self._before is not None:
            self._last = (self._before[0][..., -1:], self._before[1][..., -1:])
        self._before = (count, slope)


def armed_of_pieces(
    start: Tensor, rate: Tensor, joined: Tensor | None, stretch: int = _STRETCH
) -> tuple[Tensor, Tensor]:
    """Armed at the start of every piece of a stretch, and at its end: A[k + 1] = A[k] exp(-rate[k]) + joined[k]."""
    found = []
    for begin in range(0, rate.shape[-1], stretch):
        flux = rate[..., begin : begin + stretch].cumsum(-1)
        ends = start
        if joined is not None:
            ends = start + (joined[..., begin : begin + stretch] * torch.exp(flux)).cumsum(-1)
        ends = torch.exp(-flux) * ends
        found.append(torch.cat([start, ends[..., :-1]], -1))
        start = ends[..., -1:]
    return torch.cat(found, -1), start


def cycle_of_rows(rate: Tensor, dead_bins: Tensor, pieces: int, largest: float | None = PHOTONS) -> Cycle:
    """For rates (P, T) per cycle and bin, at least 0, and a scalar dead time in bins, float64, bins cut in `pieces`.

    `largest`: a bound of the photons in a piece, None where it is not known.
    """
    whole, part = whole_and_part(dead_bins.to(rate.device, torch.float64) * pieces)
    walk = BlockWalk(rate.shape[-1], whole, pieces)
    response = bin_response(rate / pieces, part, largest)
    start = torch.ones_like(rate[:, :1])
    columns: list[tuple[Tensor, Tensor, Tensor]] = []
    for begin, end in walk.stretches():
        bins = BinResponse(**{name: walk.taken(value, begin, end) for name, value in vars(response).items()})
        back = walk.inflow(end - begin)
        flux = walk.taken(rate, begin, end) / pieces
        armed, start = armed_of_pieces(start, flux, None if back is None else (bins.kept * back).sum(1))
        count, slope = armed * bins.fire, armed * bins.slope
        if back is not None:
            count, slope = count + (bins.hit * back).sum(1), slope + (bins.hit_slope * back).sum(1)
        walk.keep(count, slope)
        columns.append((armed, count, slope))
    armed, count, slope = (torch.cat(c, -1) for c in zip(*columns, strict=True))
    return Cycle(armed, count, slope, whole, part, pieces)


def detected_rows(rate: Tensor, dead_bins: Tensor) -> Tensor:
    """Detections per cycle and bin, rows (P, T)."""
    dead, bins = check_dead_bins(dead_bins), rate.shape[-1]
    least = 1 if dead >= 1 - 1e-9 else 2
    level, present, hidden = row_levels(rate, least)

    def solved(rows: Tensor, k: int) -> Tensor:
        # as many rows at a time as stay in the cache
        found = []
        for few in torch.split(rows, max(1, _AT_ONCE // (bins << k))):
            found.append(cycle_of_rows(few, dead_bins, least << k).count.view(*few.shape, least << k).sum(-1))
        return torch.cat(found) if len(found) > 1 else found[0]

    if len(present) == 1:
        return solved(rate, present[0])
    detected = torch.zeros_like(rate)
    for k in present:
        if hidden:
            here = (level == k).unsqueeze(-1)
            # rows of other levels are dark here, and add nothing: no number of theirs can spoil a gradient
            detected = detected + solved(torch.where(here, rate, 0.0), k)
        else:
            rows = (level == k).nonzero().squeeze(-1)
            detected = detected.index_copy(0, rows, solved(rate[rows], k))
    return detected


def double_detections(rate: Tensor, dead_bins: Tensor) -> Tensor:
    """Chance that a cycle fires twice in a bin, (P, T), for a dead time of half a bin to one bin; thrice it cannot."""
    twice = torch.zeros_like(rate)
    for rows, pieces in rows_by_level(rate, check_dead_bins(dead_bins)):
        own = rate if rows is None else rate[rows]
        cycle = cycle_of_rows(own, dead_bins, pieces)
        lines = torch.stack([cycle.count, cycle.slope], 1).view(own.shape[0], 2, -1, pieces)
        young, old = (torch.nn.functional.pad(lines, (by, 0))[..., :pieces] for by in (cycle.whole, cycle.whole + 1))
        back = torch.cat([young, old], 1)  # of detections in the same bin
        bins = bin_response(own / pieces, cycle.part)
        kept = (bins.kept.unsqueeze(-1) * back).sum(1)
        rest = own.unsqueeze(-1) * torch.linspace(1 - 1 / pieces, 0, pieces, dtype=own.dtype, device=own.device)
        found = ((bins.hit.unsqueeze(-1) * back).sum(1) - kept * torch.expm1(-rest)).sum(-1)
        twice = found if rows is None else twice.index_copy(0, rows, found)
    return twice
