"""Shapes of instrument responses (IRF): laser pulses, detector jitter and timing electronics, as delays.

A kernel holds the share of the light of a bin that arrives k bins later. Light is taken to be spread evenly over its
bin, as converters, indirect time of flight and free-running detectors take it; `within_bin="center"` puts all of it
into the middle. Parameters can be learnt: positive ones are kept as logarithms (`log_fwhm_s`), delays in picoseconds
(`delay_ps`), so that one learning rate suits them. Times go in and out in seconds.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn

from torchtransient.checks import MOST_MADE, Numbers, as_whole, is_one_of, several, shown
from torchtransient.errors import ShapeError, UnitError
from torchtransient.sensing.checks import check_choice, check_number, check_seconds, going_together, one_number, reals
from torchtransient.sensing.parameters import remembered
from torchtransient.sensing.sensor import PhysicalModule
from torchtransient.sensing.time_convolution import filter_rows

# --------------------------------------------------------------------------------------------------------- closed forms


FWHM_PER_SIGMA = 2 * math.sqrt(2 * math.log(2))  # 2.3548


def normal_cdf(u: Tensor) -> Tensor:
    """Cumulative normal distribution; keeps relative precision for u far below 0."""
    share: Tensor = 0.5 * torch.special.erfc(-u / math.sqrt(2))
    return share


def normal_integral(u: Tensor) -> Tensor:
    """Integral of `normal_cdf` up to u: u Phi(u) + phi(u). Keeps 1e-13 of itself down to u = -30."""
    return u * normal_cdf(u) + torch.exp(-0.5 * u * u) / math.sqrt(2 * math.pi)


def _tail_term(u: Tensor, ratio: Tensor) -> Tensor:
    """exp(ratio^2/2 - u ratio) Phi(u - ratio) for ratio = sigma/tau, without overflow for any of them.

    With z = (ratio - u)/sqrt 2: for z >= 0 it is exp(-u^2/2) erfcx(z)/2, and else both factors of the plain form are
    below one. Each branch sees an argument that it can take, so that gradients stay finite in the other one too.
    """
    z = (ratio - u) / math.sqrt(2)
    scaled = z >= 0
    # z >= 0 means u <= ratio; u is clamped for the unused branch only
    u_scaled = torch.where(scaled, u, torch.zeros_like(u))
    by_erfcx = 0.5 * torch.exp(-0.5 * u_scaled**2) * torch.special.erfcx(torch.where(scaled, z, torch.zeros_like(z)))
    exponent = torch.where(scaled, torch.zeros_like(u), 0.5 * ratio**2 - u * ratio)
    plain = 0.5 * torch.exp(exponent) * torch.special.erfc(torch.where(scaled, torch.zeros_like(z), z))
    return torch.where(scaled, by_erfcx, plain)


def emg_density(time_s: Tensor, mean_s: Tensor, sigma_s: Tensor, tau_s: Tensor) -> Tensor:
    """Density (1/s) of a normal delay plus an exponential one: the exponentially modified Gaussian.

    `mean_s`, `sigma_s`: of the normal part; `tau_s`: mean of the exponential part. Stable for every ratio of the two.
    Source: Grushka, Anal. Chem. 44 (1972); erfcx form as in Kalambet et al., J. Chemometrics 25 (2011).
    """
    given = going_together("emg_density", time_s=time_s, mean_s=mean_s, sigma_s=sigma_s, tau_s=tau_s)
    time_s, mean_s, sigma_s, tau_s = given
    return _tail_term((time_s - mean_s) / sigma_s, sigma_s / tau_s) / tau_s


def emg_cdf(time_s: Tensor, mean_s: Tensor, sigma_s: Tensor, tau_s: Tensor) -> Tensor:
    """Share of `emg_density` before `time_s`."""
    given = going_together("emg_cdf", time_s=time_s, mean_s=mean_s, sigma_s=sigma_s, tau_s=tau_s)
    time_s, mean_s, sigma_s, tau_s = given
    u = (time_s - mean_s) / sigma_s
    return normal_cdf(u) - _tail_term(u, sigma_s / tau_s)


def emg_survival(time_s: Tensor, mean_s: Tensor, sigma_s: Tensor, tau_s: Tensor) -> Tensor:
    """Share of `emg_density` after `time_s`, with relative precision far out in the tail."""
    given = going_together("emg_survival", time_s=time_s, mean_s=mean_s, sigma_s=sigma_s, tau_s=tau_s)
    time_s, mean_s, sigma_s, tau_s = given
    u = (time_s - mean_s) / sigma_s
    return normal_cdf(-u) + _tail_term(u, sigma_s / tau_s)


def normal_integrals(time_s: Tensor, mean_s: Tensor, sigma_s: Tensor) -> tuple[Tensor, Tensor]:
    """Integrals of the cumulative normal up to each time and of its survival from there on, in seconds."""
    u = (time_s - mean_s) / sigma_s
    return sigma_s * normal_integral(u), sigma_s * normal_integral(-u)


def emg_integrals(time_s: Tensor, mean_s: Tensor, sigma_s: Tensor, tau_s: Tensor) -> tuple[Tensor, Tensor]:
    """Integrals of `emg_cdf` up to each time and of `emg_survival` from there on, in seconds.

    The tail term is tau times the density, so that its integral is tau times the cumulative.
    """
    below, above = normal_integrals(time_s, mean_s, sigma_s)
    cdf, survival = emg_cdf(time_s, mean_s, sigma_s, tau_s), emg_survival(time_s, mean_s, sigma_s, tau_s)
    return below - tau_s * cdf, above + tau_s * survival


def integrated_counts(counts: Tensor, width_s: float, time_s: Tensor, start_s: float | Tensor = 0.0) -> Tensor:
    """Integral, up to each time, of the counts that lie before: (K,) float64, counts times seconds.

    `counts`: (T,) in bins of `width_s` from `start_s` on, spread evenly over each bin, so that the result is quadratic
    inside the bins. `time_s`: (K,). Differentiable in the counts, the times and the start.
    """
    values = counts.to(torch.float64)
    before = torch.nn.functional.pad(values.cumsum(0), (1, 0))
    area = torch.nn.functional.pad((before[:-1] + 0.5 * values).cumsum(0), (1, 0))
    bins = counts.shape[0]
    position = (time_s.to(torch.float64) - start_s) / width_s
    inside = position.clamp(0, bins)
    k = inside.floor().clamp_max(bins - 1).long()
    part = inside - k
    beyond = (position - inside).clamp_min(0) * before[-1]
    return width_s * (area[k] + part * (before[k] + 0.5 * part * values[k]) + beyond)


def resample_counts(counts: Tensor, width_s: float, edges_s: Tensor, *, start_s: float | Tensor = 0.0) -> Tensor:
    """Counts between new edges, by integrating: a bin's counts are spread evenly over it, and sums are conserved.

    `counts`: (T,) in bins of `width_s` from `start_s` on; `edges_s`: (K + 1,) increasing; returns (K,) float64. What
    lies outside the new edges is left out. Differentiable in the counts, the edges and the start.
    """
    me = "resample_counts"
    counts, edges_s = reals(me, torch.float64, counts=counts, edges_s=edges_s)
    if counts.ndim != 1 or edges_s.ndim != 1 or not counts.numel():
        raise ShapeError(f"{me}: expected counts (T,) of one bin or more and edges_s (K + 1,), got "
                         f"{tuple(counts.shape)} and {tuple(edges_s.shape)}.")  # fmt: skip
    width_s, start_s = one_number(width_s, "width_s", me), one_number(start_s, "start_s", me)
    cumulative = torch.nn.functional.pad(counts.to(torch.float64).cumsum(0), (1, 0))
    bins = counts.shape[0]
    position = ((edges_s.to(torch.float64) - start_s) / width_s).clamp(0, bins)
    below = position.floor().clamp_max(bins - 1).long()
    value = cumulative[below] + (position - below) * (cumulative[below + 1] - cumulative[below])
    return value.diff()


def above_floor(counts: Tensor, floor: float | bool, where: str) -> Tensor:
    """A measured histogram without its background, not below 0, sum 1: float64.

    `floor` True: the median of all bins, which is the background when the response fills less than half of them; False:
    none; a number: so many counts of every bin. Raises UnitError for other floors, and where nothing is left.
    """
    numbers = counts.to(torch.float64)
    level = floor if isinstance(floor, (bool, np.bool_)) else check_number(floor, "floor", where)
    if isinstance(level, (bool, np.bool_)):
        level = float(numbers.median()) if level else 0.0
    clean = (numbers - level).clamp_min(0)
    if not float(clean.sum()) > 0:
        raise UnitError(f"{where}: expected counts above the floor of {level:g}, got none.")
    return clean / clean.sum()


# ------------------------------------------------------------------------------------------------------------ responses


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


# -------------------------------------------------------------------------------------- measured and composed responses


_TABLE = 2000  # bins of a response without a closed form


class MeasuredResponse(Response):
    """A measured histogram `counts` (T,) in bins of `bin_width_s`, resampled by integrating.

    `floor`: what is taken off as background: True the median of all bins, False nothing, or a number of counts of every
    bin. The rest is normalised to 1. `align`
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
        floor: float | bool = True,
        learnable: bool = False,
    ) -> None:
        super().__init__(delay_s, learnable)
        if not isinstance(counts, Tensor) or counts.ndim != 1 or counts.numel() < 2:
            shape = tuple(counts.shape) if isinstance(counts, Tensor) else type(counts).__name__
            raise ShapeError(f"MeasuredResponse: expected counts (T,) with T >= 2, got {shape}.")
        if not is_one_of(align, ("center_of_mass", "start")):
            raise ShapeError(f"MeasuredResponse: expected align 'center_of_mass' or 'start', got {shown(align)}.")
        self.bin_width_s = check_seconds(bin_width_s, "bin_width_s", "MeasuredResponse", open_low=True)
        values = reals("MeasuredResponse", torch.float64, counts=counts)[0].detach().double()
        if not bool(torch.isfinite(values).all()) or not bool((values.amax() > values.median()) & (values >= 0).all()):
            raise UnitError("MeasuredResponse: expected finite counts >= 0 with a peak above their median.")
        shares = above_floor(values, floor, "MeasuredResponse")
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
        edges = torch.cat([(start - self.bin_width_s).reshape(1), flat])
        total = resample_counts(shares, self.bin_width_s, edges, start_s=start).cumsum(0)
        return total.reshape(time_s.shape)

    def integrals(self, time_s: Tensor) -> tuple[Tensor, Tensor]:
        shares = self._shares()
        start = self._start_s(shares)
        end = start + shares.numel() * self.bin_width_s
        # seen from its end, the response runs the other way
        above = integrated_counts(shares.flip(0), self.bin_width_s, end - time_s)
        return integrated_counts(shares, self.bin_width_s, time_s, start), above

    def support_s(self) -> tuple[float, float]:
        shares = self._shares()
        start = float(self._start_s(shares).detach())
        kept = torch.nonzero(shares > 1e-12).flatten()
        return start + int(kept[0]) * self.bin_width_s, start + (int(kept[-1]) + 1) * self.bin_width_s


class ComposedResponse(Response):
    """Independent delays one after another: laser pulse, detector jitter, timing electronics. Variances add.

    Normal ones, with at most one `TailedResponse` among them, have a closed form. Others are convolved on a grid
    `oversampling` (odd) times finer than the bins, and gathered into bins at the end. The grid keeps the mean and adds
    a variance of (bin width/oversampling)^2/6 for each; with `within_bin="center"` half of that.
    """

    def __init__(self, responses: Sequence[Response], *, oversampling: int = 9) -> None:
        super().__init__(0.0, learnable=False)
        responses = several("ComposedResponse", responses, "responses such as GaussianResponse")
        if len(responses) == 0:
            raise ShapeError("ComposedResponse: expected at least one response, got none.")
        wrong = [type(r).__name__ for r in responses if not isinstance(r, Response)]
        if wrong:
            raise ShapeError(f"ComposedResponse: expected responses such as GaussianResponse, got {wrong}.")
        odd = as_whole(oversampling)
        if odd is None or odd < 1 or odd % 2 == 0 or odd > MOST_MADE:
            raise ShapeError(f"ComposedResponse: expected oversampling to be odd and >= 1, got {shown(oversampling)}.")
        self.responses = nn.ModuleList(responses)
        self.oversampling = odd

    def _normal_part(self) -> tuple[TailedResponse | None, Tensor, Tensor] | None:
        """The one tailed response, delay and standard deviation of all cores; None where that is not all there is."""
        parts = list(self.responses)
        tailed = [r for r in parts if isinstance(r, TailedResponse)]
        if len(tailed) > 1 or not all(isinstance(r, (GaussianResponse, TailedResponse)) for r in parts):
            return None
        delay = torch.stack([r.delay_s for r in parts]).sum()  # type: ignore[misc]
        sigma = torch.stack([r.sigma_s for r in parts]).square().sum().sqrt()  # type: ignore[misc]
        return (tailed[0] if tailed else None), delay, sigma

    def cdf(self, time_s: Tensor) -> Tensor:
        """Without a closed form: from a histogram of 2000 bins, 1e-6 off where the parts are of one size."""
        if len(self.responses) == 1:
            return self.responses[0].cdf(time_s)  # type: ignore[operator, no-any-return]
        found = self._normal_part()
        if found is None:
            shares, width_s, start_s = self._table()
            return _below(shares, width_s, start_s, time_s)
        tailed, delay, sigma = found
        return normal_cdf((time_s - delay) / sigma) if tailed is None else tailed.widened_cdf(time_s, delay, sigma)

    def survival(self, time_s: Tensor) -> Tensor:
        if len(self.responses) == 1:
            return self.responses[0].survival(time_s)  # type: ignore[operator, no-any-return]
        found = self._normal_part()
        if found is None:
            shares, width_s, start_s = self._table()
            # seen from its end, the response runs the other way
            return _below(shares.flip(0), width_s, -(start_s + shares.numel() * width_s), -time_s)
        tailed, delay, sigma = found
        if tailed is None:
            return normal_cdf((delay - time_s) / sigma)
        above: Tensor = tailed.widened_survival(time_s, delay, sigma)
        return above

    def _table(self) -> tuple[Tensor, float, float]:
        """Shares (K,) in bins of a width that suits the response, and where the first begins."""
        low, high = self.support_s()
        width_s = (high - low) / _TABLE
        first, shares = self.kernel(width_s)
        return shares, width_s, (first - 0.5) * width_s

    def integrals(self, time_s: Tensor) -> tuple[Tensor, Tensor] | None:
        found = self._normal_part()
        if found is None:
            return None
        tailed, delay, sigma = found
        if tailed is None:
            return normal_integrals(time_s, delay, sigma)
        return tailed.widened_integrals(time_s, delay, sigma)

    def support_s(self) -> tuple[float, float]:
        # the sum of all supports holds all of it, and more
        ends = [r.support_s() for r in self.responses]  # type: ignore[operator]
        return sum(low for low, _ in ends), sum(high for _, high in ends)

    def kernel(self, bin_width_s: float, within_bin: WithinBin = "uniform") -> tuple[int, Tensor]:
        check_choice(within_bin, WithinBin, "within_bin", "ComposedResponse")
        if len(self.responses) == 1:
            return kernel_of(self.responses[0], bin_width_s, within_bin)  # type: ignore[arg-type]
        if within_bin == "uniform" and self._normal_part() is not None:
            first, last = self._lags(bin_width_s)
            if last - first <= CLOSED_BINS:
                return super().kernel(bin_width_s)
        fine = self.oversampling
        parts = [kernel_of(r, bin_width_s / fine, within_bin) for r in self.responses]  # type: ignore[arg-type]
        first = sum(begin for begin, _ in parts)
        total = functools.reduce(_full_convolution, [weights for _, weights in parts])
        # a fine lag goes to the bin round(lag/fine), or, where light is spread evenly, to two bins by linear shares,
        # which are `fine` such roundings from all places of a bin
        places = [(fine - 1) // 2] if within_bin == "center" else range(fine)
        coarse = first // fine
        tops = [_gathered(total, first + place - coarse * fine, fine, len(total) // fine + 3) for place in places]
        shares = torch.stack(tops).mean(0)
        return coarse, shares / shares.sum()


def _below(shares: Tensor, width_s: float, start_s: float, time_s: Tensor) -> Tensor:
    """Sum of a histogram before each time, even within its bins."""
    times = time_s.reshape(-1)
    edges = torch.cat([times.new_full((1,), start_s - width_s), times])
    return resample_counts(shares, width_s, edges, start_s=start_s).cumsum(0).reshape(time_s.shape)


def _gathered(fine_shares: Tensor, before: int, fine: int, bins: int) -> Tensor:
    """Sums over `fine` neighbours each, the first entry standing `before` entries into the first of `bins` sums."""
    padded = torch.nn.functional.pad(fine_shares, (before, bins * fine - before - fine_shares.numel()))
    return padded.view(bins, fine).sum(1)


def _full_convolution(a: Tensor, b: Tensor) -> Tensor:
    length = a.numel() + b.numel() - 1
    return filter_rows(a, torch.fft.rfft(b, n=length), length, 0, length)
