"""Draws of detectors over one period, bin by bin, and how probable they were."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchtransient.sensing.base.layout import TIME
from torchtransient.sensing.dead_time.free_running_state import FreeRunningState
from torchtransient.sensing.numerics.draws import sample_multinomial


@dataclass(frozen=True)
class BinChances:
    """Probabilities of every step of a run through the bins of a period, (..., T, H, W)."""

    # bin 0: armed at the start; then (T + 1 in all) dead at the start and armed again in bin 0, 1, ...; None: all armed
    begin: Tensor | None
    fire: Tensor  # detected in the bin, when armed at its start
    soon: Tensor  # detected in the bin, when armed again in it
    late: Tensor  # armed again after `whole` + 1 bins instead of `whole`, when detected
    whole: int


@dataclass(frozen=True)
class Path:
    """How many detectors took which step, same layout as BinChances."""

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
        return self.fired + self.soon


def share(part: Tensor, whole: Tensor) -> Tensor:
    """part / whole, 0 where nothing is, within [0, 1]."""
    some = whole > 1e-13
    share = part / torch.where(some, whole, torch.ones_like(whole))
    return torch.where(some, share, 0.0).clamp(0, 1)


def bin_chances(rate: Tensor, state: FreeRunningState) -> BinChances:
    """Chances whose run has the means of `state`, whose entries are (..., T, H, W) here, like `rate`."""
    bins, whole = rate.shape[TIME], state.whole
    early = state.detected - state.late
    back_soon, back_late = early.roll(whole, TIME), state.late.roll(whole + 1, TIME)
    back = back_soon + back_late
    index = torch.arange(bins, device=rate.device).view(-1, 1, 1)
    # detections of before the period
    dead = back_soon * (index < whole) + back_late * (index < whole + 1)
    begin = torch.cat([state.armed.narrow(TIME, 0, 1), dead], TIME)
    begin = begin / begin.sum(TIME, keepdim=True)  # rounding
    return step_chances(rate, state.detected, state.armed, state.late, back, begin, whole)


def step_chances(
    rate: Tensor, detected: Tensor, armed: Tensor, late: Tensor, back: Tensor, begin: Tensor | None, whole: int
) -> BinChances:
    """Of bins with these means; `back`: armed again in the bin."""
    fire, soon = step_shares(-torch.expm1(-rate), detected, armed, back)
    return BinChances(begin=begin, fire=fire, soon=soon, late=share(late, detected), whole=whole)


def step_shares(fire: Tensor, detected: Tensor, armed: Tensor, back: Tensor) -> tuple[Tensor, Tensor]:
    """Chances to be detected when armed at the start, nearly `fire`, and when armed again in the bin."""
    rest = detected - armed * fire
    # straight lines can put a little too much or too little here; one chance for both keeps the mean
    whole_chance = share(detected, armed + back)
    fits = (rest >= 0) & (rest <= back)
    return torch.where(fits, fire, whole_chance), torch.where(fits, share(rest, back), whole_chance)


def binomial_share(number: Tensor, chance: Tensor, generator: torch.Generator | None) -> Tensor:
    return torch.binomial(number, chance, generator=generator)


def normal_share(number: Tensor, chance: Tensor, generator: torch.Generator | None) -> Tensor:
    """Normal numbers with mean and variance of `binomial_share`."""
    z = torch.randn(number.shape, dtype=number.dtype, device=number.device, generator=generator)
    return number * chance + (number.clamp_min(0) * chance * (1 - chance)).sqrt() * z


def draw_path(
    chances: BinChances,
    periods: int,
    generator: torch.Generator | None,
    draw: Callable[[Tensor, Tensor, torch.Generator | None], Tensor] = binomial_share,
) -> Path:
    """`periods` detectors, each run over one period."""
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
    return Path(begin, steps[0], steps[1], steps[2], steps[3], steps[4], armed, steps[5], missed)


def log_likelihood(count: Tensor, chance: Tensor) -> Tensor:
    """count log(chance), 0 for no count whatever the chance."""
    return count * torch.log(torch.where(count != 0, chance, 1.0))


def path_log_prob(path: Path, chances: BinChances, periods: int) -> Tensor:
    """Log-probability (..., H, W) of the steps that were drawn, up to a number that does not depend on the light."""
    total = torch.zeros_like(chances.fire.select(TIME, 0))
    if path.begin is not None and chances.begin is not None:
        dead = periods - path.begin.sum(TIME)  # all period long
        total = total + log_likelihood(path.begin, chances.begin).sum(TIME)
        total = total + log_likelihood(dead, 1 - chances.begin.sum(TIME))
    for hits, trials, chance in (
        (path.fired, path.armed, chances.fire),
        (path.soon, path.back, chances.soon),
        (path.late, path.counts, chances.late),
    ):
        steps = log_likelihood(hits, chance) + log_likelihood(trials - hits, 1 - chance)
        total = total + steps.sum(TIME)
    return total
