"""Counts of one detector that runs free for many periods: no period begins but where the one before it ended.

Few detections are drawn one after the other. Many are those of periods drawn on their own, each from the stationary
state, with the right mean and the right correlations inside a period. What one of them leaves behind (armed, or dead
until some bin) is not what the others begin with, though, and the random difference makes totals far too wide in bright
light. The excess of ends over beginnings is sent on through the chain of detections until all of it has been detected,
in linear order: the sum over periods then obeys the balance of a train of detections, and has its covariance (that of
the central limit theorem for Markov chains). The state before the first period and that after the last one are free.

Near resonance (a dead time and a wait make up a period, or a whole part of one) a detector remembers its phase for
long. What is sent on may then be as large as the counts themselves, and no limit theorem holds: such trains are drawn
detection by detection, too.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchtransient.errors import TorchTransientError
from torchtransient.sensing.dead_time.dead_time_cycle import rows_by_level, whole_and_part
from torchtransient.sensing.dead_time.free_running_draws import (
    BinChances,
    Path,
    bin_chances,
    binomial_share,
    draw_path,
    normal_share,
)
from torchtransient.sensing.dead_time.free_running_events import begin_places, event_counts
from torchtransient.sensing.dead_time.free_running_state import (
    DARK,
    FreeRunningState,
    late_lines,
    per_period,
    within_limits,
)
from torchtransient.sensing.dead_time.renewal_chain import RenewalChain
from torchtransient.sensing.dead_time.stationary_phases import stationary_phases, tangent_phases
from torchtransient.sensing.numerics.draws import sample_multinomial

PHOTONS = 0.5  # of a piece of a bin: where in it a detection lay is forgotten, 1/6 piece^2 beside waits of 4
ONE_BY_ONE = 1000  # detections of a train, up to which they are: a limit theorem does not hold yet, and costs as much
MOST_ONE_BY_ONE = 1 << 22  # minutes
_CLIPPED, _DEVIATIONS = 1e-2, 3.0  # share of counts that bins would lack after so many standard deviations
_PILOTS = 2  # numbers for a standard deviation, of which the larger counts
_FLOOD = 64.0  # of a bin, from which on pieces get no narrower: nothing but the rounding of totals is left to see


def _columns(x: Tensor) -> Tensor:
    return x.T.unsqueeze(-1)  # time is the third dimension from behind


def _rows(x: Tensor) -> Tensor:
    return x.squeeze(-1).T


@dataclass(frozen=True)
class _Stationary:
    """Detectors whose bins are cut in `pieces`, in their stationary state."""

    chain: RenewalChain
    pieces: int
    phases: Tensor  # lines whose counts sum to 1,
    state: FreeRunningState  # per period
    chances: BinChances

    @property
    def per_bin(self) -> Tensor:
        """Detections (P, T) per period."""
        return _whole_bins(self.state.detected, self.pieces)

    def of(self, rows: Tensor) -> _Stationary:
        if torch.equal(rows, torch.arange(self.chain.rate.shape[0], device=rows.device)):
            return self
        c, s = self.chances, self.state
        begin = None if c.begin is None else c.begin[:, rows]
        chances = BinChances(begin, c.fire[:, rows], c.soon[:, rows], c.late[:, rows], c.whole)
        chain = RenewalChain(self.chain.rate[rows], self.chain.whole, self.chain.part)
        state = FreeRunningState(s.detected[rows], s.armed[rows], s.late[rows], s.whole)
        return _Stationary(chain, self.pieces, self.phases[rows], state, chances)


def _whole_bins(fine: Tensor, pieces: int) -> Tensor:
    return fine.view(fine.shape[0], -1, pieces).sum(-1)


def _stationary(rate: Tensor, dead_bins: Tensor, pieces: int) -> _Stationary:
    fine = (rate / pieces).repeat_interleave(pieces, -1)
    whole, part = whole_and_part(dead_bins.to(rate.device) * pieces)
    chain = RenewalChain(fine, whole, part)
    phases = stationary_phases(fine, part, whole)
    state = within_limits(chain, per_period(chain, phases))
    columns = FreeRunningState(_columns(state.detected), _columns(state.armed), _columns(state.late), whole)
    return _Stationary(chain, pieces, phases, state, bin_chances(_columns(fine), columns))


def train_counts(
    rate: Tensor, dead_bins: Tensor, periods: int, generator: torch.Generator | None, *, normal: bool = False
) -> Tensor:
    """Counts (P, T) of detectors in the stationary state over `periods` periods, rates (P, T) per period, float64.

    Whole numbers, or with `normal` normal numbers of the same mean and covariance. Without gradient. Raises
    TorchTransientError for a phase that is remembered over more detections than can be drawn one by one.
    """
    counts = torch.zeros_like(rate)
    dark = rate.sum(-1, keepdim=True) < DARK
    safe = torch.where(dark, 0.1, rate)
    for rows, pieces in rows_by_level(safe.clamp_max(_FLOOD), float(dead_bins), PHOTONS):
        own = safe if rows is None else safe[rows]
        state = _stationary(own, dead_bins, pieces)
        if normal:
            found, more = _periods(state, periods, generator, normal=True)
            found = found if more is None else found + more
        else:
            found = _whole_counts(state, own, dead_bins, periods, generator)
        counts = found if rows is None else counts.index_copy(0, rows, found)
    rows = dark.squeeze(-1).nonzero().squeeze(-1)
    if not rows.numel():
        return counts
    # without light there is nothing to be dead after
    many = torch.full_like(rate[rows], float(periods))
    alone = (normal_share if normal else binomial_share)(many, rate[rows], generator)
    return counts.index_copy(0, rows, alone)


def _whole_counts(
    state: _Stationary, rate: Tensor, dead_bins: Tensor, periods: int, generator: torch.Generator | None
) -> Tensor:
    counts = torch.zeros_like(rate)
    number = periods * state.per_bin.sum(-1)
    one_by_one = number <= ONE_BY_ONE
    many = (~one_by_one).nonzero().flatten()
    if many.numel():
        wide = _remembered(state.of(many), rate[many], dead_bins, periods)
        one_by_one = one_by_one.index_fill(0, many[wide], True)
        many = many[~wide]
    if many.numel():
        found, more = _periods(state.of(many), periods, generator, normal=False)
        counts = counts.index_copy(0, many, found if more is None else _added(found, more, generator))
    rows = one_by_one.nonzero().flatten()
    if rows.numel():
        chosen = state.of(rows)
        if float(number[rows].max()) > MOST_ONE_BY_ONE:
            raise TorchTransientError(
                f"FreeRunningSPAD: expected at most {MOST_ONE_BY_ONE:g} detections where dead time and wait make up a "
                f"part of the period, got {float(number[rows].max()):g}. The phase is remembered over so many of them "
                "that they are drawn one by one. Use fewer cycles, or grad='gaussian'."
            )
        start = begin_places(chosen.state, chosen.chain.part, generator) / state.pieces
        counts = counts.index_copy(0, rows, event_counts(rate[rows], dead_bins, start, periods, generator))
    return counts


def _periods(
    state: _Stationary, periods: int, generator: torch.Generator | None, *, normal: bool
) -> tuple[Tensor, Tensor | None]:
    """Counts (P, T) of periods drawn on their own, and what has to be added to them."""
    path = draw_path(state.chances, periods, generator, normal_share if normal else binomial_share)
    counts = _whole_bins(_rows(path.counts), state.pieces)
    if periods == 1:
        return counts, None
    more = _closing(state.chain, state.phases, state.chances, path, periods, generator)
    return counts, _whole_bins(more, state.pieces)


def _remembered(state: _Stationary, rate: Tensor, dead_bins: Tensor, periods: int) -> Tensor:
    """Which rows (P,) would be left with less than nothing in some bins by what has to be added to independent periods.

    Normal numbers of their own decide: what is drawn may not depend on how it came out, and whole numbers would not
    show what happens once in many trains.
    """
    mean = periods * state.per_bin
    bins = rate.shape[-1]
    wait = bins / state.per_bin.sum(-1) - float(dead_bins)
    # a wait of half a period forgets the phase
    asked = (wait < 0.5 * bins).nonzero().flatten()
    wide = torch.zeros(rate.shape[0], dtype=torch.bool, device=rate.device)
    if periods == 1 or not asked.numel():
        return wide
    pilot = torch.Generator(rate.device).manual_seed(0)
    _, more = _periods(state.of(asked.repeat(_PILOTS)), periods, pilot, normal=True)
    if more is not None:
        size = _DEVIATIONS * more.view(_PILOTS, -1, bins).abs().amax(0)
        wide[asked] = (size - mean[asked]).clamp_min(0).sum(-1) > _CLIPPED * mean[asked].sum(-1)
    return wide


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
    ends = first - last
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


def _added(counts: Tensor, more: Tensor, generator: torch.Generator | None) -> Tensor:
    """Counts with `more`, whole numbers >= 0 whose running sum is within one of the true one, wherever it rises."""
    start = torch.rand(counts[:, :1].shape, dtype=counts.dtype, device=counts.device, generator=generator)
    upto = counts.cumsum(-1) + torch.floor(more.cumsum(-1) + start)
    # a bin with too few to take away from leaves it to the next one, the last one to the first: the total is kept
    return torch.cat([upto - upto[:, -1:], upto], -1).cummax(-1).values[:, -counts.shape[-1] - 1 :].diff(dim=-1)
