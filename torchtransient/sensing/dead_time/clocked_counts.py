"""Histograms of a clocked detector: draws, their normal surrogate and score, and the inverse of the mean (Coates).

Draws go from piece to piece of `clocked`. Cycles are independent, and an armed detector does not know its past: of the
armed cycles a binomial share fires in each piece; detections are rearmed after whole pieces of the dead time, a
binomial share one later. Pieces are up to four times as wide as those of the means, whose sums they take: the place of
a detection inside its piece is forgotten, which changes correlations by less than shows in a hundred thousand cycles.

The inverse follows the cycles that are armed through the histogram. Counts do not tell where in a bin a detection lay;
that is taken from the mean of uncut bins given those before, exact to third order in the photons of a bin. Estimates
are corrected by the difference of that mean to the mean of cut bins.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from torchtransient.errors import UnitError
from torchtransient.sensing.checks import TIME
from torchtransient.sensing.dead_time.clocked import (
    DeadTimeBlocks,
    DetectionScan,
    cycle_means,
    detection_scans,
    mean_detections,
    rows_by_subdivision,
)
from torchtransient.sensing.dead_time.once import once
from torchtransient.sensing.dead_time.renewal import (
    ROOT3,
    bin_response,
    check_dead_bins,
    moments,
    second_moment,
    split_dead_time,
)
from torchtransient.sensing.draws import halve, sample_multinomial
from torchtransient.sensing.sensor import gaussian_noise

_MOST_MERGED = 4  # pieces of the means that are drawn as one
_MOST_STEPS = 40  # of Newton's method
_SETTLED = 1e-12
_BRIGHTEST = 500.0  # photons in a bin: beyond, no histogram tells how many
_CORRECTIONS = 8  # of the error of uncut bins
_LARGEST_CORRECTION = 0.1  # of the counts
_FLOOD = 30.0  # photons in a bin, above which corrections cost more and more and tell nothing


# ------------------------------------------------------------------------------------------ steps of a run through bins


@dataclass(frozen=True)
class StepProbabilities:
    """Probabilities of every step of a run through the bins of a period, (..., T, H, W)."""

    # bin 0: armed at the start; then (T + 1 in all) dead at the start and armed again in bin 0, 1, ...; None: all armed
    begin: Tensor | None
    fire: Tensor  # detected in the bin, when armed at its start
    soon: Tensor  # detected in the bin, when armed again in it
    late: Tensor  # armed again after `whole` + 1 bins instead of `whole`, when detected
    whole: int


@dataclass(frozen=True)
class StepCounts:
    """Numbers of detectors that took each step, in the layout of StepProbabilities."""

    begin: Tensor | None
    armed: Tensor  # at the start of the bin
    back: Tensor  # armed again in it
    fired: Tensor  # of `armed`
    soon: Tensor  # of `back`
    late: Tensor
    # left behind: armed at the end, armed again in each bin of some later period, and starts of periods missed by these
    end: Tensor
    wrapped: Tensor
    missed: Tensor

    @property
    def counts(self) -> Tensor:
        """Detections, (..., T, H, W)."""
        return self.fired + self.soon


def bounded_ratio(part: Tensor, whole: Tensor) -> Tensor:
    """Return part / whole within [0, 1], 0 where whole is 0.

    Args:
        part: numerator.
        whole: denominator.
    """
    some = whole > 1e-13
    share = part / torch.where(some, whole, torch.ones_like(whole))
    return torch.where(some, share, 0.0).clamp(0, 1)


def step_probabilities(
    rate: Tensor, detected: Tensor, armed: Tensor, late: Tensor, back: Tensor, begin: Tensor | None, whole: int
) -> StepProbabilities:
    """Step probabilities of bins with given means; all arguments of one layout.

    Args:
        rate: rate per cycle and bin.
        detected: mean detections.
        armed: probability of being armed at the start of bins.
        late: detections rearmed one bin after the whole dead time.
        back: rearmed in the bin.
        begin: probability of being armed when the first bin begins, or None.
        whole: whole bins of the dead time.
    """
    fire, soon = firing_probabilities(-torch.expm1(-rate), detected, armed, back)
    return StepProbabilities(begin=begin, fire=fire, soon=soon, late=bounded_ratio(late, detected), whole=whole)


def firing_probabilities(fire: Tensor, detected: Tensor, armed: Tensor, back: Tensor) -> tuple[Tensor, Tensor]:
    """Probabilities to be detected when armed at the start of a bin (nearly `fire`), and when rearmed in it.

    Where the straight lines leave too much or too little for the rearmed ones, one probability for both keeps the mean.

    Args:
        fire: probability of a photon in the bin.
        detected: mean detections.
        armed: probability of being armed at the start.
        back: rearmed in the bin.

    Returns:
        Both probabilities.
    """
    rest = detected - armed * fire
    whole_chance = bounded_ratio(detected, armed + back)
    fits = (rest >= 0) & (rest <= back)
    return torch.where(fits, fire, whole_chance), torch.where(fits, bounded_ratio(rest, back), whole_chance)


def draw_normal(number: Tensor, chance: Tensor, generator: torch.Generator | None) -> Tensor:
    """Draw normal numbers with mean and variance of binomial ones.

    Args:
        number: number of trials.
        chance: probability.
        generator: source of randomness.
    """
    z = torch.randn(number.shape, dtype=number.dtype, device=number.device, generator=generator)
    return number * chance + (number.clamp_min(0) * chance * (1 - chance)).sqrt() * z


def draw_steps(
    chances: StepProbabilities,
    periods: int,
    generator: torch.Generator | None,
    draw: Callable[[Tensor, Tensor, torch.Generator | None], Tensor] = torch.binomial,
) -> StepCounts:
    """Draw the steps of `periods` independent detectors, each run over one period.

    Args:
        chances: step probabilities, (..., T, H, W).
        periods: number of detectors.
        generator: source of randomness.
        draw: function that draws from numbers of trials, probabilities and a generator, `torch.binomial` or
            `draw_normal`.
    """
    bins, begin = chances.fire.shape[TIME], None
    if chances.begin is None:
        armed = torch.full_like(chances.fire.select(TIME, 0), float(periods))
        returning = [torch.zeros_like(armed) for _ in range(bins)]
    else:
        begin = sample_multinomial(periods, chances.begin, generator)
        armed = begin.select(TIME, 0)
        returning = list(begin.unbind(TIME)[1:])
    taken: list[list[Tensor]] = [[], [], [], [], []]
    wrapped, missed = [torch.zeros_like(armed)] * bins, torch.zeros_like(armed)
    for k in range(bins):
        back = returning[k]
        fired = draw(armed, chances.fire.select(TIME, k), generator)
        soon = draw(back, chances.soon.select(TIME, k), generator)
        hit = fired + soon
        late = draw(hit, chances.late.select(TIME, k), generator)
        for column, value in zip(taken, (armed, back, fired, soon, late), strict=True):
            column.append(value)
        for slot, amount in ((k + chances.whole, hit - late), (k + chances.whole + 1, late)):
            rounds, place = divmod(slot, bins)
            if rounds:
                wrapped[place] = wrapped[place] + amount
                missed = missed + rounds * amount
            else:
                returning[place] = returning[place] + amount
        armed = armed + back - hit
    steps = [torch.stack(column, TIME) for column in (*taken, wrapped)]
    return StepCounts(begin, steps[0], steps[1], steps[2], steps[3], steps[4], armed, steps[5], missed)


def safe_xlogy(count: Tensor, chance: Tensor) -> Tensor:
    """Return count log(chance), with value and gradient 0 for count 0 (torch.xlogy has a NaN gradient at chance 0).

    Args:
        count: tensor of any shape.
        chance: probability, in a shape that broadcasts.
    """
    return count * torch.log(torch.where(count != 0, chance, 1.0))


def binomial_log_prob(count: Tensor, trials: int, chance: Tensor) -> Tensor:
    """Log-probability of counts out of a number of trials.

    Args:
        count: float64, any shape.
        trials: number of trials.
        chance: probability, in the same shape.
    """
    quiet = trials - count
    ways = math.lgamma(trials + 1) - torch.lgamma(count + 1) - torch.lgamma(quiet + 1)
    return safe_xlogy(count, chance) + safe_xlogy(quiet, 1 - chance) + ways


def steps_log_prob(path: StepCounts, chances: StepProbabilities, periods: int) -> Tensor:
    """Log-probability of drawn steps, up to a constant in the light.

    Args:
        path: drawn steps, (..., T, H, W).
        chances: probabilities of the steps.
        periods: number of independent periods.

    Returns:
        (..., H, W).
    """
    total = torch.zeros_like(chances.fire.select(TIME, 0))
    if path.begin is not None and chances.begin is not None:
        dead = periods - path.begin.sum(TIME)  # all period long
        total = total + safe_xlogy(path.begin, chances.begin).sum(TIME)
        total = total + safe_xlogy(dead, 1 - chances.begin.sum(TIME))
    for hits, trials, chance in (
        (path.fired, path.armed, chances.fire),
        (path.soon, path.back, chances.soon),
        (path.late, path.counts, chances.late),
    ):
        steps = safe_xlogy(hits, chance) + safe_xlogy(trials - hits, 1 - chance)
        total = total + steps.sum(TIME)
    return total


# ------------------------------------------------------------------------------------------------------ draws of cycles


@dataclass(frozen=True)
class CycleSteps:
    """Means and step probabilities of a cycle, columns (N, P, 1) of pieces."""

    armed: Tensor
    count: Tensor
    back: Tensor  # armed again in the piece
    chances: StepProbabilities
    pieces: int  # of a bin


@dataclass(frozen=True)
class DrawnCycles:
    """Steps of rows (indices; None: all) whose bins are cut in `pieces` for the means."""

    rows: Tensor | None
    pieces: int
    path: StepCounts


def _delay(x: Tensor, by: int) -> Tensor:
    """Rows (P, N) shifted to later pieces."""
    return torch.nn.functional.pad(x, (by, 0))[..., : x.shape[-1]]


def columns_of(x: Tensor) -> Tensor:
    """Return rows (P, N) as columns (N, P, 1), with time as the third dimension from behind.

    Args:
        x: the rows.
    """
    return x.T.unsqueeze(-1)


def _merged_pieces(pieces: int, whole: int) -> int:
    """Number of pieces drawn as one, at most a dead time."""
    wider = min(_MOST_MERGED, pieces, whole)
    while pieces % wider:
        wider -= 1
    return wider


def _merge_states(states: Tensor, part: float, whole: int, wider: int) -> tuple[Tensor, Tensor, Tensor]:
    """Detections (N, P), armed at the start (N, P) and late ones (N + 1, P, first row 0) of merged pieces."""
    count, slope, armed = states[1:, 1], states[1:, 2], states[:-1, 0]
    late = torch.zeros_like(states[:, 1])
    if part:
        soon = (1 - part) * count - (ROOT3 * (1 - part) * part) * slope
        torch.minimum((count - soon).clamp_min_(0), count, out=late[1:])
    if wider == 1:
        return count, armed, late
    shape = (-1, wider, count.shape[1])
    fine = late[1:].reshape(shape)
    place = torch.arange(wider, device=count.device).view(-1, 1) + whole % wider
    soon = (count.reshape(shape) - fine) * (place >= wider)
    late = (soon + fine * (place + 1 >= wider)).sum(1)
    return count.reshape(shape).sum(1), armed[::wider], torch.nn.functional.pad(late, (0, 0, 1, 0))


def _cycle_steps(rate: Tensor, dead_bins: Tensor, pieces: int) -> CycleSteps:
    """Steps of rates (P, T) per cycle and bin, differentiable."""
    cycle = cycle_means(rate, dead_bins, pieces)
    wider = _merged_pieces(pieces, cycle.whole)
    shape = (rate.shape[0], -1, wider)
    fine_late = cycle.late
    place = torch.arange(wider, device=rate.device) + cycle.whole % wider
    soon = (cycle.count - fine_late).view(shape) * (place >= wider)
    late = (soon + fine_late.view(shape) * (place + 1 >= wider)).sum(-1)
    count, armed, whole = cycle.count.view(shape).sum(-1), cycle.armed.view(shape)[..., 0], cycle.whole // wider
    flux = (rate * (wider / pieces)).repeat_interleave(pieces // wider, -1)
    back = _delay(count - late, whole) + _delay(late, whole + 1)
    flux, count, armed, late, back = map(columns_of, (flux, count, armed, late, back))
    chances = step_probabilities(flux, count, armed, late, back, None, whole)
    return CycleSteps(armed, count, back, chances, pieces // wider)


def _sum_pieces(counts: Tensor, pieces: int) -> Tensor:
    """Columns (N, P, 1) of pieces -> rows (P, T) of bins."""
    return counts.view(-1, pieces, counts.shape[1]).sum(1).T


def sample_cycles(rate: Tensor, dead_bins: Tensor, cycles: int, generator: torch.Generator | None) -> Tensor:
    """Draw counts of `cycles` cycles, without the steps that a score needs.

    Args:
        rate: (T, P) per cycle and bin, float64.
        dead_bins: dead time in bins, scalar float64.
        cycles: number of cycles.
        generator: source of randomness.

    Returns:
        (T, P) float64.
    """
    counts = torch.empty_like(rate)
    with torch.no_grad():
        for columns, scan in detection_scans(rate, dead_bins):
            drawn = _sample_scan(scan, cycles, generator)
            counts[:, columns] = drawn.view(scan.bins, -1, scan.columns).sum(1) if len(drawn) > scan.bins else drawn
    return counts


def _sample_scan(scan: DetectionScan, cycles: int, generator: torch.Generator | None) -> Tensor:
    """Counts (N, P) of merged pieces."""
    wider = _merged_pieces(scan.pieces, scan.whole)
    count, armed, late = _merge_states(scan.forward(), scan.part, scan.whole, wider)
    size, whole, pieces = count.shape[0], scan.whole // wider, scan.pieces // wider
    counts = torch.empty_like(count)
    able = torch.full_like(count[0], float(cycles))
    some_later = scan.part > 0 or scan.whole % wider > 0
    waits = count.new_zeros(size + 1 if some_later else 1, count.shape[1])  # of the detections of the piece before
    for begin, end in scan.blocks(wider):
        flux = scan.rate[begin // pieces : end // pieces] / pieces
        fire = -torch.expm1(-(flux.repeat_interleave(pieces, 0) if pieces > 1 else flux))
        after = max(begin, whole)
        soon = fire[:0]
        if after < end:
            ago = slice(after - whole, end - whole)
            back = count[ago] - late[1:][ago] + late[ago]
            own = fire[after - begin :]
            chances = firing_probabilities(own, count[after:end], armed[after:end], back)
            fire, soon = torch.cat([fire[: after - begin], chances[0]]), chances[1]
        later = bounded_ratio(late[begin + 1 : end + 1], count[begin:end]) if some_later else soon
        # what comes back in as many pieces as a dead time has was detected before them: drawn for all at once
        for low in range(begin, end, whole):
            high, first = min(low + whole, end), max(low, whole)
            ago = slice(first - whole, max(high, first) - whole)
            back = counts[ago]
            if some_later:
                back = back - waits[1:][ago] + waits[ago]
            again = torch.binomial(back, soon[first - after : first - after + len(back)], generator=generator)
            _draw_pieces(counts[low:high], able, fire[low - begin : high - begin], back, again, generator)
            seen = min(high, size - whole)  # later ones are not back in this cycle
            if some_later and low < seen:
                waits[low + 1 : seen + 1] = halve(counts[low:seen], later[low - begin : seen - begin], generator)
    return counts


def _draw_pieces(
    counts: Tensor,
    able: Tensor,
    fire: Tensor,
    back: Tensor,
    again: Tensor,
    generator: torch.Generator | None,
) -> None:
    """Draw counts (L, P) of consecutive pieces and update the cycles (P,) that are `able` to fire, in place.

    `back`: cycles rearmed in the last pieces; `again`: those of them that fire in the piece they are rearmed in.
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


def draw_cycle_steps(
    rate: Tensor, dead_bins: Tensor, cycles: int, generator: torch.Generator | None
) -> tuple[Tensor, list[DrawnCycles]]:
    """Draw counts of `cycles` cycles with the steps that led to them, without gradient.

    Args:
        rate: (P, T) per cycle and bin, float64.
        dead_bins: dead time in bins, scalar float64.
        cycles: number of cycles.
        generator: source of randomness.

    Returns:
        Counts (P, T) float64, and the steps for `cycles_log_prob`.
    """
    counts, drawn = torch.zeros_like(rate), []
    with torch.no_grad():
        for rows, pieces in rows_by_subdivision(rate, float(dead_bins)):
            own = rate if rows is None else rate[rows]
            steps = _cycle_steps(own, dead_bins, pieces)
            path = draw_steps(steps.chances, cycles, generator)
            counts = _replace_rows(counts, rows, _sum_pieces(path.counts, steps.pieces))
            drawn.append(DrawnCycles(rows, pieces, path))
    return counts, drawn


def _replace_rows(into: Tensor, rows: Tensor | None, values: Tensor) -> Tensor:
    return values if rows is None else into.index_copy(0, rows, values)


def cycles_log_prob(drawn: list[DrawnCycles], rate: Tensor, dead_bins: Tensor, cycles: int) -> Tensor:
    """Log-probability of drawn steps of cycles, up to a constant in the light.

    Args:
        drawn: steps, by rows of one subdivision.
        rate: (P, T), per cycle and bin.
        dead_bins: dead time in bins.
        cycles: number of cycles.

    Returns:
        (P,).
    """
    total = torch.zeros_like(rate[:, 0])
    for one in drawn:
        own = rate if one.rows is None else rate[one.rows]
        chances = _cycle_steps(own, dead_bins, one.pieces).chances
        total = _replace_rows(total, one.rows, steps_log_prob(one.path, chances, cycles).flatten())
    return total


def normal_cycles(rate: Tensor, dead_bins: Tensor, cycles: int, generator: torch.Generator | None) -> Tensor:
    """Draw normal counts with mean and covariance of the draws, differentiable in rate and dead time.

    Binomial steps of independent cycles: each adds its own noise, that of the mean number it draws from. Means are
    linear in the steps, so that the covariance is exact.

    Args:
        rate: (P, T), per cycle and bin.
        dead_bins: dead time in bins.
        cycles: number of cycles.
        generator: source of randomness.

    Returns:
        (P, T).
    """
    counts = torch.zeros_like(rate)
    for rows, pieces in rows_by_subdivision(rate, float(dead_bins)):
        own = rate if rows is None else rate[rows]
        steps = _cycle_steps(own, dead_bins, pieces)
        noisy = cycles * steps.count + _noise(steps, cycles, generator)
        counts = _replace_rows(counts, rows, _sum_pieces(noisy, steps.pieces))
    return counts


def _noise(steps: CycleSteps, cycles: int, generator: torch.Generator | None) -> Tensor:
    """Noise (N, P, 1) of the counts of pieces, carried through the steps."""
    chances = steps.chances

    def noise(number: Tensor, chance: Tensor) -> tuple[Tensor, ...]:
        return gaussian_noise(cycles * number * chance * (1 - chance), generator).unbind(0)

    own = [noise(steps.armed, chances.fire), noise(steps.back, chances.soon), noise(steps.count, chances.late)]
    # piece by piece, in the order of the steps
    added: Iterator[Tensor] = itertools.chain.from_iterable(zip(*own, strict=True))

    def draw(number: Tensor, chance: Tensor, _: torch.Generator | None) -> Tensor:
        return chance * number + next(added)

    return draw_steps(chances, 0, generator, draw).counts


# --------------------------------------------------------------------------------------------- from counts to the light


@dataclass(frozen=True)
class ArmedCycles:
    """Cycles, rows (P, L) float64: armed at the start of bins, and inflow in them, (P, 4, L) or None."""

    armed: Tensor
    back: Tensor | None
    part: Tensor

    @property
    def cycles(self) -> Tensor:
        """Cycles that can fire in the bin, (P, L)."""
        return self.armed if self.back is None else self.armed + _rearmed(self.back, self.part)

    def survivors(self, rate: Tensor) -> tuple[Tensor, Tensor]:
        """Cycles that do not fire in the bin at `rate`, and minus the derivative of that number."""
        left = self.armed * torch.exp(-rate)
        if self.back is None:
            return left, left
        first = 1 - self.part
        near, over = moments(rate * first), moments(rate)
        inner = first * near.decay[0], first**2 * near.decay[1], first**3 * second_moment(rate * first)
        whole = (*over.decay, second_moment(rate))
        c, s, old_c, old_s = self.back.unbind(1)

        def still(k: int) -> Tensor:
            rest = whole[k] - inner[k], whole[k + 1] - inner[k + 1]
            young = (2 * first - 1) * inner[k] - 2 * inner[k + 1]
            old = (2 * first + 1) * rest[0] - 2 * rest[1]
            return inner[k] * c + ROOT3 * young * s + rest[0] * old_c + ROOT3 * old * old_s

        return left + still(0), left + still(1)


def _rearmed(back: Tensor, part: Tensor) -> Tensor:
    """Number (P, L) of rearmed cycles."""
    c, s, old_c, old_s = back.unbind(1)
    first = 1 - part
    return first * c + part * old_c - ROOT3 * first * part * (s - old_s)


def _invert_rows(counts: Tensor, cycles: float, dead_bins: float) -> tuple[ArmedCycles, Tensor, Tensor]:
    """Armed cycles, share of them that fired, and the rate that explains it, for counts (P, T)."""
    dead = torch.as_tensor(dead_bins, dtype=torch.float64, device=counts.device)
    whole, part = split_dead_time(dead)
    blocks = DeadTimeBlocks(counts.shape[-1], whole, 1)
    left = torch.full_like(counts[:, :1], float(cycles))
    columns: list[tuple[Tensor, ...]] = []
    for begin, end in blocks.stretches():
        n, back = counts[:, begin:end], blocks.inflow(end - begin)
        change = -n if back is None else _rearmed(back, part) - n
        after = left + change.cumsum(-1)
        # a fraction of a cycle that rounding or noise puts below none
        here = ArmedCycles(torch.cat([left, after[:, :-1]], -1).clamp_min(0), back, part)
        left = after[:, -1:]
        share = n / torch.where(here.cycles > 0.5, here.cycles, torch.ones_like(n))
        r = _solve_rate(here, share, cycles)
        bins = bin_response(r, part)
        slope = here.armed * bins.slope
        if back is not None:
            slope = slope + (bins.hit_slope * back).sum(1)
        blocks.append(n, slope)
        all_back = back if back is not None else n.new_zeros(n.shape[0], 4, n.shape[1])
        columns.append((here.armed, all_back, share, r))
    armed, backs, shares, rates = (torch.cat(c, -1) for c in zip(*columns, strict=True))
    return ArmedCycles(armed, backs, part), shares, rates


def _solve_rate(here: ArmedCycles, share: Tensor, cycles: float) -> Tensor:
    """Rate at which `share` of the cycles fires, by Newton from below; differentiable once."""
    trials = here.cycles
    usable = ~(trials <= 0.5)  # NaN stays NaN
    trials = torch.where(usable, trials, torch.ones_like(trials))
    share = share.clamp(0, 1 - 1 / (2 * cycles))
    armed = torch.where(usable, here.armed, trials)
    back = None if here.back is None else here.back * usable.unsqueeze(1)
    here, target = ArmedCycles(armed, back, here.part), trials.log() + torch.log1p(-share)

    def better(rate: Tensor) -> Tensor:
        value, fall = here.survivors(rate)
        # the slope belongs to a rate that is a number here
        return rate + (value.clamp_min(1e-300).log() - target) * (value / fall).detach()

    rate = -torch.log1p(-share.detach())
    with torch.no_grad():
        for _ in range(_MOST_STEPS if here.back is not None else 0):
            last, rate = rate, better(rate).clamp(0, _BRIGHTEST)
            if not bool(((rate - last).abs() > _SETTLED * (1 + rate)).any()):
                break
    found = torch.where(rate < _BRIGHTEST, better(rate), rate)
    # none fired: no rate but rounding, which falls away with its derivative left
    return torch.where(share > 0, found, found - found.detach())


def coates_of_rows(counts: Tensor, cycles: float, dead_bins: float) -> tuple[Tensor, Tensor]:
    """Rate per cycle and bin behind a histogram of several detections per cycle (Coates, with dead time).

    Args:
        counts: (P, T) float64.
        cycles: number of cycles.
        dead_bins: dead time in bins, at least 1.

    Returns:
        Rate (P, T) float64, and a mask (P, T) of bins where counts tell it.

    Raises:
        UnitError: for a dead time below one bin.
    """
    if check_dead_bins(dead_bins) < 1 - 1e-9:
        raise UnitError(
            f"coates: expected a dead time of at least one bin, got {dead_bins:g} bins. Use narrower bins to undo it."
        )
    counts = once(counts)
    here, share, rate = _invert_rows(counts, cycles, dead_bins)
    dead = torch.as_tensor(dead_bins, dtype=torch.float64, device=counts.device)
    last = torch.zeros_like(rate)
    for _ in range(_CORRECTIONS):
        # in a flood the histogram tells little, and the cost of looking closer has no end
        seen = rate.nan_to_num(0.0).clamp_max(_FLOOD)
        missed = cycles * (mean_detections(seen.T, dead).T - cycle_means(seen, dead, 1, None).count)
        missed = missed.clamp(-_LARGEST_CORRECTION * counts, _LARGEST_CORRECTION * counts)
        if not bool(((missed - last).abs() > 1e-10 * counts).any()):
            break
        last = missed
        here, share, rate = _invert_rows(counts - missed, cycles, dead_bins)
    usable = ~(here.cycles <= 0.5)
    valid = usable & (share <= 1 - 1 / (2 * cycles)) & (rate < _BRIGHTEST)
    return torch.where(usable, rate, torch.zeros_like(rate)), valid


@dataclass(frozen=True)
class ExposedCycles:
    """Cycles that could fire in a bin, float64: armed at its start, and rearmed in it for parts of it."""

    armed: Tensor
    joined: tuple[Tensor, Tensor]  # from the end of the dead time of detections `whole` bins ago, and of one bin more
    remaining: tuple[float, float]  # of the bin, on average, when they join
    second: tuple[float, float]  # mean of the square of it

    @property
    def exposed(self) -> Tensor:
        """Cycles times the share of the bin for which they could fire."""
        young, old = (number * mean for number, mean in zip(self.joined, self.remaining, strict=True))
        return self.armed + young + old

    def short_exposures(self, rate: Tensor) -> Tensor:
        """Correction to `exposed` times the rate for short exposures, which saturate less.

        Of rearmed cycles a share h(r) fires at the rate r, and h(r) / (1 - exp(-r)) rises from the mean `remaining` to
        1; returned is the integral of that rise, taken as a r / (1 + b r) with its true slope and limit.
        """
        total = torch.zeros_like(rate)
        for number, mean, second in zip(self.joined, self.remaining, self.second, strict=True):
            a = (mean - second) / 2
            if a > 1e-12:
                b = a / (1 - mean)
                total = total + number * (a / b) * (rate - torch.log1p(b * rate) / b)
        return total


def armed_time(counts: Tensor, cycles: int, dead_bins: float) -> ExposedCycles:
    """Exposed cycles from a histogram alone, linear in it, detections taken as even inside a bin.

    Args:
        counts: (..., T, H, W).
        cycles: number of cycles.
        dead_bins: dead time in bins.
    """
    check_dead_bins(dead_bins)
    whole, rest = split_dead_time(torch.tensor(dead_bins, dtype=torch.float64))
    part = float(rest)
    first, bins = 1 - part, counts.shape[TIME]
    n = counts.to(torch.float64)
    upto = n.cumsum(TIME)

    def ago(x: Tensor, by: int) -> Tensor:
        if by >= bins or not x.numel():  # torch 2.6 pads nothing that is empty
            return torch.zeros_like(x)
        return torch.nn.functional.pad(x, (0, 0, 0, 0, by, 0)).narrow(TIME, 0, bins)

    armed = cycles - (upto - n) + first * ago(upto, whole + 1) + part * ago(upto, whole + 2)
    return ExposedCycles(
        armed,
        (first * ago(n, whole), part * ago(n, whole + 1)),
        (first / 2, (1 + first) / 2),
        (first**2 / 3, (1 + first + first**2) / 3),
    )


def check_cycles(quiet: Tensor, cycles: int, least: float, where: str) -> None:
    """Check that the detections of each bin leave enough armed cycles.

    Args:
        quiet: armed cycles that did not fire.
        cycles: number of cycles, for errors.
        least: least number that has to be left.
        where: name of the caller, for errors.

    Raises:
        UnitError: for fewer.
    """
    if bool((quiet < least).any()):
        raise UnitError(
            f"{where}: expected counts of at most {cycles} cycles, got a pixel with more detections "
            "than armed cycles. Check cycles and the dead time."
        )
