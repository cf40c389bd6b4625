"""Draws of cycles with several detections, their normal surrogate and their score, piece by piece of `dead_time_cycle`.

Cycles are independent, and a detector that is armed does not know its past: of the armed ones a binomial share fires in
each piece. Detections come back after whole pieces of the dead time, a binomial share one later. Pieces are up to four
times as wide as those of the means, whose sums they take: where in a piece a detection lay is forgotten, which changes
correlations by less than can be seen in a hundred thousand cycles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchtransient.sensing.base.policies import gaussian_noise
from torchtransient.sensing.dead_time.dead_time_cycle import check_dead_bins, cycle_of_rows, rows_by_level
from torchtransient.sensing.dead_time.dead_time_means import walks
from torchtransient.sensing.dead_time.dead_time_walk import Walk
from torchtransient.sensing.dead_time.free_running_draws import (
    BinChances,
    Path,
    draw_path,
    path_log_prob,
    share,
    step_chances,
    step_shares,
)
from torchtransient.sensing.numerics.thinning import halve

_WIDER = 4
_ROOT = math.sqrt(3.0)


@dataclass(frozen=True)
class Steps:
    """Columns (N, P, 1), per cycle and piece: what a run through the pieces of a cycle needs."""

    armed: Tensor
    count: Tensor
    back: Tensor  # armed again in the piece
    chances: BinChances
    pieces: int  # of a bin


@dataclass(frozen=True)
class DrawnRows:
    """The steps of the rows (indices; None: all) whose bins were cut in `pieces` for the means."""

    rows: Tensor | None
    pieces: int
    path: Path


def _later(x: Tensor, by: int) -> Tensor:
    """Rows (P, N) shifted to later pieces."""
    return torch.nn.functional.pad(x, (by, 0))[..., : x.shape[-1]]


def _columns(x: Tensor) -> Tensor:
    return x.T.unsqueeze(-1)  # time is the third dimension from behind


def _width(pieces: int, whole: int) -> int:
    """Pieces that are drawn as one; a dead time is one of these at least."""
    wider = min(_WIDER, pieces, whole)
    while pieces % wider:
        wider -= 1
    return wider


def _wider_pieces(states: Tensor, part: float, whole: int, wider: int) -> tuple[Tensor, Tensor, Tensor]:
    """(detections, armed at the start, late ones after a row of zeros), (N, P) each, from the states of a walk."""
    count, slope, armed = states[1:, 1], states[1:, 2], states[:-1, 0]
    late = torch.zeros_like(states[:, 1])
    if part:
        soon = (1 - part) * count - (_ROOT * (1 - part) * part) * slope
        torch.minimum((count - soon).clamp_min_(0), count, out=late[1:])
    if wider == 1:
        return count, armed, late
    shape = (-1, wider, count.shape[1])
    fine = late[1:].reshape(shape)
    place = torch.arange(wider, device=count.device).view(-1, 1) + whole % wider
    soon = (count.reshape(shape) - fine) * (place >= wider)
    late = (soon + fine * (place + 1 >= wider)).sum(1)
    return count.reshape(shape).sum(1), armed[::wider], torch.nn.functional.pad(late, (0, 0, 1, 0))


def _steps(rate: Tensor, dead_bins: Tensor, pieces: int) -> Steps:
    """For rates (P, T) per cycle and bin."""
    cycle = cycle_of_rows(rate, dead_bins, pieces)
    wider = _width(pieces, cycle.whole)
    shape = (rate.shape[0], -1, wider)
    fine_late = cycle.late
    place = torch.arange(wider, device=rate.device) + cycle.whole % wider
    soon = (cycle.count - fine_late).view(shape) * (place >= wider)
    late = (soon + fine_late.view(shape) * (place + 1 >= wider)).sum(-1)
    count, armed, whole = cycle.count.view(shape).sum(-1), cycle.armed.view(shape)[..., 0], cycle.whole // wider
    flux = (rate * (wider / pieces)).repeat_interleave(pieces // wider, -1)
    back = _later(count - late, whole) + _later(late, whole + 1)
    flux, count, armed, late, back = map(_columns, (flux, count, armed, late, back))
    return Steps(armed, count, back, step_chances(flux, count, armed, late, back, None, whole), pieces // wider)


def _bins(counts: Tensor, pieces: int) -> Tensor:
    """Columns (N, P, 1) of pieces -> rows (P, T) of bins."""
    return counts.view(-1, pieces, counts.shape[1]).sum(1).T


def sample_cycles(rate: Tensor, dead_bins: Tensor, cycles: int, generator: torch.Generator | None) -> Tensor:
    """Counts (T, P) of `cycles` cycles for rates (T, P), float64: `draw_cycles`, without what a score needs."""
    counts = torch.empty_like(rate)
    with torch.no_grad():
        for columns, walk in walks(rate, dead_bins):
            drawn = _sampled(walk, cycles, generator)
            counts[:, columns] = drawn.view(walk.bins, -1, walk.columns).sum(1) if len(drawn) > walk.bins else drawn
    return counts


def _sampled(walk: Walk, cycles: int, generator: torch.Generator | None) -> Tensor:
    """Counts (N, P) of wider pieces."""
    wider = _width(walk.pieces, walk.whole)
    count, armed, late = _wider_pieces(walk.forward(), walk.part, walk.whole, wider)
    size, whole, pieces = count.shape[0], walk.whole // wider, walk.pieces // wider
    counts = torch.empty_like(count)
    able = torch.full_like(count[0], float(cycles))
    some_later = walk.part > 0 or walk.whole % wider > 0
    waits = count.new_zeros(size + 1 if some_later else 1, count.shape[1])  # of the detections of the piece before
    for begin, end in walk.blocks(wider):
        flux = walk.rate[begin // pieces : end // pieces] / pieces
        fire = -torch.expm1(-(flux.repeat_interleave(pieces, 0) if pieces > 1 else flux))
        after = max(begin, whole)
        soon = fire[:0]
        if after < end:
            ago = slice(after - whole, end - whole)
            back = count[ago] - late[1:][ago] + late[ago]
            own = fire[after - begin :]
            chances = step_shares(own, count[after:end], armed[after:end], back)
            fire, soon = torch.cat([fire[: after - begin], chances[0]]), chances[1]
        later = share(late[begin + 1 : end + 1], count[begin:end]) if some_later else soon
        # what comes back in as many pieces as a dead time has was detected before them: drawn for all at once
        for low in range(begin, end, whole):
            high, first = min(low + whole, end), max(low, whole)
            ago = slice(first - whole, max(high, first) - whole)
            back = counts[ago]
            if some_later:
                back = back - waits[1:][ago] + waits[ago]
            again = torch.binomial(back, soon[first - after : first - after + len(back)], generator=generator)
            _walk_through(counts[low:high], able, fire[low - begin : high - begin], back, again, generator)
            seen = min(high, size - whole)  # later ones are not back in this cycle
            if some_later and low < seen:
                waits[low + 1 : seen + 1] = halve(counts[low:seen], later[low - begin : seen - begin], generator)
    return counts


def _walk_through(
    counts: Tensor,
    able: Tensor,
    fire: Tensor,
    back: Tensor,
    again: Tensor,
    generator: torch.Generator | None,
) -> None:
    """Counts (L, P) of consecutive pieces, and the cycles (P,) that are `able` to fire after each of them, in place.

    `back`: cycles that come back in the last pieces, `again`: those of them that fire in the piece they come back in.
    """
    alone = len(counts) - len(back)
    hits = []
    for chance in fire[:alone].unbind(0):
        hits.append(torch.binomial(able, chance, generator=generator))
        able -= hits[-1]
    for chance, own, more in zip(fire[alone:].unbind(0), again.unbind(0), back.unbind(0), strict=True):
        hits.append(torch.binomial(able, chance, generator=generator).add_(own))
        able += more
        able -= hits[-1]
    torch.stack(hits, out=counts)


def draw_cycles(
    rate: Tensor, dead_bins: Tensor, cycles: int, generator: torch.Generator | None
) -> tuple[Tensor, list[DrawnRows]]:
    """Counts (P, T) of `cycles` cycles for rates (P, T), float64, and how they came about. Without gradient."""
    counts, drawn = torch.zeros_like(rate), []
    with torch.no_grad():
        for rows, pieces in rows_by_level(rate, check_dead_bins(dead_bins)):
            own = rate if rows is None else rate[rows]
            steps = _steps(own, dead_bins, pieces)
            path = draw_path(steps.chances, cycles, generator)
            counts = _placed(counts, rows, _bins(path.counts, steps.pieces))
            drawn.append(DrawnRows(rows, pieces, path))
    return counts, drawn


def _placed(into: Tensor, rows: Tensor | None, values: Tensor) -> Tensor:
    return values if rows is None else into.index_copy(0, rows, values)


def score_of_cycles(drawn: list[DrawnRows], rate: Tensor, dead_bins: Tensor, cycles: int) -> Tensor:
    """Log-probability (P,) of the steps that were drawn, up to a number that does not depend on the light."""
    total = torch.zeros_like(rate[:, 0])
    for one in drawn:
        own = rate if one.rows is None else rate[one.rows]
        chances = _steps(own, dead_bins, one.pieces).chances
        total = _placed(total, one.rows, path_log_prob(one.path, chances, cycles).flatten())
    return total


def gaussian_cycles(rate: Tensor, dead_bins: Tensor, cycles: int, generator: torch.Generator | None) -> Tensor:
    """Normal counts (P, T) with mean and covariance of the draws, differentiable in both.

    Binomial steps of independent cycles: each adds its own noise, that of the mean number it draws from, and hands what
    it got on. Means are linear in the steps, so the covariance is that of the counts, not nearly.
    """
    counts = torch.zeros_like(rate)
    for rows, pieces in rows_by_level(rate, check_dead_bins(dead_bins)):
        own = rate if rows is None else rate[rows]
        steps = _steps(own, dead_bins, pieces)
        noisy = cycles * steps.count + _noise(steps, cycles, generator)
        counts = _placed(counts, rows, _bins(noisy, steps.pieces))
    return counts


def _noise(steps: Steps, cycles: int, generator: torch.Generator | None) -> Tensor:
    chances = steps.chances

    def noise(number: Tensor, chance: Tensor) -> tuple[Tensor, ...]:
        return gaussian_noise(cycles * number * chance * (1 - chance), generator).unbind(0)

    of_armed = noise(steps.armed, chances.fire)
    of_back = noise(steps.back, chances.soon)
    of_late = noise(steps.count, chances.late)
    fire, soon, late = (c.unbind(0) for c in (chances.fire, chances.soon, chances.late))
    pieces, whole = len(fire), chances.whole
    armed = torch.zeros_like(fire[0])
    returning = [armed] * pieces
    found = []
    for k in range(pieces):
        hit = fire[k] * armed + of_armed[k] + soon[k] * returning[k] + of_back[k]
        delayed = late[k] * hit + of_late[k]
        for slot, amount in ((k + whole, hit - delayed), (k + whole + 1, delayed)):
            if slot < pieces:
                returning[slot] = returning[slot] + amount
        armed = armed + returning[k] - hit
        found.append(hit)
    return torch.stack(found)
