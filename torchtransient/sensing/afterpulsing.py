"""Detections that no photon made: afterpulses in time, crosstalk between pixels, hot pixels."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from torchtransient.axes import TimeAxis
from torchtransient.errors import UnitError
from torchtransient.sensing.draws import fast_poisson
from torchtransient.sensing.layout import (
    TIME,
    bin_width_of,
    check_number,
    check_seconds,
    check_transient,
)
from torchtransient.sensing.policies import (
    GradPolicy,
    gaussian_noise,
    record_score,
    straight_through,
)
from torchtransient.sensing.sensor import RandomSensor
from torchtransient.sensing.shot_noise import poisson_log_prob


class AddedCounts(RandomSensor):
    """A sensor that adds counts to those it is given: x + n with n Poisson of mean `extra(x)`. All four policies.

    The counts given pass with their own gradient under every policy. A Poisson number stands for the binomial thinning
    of single detections; its variance is larger by the probability of the effect (1 % of itself at 1 %).
    """

    def rough_extra(self, x: Tensor) -> Tensor:
        """`extra` as precisely as a draw needs it."""
        return self.extra(x)

    def extra(self, x: Tensor) -> Tensor:
        """Mean of the counts added, in the shape of `x`."""
        raise NotImplementedError(f"{type(self).__name__} has to define extra(x).")

    def expected(self, x: Tensor) -> Tensor:
        return x + self.extra(x)

    def variance(self, x: Tensor) -> Tensor:
        return self.extra(x)

    def sample(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        with torch.no_grad():
            return x.detach() + self._draw(self.rough_extra(x.detach()), generator)

    def _draw(self, mean: Tensor, generator: torch.Generator | None) -> Tensor:
        work = mean.detach().clamp_min(0)
        if work.dtype in (torch.float16, torch.bfloat16):
            work = work.float()
        return fast_poisson(work, generator).to(mean.dtype)

    def log_prob(self, measurement: Tensor, x: Tensor) -> Tensor:
        return poisson_log_prob((measurement - x).detach().clamp_min(0), self.extra(x)).sum(TIME)

    def forward(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        if self.grad == "expected":
            return self.expected(x)
        if self.grad != "gaussian" and not torch.is_grad_enabled():
            return self.sample(x, generator)
        mean = self.extra(x)
        if self.grad == "gaussian":
            return x + mean + gaussian_noise(mean, generator)
        added = self._draw(mean, generator)
        if self.grad == "straight_through":
            return x + straight_through(added, mean)
        record_score(lambda: poisson_log_prob(added, mean).sum(TIME), type(self).__name__)
        return x + added


def afterpulse_kernel(tau_s: Tensor | float, dead_time_s: float, bin_width_s: float, period_bins: int) -> Tensor:
    """Share of afterpulses k bins after their detection, folded into one period: (period_bins,) float64, sum 1.

    The delay is the dead time plus an exponential time of mean `tau_s` (differentiable); a detection lies in the middle
    of its bin. Bins are integrated exactly, and so are all later periods.
    """
    tau = torch.as_tensor(tau_s, dtype=torch.float64) / bin_width_s
    dead = dead_time_s / bin_width_s
    start = math.floor(dead + 0.5)
    # edges of the bins start, start + 1, ..., counted from the end of the dead time; the first begins before it
    edges = (torch.arange(period_bins + 1, dtype=torch.float64, device=tau.device) + start - 0.5 - dead).clamp_min(0)
    survive = torch.exp(-edges / tau)
    shares = survive[:-1] - survive[1:]
    # bins a whole number of periods later have exp(-period/tau) of it each; the first bin is cut by the dead time only
    # once, so later rounds are those of an uncut bin
    later = torch.exp(-(edges[1:] - 1 + period_bins) / tau) - torch.exp(-(edges[1:] + period_bins) / tau)
    folded = shares + later / -torch.expm1(-period_bins / tau)
    return folded.roll(start % period_bins)


def add_afterpulses(
    counts: Tensor,
    probability: Tensor | float,
    kernel: Tensor,
    *,
    only_added: bool = False,
    dtype: torch.dtype = torch.float64,
) -> Tensor:
    """Mean histogram with afterpulses, and afterpulses of afterpulses: counts * (1 - probability kernel)^-1.

    `counts`: (..., C, T, H, W); `kernel`: (P,) with P >= T, from `afterpulse_kernel`; the window is the first T bins of
    a period of P. Afterpulses outside the window are lost. With P = T sums grow by 1/(1 - probability) exactly.
    Differentiable in all three. Computed in `dtype` by FFT round the period; the dtype and device of `counts` are kept.
    """
    check_transient(counts, "add_afterpulses")
    bins, period = counts.shape[TIME], kernel.shape[0]
    if period < bins:
        raise UnitError(f"add_afterpulses: expected a period of at least the window of {bins} bins, got {period}.")
    p = torch.as_tensor(probability, dtype=torch.float64, device=counts.device)
    transfer = p * torch.fft.rfft(kernel.to(counts.device, torch.float64))
    # only what is added is transformed: the detections themselves keep all their digits
    gain = transfer / (1 - transfer)
    # rows of time next to each other: the copy costs less than a transform that strides
    rows = counts.movedim(TIME, -1).contiguous().to(dtype)
    spectrum = torch.fft.rfft(rows, n=period) * gain.to(dtype.to_complex())
    wide: Tensor = torch.fft.irfft(spectrum, n=period)
    added = wide[..., :bins].movedim(-1, TIME).contiguous().to(counts.dtype)
    return added if only_added else counts + added


class Afterpulsing(AddedCounts):
    """Every detection triggers another with `probability`, dead time plus an exponential time of mean `tau_s` later.

    Works on counts, behind the SPAD. The histogram is taken round the laser period (`period_s`, by default the window):
    afterpulses of one cycle fall into later ones. Dead time is not applied to the afterpulses themselves, nor are they
    kept from one another: fine while `probability` is small. `learnable`: `logit_probability`, `log_tau_s`.
    """

    logit_probability: Tensor
    log_tau_s: Tensor

    def __init__(
        self,
        probability: float,
        tau_s: float,
        dead_time_s: float,
        *,
        axis: TimeAxis | None = None,
        bin_width_s: float | None = None,
        period_s: float | None = None,
        learnable: bool = False,
        grad: GradPolicy = "expected",
    ) -> None:
        super().__init__(grad)
        where = "Afterpulsing"
        p = check_number(probability, "probability", where, high=0.5, open_low=True)
        tau = check_seconds(tau_s, "tau_s", where, open_low=True)
        self.dead_time_s = check_seconds(dead_time_s, "dead_time_s", where)
        self.bin_width_s = bin_width_of(axis, bin_width_s, where)
        self.period_bins: int | None = None
        if period_s is not None:
            self.period_bins = round(check_seconds(period_s, "period_s", where, open_low=True) / self.bin_width_s)
        numbers = {"logit_probability": math.log(p / (1 - p)), "log_tau_s": math.log(tau)}
        for name, value in numbers.items():
            tensor = torch.tensor(value, dtype=torch.float64)
            if learnable:
                self.register_parameter(name, nn.Parameter(tensor))
            else:
                self.register_buffer(name, tensor)

    @property
    def probability(self) -> Tensor:
        """Afterpulses of a detection, float64."""
        return self.logit_probability.double().sigmoid()

    @property
    def tau_s(self) -> Tensor:
        """Mean delay beyond the dead time, in seconds, float64."""
        return self.log_tau_s.double().exp()

    def extra(self, x: Tensor) -> Tensor:
        return self._extra(x, torch.float64)

    def rough_extra(self, x: Tensor) -> Tensor:
        return self._extra(x, torch.float64 if x.dtype == torch.float64 else torch.float32)

    def _extra(self, x: Tensor, dtype: torch.dtype) -> Tensor:
        check_transient(x, "Afterpulsing")
        kernel = afterpulse_kernel(self.tau_s, self.dead_time_s, self.bin_width_s, self.period_bins or x.shape[TIME])
        return add_afterpulses(x, self.probability, kernel, only_added=True, dtype=dtype)


def add_crosstalk(
    counts: Tensor, probability: Tensor | float, diagonal: Tensor | float = 0.0, *, only_added: bool = False
) -> Tensor:
    """Mean histogram with optical crosstalk: each detection triggers each of the 4 neighbours with `probability`.

    `diagonal`: the same for the 4 neighbours across a corner. No delay: crosstalk takes less than a bin. What leaves
    the rim of the sensor is lost. First order: crosstalk of crosstalk is left out. (..., C, T, H, W), dtype kept.
    """
    check_transient(counts, "add_crosstalk")
    near = torch.as_tensor(probability, device=counts.device).to(counts.dtype)
    far = torch.as_tensor(diagonal, device=counts.device).to(counts.dtype)
    padded = torch.nn.functional.pad(counts, (1, 1, 1, 1))
    height, width = counts.shape[-2:]

    def seen(dy: int, dx: int) -> Tensor:
        return padded[..., 1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]

    added = near * (seen(-1, 0) + seen(1, 0) + seen(0, -1) + seen(0, 1))
    if far.requires_grad or bool(far != 0):
        added = added + far * (seen(-1, -1) + seen(-1, 1) + seen(1, -1) + seen(1, 1))
    return added if only_added else counts + added


class Crosstalk(AddedCounts):
    """Crosstalk between pixels, on counts, behind the SPAD; see `add_crosstalk`. `learnable`: `logit_probability`.

    `diagonal_ratio`: probability across a corner over that across an edge.
    """

    logit_probability: Tensor

    def __init__(
        self,
        probability: float,
        *,
        diagonal_ratio: float = 0.0,
        learnable: bool = False,
        grad: GradPolicy = "expected",
    ) -> None:
        super().__init__(grad)
        p = check_number(probability, "probability", "Crosstalk", high=0.25, open_low=True)
        self.diagonal_ratio = check_number(diagonal_ratio, "diagonal_ratio", "Crosstalk", high=1.0)
        tensor = torch.tensor(math.log(p / (1 - p)), dtype=torch.float64)
        if learnable:
            self.register_parameter("logit_probability", nn.Parameter(tensor))
        else:
            self.register_buffer("logit_probability", tensor)

    @property
    def probability(self) -> Tensor:
        """Of one neighbour per detection, float64."""
        return self.logit_probability.double().sigmoid()

    def extra(self, x: Tensor) -> Tensor:
        p = self.probability
        return add_crosstalk(x, p, p * self.diagonal_ratio if self.diagonal_ratio > 0 else 0.0, only_added=True)


def hot_pixel_rates(
    height: int,
    width: int,
    *,
    median_hz: float,
    log_std: float = 0.5,
    hot_fraction: float = 0.01,
    hot_factor: float = 100.0,
    generator: torch.Generator | None = None,
) -> Tensor:
    """A map (H, W) float64 of dark count rates: log-normal around `median_hz`, some pixels `hot_factor` times that.

    `log_std`: standard deviation of the natural logarithm. For `PhotonBudget(dark_count_rate_hz=...)`.
    """
    where = "hot_pixel_rates"
    median = check_number(median_hz, "median_hz", where)
    spread = check_number(log_std, "log_std", where)
    fraction = check_number(hot_fraction, "hot_fraction", where, high=1.0)
    factor = check_number(hot_factor, "hot_factor", where, low=1.0)
    rates = median * torch.exp(spread * torch.randn(height, width, dtype=torch.float64, generator=generator))
    hot = torch.rand(height, width, dtype=torch.float64, generator=generator) < fraction
    return torch.where(hot, rates * factor, rates)
