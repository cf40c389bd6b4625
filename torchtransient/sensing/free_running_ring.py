"""Counts of one detector that runs free for many periods: no period begins but where the one before it ended.

Periods drawn on their own, each from the stationary state, have the right mean and the right correlations inside a
period. What one of them leaves behind (armed, or dead until some bin) is not what the others begin with, though, and
the random difference makes totals far too wide in bright light. The excess of ends over beginnings is sent on through
the chain of detections until all of it has been detected, in linear order: the sum over periods then obeys the balance
of a train of detections, and has its covariance (that of the central limit theorem for Markov chains). The state before
the first period and that after the last one are free.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchtransient.sensing.dead_time_cycle import rows_by_level, whole_and_part
from torchtransient.sensing.draws import sample_multinomial
from torchtransient.sensing.free_running_draws import (
    BinChances,
    Path,
    bin_chances,
    binomial_share,
    draw_path,
    normal_share,
)
from torchtransient.sensing.free_running_state import DARK, FreeRunningState, late_lines, per_period
from torchtransient.sensing.renewal_chain import RenewalChain
from torchtransient.sensing.stationary_phases import stationary_phases, tangent_phases

PHOTONS = 0.5  # of a piece of a bin: where in it a detection lay is forgotten, 1/6 piece^2 beside waits of 4
_FLOOD = 64.0  # of a bin, from which on pieces get no narrower: nothing but the rounding of totals is left to see


def _columns(x: Tensor) -> Tensor:
    return x.T.unsqueeze(-1)  # time is the third dimension from behind


def _rows(x: Tensor) -> Tensor:
    return x.squeeze(-1).T


def train_counts(
    rate: Tensor, dead_bins: Tensor, periods: int, generator: torch.Generator | None, *, normal: bool = False
) -> Tensor:
    """Counts (P, T) of detectors in the stationary state over `periods` periods, rates (P, T) per period, float64.

    Whole numbers, or with `normal` normal numbers of the same mean and covariance. Without gradient.
    """
    counts = torch.zeros_like(rate)
    dark = rate.sum(-1, keepdim=True) < DARK
    safe = torch.where(dark, torch.full_like(rate, 1.0 / rate.shape[-1]), rate)
    for rows, pieces in rows_by_level(safe.clamp_max(_FLOOD), float(dead_bins), PHOTONS):
        own = safe if rows is None else safe[rows]
        found = _train(own, dead_bins, pieces, periods, generator, normal)
        counts = found if rows is None else counts.index_copy(0, rows, found)
    if bool(dark.any()):
        many = torch.full_like(rate, float(periods))
        # without light there is nothing to be dead after
        alone = (normal_share if normal else binomial_share)(many, torch.where(dark, rate, 0.0), generator)
        counts = torch.where(dark, alone, counts)
    return counts


def _train(
    rate: Tensor, dead_bins: Tensor, pieces: int, periods: int, generator: torch.Generator | None, normal: bool
) -> Tensor:
    fine = (rate / pieces).repeat_interleave(pieces, -1)
    whole, part = whole_and_part(dead_bins.to(rate.device) * pieces)
    chain = RenewalChain(fine, whole, part)
    phases = stationary_phases(fine, part, whole)
    lines = per_period(chain, phases)
    count = lines[:, : chain.bins]
    late = torch.minimum(late_lines(lines, part).clamp_min(0), count.clamp_min(0))
    armed = chain.at_start(chain.inflow(lines)).clamp(0, 1)
    state = FreeRunningState(_columns(count.clamp_min(0)), _columns(armed), _columns(late), whole)
    chances = bin_chances(_columns(fine), state)
    path = draw_path(chances, periods, generator, normal_share if normal else binomial_share)
    found = _rows(path.counts)
    if periods > 1:
        found = _added(found, _closing(chain, phases, chances, path, periods, generator), normal, generator)
    return found.view(*rate.shape, pieces).sum(-1)


def _closing(
    chain: RenewalChain,
    phases: Tensor,
    chances: BinChances,
    path: Path,
    periods: int,
    generator: torch.Generator | None,
) -> Tensor:
    """What has to be added to the counts (P, N) of independent periods, real numbers."""
    if path.begin is None or chances.begin is None:
        raise AssertionError("a free-running detector begins in its stationary state")
    begin = _rows(path.begin)
    # the train itself begins and ends somewhere
    first, last = (_rows(sample_multinomial(1, chances.begin, generator)) for _ in range(2))
    known = (first.sum(-1, keepdim=True) > 0) & (last.sum(-1, keepdim=True) > 0)
    ends = torch.where(known, first - last, 0.0)
    armed = path.end - begin[:, :1] + ends[:, :1]
    back = _rows(path.wrapped) - begin[:, 1:] + ends[:, 1:]
    soon = _rows(chances.soon)
    joined = (back * (1 - soon)).roll(1, -1)
    joined = torch.cat([joined[:, :1] + armed, joined[:, 1:]], -1)
    extra = chain.armed(joined)
    right = torch.cat([extra * chain.response.fire + back * soon, extra * chain.response.slope], -1)
    sent = tangent_phases(chain, phases, right)
    # a multiple of the stationary state is free: every period has one state at its start
    bins = torch.arange(chain.bins, device=right.device)
    starts = torch.stack([(bins + chain.whole + k).div(chain.bins, rounding_mode="floor") for k in (0, 1)]).to(right)

    def states(lines: Tensor) -> Tensor:
        late = late_lines(lines, chain.part)
        dead = (lines[:, : chain.bins] - late) * starts[0] + late * starts[1]
        return dead.sum(-1, keepdim=True) + chain.at_start(chain.inflow(lines))[:, :1]

    there = begin[:, :1] + extra[:, :1] + path.missed + ends[:, 1:].sum(-1, keepdim=True) + states(sent)
    sent = sent + phases * ((periods - there) / states(phases))
    return sent[:, : chain.bins]


def _added(counts: Tensor, more: Tensor, normal: bool, generator: torch.Generator | None) -> Tensor:
    """Counts with `more`, whole numbers >= 0 whose running sum is within one of the true one, wherever it rises."""
    if normal:
        return counts + more
    start = torch.rand(counts[:, :1].shape, dtype=counts.dtype, device=counts.device, generator=generator)
    upto = counts.cumsum(-1) + torch.floor(more.cumsum(-1) + start)
    # a bin with too few to take away from leaves it to the next one
    upto = upto.clamp_min(0).cummax(-1).values
    return upto.diff(dim=-1, prepend=torch.zeros_like(start))
