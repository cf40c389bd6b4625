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
        row = torch.arange(rows).unsqueeze(1)
        # one ascending list of all rows: row r lies between r and r + 1
        self._below = (below + row).reshape(-1)
        place = below * cells
        started = torch.zeros(rows, cells + 1, dtype=torch.int8)
        one = torch.ones(1, dtype=torch.int8).expand(below.numel())
        started.view(-1).scatter_add_(0, (row * (cells + 1) + place.ceil().long()).view(-1), one)
        number = started[:, :-1].cumsum(1, dtype=torch.int8)
        for shift in (-_ROOM, _ROOM):
            cell = (place + shift * cells).floor().long()
            number.view(-1)[(cell + row * cells)[(cell >= 0) & (cell < cells)]] = -1
        self._number = number.view(-1)

    def draw(self, which: Tensor | int, trials: Tensor, generator: torch.Generator | None) -> Tensor:
        """Numbers (K,) int32 of `trials` (K,) int32, each of the probability number `which` (K,) int32."""
        row = trials.clamp_max(self._most)
        row += which * (self._most + 1)
        number = self._look_up(row, generator).to(torch.int32)
        more = (trials > self._most).nonzero().squeeze(-1)
        if more.numel():
            others = which[more] if isinstance(which, Tensor) else which
            number[more] += self.draw(others, trials[more] - self._most, generator)
        return number

    def _look_up(self, row: Tensor, generator: torch.Generator | None) -> Tensor:
        cell = sixteen_bits(row, generator).to(torch.int32).bitwise_and_(self._cells - 1)
        number = self._number.index_select(0, cell.add(row, alpha=self._cells))
        unsure = (number < 0).nonzero().squeeze(-1)
        if unsure.numel():
            row = row[unsure]
            u = torch.rand(unsure.shape, dtype=torch.float64, generator=generator)
            u = u.add_(cell[unsure]).mul_(1 / self._cells).add_(row)
            k = torch.searchsorted(self._below, u, right=True) - row * self._results
            # the end of a row is rounded
            number[unsure] = k.clamp_(min=0).minimum(row % (self._most + 1)).to(torch.int8)
        return number


def sixteen_bits(like: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """One int16, uniform over all its values, for each entry of `like`: four out of every random 64 bits."""
    words = torch.empty((like.numel() + 3) // 4, dtype=torch.int64, device=like.device)
    return words.random_(-(2**63), None, generator=generator).view(torch.int16)[: like.numel()]


def _distribution(probabilities: Tensor, most: int) -> Tensor:
    """P(K <= k) for all probabilities and n = 0 ... `most`, one a row, and all k within reach: float64."""
    mean = most * float(probabilities.max())
    results = min(most, math.ceil(mean + 10 * math.sqrt(mean) + 25))
    n = torch.arange(most + 1, dtype=torch.float64).unsqueeze(1)
    k = torch.arange(results + 1, dtype=torch.float64)
    ways = torch.lgamma(n + 1) - torch.lgamma(k + 1) - torch.lgamma((n - k).clamp_min(0) + 1)
    p = probabilities.view(-1, 1, 1)
    chance = torch.exp(ways + torch.xlogy(k, p) + (n - k) * torch.log1p(-p))
    return torch.where(k <= n, chance, 0.0).cumsum_(-1).clamp_(max=1.0).view(-1, results + 1)


@functools.lru_cache(maxsize=16)
def table_of(probability: float) -> BinomialTable:
    """The table of one probability in [0, 1/2]."""
    most = _RARE_TRIALS if probability <= _RARE else FEW_TRIALS
    return BinomialTable(torch.tensor([probability], dtype=torch.float64), most, 1024)


@functools.cache
def _coarse() -> BinomialTable:
    return BinomialTable(torch.arange(17, dtype=torch.float64) / 32, FEW_TRIALS, 4096)


@functools.cache
def _fine() -> BinomialTable:
    return BinomialTable(torch.arange(64, dtype=torch.float64) / 1024, FEW_TRIALS, 512)


def up_to_share(
    trials: Tensor, share: Tensor, generator: torch.Generator | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Binomial numbers for a probability just below `share` (K,), in [0, 1/2], and what is missing: three (K,).

    (number int32, trials left, probability, below 1.1e-3, with which each of those still has to be added to it).
    `trials` (K,) int32.
    """
    # a share in steps of 1/32, then what is left of it in steps of 1/1024: trials pass the first time or the second
    number, rest, left = None, share, trials
    for table, steps in ((_coarse(), 32), (_fine(), 1024)):
        which = (rest * steps).to(torch.int32)
        lower = which * (1 / steps)
        rest = (rest - lower).div_(1 - lower)
        drawn = table.draw(which, left, generator)
        left = left - drawn
        number = drawn if number is None else number.add_(drawn)
    assert number is not None
    return number, left, rest
