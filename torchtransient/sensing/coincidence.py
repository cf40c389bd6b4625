"""Coincidences: detections of different SPADs of a pixel within a short window, which background rarely makes.

Draws follow every SPAD of a pixel through every cycle, event by event, and the lines that are up. A train is one SPAD
through one block of periods: a cycle in step with the laser, or several periods of a detector that runs free, which
begin a few periods before they count. The next detection of an armed detector comes when the flux since then has
reached a number drawn from the exponential distribution.

Sources: Niclass et al., A 100-m range 10-frame/s 340 x 96-pixel time-of-flight depth sensor in 0.18-um CMOS (IEEE JSSC
2013), macro-pixels and coincidence; Beer, Haase, Ruskowski, Kokozinski, Background light rejection in SPAD-based LiDAR
sensors by adaptive photon coincidence detection (Sensors 2018), rates of coincidences in constant light.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.checks import Numbers
from torchtransient.errors import GradientError, UnitError
from torchtransient.sensing.afterpulsing_spad import AfterpulsingSPAD
from torchtransient.sensing.checks import (
    TIME,
    bins_from,
    check_count,
    check_seconds,
    check_tensor,
    check_transient,
)
from torchtransient.sensing.dead_time.clocked import highest_level
from torchtransient.sensing.dead_time.clocked_counts import binomial_log_prob, safe_xlogy
from torchtransient.sensing.draws import check_rates
from torchtransient.sensing.free_running import FreeRunningSPAD
from torchtransient.sensing.macro_pixel import groups_of
from torchtransient.sensing.sensor import (
    VARIANCE_FLOOR,
    GradPolicy,
    RandomSensor,
    common_bins,
    cycles_of,
    record_score,
    several_of,
)
from torchtransient.sensing.spad import SynchronousSPAD

# ---------------------------------------------------------------------------------------------------------------- draws


_AT_ONCE = 1 << 19  # trains, so that memory is bounded
_PERIODS = 16  # of a free-running detector in a block, and at least half of them before it counts
_DEAD_TIMES = 4  # before a block counts
_NO_LIGHT = torch.finfo(torch.float64).tiny


@dataclass(frozen=True)
class Trains:
    """SPADs alike in each of P pixels.

    Attributes:
        rate: rate of one SPAD per period and bin, (P, T) float64.
        dead_bins: dead time in bins, infinite for one detection per cycle.
        number: number of SPADs.
    """

    rate: Tensor
    dead_bins: float
    number: int


@dataclass(frozen=True)
class Seen:
    """Detections of trains, and time in bins that they were armed, (P, T) each, for their score."""

    detected: Tensor
    armed: Tensor


def draw_coincidences(
    groups: Sequence[Trains],
    cycles: int,
    coincidence: int,
    window: float,
    *,
    free: bool,
    generator: torch.Generator | None,
    seen: Sequence[Seen] | None = None,
    weights: Tensor | None = None,
) -> Tensor:
    """Draw coincidences event by event: detections that bring the number of those within a window up to `coincidence`.

    Args:
        groups: SPADs of equal shares.
        cycles: number of periods.
        coincidence: number of detections that make a coincidence.
        window: length of the window in bins.
        free: trains go on over periods, and lines stay up from one to the next.
        generator: source of randomness.
        seen: records of the groups that detections are added to, or None.
        weights: (P, M), value of a coincidence of the periods m, m + M, ... in place of one.

    Returns:
        Coincidences (P, T).
    """
    pixels, bins = groups[0].rate.shape
    lead = max(_PERIODS // 2, math.ceil(_DEAD_TIMES * groups[0].dead_bins / bins)) if free else 0
    length = min(max(_PERIODS, 2 * lead), cycles) if free else 1
    counts = torch.zeros_like(groups[0].rate)
    blocks, spads = -(-cycles // length), sum(group.number for group in groups)
    step = min(blocks, max(1, _AT_ONCE // spads))
    rows = max(1, _AT_ONCE // (spads * step))
    for first in range(0, pixels, rows):
        at = slice(first, min(first + rows, pixels))
        for begin in range(0, blocks, step):
            some = min(step, blocks - begin)
            parts = []
            for i, group in enumerate(groups):
                part = Trains(group.rate[at], group.dead_bins, group.number)
                known = None if seen is None else Seen(seen[i].detected[at], seen[i].armed[at])
                parts.append(_detections(part, some, lead, length, generator, known))
            owner, time = (torch.cat(columns) for columns in zip(*parts, strict=True))
            row, period, place = _coincidences(owner, time, some, bins, length, coincidence, window)
            period += begin * length
            counted = period < cycles  # the last block is cut off
            row, period, place = row[counted], period[counted], place[counted]
            each = None if weights is None else weights[at][row, period % weights.shape[1]]
            counts[at] += torch.bincount(row * bins + place, each, counts[at].numel()).view_as(counts[at])
    return counts


def _coincidences(
    owner: Tensor, time: Tensor, blocks: int, bins: int, length: int, coincidence: int, window: float
) -> tuple[Tensor, Tensor, Tensor]:
    """(pixel, period, bin) of coincidences among detections, those that count; `owner`: pixel times blocks plus block.

    Periods count from that of the first block on.
    """
    # owners know nothing of one another: farther apart than a window, and than what happens before a block counts
    first, last = time.aminmax() if len(time) else (time.new_zeros(()), time.new_zeros(()))
    clock, order = (owner * (float(last - first) + window + 1) + time).sort()
    up = torch.arange(len(clock), device=clock.device) - torch.searchsorted(clock, clock - window, right=True)
    chosen = order[(up == coincidence - 1) & (time[order] >= 0)]
    owner, time = owner[chosen], time[chosen]
    period = (time / bins).floor()
    place = (time - period * bins).long().clamp_max(bins - 1)
    pixel = owner.div(blocks, rounding_mode="floor")
    return pixel, (owner - pixel * blocks) * length + period.long(), place


def _detections(
    trains: Trains, blocks: int, lead: int, length: int, generator: torch.Generator | None, seen: Seen | None
) -> tuple[Tensor, Tensor]:
    """(owner, time) of all detections, in bins from the start of a block on; adds to what was `seen`."""
    rate, dead = trains.rate, trains.dead_bins
    pixels, bins = rate.shape
    flux = _Flux(rate)
    end = float(length * bins)
    owner = torch.arange(pixels * blocks * trains.number, device=rate.device).div(trains.number, rounding_mode="floor")
    armed = torch.zeros(owner.shape, dtype=torch.float64, device=rate.device)
    if lead:
        # A bright pulse keeps a detector of long dead time in step with every n-th period: all n have to be drawn.
        turns = max(1, math.ceil(dead / bins))
        armed += _uniform(armed, generator) * (turns * bins) - lead * bins
    owners, times = [], []
    while len(owner):
        pixel = owner.div(blocks, rounding_mode="floor")
        fired = flux.time(pixel, flux.before(pixel, armed) - torch.log1p(-_uniform(armed, generator))).maximum(armed)
        if seen is not None:
            _look(seen, pixel, armed, fired, end)
        hit = fired < end
        owner, fired = owner[hit], fired[hit]
        owners.append(owner)
        times.append(fired)
        armed = fired + dead
        owner, armed = owner[armed < end], armed[armed < end]
    return torch.cat(owners), torch.cat(times)


def _uniform(like: Tensor, generator: torch.Generator | None) -> Tensor:
    return torch.rand(like.shape, dtype=like.dtype, device=like.device, generator=generator)


class _Flux:
    """Photons of pixels over time, in bins from the start of a period on, with periods that repeat; rows (P, T)."""

    def __init__(self, rate: Tensor) -> None:
        self.bins = rate.shape[1]
        self.edges = torch.nn.functional.pad(rate.cumsum(1), (1, 0))
        self.total = self.edges[:, -1]
        # all pixels in one increasing list, each from its number to the next
        number = torch.arange(len(rate), dtype=torch.float64, device=rate.device).unsqueeze(1)
        self.line = (number + self.edges / self.edges[:, -1:].clamp_min(_NO_LIGHT)).flatten()
        self.edges = self.edges.flatten()

    def before(self, pixel: Tensor, time: Tensor) -> Tensor:
        """Photons before a time, counted from time 0 on."""
        period, whole, part = _parts(time, self.bins)
        place = pixel * (self.bins + 1) + whole
        low = self.edges[place]
        return period * self.total[pixel] + low + (self.edges[place + 1] - low) * part

    def time(self, pixel: Tensor, photons: Tensor) -> Tensor:
        """The time before which so many photons come, counted from time 0 on; infinite without light."""
        periods = photons / self.total[pixel]
        whole = periods.floor()
        first = pixel * (self.bins + 1)
        upper = torch.searchsorted(self.line, pixel + (periods - whole)).maximum(first + 1).minimum(first + self.bins)
        low = self.edges[upper - 1]
        width = self.edges[upper] - low
        left = photons - whole * self.total[pixel] - low
        part = (left / torch.where(width > 0, width, torch.ones_like(width))).clamp(0, 1)
        found = whole * self.bins + (upper - 1 - first) + part
        return torch.where(torch.isfinite(periods), found, math.inf)


def _parts(time: Tensor, bins: int) -> tuple[Tensor, Tensor, Tensor]:
    """Whole periods before a time, whole bins after these, and the part of a bin that is left."""
    period = (time / bins).floor()
    phase = (time - period * bins).clamp(0, bins)
    whole = phase.long().clamp_max(bins - 1)
    return period, whole, phase - whole


def _look(seen: Seen, pixel: Tensor, begin: Tensor, fired: Tensor, end: float) -> None:
    """Add detections, and the time from `begin` until then in which detectors were armed, bin by bin."""
    bins, size = seen.armed.shape[1], seen.armed.numel()
    hit = fired < end
    place = pixel[hit] * bins + _parts(fired[hit], bins)[1]
    seen.detected.add_(torch.bincount(place, minlength=size).view_as(seen.detected))
    for time, sign in ((fired.clamp_max(end), 1.0), (begin, -1.0)):
        period, whole, part = _parts(time, bins)
        place = pixel * bins + whole
        # the part of its own bin, and all of those before that
        own, reached = (torch.bincount(place, w, size).view_as(seen.armed) for w in (part, torch.ones_like(part)))
        periods = torch.bincount(pixel, period, len(seen.armed)).unsqueeze(1)
        seen.armed.add_(sign * (own + reached.flip(1).cumsum(1).flip(1) - reached + periods))


# ------------------------------------------------------------------------------------------------------ mean and sensor


_PLACES, _WEIGHTS = ((0.5 * values).tolist() for values in np.polynomial.legendre.leggauss(8))  # on [-1/2, 1/2]
_Detector = SynchronousSPAD | FreeRunningSPAD
_PHOTONS = 4.0  # of all SPADs in a piece, which 8 points integrate
_ROUNDED = 1e-6  # of a probability
_FLOOD = 1e8  # photons of a bin, from which on first ones are where it begins
_PARTS = 64  # of the cycles, that the normal surrogate weighs


@dataclass(frozen=True)
class _Group:
    """SPADs of an equal share.

    Attributes:
        one: detections of each SPAD per cycle and bin, (..., T, H, W).
        rate: rate of SPADs that detect once per cycle; None where detections are spread evenly over a bin.
        number: number of SPADs.
    """

    one: Tensor
    rate: Tensor | None
    number: int

    def until(self, at: float) -> Tensor:
        """Detections in the first share `at` of every bin."""
        if self.rate is None:
            return at * self.one
        return self.one * at * _mean_survival(at * self.rate) / _mean_survival(self.rate)

    def density(self, at: float) -> Tensor:
        """Detections per bin at a share `at` of every bin."""
        if self.rate is None:
            return self.one
        return self.one * torch.exp(-at * self.rate) / _mean_survival(self.rate)


def _pieces(low: float, high: float, halvings: int) -> Iterator[tuple[float, float]]:
    """A part of a bin in pieces that 8 points integrate to 1e-9.

    First photons fall off as exp(-rate), others crowd at one end: pieces get shorter, by halves, to both ends.
    """
    if not high > low:
        return
    steps = [0.0, *(2.0**-k for k in range(halvings, 0, -1))]
    shares = [*steps, *(1 - step for step in reversed(steps[:-1]))] if halvings else [0.0, 1.0]
    for first, last in itertools.pairwise(shares):
        yield low + (high - low) * first, low + (high - low) * last


def _mean_survival(x: Tensor) -> Tensor:
    """(1 - exp(-x)) / x."""
    small = x < 1e-5
    safe = torch.where(small, torch.ones_like(x), x)
    return torch.where(small, 1 - x / 2, -torch.expm1(-safe) / safe)


class CoincidencePixel(RandomSensor):
    """Pixel of several SPADs that counts coincidences of their detections, (..., C, T, H, W).

    Every detection raises its SPAD's line for `window_s`; a coincidence is counted when the number of lines that are up
    reaches `coincidence`, at the detection that does so. All of a cycle are counted. A `coincidence` of 1 is an OR of
    all lines: detections of others are lost while it is up.

    The mean is exact for independent SPADs in any light: detections of each SPAD times the chance that `coincidence` -
    1 of the others have detected within the window before. In constant light of r detections per second of many SPADs
    it is r (r w)^(k - 1) exp(-r w) / (k - 1)!. Inside a bin the light is spread evenly; so are detections in the mean,
    except those of one per cycle, of which the first photons of a bin are the first: with a dead time, use bins of at
    most one photon a SPAD. Integrals over a bin are right to 1e-6, however bright it is; a pixel with thousands of
    photons in a bin takes ten times as long, for the whole image. Lines are down at the start of a cycle of a
    SynchronousSPAD, and come round the period of a FreeRunningSPAD.

    Samples follow every SPAD through every cycle, so that coincidences of a cycle exclude or bring one another as those
    of events do: in a pulse a total varies several times less than of independent bins. Time grows with cycles times
    SPADs, a few 1e6 of which take a second. Of paralyzable detectors they are independent binomials, as the detector's
    own.

    All policies. `gaussian`: normal numbers with the covariance of the draws, whose size is differentiated as that of
    independent bins; `score`: that of the detections of all SPADs. `variance` and `log_prob` are those of single bins
    with at most one coincidence per cycle, and of bins taken as independent.

    Args:
        detector: one of the SPADs, see `MacroPixel`.
        spads: number of SPADs.
        coincidence: number of detections that make a coincidence.
        window_s: duration of a line in seconds; at most the dead time, so that a line goes up once in a window, and at
            most the window of bins.
        weights: shares of the light, see `MacroPixel`.
        axis: axis of the light, or
        bin_width_s: its bin width in seconds.
        grad: gradient policy.

    Raises:
        UnitError: for more SPADs in coincidence than there are, a window longer than the dead time, and a detector made
            for other bins; of paralyzable detectors for draws of light that has more than one coincidence per cycle in
            a bin.
        GradientError: for the score of a learnt dead time.
    """

    takes, gives = ("rate",), "counts"

    def __init__(
        self,
        detector: SynchronousSPAD | FreeRunningSPAD | AfterpulsingSPAD,
        spads: int,
        *,
        coincidence: int,
        window_s: float,
        weights: Numbers | None = None,
        axis: TimeAxis | None = None,
        bin_width_s: float | None = None,
        grad: GradPolicy = "expected",
    ) -> None:
        super().__init__(grad)
        where = "CoincidencePixel"
        self.detector = detector
        self.groups = groups_of(spads, weights, where)
        self.spads = int(spads)
        self.coincidence = check_count(coincidence, "coincidence", where)
        if self.coincidence > sum(number for _, number in self.groups):
            raise UnitError(f"{where}: expected a coincidence of at most {spads} SPADs with light, got {coincidence}.")
        own = bins_from(axis, bin_width_s, where)
        self.bin_width_s, self.num_bins = own[0], common_bins([detector], where, own)[1]
        self.window_s = check_seconds(window_s, "window_s", where, open_low=True)
        self.periodic = isinstance(self._inner, FreeRunningSPAD)
        self._check_dead_time()

    def check_bins(self, x: object) -> None:
        super().check_bins(x)
        self.detector.check_bins(x)

    @property
    def cycles(self) -> int:
        """Laser cycles of an exposure."""
        return cycles_of(self.detector)

    def probabilities(self, x: Tensor) -> Tensor:
        """Expected coincidences per cycle and bin.

        Args:
            x: rate of the pixel per cycle and bin, (..., C, T, H, W).
        """
        check_transient(x, "CoincidencePixel")
        self._check_window(x)
        window = self.window_s / self.bin_width_s
        parts = [self._one(x, share, number) for share, number in self.groups]
        whole = math.floor(window)
        total = torch.zeros_like(x, dtype=torch.float64)
        photons = (x.double() / _PHOTONS).clamp(1, _FLOOD * self.spads)
        halvings = highest_level(photons.log2().ceil().long())
        # the rear edge of the window passes a border of bins when its front edge has gone `window` - `whole` into one
        for low, high in ((0.0, window - whole), (window - whole, 1.0)):
            for begin, end in _pieces(low, high, halvings):
                for place, weight in zip(_PLACES, _WEIGHTS, strict=True):
                    at = begin + (end - begin) * (0.5 + place)
                    total = total + (end - begin) * weight * self._reached(parts, at, window)
        return total.to(x.dtype)

    def _check_dead_time(self) -> None:
        dead = self._inner.dead_time_s
        dead = float(dead.detach()) if isinstance(dead, Tensor) else dead
        if dead is not None and self.window_s > dead * (1 + 1e-9):
            raise UnitError(
                f"CoincidencePixel: expected window_s of at most the dead time of {dead:g} s, got {self.window_s:g} s. "
                "A SPAD that fires twice in a window would count twice. Keep a dead time that is learnt above it."
            )

    def _check_window(self, x: Tensor) -> Tensor:
        self._check_dead_time()  # which may have been learnt since
        bins, window = x.shape[TIME], self.window_s / self.bin_width_s
        if window > bins:
            raise UnitError(
                f"CoincidencePixel: expected window_s within the {bins} bins of the light, got {window:g} bins."
            )
        return x

    def _spad(self, x: Tensor, share: float) -> tuple[_Detector, Tensor]:
        """One SPAD with a `share` of the pixel, and its rate per cycle and bin."""
        one = several_of(self.detector, 1, share)
        if isinstance(one, AfterpulsingSPAD):
            return one.detector, one.rate(x * share)
        return cast("_Detector", one), x * share

    def _one(self, x: Tensor, share: float, number: int) -> _Group:
        """A SPAD in the light (..., T, H, W) of the pixel, one of `number` with a `share` of it."""
        spad, rate = self._spad(x, share)
        once = isinstance(spad, SynchronousSPAD) and spad.dead_time_s is None
        seen = cast("SynchronousSPAD", spad)._gated(rate).double().clamp_max(_FLOOD) if once else None
        return _Group(spad.probabilities(rate).double(), seen, number)

    def _reached(self, parts: list[_Group], at: float, window: float) -> Tensor:
        """Coincidences per bin and cycle at a share `at` of every bin."""
        most = self.coincidence - 1
        # by how many lines of the SPADs so far are up: its chance, and detections of one when so many others are up
        up, hit = [torch.ones_like(parts[0].one)], [torch.zeros_like(parts[0].one)]
        for group in parts:
            number = group.number
            q = self._fired_within(group, at, window).clamp(0, 1)
            others, own = _binomials(q, number - 1, most), _binomials(q, number, most)
            now = number * group.density(at)
            with_one = _product(up, [now * chance for chance in others], most)
            hit = _added(_product(hit, own, most), with_one)
            up = _product(up, own, most)
        return hit[most] if len(hit) > most else torch.zeros_like(parts[0].one)

    def _fired_within(self, group: _Group, at: float, window: float) -> Tensor:
        """Detections (..., T, H, W) of a SPAD in the window that ends a share `at` into every bin."""
        one = group.one
        bins = one.shape[TIME]
        edges = torch.cat([torch.zeros_like(one.narrow(TIME, 0, 1)), one.cumsum(TIME)], TIME)
        total = edges.narrow(TIME, bins, 1)
        front = edges.narrow(TIME, 0, bins) + group.until(at)
        back = at - window
        index = torch.arange(bins, device=one.device) + math.floor(back)
        rounds, inside = index.div(bins, rounding_mode="floor"), index % bins
        rear = edges.index_select(TIME, inside) + group.until(back - math.floor(back)).index_select(TIME, inside)
        over = rounds.view(-1, 1, 1)
        rear = rear + over * total if self.periodic else torch.where(over < 0, torch.zeros_like(rear), rear)
        return front - rear

    def expected(self, x: Tensor) -> Tensor:
        return self.probabilities(x) * self.cycles

    def variance(self, x: Tensor) -> Tensor:
        p = self.probabilities(x)
        variance: Tensor = self.cycles * p * (1 - p).clamp_min(0)  # rounding
        return variance

    def sample(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        if not self._paralyzable:
            return self._drawn(x, generator)
        with torch.no_grad():
            p = self.probabilities(check_rates(check_tensor(x, "CoincidencePixel").double(), "CoincidencePixel"))
            if p.numel() and float(p.max()) > 1 + _ROUNDED:
                raise UnitError(
                    f"CoincidencePixel: expected at most one coincidence per cycle in a bin, got {float(p.max()):g}. "
                    "Use narrower bins to draw."
                )
            return torch.binomial(torch.full_like(p, float(self.cycles)), p, generator=generator).to(x.dtype)

    def gaussian(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        if self._paralyzable:
            return super().gaussian(x, generator)
        # A normal number for each of several parts of the cycles, times what the part has drawn beside its mean: normal
        # numbers with the covariance of the draws.
        pixels, parts = x.select(TIME, 0).shape, min(self.cycles, _PARTS)
        normal = torch.randn(*pixels, parts, dtype=torch.float64, device=x.device, generator=generator)
        cycles = torch.full((parts,), float(self.cycles // parts), dtype=torch.float64, device=x.device)
        cycles[: self.cycles % parts] += 1
        p = self.probabilities(x)
        mean = p.detach() * (normal @ cycles).unsqueeze(TIME)
        noise = self._drawn(x, generator, weights=normal.view(-1, parts)) - mean
        width = (self.variance(x) + VARIANCE_FLOOR).sqrt()
        return self.cycles * p + noise.to(x.dtype) * (width / width.detach())

    @property
    def _paralyzable(self) -> bool:
        inner = self._inner
        return isinstance(inner, FreeRunningSPAD) and inner.kind == "paralyzable"

    @property
    def _inner(self) -> SynchronousSPAD | FreeRunningSPAD:
        return self.detector.detector if isinstance(self.detector, AfterpulsingSPAD) else self.detector

    def _lit(self, x: Tensor, share: float) -> tuple[Tensor, float]:
        """Rate of one SPAD with a `share` of the light, per cycle and bin, and its dead time in bins."""
        spad, rate = self._spad(x, share)
        if isinstance(spad, SynchronousSPAD):
            return spad._gated(rate), math.inf if spad.dead_bins is None else spad.dead_bins
        return rate, float(spad.dead_time_s.detach()) / self.bin_width_s

    def _drawn(
        self,
        x: Tensor,
        generator: torch.Generator | None,
        seen: list[Seen] | None = None,
        weights: Tensor | None = None,
    ) -> Tensor:
        """Draw coincidences, and append the detections of every share, whose pixels are rows, to `seen`."""
        with torch.no_grad():
            wide = self._check_window(check_rates(check_tensor(x, "CoincidencePixel"), "CoincidencePixel")).double()
            groups = []
            for share, number in self.groups:
                rate, dead = self._lit(wide, share)
                groups.append(Trains(rate.movedim(TIME, -1).reshape(-1, x.shape[TIME]), dead, number))
            if seen is not None:
                seen += [Seen(torch.zeros_like(g.rate), torch.zeros_like(g.rate)) for g in groups]
            rows = draw_coincidences(
                groups, self.cycles, self.coincidence, self.window_s / self.bin_width_s,
                free=self.periodic, generator=generator, seen=seen, weights=weights,
            )  # fmt: skip
            return rows.view(wide.movedim(TIME, -1).shape).movedim(-1, TIME).to(x.dtype)

    def forward(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        if self.grad != "score" or self._paralyzable:
            return super().forward(x, generator)
        dead = self._inner.dead_time_s
        if isinstance(dead, Tensor) and dead.requires_grad and torch.is_grad_enabled():
            raise GradientError(
                "CoincidencePixel: expected a dead time that is not learnt, whose score is not supported, got one. "
                "Choose grad='expected', 'gaussian' or 'straight_through'."
            )
        seen: list[Seen] = []
        measurement = self._drawn(x, generator, seen)

        def log_prob() -> Tensor:
            """Log-probability of the detections of all SPADs: armed detectors fire at the rate of the light."""
            total = torch.zeros_like(x.select(TIME, 0), dtype=torch.float64)
            for (share, _), known in zip(self.groups, seen, strict=True):
                rate = self._lit(x.double(), share)[0].movedim(TIME, -1)
                detected, armed = (rows.view(rate.shape) for rows in (known.detected, known.armed))
                total = total + (safe_xlogy(detected, rate) - armed * rate).sum(-1)
            return total

        record_score(log_prob, "CoincidencePixel")
        return measurement

    def log_prob(self, measurement: Tensor, x: Tensor) -> Tensor:
        """Log-probability of bins as independent binomials, each of which is exact.

        `grad="score"` scores the draws themselves.

        Args:
            measurement: counts (..., C, T, H, W).
            x: rate of the pixel per cycle and bin, (..., C, T, H, W).
        """
        p = self.probabilities(x.double()).clamp_max(1)
        return binomial_log_prob(measurement.double(), self.cycles, p).sum(TIME).to(x.dtype)


def _binomials(q: Tensor, number: int, most: int) -> list[Tensor]:
    """Chance that 0, 1, ... up to `most` of `number` lines are up."""
    return [math.comb(number, j) * q**j * (1 - q) ** (number - j) for j in range(min(number, most) + 1)]


def _product(a: list[Tensor], b: list[Tensor], most: int) -> list[Tensor]:
    """Product of polynomials by their coefficients, up to the power `most`."""
    found: list[Tensor | None] = [None] * min(len(a) + len(b) - 1, most + 1)
    for i, left in enumerate(a):
        for j, right in enumerate(b):
            if i + j < len(found):
                before = found[i + j]
                found[i + j] = left * right if before is None else before + left * right
    return [f for f in found if f is not None]


def _added(a: list[Tensor], b: list[Tensor]) -> list[Tensor]:
    longer, shorter = (a, b) if len(a) >= len(b) else (b, a)
    return [v + shorter[i] if i < len(shorter) else v for i, v in enumerate(longer)]
