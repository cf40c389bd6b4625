"""Afterpulses: detections triggered by carriers that an earlier one left behind. And maps of hot pixels."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from torchtransient.axes import TimeAxis
from torchtransient.checks import MOST_MADE, Numbers, as_number, shown
from torchtransient.errors import ShapeError, UnitError
from torchtransient.floating import in_single
from torchtransient.sensing.base.given import numbers_of
from torchtransient.sensing.base.layout import (
    TIME,
    bin_width_of,
    check_count,
    check_number,
    check_seconds,
    check_transient,
    one_number,
    reals,
)
from torchtransient.sensing.base.pixel_maps import check_map, keep_map, kept_map, over_time
from torchtransient.sensing.base.policies import GradPolicy
from torchtransient.sensing.base.remembered import remembered
from torchtransient.sensing.correlated_noise.afterpulse_delays import (
    AfterpulseDelays,
    exponential_kernel,
    exponential_shares,
)
from torchtransient.sensing.counts.added_counts import AddedCounts
from torchtransient.sensing.numerics.binomial_tables import LagTable, sixteen_bits
from torchtransient.sensing.numerics.draws import by_pieces
from torchtransient.sensing.numerics.thinning import thin
from torchtransient.sensing.numerics.time_convolution import check_choice, filter_rows

CountedFrom = Literal["dead_time", "avalanche"]

_BLOCK = 1 << 17  # entries at a time, so that temporaries stay in the cache
_WORTH_TABLE = 1 << 16  # entries, above which the lags of afterpulses are looked up
_FEW = 1 << 12  # places, below which one slow operation takes less time than several fast ones
_VALUES = 1 << 16  # of a random number of 16 bits
_MOST_LAGS = 1 << 14  # bins of a period, above which a table of 2^16 cells says little
_FINE = 2.0**14  # bins of a period, or of a delay, up to which single precision places afterpulses
_MOST = 0.5  # afterpulses of a detection


def afterpulse_kernel(tau_s: Tensor | float, dead_time_s: float, bin_width_s: float, *, period_bins: int) -> Tensor:
    """Share of afterpulses k bins after their detection, folded into one period: (period_bins,) float64, sum 1.

    The delay is the dead time plus an exponential time of mean `tau_s` (differentiable); detections are spread evenly
    over their bins. Bins are integrated exactly, and so are all later periods.
    """
    if as_number(tau_s) is None:
        raise UnitError(f"afterpulse_kernel: expected tau_s as one number of seconds, got {shown(tau_s)}.")
    dead_time_s = check_seconds(dead_time_s, "dead_time_s", "afterpulse_kernel", high=1.0)
    bin_width_s = check_seconds(bin_width_s, "bin_width_s", "afterpulse_kernel", open_low=True, high=1.0)
    period_bins = check_count(period_bins, "period_bins", "afterpulse_kernel", most=MOST_MADE)
    tau = torch.as_tensor(one_number(tau_s, "tau_s", "afterpulse_kernel"), dtype=torch.float64) / bin_width_s
    return exponential_kernel(tau.reshape(1), dead_time_s / bin_width_s, period_bins)[0]


@in_single
def add_afterpulses(
    counts: Tensor,
    probability: Tensor | float,
    kernel: Tensor,
    *,
    only_added: bool = False,
) -> Tensor:
    """Mean histogram with afterpulses, and afterpulses of afterpulses: counts * (1 - probability kernel)^-1.

    `counts`: (..., C, T, H, W); `kernel`: (P,) with P >= T, from `afterpulse_kernel` (or `Afterpulsing.kernel`, which
    has the probability in it); the window is the first T bins of a period of P. Afterpulses outside the window are
    lost. With P = T sums grow by 1/(1 - probability) exactly.
    Differentiable in all three. Computed in float64 by FFT round the period; dtype and device of `counts` are kept.
    """
    check_transient(counts, "add_afterpulses")
    (kernel,) = reals("add_afterpulses", kernel=kernel)
    if kernel.ndim != 1:
        raise ShapeError(f"add_afterpulses: expected a kernel (P,), got {tuple(kernel.shape)}.")
    _check_period(kernel.shape[0], bins := counts.shape[TIME])
    p = one_number(probability, "probability", "add_afterpulses")
    p = torch.as_tensor(p, dtype=torch.float64, device=counts.device)
    added = _filtered(counts, *_gain(p, kernel.to(counts.device, torch.float64), bins))
    return added if only_added else counts + added


def _gain(probability: Tensor | float, kernel: Tensor, bins: int) -> tuple[Tensor, int]:
    """Transfer function from detections to all afterpulses, and its length."""
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


def _from_outside(kernel: Tensor, bins: int) -> Tensor:
    window = torch.ones(1, bins, 1, 1, dtype=torch.float64, device=kernel.device)
    total = kernel.sum() / (1 - kernel.sum())
    return (total - add_afterpulses(window, 1.0, kernel, only_added=True)).clamp_min(0).flatten()


class Afterpulsing(AddedCounts):
    """Every detection triggers others later: with `probability`, one dead time plus a random time after it.

    `probability` and `tau_s`: numbers, or one each of several exponentials (carriers of several traps; probabilities
    add up); mean delays `tau_s` are counted from the end of the dead time on, since exponentials have no memory.
    `delays`: another law instead, `PowerLawDelays` or `MeasuredDelays`, cut off at the dead time. Probabilities are
    those of afterpulses after the dead time, as data sheets give them; with `counted_from` "avalanche" those of all
    carriers, of which those that are set free during the dead time are not seen.

    Works on counts, behind the SPAD. The histogram is taken round the laser period (`period_s`, by default the window):
    afterpulses of one cycle fall into later ones, constant light stays constant. Dead time is not applied to the
    afterpulses themselves, nor do they keep photons from being seen: right in dim light (`AfterpulsingSPAD` for the
    rest).

    A period that is longer than the window has counts that nobody sees, whose afterpulses do come into the window:
    `background`, constant counts of a bin of the exposure (a number or a map; `PhotonBudget.background_counts`), is
    taken to go on outside of it, and constant light then stays constant. 0: the detector is dark or off there.

    `learnable`: `logit_probability`, `log_tau_s`, as long as there are exponentials.

    Raises UnitError for probabilities whose sum is not in (0, 0.5], ShapeError where they and `tau_s` differ in number.
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
            raise UnitError(f"{where}: expected dead_time_s (0 for none), and either tau_s or delays, got others.")
        if delays is not None and not isinstance(delays, AfterpulseDelays):
            raise UnitError(f"{where}: expected delays to be PowerLawDelays or MeasuredDelays, got {delays!r}.")
        check_choice(counted_from, CountedFrom, "counted_from", where)
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
        keep_map(self, "background", check_map(background, "background", where))
        self.delays, self.counted_from = delays, counted_from
        self._keep(probability, [] if tau_s is None else tau_s, learnable)
        if delays is not None:  # says what is wrong with a law and a dead time that do not go together
            delays.shares(self.dead_time_s, self.bin_width_s, first=0, number=1)
            self.seen()

    def _keep(self, probability: float | Numbers, tau_s: float | Numbers, learnable: bool) -> None:
        where = "Afterpulsing"
        chance, tau = numbers_of(probability, "probability", where), numbers_of(tau_s, "tau_s", where)
        several = isinstance(chance, Sequence) and not isinstance(chance, str)
        shares = list(chance) if isinstance(chance, Sequence) else [chance]
        p = [check_number(v, "probability", where, high=_MOST, open_low=True) for v in shares]
        if not p or sum(p) > _MOST:
            raise UnitError(f"{where}: expected a sum of probability in (0, {_MOST:g}], got {chance!r}.")
        numbers = {"logit_probability": [math.log(v / (1 - v)) for v in p]}
        if self.delays is None:
            times = list(tau) if isinstance(tau, Sequence) else [tau]
            numbers["log_tau_s"] = [math.log(check_seconds(v, "tau_s", where, open_low=True)) for v in times]
            if len(times) != len(p):
                raise ShapeError(f"{where}: expected as many tau_s as probability, got {len(times)} and {len(p)}.")
        elif several:
            raise ShapeError(f"{where}: expected one probability of delays, got {len(p)}.")
        for name, values in numbers.items():
            tensor = torch.tensor(values, dtype=torch.float64)
            tensor = tensor if several else tensor[0].clone()
            if learnable:
                self.register_parameter(name, nn.Parameter(tensor))
            else:
                self.register_buffer(name, tensor)

    @property
    def probability(self) -> Tensor:
        """Afterpulses of a detection, as given: () or one of each exponential, float64."""
        return self.logit_probability.double().sigmoid()

    @property
    def tau_s(self) -> Tensor:
        """Mean delays beyond the dead time, in seconds, float64. UnitError where another law stands for them."""
        if self.delays is not None:
            raise UnitError(f"Afterpulsing.tau_s: expected exponentials, but the delays are {self.delays!r}.")
        return self.log_tau_s.double().exp()

    def seen(self) -> Tensor:
        """Afterpulses of a detection after its dead time, by exponential: (K,) float64."""
        p = self.probability.reshape(-1)
        if not float(p.detach().sum()) <= _MOST * (1 + 1e-9):
            raise UnitError(
                f"Afterpulsing: expected a sum of probability in (0, {_MOST:g}], got {p.detach().tolist()}. If it is "
                "learnt, lower the learning rate: at a sum of 1 a detection would never end."
            )
        if self.counted_from == "dead_time":
            return p
        if self.delays is not None:
            return p * self.delays.seen(self.dead_time_s)
        return p * torch.exp(-self.dead_time_s / self.tau_s.reshape(-1))

    def _period_bins(self, x: Tensor) -> int:
        return self.period_bins or x.shape[TIME]

    def kernel(self, period_bins: int) -> Tensor:
        """Afterpulses of one detection k bins after it, folded into one period: (period_bins,) float64."""
        if self.delays is not None:
            return self.seen() * self.delays.kernel(self.dead_time_s, self.bin_width_s, period_bins)
        tau, dead = self.tau_s.reshape(-1) / self.bin_width_s, self.dead_time_s / self.bin_width_s
        return self.seen() @ exponential_kernel(tau, dead, period_bins)

    def first_kernel(self, bins: int) -> Tensor:
        """Those among them that come less than `bins` bins later, without later rounds: (bins,) float64."""
        if self.delays is not None:
            return self.seen() * self.delays.shares(self.dead_time_s, self.bin_width_s, first=0, number=bins)
        tau, dead = self.tau_s.reshape(-1) / self.bin_width_s, self.dead_time_s / self.bin_width_s
        return self.seen() @ exponential_shares(tau, dead, 0, bins)

    @in_single
    def extra(self, x: Tensor) -> Tensor:
        check_transient(x, "Afterpulsing")
        bins, period = x.shape[TIME], self._period_bins(x)
        _check_period(period, bins)
        gain, length = remembered(self, ("gain", period, bins), lambda: _gain(1.0, self._kernel(period), bins))
        added = _filtered(x, gain.to(x.device), length)
        beyond = self._beyond(x)
        return added if beyond is None else added + beyond

    def _beyond(self, x: Tensor) -> Tensor | None:
        """Mean afterpulses in the window of constant counts outside of it; None where there are none."""
        bins, period = x.shape[TIME], self._period_bins(x)
        dark = not isinstance(self.background, Tensor) and self.background == 0
        if dark or period <= bins:
            return None
        missing = self._missing(period, bins).to(x.device).view(-1, 1, 1)
        level = over_time(kept_map(self, "background"), x, "background", "Afterpulsing")
        return (missing * level).to(x.dtype).expand_as(x)

    def _missing(self, period: int, bins: int) -> Tensor:
        """Afterpulses in the window of one count in every bin outside of it: (bins,) float64."""
        return remembered(self, ("missing", period, bins), lambda: _from_outside(self._kernel(period), bins))

    def _kernel(self, period: int) -> Tensor:
        """`kernel`, remembered while nothing is learnt: not to be changed in place."""
        return remembered(self, ("kernel", period), lambda: self.kernel(period))

    def share(self) -> float:
        p = float(self.seen().detach().sum())
        return p / (1 - p)

    def _draw_delays(self, like: Tensor, generator: torch.Generator | None) -> Tensor:
        """In bins after the detection, in the shape, dtype and device of `like` (N,)."""
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
        _check_period(period, bins)
        draw = self._lags(period, counts)

        def follow(piece: Tensor, begin: int, own: torch.Generator | None) -> Tensor:
            """Places of all afterpulses of the detections of a piece, and of those triggered by them."""
            first = thin(piece, p, own)
            found = [first.place[:0]]
            for block in range(0, first.place.numel(), _BLOCK):
                at = slice(block, block + _BLOCK)
                place = _one_each(first.place[at] + begin, first.number[at])
                time = place.div(pixels, rounding_mode="floor") % bins
                while time.numel():
                    lag = draw(time, own)
                    lag -= period * (lag + time >= period)
                    # a round later is as far in front of the window as it is behind the end of the period
                    time, place = time.add_(lag), place.add_(lag, alpha=pixels)
                    found.append(place[time < bins])
                    again = _passes(time, p, own)
                    time, place = time[again], place[again]
            return torch.cat(found)

        one = torch.ones(1, dtype=counts.dtype, device=counts.device)
        total = counts.clone(memory_format=torch.contiguous_format)
        for places in by_pieces(follow, counts.reshape(-1), generator):
            total.view(-1).scatter_add_(0, places, one.expand(places.shape))
        beyond = self._beyond(counts)
        return total if beyond is None else total + self._poisson(beyond, generator)

    def _lags(self, period: int, counts: Tensor) -> Callable[[Tensor, torch.Generator | None], Tensor]:
        """Draws of the bins from a detection to its afterpulse, folded into one period: int64 as large as a tensor."""
        if counts.device.type == "cpu" and counts.numel() >= _WORTH_TABLE and period <= _MOST_LAGS:
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


def _one_each(place: Tensor, number: Tensor) -> Tensor:
    """Every place as often as its number says."""
    if place.numel() < _FEW:
        return place.repeat_interleave(number.long())
    all_places, k = [place if bool((number >= 1).all()) else place[number >= 1]], 2
    while True:
        more = (number >= k).nonzero().squeeze(-1)
        if not more.numel():
            return torch.cat(all_places)
        place, number, k = place[more], number[more], k + 1
        all_places.append(place)


def _passes(like: Tensor, p: float, generator: torch.Generator | None) -> Tensor:
    """Indices of the entries that pass, each with probability `p`."""
    steps = math.floor(p * _VALUES)
    bits = sixteen_bits(like, generator)
    passing = (bits <= steps - _VALUES // 2).nonzero().squeeze(-1)
    # the last step passes in part
    finer = torch.rand(passing.shape, dtype=torch.float64, device=like.device, generator=generator)
    return passing[(bits[passing] < steps - _VALUES // 2).logical_or_(finer < p * _VALUES - steps)]


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
    median = check_number(median_hz, "median_hz", where := "hot_pixel_rates")
    spread = check_number(log_std, "log_std", where)
    fraction = check_number(hot_fraction, "hot_fraction", where, high=1.0)
    factor = check_number(hot_factor, "hot_factor", where, low=1.0)
    size = [check_count(side, "height and width", where, low=0, most=MOST_MADE) for side in (height, width)]
    rates = median * torch.exp(spread * torch.randn(size, dtype=torch.float64, generator=generator))
    hot = torch.rand(size, dtype=torch.float64, generator=generator) < fraction
    return torch.where(hot, rates * factor, rates)
