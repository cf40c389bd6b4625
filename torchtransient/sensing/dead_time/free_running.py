"""A free-running detector, whose dead time carries over from one laser period to the next: stationary state and draws.

Trains of many detections are drawn period by period, each from the stationary state, with the right mean and the right
correlations inside a period. The state that a period leaves behind (armed, or dead until some bin) differs from the one
that the next begins with; this excess is sent through the chain of detections until all of it has been detected, in
linear order. The sum over periods then obeys the balance of one train and has its covariance, that of the central limit
theorem for Markov chains. The states before the first and after the last period are free.

Trains of few detections are drawn event by event. So are those near resonance (dead time and wait make up a period, or
a whole part of one), where a detector remembers its phase for so long that no limit theorem holds.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor

from torchtransient.errors import TorchTransientError
from torchtransient.sensing.checks import TIME
from torchtransient.sensing.dead_time.clocked import rows_by_subdivision
from torchtransient.sensing.dead_time.clocked_counts import (
    StepCounts,
    StepProbabilities,
    columns_of,
    draw_normal,
    draw_steps,
    step_probabilities,
)
from torchtransient.sensing.dead_time.renewal import (
    ROOT3,
    RenewalChain,
    split_dead_time,
    stationary_phases,
    sum_of_detections,
)
from torchtransient.sensing.draws import sample_multinomial
from torchtransient.sensing.sensor import straight_through

DARK = 1e-12  # photons per period; below, detections equal photons
_ROUNDING = 1e-9  # of probabilities and of counts per period: more than solutions are off by
_BELOW_ZERO = 1e-5  # of the largest bin: counts as far below zero show bins too wide for the light in them
_SETTLED = 1e-2  # of all counts: change from pieces twice as wide, some ten times the error that is left
_FINEST = 32  # pieces of a bin
_CONTRAST = 9.0  # photons by which light changes from piece to piece
# Of all detections: share rearmed in light that asks for finer pieces. With less of them errors of counts in whole bins
# are below 2e-3 (total variation), and finer pieces cost ten times as much.
_BRIGHT = 0.07
PHOTONS = 0.5  # of a piece in draws: the place inside it is forgotten, 1/6 piece^2 beside waits of 4
ONE_BY_ONE = 1000  # detections of a train, up to which they are drawn event by event: no limit theorem, as cheap
MOST_ONE_BY_ONE = 1 << 22  # minutes
_CLIPPED, _DEVIATIONS = 1e-2, 3.0  # share of counts that bins would lack after so many standard deviations
_PILOTS = 2  # numbers for a standard deviation, of which the larger counts
_FLOOD = 64.0  # photons of a bin, above which pieces get no narrower: nothing but the rounding of totals is left to see
_TRIES = 64  # for a place in the piece that holds the detection just one dead time ago
_LATER = 32  # detections between checks of which pixels are done


# ----------------------------------------------------------------------------------------------------- stationary state


@dataclass(frozen=True)
class FreeRunningState:
    """Stationary state, rows (P, T) or (..., T, H, W), per period, float64, differentiable."""

    detected: Tensor
    armed: Tensor  # probability at the start of the bin
    late: Tensor  # of `detected`: those that are armed again in bin i + `whole` + 1; the others in i + `whole`
    whole: int


def stationary_state(rate: Tensor, dead_bins: Tensor) -> FreeRunningState:
    """Stationary state of detectors.

    Light that changes by many photons a bin, where a share of detections is rearmed, is cut in finer pieces: detections
    there follow no straight lines. Where many photons in a bin meet a dead time that locks the phase, detections crowd
    at an edge of a bin and the lines go below zero; such rows are cut in 2, 4, ... until counts settle.

    Args:
        rate: (P, T) per bin and period, float64.
        dead_bins: dead time in bins, scalar float64.

    Raises:
        TorchTransientError: if counts do not settle with 32 pieces.
    """
    # a dark pixel has no phases; its limit is one photon, at most, per many periods
    dark = rate.sum(-1, keepdim=True) < DARK
    safe = torch.where(dark, 0.1, rate)
    state = _solve_settled(safe, dead_bins, 1)
    inside = _armed_in_the_light(safe, state).nonzero().flatten()
    for rows, pieces in rows_by_contrast(safe[inside]):
        if pieces > 1:
            rows = inside if rows is None else inside[rows]
            state = _replace_rows(state, _solve_settled(safe[rows], dead_bins, pieces), rows)
    detected = torch.where(dark, rate, _within(state.detected, None))
    late = torch.where(dark, torch.zeros_like(rate), _within(state.late, detected))
    armed = torch.where(dark, torch.ones_like(rate), _within(state.armed, torch.ones_like(rate)))
    return FreeRunningState(detected, armed, late, state.whole)


def _within(x: Tensor, high: Tensor | None) -> Tensor:
    """`x` from zero to `high`, with its slope where it is out by rounding, as in every other bin without light."""
    near = x.clamp_min(-_ROUNDING)
    near = near if high is None else torch.minimum(near, high + _ROUNDING)
    return straight_through(x.clamp(torch.zeros_like(x), high), near)


def _armed_in_the_light(rate: Tensor, state: FreeRunningState) -> Tensor:
    """Mask (P,) of rows with a share of detections rearmed in bins far brighter than the darkest."""
    detected, late = state.detected, state.late
    armed_anew = (detected - late).roll(state.whole, -1) + late.roll(state.whole + 1, -1)
    bright = rate - rate.amin(-1, keepdim=True) > _CONTRAST
    return torch.where(bright, armed_anew, 0.0).sum(-1) > _BRIGHT * detected.sum(-1)


def rows_by_contrast(rate: Tensor) -> Iterator[tuple[Tensor | None, int]]:
    """Yield rows of rates and the pieces of their bins, such that light changes by few photons a piece.

    Constant light is exact in bins of any width: only the excess over the darkest bin counts.

    Args:
        rate: (P, T), per period and bin.

    Yields:
        Indices of rows, None for all, and pieces of their bins.
    """
    peak = torch.nan_to_num(rate.amax(-1) - rate.amin(-1)) / _CONTRAST
    level = torch.ceil(torch.log2(peak.clamp(1, _FINEST / 2)) - 1e-9).long()
    for k in range(int(_FINEST).bit_length()):
        rows = (level == k).nonzero().flatten()
        if rows.numel():
            yield (None if rows.numel() == rate.shape[0] else rows), 1 << k


def _replace_rows(whole: FreeRunningState, part: FreeRunningState, rows: Tensor) -> FreeRunningState:
    """`whole` with `part` in these rows."""
    return FreeRunningState(
        whole.detected.index_copy(0, rows, part.detected),
        whole.armed.index_copy(0, rows, part.armed),
        whole.late.index_copy(0, rows, part.late),
        whole.whole,
    )


def _solve_settled(safe: Tensor, dead_bins: Tensor, pieces: int) -> FreeRunningState:
    """State of rows with light, bins cut in `pieces` or as many more as they need."""
    state = _solve_cut(safe, dead_bins, pieces)
    low, high = state.detected.aminmax(dim=-1)
    rows = (~(low >= -_BELOW_ZERO * high)).nonzero().flatten()
    while rows.numel():
        before = state.detected[rows]
        pieces *= 2
        if pieces > _FINEST:
            raise TorchTransientError(
                f"stationary_state: expected counts that settle when bins are cut, got {rows.numel()} pixels that do "
                f"not with bins cut in {_FINEST}. The dead time locks the phase more narrowly than that; use narrower "
                "bins, or less light in a bin."
            )
        finer = _solve_cut(safe[rows], dead_bins, pieces)
        state = _replace_rows(state, finer, rows)
        now = finer.detected
        low, high = now.aminmax(dim=-1)
        settled = (now - before).abs().sum(-1) <= _SETTLED * now.sum(-1)
        rows = rows[~(settled & (low >= -_BELOW_ZERO * high))]
    return state


def detections_per_period(chain: RenewalChain, lines: Tensor) -> Tensor:
    """Detections per period of a stationary chain.

    Args:
        chain: the chain.
        lines: stationary lines whose counts sum to 1.
    """
    # from one detection to the next a detector is dead, then armed
    return lines * (chain.bins / (chain.whole + chain.part + chain.waiting(lines)))


def late_lines(lines: Tensor, part: Tensor) -> Tensor:
    """Detections that are rearmed one bin after the whole dead time.

    Args:
        lines: (P, 2 T).
        part: fraction of a bin of the dead time.

    Returns:
        (P, T).
    """
    bins = lines.shape[-1] // 2
    return part * lines[:, :bins] + ROOT3 * (1 - part) * part * lines[:, bins:]


def clamped_state(chain: RenewalChain, lines: Tensor) -> FreeRunningState:
    """State of lines within the limits of probabilities; lines may dip below zero at edges.

    Args:
        chain: the chain.
        lines: (P, 2 N).
    """
    count = lines[:, : chain.bins].clamp_min(0)
    late = torch.minimum(late_lines(lines, chain.part).clamp_min(0), count)
    armed = chain.at_start(chain.inflow(lines)).clamp(0, 1)
    return FreeRunningState(count, armed, late, chain.whole)


def _solve_cut(rate: Tensor, dead_bins: Tensor, pieces: int) -> FreeRunningState:
    """State with every bin cut in `pieces` of equal rate, put together again."""
    pixels, bins = rate.shape
    fine = (rate / pieces).repeat_interleave(pieces, -1) if pieces > 1 else rate
    whole, part = split_dead_time(dead_bins * pieces)
    part = part.to(rate.device)
    chain = RenewalChain(fine, whole, part)
    lines = detections_per_period(chain, stationary_phases(fine, part, whole))
    count, slope = lines.view(pixels, 2, bins, pieces).unbind(1)
    armed = chain.at_start(chain.inflow(lines)).view(pixels, bins, pieces)[..., 0]
    first = 1 - part
    soon = first * count - ROOT3 * first * part * slope  # detected in the first 1 - part of a piece
    place = torch.arange(pieces, device=rate.device) + whole % pieces
    late = (soon * (place >= pieces) + (count - soon) * (place + 1 >= pieces)).sum(-1)
    return FreeRunningState(count.sum(-1), armed, late, whole // pieces)


def stationary_steps(rate: Tensor, state: FreeRunningState) -> StepProbabilities:
    """Step probabilities of a run with the means of a stationary state.

    Args:
        rate: (..., T, H, W), per period and bin.
        state: stationary state in the same layout.
    """
    bins, whole = rate.shape[TIME], state.whole
    early = state.detected - state.late
    back_soon, back_late = early.roll(whole, TIME), state.late.roll(whole + 1, TIME)
    back = back_soon + back_late
    index = torch.arange(bins, device=rate.device).view(-1, 1, 1)
    # detections of before the period
    dead = back_soon * (index < whole) + back_late * (index < whole + 1)
    begin = torch.cat([state.armed.narrow(TIME, 0, 1), dead], TIME)
    begin = begin / begin.sum(TIME, keepdim=True)  # rounding
    return step_probabilities(rate, state.detected, state.armed, state.late, back, begin, whole)


# ------------------------------------------------------------------------------------------------ draws, event by event


def first_armed(state: FreeRunningState, part: Tensor, generator: torch.Generator | None) -> Tensor:
    """Draw the time at which each detector (P, 1) is armed for the first time, in pieces: 0, or up to a dead time
    later.

    Args:
        state: stationary state of pieces (P, N).
        part: fraction of a piece in the dead time, beyond `state.whole`.
        generator: source of randomness.
    """
    count = state.detected
    pixels, size = count.shape
    dead = state.whole + part
    index = torch.arange(size, dtype=torch.float64, device=count.device)
    # earlier periods in which a detection of this piece would still be felt, the piece where it only may be included
    rounds = torch.ceil((index + 1 + dead) / size - 1e-12) - 1
    weights = (count * rounds).cumsum(-1)

    def uniform() -> Tensor:
        return torch.rand(pixels, 1, dtype=torch.float64, device=count.device, generator=generator)

    armed = state.armed[:, :1]
    start = torch.zeros_like(armed)
    left = (uniform() >= armed) & (weights[:, -1:] > 0)
    share = state.late / count  # NaN of pieces that nothing is drawn from
    for _ in range(_TRIES):
        if not bool(left.any()):
            break
        piece = torch.searchsorted(weights, uniform() * weights[:, -1:], right=True).clamp_max(size - 1)
        # in the last `part` of the piece with the chance of the line, evenly inside either stretch
        at_end = uniform() < share.gather(1, piece)
        inside = torch.where(at_end, 1 - part * uniform(), (1 - part) * uniform())
        before = torch.floor(uniform() * rounds[piece]) + 1
        free = piece + inside - before * size + dead
        start = torch.where(left & (free > 0), free, start)
        left = left & (free <= 0)
    return start


def event_by_event(
    rate: Tensor, dead: Tensor, start: Tensor, periods: int, generator: torch.Generator | None
) -> Tensor:
    """Draw counts (P, T) over `periods` periods, one exponential wait in units of flux per detection.

    Exact; the cost grows with the number of detections.

    Args:
        rate: (P, T) per period, float64, with light in every row; constant inside a bin.
        dead: dead time in bins.
        start: (P, 1), first time at which detectors are armed, in bins.
        periods: number of periods.
        generator: source of randomness.
    """
    pixels, bins = rate.shape
    counts = torch.zeros_like(rate)
    flux = torch.cat([torch.zeros_like(rate[:, :1]), rate.cumsum(-1)], -1)
    rounds, rest = divmod(float(dead), bins)
    rows = torch.arange(pixels, device=rate.device)
    period = torch.floor(start / bins)
    place = start - period * bins
    hits = counts
    while rows.numel():
        total, upto = flux[:, -1:], flux[:, 1:].contiguous()
        for _ in range(_LATER):
            k = place.long().clamp_max_(bins - 1)
            target = flux.gather(1, k).addcmul_(rate.gather(1, k), place - k)
            target += torch.empty_like(target).exponential_(generator=generator)
            over = torch.floor(target / total)
            target.addcmul_(over, total, value=-1)
            period += over
            k = torch.searchsorted(upto, target, right=True).clamp_max_(bins - 1)
            hits.scatter_add_(1, k, (period < periods).to(hits.dtype))
            inside = (target - flux.gather(1, k)) / rate.gather(1, k)
            place = inside.nan_to_num_(0.0, 0.0, 0.0).clamp_(0, 1) + k + rest
            over = (place >= bins).to(place.dtype)
            place.sub_(over, alpha=bins)
            period += over + rounds
        going = (period < periods).squeeze(-1)
        if hits is not counts:
            counts[rows] = hits
        if not bool(going.all()):
            rows, rate, flux = rows[going], rate[going], flux[going]
            place, period = place[going], period[going]
            hits = counts[rows]
    return counts


# ---------------------------------------------------------------------------------------------- draws, period by period


def _rows(x: Tensor) -> Tensor:
    return x.squeeze(-1).T


@dataclass(frozen=True)
class _StationaryTrain:
    """Detectors whose bins are cut in `pieces`, in their stationary state."""

    chain: RenewalChain
    pieces: int
    phases: Tensor  # lines whose counts sum to 1,
    state: FreeRunningState  # per period
    chances: StepProbabilities

    @property
    def per_bin(self) -> Tensor:
        """Detections (P, T) per period."""
        return _whole_bins(self.state.detected, self.pieces)

    def select(self, rows: Tensor) -> _StationaryTrain:
        """Detectors of these rows."""
        if torch.equal(rows, torch.arange(self.chain.rate.shape[0], device=rows.device)):
            return self
        c, s = self.chances, self.state
        begin = None if c.begin is None else c.begin[:, rows]
        chances = StepProbabilities(begin, c.fire[:, rows], c.soon[:, rows], c.late[:, rows], c.whole)
        chain = RenewalChain(self.chain.rate[rows], self.chain.whole, self.chain.part)
        state = FreeRunningState(s.detected[rows], s.armed[rows], s.late[rows], s.whole)
        return _StationaryTrain(chain, self.pieces, self.phases[rows], state, chances)


def _whole_bins(fine: Tensor, pieces: int) -> Tensor:
    return fine.view(fine.shape[0], -1, pieces).sum(-1)


def _stationary_train(rate: Tensor, dead_bins: Tensor, pieces: int) -> _StationaryTrain:
    fine = (rate / pieces).repeat_interleave(pieces, -1)
    whole, part = split_dead_time(dead_bins.to(rate.device) * pieces)
    chain = RenewalChain(fine, whole, part)
    phases = stationary_phases(fine, part, whole)
    state = clamped_state(chain, detections_per_period(chain, phases))
    columns = FreeRunningState(columns_of(state.detected), columns_of(state.armed), columns_of(state.late), whole)
    return _StationaryTrain(chain, pieces, phases, state, stationary_steps(columns_of(fine), columns))


def sample_trains(
    rate: Tensor, dead_bins: Tensor, periods: int, generator: torch.Generator | None, *, normal: bool = False
) -> Tensor:
    """Draw counts of detectors that start in the stationary state, over `periods` periods.

    Args:
        rate: (P, T) per period, float64.
        dead_bins: dead time in bins, scalar float64.
        periods: number of periods.
        generator: source of randomness.
        normal: normal numbers of the same mean and covariance, instead of integers.

    Returns:
        (P, T) float64, without gradient.

    Raises:
        TorchTransientError: for a phase that is remembered over more detections than can be drawn event by event.
    """
    counts = torch.zeros_like(rate)
    dark = rate.sum(-1, keepdim=True) < DARK
    safe = torch.where(dark, 0.1, rate)
    for rows, pieces in rows_by_subdivision(safe.clamp_max(_FLOOD), float(dead_bins), PHOTONS):
        own = safe if rows is None else safe[rows]
        state = _stationary_train(own, dead_bins, pieces)
        if normal:
            found, more = _independent_periods(state, periods, generator, normal=True)
            found = found if more is None else found + more
        else:
            found = _sample_counts(state, own, dead_bins, periods, generator)
        counts = found if rows is None else counts.index_copy(0, rows, found)
    rows = dark.squeeze(-1).nonzero().squeeze(-1)
    if not rows.numel():
        return counts
    # without light there is nothing to be dead after
    many = torch.full_like(rate[rows], float(periods))
    alone = (draw_normal if normal else torch.binomial)(many, rate[rows], generator)
    return counts.index_copy(0, rows, alone)


def _sample_counts(
    state: _StationaryTrain, rate: Tensor, dead_bins: Tensor, periods: int, generator: torch.Generator | None
) -> Tensor:
    """Integer counts (P, T), period by period or event by event."""
    counts = torch.zeros_like(rate)
    number = periods * state.per_bin.sum(-1)
    one_by_one = number <= ONE_BY_ONE
    many = (~one_by_one).nonzero().flatten()
    if many.numel():
        wide = _remembers_phase(state.select(many), rate[many], dead_bins, periods)
        one_by_one = one_by_one.index_fill(0, many[wide], True)
        many = many[~wide]
    if many.numel():
        found, more = _independent_periods(state.select(many), periods, generator, normal=False)
        counts = counts.index_copy(0, many, found if more is None else _add_rounded(found, more, generator))
    rows = one_by_one.nonzero().flatten()
    if rows.numel():
        chosen = state.select(rows)
        if float(number[rows].max()) > MOST_ONE_BY_ONE:
            raise TorchTransientError(
                f"FreeRunningSPAD: expected at most {MOST_ONE_BY_ONE:g} detections where dead time and wait make up a "
                f"part of the period, got {float(number[rows].max()):g}. The phase is remembered over so many of them "
                "that they are drawn one by one. Use fewer cycles, or grad='gaussian'."
            )
        start = first_armed(chosen.state, chosen.chain.part, generator) / state.pieces
        counts = counts.index_copy(0, rows, event_by_event(rate[rows], dead_bins, start, periods, generator))
    return counts


def _independent_periods(
    state: _StationaryTrain, periods: int, generator: torch.Generator | None, *, normal: bool
) -> tuple[Tensor, Tensor | None]:
    """Counts (P, T) of independent periods, and the correction that makes one train of them."""
    path = draw_steps(state.chances, periods, generator, draw_normal if normal else torch.binomial)
    counts = _whole_bins(_rows(path.counts), state.pieces)
    if periods == 1:
        return counts, None
    more = _balance(state.chain, state.phases, state.chances, path, periods, generator)
    return counts, _whole_bins(more, state.pieces)


def _remembers_phase(state: _StationaryTrain, rate: Tensor, dead_bins: Tensor, periods: int) -> Tensor:
    """Mask (P,) of rows whose correction would leave less than no counts in some bins.

    Decided by normal numbers of their own: a choice by the draw itself would bias it, and integers would not show what
    happens once in many trains.
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
    _, more = _independent_periods(state.select(asked.repeat(_PILOTS)), periods, pilot, normal=True)
    if more is not None:
        size = _DEVIATIONS * more.view(_PILOTS, -1, bins).abs().amax(0)
        wide[asked] = (size - mean[asked]).clamp_min(0).sum(-1) > _CLIPPED * mean[asked].sum(-1)
    return wide


def _balance(
    chain: RenewalChain,
    phases: Tensor,
    chances: StepProbabilities,
    path: StepCounts,
    periods: int,
    generator: torch.Generator | None,
) -> Tensor:
    """Correction (P, N), real numbers, to counts of independent periods: excess of ends over beginnings, detected."""
    # a free-running detector begins in its stationary state: neither is None
    begin, begin_chances = _rows(cast(Tensor, path.begin)), cast(Tensor, chances.begin)
    # the train itself begins and ends somewhere
    first, last = (_rows(sample_multinomial(1, begin_chances, generator)) for _ in range(2))
    ends = first - last
    armed = path.end - begin[:, :1] + ends[:, :1]
    back = _rows(path.wrapped) - begin[:, 1:] + ends[:, 1:]
    soon = _rows(chances.soon)
    joined = (back * (1 - soon)).roll(1, -1)
    joined = torch.cat([joined[:, :1] + armed, joined[:, 1:]], -1)
    extra = chain.armed(joined)
    right = torch.cat([extra * chain.response.fire + back * soon, extra * chain.response.slope], -1)
    sent = sum_of_detections(chain, phases, right)
    # a multiple of the stationary state is free: every period has one state at its start
    bins = torch.arange(chain.bins, device=right.device)
    starts = torch.stack([(bins + chain.whole + k).div(chain.bins, rounding_mode="floor") for k in (0, 1)]).to(right)

    def states(lines: Tensor) -> Tensor:
        """Detectors per period that the lines account for."""
        late = late_lines(lines, chain.part)
        dead = (lines[:, : chain.bins] - late) * starts[0] + late * starts[1]
        return dead.sum(-1, keepdim=True) + chain.at_start(chain.inflow(lines))[:, :1]

    there = begin[:, :1] + extra[:, :1] + path.missed + ends[:, 1:].sum(-1, keepdim=True) + states(sent)
    sent = sent + phases * ((periods - there) / states(phases))
    return sent[:, : chain.bins]


def _add_rounded(counts: Tensor, more: Tensor, generator: torch.Generator | None) -> Tensor:
    """Integers >= 0 whose running sum is within one of that of `counts` + `more`, wherever it rises."""
    start = torch.rand(counts[:, :1].shape, dtype=counts.dtype, device=counts.device, generator=generator)
    upto = counts.cumsum(-1) + torch.floor(more.cumsum(-1) + start)
    # a bin with too few to take away from leaves it to the next one, the last one to the first: the total is kept
    return torch.cat([upto - upto[:, -1:], upto], -1).cummax(-1).values[:, -counts.shape[-1] - 1 :].diff(dim=-1)
