"""A single-photon avalanche diode (SPAD) in step with the laser: first-photon pile-up, gates, several hits per cycle.

With `rate` the expected detections per cycle and bin of a detector that is never dead, the first photon of a cycle
falls into bin k with probability (1 - exp(-rate[k])) exp(-sum of the rates before). The histogram of N cycles is
multinomial. Sources: Coates, J. Phys. E 1 (1968); Gupta et al., Photon-flooded single-photon 3D cameras, CVPR 2019.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.errors import ShapeError, UnitError
from torchtransient.floating import holds, in_single
from torchtransient.sensing.checks import (
    TIME,
    bin_width_of,
    bins_from,
    check_bins,
    check_broadcast,
    check_count,
    check_seconds,
    check_transient,
    one_number,
    reals,
    refuse_cut_off,
)
from torchtransient.sensing.dead_time.clocked import mean_detections, second_detections
from torchtransient.sensing.dead_time.clocked_counts import (
    armed_time,
    check_cycles,
    coates_of_rows,
    cycles_log_prob,
    draw_cycle_steps,
    normal_cycles,
    sample_cycles,
)
from torchtransient.sensing.dead_time.renewal import check_dead_bins
from torchtransient.sensing.draws import WHOLE_FLOAT32, check_rates, sample_first_photons
from torchtransient.sensing.sensor import GradPolicy, RandomSensor, gaussian_noise, record_score
from torchtransient.sensing.time_convolution import sum_before


@in_single
def first_photon_probabilities(rate: Tensor) -> tuple[Tensor, Tensor]:
    """Probabilities of the first photon of a cycle: (1 - exp(-rate[k])) exp(-sum of the rates before).

    Sums over bins are made in float64, in the exponent, so that 1e4 bins lose no digits; in a saturated pixel the late
    bins have probability and gradient 0.

    Args:
        rate: expected detections per cycle and bin, (..., C, T, H, W).

    Returns:
        Probability of each bin (..., C, T, H, W), and of no photon (..., C, H, W).

    Raises:
        UnitError: for rates that are negative, infinite or NaN.
    """
    check_rates(check_bins(rate, "first_photon_probabilities"), "first_photon_probabilities")
    before = sum_before(rate)
    p = -torch.expm1(-rate) * torch.exp(-before.to(rate.dtype))
    none = torch.exp(-(before.select(TIME, -1) + rate.select(TIME, -1).double()))
    return p, none.to(rate.dtype)


class CoatesEstimate(NamedTuple):
    """Estimate of the light behind a histogram.

    ``rate``: detections per cycle and bin of a detector that is never dead, (..., C, T, H, W). ``valid``: mask of bins
    where cycles were still armed and not all of them fired.
    """

    rate: Tensor
    valid: Tensor


def _rows(x: Tensor) -> Tensor:
    """(..., T, H, W) -> rows (P, T), float64."""
    return x.to(torch.float64).movedim(TIME, -1).reshape(-1, x.shape[TIME])


def _image(rows: Tensor, like: Tensor) -> Tensor:
    """Rows (P, T) in the layout of `like`."""
    return rows.view(like.movedim(TIME, -1).shape).movedim(-1, TIME)


def _columns(x: Tensor) -> Tensor:
    """(..., T, H, W) -> columns (T, P), float64."""
    return x.to(torch.float64).movedim(TIME, 0).reshape(x.shape[TIME], -1)


def _of_columns(columns: Tensor, like: Tensor) -> Tensor:
    """Columns (T, P) in the layout of `like`."""
    return columns.view(like.movedim(TIME, 0).shape).movedim(0, TIME)


def detections_with_dead_time(rate: Tensor, dead_bins: Tensor | float) -> Tensor:
    """Expected detections per cycle and bin of a detector armed at the start of each cycle, with dead time.

    Exact for dead times of fractions of a bin; bins of more than a photon are cut. Total variation from the exact mean:
    below 1e-5 (docs/photon_counting.md). Differentiable to any order in both arguments.

    Args:
        rate: expected detections per cycle and bin of a detector that is never dead, (..., C, T, H, W), constant in a
            bin.
        dead_bins: non-paralyzable dead time in bins, at least 1/2; a number or scalar tensor.

    Returns:
        (..., C, T, H, W) float64.

    Raises:
        UnitError: for rates that are negative, infinite or NaN, and for dead times below half a bin.
    """
    check_bins(rate, "detections_with_dead_time")
    check_rates(rate, "detections_with_dead_time")
    check_dead_bins(dead_bins)
    dead = torch.as_tensor(dead_bins, dtype=torch.float64, device=rate.device)
    return _of_columns(mean_detections(_columns(rate), dead), rate)


@in_single
def coates(counts: Tensor, cycles: int, dead_bins: float | None = None) -> CoatesEstimate:
    """Undo pile-up by the maximum likelihood estimate of Coates: rate[k] = -log(1 - counts[k] / cycles still armed at
    k).

    With a dead time, cycles rearmed inside a bin count for as long as they are armed in it: the inverse of
    `detections_with_dead_time` (to 1e-6 in bins of up to 15 photons). Differentiable in `counts`, with a dead time
    once.

    Args:
        counts: detections, (..., C, T, H, W).
        cycles: number of cycles.
        dead_bins: dead time in bins, at least 1, for several detections per cycle; None for one.

    Returns:
        Rate in dtype and device of `counts`; 0 where no cycle was armed, that of a share 1 - 1/(2 cycles) where all
        fired, both not valid.

    Raises:
        UnitError: for a dead time below one bin.
    """
    check_transient(counts, "coates")
    number = check_count(cycles, "cycles", "coates")
    if dead_bins is not None and counts.numel():
        refuse_cut_off(dead_bins, "dead_bins", "coates")
        dead = float(one_number(dead_bins, "dead_bins", "coates"))
        rate, valid = coates_of_rows(_rows(counts), number, dead)
        return CoatesEstimate(_image(rate, counts).to(counts.dtype), _image(valid, counts))
    armed = number - sum_before(counts)
    usable = ~(armed <= 0.5)  # NaN stays NaN
    safe = torch.where(usable, armed, torch.ones_like(armed))
    share = torch.where(usable, counts.to(torch.float64) / safe, torch.zeros_like(armed))
    highest = 1 - 1 / (2 * number)
    valid = usable & (share <= highest)
    return CoatesEstimate((-torch.log1p(-share.clamp(0, highest))).to(counts.dtype), valid)


@in_single
def sample_detections(
    rate: Tensor, cycles: int, dead_bins: float | None = None, *, generator: torch.Generator | None = None
) -> Tensor:
    """Draw a histogram of `cycles` cycles, without gradient.

    One detection per cycle is multinomial, by a tree of binomials. With a dead time, bin by bin (or piece by piece
    where bins hold more than a photon), a binomial share of the armed cycles fires and is rearmed after the dead time.
    Means are those of `detections_with_dead_time`, correlations those of the cycles.

    Args:
        rate: expected detections per cycle and bin, (..., C, T, H, W).
        cycles: number of cycles.
        dead_bins: dead time in bins, at least 1/2; None for one detection per cycle.
        generator: source of randomness.

    Returns:
        Counts in shape and dtype of `rate`.

    Raises:
        UnitError: for rates that are negative, infinite or NaN, and for dead times below half a bin.
    """
    check_bins(rate, "sample_detections")
    number = check_count(cycles, "cycles", "sample_detections")
    rate = rate.detach()
    if dead_bins is None:
        return sample_first_photons(number, rate, generator)
    check_dead_bins(dead_bins)
    check_rates(rate, "sample_detections")
    dead = torch.as_tensor(dead_bins, dtype=torch.float64, device=rate.device)
    counts = sample_cycles(_columns(rate), dead, number, generator)
    return _of_columns(counts, rate).to(rate.dtype)


def multinomial_noise(probabilities: Tensor, trials: int, generator: torch.Generator | None = None) -> Tensor:
    """Draw normal noise with the covariance of multinomial counts, trials (diag p - p p^T), differentiable in p.

    Args:
        probabilities: (..., T, H, W).
        trials: number of trials.
        generator: source of randomness.
    """
    z = gaussian_noise(trials * probabilities, generator)
    none = 1 - probabilities.sum(TIME, keepdim=True)
    rest = gaussian_noise(trials * none, generator)
    return z - probabilities * (z.sum(TIME, keepdim=True) + rest)


class SynchronousSPAD(RandomSensor):
    """SPAD in step with the laser: histogram (..., C, T, H, W), in counts, of `cycles` cycles.

    The input is the rate of an always-armed detector per cycle and bin: signal, ambient light and dark counts, as
    `PhotonBudget` gives it. Without a dead time the first photon of a cycle is the only one; with one the detector is
    armed at the start of each cycle and fires several times (`detections_with_dead_time`).

    All policies. "gaussian" has the covariance of the cycles, between bins too; "score" is that of the draws, bin by
    bin. With a dead time `log_prob` is that of every bin given those before it, exact but for the place of detections
    in a bin. Afterpulses and crosstalk are modules of their own, behind.

    Args:
        cycles: number of laser cycles.
        gate: (T,) profile in [0, 1] that multiplies the rate; bins before the gate opens do not pile up.
        dead_time_s: dead time in seconds, with `axis` or `bin_width_s`; None for one detection per cycle.
        axis: time axis, or
        bin_width_s: bin width in seconds.
        grad: gradient policy.

    Raises:
        ShapeError: for a gate that is not (T,).
        UnitError: for gate values outside [0, 1], and dead times below half a bin.
    """

    takes, gives = ("rate",), "counts"

    gate: Tensor | None

    def __init__(
        self,
        cycles: int,
        *,
        gate: Tensor | None = None,
        dead_time_s: float | None = None,
        axis: TimeAxis | None = None,
        bin_width_s: float | None = None,
        grad: GradPolicy = "expected",
    ) -> None:
        super().__init__(grad)
        self.cycles = check_count(cycles, "cycles", "SynchronousSPAD")
        self.bin_width_s: float | None = None
        if axis is not None or bin_width_s is not None:
            self.bin_width_s, self.num_bins = bins_from(axis, bin_width_s, "SynchronousSPAD")
        self.dead_time_s: float | None = None
        self.dead_bins: float | None = None
        if dead_time_s is not None:
            self.dead_time_s = check_seconds(dead_time_s, "dead_time_s", "SynchronousSPAD")
            self.dead_bins = self.dead_time_s / bin_width_of(axis, bin_width_s, "SynchronousSPAD")
            check_dead_bins(self.dead_bins)
        if gate is not None:
            if gate.ndim != 1:
                raise ShapeError(f"SynchronousSPAD: expected gate to be a tensor (T,), got {tuple(gate.shape)}.")
            if not bool(((gate >= 0) & (gate <= 1)).all()):
                raise UnitError("SynchronousSPAD: expected gate values between 0 and 1.")
            gate = gate.detach().double()
        self.register_buffer("gate", gate)

    def _gated(self, x: Tensor) -> Tensor:
        check_bins(x, "SynchronousSPAD")
        if self.gate is None:
            return x
        if self.gate.shape[0] != x.shape[TIME]:
            raise ShapeError(f"SynchronousSPAD: expected T = {self.gate.shape[0]} as in gate, got {x.shape[TIME]}.")
        return x * self.gate.to(x.dtype).view(-1, 1, 1)

    def probabilities(self, x: Tensor) -> Tensor:
        """Expected detections per cycle and bin, after pile-up.

        Args:
            x: rate per cycle and bin, (..., C, T, H, W).
        """
        rate = self._gated(x)
        if self.dead_bins is None:
            return first_photon_probabilities(rate)[0]
        return detections_with_dead_time(rate, self.dead_bins).to(x.dtype)

    def expected(self, x: Tensor) -> Tensor:
        return self.probabilities(x) * self.cycles

    def variance(self, x: Tensor) -> Tensor:
        p = self.probabilities(x)
        variance = p * (1 - p)
        if self.dead_bins is not None and self.dead_bins < 1:
            # a cycle may fire twice in a bin
            dead = torch.as_tensor(self.dead_bins, dtype=torch.float64, device=x.device)
            variance = variance + 2 * _image(second_detections(_rows(self._gated(x)), dead), x).to(x.dtype)
        return variance * self.cycles

    def gaussian(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        if self.dead_bins is not None:
            rate = check_rates(self._gated(x), "SynchronousSPAD")
            dead = torch.as_tensor(self.dead_bins, dtype=torch.float64, device=x.device)
            return _image(normal_cycles(_rows(rate), dead, self.cycles, generator), x).to(x.dtype)
        p = self.probabilities(x)
        return p * self.cycles + multinomial_noise(p, self.cycles, generator)

    def sample(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return sample_detections(self._gated(x), self.cycles, self.dead_bins, generator=generator)

    def log_prob(self, measurement: Tensor, x: Tensor) -> Tensor:
        rate = check_rates(self._gated(x), "SynchronousSPAD")
        return first_photon_log_prob(measurement, rate, self.cycles, dead_bins=self.dead_bins).sum(TIME)

    def forward(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        if self.grad != "score" or self.dead_bins is None:
            return super().forward(x, generator)
        with torch.no_grad():
            rate = check_rates(self._gated(x), "SynchronousSPAD")
            dead = torch.as_tensor(self.dead_bins, dtype=torch.float64, device=x.device)
            counts, drawn = draw_cycle_steps(_rows(rate), dead, self.cycles, generator)

        def log_prob() -> Tensor:
            return cycles_log_prob(drawn, _rows(self._gated(x)), dead, self.cycles).view(x.select(TIME, 0).shape)

        record_score(log_prob, type(self).__name__)
        return _image(counts, x).to(x.dtype)

    def inverse(self, counts: Tensor) -> CoatesEstimate:
        """Rate behind a histogram (`coates`), divided by the gate; bins with a shut gate are not valid.

        Args:
            counts: (..., C, T, H, W).

        Raises:
            UnitError: for a dead time below one bin.
        """
        estimate = coates(counts, self.cycles, self.dead_bins)
        if self.gate is None:
            return estimate
        gate = self.gate.to(counts.dtype).view(-1, 1, 1)
        is_open = gate > 0
        rate = torch.where(is_open, estimate.rate / gate.clamp_min(1e-12), torch.zeros_like(estimate.rate))
        return CoatesEstimate(rate, estimate.valid & is_open)


def log_of_firing(rate: Tensor) -> Tensor:
    """Log-probability that an armed detector fires, log(1 - exp(-rate)), with all digits of dark and bright bins.

    Differentiable. Source: Maechler, Accurately computing log(1 - exp(-|a|)) (2012).

    Args:
        rate: tensor of any shape, >= 0; -inf at 0.
    """
    bright = rate > math.log(2)
    if not bool(bright.any()):  # as a rule: half the cost
        return (-torch.expm1(-rate)).log()
    half = torch.full_like(rate, 0.5)
    dark = torch.where(bright, half, rate)
    many = torch.where(bright, rate, 2 * half)
    return torch.where(bright, torch.log1p(-torch.exp(-many)), (-torch.expm1(-dark)).log())


def exposed_cycles(counts: Tensor, cycles: int, dead_bins: float | None) -> Tensor:
    """Cycles that could fire in each bin, times the part of it in which they could.

    Args:
        counts: (..., T, H, W).
        cycles: number of cycles.
        dead_bins: dead time in bins; None for one detection per cycle.

    Returns:
        (..., T, H, W) float64.
    """
    if dead_bins is None:
        return cycles - sum_before(counts)
    return armed_time(counts, cycles, float(dead_bins)).exposed


@in_single
def first_photon_log_prob(
    counts: Tensor,
    rate: Tensor,
    cycles: int,
    *,
    dead_bins: float | None = None,
    constant: bool = True,
    where: str = "first_photon_log_prob",
) -> Tensor:
    """Log-probability of every bin given the bins before: binomial(armed cycles, 1 - exp(-rate)).

    Its sum over time is that of the histogram; concave in the rate. With a dead time, cycles rearmed inside a bin count
    for the part of it in which they could fire: linear in the counts, greatest where the mean is right, to second order
    in the photons of a bin (the estimate of `coates` is closer). Values and gradients are finite wherever counts are
    possible; a count at rate 0 has log-probability -inf.

    Args:
        counts: detections, (..., C, T, H, W).
        rate: expected detections per cycle and bin, (..., C, T, H, W).
        cycles: number of cycles.
        dead_bins: dead time in bins; None for one detection per cycle.
        constant: include the binomial coefficient, which does not depend on the rate.
        where: name of the caller, for errors.

    Returns:
        (..., C, T, H, W) in the dtype of `rate`.

    Raises:
        ShapeError: for fewer than 3 dimensions, or shapes that do not broadcast.
        UnitError: for counts that need more than `cycles` cycles.
    """
    number = check_count(cycles, "cycles", where)
    (counts,), (rate,) = reals(where, torch.float64, counts=counts), reals(where, rate=rate)
    check_broadcast(where, counts=counts, rate=rate)
    if min(counts.ndim, rate.ndim) < 3:
        raise ShapeError(f"{where}: expected counts and rate (..., T, H, W), got {tuple(counts.shape)} and "
                         f"{tuple(rate.shape)}.")  # fmt: skip
    dead_bins = None if dead_bins is None else one_number(dead_bins, "dead_bins", where)
    n, r = counts.to(torch.float64), rate.to(torch.float64)
    if dead_bins is None:
        short, exposed = torch.zeros_like(r), number - sum_before(n)
    else:
        time = armed_time(n, number, float(dead_bins))
        short, exposed = time.short_exposures(r), time.exposed
    quiet = exposed - n
    # with a dead time the armed cycles are known on average only
    refuse_cut_off(dead_bins, "dead_bins", where)
    check_cycles(quiet, number, -0.5 if dead_bins is None else -0.5 - 6 * number**0.5, where)
    quiet = quiet.clamp_min(0)
    # where on the input: the logarithm of 0 has no finite gradient, and is of no count
    some = (n != 0) | (r >= torch.finfo(r.dtype).tiny)
    fire = log_of_firing(torch.where(some, r, 0.5))
    value = torch.where(some, n * fire, torch.zeros_like(r)) - r * quiet - short
    if constant:
        value = value + (torch.lgamma(n + quiet + 1) - torch.lgamma(n + 1) - torch.lgamma(quiet + 1))
    return value.to(rate.dtype)


# -------------------------------------------------------------------------------------------------------- binary frames


@in_single
def frames_to_rate(counts: Tensor, frames: int) -> Tensor:
    """Photons per frame from the number of frames that saw any: -log(1 - counts / frames). Differentiable.

    Args:
        counts: tensor of any shape.
        frames: number of frames.

    Returns:
        Shape of `counts`; for a pixel that fired in every frame the rate of a share 1 - 1/(2 frames).

    Raises:
        UnitError: for more counts than frames.
    """
    number = check_count(frames, "frames", "frames_to_rate")
    (counts,) = reals("frames_to_rate", counts=counts)
    # a normal surrogate goes beyond all frames by some standard deviations, of which half the root is the largest
    if not holds(~(counts > number + 1 + 3 * number**0.5)):
        raise UnitError(
            f"frames_to_rate: expected at most as many counts as the {number} frames, got {float(counts.max()):g}. "
            "Give the frames of the sensor that counted: BinaryFrames.frames."
        )
    # in double: 1 - 1/(2 frames) is 1 in single precision from 2^24 frames on
    return -torch.log1p(-(counts.double() / number).clamp(0, 1 - 1 / (2 * number))).to(counts.dtype)


class BinaryFrames(RandomSensor):
    """Quanta sensor: counts of binary frames that saw a photon, from the mean photons of one frame.

    Every bin along T is a gate or moment of its own, exposed `frames` times: independent binomials with probability 1 -
    exp(-mean). All four policies. Source: Fossum et al., Sensors 16 (2016).

    Args:
        frames: number of frames.
        grad: gradient policy.

    Input and output are (..., C, T, H, W).
    """

    takes, gives = ("electrons",), "counts"

    def __init__(self, frames: int, *, grad: GradPolicy = "expected") -> None:
        super().__init__(grad)
        self.frames = check_count(frames, "frames", "BinaryFrames")

    def expected(self, x: Tensor) -> Tensor:
        return self._probability(x) * self.frames

    def _probability(self, x: Tensor) -> Tensor:
        return -torch.expm1(-check_rates(check_transient(x, "BinaryFrames"), "BinaryFrames"))

    def variance(self, x: Tensor) -> Tensor:
        return self._probability(x) * torch.exp(-x) * self.frames

    def sample(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        check_transient(x, "BinaryFrames")
        # beyond 2^24 trials the variance of torch.binomial in float32 is 13 to 38 % too large
        exact = torch.float64 if self.frames > WHOLE_FLOAT32 or x.dtype == torch.float64 else torch.float32
        p = self._probability(x.detach().to(exact))
        return torch.binomial(torch.full_like(p, float(self.frames)), p, generator=generator).to(x.dtype)

    def log_prob(self, measurement: Tensor, x: Tensor) -> Tensor:
        n, r = measurement.double(), check_rates(x, "BinaryFrames").double()
        hit = n > 0
        fire = log_of_firing(torch.where(hit, r, 0.5))
        value = torch.where(hit, n * fire, torch.zeros_like(r)) - r * (self.frames - n)
        total = torch.lgamma(torch.tensor(self.frames + 1.0, dtype=torch.float64))
        value = value + (total - torch.lgamma(n + 1) - torch.lgamma(self.frames - n + 1))
        return value.sum(TIME).to(x.dtype)
