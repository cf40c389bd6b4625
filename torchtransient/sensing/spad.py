"""A single-photon avalanche diode (SPAD) in step with the laser: first-photon pile-up, gates, several hits per cycle.

With `rate` the expected detections per cycle and bin of a detector that is never dead, the first photon of a cycle
falls into bin k with probability (1 - exp(-rate[k])) exp(-sum of the rates before). The histogram of N cycles is
multinomial. Sources: Coates, J. Phys. E 1 (1968); Gupta et al., Photon-flooded single-photon 3D cameras, CVPR 2019.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.errors import ShapeError, UnitError
from torchtransient.floating import in_single
from torchtransient.sensing.draws import check_rates, sample_first_photons
from torchtransient.sensing.layout import (
    TIME,
    bin_width_of,
    check_count,
    check_seconds,
    check_transient,
)
from torchtransient.sensing.policies import GradPolicy, gaussian_noise
from torchtransient.sensing.running_sums import (
    armed_cycles,
    detections_with_dead_time,
    split_dead_time,
    sum_before,
)
from torchtransient.sensing.sensor import RandomSensor


def _working(x: Tensor) -> Tensor:
    return x.float() if x.dtype in (torch.float16, torch.bfloat16) else x


@in_single
def first_photon_probabilities(rate: Tensor) -> tuple[Tensor, Tensor]:
    """Probability (..., C, T, H, W) that the first photon of a cycle falls into each bin, and (..., C, H, W) of none.

    `rate`: expected detections per cycle and bin, >= 0. Sums over bins are made in float64, in the exponent, so that
    1e4 bins lose no digits; in a saturated pixel the late bins get probability and gradient 0, as they should.
    """
    check_transient(rate, "first_photon_probabilities")
    work = _working(rate)
    before = sum_before(work)
    p = -torch.expm1(-work) * torch.exp(-before.to(work.dtype))
    none = torch.exp(-(before.select(TIME, -1) + work.select(TIME, -1).double()))
    return p.to(rate.dtype), none.to(rate.dtype)


class CoatesEstimate(NamedTuple):
    """`rate`: detections per cycle and bin; `valid`: bool, where cycles were still armed and not all of them fired."""

    rate: Tensor
    valid: Tensor


@in_single
def coates(counts: Tensor, cycles: int, dead_bins: float | None = None) -> CoatesEstimate:
    """Undo pile-up: rate[k] = -log(1 - counts[k] / cycles still armed at k). The maximum likelihood estimate.

    `counts`: (..., C, T, H, W) detections of `cycles` cycles; `dead_bins`: dead time in bins for several detections per
    cycle, None for one. Where no cycle was armed any more the rate is 0, where every armed one fired it is that of a
    share 1 - 1/(2 cycles); both are marked not valid. Differentiable in `counts`. dtype and device are kept.
    """
    check_transient(counts, "coates")
    number = check_count(cycles, "cycles", "coates")
    armed = armed_cycles(counts, number, dead_bins)
    usable = ~(armed <= 0.5)  # NaN stays NaN
    safe = torch.where(usable, armed, torch.ones_like(armed))
    share = torch.where(usable, counts.to(torch.float64) / safe, torch.zeros_like(armed))
    highest = 1 - 1 / (2 * number)
    valid = usable & (share <= highest)
    return CoatesEstimate((-torch.log1p(-share.clamp(0, highest))).to(counts.dtype), valid)


@in_single
def sample_detections(
    rate: Tensor, cycles: int, dead_bins: float | None = None, generator: torch.Generator | None = None
) -> Tensor:
    """A histogram of `cycles` cycles, without gradient, in the shape and dtype of `rate` (..., C, T, H, W).

    `dead_bins` None: one detection per cycle, multinomial by a tree of binomials. Else bin by bin: of the armed cycles
    a binomial share fires, and those that fired are armed again after the dead time (a fractional number of bins is
    met on average, by a binomial share that takes one bin more).
    """
    check_transient(rate, "sample_detections")
    number = check_count(cycles, "cycles", "sample_detections")
    rate = rate.detach()
    if dead_bins is None:
        return sample_first_photons(number, _working(rate), generator).to(rate.dtype)
    check_rates(rate, "sample_detections")
    whole, part = split_dead_time(dead_bins)
    share = part.to(rate.device)
    fire = -torch.expm1(-rate.to(torch.float64))
    bins = rate.shape[TIME]
    armed = torch.full_like(fire.select(TIME, 0), float(number))
    returning = [torch.zeros_like(armed) for _ in range(bins + whole + 2)]
    counts = torch.empty_like(fire)
    for k in range(bins):
        armed = armed + returning[k]
        hit = torch.binomial(armed, fire.select(TIME, k), generator=generator)
        later = torch.binomial(hit, share.expand_as(hit), generator=generator) if float(share) > 0 else hit * 0
        counts.select(TIME, k).copy_(hit)
        returning[k + whole] = returning[k + whole] + (hit - later)
        returning[k + whole + 1] = returning[k + whole + 1] + later
        armed = armed - hit
    return counts.to(rate.dtype)


def multinomial_noise(probabilities: Tensor, trials: int, generator: torch.Generator | None = None) -> Tensor:
    """Normal noise with the covariance of multinomial counts, trials (diag p - p p^T), differentiable in p."""
    z = gaussian_noise(trials * probabilities, generator)
    none = 1 - probabilities.sum(TIME, keepdim=True)
    rest = gaussian_noise(trials * none, generator)
    return z - probabilities * (z.sum(TIME, keepdim=True) + rest)


class SynchronousSPAD(RandomSensor):
    """Histogram (..., C, T, H, W), in counts, of `cycles` laser cycles from detections per cycle and bin.

    The input is the rate of an always-armed detector: signal, ambient light and dark counts, as `PhotonBudget` gives
    it. `gate`: (T,) profile between 0 and 1 that multiplies the rate (bins before the gate opens do not pile up).
    `dead_time_s` with `axis` or `bin_width_s`: several detections per cycle, the detector being armed at the start of
    each; without it, the first photon of a cycle is the only one (dead until the next cycle).

    Policies: all four. The normal surrogate has the covariance of the multinomial (with a dead time: independent bins
    with variance N d (1 - d)). The score is exact, with a dead time if dead time/bin width + 1/2 is whole, else it
    takes the re-arming of a share of cycles on average. Afterpulses and crosstalk are modules of their own, behind.
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
            self.bin_width_s = bin_width_of(axis, bin_width_s, "SynchronousSPAD")
        self.num_bins = None if axis is None else axis.num_bins
        self.dead_time_s = dead_time_s
        self.dead_bins: float | None = None
        if dead_time_s is not None:
            dead = check_seconds(dead_time_s, "dead_time_s", "SynchronousSPAD")
            self.dead_bins = dead / bin_width_of(axis, bin_width_s, "SynchronousSPAD")
            split_dead_time(self.dead_bins)  # says what is wrong with a dead time that is too short
        if gate is not None:
            if not isinstance(gate, Tensor) or gate.ndim != 1:
                shape = tuple(gate.shape) if isinstance(gate, Tensor) else type(gate).__name__
                raise ShapeError(f"SynchronousSPAD: expected gate to be a tensor (T,), got {shape}.")
            if not bool(((gate >= 0) & (gate <= 1)).all()):
                raise UnitError("SynchronousSPAD: expected gate values between 0 and 1.")
            gate = gate.detach().double()
        self.register_buffer("gate", gate)

    def _gated(self, x: Tensor) -> Tensor:
        check_transient(x, "SynchronousSPAD")
        if self.gate is None:
            return x
        if self.gate.shape[0] != x.shape[TIME]:
            raise ShapeError(f"SynchronousSPAD: expected T = {self.gate.shape[0]} as in gate, got {x.shape[TIME]}.")
        return x * self.gate.to(x.dtype).view(-1, 1, 1)

    @in_single
    def probabilities(self, x: Tensor) -> Tensor:
        """Expected detections per cycle and bin, after pile-up."""
        rate = self._gated(x)
        if self.dead_bins is None:
            return first_photon_probabilities(rate)[0]
        return detections_with_dead_time(rate, self.dead_bins).to(x.dtype)

    def expected(self, x: Tensor) -> Tensor:
        return self.probabilities(x) * self.cycles

    def variance(self, x: Tensor) -> Tensor:
        p = self.probabilities(x)
        variance: Tensor = self.cycles * p * (1 - p)
        return variance

    def gaussian(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        if self.dead_bins is not None:
            return super().gaussian(x, generator)
        p = self.probabilities(x)
        return p * self.cycles + multinomial_noise(p, self.cycles, generator)

    def sample(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return sample_detections(self._gated(x), self.cycles, self.dead_bins, generator)

    def log_prob(self, measurement: Tensor, x: Tensor) -> Tensor:
        return first_photon_log_prob(measurement, self._gated(x), self.cycles, self.dead_bins).sum(TIME)

    def inverse(self, counts: Tensor) -> CoatesEstimate:
        """The rate behind a histogram (`coates`), divided by the gate; bins where the gate is shut are not valid."""
        estimate = coates(counts, self.cycles, self.dead_bins)
        if self.gate is None:
            return estimate
        gate = self.gate.to(counts.dtype).view(-1, 1, 1)
        is_open = gate > 0
        rate = torch.where(is_open, estimate.rate / gate.clamp_min(1e-12), torch.zeros_like(estimate.rate))
        return CoatesEstimate(rate, estimate.valid & is_open)

    def extra_repr(self) -> str:
        return f"cycles={self.cycles}, dead_time_s={self.dead_time_s}, {super().extra_repr()}"


@in_single
def first_photon_log_prob(
    counts: Tensor,
    rate: Tensor,
    cycles: int,
    dead_bins: float | None = None,
    *,
    constant: bool = True,
    where: str = "first_photon_log_prob",
) -> Tensor:
    """Log-probability of every bin given the bins before: binomial(armed cycles, 1 - exp(-rate)). (..., C, T, H, W).

    Its sum over time is that of the histogram. `constant` False leaves the binomial coefficient out, which does not
    depend on the rate. Concave in the rate. Values and gradients are finite wherever counts are possible; a count at
    rate 0 has log-probability -inf. Raises UnitError, in the name of `where`, when the counts need more than `cycles`
    cycles.
    """
    number = check_count(cycles, "cycles", where)
    armed = armed_cycles(counts.detach(), number, dead_bins)
    n, r = counts.to(torch.float64), rate.to(torch.float64)
    quiet = armed - n
    # with a fractional dead time the armed cycles are known on average only
    whole = dead_bins is None or float(split_dead_time(dead_bins)[1]) < 1e-6
    if bool((quiet < (-0.5 if whole else -0.5 - 6 * number**0.5)).any()):
        raise UnitError(
            f"{where}: expected counts of at most {number} cycles, got a pixel with more detections "
            "than armed cycles. Check cycles and the dead time."
        )
    quiet = quiet.clamp_min(0)
    hit = n != 0
    # where on the input: the logarithm of 0 has no finite gradient
    fire = torch.where(hit, -torch.expm1(-r), torch.ones_like(r))
    value = torch.where(hit, n * fire.log(), torch.zeros_like(r)) - r * quiet
    if constant:
        value = value + torch.lgamma(n + quiet + 1) - torch.lgamma(n + 1) - torch.lgamma(quiet + 1)
    return value.to(rate.dtype)
