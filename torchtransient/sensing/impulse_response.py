"""Instrument response functions (IRF): laser pulse, detector jitter and timing electronics, applied along time.

Every response is a distribution of delays. Its kernel holds the share that arrives k bins later, the difference of the
cumulative distribution between (k - 1/2) and (k + 1/2) bin widths: light counts as being in the middle of its bin.
Parameters can be learnt: positive ones are kept as logarithms (`log_fwhm_s`), delays in picoseconds (`delay_ps`), so
that one learning rate suits them. Times go in and out in seconds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torchtransient.axes import TimeAxis
from torchtransient.errors import ShapeError, UnitError
from torchtransient.sensing.layout import bin_width_of, check_number, check_seconds
from torchtransient.sensing.response_shapes import (
    FWHM_PER_SIGMA,
    emg_cdf,
    emg_survival,
    normal_cdf,
    remove_floor,
    resample_counts,
)
from torchtransient.sensing.sensor import PhysicalModule, Sensor
from torchtransient.sensing.time_convolution import Boundary, Method, check_choice, convolve_time

_OUTSIDE = 1e-9  # share of a response that a kernel may leave out on each side before it is normalised
_MOST_BINS = 1 << 24  # more is a unit gone wrong or a width that ran away, and takes all memory
_SIGMAS = 6.0  # a normal distribution has that share outside


class Response(PhysicalModule):
    """A distribution of delays. Subclasses give `cdf`, `survival`, and the `support_s` outside which nothing matters.

    `learnable`: whether the numbers are `nn.Parameter`s or buffers.
    """

    delay_ps: Tensor

    def __init__(self, delay_s: float, learnable: bool) -> None:
        super().__init__()
        self.learnable = bool(learnable)
        delay = check_seconds(delay_s, "delay_s", type(self).__name__, signed=True)
        self._hold("delay_ps", torch.tensor(delay * 1e12, dtype=torch.float64))

    def _hold(self, name: str, value: Tensor) -> None:
        if self.learnable:
            self.register_parameter(name, nn.Parameter(value))
        else:
            self.register_buffer(name, value)

    def _hold_log(self, name: str, value_s: float) -> None:
        value = check_seconds(value_s, name, type(self).__name__, open_low=True)
        self._hold(f"log_{name}", torch.tensor(math.log(value), dtype=torch.float64))

    def _positive(self, name: str) -> Tensor:
        value: Tensor = getattr(self, f"log_{name}")
        return value.double().exp()

    @property
    def delay_s(self) -> Tensor:
        """Shift of the whole response, in seconds."""
        return self.delay_ps.double() * 1e-12

    def cdf(self, time_s: Tensor) -> Tensor:
        """Share of the response before each time, float64, differentiable in time and parameters."""
        raise NotImplementedError(f"{type(self).__name__} has to define cdf.")

    def survival(self, time_s: Tensor) -> Tensor:
        """Share of the response after each time; 1 - cdf with better digits where the subclass has them."""
        return 1 - self.cdf(time_s)

    def support_s(self) -> tuple[float, float]:
        """Times between which all but about 1e-9 of the response lies."""
        raise NotImplementedError(f"{type(self).__name__} has to define support_s.")

    def mass(self, edges_s: Tensor) -> Tensor:
        """Share between consecutive edges (K + 1,): (K,). Tails keep their relative precision."""
        below, above = self.cdf(edges_s), self.survival(edges_s)
        late = (below > 0.5)[:-1]
        return torch.where(late, above[:-1] - above[1:], below[1:] - below[:-1])

    def kernel(self, bin_width_s: float) -> tuple[int, Tensor]:
        """(first, (K,) float64): shares that arrive `first + k` bins later, summing to 1."""
        if not all(bool(torch.isfinite(p).all()) for p in self.parameters()):
            raise UnitError(
                f"{type(self).__name__}: expected finite parameters, got NaN or infinity. If they are learnt, lower "
                "the learning rate."
            )
        low, high = self.support_s()
        if not high - low <= _MOST_BINS * bin_width_s:
            raise UnitError(
                f"{type(self).__name__}: expected a response of at most {_MOST_BINS} bins of {bin_width_s:g} s, got "
                f"{high - low:g} s. Wrong unit? If it is learnt, lower the learning rate."
            )
        first, last = math.floor(low / bin_width_s), math.ceil(high / bin_width_s)
        device = self.delay_ps.device
        edges = (torch.arange(first, last + 2, dtype=torch.float64, device=device) - 0.5) * bin_width_s
        weights = self.mass(edges)
        return first, weights / weights.sum()


class GaussianResponse(Response):
    """A normal distribution around `delay_s`, full width at half maximum `fwhm_s` (2.3548 standard deviations)."""

    def __init__(self, fwhm_s: float, delay_s: float = 0.0, *, learnable: bool = False) -> None:
        super().__init__(delay_s, learnable)
        self._hold_log("fwhm_s", fwhm_s)

    @property
    def fwhm_s(self) -> Tensor:
        """Full width at half maximum, in seconds."""
        return self._positive("fwhm_s")

    @property
    def sigma_s(self) -> Tensor:
        """Standard deviation, in seconds."""
        return self.fwhm_s / FWHM_PER_SIGMA

    def cdf(self, time_s: Tensor) -> Tensor:
        return normal_cdf((time_s - self.delay_s) / self.sigma_s)

    def survival(self, time_s: Tensor) -> Tensor:
        return normal_cdf((self.delay_s - time_s) / self.sigma_s)

    def support_s(self) -> tuple[float, float]:
        delay, reach = float(self.delay_s.detach()), _SIGMAS * float(self.sigma_s.detach())
        return delay - reach, delay + reach


class UniformResponse(Response):
    """Equal probability over `width_s` around `delay_s`: a clock without dither, or a square pulse."""

    def __init__(self, width_s: float, delay_s: float = 0.0, *, learnable: bool = False) -> None:
        super().__init__(delay_s, learnable)
        self._hold_log("width_s", width_s)

    @property
    def width_s(self) -> Tensor:
        """Full width, in seconds."""
        return self._positive("width_s")

    def cdf(self, time_s: Tensor) -> Tensor:
        return ((time_s - self.delay_s) / self.width_s + 0.5).clamp(0, 1)

    def support_s(self) -> tuple[float, float]:
        delay, half = float(self.delay_s.detach()), 0.5 * float(self.width_s.detach())
        return delay - half, delay + half


class TailedResponse(Response):
    """A Gaussian core and exponential diffusion tails: fraction_0 N + sum of fraction_i (N + Exp(tail_s[i])).

    `tails_s`: mean delays of the tails; `fractions`: share of light in each of them, positive, in all at most 1 (the
    rest is the pure Gaussian). One tail of fraction 1 is the exponentially modified Gaussian; two tails are the model
    of Hernandez et al., A computational model of a single-photon avalanche diode sensor (arXiv 1703.02635).
    `delay_s` is that of the Gaussian; the mean lies sum(fraction_i tail_i) later.
    """

    log_tails_s: Tensor
    fraction_logits: Tensor

    def __init__(
        self,
        fwhm_s: float,
        tails_s: Sequence[float],
        fractions: Sequence[float],
        delay_s: float = 0.0,
        *,
        learnable: bool = False,
    ) -> None:
        super().__init__(delay_s, learnable)
        self._hold_log("fwhm_s", fwhm_s)
        if len(tails_s) != len(fractions) or len(tails_s) == 0:
            raise ShapeError(
                f"TailedResponse: expected as many fractions as tails_s, got {len(fractions)} and {len(tails_s)}."
            )
        tails = [math.log(check_seconds(t, "tails_s", "TailedResponse", open_low=True)) for t in tails_s]
        parts = [check_number(f, "fractions", "TailedResponse", high=1.0, open_low=True) for f in fractions]
        core = 1 - math.fsum(parts)
        if core < -1e-9:
            raise UnitError(f"TailedResponse: expected fractions with sum <= 1, got {math.fsum(parts):g}.")
        self.has_core = core > 1e-9
        logits = [math.log(p) for p in ([core, *parts] if self.has_core else parts)]
        self._hold("log_tails_s", torch.tensor(tails, dtype=torch.float64))
        self._hold("fraction_logits", torch.tensor(logits, dtype=torch.float64))

    @property
    def fwhm_s(self) -> Tensor:
        """Full width at half maximum of the Gaussian core, in seconds."""
        return self._positive("fwhm_s")

    @property
    def sigma_s(self) -> Tensor:
        """Standard deviation of the Gaussian core, in seconds."""
        return self.fwhm_s / FWHM_PER_SIGMA

    @property
    def tails_s(self) -> Tensor:
        """Mean delays of the tails, in seconds."""
        return self.log_tails_s.double().exp()

    @property
    def fractions(self) -> Tensor:
        """Shares of the tails, float64; the core has the rest."""
        shares = self.fraction_logits.double().softmax(0)
        return shares[1:] if self.has_core else shares

    def _mix(self, time_s: Tensor, core: Tensor, tail: Tensor) -> Tensor:
        shares = self.fraction_logits.double().softmax(0)
        weights = shares[1:] if self.has_core else shares
        mixed = (weights * tail).sum(-1)
        return mixed + shares[0] * core if self.has_core else mixed

    def cdf(self, time_s: Tensor) -> Tensor:
        tail = emg_cdf(time_s.unsqueeze(-1), self.delay_s, self.sigma_s, self.tails_s)
        return self._mix(time_s, normal_cdf((time_s - self.delay_s) / self.sigma_s), tail)

    def survival(self, time_s: Tensor) -> Tensor:
        tail = emg_survival(time_s.unsqueeze(-1), self.delay_s, self.sigma_s, self.tails_s)
        return self._mix(time_s, normal_cdf((self.delay_s - time_s) / self.sigma_s), tail)

    def support_s(self) -> tuple[float, float]:
        delay, reach = float(self.delay_s.detach()), _SIGMAS * float(self.sigma_s.detach())
        return delay - reach, delay + reach - math.log(_OUTSIDE) * float(self.tails_s.detach().max())


def emg_response(fwhm_s: float, tau_s: float, delay_s: float = 0.0, *, learnable: bool = False) -> TailedResponse:
    """The exponentially modified Gaussian: normal jitter of `fwhm_s` plus an exponential delay of mean `tau_s`."""
    return TailedResponse(fwhm_s, [tau_s], [1.0], delay_s, learnable=learnable)


class MeasuredResponse(Response):
    """A measured histogram `counts` (T,) in bins of `bin_width_s`, resampled by integrating.

    The median of all bins is taken off as background (`floor=False` keeps it), the rest normalised to 1. `align`
    "center_of_mass" puts the mean delay at `delay_s` (the highest bin would shift an asymmetric response by about its
    tail); "start" puts the start of the first bin there. `learnable` makes the delay and the shape (as logits) learnt.
    """

    shares: Tensor

    share_logits: Tensor

    def __init__(
        self,
        counts: Tensor,
        bin_width_s: float,
        delay_s: float = 0.0,
        *,
        align: str = "center_of_mass",
        floor: bool = True,
        learnable: bool = False,
    ) -> None:
        super().__init__(delay_s, learnable)
        if not isinstance(counts, Tensor) or counts.ndim != 1 or counts.numel() < 2:
            shape = tuple(counts.shape) if isinstance(counts, Tensor) else type(counts).__name__
            raise ShapeError(f"MeasuredResponse: expected counts (T,) with T >= 2, got {shape}.")
        if align not in ("center_of_mass", "start"):
            raise ShapeError(f"MeasuredResponse: expected align 'center_of_mass' or 'start', got {align!r}.")
        self.bin_width_s = check_seconds(bin_width_s, "bin_width_s", "MeasuredResponse", open_low=True)
        values = counts.detach().double()
        if not bool(torch.isfinite(values).all()) or not bool((values.amax() > values.median()) & (values >= 0).all()):
            raise UnitError("MeasuredResponse: expected finite counts >= 0 with a peak above their median.")
        shares = remove_floor(values) if floor else values / values.sum()
        self.align = align
        if self.learnable:
            # a bin without light starts at e^-30 of the whole, so that it can be learnt at all
            self.register_parameter("share_logits", nn.Parameter(shares.clamp_min(1e-13).log()))
        else:
            self.register_buffer("shares", shares)

    def _shares(self) -> Tensor:
        if self.learnable:
            logits: Tensor = self.share_logits
            return logits.double().softmax(0)
        return self.shares.double()

    def _start_s(self, shares: Tensor) -> Tensor:
        if self.align == "start":
            return self.delay_s
        middles = (torch.arange(shares.numel(), dtype=torch.float64, device=shares.device) + 0.5) * self.bin_width_s
        return self.delay_s - (shares * middles).sum()

    def cdf(self, time_s: Tensor) -> Tensor:
        shares = self._shares()
        start = self._start_s(shares)
        flat = time_s.reshape(-1)
        # resample_counts from far before the response to each time, as one running sum
        edges = torch.cat([(start.detach() - self.bin_width_s).reshape(1), flat])
        total = resample_counts(shares, self.bin_width_s, edges, start).cumsum(0)
        return total.reshape(time_s.shape)

    def support_s(self) -> tuple[float, float]:
        shares = self._shares().detach()
        start = float(self._start_s(shares).detach())
        kept = torch.nonzero(shares > 1e-12).flatten()
        return start + int(kept[0]) * self.bin_width_s, start + (int(kept[-1]) + 1) * self.bin_width_s


class ComposedResponse(Response):
    """Independent delays one after another: laser pulse, detector jitter, timing electronics. Variances add.

    The responses are convolved on a grid `oversampling` (odd) times finer than the bins, which adds a variance of
    (bin width/oversampling)^2/12 for each, and gathered into bins at the end.
    """

    def __init__(self, responses: Sequence[Response], *, oversampling: int = 9) -> None:
        super().__init__(0.0, learnable=False)
        if len(responses) == 0:
            raise ShapeError("ComposedResponse: expected at least one response, got none.")
        wrong = [type(r).__name__ for r in responses if not isinstance(r, Response)]
        if wrong:
            raise ShapeError(f"ComposedResponse: expected responses such as GaussianResponse, got {wrong}.")
        if oversampling < 1 or oversampling % 2 == 0:
            raise ShapeError(f"ComposedResponse: expected oversampling to be odd and >= 1, got {oversampling}.")
        self.responses = nn.ModuleList(responses)
        self.oversampling = int(oversampling)

    def kernel(self, bin_width_s: float) -> tuple[int, Tensor]:
        fine = self.oversampling
        first, total = 0, None
        for response in self.responses:
            begin, weights = response.kernel(bin_width_s / fine)  # type: ignore[operator]
            first += begin
            total = weights if total is None else _full_convolution(total, weights)
        if total is None:
            raise ShapeError("ComposedResponse: expected at least one response, got none.")
        # fine bin i belongs to the coarse bin round(i / fine)
        half = (fine - 1) // 2
        coarse = math.floor((first + half) / fine)
        before = first + half - coarse * fine
        padded = torch.nn.functional.pad(total, (before, -(before + total.numel()) % fine))
        return coarse, padded.view(-1, fine).sum(1)


def _full_convolution(a: Tensor, b: Tensor) -> Tensor:
    length = a.numel() + b.numel() - 1
    both: Tensor = torch.fft.irfft(torch.fft.rfft(a, n=length) * torch.fft.rfft(b, n=length), n=length)
    return both


class ImpulseResponse(Sensor):
    """Convolves a transient (..., C, T, H, W) with a response along time.

    The bin width comes from `axis` or `bin_width_s`; boundary and method as in `convolve_time`. Sums over time are
    conserved with "periodic", and with "zero" as far as light stays in the window. The order of linear steps is free,
    but this one belongs before detection: jitter of the detector, applied to rates, is exact only far from pile-up.
    """

    gives = "the same"

    def __init__(
        self,
        response: Response,
        axis: TimeAxis | None = None,
        *,
        bin_width_s: float | None = None,
        boundary: Boundary = "zero",
        method: Method = "auto",
    ) -> None:
        super().__init__()
        check_choice(boundary, Boundary, "boundary", "ImpulseResponse")
        check_choice(method, Method, "method", "ImpulseResponse")
        if not isinstance(response, Response):
            raise ShapeError(
                f"ImpulseResponse: expected a response such as GaussianResponse, got {type(response).__name__}. A "
                "measured histogram goes into MeasuredResponse(counts, bin_width_s)."
            )
        self.response = response
        self.bin_width_s = bin_width_of(axis, bin_width_s, "ImpulseResponse")
        self.num_bins = None if axis is None else axis.num_bins
        self.boundary: Boundary = boundary
        self.method: Method = method

    def expected(self, x: Tensor) -> Tensor:
        first, kernel = self.response.kernel(self.bin_width_s)
        return convolve_time(x, kernel, first, boundary=self.boundary, method=self.method)

    def extra_repr(self) -> str:
        return f"bin_width_s={self.bin_width_s:g}, boundary={self.boundary!r}, method={self.method!r}"
