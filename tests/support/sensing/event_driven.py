"""An independent oracle: photons one by one, detectors with dead time, no histogram algebra. numpy only."""

from __future__ import annotations

import numpy as np


def arrivals(rng, rate, periods):
    """Sorted arrival times, in bins, of a Poisson process whose rate repeats every len(rate) bins."""
    bins, total = len(rate), rate.sum()
    count = rng.poisson(total * periods)
    inside = rng.choice(bins, count, p=rate / total) + rng.random(count)
    return np.sort(rng.integers(0, periods, count) * bins + inside)


def detections(times, dead_bins, kind="non_paralyzable", armed_at=None):
    """The arrivals that are detected, by walking through them."""
    if kind == "paralyzable":
        gaps = np.diff(times, prepend=-np.inf)
        return times[gaps >= dead_bins]
    kept, free = [], -np.inf
    for t in times:
        if t >= free:
            kept.append(t)
            free = t + dead_bins
    return np.array(kept)


def histogram(times, bins):
    return np.bincount(np.floor(times % bins).astype(int) % bins, minlength=bins).astype(float)


def synchronous(rng, rate, cycles, dead_bins=None):
    """Histogram of `cycles` independent cycles; dead_bins None: the first photon only."""
    bins, total = len(rate), np.zeros(len(rate))
    for _ in range(cycles):
        count = rng.poisson(rate.sum())
        times = np.sort(rng.choice(bins, count, p=rate / rate.sum()) + rng.random(count))
        kept = times[:1] if dead_bins is None else detections(times, dead_bins)
        total += histogram(kept, bins)
    return total


def total_variation(counts, expected):
    return 0.5 * np.abs(counts / counts.sum() - expected / expected.sum()).sum()


def chi2_per_dof(counts, expected):
    """Pearson's statistic over bins that expect 5 counts or more."""
    use = expected >= 5
    return (((counts - expected) ** 2 / expected)[use]).sum() / use.sum()


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


def last_phases(rng, rate, dead_bins, phases, steps):
    """Phases of independent detectors `steps` detections after `phases`, by exponential waits in units of flux."""
    bins, flux = len(rate), np.concatenate([[0.0], np.cumsum(rate)])
    edges = np.arange(bins + 1.0)
    for _ in range(steps):
        armed = (phases + dead_bins) % bins
        target = np.interp(armed, edges, flux) + rng.exponential(size=armed.shape)
        phases = np.interp(target % flux[-1], flux, edges)
    return phases
