"""Afterpulses: detections triggered by carriers that an earlier one left behind. And maps of hot pixels."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from torchtransient.axes import TimeAxis
from torchtransient.errors import UnitError
from torchtransient.floating import in_single
from torchtransient.sensing.added_counts import AddedCounts
from torchtransient.sensing.draws import by_pieces
from torchtransient.sensing.layout import TIME, bin_width_of, check_number, check_seconds, check_transient
from torchtransient.sensing.policies import GradPolicy
from torchtransient.sensing.thinning import thin
from torchtransient.sensing.time_convolution import filter_rows

_BLOCK = 1 << 17  # entries at a time, so that temporaries stay in the cache
_FINE = 2.0**14  # bins of a period, or of a delay, up to which single precision places afterpulses


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


@in_single
def add_afterpulses(
    counts: Tensor,
    probability: Tensor | float,
    kernel: Tensor,
    *,
    only_added: bool = False,
) -> Tensor:
    """Mean histogram with afterpulses, and afterpulses of afterpulses: counts * (1 - probability kernel)^-1.

    `counts`: (..., C, T, H, W); `kernel`: (P,) with P >= T, from `afterpulse_kernel`; the window is the first T bins of
    a period of P. Afterpulses outside the window are lost. With P = T sums grow by 1/(1 - probability) exactly.
    Differentiable in all three. Computed in float64 by FFT round the period; dtype and device of `counts` are kept.
    """
    check_transient(counts, "add_afterpulses")
    bins, period = counts.shape[TIME], kernel.shape[0]
    _check_period(period, bins)
    p = torch.as_tensor(probability, dtype=torch.float64, device=counts.device)
    transfer = p * torch.fft.rfft(kernel.to(counts.device, torch.float64))
    # only what is added is transformed: the detections themselves keep all their digits
    gain = transfer / (1 - transfer)
    length = period
    if period > 2 * bins:
        # of a long period only the lags between two bins of the window matter, forwards and round the period
        response = torch.fft.irfft(gain, n=period)
        near = torch.cat([response[:bins], response.new_zeros(1), response[period - bins + 1 :]])
        gain, length = torch.fft.rfft(near), 2 * bins
    # rows of time next to each other: the copy costs less than a transform that strides
    rows = counts.movedim(TIME, -1).contiguous().to(torch.float64)
    added = filter_rows(rows, gain, length, 0, bins).movedim(-1, TIME).contiguous().to(counts.dtype)
    return added if only_added else counts + added


def _check_period(period: int, bins: int) -> None:
    if period < bins:
        raise UnitError(f"add_afterpulses: expected a period of at least the window of {bins} bins, got {period}.")


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
        self.num_bins = None if axis is None else axis.num_bins
        self.period_s: float | None = None
        self.period_bins: int | None = None
        self.window_is_period = period_s is None
        if period_s is not None:
            self.period_s = check_seconds(period_s, "period_s", where, open_low=True, high=1.0)
            self.period_bins = round(self.period_s / self.bin_width_s)
            _check_period(self.period_bins, 1)
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

    def _period_bins(self, x: Tensor) -> int:
        return self.period_bins or x.shape[TIME]

    @in_single
    def extra(self, x: Tensor) -> Tensor:
        check_transient(x, "Afterpulsing")
        kernel = afterpulse_kernel(self.tau_s, self.dead_time_s, self.bin_width_s, self._period_bins(x))
        return add_afterpulses(x, self.probability, kernel, only_added=True)

    def share(self) -> float:
        p = float(self.probability)
        return p / (1 - p)

    def trigger(self, counts: Tensor, generator: torch.Generator | None) -> Tensor:
        check_transient(counts, "Afterpulsing")
        p, tau = float(self.probability), float(self.tau_s / self.bin_width_s)
        # an event lies in the middle of its bin
        after = 0.5 + self.dead_time_s / self.bin_width_s
        period, bins, pixels = self._period_bins(counts), counts.shape[TIME], counts.shape[-2] * counts.shape[-1]
        _check_period(period, bins)
        # bins are told apart to 1e-3 of a bin, and delays have as many steps
        real = torch.float32 if max(period, after, 20 * tau) < _FINE else torch.float64

        def follow(piece: Tensor, begin: int, own: torch.Generator | None) -> Tensor:
            """Places of all afterpulses of the detections of a piece, and of those triggered by them."""
            first = thin(piece, p, own)
            found = [first.place[:0]]
            for block in range(0, first.place.numel(), _BLOCK):
                at = slice(block, block + _BLOCK)
                place, number = first.place[at] + begin, first.number[at].long()
                start = place.div(pixels, rounding_mode="floor") % bins
                origin = place.sub_(start * pixels).repeat_interleave(number)
                time = start.to(real).repeat_interleave(number)
                while time.numel():
                    delay = torch.rand(time.shape, dtype=real, device=time.device, generator=own).neg_().log1p_()
                    time = delay.mul_(-tau).add_(after).floor_().add_(time)
                    time.sub_((time * (1 / period)).floor_().mul_(period))
                    # where the quotient was rounded
                    time.sub_(period * (time >= period)).add_(period * (time < 0))
                    seen = (time < bins).nonzero().squeeze(-1)
                    found.append(time[seen].long().mul_(pixels).add_(origin[seen]))
                    again = torch.rand(time.shape, dtype=real, device=time.device, generator=own) < p
                    again = again.nonzero().squeeze(-1)
                    time, origin = time[again], origin[again]
            return torch.cat(found)

        one = torch.ones(1, dtype=counts.dtype, device=counts.device)
        total = counts.clone(memory_format=torch.contiguous_format)
        for places in by_pieces(follow, counts.reshape(-1), generator):
            total.view(-1).scatter_add_(0, places, one.expand(places.shape))
        return total


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
