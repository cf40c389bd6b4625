"""Afterpulses on counts: detections triggered by carriers that an earlier one left behind, and laws of their delays.

Delays of afterpulses count from the detection. A carrier that is released while the detector is dead makes no
detection: laws of delays are cut off at the dead time. Time is in bins; a detection is spread evenly over its bin.

Sources: several exponentials: Cova, Lacaita, Ripamonti, Trapping phenomena in avalanche photodiodes on nanosecond scale
(IEEE EDL 1991). Power law: Itzler, Jiang, Entwistle, Power law temporal dependence of InGaAs/InP SPAD afterpulsing
(Journal of Modern Optics 2012).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.checks import Numbers, shown
from torchtransient.errors import ShapeError, UnitError
from torchtransient.floating import in_single, number_tensor
from torchtransient.sensing.checks import (
    TIME,
    bins_from,
    check_choice,
    check_number,
    check_seconds,
    check_transient,
    one_number,
    reals,
)
from torchtransient.sensing.counts import AddedCounts
from torchtransient.sensing.draws import LagTable, by_pieces, sixteen_bits, thin
from torchtransient.sensing.parameters import check_map, keep_map, keep_number, kept_map, over_time, remembered
from torchtransient.sensing.responses import above_floor
from torchtransient.sensing.sensor import GradPolicy, PhysicalModule
from torchtransient.sensing.time_convolution import filter_rows

CountedFrom = Literal["dead_time", "avalanche"]

_LONGEST_LAW = 1 << 23  # bins of a law of delays that ends
_NODES, _WEIGHTS = (values.tolist() for values in np.polynomial.legendre.leggauss(8))  # on [-1, 1]
_ENTRIES = 1 << 17  # at a time, so that temporaries stay in the cache
_WORTH_TABLE = 1 << 16  # entries, above which the lags of afterpulses are looked up
_FEW = 1 << 12  # places, below which one slow operation takes less time than several fast ones
_VALUES = 1 << 16  # of a random number of 16 bits
_LONGEST_TABLE = 1 << 14  # bins of a period, above which a table of 2^16 cells says little
_FINE = 2.0**14  # bins of a period, or of a delay, up to which single precision places afterpulses
_MOST = 0.5  # afterpulses of a detection


# ------------------------------------------------------------------------------------------------------- laws of delays


def exponential_shares(tau_bins: Tensor, dead_bins: float, first: int, number: int) -> Tensor:
    """Share of afterpulses in bins after their detection, for exponential delays.

    Args:
        tau_bins: time constants (K,) in bins.
        dead_bins: dead time in bins.
        first: first bin after the detection.
        number: number of bins.

    Returns:
        (K, number).
    """
    tau = tau_bins.unsqueeze(1)
    k = torch.arange(first - 1, first + number, dtype=torch.float64, device=tau.device)
    # mean over the bin of the chance that the afterpulse is yet to come: 1 while the detector is dead
    begin = torch.minimum(k.clamp_min(dead_bins), k + 1)
    late = tau * torch.exp(-(begin - dead_bins).clamp_min(0) / tau) * -torch.expm1(-(k + 1 - begin) / tau)
    yet = begin - k + late
    return yet[:, :-1] - yet[:, 1:]


def exponential_kernel(tau_bins: Tensor, dead_bins: float, period_bins: int) -> Tensor:
    """Shares of all bins after a detection, folded into one period; see `exponential_shares`.

    Args:
        tau_bins: time constants (K,) in bins.
        dead_bins: dead time in bins.
        period_bins: bins of the period.

    Returns:
        (K, period_bins), every sum 1.
    """
    start = math.floor(dead_bins)
    shares = exponential_shares(tau_bins, dead_bins, start, 3 * period_bins).view(-1, 3, period_bins)
    # two bins are cut by the dead time; those of the third round and all later ones are a geometric series
    rest = shares[:, 2] / -torch.expm1(-period_bins / tau_bins).unsqueeze(1)
    return (shares[:, 0] + shares[:, 1] + rest).roll(start % period_bins, -1)


class AfterpulseDelays(PhysicalModule):
    """Law of delays of afterpulses that ends, for `Afterpulsing(probability, dead_time_s=..., delays=law)`.

    Delays count from the detection, not from the end of its dead time, and end after a finite `end_s`. Subclasses
    define `end_s`, `released_after`, `yet_to_come` and `draw`; a law whose share yet to come has a closed integral, or
    an infinite slope within a bin, overrides `mean_yet_to_come`.
    """

    def end_s(self) -> float:
        """Longest delay in seconds, finite: nothing is yet to come beyond it."""
        raise NotImplementedError(f"{type(self).__name__} has to define end_s().")

    def released_after(self, dead_time_s: float) -> Tensor | float:
        """Share of all carriers that are released after the dead time.

        Args:
            dead_time_s: dead time in seconds.

        Raises:
            UnitError: for a law that is infinite at delay 0.
        """
        raise NotImplementedError(f"{type(self).__name__} has to define released_after(dead_time_s).")

    def yet_to_come(self, delay: Tensor, dead_time_s: float, bin_width_s: float) -> Tensor:
        """Share of the afterpulses after the dead time that come later than a delay.

        Args:
            delay: (N,) float64, bins after the detection, at least the dead time; possibly beyond `end_s`.
            dead_time_s: dead time in seconds.
            bin_width_s: bin width in seconds, of the delay.

        Returns:
            (N,) float64, 1 at the dead time, 0 from `end_s` on.

        Raises:
            UnitError: for a dead time beyond the law.
        """
        raise NotImplementedError(f"{type(self).__name__} has to define yet_to_come(delay, dead time, bin width).")

    def mean_yet_to_come(self, k: Tensor, dead_time_s: float, bin_width_s: float) -> Tensor:
        """Mean of `yet_to_come` over the bin from `k` to `k` + 1, 1 while the detector is dead.

        By a Gauss-Legendre rule of 8 points behind the dead time. Shares of bins are within 1e-6 for bins as long as
        the dead time, within 3e-4 where the law ends in a bin or falls by several decades there.

        Args:
            k: (N,) float64, bins after the detection. A detection is spread evenly over its bin, so that `shares`
                begin with `k` = -1, one bin before the detection.
            dead_time_s: dead time in seconds.
            bin_width_s: bin width in seconds.

        Returns:
            (N,) float64.
        """
        dead = dead_time_s / bin_width_s
        begin = torch.minimum(k.clamp_min(dead), k + 1)
        half, mean = (k + 1 - begin) / 2, torch.zeros_like(k)
        for node, weight in zip(_NODES, _WEIGHTS, strict=True):
            delay = (begin + half * (1 + node)).clamp_min(dead)
            mean = mean + 0.5 * weight * self.yet_to_come(delay, dead_time_s, bin_width_s)
        return begin - k + 2 * half * mean

    def draw(self, number: int, dead_time_s: float, generator: torch.Generator | None) -> Tensor:
        """Draw delays beyond the dead time.

        Args:
            number: number of delays.
            dead_time_s: dead time in seconds.
            generator: source of randomness.

        Returns:
            (number,) float64, seconds after the detection.
        """
        raise NotImplementedError(f"{type(self).__name__} has to define draw(number, dead time, generator).")

    def shares(self, dead_time_s: float, bin_width_s: float, *, first: int, number: int) -> Tensor:
        """Share of afterpulses in bins `first`, `first` + 1, ... after their detection.

        Args:
            dead_time_s: dead time in seconds.
            bin_width_s: bin width in seconds.
            first: first bin.
            number: number of bins.

        Returns:
            (number,) float64.
        """
        device = next((t.device for t in [*self.parameters(), *self.buffers()]), None)
        k = torch.arange(first - 1, first + number, dtype=torch.float64, device=device)
        yet = self.mean_yet_to_come(k, dead_time_s, bin_width_s)
        return yet[:-1] - yet[1:]

    def kernel(self, dead_time_s: float, bin_width_s: float, period_bins: int) -> Tensor:
        """Shares of all bins, folded into one period.

        Args:
            dead_time_s: dead time in seconds.
            bin_width_s: bin width in seconds.
            period_bins: period in bins.

        Returns:
            (period_bins,) float64, sum 1.

        Raises:
            UnitError: for a law of more than 2^23 bins.
        """
        number = math.ceil(self.end_s() / bin_width_s) + 2
        if number > _LONGEST_LAW:
            raise UnitError(
                f"{type(self).__name__}: expected delays of at most {_LONGEST_LAW} bins, got {number} bins of "
                f"{bin_width_s:g} s. Let the law end earlier, or use wider bins."
            )
        shares = self.shares(dead_time_s, bin_width_s, first=0, number=number)
        rounds = -(-number // period_bins)
        return torch.nn.functional.pad(shares, (0, rounds * period_bins - number)).view(rounds, period_bins).sum(0)


class PowerLawDelays(AfterpulseDelays):
    """Afterpulses whose rate falls as delay^-exponent, from the end of the dead time to `longest_s`.

    Measured exponents are about 1 to 1.4 (Itzler et al. 2012, InGaAs/InP). The law diverges at delay 0: it needs a dead
    time above zero, and its `probability` counts what comes after it.

    Args:
        exponent: exponent of the law, in (0, 10].
        longest_s: longest delay in seconds.
        learnable: make `log_exponent` a parameter.

    Raises:
        UnitError: for exponents outside (0, 10].
    """

    log_exponent: Tensor

    def __init__(self, exponent: float, longest_s: float, *, learnable: bool = False) -> None:
        super().__init__()
        value = check_number(exponent, "exponent", "PowerLawDelays", high=10.0, open_low=True)
        self.longest_s = check_seconds(longest_s, "longest_s", "PowerLawDelays", open_low=True)
        tensor = torch.tensor(math.log(value), dtype=torch.float64)
        keep_number(self, "log_exponent", tensor, learnable)

    def end_s(self) -> float:
        return self.longest_s

    def released_after(self, dead_time_s: float) -> float:
        raise UnitError(
            "PowerLawDelays: expected counted_from='dead_time', got 'avalanche'. The law is infinite at delay 0; give "
            "the probability of what comes after the dead time."
        )

    @property
    def exponent(self) -> Tensor:
        """Exponent of the law, float64."""
        return self.log_exponent.double().exp()

    def _limits(self, dead_time_s: float) -> float:
        """Logarithm of the longest delay over the dead time."""
        if not 0 < dead_time_s < self.longest_s:
            raise UnitError(
                f"PowerLawDelays: expected a dead time above 0 and below longest_s = {self.longest_s:g} s, where the "
                f"law begins, got {dead_time_s:g} s."
            )
        return math.log(self.longest_s / dead_time_s)

    def _growth(self, log_x: Tensor) -> Tensor:
        """Integral of x^-exponent from 1 on, as a function of log x."""
        a = 1 - self.exponent
        flat = a.abs() < 1e-6
        safe = torch.where(flat, torch.ones_like(a), a)
        return torch.where(flat, log_x * (1 + a * log_x / 2), torch.expm1(safe * log_x) / safe)

    def yet_to_come(self, delay: Tensor, dead_time_s: float, bin_width_s: float) -> Tensor:
        end = self._limits(dead_time_s)
        total = self._growth(torch.tensor(end, dtype=torch.float64, device=delay.device))
        return 1 - self._growth(torch.log(delay / (dead_time_s / bin_width_s)).clamp_max(end)) / total

    def draw(self, number: int, dead_time_s: float, generator: torch.Generator | None) -> Tensor:
        end, device = self._limits(dead_time_s), self.log_exponent.device
        u = torch.rand(number, dtype=torch.float64, device=device, generator=generator)
        a = 1 - float(self.exponent.detach())
        if abs(a) < 1e-6:
            return dead_time_s * torch.exp(u * end)
        return dead_time_s * torch.exp(torch.log1p(u * math.expm1(a * end)) / a)


class MeasuredDelays(AfterpulseDelays):
    """Delays by a measured histogram, counts spread evenly over their bins.

    Args:
        counts: (K,) counts >= 0.
        bin_width_s: width of its bins in seconds.
        start_s: delay at which the first bin begins, in seconds.
        floor: counts of a bin that are no afterpulses (dark counts), taken off; True: the median of all bins.

    Raises:
        ShapeError: for counts that are not (K,).
        UnitError: for counts that are negative, not finite, or all below the floor.
    """

    share_of_bins: Tensor

    def __init__(self, counts: Tensor, bin_width_s: float, *, start_s: float = 0.0, floor: float | bool = 0.0) -> None:
        super().__init__()
        where = "MeasuredDelays"
        counts = number_tensor(counts, f"{where}: expected counts (K,) of a histogram of delays")
        if counts.ndim != 1 or counts.numel() == 0:
            raise ShapeError(f"{where}: expected counts (K,) of a histogram of delays, got {tuple(counts.shape)}.")
        numbers = counts.detach().double()
        if not bool((numbers >= 0).all()) or not bool(torch.isfinite(numbers).all()):
            raise UnitError(f"{where}: expected finite counts >= 0. Look at the measurement.")
        shares = above_floor(numbers, floor, where)
        self.own_width_s = check_seconds(bin_width_s, "bin_width_s", where, open_low=True)
        self.start_s = check_seconds(start_s, "start_s", where)
        self.register_buffer("share_of_bins", shares)

    def end_s(self) -> float:
        return self.start_s + self.share_of_bins.numel() * self.own_width_s

    def released_after(self, dead_time_s: float) -> float:
        place = (dead_time_s - self.start_s) / self.own_width_s
        whole = min(max(math.floor(place), 0), self.share_of_bins.numel() - 1)
        part = min(max(place - whole, 0.0), 1.0)
        shares = self.share_of_bins.double()
        left = 1 - float(shares[:whole].sum() + part * shares[whole])
        if left <= 0:
            raise UnitError(
                f"MeasuredDelays: expected delays beyond the dead time of {dead_time_s:g} s, but the histogram ends at "
                f"{self.end_s():g} s with nothing left. Measure for longer."
            )
        return left

    def yet_to_come(self, delay: Tensor, dead_time_s: float, bin_width_s: float) -> Tensor:
        shares, yet, left = self._polygon(dead_time_s)
        inside = ((delay * bin_width_s - self.start_s) / self.own_width_s).clamp(0, shares.numel())
        whole = inside.floor().clamp_max(shares.numel() - 1).long()
        return (yet[whole] - (inside - whole) * shares[whole]) / left

    def _polygon(self, dead_time_s: float) -> tuple[Tensor, Tensor, float]:
        """Shares of bins (K,), shares yet to come at their edges (K + 1,), and the share after the dead time."""
        shares = self.share_of_bins.double()
        return shares, torch.cat([shares.new_ones(1), 1 - shares.cumsum(0)]), self.released_after(dead_time_s)

    def mean_yet_to_come(self, k: Tensor, dead_time_s: float, bin_width_s: float) -> Tensor:
        # exact: what is yet to come is a polygon
        shares, yet, left = self._polygon(dead_time_s)
        # integral over delays of what is yet to come, in own bins, a parabola in each
        sums = torch.cat([yet.new_zeros(1), (0.5 * (yet[:-1] + yet[1:])).cumsum(0)])
        dead = dead_time_s / bin_width_s

        def integral(place: Tensor) -> Tensor:
            own = (place * bin_width_s - self.start_s) / self.own_width_s
            inside = own.clamp(0, shares.numel())
            whole = inside.floor().clamp_max(shares.numel() - 1).long()
            part = inside - whole
            curve = sums[whole] + part * yet[whole] - 0.5 * part**2 * shares[whole]
            return (curve + own.clamp_max(0)) * (self.own_width_s / bin_width_s)

        begin = torch.minimum(k.clamp_min(dead), k + 1)
        return begin - k + (integral(k + 1) - integral(begin)) / left

    def draw(self, number: int, dead_time_s: float, generator: torch.Generator | None) -> Tensor:
        # from the end on: what is yet to come is above 0 and at most all, which ends in a bin that holds something
        shares = self.share_of_bins.double().flip(0)
        sums = shares.cumsum(0)
        u = torch.rand(number, dtype=torch.float64, device=shares.device, generator=generator)
        yet = self.released_after(dead_time_s) * (1 - u) * sums[-1]
        later = torch.searchsorted(sums, yet)
        place = shares.numel() - 1 - later + (sums[later] - yet) / shares[later]
        return (self.start_s + place * self.own_width_s).clamp_min(dead_time_s)


# ---------------------------------------------------------------------------------------------------------- afterpulses


@in_single
def add_afterpulses(counts: Tensor, probability: Tensor | float, kernel: Tensor) -> Tensor:
    """Mean histogram with afterpulses, and afterpulses of afterpulses: counts * (1 - probability kernel)^-1.

    The window is the first T bins of a period of P; afterpulses outside of it are lost. With P = T sums grow by 1/(1 -
    probability) exactly. Computed in float64 by FFT round the period; differentiable in all three tensors.

    Args:
        counts: (..., C, T, H, W).
        probability: afterpulses of a detection.
        kernel: (P,), P >= T, afterpulses k bins after their detection, up to the factor `probability`. That of
            `Afterpulsing.kernel` includes the probability.

    Returns:
        Shape, dtype and device of `counts`.

    Raises:
        ShapeError: for a kernel that is not (P,).
        UnitError: for P < T.
    """
    check_transient(counts, "add_afterpulses")
    (kernel,) = reals("add_afterpulses", kernel=kernel)
    if kernel.ndim != 1:
        raise ShapeError(f"add_afterpulses: expected a kernel (P,), got {tuple(kernel.shape)}.")
    _check_period(kernel.shape[0], bins := counts.shape[TIME])
    p = one_number(probability, "probability", "add_afterpulses")
    p = torch.as_tensor(p, dtype=torch.float64, device=counts.device)
    return counts + _filtered(counts, *_gain(p, kernel.to(counts.device, torch.float64), bins))


def _gain(probability: Tensor | float, kernel: Tensor, bins: int) -> tuple[Tensor, int]:
    """Transfer function from detections to all generations of afterpulses, and its length."""
    period = kernel.shape[0]
    transfer = probability * torch.fft.rfft(kernel)
    # only what is added is transformed: the detections themselves keep all their digits
    gain = transfer / (1 - transfer)
    if period <= 2 * bins:
        return gain, period
    # of a long period only the lags between two bins of the window matter, forwards and round the period
    response = torch.fft.irfft(gain, n=period)
    near = torch.cat([response[:bins], response.new_zeros(1), response[period - bins + 1 :]])
    return torch.fft.rfft(near), 2 * bins


def _filtered(counts: Tensor, gain: Tensor, length: int) -> Tensor:
    # rows of time next to each other: the copy costs less than a transform that strides
    rows = counts.movedim(TIME, -1).contiguous().to(torch.float64)
    return filter_rows(rows, gain, length, 0, counts.shape[TIME]).movedim(-1, TIME).contiguous().to(counts.dtype)


def _check_period(period: int, bins: int) -> None:
    if period < bins:
        raise UnitError(f"add_afterpulses: expected a period of at least the window of {bins} bins, got {period}.")


class Afterpulsing(AddedCounts):
    """Afterpulses on counts, behind the SPAD: every detection triggers others one dead time plus a random time later.

    The histogram is taken round the laser period: afterpulses of one cycle fall into later ones, constant light stays
    constant. Dead time is not applied to the afterpulses themselves, nor do they keep photons from being seen: right in
    dim light (`AfterpulsingSPAD` for the rest). A period longer than the window has counts outside of it, whose
    afterpulses fall into the window: `background` stands for them.

    Args:
        probability: afterpulses of a detection, one number, or one for each of several exponentials (traps).
        tau_s: mean delays beyond the dead time in seconds, as many; exponentials have no memory.
        dead_time_s: dead time in seconds, 0 for none.
        delays: law of delays instead of `tau_s`, cut off at the dead time.
        counted_from: "dead_time": probabilities of afterpulses after the dead time, as in data sheets; "avalanche": of
            all carriers, of which those released during the dead time are not seen.
        axis: time axis, which gives the bin width.
        bin_width_s: bin width in seconds, without an axis.
        period_s: laser period in seconds; None: the window.
        background: constant counts of a bin of the whole exposure outside of the window, a number or (H, W)
            (`PhotonBudget.background_counts`); 0: the detector is dark or off there.
        learnable: make `logit_probability` and `log_tau_s` parameters.
        grad: gradient policy.

    Raises:
        UnitError: for probabilities whose sum is not in (0, 0.5].
        ShapeError: for probabilities and `tau_s` of different numbers.
    """

    logit_probability: Tensor
    log_tau_s: Tensor
    background: float | Tensor

    def __init__(
        self,
        probability: float | Numbers,
        tau_s: float | Numbers | None = None,
        dead_time_s: float | None = None,
        *,
        delays: AfterpulseDelays | None = None,
        counted_from: CountedFrom = "dead_time",
        axis: TimeAxis | None = None,
        bin_width_s: float | None = None,
        period_s: float | None = None,
        background: float | Tensor = 0.0,
        learnable: bool = False,
        grad: GradPolicy = "expected",
    ) -> None:
        super().__init__(grad)
        where = "Afterpulsing"
        if dead_time_s is None or (tau_s is None) == (delays is None):
            got = f"{dead_time_s=}, {tau_s=} and delays={shown(delays)}"
            raise UnitError(f"{where}: expected dead_time_s (0 for none), and either tau_s or delays, got {got}.")
        check_choice(counted_from, CountedFrom, "counted_from", where)
        self.dead_time_s = check_seconds(dead_time_s, "dead_time_s", where)
        self.bin_width_s, self.num_bins = bins_from(axis, bin_width_s, where)
        self.period_s: float | None = None
        self.period_bins: int | None = None
        self.window_is_period = period_s is None
        if period_s is not None:
            self.period_s = check_seconds(period_s, "period_s", where, open_low=True, high=1.0)
            self.period_bins = round(self.period_s / self.bin_width_s)
            _check_period(self.period_bins, 1)
        keep_map(self, "background", check_map(background, "background", where))
        self.delays, self.counted_from = delays, counted_from
        self._keep(probability, [] if tau_s is None else tau_s, learnable)
        if delays is not None:  # says what is wrong with a law and a dead time that do not go together
            delays.shares(self.dead_time_s, self.bin_width_s, first=0, number=1)
            self.seen()

    def _keep(self, probability: float | Numbers, tau_s: float | Numbers, learnable: bool) -> None:
        """Check and register probabilities and delays."""
        where = "Afterpulsing"
        chance, tau = (torch.as_tensor(value, dtype=torch.float64) for value in (probability, tau_s))
        p = [check_number(v, "probability", where, high=_MOST, open_low=True) for v in chance.flatten().tolist()]
        if not p or sum(p) > _MOST:
            raise UnitError(f"{where}: expected a sum of probability in (0, {_MOST:g}], got {p}.")
        numbers = {"logit_probability": [math.log(v / (1 - v)) for v in p]}
        if self.delays is None:
            times = tau.flatten().tolist()
            numbers["log_tau_s"] = [math.log(check_seconds(v, "tau_s", where, open_low=True)) for v in times]
            if len(times) != len(p):
                raise ShapeError(f"{where}: expected as many tau_s as probability, got {len(times)} and {len(p)}.")
        elif chance.ndim:
            raise ShapeError(f"{where}: expected one probability of delays, got {len(p)}.")
        for name, values in numbers.items():
            keep_number(self, name, torch.tensor(values, dtype=torch.float64).view(chance.shape), learnable)

    @property
    def probability(self) -> Tensor:
        """Afterpulses of a detection, as given: () or one of each exponential, float64."""
        return self.logit_probability.double().sigmoid()

    @property
    def tau_s(self) -> Tensor:
        """Mean delays beyond the dead time, in seconds, float64.

        Raises:
            UnitError: with another law of delays.
        """
        if self.delays is not None:
            raise UnitError(f"Afterpulsing.tau_s: expected exponentials, but the delays are {self.delays!r}.")
        return self.log_tau_s.double().exp()

    def seen(self) -> Tensor:
        """Afterpulses of a detection after its dead time, by exponential: (K,) float64.

        Raises:
            UnitError: for learnt probabilities whose sum is above 0.5.
        """
        p = self.probability.reshape(-1)
        if not float(p.detach().sum()) <= _MOST * (1 + 1e-9):
            raise UnitError(
                f"Afterpulsing: expected a sum of probability in (0, {_MOST:g}], got {p.detach().tolist()}. If it is "
                "learnt, lower the learning rate: at a sum of 1 a detection would never end."
            )
        if self.counted_from == "dead_time":
            return p
        if self.delays is not None:
            return p * self.delays.released_after(self.dead_time_s)
        return p * torch.exp(-self.dead_time_s / self.tau_s.reshape(-1))

    def _period_bins(self, x: Tensor) -> int:
        period = self.period_bins or x.shape[TIME]
        _check_period(period, x.shape[TIME])
        return period

    def kernel(self, period_bins: int) -> Tensor:
        """Return the afterpulses of one detection k bins after it, folded into one period.

        Args:
            period_bins: bins of a period.

        Returns:
            (period_bins,) float64.
        """
        if self.delays is not None:
            return self.seen() * self.delays.kernel(self.dead_time_s, self.bin_width_s, period_bins)
        tau, dead = self.tau_s.reshape(-1) / self.bin_width_s, self.dead_time_s / self.bin_width_s
        return self.seen() @ exponential_kernel(tau, dead, period_bins)

    def first_kernel(self, bins: int) -> Tensor:
        """Return the afterpulses of one detection that come less than `bins` bins later, without later rounds.

        Args:
            bins: number of bins.

        Returns:
            (bins,) float64.
        """
        if self.delays is not None:
            return self.seen() * self.delays.shares(self.dead_time_s, self.bin_width_s, first=0, number=bins)
        tau, dead = self.tau_s.reshape(-1) / self.bin_width_s, self.dead_time_s / self.bin_width_s
        return self.seen() @ exponential_shares(tau, dead, 0, bins)

    @in_single
    def extra(self, x: Tensor) -> Tensor:
        check_transient(x, "Afterpulsing")
        bins, period = x.shape[TIME], self._period_bins(x)
        gain, length = remembered(self, ("gain", period, bins), lambda: _gain(1.0, self._kernel(period), bins))
        added = _filtered(x, gain.to(x.device), length)
        beyond = self._from_background(x)
        return added if beyond is None else added + beyond

    def _from_background(self, x: Tensor) -> Tensor | None:
        """Mean afterpulses in the window of constant counts outside of it; None without such counts."""
        bins, period = x.shape[TIME], self._period_bins(x)
        dark = not isinstance(self.background, Tensor) and self.background == 0
        if dark or period <= bins:
            return None

        def missing() -> Tensor:
            """Afterpulses (bins,) in the window of one count in every bin outside of it."""
            kernel = self._kernel(period)
            window = torch.ones(1, bins, 1, 1, dtype=torch.float64, device=kernel.device)
            inside = _filtered(window, *_gain(1.0, kernel, bins))
            return (kernel.sum() / (1 - kernel.sum()) - inside).clamp_min(0).flatten()

        share = remembered(self, ("missing", period, bins), missing).to(x.device).view(-1, 1, 1)
        level = over_time(kept_map(self, "background"), x, "background", "Afterpulsing")
        return (share * level).to(x.dtype).expand_as(x)

    def _kernel(self, period: int) -> Tensor:
        """`kernel`, remembered while nothing is learnt: do not change in place."""
        return remembered(self, ("kernel", period), lambda: self.kernel(period))

    def share(self) -> float:
        p = float(self.seen().detach().sum())
        return p / (1 - p)

    def _draw_delays(self, like: Tensor, generator: torch.Generator | None) -> Tensor:
        """Delays in bins, in shape, dtype and device of `like` (N,)."""
        if self.delays is not None:
            delays = self.delays.draw(like.numel(), self.dead_time_s, generator) / self.bin_width_s
            return delays.to(like)
        tau, dead = (self.tau_s.detach() / self.bin_width_s).reshape(-1), self.dead_time_s / self.bin_width_s
        delay = torch.rand(like.shape, dtype=like.dtype, device=like.device, generator=generator).neg_().log1p_()
        if tau.numel() == 1:
            return delay.mul_(-float(tau)).add_(dead)
        parts = self.seen()
        edges = (parts / parts.sum()).cumsum(0)[:-1].to(like)
        u = torch.rand(like.shape, dtype=like.dtype, device=like.device, generator=generator)
        which = torch.bucketize(u, edges, right=True)
        return delay.mul_(-tau.to(like)[which]).add_(dead)

    def trigger(self, counts: Tensor, generator: torch.Generator | None) -> Tensor:
        check_transient(counts, "Afterpulsing")
        p = float(self.seen().detach().sum())
        period, bins, pixels = self._period_bins(counts), counts.shape[TIME], counts.shape[-2] * counts.shape[-1]
        draw = self._lags(period, counts)

        def follow(piece: Tensor, begin: int, own: torch.Generator | None) -> Tensor:
            """Places of all afterpulses of the detections of a piece, of all generations."""
            first = thin(piece, p, own)
            found = [first.place[:0]]
            for block in range(0, first.place.numel(), _ENTRIES):
                at = slice(block, block + _ENTRIES)
                place = _repeat(first.place[at] + begin, first.number[at])
                time = place.div(pixels, rounding_mode="floor") % bins
                while time.numel():
                    lag = draw(time, own)
                    lag -= period * (lag + time >= period)
                    # a round later is as far in front of the window as it is behind the end of the period
                    time, place = time.add_(lag), place.add_(lag, alpha=pixels)
                    found.append(place[time < bins])
                    again = _passing(time, p, own)
                    time, place = time[again], place[again]
            return torch.cat(found)

        one = torch.ones(1, dtype=counts.dtype, device=counts.device)
        total = counts.clone(memory_format=torch.contiguous_format)
        for places in by_pieces(follow, counts.reshape(-1), generator):
            total.view(-1).scatter_add_(0, places, one.expand(places.shape))
        beyond = self._from_background(counts)
        return total if beyond is None else total + self._poisson(beyond, generator)

    def _lags(self, period: int, counts: Tensor) -> Callable[[Tensor, torch.Generator | None], Tensor]:
        """Function that draws bins from a detection to its afterpulse, folded into one period, int64."""
        if counts.device.type == "cpu" and counts.numel() >= _WORTH_TABLE and period <= _LONGEST_TABLE:
            kernel = self._kernel(period).cpu()
            return LagTable(kernel / kernel.sum()).draw
        if self.delays is None:
            longest = self.dead_time_s + 20 * float(self.tau_s.detach().max())
        else:
            longest = self.delays.end_s()
        # bins are told apart to 1e-3 of a bin, and delays have as many steps
        real = torch.float32 if max(period, longest / self.bin_width_s) < _FINE else torch.float64

        def draw(like: Tensor, generator: torch.Generator | None) -> Tensor:
            # somewhere in its bin, with the same chance everywhere
            inside = torch.rand(like.shape, dtype=real, device=like.device, generator=generator)
            return self._draw_delays(inside, generator).add_(inside).floor_().long().remainder_(period)

        return draw


def _repeat(place: Tensor, number: Tensor) -> Tensor:
    """Every place, repeated `number` times."""
    if place.numel() < _FEW:
        return place.repeat_interleave(number.long())
    all_places, k = [place if bool((number >= 1).all()) else place[number >= 1]], 2
    while True:
        more = (number >= k).nonzero().squeeze(-1)
        if not more.numel():
            return torch.cat(all_places)
        place, number, k = place[more], number[more], k + 1
        all_places.append(place)


def _passing(like: Tensor, p: float, generator: torch.Generator | None) -> Tensor:
    """Indices of the entries that pass, each with probability `p`."""
    steps = math.floor(p * _VALUES)
    bits = sixteen_bits(like, generator)
    passing = (bits <= steps - _VALUES // 2).nonzero().squeeze(-1)
    # the last step passes in part
    finer = torch.rand(passing.shape, dtype=torch.float64, device=like.device, generator=generator)
    return passing[(bits[passing] < steps - _VALUES // 2).logical_or_(finer < p * _VALUES - steps)]
