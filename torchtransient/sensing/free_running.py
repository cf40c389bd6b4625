"""A SPAD that runs free of the laser: dead time carries over from one period to the next.

Non-paralyzable (a photon during the dead time is ignored): the stationary distribution of a Markov chain, see
`sensing.dead_time.renewal`. Paralyzable (a photon during the dead time prolongs it): closed form, a photon counts if
none came before it for as long as the dead time.

Sources: Rapp, Ma, Dawson, Goyal, Dead time compensation for high-flux ranging, IEEE TSP 67 (2019); Gupta et al.,
Asynchronous single-photon 3D imaging, ICCV 2019.
"""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.errors import GradientError, UnitError
from torchtransient.floating import in_single
from torchtransient.sensing.checks import (
    TIME,
    bins_from,
    check_bins,
    check_choice,
    check_count,
    check_seconds,
    check_tensor,
    one_number,
    reals,
)
from torchtransient.sensing.dead_time.clocked_counts import (
    StepProbabilities,
    binomial_log_prob,
    draw_steps,
    steps_log_prob,
)
from torchtransient.sensing.dead_time.free_running import (
    FreeRunningState,
    sample_trains,
    stationary_state,
    stationary_steps,
)
from torchtransient.sensing.dead_time.renewal import check_dead_bins, split_dead_time
from torchtransient.sensing.draws import check_rates
from torchtransient.sensing.parameters import keep_number
from torchtransient.sensing.sensor import VARIANCE_FLOOR, GradPolicy, RandomSensor, record_score

DeadTime = Literal["non_paralyzable", "paralyzable"]
_SIDE_BY_SIDE = 1 << 10  # detectors drawn at a time


@in_single
def free_running_rate(rate_hz: Tensor, dead_time_s: float, kind: DeadTime = "non_paralyzable") -> Tensor:
    """Detections per second in constant light: n / (1 + n td), or n exp(-n td) for a paralyzable detector.

    Args:
        rate_hz: photon rate n times efficiency, any shape.
        dead_time_s: dead time td in seconds.
        kind: "non_paralyzable" or "paralyzable".

    Returns:
        Shape of `rate_hz`, in Hz.

    Raises:
        UnitError: for rates that are negative, infinite or NaN.
    """
    dead = check_seconds(dead_time_s, "dead_time_s", "free_running_rate")
    check_choice(kind, DeadTime, "kind", "free_running_rate")
    (rate_hz,) = reals("free_running_rate", rate_hz=rate_hz)
    check_rates(rate_hz, "free_running_rate")
    if kind == "paralyzable":
        return rate_hz * torch.exp(-rate_hz * dead)
    return rate_hz / (1 + rate_hz * dead)


def state_image(rate: Tensor, dead_bins: Tensor | float) -> FreeRunningState:
    """Stationary state for rates, in the same layout.

    Args:
        rate: rate per period and bin, (..., T, H, W).
        dead_bins: dead time in bins.
    """
    if rate.numel() == 0:
        empty = rate.to(torch.float64)
        return FreeRunningState(empty, empty, empty, split_dead_time(torch.as_tensor(dead_bins))[0])
    wide = rate.to(torch.float64).movedim(TIME, -1)
    dead = torch.as_tensor(dead_bins, dtype=torch.float64, device=rate.device)
    rows = stationary_state(wide.reshape(-1, wide.shape[-1]), dead)

    def image(value: Tensor) -> Tensor:
        return value.view(wide.shape).movedim(-1, TIME)

    return FreeRunningState(image(rows.detected), image(rows.armed), image(rows.late), rows.whole)


@in_single
def nonparalyzable_histogram(rate: Tensor, dead_bins: Tensor | float) -> Tensor:
    """Expected detections per period and bin of a free-running detector in its stationary state.

    Photons arrive at a constant rate inside a bin, any number of them; dead times are exact to fractions of a bin.
    Exact in constant light and for dead times of whole periods, otherwise third order in the rate of a bin (errors:
    docs/photon_counting.md). Computed in float64; differentiable once, also in `dead_bins` (piecewise smooth).

    Args:
        rate: photons (times efficiency) per period and bin, (..., C, T, H, W), T bins being one period.
        dead_bins: dead time in bins, at least 1/2, also longer than a period; a number or scalar tensor.

    Returns:
        Shape, dtype and device of `rate`.

    Raises:
        UnitError: for rates that are negative, infinite or NaN, and for dead times below half a bin.
        TorchTransientError: for a phase locked so narrowly that bins cut in 32 do not show it.
    """
    check_rates(check_bins(rate, "nonparalyzable_histogram"), "nonparalyzable_histogram")
    check_dead_bins(dead_bins)
    return state_image(rate, dead_bins).detected.to(rate.dtype)


def _mean_of_exponentials(start: Tensor, step: Tensor) -> Tensor:
    """Mean of exp(-x) over x from `start` to `start + step`, of either sign.

    Counted from the smaller end, so that no factor overflows where the other one is 0.
    """
    back = step < 0
    low = torch.where(back, start + step, start)
    # Not its magnitude, whose slope is 0 for a step of 0, as in constant light.
    width = torch.where(back, -step, step)
    small = width < 1e-4
    safe = torch.where(small, torch.ones_like(width), width)
    return torch.exp(-low) * torch.where(small, 1 - width / 2 + width**2 / 6, -torch.expm1(-safe) / safe)


@in_single
def paralyzable_histogram(rate: Tensor, dead_bins: Tensor | float) -> Tensor:
    """Expected detections per period and bin when every photon, counted or not, starts the dead time anew.

    Integral over the bin of n(t) exp(-flux of the dead time before t), exact for rates that are constant in a bin.
    Computed in float64; differentiable in both arguments.

    Args:
        rate: rate per period and bin, (..., C, T, H, W), T bins being one period.
        dead_bins: dead time in bins, >= 0, also longer than a period; a number or scalar tensor.

    Returns:
        Shape, dtype and device of `rate`.

    Raises:
        UnitError: for rates or dead times that are negative, infinite or NaN.
    """
    check_rates(check_bins(rate, "paralyzable_histogram"), "paralyzable_histogram")
    dead_bins = one_number(dead_bins, "dead_bins", "paralyzable_histogram")
    dead = torch.as_tensor(dead_bins, dtype=torch.float64, device=rate.device)
    if not 0 <= float(dead.detach()) < math.inf:
        raise UnitError(f"paralyzable_histogram: expected dead_bins >= 0, got {float(dead.detach()):g}.")
    wide = rate.to(torch.float64)
    bins = wide.shape[TIME]
    whole = math.floor(float(dead.detach()))
    part = dead - float(whole)
    # flux between the start of the bin minus the dead time and the start of the bin
    total = wide.sum(TIME, keepdim=True)
    cycles, rest = divmod(whole, bins)
    edges = torch.cat([torch.zeros_like(total), wide.cumsum(TIME)], TIME)
    before = edges.narrow(TIME, 0, bins)
    earlier = before.roll(rest, TIME)
    index = torch.arange(bins, device=rate.device).view(-1, 1, 1)
    wrapped = torch.where(index < rest, before - earlier + total, before - earlier) + float(cycles) * total
    # the bin in which the dead time before the start of this bin begins, and the one after it
    first, second = wide.roll(rest + 1, TIME), wide.roll(rest, TIME)
    exponent = wrapped + part * first
    # while the bin passes, the window's rear edge is in `first` for the share `part`, then in `second`
    slope_1, slope_2 = wide - first, wide - second
    early = part * _mean_of_exponentials(exponent, part * slope_1)
    late = (1 - part) * _mean_of_exponentials(exponent + part * slope_1, (1 - part) * slope_2)
    return (wide * (early + late)).to(rate.dtype)


class FreeRunningSPAD(RandomSensor):
    """SPAD that runs free for `cycles` laser periods: histogram (..., C, T, H, W) over laser phase, in counts.

    The input is the rate per period and bin of a detector that is never dead; its T bins are one laser period.

    Non-paralyzable draws are one detector over all `cycles` periods, from its stationary state on. Up to a thousand
    detections, and near resonance (dead time and wait make up a period or a part of one), they go event by event;
    beyond, they have means and correlations inside a period of the chain of detections, and correlations between
    periods (which make totals up to hundreds of times less variable in saturation) of its central limit theorem.
    Rounding to integers adds up to a quarter of a count^2 to the variance of a total; the cost does not grow with
    `cycles`. Paralyzable draws are independent binomials with the exact mean and N d (1 - d) as variance: totals of a
    real detector vary less, down to a quarter (variance over mean 0.28 for 0.84 at 1.3 photons a dead time, 0.33 for
    0.98 at 0.6 with longer ones).

    All policies. "gaussian": normal numbers with the covariance of the draws (paralyzable: independent bins), whose
    size is differentiated as that of independent bins. "score": that of `cycles` independent periods; its draws lack
    the correlations between periods. `variance` is that of single bins, N d (1 - d): right to a few per cent up to ten
    photons per period, 0.5 to 1.3 times the true one at a hundred.

    Args:
        cycles: laser periods.
        dead_time_s: dead time in seconds, at least one bin ("paralyzable": any), also longer than the period.
        axis: time axis, or
        bin_width_s: bin width in seconds.
        kind: "non_paralyzable" or "paralyzable".
        learnable: make log(dead time) a parameter `log_dead_time_s`.
        grad: gradient policy.

    Raises:
        UnitError: for a dead time below one bin.
        ShapeError: for light with another T.
        TorchTransientError: for a phase that is remembered over more than four million detections.
    """

    takes, gives, window_is_period = ("rate",), "counts", True

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
        self.trains = 1  # detectors alike that share the cycles, of a pixel of several: see `several_of`
        check_choice(kind, DeadTime, "kind", "FreeRunningSPAD")
        self.kind: DeadTime = kind
        self.bin_width_s, self.num_bins = bins_from(axis, bin_width_s, "FreeRunningSPAD")
        dead = check_seconds(dead_time_s, "dead_time_s", "FreeRunningSPAD", open_low=True)
        if kind == "non_paralyzable":
            self._check_dead_time(dead)
        value = torch.tensor(math.log(dead), dtype=torch.float64)
        keep_number(self, "log_dead_time_s", value, learnable)

    @property
    def dead_time_s(self) -> Tensor:
        """Dead time in seconds, float64."""
        return self.log_dead_time_s.double().exp()

    @property
    def _dead_bins(self) -> Tensor:
        return self.dead_time_s / self.bin_width_s

    def probabilities(self, x: Tensor) -> Tensor:
        """Expected detections per period and bin.

        Args:
            x: rate per period and bin, (..., C, T, H, W).
        """
        if self.kind == "paralyzable":
            return paralyzable_histogram(x, self._dead_bins)
        return nonparalyzable_histogram(x, self._dead_bins)

    def expected(self, x: Tensor) -> Tensor:
        return self.probabilities(x) * self.cycles

    def variance(self, x: Tensor) -> Tensor:
        p = self.probabilities(x)
        return self.cycles * p * (1 - p).clamp_min(0)  # rounding

    def _check_dead_time(self, dead_time_s: float) -> None:
        if not dead_time_s / self.bin_width_s >= 1 - 1e-9:
            raise UnitError(
                f"FreeRunningSPAD: expected dead_time_s of at least one bin of {self.bin_width_s:g} s, got "
                f"{dead_time_s:g} s. Use narrower bins, or no dead time (ShotNoise) where it does not matter."
            )

    def _rate(self, x: Tensor) -> Tensor:
        """Light of draws, float64."""
        return check_rates(check_tensor(x, "FreeRunningSPAD").double(), "FreeRunningSPAD")

    def _steps(self, rate: Tensor) -> StepProbabilities:
        """Steps of independent periods of the non-paralyzable detector."""
        return stationary_steps(rate, state_image(rate, self._dead_bins))

    def _train(self, x: Tensor, generator: torch.Generator | None, normal: bool) -> Tensor:
        """Counts of the non-paralyzable detector over consecutive periods."""
        with torch.no_grad():
            self._check_dead_time(float(self.dead_time_s))
            rate = self._rate(x)
            if rate.numel() == 0:
                return x.clone()
            wide = rate.movedim(TIME, -1)
            rows = wide.reshape(-1, wide.shape[-1])
            dead, periods = self._dead_bins.to(rate.device), self.cycles // self.trains
            counts, left = torch.zeros_like(rows), self.trains
            while left:  # several rows of one light side by side: few pixels cost as much as one
                number = min(left, max(1, _SIDE_BY_SIDE // rows.shape[0]))
                found = sample_trains(rows.repeat(number, 1), dead, periods, generator, normal=normal)
                counts, left = counts + found.view(number, *rows.shape).sum(0), left - number
            return counts.view(wide.shape).movedim(-1, TIME).to(x.dtype)

    def gaussian(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        if self.kind == "paralyzable":
            return super().gaussian(x, generator)
        drawn, mean = self._train(x, generator, normal=True), self.expected(x)
        width = (self.variance(x) + VARIANCE_FLOOR).sqrt()
        return mean + (drawn - mean.detach()) * (width / width.detach())

    def sample(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        if self.kind == "non_paralyzable":
            return self._train(x, generator, normal=False)
        with torch.no_grad():
            p = self.probabilities(self._rate(x))
            return torch.binomial(torch.full_like(p, float(self.cycles)), p, generator=generator).to(x.dtype)

    def log_prob(self, measurement: Tensor, x: Tensor) -> Tensor:
        if self.kind == "non_paralyzable":
            raise GradientError(
                "FreeRunningSPAD.log_prob: expected kind 'paralyzable'; a histogram does not tell which detectors were "
                "dead when the period began. Use grad='score', which scores the draws themselves."
            )
        p = self.probabilities(x.double())
        return binomial_log_prob(measurement.double(), self.cycles, p).sum(TIME)

    def forward(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        if self.grad != "score" or self.kind == "paralyzable":
            return super().forward(x, generator)
        with torch.no_grad():
            self._check_dead_time(float(self.dead_time_s))
            path = draw_steps(self._steps(self._rate(x)), self.cycles, generator)
        record_score(lambda: steps_log_prob(path, self._steps(x.double()), self.cycles), type(self).__name__)
        return path.counts.to(x.dtype)
