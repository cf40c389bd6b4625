"""Back from the histogram of cycles with several detections to the light, or to how probable it was, bin by bin.

The counts say who was dead. Where in its bin a detection lay they do not say; that is as in `dead_time_cycle`, with
uncut bins: the mean of a bin given those before it, exact to third order in the photons of a bin. For the estimate,
what uncut bins miss is put right by the difference of both means.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchtransient.errors import UnitError
from torchtransient.sensing.base.layout import TIME
from torchtransient.sensing.dead_time.dead_time_cycle import BlockWalk, check_dead_bins, cycle_of_rows, whole_and_part
from torchtransient.sensing.dead_time.dead_time_means import detected_columns
from torchtransient.sensing.dead_time.renewal_chain import bin_response
from torchtransient.sensing.numerics.exponential_moments import moments, second_moment

_ROOT = math.sqrt(3.0)
_MOST_STEPS = 40
_SETTLED = 1e-12
_BRIGHTEST = 500.0  # photons in a bin: beyond, no histogram tells how many
_ROUNDS = 8  # of what uncut bins miss, put right
_FARTHEST = 0.1  # of the counts
_FLOOD = 30.0


@dataclass(frozen=True)
class ArmedCounts:
    """Cycles, rows (P, L), float64: armed at the start of the bins, and what comes back in them, (P, 4, L) or None."""

    armed: Tensor
    back: Tensor | None
    part: Tensor

    @property
    def cycles(self) -> Tensor:
        """That can fire in the bin."""
        return self.armed if self.back is None else self.armed + _number(self.back, self.part)

    def survivors(self, rate: Tensor) -> tuple[Tensor, Tensor]:
        """Of `cycles`: not fired in the bin, and how that falls with the rate."""
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
            return inner[k] * c + _ROOT * young * s + rest[0] * old_c + _ROOT * old * old_s

        return left + still(0), left + still(1)


def _number(back: Tensor, part: Tensor) -> Tensor:
    c, s, old_c, old_s = back.unbind(1)
    first = 1 - part
    return first * c + part * old_c - _ROOT * first * part * (s - old_s)


def _check_uncut(dead_bins: float, where: str) -> None:
    """UnitError for a dead time below one bin: the histogram does not tell what happened inside a bin."""
    if check_dead_bins(dead_bins) < 1 - 1e-9:
        raise UnitError(
            f"{where}: expected a dead time of at least one bin, got {dead_bins:g} bins. Use narrower bins to undo it."
        )


def _walked(counts: Tensor, cycles: float, dead_bins: float) -> tuple[ArmedCounts, Tensor, Tensor]:
    """(armed cycles, share of them that fired, rate that explains it) for rows (P, T)."""
    dead = torch.as_tensor(dead_bins, dtype=torch.float64, device=counts.device)
    whole, part = whole_and_part(dead)
    walk = BlockWalk(counts.shape[-1], whole, 1)
    left = torch.full_like(counts[:, :1], float(cycles))
    columns: list[tuple[Tensor, ...]] = []
    for begin, end in walk.stretches():
        n, back = counts[:, begin:end], walk.inflow(end - begin)
        change = -n if back is None else _number(back, part) - n
        after = left + change.cumsum(-1)
        # a fraction of a cycle that rounding or noise puts below none
        here = ArmedCounts(torch.cat([left, after[:, :-1]], -1).clamp_min(0), back, part)
        left = after[:, -1:]
        share = n / torch.where(here.cycles > 0.5, here.cycles, torch.ones_like(n))
        r = _explained(here, share, cycles)
        bins = bin_response(r, part)
        slope = here.armed * bins.slope
        if back is not None:
            slope = slope + (bins.hit_slope * back).sum(1)
        walk.keep(n, slope)
        all_back = back if back is not None else n.new_zeros(n.shape[0], 4, n.shape[1])
        columns.append((here.armed, all_back, share, r))
    armed, backs, shares, rates = (torch.cat(c, -1) for c in zip(*columns, strict=True))
    return ArmedCounts(armed, backs, part), shares, rates


def _explained(here: ArmedCounts, share: Tensor, cycles: float) -> Tensor:
    """The rate at which `share` of the cycles fire, by Newton's method from below; differentiable once."""
    trials = here.cycles
    usable = ~(trials <= 0.5)  # NaN stays NaN
    trials = torch.where(usable, trials, torch.ones_like(trials))
    share = share.clamp(0, 1 - 1 / (2 * cycles))
    armed = torch.where(usable, here.armed, trials)
    back = None if here.back is None else here.back * usable.unsqueeze(1)
    here, target = ArmedCounts(armed, back, here.part), trials.log() + torch.log1p(-share)

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


def rates_of_counts(counts: Tensor, cycles: float, dead_bins: float) -> tuple[Tensor, Tensor]:
    """Rows (P, T), float64: the rate per cycle and bin, and where the counts tell it."""
    _check_uncut(dead_bins, "coates")
    here, share, rate = _walked(counts, cycles, dead_bins)
    dead = torch.as_tensor(dead_bins, dtype=torch.float64, device=counts.device)
    last = torch.zeros_like(rate)
    for _ in range(_ROUNDS):
        with torch.no_grad():
            # in a flood the histogram tells little, and the cost of looking closer has no end
            seen = rate.nan_to_num(0.0).clamp_max(_FLOOD)
            missed = cycles * (detected_columns(seen.T, dead).T - cycle_of_rows(seen, dead, 1, None).count)
            missed = missed.clamp(-_FARTHEST * counts, _FARTHEST * counts)
            settled = not bool(((missed - last).abs() > 1e-10 * counts).any())
        if settled:
            break
        last = missed
        here, share, rate = _walked(counts - missed, cycles, dead_bins)
    usable = ~(here.cycles <= 0.5)
    valid = usable & (share <= 1 - 1 / (2 * cycles)) & (rate < _BRIGHTEST)
    return torch.where(usable, rate, torch.zeros_like(rate)), valid


@dataclass(frozen=True)
class ArmedTime:
    """Cycles that could fire in a bin, float64, any layout: armed at its start, and joining in it for parts of it."""

    armed: Tensor
    joined: tuple[Tensor, Tensor]  # from the end of the dead time of detections `whole` bins ago, and of one bin more
    remaining: tuple[float, float]  # of the bin, on average, when they join
    second: tuple[float, float]  # mean of the square of it

    @property
    def exposed(self) -> Tensor:
        """Cycles times the share of the bin for which they could fire."""
        young, old = (number * mean for number, mean in zip(self.joined, self.remaining, strict=True))
        return self.armed + young + old

    def sooner(self, rate: Tensor) -> Tensor:
        """What those that join count for beyond their share of the bin, times the rate: short stays saturate less.

        Of those that join and fire at the rate r a share h(r), and h(r) / (1 - exp(-r)) rises from the mean `remaining`
        to 1; the integral of that rise, taken as a r / (1 + b r) with its true slope and limit.
        """
        total = torch.zeros_like(rate)
        for number, mean, second in zip(self.joined, self.remaining, self.second, strict=True):
            a = (mean - second) / 2
            if a > 1e-12:
                b = a / (1 - mean)
                total = total + number * (a / b) * (rate - torch.log1p(b * rate) / b)
        return total


def armed_time(counts: Tensor, cycles: int, dead_bins: float) -> ArmedTime:
    """From the histogram (..., T, H, W) alone, linear in it; detections are taken to be even inside a bin."""
    check_dead_bins(dead_bins)
    whole, rest = whole_and_part(torch.tensor(dead_bins, dtype=torch.float64))
    part = float(rest)
    first, bins = 1 - part, counts.shape[TIME]
    n = counts.to(torch.float64)
    upto = n.cumsum(TIME)

    def ago(x: Tensor, by: int) -> Tensor:
        if by >= bins or not x.numel():  # torch 2.6 pads nothing that is empty
            return torch.zeros_like(x)
        return torch.nn.functional.pad(x, (0, 0, 0, 0, by, 0)).narrow(TIME, 0, bins)

    armed = cycles - (upto - n) + first * ago(upto, whole + 1) + part * ago(upto, whole + 2)
    return ArmedTime(
        armed,
        (first * ago(n, whole), part * ago(n, whole + 1)),
        (first / 2, (1 + first) / 2),
        (first**2 / 3, (1 + first + first**2) / 3),
    )


def check_cycles(quiet: Tensor, cycles: int, least: float, where: str) -> None:
    """UnitError when fewer than `least` armed cycles are left over by the detections of a bin."""
    if bool((quiet < least).any()):
        raise UnitError(
            f"{where}: expected counts of at most {cycles} cycles, got a pixel with more detections "
            "than armed cycles. Check cycles and the dead time."
        )
