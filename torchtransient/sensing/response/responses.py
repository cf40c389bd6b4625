"""Shapes of instrument responses (IRF): laser pulses, detector jitter and timing electronics, as delays.

A kernel holds the share of the light of a bin that arrives k bins later. Light is taken to be spread evenly over its
bin, as converters, indirect time of flight and free-running detectors take it; `within_bin="center"` puts all of it
into the middle. Parameters can be learnt: positive ones are kept as logarithms (`log_fwhm_s`), delays in picoseconds
(`delay_ps`), so that one learning rate suits them. Times go in and out in seconds.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn

from torchtransient.checks import Numbers, several
from torchtransient.errors import ShapeError, UnitError
from torchtransient.sensing.base.layout import check_choice, check_number, check_seconds
from torchtransient.sensing.base.remembered import remembered
from torchtransient.sensing.base.sensor import PhysicalModule
from torchtransient.sensing.response.response_shapes import (
    FWHM_PER_SIGMA,
    emg_cdf,
    emg_integrals,
    emg_survival,
    normal_cdf,
    normal_integrals,
)

WithinBin = Literal["uniform", "center"]

_OUTSIDE = 1e-9  # share of a response that a kernel may leave out on each side before it is normalised
_MOST_BINS = 1 << 24  # more is a unit gone wrong or a width that ran away, and takes all memory
_SIGMAS = 6.0  # a normal distribution has that share outside
# second differences lose the square of the length in bins of their digits; a mean over nodes loses one power of it
CLOSED_BINS = 4096
_MOST_PANELS = 4096


class Response(PhysicalModule):
    """A distribution of delays. Subclasses give `cdf` and the `support_s` outside which nothing matters.

    `survival` and `integrals` are for better digits and less time: without them `kernel` is right to 1e-9 where `cdf`
    is smooth over an eighth of the support, and to 1e-3 where it has corners.

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

    def integrals(self, time_s: Tensor) -> tuple[Tensor, Tensor] | None:
        """Integral of `cdf` up to each time (K,) and of `survival` from there on, in seconds, float64.

        None where a subclass has no closed form: `kernel` then integrates `cdf` and `survival` numerically.
        """
        return None

    def mass(self, edges_s: Tensor) -> Tensor:
        """Share between consecutive edges (K + 1,): (K,). Tails keep their relative precision.

        This is what bins hold of light that arrives at one known time; `kernel` is for light that is known to a bin.
        """
        return _between(self.cdf(edges_s), self.survival(edges_s))

    def kernel(self, bin_width_s: float, within_bin: WithinBin = "uniform") -> tuple[int, Tensor]:
        """(first, (K,) float64): shares of the light of a bin that arrive `first + k` bins later, summing to 1.

        `within_bin` "uniform": light lies evenly in its bin, exact by the second difference of the integrated
        distribution; "center": all of it in the middle. Raises UnitError for parameters that are not finite and for
        responses of more than 2^24 bins.
        """
        check_choice(within_bin, WithinBin, "within_bin", type(self).__name__)
        first, last = self._lags(bin_width_s)
        if within_bin == "uniform":
            weights = self._spread(first, last, bin_width_s)
        else:
            edges = torch.arange(first, last + 2, dtype=torch.float64, device=self.delay_ps.device) - 0.5
            weights = self.mass(edges * bin_width_s)
        weights = weights.clamp_min(0)  # rounding
        return first, weights / weights.sum()

    def _lags(self, bin_width_s: float) -> tuple[int, int]:
        """First and last lag that a kernel holds."""
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
        return math.floor(low / bin_width_s), math.ceil(high / bin_width_s)

    def _spread(self, first: int, last: int, bin_width_s: float) -> Tensor:
        """Shares of evenly spread light, not normalised."""
        device = self.delay_ps.device
        times = torch.arange(first - 1, last + 2, dtype=torch.float64, device=device) * bin_width_s
        closed = self.integrals(times) if last - first <= CLOSED_BINS else None
        if closed is None:
            return self._spread_by_nodes(first, last, bin_width_s)
        below, above = closed
        early, late = below.diff().diff(), above.diff().diff()
        return torch.where((below > above)[1:-1], late, early) / bin_width_s

    def _spread_by_nodes(self, first: int, last: int, bin_width_s: float) -> Tensor:
        """The mean of `mass` over places in the bin, by Gauss-Legendre rules on panels of an eighth of the response."""
        low, high = self.support_s()
        narrow = 8 * bin_width_s / max(high - low, 1e-30)
        panels = min(max(1, math.ceil(narrow)), _MOST_PANELS)
        nodes, shares = np.polynomial.legendre.leggauss(8 if last - first <= CLOSED_BINS else 3)
        device = self.delay_ps.device
        node = torch.from_numpy(0.5 + 0.5 * nodes).to(device)
        place = ((torch.arange(panels, dtype=torch.float64, device=device).unsqueeze(1) + node) / panels).flatten()
        weight = torch.from_numpy(0.5 * shares / panels).to(device).repeat(panels)
        edges = torch.arange(first, last + 2, dtype=torch.float64, device=device).unsqueeze(1) - place
        flat = (edges * bin_width_s).flatten()
        mass = _between(self.cdf(flat).view(edges.shape), self.survival(flat).view(edges.shape))
        return mass @ weight


def _between(below: Tensor, above: Tensor) -> Tensor:
    """Differences along dimension 0 of a cumulative distribution, beyond the median of its survival."""
    late = (below > 0.5)[:-1]
    return torch.where(late, above[:-1] - above[1:], below[1:] - below[:-1])


def kernel_of(response: Response, bin_width_s: float, within_bin: WithinBin) -> tuple[int, Tensor]:
    """`response.kernel`; responses with a kernel of their own need not know of the default `within_bin`. Remembered."""

    def kernel() -> tuple[int, Tensor]:
        return response.kernel(bin_width_s) if within_bin == "uniform" else response.kernel(bin_width_s, within_bin)

    return remembered(response, ("kernel", bin_width_s, within_bin), kernel)


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

    def integrals(self, time_s: Tensor) -> tuple[Tensor, Tensor]:
        return normal_integrals(time_s, self.delay_s, self.sigma_s)

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

    def integrals(self, time_s: Tensor) -> tuple[Tensor, Tensor]:
        u = (time_s - self.delay_s) / self.width_s
        return self.width_s * _ramp_integral(u), self.width_s * _ramp_integral(-u)

    def support_s(self) -> tuple[float, float]:
        delay, half = float(self.delay_s.detach()), 0.5 * float(self.width_s.detach())
        return delay - half, delay + half


def _ramp_integral(u: Tensor) -> Tensor:
    """Integral of the cumulative of a uniform distribution between -1/2 and 1/2."""
    return 0.5 * (u + 0.5).clamp(0, 1).square() + (u - 0.5).clamp_min(0)


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
        tails_s: Numbers,
        fractions: Numbers,
        *,
        delay_s: float = 0.0,
        learnable: bool = False,
    ) -> None:
        super().__init__(delay_s, learnable)
        self._hold_log("fwhm_s", fwhm_s)
        tails_s = several("TailedResponse: tails_s", tails_s, "numbers of seconds")
        fractions = several("TailedResponse: fractions", fractions, "shares of light")
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
        return self.widened_cdf(time_s, self.delay_s, self.sigma_s)

    def survival(self, time_s: Tensor) -> Tensor:
        return self.widened_survival(time_s, self.delay_s, self.sigma_s)

    def widened_cdf(self, time_s: Tensor, delay_s: Tensor, sigma_s: Tensor) -> Tensor:
        """`cdf` with another delay and core: of what this response and normal ones make together."""
        tail = emg_cdf(time_s.unsqueeze(-1), delay_s, sigma_s, self.tails_s)
        return self._mix(time_s, normal_cdf((time_s - delay_s) / sigma_s), tail)

    def widened_survival(self, time_s: Tensor, delay_s: Tensor, sigma_s: Tensor) -> Tensor:
        """`survival` of the same."""
        tail = emg_survival(time_s.unsqueeze(-1), delay_s, sigma_s, self.tails_s)
        return self._mix(time_s, normal_cdf((delay_s - time_s) / sigma_s), tail)

    def integrals(self, time_s: Tensor) -> tuple[Tensor, Tensor]:
        return self.widened_integrals(time_s, self.delay_s, self.sigma_s)

    def widened_integrals(self, time_s: Tensor, delay_s: Tensor, sigma_s: Tensor) -> tuple[Tensor, Tensor]:
        """`integrals` with another delay and core: what this response and normal ones make together."""
        core = normal_integrals(time_s, delay_s, sigma_s)
        tail = emg_integrals(time_s.unsqueeze(-1), delay_s, sigma_s, self.tails_s)
        below, above = (self._mix(time_s, c, t) for c, t in zip(core, tail, strict=True))
        return below, above

    def support_s(self) -> tuple[float, float]:
        delay, reach = float(self.delay_s.detach()), _SIGMAS * float(self.sigma_s.detach())
        return delay - reach, delay + reach - math.log(_OUTSIDE) * float(self.tails_s.detach().max())


def emg_response(fwhm_s: float, tau_s: float, delay_s: float = 0.0, *, learnable: bool = False) -> TailedResponse:
    """The exponentially modified Gaussian: normal jitter of `fwhm_s` plus an exponential delay of mean `tau_s`."""
    return TailedResponse(fwhm_s, [tau_s], [1.0], delay_s=delay_s, learnable=learnable)
