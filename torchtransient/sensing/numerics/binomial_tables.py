"""Binomial numbers by one look into a table each, for many entries of few trials.

A row of a table belongs to a probability and a number of trials, a cell of it to a stretch of the uniform number. Most
cells hold one result only; where a border between results lies inside a cell, more of the uniform number is drawn and
the result looked up in the distribution function itself, in double precision.
"""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

_VALUES = 1 << 16  # of a random number of 16 bits
_ROOM = 1e-9  # beside the border of two results, more than the rounding of the distribution function
FEW_TRIALS = 127  # of an entry: their numbers fit into a byte. With more, torch.binomial is cheaper than two looks
_RARE, _RARE_TRIALS = 0.05, 511  # up to this probability so many trials have results that fit into a byte


class BinomialTable:
    """Binomial numbers of `probabilities` (S,) float64 in [0, 1) and of 0 ... `most` trials, on the CPU.

    `cells`: stretches of the uniform number, a power of 2 up to 65536. `most`: with so many trials results above 127
    must be out of reach (probability below 1e-20).
    """

    def __init__(self, probabilities: Tensor, most: int, cells: int) -> None:
        self._most, self._cells = most, cells
        below = _distribution(probabilities, most)
        rows, self._results = below.shape
        row = torch.arange(rows, device="cpu").unsqueeze(1)
        # one ascending list of all rows: row r lies between r and r + 1
        self._below = (below + row).reshape(-1)
        place = below * cells
        started = torch.zeros(rows, cells + 1, dtype=torch.int8, device="cpu")
        one = torch.ones(1, dtype=torch.int8, device="cpu").expand(below.numel())
        started.view(-1).scatter_add_(0, (row * (cells + 1) + place.ceil().long()).view(-1), one)
        number = started[:, :-1].cumsum(1, dtype=torch.int8)
        for shift in (-_ROOM, _ROOM):
            cell = (place + shift * cells).floor().long()
            number.view(-1)[(cell + row * cells)[(cell >= 0) & (cell < cells)]] = -1
        self._number = number.view(-1)

    def draw(self, which: Tensor | int, trials: Tensor, generator: torch.Generator | None) -> Tensor:
        """Numbers (K,) int32 of `trials` (K,) int32, each of the probability number `which` (K,) int32."""
        if int(trials.max()) <= self._most:
            return self._of_few(which, trials, generator).to(torch.int32)
        number = self._of_few(which, trials.clamp_max(self._most), generator).to(torch.int32)
        more = (trials > self._most).nonzero().squeeze(-1)
        others = which[more] if isinstance(which, Tensor) else which
        number[more] += self.draw(others, trials[more] - self._most, generator)
        return number

    def _of_few(self, which: Tensor | int, trials: Tensor, generator: torch.Generator | None) -> Tensor:
        """Numbers (K,) int8 of at most as many trials as the table has."""
        cell, number = self._look(self._row(which, trials), generator)
        unsure = (number < 0).nonzero().squeeze(-1)
        if unsure.numel():
            number[unsure] = self._exactly(self._row(which, trials)[unsure], cell[unsure], generator)
        return number

    def draw_some(self, trials: Tensor, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
        """Places (J,) int64 of the numbers above 0 (a few of 0 among them), and these (J,) int32, for one probability.

        `trials` (K,) int32.
        """
        if int(trials.max()) > self._most:
            number = self.draw(0, trials, generator)
            place = number.nonzero().squeeze(-1)
            return place, number.index_select(0, place)
        cell, number = self._look(trials, generator)
        place = number.nonzero().squeeze(-1)
        some = number.index_select(0, place)
        unsure = (some < 0).nonzero().squeeze(-1)
        if unsure.numel():
            among = place[unsure]
            some[unsure] = self._exactly(trials[among], cell[among], generator)
        return place, some.to(torch.int32)

    def _row(self, which: Tensor | int, trials: Tensor) -> Tensor:
        return trials if isinstance(which, int) and which == 0 else trials + which * (self._most + 1)

    def _look(self, row: Tensor, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
        """Cells, and what the table says in them: -1 where it does not tell."""
        cell = sixteen_bits(row, generator).to(torch.int32).bitwise_and_(self._cells - 1)
        return cell, self._number.index_select(0, cell.add(row, alpha=self._cells))

    def _exactly(self, row: Tensor, cell: Tensor, generator: torch.Generator | None) -> Tensor:
        """The number by the rest of the uniform number, somewhere in the cell."""
        u = torch.rand(row.shape, dtype=torch.float64, device="cpu", generator=generator)
        u = u.add_(cell).mul_(1 / self._cells).add_(row)
        k = torch.searchsorted(self._below, u, right=True) - row * self._results
        # the end of a row is rounded
        return k.clamp_(min=0).minimum(row % (self._most + 1)).to(torch.int8)


class LagTable:
    """Draws of 0 ... K - 1 with `probabilities` (K,) float64 whose sum is 1, on the CPU. K at most 32767."""

    def __init__(self, probabilities: Tensor) -> None:
        self._below = probabilities.cumsum(0)[:-1]
        place = self._below * _VALUES
        started = torch.bincount(place.ceil().long().clamp_(max=_VALUES), minlength=_VALUES + 1)
        self._number = started.cumsum(0)[:_VALUES].to(torch.int16)
        for shift in (-_ROOM, _ROOM):
            cell = (place + shift * _VALUES).floor().long()
            self._number[cell[(cell >= 0) & (cell < _VALUES)]] = -1

    def draw(self, like: Tensor, generator: torch.Generator | None) -> Tensor:
        """(N,) int64 for `like` (N,)."""
        cell = sixteen_bits(like, generator).to(torch.int32).bitwise_and_(_VALUES - 1)
        number = self._number.index_select(0, cell).long()
        unsure = (number < 0).nonzero().squeeze(-1)
        if unsure.numel():
            u = torch.rand(unsure.shape, dtype=torch.float64, device="cpu", generator=generator)
            number[unsure] = torch.searchsorted(self._below, u.add_(cell[unsure]).mul_(1 / _VALUES), right=True)
        return number


def sixteen_bits(like: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """One int16, uniform over all its values, for each entry of `like`: four out of every random 64 bits."""
    words = torch.empty((like.numel() + 3) // 4, dtype=torch.int64, device=like.device)
    return words.random_(-(2**63), None, generator=generator).view(torch.int16)[: like.numel()]


def _distribution(probabilities: Tensor, most: int) -> Tensor:
    """P(K <= k) for all probabilities and n = 0 ... `most`, one a row, and all k within reach: float64."""
    mean = most * float(probabilities.max())
    results = min(most, math.ceil(mean + 10 * math.sqrt(mean) + 25))
    n = torch.arange(most + 1, dtype=torch.float64, device="cpu").unsqueeze(1)
    k = torch.arange(results + 1, dtype=torch.float64, device="cpu")
    ways = torch.lgamma(n + 1) - torch.lgamma(k + 1) - torch.lgamma(n - k + 1)  # none of k > n
    p = probabilities.view(-1, 1, 1)
    chance = torch.exp(ways + torch.xlogy(k, p) + (n - k) * torch.log1p(-p))
    return chance.cumsum_(-1).clamp_(max=1.0).view(-1, results + 1)


@functools.lru_cache(maxsize=32)
def table_of(probability: float, *, small: bool = False) -> BinomialTable:
    """The table of one probability in [0, 1/2]. `small`: one that is made in less time, for fewer entries."""
    most = _RARE_TRIALS if probability <= _RARE and not small else FEW_TRIALS
    return BinomialTable(torch.tensor([probability], dtype=torch.float64, device="cpu"), most, 256 if small else 1024)


@functools.cache
def _coarse() -> BinomialTable:
    return BinomialTable(torch.arange(17, dtype=torch.float64, device="cpu") / 32, FEW_TRIALS, 4096)


@functools.cache
def _fine() -> BinomialTable:
    return BinomialTable(torch.arange(64, dtype=torch.float64, device="cpu") / 1024, FEW_TRIALS, 512)


def up_to_share(
    trials: Tensor, share: Tensor, generator: torch.Generator | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Binomial numbers for a probability just below `share` (K,), in [0, 1/2], and what is missing: three (K,).

    (number int32, trials left, probability, below 1.1e-3, with which each of those still has to be added to it).
    `trials` (K,) int32.
    """
    # a share in steps of 1/32, then what is left of it in steps of 1/1024: trials pass the first time or the second
    number, rest, left = torch.zeros_like(trials), share, trials
    for table, steps in ((_coarse(), 32), (_fine(), 1024)):
        which = (rest * steps).to(torch.int32)
        lower = which * (1 / steps)
        rest = (rest - lower).div_(1 - lower)
        drawn = table.draw(which, left, generator)
        left = left - drawn
        number += drawn
    return number, left, rest
