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
