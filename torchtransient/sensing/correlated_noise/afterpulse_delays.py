"""How long after a detection its afterpulse comes: exponentials, a power law, a measured histogram.

Delays are counted from the detection. While the detector is dead a carrier that is set free makes no detection, so
that only delays beyond the dead time are seen; their distribution is cut there. Time is in bins; a detection is spread
evenly over its bin.

Sources: several exponentials: Cova, Lacaita, Ripamonti, Trapping phenomena in avalanche photodiodes on nanosecond scale
(IEEE EDL 1991). Power law: Itzler, Jiang, Entwistle, Power law temporal dependence of InGaAs/InP SPAD afterpulsing
(Journal of Modern Optics 2012).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from torchtransient.errors import ShapeError, UnitError
from torchtransient.floating import number_tensor
from torchtransient.sensing.base.layout import check_number, check_seconds
from torchtransient.sensing.base.sensor import PhysicalModule
from torchtransient.sensing.response.response_shapes import above_floor

_MOST_LAGS = 1 << 23  # of a law that ends
_NODES, _WEIGHTS = (
    (-0.9602898564975363, -0.7966664774136267, -0.5255324099163290, -0.1834346424956498),
    (0.1012285362903763, 0.2223810344533745, 0.3137066458778873, 0.3626837833783620),
)  # Gauss-Legendre, 8 points, the lower half


def exponential_shares(tau_bins: Tensor, dead_bins: float, first: int, number: int) -> Tensor:
    """Share of afterpulses in bins `first`, `first` + 1, ... after their detection, by component: (K, number) float64.

    `tau_bins` (K,): mean delays beyond the dead time, differentiable.
    """
    tau = tau_bins.unsqueeze(1)
    k = torch.arange(first - 1, first + number, dtype=torch.float64, device=tau.device)
    # mean over the bin of the chance that the afterpulse is yet to come: 1 while the detector is dead
    begin = torch.minimum(k.clamp_min(dead_bins), k + 1)
    late = tau * torch.exp(-(begin - dead_bins).clamp_min(0) / tau) * -torch.expm1(-(k + 1 - begin) / tau)
    yet = begin - k + late
    return yet[:, :-1] - yet[:, 1:]


def exponential_kernel(tau_bins: Tensor, dead_bins: float, period_bins: int) -> Tensor:
    """`exponential_shares` of all bins, folded into one period: (K, period_bins), every sum 1."""
    start = math.floor(dead_bins)
    shares = exponential_shares(tau_bins, dead_bins, start, 3 * period_bins).view(-1, 3, period_bins)
    # two bins are cut by the dead time; those of the third round and all later ones are a geometric series
    rest = shares[:, 2] / -torch.expm1(-period_bins / tau_bins).unsqueeze(1)
    return (shares[:, 0] + shares[:, 1] + rest).roll(start % period_bins, -1)


class AfterpulseDelays(PhysicalModule):
    """A law of delays that ends. A subclass says how many afterpulses are yet to come, and draws.

    For `Afterpulsing(probability, dead_time_s=..., delays=law)`.
    """

    def seen(self, dead_time_s: float) -> Tensor | float:
        """Share of all carriers that are set free after the dead time."""
        raise NotImplementedError(f"{type(self).__name__} has to define seen(dead_time_s).")

    def mean_yet_to_come(self, k: Tensor, dead_time_s: float, bin_width_s: float) -> Tensor:
        """Mean over the bins from `k` to `k` + 1 (bins after the detection) of the share that is yet to come."""
        raise NotImplementedError(f"{type(self).__name__} has to define mean_yet_to_come(k, dead time, bin width).")

    def draw(self, number: int, dead_time_s: float, generator: torch.Generator | None) -> Tensor:
        """(number,) float64 delays after the detection that are seen, in seconds."""
        raise NotImplementedError(f"{type(self).__name__} has to define draw(number, dead time, generator).")

    def end_s(self) -> float:
        """The longest delay, in seconds."""
        raise NotImplementedError(f"{type(self).__name__} has to define end_s().")

    def shares(self, dead_time_s: float, bin_width_s: float, *, first: int, number: int) -> Tensor:
        """Share of afterpulses in bins `first`, `first` + 1, ... after their detection: (number,) float64."""
        device = next((t.device for t in [*self.parameters(), *self.buffers()]), None)
        k = torch.arange(first - 1, first + number, dtype=torch.float64, device=device)
        yet = self.mean_yet_to_come(k, dead_time_s, bin_width_s)
        return yet[:-1] - yet[1:]

    def kernel(self, dead_time_s: float, bin_width_s: float, period_bins: int) -> Tensor:
        """The shares of all bins, folded into one period: (period_bins,) float64, sum 1."""
        number = math.ceil(self.end_s() / bin_width_s) + 2
        if number > _MOST_LAGS:
            raise UnitError(
                f"{type(self).__name__}: expected delays of at most {_MOST_LAGS} bins, got {number} bins of "
                f"{bin_width_s:g} s. Let the law end earlier, or use wider bins."
            )
        shares = self.shares(dead_time_s, bin_width_s, first=0, number=number)
        rounds = -(-number // period_bins)
        return torch.nn.functional.pad(shares, (0, rounds * period_bins - number)).view(rounds, period_bins).sum(0)


class PowerLawDelays(AfterpulseDelays):
    """Afterpulses whose rate falls as delay^-exponent, from the end of the dead time to `longest_s`; none later.

    Measured exponents are about 1 to 1.4 (Itzler et al. 2012, InGaAs/InP). The law has no beginning: it needs a dead
    time above zero, and its `probability` counts what comes after it. `learnable`: `log_exponent` is a parameter.
    Raises UnitError for exponents outside (0, 10].
    """

    log_exponent: Tensor

    def __init__(self, exponent: float, longest_s: float, *, learnable: bool = False) -> None:
        super().__init__()
        value = check_number(exponent, "exponent", "PowerLawDelays", high=10.0, open_low=True)
        self.longest_s = check_seconds(longest_s, "longest_s", "PowerLawDelays", open_low=True)
        tensor = torch.tensor(math.log(value), dtype=torch.float64)
        if learnable:
            self.register_parameter("log_exponent", nn.Parameter(tensor))
        else:
            self.register_buffer("log_exponent", tensor)

    def end_s(self) -> float:
        return self.longest_s

    def seen(self, dead_time_s: float) -> float:
        raise UnitError(
            "PowerLawDelays: expected counted_from='dead_time', got 'avalanche'. The law is infinite at delay 0; give "
            "the probability of what comes after the dead time."
        )

    @property
    def exponent(self) -> Tensor:
        """Exponent of the law, float64."""
        return self.log_exponent.double().exp()

    def _limits(self, dead_time_s: float) -> float:
        if not 0 < dead_time_s < self.longest_s:
            raise UnitError(
                f"PowerLawDelays: expected a dead time above 0 and below longest_s = {self.longest_s:g} s, where the "
                f"law begins, got {dead_time_s:g} s."
            )
        return math.log(self.longest_s / dead_time_s)

    def _growth(self, log_x: Tensor) -> Tensor:
        """Integral of x^-exponent from 1 on, by the logarithm of x."""
        a = 1 - self.exponent
        flat = a.abs() < 1e-6
        safe = torch.where(flat, torch.ones_like(a), a)
        return torch.where(flat, log_x * (1 + a * log_x / 2), torch.expm1(safe * log_x) / safe)

    def mean_yet_to_come(self, k: Tensor, dead_time_s: float, bin_width_s: float) -> Tensor:
        end = self._limits(dead_time_s)
        total = self._growth(torch.tensor(end, dtype=torch.float64, device=k.device))
        dead = dead_time_s / bin_width_s
        begin = torch.minimum(k.clamp_min(dead), k + 1)
        half, mean = (k + 1 - begin) / 2, torch.zeros_like(k)
        for node, weight in zip(_NODES, _WEIGHTS, strict=True):
            for side in (-1, 1):
                log_x = torch.log((begin + half * (1 + side * node)).clamp_min(dead) / dead).clamp_max(end)
                mean = mean + 0.5 * weight * (1 - self._growth(log_x) / total)
        return begin - k + 2 * half * mean

    def draw(self, number: int, dead_time_s: float, generator: torch.Generator | None) -> Tensor:
        end, device = self._limits(dead_time_s), self.log_exponent.device
        u = torch.rand(number, dtype=torch.float64, device=device, generator=generator)
        a = 1 - float(self.exponent.detach())
        if abs(a) < 1e-6:
            return dead_time_s * torch.exp(u * end)
        return dead_time_s * torch.exp(torch.log1p(u * math.expm1(a * end)) / a)


class MeasuredDelays(AfterpulseDelays):
    """Delays by a measured histogram `counts` (K,) in bins of `bin_width_s`, the first beginning `start_s` after it.

    Counts are spread evenly over their bins. `floor`: counts of a bin that are no afterpulses (dark counts, the level
    far out), taken off; True the median of all bins, False nothing. Below it nothing is left. Raises ShapeError for
    what is no histogram, UnitError for counts that are negative, not finite, or nothing above the floor.
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

    def _until(self, time_s: float) -> float:
        """Share of the histogram before a delay."""
        place = (time_s - self.start_s) / self.own_width_s
        whole = min(max(math.floor(place), 0), self.share_of_bins.numel() - 1)
        part = min(max(place - whole, 0.0), 1.0)
        shares = self.share_of_bins.double()
        return float(shares[:whole].sum() + part * shares[whole])

    def seen(self, dead_time_s: float) -> float:
        left = 1 - self._until(dead_time_s)
        if left <= 0:
            raise UnitError(
                f"MeasuredDelays: expected delays beyond the dead time of {dead_time_s:g} s, but the histogram ends at "
                f"{self.end_s():g} s with nothing left. Measure for longer."
            )
        return left

    def mean_yet_to_come(self, k: Tensor, dead_time_s: float, bin_width_s: float) -> Tensor:
        shares, left = self.share_of_bins.double(), self.seen(dead_time_s)
        yet = torch.cat([shares.new_ones(1), 1 - shares.cumsum(0)])
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
        yet = self.seen(dead_time_s) * (1 - u) * sums[-1]
        later = torch.searchsorted(sums, yet)
        place = shares.numel() - 1 - later + (sums[later] - yet) / shares[later]
        return (self.start_s + place * self.own_width_s).clamp_min(dead_time_s)

    def extra_repr(self) -> str:
        return f"bins={self.share_of_bins.numel()}, bin_width_s={self.own_width_s:g}, start_s={self.start_s:g}"
