"""An independent oracle: photons one by one, detectors with dead time, no histogram algebra. numpy only.

Time is in bins, period after period without a gap. A train of detections is made for many runs at once by `detect`
(exponential clocks in units of flux) or photon by photon by `photon_by_photon`; jitter and converter codes act on its
events. `compare` says how far the mean of a chain is from the events, and how far it would be by noise alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

# --- trains of detections -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Events:
    """Detections of `runs` independent runs of `periods` periods of `bins` bins: times (N,) from each run's start."""

    times: np.ndarray
    run: np.ndarray
    runs: int
    periods: int
    bins: int

    def __len__(self):
        return self.times.size

    @property
    def counts(self):
        """(runs, bins): the histogram over the period, run by run."""
        place = self.run * self.bins + np.floor(self.times % self.bins).astype(np.int64) % self.bins
        return np.bincount(place, minlength=self.runs * self.bins).reshape(self.runs, self.bins).astype(float)

    @property
    def histogram(self):
        return self.counts.sum(0)

    @property
    def mean(self):
        """Detections per period and bin."""
        return self.histogram / (self.runs * self.periods)

    def variance(self):
        """Of the counts of a run, bin by bin."""
        return self.counts.var(0, ddof=1)

    def fano(self):
        """Variance over mean of the number of detections of a run."""
        totals = np.bincount(self.run, minlength=self.runs)
        return totals.var(ddof=1) / totals.mean()

    def chosen(self, which):
        return replace(self, times=self.times[which], run=self.run[which])

    def jittered(self, rng, sigma):
        """Every event later by a normal delay, round its period."""
        period = np.floor(self.times / self.bins)
        moved = self.times + rng.normal(0.0, sigma, len(self))
        return replace(self, times=moved % self.bins + period * self.bins)

    def coded(self, widths):
        """Codes of unequal `widths` (bins,), whose sum is that of the bins, instead of times."""
        inside, period = self.times % self.bins, np.floor(self.times / self.bins)
        code = np.searchsorted(np.cumsum(widths), inside, side="right").clip(0, self.bins - 1)
        return replace(self, times=code + 0.5 + period * self.bins)


class Afterpulse(NamedTuple):
    """A detection triggers one with `probability`, `delays(rng, number)` bins after it; several are independent."""

    probability: float
    delays: object


def exponential_delays(tau, after=0.0):
    """Mean `tau`, counted from `after` on: 0 for carriers that are also set free while the detector is dead."""
    return lambda rng, n: after + rng.exponential(tau, n)


def measured_delays(edges, weights):
    """From a histogram of delays: even within each of its bins."""
    edges, weights = np.asarray(edges, float), np.asarray(weights, float)

    def draw(rng, n):
        k = rng.choice(weights.size, n, p=weights / weights.sum())
        return edges[k] + rng.random(n) * (edges[k + 1] - edges[k])

    return draw


class _Flux:
    """Photons expected up to a time, and the time of an expected number, for a rate that repeats."""

    def __init__(self, rate):
        self.bins, self.edges = len(rate), np.arange(len(rate) + 1.0)
        self.sums = np.concatenate([[0.0], np.cumsum(rate)])
        self.total = self.sums[-1]

    def until(self, t):
        return np.floor(t / self.bins) * self.total + np.interp(t % self.bins, self.edges, self.sums)

    def time(self, flux):
        rounds = np.floor(flux / self.total)
        return rounds * self.bins + np.interp(flux - rounds * self.total, self.sums, self.edges)


def detect(rng, rate, runs, periods=1, dead_bins=None, *, free_running=False, afterpulses=(), gate=None, warm_up=0):
    """Detections of `runs` detectors in light of `rate` (bins,) photons per period, non-paralyzable.

    In step with the laser (default) a detector is armed at the start of every period; after a detection it is dead for
    `dead_bins`, or to the end of the period (None), whichever is shorter. Free-running: dead for `dead_bins`, whatever
    the period; begins in the stationary state of constant light, and `warm_up` periods are thrown away. `gate` (bins,):
    share of photons that are seen; where it is 0 nothing fires, afterpulses neither. Afterpulses fire when the detector
    is armed, else never.
    """
    rate = np.asarray(rate, float) if gate is None else np.asarray(rate, float) * gate
    flux, bins = _Flux(rate), len(rate)
    end, kept = (periods + warm_up) * bins, []
    index = np.arange(runs)
    free = np.zeros(runs)
    if free_running:
        dead_share = dead_bins * flux.total / (bins + dead_bins * flux.total)
        free = np.where(rng.random(runs) < dead_share, rng.random(runs) * dead_bins, 0.0)
    pending = np.full((runs, 1), -1.0)
    while index.size:
        photon = np.full(index.size, np.inf)
        if flux.total > 0:
            # memoryless: whether the last candidate was overtaken by an afterpulse does not matter
            photon = np.maximum(flux.time(flux.until(free) + rng.exponential(size=free.shape)), free)
        t = np.minimum(photon, np.where(pending >= free[:, None], pending, np.inf).min(1))
        alive = t < end
        index, t, pending = index[alive], t[alive], pending[alive]
        kept.append((t, index))
        if free_running:
            free = t + dead_bins
        else:
            next_start = (np.floor(t / bins) + 1) * bins
            free = next_start if dead_bins is None else np.minimum(t + dead_bins, next_start)
        for probability, delays in afterpulses:
            pending = _with_pending(rng, t, free, pending, probability, delays, gate)
    times, run = (np.concatenate(column) for column in zip(*kept, strict=True))
    seen = times >= warm_up * bins
    return Events(times[seen] - warm_up * bins, run[seen], runs, periods, bins)


def _with_pending(rng, t, free, pending, probability, delays, gate):
    """Afterpulses of detections at `t` written over those that are over; more columns where none is."""
    later = np.where(rng.random(t.size) < probability, t + delays(rng, t.size), -1.0)
    if gate is not None:
        shut = np.asarray(gate)[np.floor(later % len(gate)).astype(int) % len(gate)] == 0
        later = np.where(shut, -1.0, later)
    new = later >= free
    column = pending.argmin(1)
    rows = np.arange(t.size)
    if np.any(new & (pending[rows, column] >= free)):
        pending = np.concatenate([pending, np.full((t.size, 1), -1.0)], 1)
        column = np.where(new & (pending[rows, column] >= free), pending.shape[1] - 1, column)
    pending[rows[new], column[new]] = later[new]
    return pending


def photon_by_photon(rng, rate, runs, periods=1, dead_bins=None, *, kind="non_paralyzable", free_running=False):
    """The same by walking through every photon, paralyzable free-running detectors too. No afterpulses."""
    bins = len(rate)
    # what the dead time of a run's first photon depends on
    warm_up = 0 if not free_running else 1 + int(np.ceil(dead_bins / bins)) * (1 if kind == "paralyzable" else 20)
    length = (periods + warm_up) * bins
    t = arrivals(rng, np.asarray(rate, float), runs * (periods + warm_up))
    if not free_running:
        over = np.floor(t / bins) * bins + bins
        t = t[_armed(t, over if dead_bins is None else np.minimum(t + dead_bins, over))]
    else:
        t = detections(t, dead_bins, kind)
    run = np.floor(t / length).astype(np.int64)
    t = t - run * length
    seen = t >= warm_up * bins
    return Events(t[seen] - warm_up * bins, run[seen], runs, periods, bins)


class Agreement(NamedTuple):
    """Total variation between a chain's mean and events, in shares of all counts, and what noise alone would give."""

    total_variation: float
    noise: float
    spread: float  # standard deviation of `noise`, as if bins were independent: it counts where they are few

    @property
    def ratio(self):
        return self.total_variation / self.noise

    def within(self, factor=1.5, exact=0.0):
        """Whether noise explains it: up to `factor` times the expected noise, and `exact` for what a chain claims."""
        return self.total_variation <= max(factor * self.noise, self.noise + 4 * self.spread) + exact


def compare(events, expected):
    """How far `expected`, detections per period and bin (or per run: any multiple), is from the mean of the events.

    `expected` is taken as it is, so that a wrong number of counts shows as well as a wrong shape. The noise is that of
    the runs themselves: a saturated detector has far less than that of independent counts. At least 30 runs.
    """
    if events.runs < 30:
        raise ValueError(f"compare: expected at least 30 runs to know the noise, got {events.runs}.")
    expected = np.asarray(expected, float).reshape(-1)
    if expected.shape != (events.bins,):
        raise ValueError(f"compare: expected {events.bins} bins, got {expected.shape}.")
    counts = events.counts / events.periods
    total = expected.sum()
    # mean of the size of a normal number; a bin of which nothing was seen has the noise of its expectation
    variance = np.maximum(counts.var(0, ddof=1), (counts.sum(0) == 0) * expected / events.periods)
    noise = np.sqrt(2 / np.pi * variance / events.runs).sum()
    spread = np.sqrt((1 - 2 / np.pi) * variance.sum() / events.runs)
    far = np.abs(counts.mean(0) - expected).sum()
    return Agreement(*(0.5 * float(value) / total for value in (far, noise, spread)))


# --- photons --------------------------------------------------------------------------------------------------------


def arrivals(rng, rate, periods):
    """Sorted arrival times, in bins, of a Poisson process whose rate repeats every len(rate) bins."""
    bins, total = len(rate), rate.sum()
    count = rng.poisson(total * periods)
    if count == 0:
        return np.zeros(0)
    inside = rng.choice(bins, count, p=rate / total) + rng.random(count)
    return np.sort(rng.integers(0, periods, count) * bins + inside)


def _armed(times, free):
    """Indices of the arrivals that find the detector armed, `free` being when each of them would arm it again."""
    following, kept, i = np.searchsorted(times, free).tolist(), [], 0
    while i < len(following):
        kept.append(i)
        i = max(following[i], i + 1)
    return np.array(kept, dtype=np.int64)


def detections(times, dead_bins, kind="non_paralyzable"):
    """The arrivals that are detected, by walking through them."""
    if kind == "paralyzable":
        gaps = np.diff(times, prepend=-np.inf)
        return times[gaps >= dead_bins]
    return times[_armed(times, times + dead_bins)]


# --- histograms -----------------------------------------------------------------------------------------------------


def total_variation(counts, expected):
    return 0.5 * np.abs(counts / counts.sum() - expected / expected.sum()).sum()


def dense_histogram(rate, dead_bins, pieces):
    """Detections per period and bin from a dense Markov matrix: bins cut in `pieces`, detections at their middles.

    Re-armed at the start of one of two pieces, so that the mean is right. Second order in the rate of a piece.
    """
    bins, r = len(rate) * pieces, np.repeat(rate / pieces, pieces)
    delay = dead_bins * pieces + 0.5
    whole = int(np.floor(delay + 1e-9))
    part = max(0.0, delay - whole)
    k = np.arange(bins)
    flux = np.concatenate([[0.0], np.cumsum(r)])
    # armed[i, j]: chance that a detector armed at piece i still is at the start of piece j
    between = flux[:-1][None, :] - flux[:-1][:, None]
    between = between + flux[-1] * (k[None, :] < k[:, None])
    armed = np.exp(-between) / -np.expm1(-flux[-1])
    waiting = (1 - part) * armed[(k + whole) % bins] + part * armed[(k + whole + 1) % bins]
    step = waiting * -np.expm1(-r)
    pi = np.linalg.solve(np.eye(bins) - step.T + 1 / bins, np.full(bins, 1 / bins))
    # one detection takes its dead time and its wait
    cycle = whole - 1 + part + (pi @ waiting).sum() / pi.sum()
    return (pi / pi.sum() * bins / cycle).reshape(len(rate), pieces).sum(-1)


def dense_limit(rate, dead_bins, pieces):
    """The limit of many pieces by Richardson's extrapolation, and a bound of its error (that of the finer of two)."""
    coarse, fine = dense_histogram(rate, dead_bins, pieces), dense_histogram(rate, dead_bins, 2 * pieces)
    return (4 * fine - coarse) / 3, np.abs(fine - coarse).max() / 3
