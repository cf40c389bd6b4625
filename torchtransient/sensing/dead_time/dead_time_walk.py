"""The walk of `dead_time_cycle` for speed: columns of pieces one after another, and its adjoint, without a graph.

Per piece (armed at its end, detections, slope of them) are linear in (the inflow's four parts, armed at its start).
The 3 x 5 numbers are power series of the photons in a piece, at most a quarter: one matrix times its powers gives them
all. What is left is one multiplication a piece, and sums over stretches of pieces of at most one dead time.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator

import torch
from torch import Tensor

_ROOT = math.sqrt(3.0)
_SMALLEST_TERM = 1e-15  # relative
_AT_ONCE = 1 << 15  # responses: as many as stay in the cache
_SHORT = 4  # pieces: stretches below are walked piece by piece


def degree_of(largest: float) -> int:
    degree = 3
    while largest**degree / math.factorial(degree) > _SMALLEST_TERM:
        degree += 1
    return degree


@functools.lru_cache(maxsize=64)
@torch.inference_mode(False)
def response_series(part: float, degree: int) -> tuple[Tensor, Tensor]:
    """Power series (3, 5, D + 1) for (armed at the end, detections, slope), and derivatives (2, 5, D + 1) of two.

    Of the inflow, ordered (older line's constant, its slope, younger line's constant, its slope), and of the armed.
    As `renewal_chain.bin_response`, up to the power D = `degree` of the rates. Remembered: not to be changed in place.
    """
    first = 1 - part
    waited = torch.zeros(5, degree + 1, dtype=torch.float64)
    for i in range(degree + 1):
        sign = (-1) ** i / math.factorial(i + 1)
        near = sign * first ** (i + 2) / (i + 2), sign * first ** (i + 3) / (i + 3)
        rest = sign / (i + 2) - near[0], sign / (i + 3) - near[1]
        waited[0, i] = rest[0]
        waited[1, i] = _ROOT * ((2 * first + 1) * rest[0] - 2 * rest[1])
        waited[2, i] = near[0]
        waited[3, i] = _ROOT * ((2 * first - 1) * near[0] - 2 * near[1])
        waited[4, i] = sign
    hit, slope = torch.zeros_like(waited), torch.zeros_like(waited)
    hit[:, 1:] = waited[:, :-1]
    slope[:, 1:] = _ROOT * (2 * waited[:, 1:] + waited[:, :-1])
    slope[4, 1] = 0  # and not what rounding leaves of -1 + 1
    kept = -hit
    turn = _ROOT * first * part
    kept[:, 0] = torch.tensor([part, turn, first, -turn, 1.0], dtype=torch.float64)
    order = torch.arange(1, degree + 1, dtype=torch.float64)
    derivative = torch.zeros(2, 5, degree + 1, dtype=torch.float64)
    derivative[..., :-1] = torch.stack([hit, slope])[..., 1:] * order
    return torch.stack([kept, hit, slope]), derivative


class Walk:
    """Of columns (T, P) of photons per bin, the bins cut in `pieces` of at most `largest` photons, float64.

    States are (N + 1, 3, P) for N pieces: (armed at the end, detections, slope) of piece k in place k + 1; place 0 is
    the start of the cycle. `whole` pieces and `part` of one are the dead time.
    """

    def __init__(self, rate: Tensor, whole: int, part: float, pieces: int, largest: float) -> None:
        series, derivative = response_series(part, degree_of(largest))
        self.rate, self.whole, self.part, self.pieces = rate, whole, part, pieces
        self.bins, self.columns = rate.shape
        self.size = self.bins * pieces
        self._series = series.to(rate.device).view(15, -1)
        self._derivative = derivative.to(rate.device).view(10, -1)

    def blocks(self, wider: int = 1) -> list[tuple[int, int]]:
        """(begin, end) of pieces, or of those `wider` times as wide: whole bins."""
        bins, pieces = max(1, _AT_ONCE // (self.pieces * max(1, self.columns))), self.pieces // wider
        return [(k * pieces, min(k + bins, self.bins) * pieces) for k in range(0, self.bins, bins)]

    def responses(self, begin: int, end: int, derivative: bool = False) -> tuple[Tensor, Tensor]:
        """(3, 5, L, P) for L pieces, and (2, 5, L, P) of slopes or nothing."""
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
        """Of at most one dead time, those before the end of the first one apart."""
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
        """The states."""
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
        """Of a sum of states with `weights` (as states; overwritten), derivatives with respect to the rates (T, P)."""
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
