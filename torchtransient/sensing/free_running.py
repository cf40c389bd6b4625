"""A SPAD that runs free of the laser: dead time carries over from one period to the next.

Non-paralyzable (a photon during the dead time is ignored): the stationary distribution of a Markov chain, see
`renewal_chain`. Paralyzable (a photon during the dead time prolongs it): closed form, a photon counts if none came
before it for as long as the dead time.

Sources: Rapp, Ma, Dawson, Goyal, Dead time compensation for high-flux ranging, IEEE TSP 67 (2019); Gupta et al.,
Asynchronous single-photon 3D imaging, ICCV 2019.
"""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor, nn

from torchtransient.axes import TimeAxis
from torchtransient.errors import UnitError
from torchtransient.sensing.draws import check_rates, sample_multinomial
from torchtransient.sensing.layout import TIME, bin_width_of, check_count, check_seconds, check_transient
from torchtransient.sensing.policies import GradPolicy
from torchtransient.sensing.renewal_chain import RenewalChain, stationary_phases
from torchtransient.sensing.running_sums import split_dead_time
from torchtransient.sensing.sensor import RandomSensor
from torchtransient.sensing.time_convolution import check_choice

DeadTime = Literal["non_paralyzable", "paralyzable"]


def free_running_rate(rate_hz: Tensor, dead_time_s: float, kind: DeadTime = "non_paralyzable") -> Tensor:
    """Detections per second at a constant photon rate n: n/(1 + n td), or n exp(-n td) for "paralyzable"."""
    dead = check_seconds(dead_time_s, "dead_time_s", "free_running_rate")
    check_choice(kind, DeadTime, "kind", "free_running_rate")
    if kind == "paralyzable":
        return rate_hz * torch.exp(-rate_hz * dead)
    return rate_hz / (1 + rate_hz * dead)


def nonparalyzable_histogram(rate: Tensor, dead_bins: Tensor | float) -> Tensor:
    """Expected detections per period and bin of a free-running detector in its stationary state.

    `rate`: (..., C, T, H, W) photons (times efficiency) per period and bin; the T bins are one whole period.
    `dead_bins`: dead time in bins, at least 1/2, also longer than a period; a number or a scalar tensor, in which the
    result is differentiable (once; piecewise smooth). dtype and device of `rate` are kept; computed in float64. Exact
    to second order in the rate of a bin: use bins that hold less than about 0.2 photons, or narrower ones.
    """
    check_transient(rate, "nonparalyzable_histogram")
    check_rates(rate, "nonparalyzable_histogram")
    if rate.numel() == 0:
        return rate.clone()
    whole, part = split_dead_time(dead_bins)
    bins = rate.shape[TIME]
    columns = rate.to(torch.float64).movedim(TIME, -1)
    rows = columns.reshape(-1, bins)
    part = part.to(rows.device)
    # a dark pixel has no phases; its limit is one photon, at most, per many periods: detections equal photons
    faint = rows.detach().sum(-1, keepdim=True) < 1e-12
    safe = torch.where(faint, torch.full_like(rows, 1.0 / bins), rows)
    pi = stationary_phases(safe, part, whole)
    chain = RenewalChain(safe, whole, part)
    # armed and dead probability add up to the same number at every bin; normalise it to 1
    armed = chain.armed(chain.shift(pi)).mean(-1, keepdim=True)
    dead = pi.sum(-1, keepdim=True) * (whole - 1 + part) / bins
    detected = torch.where(faint, rows, pi / (armed + dead))
    return detected.view(columns.shape).movedim(-1, TIME).to(rate.dtype)


def _mean_of_exponentials(start: Tensor, step: Tensor) -> Tensor:
    """Mean of exp(-x) over x from `start` to `start + step`, of either sign: finite wherever both ends are >= 0.

    Counted from the smaller end, so that no factor overflows where the other one is 0.
    """
    low = torch.where(step < 0, start + step, start)
    width = step.abs()
    small = width < 1e-4
    safe = torch.where(small, torch.ones_like(width), width)
    return torch.exp(-low) * torch.where(small, 1 - width / 2 + width**2 / 6, -torch.expm1(-safe) / safe)


def paralyzable_histogram(rate: Tensor, dead_bins: Tensor | float) -> Tensor:
    """Expected detections per period and bin when every photon, counted or not, starts the dead time anew.

    Integral over the bin of n(t) exp(-flux of the dead time before t), exact for rates that are constant in a bin.
    `rate`: (..., C, T, H, W) per period and bin, the T bins being one period; `dead_bins`: dead time in bins, >= 0,
    also longer than a period; differentiable in both. dtype and device are kept; computed in float64.
    """
    check_transient(rate, "paralyzable_histogram")
    dead = torch.as_tensor(dead_bins, dtype=torch.float64, device=rate.device)
    if not float(dead.detach()) >= 0 or not math.isfinite(float(dead.detach())):
        raise UnitError(f"paralyzable_histogram: expected dead_bins >= 0, got {float(dead.detach()):g}.")
    wide = rate.to(torch.float64)
    bins = wide.shape[TIME]
    whole = math.floor(float(dead.detach()))
    part = dead - whole
    # flux between the start of the bin minus the dead time and the start of the bin
    total = wide.sum(TIME, keepdim=True)
    cycles, rest = divmod(whole, bins)
    edges = torch.cat([torch.zeros_like(total), wide.cumsum(TIME)], TIME)
    before = edges.narrow(TIME, 0, bins)
    earlier = before.roll(rest, TIME)
    index = torch.arange(bins, device=rate.device).view(-1, 1, 1)
    wrapped = torch.where(index < rest, before - earlier + total, before - earlier) + cycles * total
    # the bin in which the dead time before the start of this bin begins, and the one after it
    first, second = wide.roll(rest + 1, TIME), wide.roll(rest, TIME)
    exponent = wrapped + part * first
    # while the bin passes, the window's rear edge is in `first` for the share `part`, then in `second`
    slope_1, slope_2 = wide - first, wide - second
    early = part * _mean_of_exponentials(exponent, part * slope_1)
    late = (1 - part) * _mean_of_exponentials(exponent + part * slope_1, (1 - part) * slope_2)
    return (wide * (early + late)).to(rate.dtype)


def _chain_counts(
    rate: Tensor, detected: Tensor, periods: int, dead_bins: float, generator: torch.Generator | None
) -> Tensor:
    """`periods` detectors in their stationary state, each run over one period: counts, float64."""
    whole, part = split_dead_time(dead_bins)
    share = part.to(rate.device)
    bins = rate.shape[TIME]
    fire = -torch.expm1(-rate)
    # who of the detectors that are dead at the start is armed again at the start of bin k: detections of bin k - whole
    # (or one earlier) before the period began
    again = torch.zeros_like(rate)
    reach = min(whole, bins)
    again.narrow(TIME, 0, reach).copy_((1 - share) * detected.roll(whole, TIME).narrow(TIME, 0, reach))
    reach = min(whole + 1, bins)
    again.narrow(TIME, 0, reach).add_(share * detected.roll(whole + 1, TIME).narrow(TIME, 0, reach))
    # armed and dead at the start of a bin are everybody: armed before bin 0 = 1 - dead(before any re-arms at 0)
    hit_chance = torch.where(fire > 0, detected / fire.clamp_min(1e-300), torch.zeros_like(fire)).select(TIME, 0)
    dead = detected.sum(TIME) * (whole - 1 + share)
    armed_now = torch.where(fire.select(TIME, 0) > 0, hit_chance, 1 - dead).clamp(0, 1)
    states = torch.cat([armed_now.unsqueeze(TIME), again.narrow(TIME, 1, bins - 1)], TIME)
    drawn = sample_multinomial(periods, states, generator)
    armed = drawn.select(TIME, 0)
    returning = list(drawn.unbind(TIME)[1:]) + [torch.zeros_like(armed)] * (whole + 2)
    counts = torch.empty_like(rate)
    for k in range(bins):
        hit = torch.binomial(armed, fire.select(TIME, k), generator=generator)
        later = torch.binomial(hit, share.expand_as(hit), generator=generator) if float(share) > 0 else hit * 0
        counts.select(TIME, k).copy_(hit)
        if k + 1 < bins:
            for delay, amount in ((whole, hit - later), (whole + 1, later)):
                slot = k + delay - 1  # returning[j] arms at the start of bin j + 1
                if slot < bins - 1:
                    returning[slot] = returning[slot] + amount
            armed = armed - hit + returning[k]
    return counts


class FreeRunningSPAD(RandomSensor):
    """Histogram (..., C, T, H, W) over laser phase, in counts, of a SPAD that runs free for `cycles` laser periods.

    The input is the rate per period and bin of a detector that is never dead; its T bins are one whole laser period.
    `dead_time_s`: at least half a bin, also longer than the period; `kind`: "non_paralyzable" or "paralyzable";
    `learnable` keeps log(dead time) as a parameter `log_dead_time_s`.

    Samples: non-paralyzable, `cycles` detectors in their stationary state are run over one period each: mean and
    correlations within a period are right, those between periods (they lower the variance of totals further when the
    dead time is about a period or longer) are left out. Paralyzable: independent binomials with the exact mean and
    N d (1 - d) as variance. Policies: expected, gaussian (independent bins, that variance), straight_through; "score"
    is not supported: the stationary state itself depends on the rate.
    """

    log_dead_time_s: Tensor

    def __init__(
        self,
        cycles: int,
        dead_time_s: float,
        *,
        axis: TimeAxis | None = None,
        bin_width_s: float | None = None,
        kind: DeadTime = "non_paralyzable",
        learnable: bool = False,
        grad: GradPolicy = "expected",
    ) -> None:
        super().__init__(grad)
        self.cycles = check_count(cycles, "cycles", "FreeRunningSPAD")
        check_choice(kind, DeadTime, "kind", "FreeRunningSPAD")
        self.kind: DeadTime = kind
        self.bin_width_s = bin_width_of(axis, bin_width_s, "FreeRunningSPAD")
        dead = check_seconds(dead_time_s, "dead_time_s", "FreeRunningSPAD", open_low=True)
        if kind == "non_paralyzable":
            split_dead_time(dead / self.bin_width_s)  # says what is wrong with a dead time that is too short
        value = torch.tensor(math.log(dead), dtype=torch.float64)
        if learnable:
            self.register_parameter("log_dead_time_s", nn.Parameter(value))
        else:
            self.register_buffer("log_dead_time_s", value)

    @property
    def dead_time_s(self) -> Tensor:
        """Dead time in seconds, float64."""
        return self.log_dead_time_s.double().exp()

    def probabilities(self, x: Tensor) -> Tensor:
        """Expected detections per period and bin."""
        dead_bins = self.dead_time_s / self.bin_width_s
        if self.kind == "paralyzable":
            return paralyzable_histogram(x, dead_bins)
        return nonparalyzable_histogram(x, dead_bins)

    def expected(self, x: Tensor) -> Tensor:
        return self.probabilities(x) * self.cycles

    def variance(self, x: Tensor) -> Tensor:
        p = self.probabilities(x)
        variance: Tensor = self.cycles * p * (1 - p)
        return variance

    def sample(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        with torch.no_grad():
            wide = x.detach().double()
            p = self.probabilities(check_rates(wide, "FreeRunningSPAD"))
            if self.kind == "paralyzable":
                return torch.binomial(torch.full_like(p, float(self.cycles)), p, generator=generator).to(x.dtype)
            dead_bins = float(self.dead_time_s) / self.bin_width_s
            return _chain_counts(wide, p, self.cycles, dead_bins, generator).to(x.dtype)

    def extra_repr(self) -> str:
        dead = float(self.dead_time_s.detach())
        return f"cycles={self.cycles}, dead_time_s={dead:g}, kind={self.kind!r}, {super().extra_repr()}"
