"""Mean detections of a clocked detector, which is armed at the start of every laser cycle and dead after detections.

Detections inside a bin follow a straight line, as in `renewal`, and so do those that the dead time hands on. Bins with
many photons are cut in pieces of at most a quarter of one, so that any number of detections and dead times fits into a
bin. Nothing that is rearmed within one dead time depends on what happens in it: a stretch of that length is one step.

Two forms of one recursion: `cycle_means`, differentiable in all its steps (in the dead time, in forward mode, to any
order), and `DetectionScan`, in place and with an adjoint of its own, which `mean_detections` takes for values and first
derivatives in the light. Source: Isbaner et al., Dead-time correction of fluorescence lifetime measurements, Optics
Express 24 (2016), for the model.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchtransient.errors import TorchTransientError
from torchtransient.sensing.checks import is_dual
from torchtransient.sensing.dead_time.renewal import ROOT3, BinResponse, bin_response, split_dead_time

PHOTONS = 0.25  # of the brightest piece, at most: the total variation of means is then below 1e-5
MOST_PIECES = 1 << 14
_PIECES_AT_ONCE = 1 << 15  # as many as stay in the cache
_STRETCH = 1000  # pieces, over which exp(flux) stays inside float64
_SMALLEST_TERM = 1e-15  # of the power series, relative
_SHORT = 4  # pieces: shorter dead times are walked piece by piece
_STATES = 1 << 24  # numbers that are held at a time while bins are cut


# --------------------------------------------------------------------------------------------------- bins cut in pieces


def _level_counts(level: Tensor) -> tuple[list[int], bool]:
    """Numbers of rows of levels 0, 1, 2, ..., of all that torch.func.vmap maps over; True inside of it."""
    mapped = False
    while torch._C._functorch.is_functorch_wrapped_tensor(level):
        mapped = mapped or torch._C._functorch.is_batchedtensor(level)
        level = torch._C._functorch.get_unwrapped(level)
    # One by one: torch 2.6 makes no list inside of torch.func.
    return [int(number) for number in torch.bincount(level.reshape(-1), minlength=1).unbind()], mapped


def subdivision_levels(rate: Tensor, least: int, photons: float = PHOTONS) -> tuple[Tensor, list[int], bool]:
    """Find the levels of rows, whose bins are cut in `least` 2^level pieces of at most `photons` photons.

    Args:
        rate: (P, T), per cycle and bin.
        least: pieces of a bin at level 0.
        photons: largest number in a piece.

    Returns:
        Level of each row (P,); levels that occur; True if torch.func.vmap hides which rows they belong to.

    Raises:
        TorchTransientError: if a bin would need more than `MOST_PIECES`.
    """
    peak = torch.nan_to_num(rate.detach().amax(-1), nan=0.0) / (photons * least)
    level = torch.ceil(torch.log2(peak.clamp(1, 2.0**40)) - 1e-9).long()
    found, hidden = _level_counts(level)
    present = [k for k, number in enumerate(found) if number]
    if present and (least << present[-1]) > MOST_PIECES:
        raise TorchTransientError(
            f"detections_with_dead_time: expected at most {photons * MOST_PIECES:g} photons in a bin, got "
            f"{float(peak.amax()) * photons * least:g}. Use narrower bins, or less light."
        )
    return level, present, hidden


def highest_level(level: Tensor) -> int:
    """Largest of integers >= 0 (0 of none), of all rows that are mapped over inside of torch.func.vmap.

    Args:
        level: integers.
    """
    return len(_level_counts(level)[0]) - 1


def rows_by_subdivision(rate: Tensor, dead: float, photons: float = PHOTONS) -> Iterator[tuple[Tensor | None, int]]:
    """Yield the rows of every level of subdivision that occurs.

    Args:
        rate: (P, T), per cycle and bin.
        dead: dead time in bins.
        photons: largest number in a piece.

    Yields:
        Indices of rows, None for all, and pieces of their bins.
    """
    least = 1 if dead >= 1 - 1e-9 else 2
    level, present, _ = subdivision_levels(rate, least, photons)
    for k in present:
        yield (None if len(present) == 1 else (level == k).nonzero().squeeze(-1)), least << k


def solve_by_level(
    rate: Tensor,
    levels: tuple[Tensor, list[int], bool],
    least: int,
    solve: Callable[[Tensor, Tensor, int], Tensor],
) -> Tensor:
    """Solve rows with their bins cut in pieces, as many rows at a time as stay in the cache.

    Args:
        rate: (P, T), per cycle and bin.
        levels: levels of the rows, from `subdivision_levels`.
        least: pieces of a bin at level 0.
        solve: function of rates (K, T), indices (K,) of their rows, and pieces of a bin.

    Returns:
        Results of the rows, (P, N).
    """
    level, present, hidden = levels
    every = torch.arange(rate.shape[0], device=rate.device)

    def solved(rows: Tensor, at: Tensor, pieces: int) -> Tensor:
        few = max(1, _PIECES_AT_ONCE // (rate.shape[-1] * pieces))
        parts = [solve(r, i, pieces) for r, i in zip(torch.split(rows, few), torch.split(at, few), strict=True)]
        return torch.cat(parts) if len(parts) > 1 else parts[0]

    if len(present) == 1:
        return solved(rate, every, least << present[0])
    found: Tensor | None = None
    for k in present:
        if hidden:
            here = (level == k).unsqueeze(-1)
            # rows of other levels are dark here, and add nothing: no number of theirs can spoil a gradient
            own = torch.where(here, solved(torch.where(here, rate, 0.0), every, least << k), 0.0)
            found = own if found is None else found + own
        else:
            rows = (level == k).nonzero().squeeze(-1)
            own = solved(rate[rows], rows, least << k)
            found = rate.new_zeros(rate.shape[0], own.shape[-1]) if found is None else found
            found = found.index_copy(0, rows, own)
    return torch.zeros_like(rate) if found is None else found


# -------------------------------------------------------------------------------- the recursion in differentiable steps


@dataclass(frozen=True)
class CycleMeans:
    """Rows (P, N) of pieces of bins, per cycle, float64, differentiable."""

    armed: Tensor  # probability at the start of the piece
    count: Tensor  # detections in it
    slope: Tensor  # of their density, coefficient of sqrt(3) (2 y - 1)
    whole: int  # pieces of the dead time,
    part: Tensor  # and the rest of it, of a piece
    pieces: int  # of a bin

    @property
    def late(self) -> Tensor:
        """Detections (P, N) that are rearmed `whole` + 1 pieces later; the others after `whole`."""
        first = 1 - self.part
        soon = first * self.count - ROOT3 * first * self.part * self.slope
        return torch.minimum((self.count - soon).clamp_min(0), self.count)


class DeadTimeBlocks:
    """Stretches of one dead time each; the inflow of one comes from the lines of the two before it."""

    def __init__(self, bins: int, whole: int, pieces: int) -> None:
        self.pieces, self.whole, self.size = pieces, whole, bins * pieces
        self._before: tuple[Tensor, Tensor] | None = None
        self._last: tuple[Tensor, Tensor] | None = None

    def stretches(self) -> Iterator[tuple[int, int]]:
        for begin in range(0, self.size, self.whole):
            yield begin, min(begin + self.whole, self.size)

    def of_pieces(self, value: Tensor, begin: int, end: int) -> Tensor:
        """Columns of pieces out of values of bins."""
        if self.pieces == 1:
            return value[..., begin:end]
        index = torch.arange(begin, end, device=value.device).div(self.pieces, rounding_mode="floor")
        return value.index_select(-1, index)

    def inflow(self, length: int) -> Tensor | None:
        """Inflow (P, 4, length), None within the first dead time."""
        if self._before is None:
            return None
        young = torch.stack(self._before, 1)
        last = torch.zeros_like(young[..., :1]) if self._last is None else torch.stack(self._last, 1)
        old = torch.cat([last, young[..., :-1]], -1)
        return torch.cat([young, old], 1)[..., :length]

    def append(self, count: Tensor, slope: Tensor) -> None:
        """Append the lines of a stretch."""
        if self._before is not None:
            self._last = (self._before[0][..., -1:], self._before[1][..., -1:])
        self._before = (count, slope)


def armed_probabilities(
    start: Tensor, rate: Tensor, joined: Tensor | None, stretch: int = _STRETCH
) -> tuple[Tensor, Tensor]:
    """Armed at the start of pieces, and at the end of the last: A[k + 1] = A[k] exp(-rate[k]) + joined[k].

    Args:
        start: probability of being armed at the start, (P, 1).
        rate: rate per piece, (P, N).
        joined: probability of being rearmed in each piece, (P, N), or None.
        stretch: number of pieces summed at a time.

    Returns:
        (P, N) and (P, 1).
    """
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


def cycle_means(rate: Tensor, dead_bins: Tensor, pieces: int, largest: float | None = PHOTONS) -> CycleMeans:
    """Means of one cycle, piece by piece, differentiable in rate and dead time.

    Args:
        rate: (P, T) per cycle and bin, float64, >= 0.
        dead_bins: dead time in bins, scalar float64.
        pieces: number of pieces of a bin.
        largest: known bound of the photons in a piece, or None.
    """
    whole, part = split_dead_time(dead_bins.to(rate.device, torch.float64) * pieces)
    blocks = DeadTimeBlocks(rate.shape[-1], whole, pieces)
    response = bin_response(rate / pieces, part, largest)
    start = torch.ones_like(rate[:, :1])
    columns: list[tuple[Tensor, Tensor, Tensor]] = []
    for begin, end in blocks.stretches():
        bins = BinResponse(**{name: blocks.of_pieces(value, begin, end) for name, value in vars(response).items()})
        back = blocks.inflow(end - begin)
        flux = blocks.of_pieces(rate, begin, end) / pieces
        armed, start = armed_probabilities(start, flux, None if back is None else (bins.kept * back).sum(1))
        count, slope = armed * bins.fire, armed * bins.slope
        if back is not None:
            count, slope = count + (bins.hit * back).sum(1), slope + (bins.hit_slope * back).sum(1)
        blocks.append(count, slope)
        columns.append((armed, count, slope))
    armed, count, slope = (torch.cat(c, -1) for c in zip(*columns, strict=True))
    return CycleMeans(armed, count, slope, whole, part, pieces)


def mean_detections_in_steps(rate: Tensor, dead_bins: Tensor) -> Tensor:
    """Detections per cycle and bin by `cycle_means`.

    Args:
        rate: (P, T), per cycle and bin.
        dead_bins: dead time in bins.

    Returns:
        (P, T).
    """
    least = 1 if float(dead_bins.detach()) >= 1 - 1e-9 else 2

    def solve(rows: Tensor, _: Tensor, pieces: int) -> Tensor:
        return cycle_means(rows, dead_bins, pieces).count.view(*rows.shape, pieces).sum(-1)

    return solve_by_level(rate, subdivision_levels(rate, least), least, solve)


def second_detections(rate: Tensor, dead_bins: Tensor) -> Tensor:
    """Probability of two detections in a bin, for dead times of half a bin to one bin (never three).

    Args:
        rate: (P, T), per cycle and bin.
        dead_bins: dead time in bins.

    Returns:
        (P, T).
    """
    twice = torch.zeros_like(rate)
    for rows, pieces in rows_by_subdivision(rate, float(dead_bins)):
        own = rate if rows is None else rate[rows]
        cycle = cycle_means(own, dead_bins, pieces)
        lines = torch.stack([cycle.count, cycle.slope], 1).view(own.shape[0], 2, -1, pieces)
        young, old = (torch.nn.functional.pad(lines, (by, 0))[..., :pieces] for by in (cycle.whole, cycle.whole + 1))
        back = torch.cat([young, old], 1)  # of detections in the same bin
        bins = bin_response(own / pieces, cycle.part)
        kept = (bins.kept.unsqueeze(-1) * back).sum(1)
        rest = own.unsqueeze(-1) * torch.linspace(1 - 1 / pieces, 0, pieces, dtype=own.dtype, device=own.device)
        found = ((bins.hit.unsqueeze(-1) * back).sum(1) - kept * torch.expm1(-rest)).sum(-1)
        twice = found if rows is None else twice.index_copy(0, rows, found)
    return twice


# ------------------------------------------------------------------------------ the recursion in place, and its adjoint


def series_degree(largest: float) -> int:
    """Degree at which terms of exp(largest) fall below rounding.

    Args:
        largest: exponent.
    """
    degree = 3
    while largest**degree / math.factorial(degree) > _SMALLEST_TERM:
        degree += 1
    return degree


@functools.lru_cache(maxsize=64)
@torch.inference_mode(False)
def response_series(part: float, degree: int) -> tuple[Tensor, Tensor]:
    """Power series in the rate of `renewal.bin_response`, cached: do not change in place.

    Args:
        part: fraction of a piece in the dead time.
        degree: highest power D.

    Returns:
        (3, 5, D + 1) for (armed at the end, detections, slope) and (2, 5, D + 1), derivatives of the last two, of the
        inflow (older line's constant and slope, younger line's constant and slope) and of the detectors armed at the
        start.
    """
    first = 1 - part
    waited = torch.zeros(5, degree + 1, dtype=torch.float64)
    for i in range(degree + 1):
        sign = (-1) ** i / math.factorial(i + 1)
        near = sign * first ** (i + 2) / (i + 2), sign * first ** (i + 3) / (i + 3)
        rest = sign / (i + 2) - near[0], sign / (i + 3) - near[1]
        waited[0, i] = rest[0]
        waited[1, i] = ROOT3 * ((2 * first + 1) * rest[0] - 2 * rest[1])
        waited[2, i] = near[0]
        waited[3, i] = ROOT3 * ((2 * first - 1) * near[0] - 2 * near[1])
        waited[4, i] = sign
    hit, slope = torch.zeros_like(waited), torch.zeros_like(waited)
    hit[:, 1:] = waited[:, :-1]
    slope[:, 1:] = ROOT3 * (2 * waited[:, 1:] + waited[:, :-1])
    slope[4, 1] = 0  # and not what rounding leaves of -1 + 1
    kept = -hit
    turn = ROOT3 * first * part
    kept[:, 0] = torch.tensor([part, turn, first, -turn, 1.0], dtype=torch.float64)
    order = torch.arange(1, degree + 1, dtype=torch.float64)
    derivative = torch.zeros(2, 5, degree + 1, dtype=torch.float64)
    derivative[..., :-1] = torch.stack([hit, slope])[..., 1:] * order
    return torch.stack([kept, hit, slope]), derivative


class DetectionScan:
    """Recursion over columns (T, P) of photons per bin, in place and without a graph, and its adjoint.

    Per piece (armed at its end, detections, their slope) are linear in (four parts of the inflow, armed at its start).
    The 3 x 5 coefficients are power series of the photons in a piece: one matrix times their powers. States are (N + 1,
    3, P) for N pieces, those of piece k in place k + 1; place 0 is the start of the cycle.

    Args:
        rate: (T, P) float64.
        whole, part: dead time in pieces, split.
        pieces: number of pieces of a bin.
        largest: photons of a piece, at most.
    """

    def __init__(self, rate: Tensor, whole: int, part: float, pieces: int, largest: float) -> None:
        series, derivative = response_series(part, series_degree(largest))
        self.rate, self.whole, self.part, self.pieces = rate, whole, part, pieces
        self.bins, self.columns = rate.shape
        self.size = self.bins * pieces
        self._series = series.to(rate.device).view(15, -1)
        self._derivative = derivative.to(rate.device).view(10, -1)

    def blocks(self, wider: int = 1) -> list[tuple[int, int]]:
        """(begin, end) of pieces, or of those `wider` times as wide, in whole bins that fit into the cache."""
        bins, pieces = max(1, _PIECES_AT_ONCE // (self.pieces * max(1, self.columns))), self.pieces // wider
        return [(k * pieces, min(k + bins, self.bins) * pieces) for k in range(0, self.bins, bins)]

    def responses(self, begin: int, end: int, derivative: bool = False) -> tuple[Tensor, Tensor]:
        """Coefficients (3, 5, L, P) of L pieces, and their derivatives (2, 5, L, P) if asked for."""
        rate = self.rate[begin // self.pieces : end // self.pieces]
        if self.pieces > 1:
            rate = rate / self.pieces
        powers = rate.new_empty(self._series.shape[1], *rate.shape)
        powers[0] = 1
        powers[1] = rate
        for i in range(2, powers.shape[0]):
            torch.mul(powers[i - 1], rate, out=powers[i])
        flat = powers.view(powers.shape[0], -1)

        def cut(series: Tensor, rows: int) -> Tensor:
            found = torch.mm(series, flat).view(rows, 5, *rate.shape)
            return found.repeat_interleave(self.pieces, 2) if self.pieces > 1 else found

        return cut(self._series, 3), cut(self._derivative, 2) if derivative else flat[:0]

    def stretches(self, begin: int, end: int) -> Iterator[tuple[int, int]]:
        """Yield stretches of at most one dead time, cut at the end of the first one."""
        while begin < end:
            to = min(end, begin + self.whole)
            if begin < self.whole < to:
                to = self.whole
            yield begin, to
            begin = to

    def inflow(self, states: Tensor, begin: int, end: int) -> list[Tensor]:
        """Views of the four parts (L, P)."""
        at = begin + 1 - self.whole
        old, young = states[at - 1 : at - 1 + end - begin], states[at : at + end - begin]
        return [old[:, 1], old[:, 2], young[:, 1], young[:, 2]]

    def forward(self) -> Tensor:
        """States (N + 1, 3, P)."""
        states = self.rate.new_empty(self.size + 1, 3, self.columns)
        states[0] = 0
        states[0, 0] = 1
        for begin, end in self.blocks():
            response = self.responses(begin, end)[0]
            many = end if self.whole >= _SHORT else min(end, max(begin, self.whole))
            for b, e in self.stretches(begin, many):
                self._stretch(states, response[:, :, b - begin : e - begin], b, e)
            if many < end:
                self._piece_by_piece(states, response[:, :, many - begin :], many, end)
        return states

    def _stretch(self, states: Tensor, response: Tensor, begin: int, end: int) -> None:
        at = begin + 1
        here = states[at : at + end - begin].transpose(0, 1)
        back = begin >= self.whole
        if back:
            parts = self.inflow(states, begin, end)
            found = response[:, 0] * parts[0]
            for j in (1, 2, 3):
                found.addcmul_(response[:, j], parts[j])
            joined = found[0].unbind(0)
        before = states[at - 1, 0]
        for k, (after, decay) in enumerate(zip(here[0].unbind(0), response[0, 4].unbind(0), strict=True)):
            if back:
                torch.addcmul(joined[k], before, decay, out=after)
            else:
                torch.mul(before, decay, out=after)
            before = after
        armed = states[at - 1 : at - 1 + end - begin, 0]
        if back:
            torch.addcmul(found[1:], response[1:, 4], armed, out=here[1:])
        else:
            torch.mul(response[1:, 4], armed, out=here[1:])

    def _piece_by_piece(self, states: Tensor, response: Tensor, begin: int, end: int) -> None:
        size, at = end - begin, begin + 1
        lines = states[at - self.whole - 1 :, 1:]
        pairs = lines.as_strided((size, 2, 2, self.columns), (lines.stride(0), *lines.stride())).unbind(0)
        by_line = response[:, :4].reshape(3, 2, 2, size, self.columns).unbind(3)
        of_armed = response[:, 4].unbind(1)
        here = states[at : at + size].unbind(0)
        before = states[at - 1, 0]
        work = response.new_empty(3, 2, 2, self.columns)
        for pair, lined, armed, state in zip(pairs, by_line, of_armed, here, strict=True):
            torch.mul(lined, pair, out=work)
            torch.addcmul(work.sum((1, 2)), armed, before, out=state)
            before = state[0]

    def adjoint(self, states: Tensor, weights: Tensor) -> Tensor:
        """Derivatives (T, P) in the rates of a sum of states with `weights` (as states; overwritten)."""
        found = torch.empty_like(self.rate)
        for begin, end in reversed(self.blocks()):
            response, derivative = self.responses(begin, end, True)
            for b, e in reversed(list(self.stretches(begin, end))):
                self._stretch_adjoint(weights, response[:, :, b - begin : e - begin], b, e)
            at, size = begin + 1, end - begin
            changed = derivative[:, 4] * states[at - 1 : at - 1 + size, 0]
            late = max(begin, self.whole)
            if late < end:
                for j, part in enumerate(self.inflow(states, late, end)):
                    changed[:, late - begin :].addcmul_(derivative[:, j, late - begin :], part)
            own = weights[at : at + size]
            total = (own[:, 1] - own[:, 0]) * changed[0]
            total.addcmul_(own[:, 2], changed[1])
            bins = slice(begin // self.pieces, end // self.pieces)
            if self.pieces > 1:
                total = total.view(-1, self.pieces, self.columns).sum(1) / self.pieces
            found[bins] = total
        return found

    def _stretch_adjoint(self, weights: Tensor, response: Tensor, begin: int, end: int) -> None:
        at, size = begin + 1, end - begin
        own = weights[at : at + size]
        # of the armed at the start of a piece: what it detects, and what it leaves for the next one
        source = response[1, 4] * own[:, 1]
        source.addcmul_(response[2, 4], own[:, 2])
        before = weights[at - 1 : at - 1 + size, 0].unbind(0)
        after, decay, sources = own[:, 0].unbind(0), response[0, 4].unbind(0), source.unbind(0)
        for k in range(size - 1, -1, -1):
            before[k].add_(sources[k]).addcmul_(decay[k], after[k])
        if begin < self.whole:
            return
        if size == 1:
            row = at - self.whole
            given = (response[:, :4, 0].reshape(3, 2, 2, -1) * own[0].view(3, 1, 1, -1)).sum(0)
            weights[row - 1 : row + 1, 1:] += given
            return
        for j, part in enumerate(self.inflow(weights, begin, end)):
            for r in range(3):
                part.addcmul_(response[r, j], own[:, r])


def detection_scans(rate: Tensor, dead_bins: Tensor) -> Iterator[tuple[Tensor | slice, DetectionScan]]:
    """Yield scans over columns of rates, bins cut as finely as the columns need.

    Args:
        rate: (T, P), per cycle and bin.
        dead_bins: dead time in bins.

    Yields:
        Columns, and the scan over them.
    """
    for columns, pieces in rows_by_subdivision(rate.T, float(dead_bins.detach())):
        whole, part = split_dead_time(dead_bins.double() * pieces)
        number = rate.shape[1] if columns is None else columns.numel()
        few = max(1, _STATES // (3 * pieces * rate.shape[0]))
        for begin in range(0, number, few):
            taken = slice(begin, min(begin + few, number)) if columns is None else columns[begin : begin + few]
            own = rate[:, taken]
            largest = float(own.amax().nan_to_num(PHOTONS)) / pieces
            yield taken, DetectionScan(own, whole, float(part), pieces, min(largest, PHOTONS))


# ----------------------------------------------------------------------- mean detections with derivatives of all orders


def mean_detections(rate: Tensor, dead_bins: Tensor) -> Tensor:
    """Mean detections per cycle and bin, differentiable to any order.

    First derivatives in the light take the adjoint of the scan; others (in the dead time, forward mode, higher orders,
    transforms of torch.func) the recursion in differentiable steps, which takes longer.

    Args:
        rate: (T, P) per cycle and bin, float64.
        dead_bins: dead time in bins, scalar float64.

    Returns:
        (T, P) float64.
    """
    if not torch.compiler.is_compiling():
        wrapped = torch._C._functorch.is_functorch_wrapped_tensor
        if any(is_dual(x) or wrapped(x) for x in (rate, dead_bins)):
            return _means_in_steps(rate, dead_bins)
        if not torch.is_grad_enabled():
            return _Detected.forward(rate, dead_bins, False)[0]  # calls of autograd take as long as small images
    keep = torch.is_grad_enabled() and rate.requires_grad
    found: Tensor = _Detected.apply(rate, dead_bins, keep)[0]  # type: ignore[no-untyped-call]
    return found


def _means_in_steps(rate: Tensor, dead_bins: Tensor) -> Tensor:
    return mean_detections_in_steps(rate.T, dead_bins).T


class _Detected(torch.autograd.Function):
    """Detections (T, P) per cycle of rates (T, P), and the states of the scan where they are kept."""

    @staticmethod
    def forward(rate: Tensor, dead_bins: Tensor, keep: bool) -> tuple[Tensor, Tensor]:
        detected = torch.empty_like(rate)
        kept = rate.new_empty(0)
        for columns, scan in detection_scans(rate, dead_bins):
            states = scan.forward()
            detected[:, columns] = states[1:, 1].view(rate.shape[0], scan.pieces, -1).sum(1)
            if keep and scan.columns == rate.shape[1] and scan.pieces == 1:
                kept = states
        return detected, kept

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
        ctx.mark_non_differentiable(output[1])
        ctx.save_for_backward(inputs[0], inputs[1], output[1])

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor | None, None]:
        rate, dead_bins, kept = ctx.saved_tensors
        # batches of torch.autograd (is_grads_batched) know no rule of ours
        batched = torch._C._functorch.is_legacy_batchedtensor(gradients[0])
        if ctx.needs_input_grad[1] or torch.is_grad_enabled() or batched:
            return *torch.func.vjp(_means_in_steps, rate, dead_bins)[1](gradients[0]), None
        return _light_gradient(rate, dead_bins, gradients[0], kept), None, None


def _light_gradient(rate: Tensor, dead_bins: Tensor, weights: Tensor, kept: Tensor) -> Tensor:
    """Derivatives (T, P) in the rates of the sum of detections with weights (T, P)."""
    gradient = torch.empty_like(rate)
    for columns, scan in detection_scans(rate, dead_bins):
        states = kept if kept.ndim > 1 else scan.forward()
        given = torch.zeros_like(states)
        own = weights[:, columns]
        given[1:, 1] = own.repeat_interleave(scan.pieces, 0) if scan.pieces > 1 else own
        gradient[:, columns] = scan.adjoint(states, given)
    return gradient
