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
from torch import Tensor

from torchtransient.checks import Numbers
from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.sensing.checks import check_choice, check_number, check_seconds, reals
from torchtransient.sensing.parameters import keep_number, remembered
from torchtransient.sensing.sensor import PhysicalModule

# --------------------------------------------------------------------------------------------------------- closed forms


FWHM_PER_SIGMA = 2 * math.sqrt(2 * math.log(2))  # 2.3548


def normal_cdf(u: Tensor) -> Tensor:
    """Cumulative normal distribution, with relative precision for u far below 0.

    Args:
        u: standard deviations above the mean, any shape.
    """
    share: Tensor = 0.5 * torch.special.erfc(-u / math.sqrt(2))
    return share


def normal_integral(u: Tensor) -> Tensor:
    """Integral of `normal_cdf` up to u: u Phi(u) + phi(u), to 1e-13 of itself down to u = -30.

    Args:
        u: standard deviations above the mean, any shape.
    """
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


def emg_cdf(time_s: Tensor, mean_s: Tensor, sigma_s: Tensor, tau_s: Tensor) -> Tensor:
    """Share of an exponentially modified Gaussian, a normal delay plus an exponential one, before each time.

    Stable for every ratio of the two. Source: Grushka, Anal. Chem. 44 (1972); erfcx form as in Kalambet et al., J.
    Chemometrics 25 (2011).

    Args:
        time_s: times in seconds; all arguments broadcast.
        mean_s: mean of the normal part, in seconds.
        sigma_s: standard deviation of the normal part, in seconds.
        tau_s: mean of the exponential part, in seconds.
    """
    u = (time_s - mean_s) / sigma_s
    return normal_cdf(u) - _tail_term(u, sigma_s / tau_s)


def emg_survival(time_s: Tensor, mean_s: Tensor, sigma_s: Tensor, tau_s: Tensor) -> Tensor:
    """Share of an exponentially modified Gaussian after each time, with relative precision far out in the tail.

    Args:
        time_s: times in seconds; all arguments broadcast.
        mean_s: mean of the normal part, in seconds.
        sigma_s: standard deviation of the normal part, in seconds.
        tau_s: mean of the exponential part, in seconds.
    """
    u = (time_s - mean_s) / sigma_s
    return normal_cdf(-u) + _tail_term(u, sigma_s / tau_s)


def normal_integrals(time_s: Tensor, mean_s: Tensor, sigma_s: Tensor) -> tuple[Tensor, Tensor]:
    """Integrals of the cumulative normal up to each time and of its survival from there on.

    Args:
        time_s: times in seconds.
        mean_s: mean in seconds.
        sigma_s: standard deviation in seconds.

    Returns:
        Both in seconds.
    """
    u = (time_s - mean_s) / sigma_s
    return sigma_s * normal_integral(u), sigma_s * normal_integral(-u)


def emg_integrals(time_s: Tensor, mean_s: Tensor, sigma_s: Tensor, tau_s: Tensor) -> tuple[Tensor, Tensor]:
    """Integrals of `emg_cdf` up to each time and of `emg_survival` from there on.

    The tail term is tau times the density, so that its integral is tau times the cumulative.

    Args:
        time_s: times in seconds.
        mean_s: mean of the normal part, in seconds.
        sigma_s: standard deviation of the normal part, in seconds.
        tau_s: mean of the exponential part, in seconds.

    Returns:
        Both in seconds.
    """
    below, above = normal_integrals(time_s, mean_s, sigma_s)
    cdf, survival = emg_cdf(time_s, mean_s, sigma_s, tau_s), emg_survival(time_s, mean_s, sigma_s, tau_s)
    return below - tau_s * cdf, above + tau_s * survival


def integrated_counts(counts: Tensor, width_s: float, time_s: Tensor, start_s: float | Tensor = 0.0) -> Tensor:
    """Integrate, up to each time, the counts that lie before.

    Counts are spread evenly over each bin, so that the result is quadratic inside the bins. Differentiable in the
    counts, the times and the start.

    Args:
        counts: (T,).
        width_s: bin width in seconds.
        time_s: times (K,) in seconds.
        start_s: start of the first bin in seconds.

    Returns:
        (K,) float64, counts times seconds.
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


def counts_before(counts: Tensor, width_s: float, time_s: Tensor, start_s: float | Tensor = 0.0) -> Tensor:
    """Sum the counts that lie before each time, spread evenly over each bin.

    Differentiable in the counts, the times and the start.

    Args:
        counts: (T,).
        width_s: bin width in seconds.
        time_s: times in seconds, any shape.
        start_s: start of the first bin in seconds.

    Returns:
        Shape of `time_s`, float64.
    """
    cumulative = torch.nn.functional.pad(counts.to(torch.float64).cumsum(0), (1, 0))
    bins = counts.shape[0]
    position = ((time_s.to(torch.float64) - start_s) / width_s).clamp(0, bins)
    below = position.floor().clamp_max(bins - 1).long()
    return cumulative[below] + (position - below) * (cumulative[below + 1] - cumulative[below])


def resample_counts(counts: Tensor, width_s: float, edges_s: Tensor, *, start_s: float | Tensor = 0.0) -> Tensor:
    """Resample a histogram to new bins by integrating: sums are conserved.

    Counts are spread evenly over each bin; those outside of the new edges are left out. Differentiable in the counts,
    the edges and the start.

    Args:
        counts: (T,).
        width_s: bin width in seconds.
        edges_s: new edges (K + 1,) in seconds, increasing.
        start_s: start of the first bin in seconds.

    Returns:
        (K,) float64.

    Raises:
        ShapeError: for other shapes.
        UnitError: for numbers that are not real.
    """
    me = "resample_counts"
    counts, edges_s = reals(me, torch.float64, counts=counts, edges_s=edges_s)
    if counts.ndim != 1 or edges_s.ndim != 1 or not counts.numel():
        raise ShapeError(f"{me}: expected counts (T,) of one bin or more and edges_s (K + 1,), got "
                         f"{tuple(counts.shape)} and {tuple(edges_s.shape)}.")  # fmt: skip
    return counts_before(counts, width_s, edges_s, start_s).diff()


def above_floor(counts: Tensor, floor: float | bool, where: str) -> Tensor:
    """Take the background off a measured histogram and normalise the rest.

    Args:
        counts: (T,).
        floor: background of every bin: True for the median of all bins, which is the background when the response fills
            less than half of them; False for none; a number of counts of every bin.
        where: name of the caller, for errors.

    Returns:
        (T,) float64, not below 0, sum 1.

    Raises:
        UnitError: for other floors, and where nothing is left.
    """
    numbers = counts.to(torch.float64)
    if isinstance(floor, bool):
        level = float(numbers.median()) if floor else 0.0
    else:
        level = check_number(floor, "floor", where)
    clean = (numbers - level).clamp_min(0)
    if not float(clean.sum()) > 0:
        raise UnitError(f"{where}: expected counts above the floor of {level:g}, got none.")
    return clean / clean.sum()


# ------------------------------------------------------------------------------------------------------------ responses


WithinBin = Literal["uniform", "center"]
Core = tuple[Tensor, Tensor]  # delay and standard deviation of a normal part, in seconds

_OUTSIDE = 1e-9  # share of a response that a kernel may leave out on each side before it is normalised
_MOST_BINS = 1 << 24  # more is a unit gone wrong or a width that ran away, and takes all memory
_SIGMAS = 6.0  # a normal distribution has that share outside
# second differences lose the square of the length in bins of their digits; a mean over nodes loses one power of it
CLOSED_BINS = 4096
_MOST_PANELS = 4096


class Response(PhysicalModule):
    """Base of distributions of delays.

    A subclass defines `cdf` and `support_s`. `survival` and `integrals` are for better digits and less time: without
    them `kernel` is right to 1e-9 where `cdf` is smooth over an eighth of the support, and to 1e-3 where it has
    corners.

    Args:
        delay_s: shift in seconds.
        learnable: make the numbers `nn.Parameter`s in place of buffers.

    Raises:
        UnitError: for delays of a millisecond and more.
    """

    delay_ps: Tensor

    def __init__(self, delay_s: float, learnable: bool) -> None:
        super().__init__()
        self.learnable = bool(learnable)
        delay = check_seconds(delay_s, "delay_s", type(self).__name__, signed=True)
        self._hold("delay_ps", torch.tensor(delay * 1e12, dtype=torch.float64))

    def _hold(self, name: str, value: Tensor) -> None:
        keep_number(self, name, value, self.learnable)

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
        """Share of the response before each time, float64, differentiable in time and parameters.

        Args:
            time_s: times in seconds, any shape.
        """
        raise NotImplementedError(f"{type(self).__name__} has to define cdf.")

    def survival(self, time_s: Tensor) -> Tensor:
        """Share of the response after each time.

        Args:
            time_s: times in seconds, any shape.
        """
        return 1 - self.cdf(time_s)

    def support_s(self) -> tuple[float, float]:
        """Return the times in seconds between which all but about 1e-9 of the response lies."""
        raise NotImplementedError(f"{type(self).__name__} has to define support_s.")

    def integrals(self, time_s: Tensor) -> tuple[Tensor, Tensor] | None:
        """Integrals of `cdf` up to each time and of `survival` from there on, float64, in seconds.

        Args:
            time_s: times in seconds, (K,).

        Returns:
            None without a closed form: `kernel` then integrates `cdf` and `survival` numerically.
        """
        return None

    def mass(self, edges_s: Tensor) -> Tensor:
        """Share between consecutive edges, not below 0, with relative precision in the tails.

        Shares of bins for light that arrives at one known time; `kernel` is for light that is known to a bin.

        Args:
            edges_s: (..., K + 1), in seconds.

        Returns:
            (..., K).
        """
        return _between(self.cdf(edges_s), self.survival(edges_s)).clamp_min(0)  # rounding

    def kernel(self, bin_width_s: float, within_bin: WithinBin = "uniform") -> tuple[int, Tensor]:
        """Shares of the light of a bin that arrive some bins later.

        Args:
            bin_width_s: bin width in seconds.
            within_bin: "uniform" for light that lies evenly in its bin, exact by the second difference of the
                integrated distribution; "center" for light in the middle.

        Returns:
            First lag in bins, and shares (K,) float64 of the lags from there on, summing to 1.

        Raises:
            UnitError: for parameters that are not finite and for responses of more than 2^24 bins.
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
        mass = _between(self.cdf(flat).view(edges.shape).T, self.survival(flat).view(edges.shape).T)
        return mass.T.contiguous() @ weight


def _between(below: Tensor, above: Tensor) -> Tensor:
    """Differences of a cumulative distribution, beyond the median of its survival."""
    late = (below > 0.5)[..., :-1]
    return torch.where(late, above[..., :-1] - above[..., 1:], below.diff(dim=-1))


def kernel_of(response: Response, bin_width_s: float, within_bin: WithinBin) -> tuple[int, Tensor]:
    """Return `Response.kernel`, from a cache while nothing is learnt.

    A response with a kernel of its own may leave out the argument `within_bin`.

    Args:
        response: the response.
        bin_width_s: bin width in seconds.
        within_bin: "uniform" or "center".

    Returns:
        First lag in bins, and shares (K,).

    Raises:
        ArgumentError: for other objects, such as a histogram.
    """
    if not isinstance(response, Response):
        raise ArgumentError(
            f"expected a response such as GaussianResponse, got {type(response).__name__}. A measured histogram goes "
            "into MeasuredResponse(counts, bin_width_s)."
        )

    def kernel() -> tuple[int, Tensor]:
        return response.kernel(bin_width_s) if within_bin == "uniform" else response.kernel(bin_width_s, within_bin)

    return remembered(response, ("kernel", bin_width_s, within_bin), kernel)


class GaussianResponse(Response):
    """Normal distribution of delays.

    Args:
        fwhm_s: full width at half maximum in seconds, 2.3548 standard deviations.
        delay_s: mean delay in seconds.
        learnable: learn the logarithm of the width, and the delay in picoseconds.

    Raises:
        UnitError: for numbers that are no seconds.
    """

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

    # `core` is another delay and standard deviation, of this response and other normal ones together

    def cdf(self, time_s: Tensor, core: Core | None = None) -> Tensor:
        delay, sigma = core or (self.delay_s, self.sigma_s)
        return normal_cdf((time_s - delay) / sigma)

    def survival(self, time_s: Tensor, core: Core | None = None) -> Tensor:
        delay, sigma = core or (self.delay_s, self.sigma_s)
        return normal_cdf((delay - time_s) / sigma)

    def integrals(self, time_s: Tensor, core: Core | None = None) -> tuple[Tensor, Tensor]:
        return normal_integrals(time_s, *(core or (self.delay_s, self.sigma_s)))

    def support_s(self) -> tuple[float, float]:
        delay, reach = float(self.delay_s.detach()), _SIGMAS * float(self.sigma_s.detach())
        return delay - reach, delay + reach


class UniformResponse(Response):
    """Equal probability over a width: a clock without dither, or a square pulse.

    Args:
        width_s: full width in seconds.
        delay_s: delay of the middle in seconds.
        learnable: learn the logarithm of the width, and the delay in picoseconds.

    Raises:
        UnitError: for numbers that are no seconds.
    """

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
    """Gaussian core with exponential diffusion tails: fraction_0 N + sum of fraction_i (N + Exp(tail_s[i])).

    One tail of fraction 1 is the exponentially modified Gaussian; two tails are the model of Hernandez et al., A
    computational model of a single-photon avalanche diode sensor (arXiv 1703.02635). The mean lies sum(fraction_i
    tail_i) behind `delay_s`.

    Args:
        fwhm_s: full width at half maximum of the core, in seconds.
        tails_s: mean delays of the tails, in seconds.
        fractions: share of light in each tail, positive, in all at most 1; the core has the rest.
        delay_s: delay of the core, in seconds.
        learnable: learn logarithms of widths, logits of shares, and the delay in picoseconds.

    Raises:
        ShapeError: for unequal numbers of tails and fractions.
        UnitError: for numbers out of range.
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
        mixed = (self.fractions * tail).sum(-1)
        return mixed + shares[0] * core if self.has_core else mixed

    # `core` as in `GaussianResponse`

    def cdf(self, time_s: Tensor, core: Core | None = None) -> Tensor:
        delay, sigma = core or (self.delay_s, self.sigma_s)
        tail = emg_cdf(time_s.unsqueeze(-1), delay, sigma, self.tails_s)
        return self._mix(time_s, normal_cdf((time_s - delay) / sigma), tail)

    def survival(self, time_s: Tensor, core: Core | None = None) -> Tensor:
        delay, sigma = core or (self.delay_s, self.sigma_s)
        tail = emg_survival(time_s.unsqueeze(-1), delay, sigma, self.tails_s)
        return self._mix(time_s, normal_cdf((delay - time_s) / sigma), tail)

    def integrals(self, time_s: Tensor, core: Core | None = None) -> tuple[Tensor, Tensor]:
        delay, sigma = core or (self.delay_s, self.sigma_s)
        normal = normal_integrals(time_s, delay, sigma)
        tail = emg_integrals(time_s.unsqueeze(-1), delay, sigma, self.tails_s)
        below, above = (self._mix(time_s, n, t) for n, t in zip(normal, tail, strict=True))
        return below, above

    def support_s(self) -> tuple[float, float]:
        delay, reach = float(self.delay_s.detach()), _SIGMAS * float(self.sigma_s.detach())
        return delay - reach, delay + reach - math.log(_OUTSIDE) * float(self.tails_s.detach().max())


def emg_response(fwhm_s: float, tau_s: float, delay_s: float = 0.0, *, learnable: bool = False) -> TailedResponse:
    """Make an exponentially modified Gaussian: normal jitter plus an exponential delay.

    Args:
        fwhm_s: full width at half maximum of the normal part, in seconds.
        tau_s: mean of the exponential part, in seconds.
        delay_s: delay of the normal part, in seconds.
        learnable: learn logarithms of widths, logits of shares, and the delay in picoseconds, see `TailedResponse`.
    """
    return TailedResponse(fwhm_s, [tau_s], [1.0], delay_s=delay_s, learnable=learnable)
