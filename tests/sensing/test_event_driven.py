"""The oracle itself: trains of detections against closed forms, and its two ways of making them against each other."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special

from support.sensing.event_driven import (
    Afterpulse,
    Events,
    compare,
    detect,
    exponential_delays,
    gaussian_delays,
    measured_delays,
    photon_by_photon,
)

BINS = 16
RUNS = 4000


def rng(seed=0):
    return np.random.default_rng(seed)


def uneven(total, bins=BINS):
    shape = 0.4 + np.cos(np.arange(bins)) ** 4 + 6 * (np.arange(bins) == 5)
    return total * shape / shape.sum()


def close(values, mean, sigmas=4.5):
    assert abs(values.mean() - mean) < sigmas * values.std(ddof=1) / np.sqrt(values.size)


def totals(events):
    return np.bincount(events.run, minlength=events.runs)


both = pytest.mark.parametrize("make", [detect, photon_by_photon])


@both
@pytest.mark.parametrize("total", [0.1, 3.0])
def test_first_photons(make, total):
    rate = uneven(total)
    events = make(rng(), rate, RUNS, 2)
    before = np.cumsum(rate) - rate
    wanted = -np.expm1(-rate) * np.exp(-before)
    assert compare(events, wanted).ratio < 1.5
    # at most one a period, independent
    assert events.fano() == pytest.approx(np.exp(-total), rel=6 * (2 / RUNS) ** 0.5)


@both
@pytest.mark.parametrize("total, dead", [(0.5, 3.7), (30.0, 0.2)])
def test_number_of_detections_of_a_cycle(make, total, dead):
    """Constant light: the k-th detection is a gamma time and k - 1 dead times after the start."""
    events = make(rng(1), np.full(BINS, total / BINS), RUNS, 1, dead)
    k = np.arange(1, 200)
    left = np.maximum(BINS - (k - 1) * dead, 0)
    at_least = special.gammainc(k, total / BINS * left) * (left > 0)
    mean, square = at_least.sum(), ((2 * k - 1) * at_least).sum()
    close(totals(events), mean)
    assert totals(events).var() == pytest.approx(square - mean**2, rel=8 * (2 / RUNS) ** 0.5, abs=1e-3)


@both
@pytest.mark.parametrize("total, dead", [(0.1, 20.3), (10.0, 7.3)])
def test_free_running_in_constant_light(make, total, dead):
    """Rate n/(1 + n d), and 1/(1 + n d)^2 of the variance of photons (renewal theory, for long runs)."""
    rate, periods, runs = total / BINS, 40, 600 if total < 100 else 200
    events = make(rng(2), np.full(BINS, rate), runs, periods, dead, free_running=True)
    mean = rate / (1 + rate * dead)
    close(totals(events), mean * BINS * periods)
    gaps = 1 + rate * dead
    # the ends of a stationary run
    ends = 1 / 6 + 1 / (2 * gaps**4) - 2 / (3 * gaps**3)
    variance = mean * BINS * periods / gaps**2 + ends
    assert totals(events).var() == pytest.approx(variance, rel=6 * (2 / runs) ** 0.5)


def test_paralyzable_in_constant_light():
    rate, dead, periods = 0.2, 4.3, 60
    events = photon_by_photon(rng(), np.full(BINS, rate), 1500, periods, dead, kind="paralyzable", free_running=True)
    mean = rate * np.exp(-rate * dead)
    close(totals(events), mean * BINS * periods)
    # pairs closer than the dead time are missing, those further are independent: an exact sum over pairs
    variance = mean * BINS * periods - (2 * dead * BINS * periods - dead**2) * mean**2
    assert totals(events).var() == pytest.approx(variance, rel=6 * (2 / 1500) ** 0.5)


@pytest.mark.slow
@pytest.mark.parametrize("free", [False, True])
@pytest.mark.parametrize("total, dead", [(0.1, 3.7), (3.0, 21.4), (40.0, 1.3)])
def test_both_ways_agree_in_uneven_light(free, total, dead):
    rate = uneven(total)
    photons = photon_by_photon(rng(3), rate, RUNS // 4, 40, dead, free_running=free)
    warm = {"warm_up": 40} if free else {}
    clocks = detect(rng(4), rate, RUNS // 4, 40, dead, free_running=free, **warm)
    # two noises of the same size
    assert compare(photons, clocks.mean).ratio < 1.5 * 2**0.5


def test_afterpulses_obey_dead_time():
    """Delays between one and two dead times: gaps are independent, the shorter of two times each."""
    rate, dead, p = 0.15, 4.0, 0.4
    short, weights = np.array([4.5, 5.0, 7.5]), np.array([1.0, 2.0])
    after = [Afterpulse(p, measured_delays(short, weights))]
    events = detect(rng(), np.full(BINS, rate), 500, 40, dead, free_running=True, afterpulses=after, warm_up=9)
    # mean gap: dead time and the integral of what is left of both
    x = np.linspace(0, 200, 400_001)
    fired = np.interp(x + dead, short, np.concatenate([[0], np.cumsum(weights / weights.sum())]))
    left = np.exp(-rate * x) * (1 - p * fired)
    gap = dead + float(((left[1:] + left[:-1]) * np.diff(x)).sum() / 2)
    close(totals(events), BINS * 40 / gap)
    # with every delay inside the dead time there is none
    none = [Afterpulse(1.0, measured_delays([0.0, 3.9], [1.0]))]
    events = detect(rng(), np.full(BINS, rate), 500, 40, dead, free_running=True, afterpulses=none, warm_up=10)
    close(totals(events), BINS * 40 * rate / (1 + rate * dead))


@pytest.mark.parametrize("free", [False, True])
def test_afterpulses_in_the_dark(free):
    """Every photon has a family of 1/(1 - q), q the share of releases after the dead time; a gate loses those outside.

    The light is so weak that families do not meet.
    """
    rate, dead, taus, p = np.full(BINS, 2e-5), 3.0, (2.0, 9.0), (0.3, 0.2)
    after = [Afterpulse(share, exponential_delays(tau)) for share, tau in zip(p, taus, strict=True)]
    q = sum(share * np.exp(-dead / tau) for share, tau in zip(p, taus, strict=True))
    events = detect(rng(5), rate, 4000, 1000, dead, free_running=True, afterpulses=after)
    # families end at different places of a run: what is lost at the end is a thousandth
    close(totals(events), 1000 * rate.sum() / (1 - q), 5.0)
    gate = (np.arange(BINS) < 4) * 1.0
    gated = detect(rng(5), rate, 4000, 1000, dead, free_running=free, afterpulses=after, gate=gate)
    assert len(gated) > 50 and np.all(gated.times % BINS < 4)


def test_jitter():
    events = Events(np.full(20_000, 15.5), np.zeros(20_000, int), 1, 1, BINS)
    moved = events.jittered(rng(), gaussian_delays(0.5, 1.0))
    assert len(moved) == 20_000
    unwrapped = np.where(moved.times < 8, moved.times + BINS, moved.times)
    close(unwrapped, 16.5)
    assert unwrapped.std() == pytest.approx(0.5, rel=0.03)
    kept = events.jittered(rng(), gaussian_delays(0.5, 1.0), "zero")
    assert len(kept) == pytest.approx(20_000 * special.ndtr(-1), rel=0.06)


def test_codes():
    widths = np.array([0.5, 1.5, 1.0, 0.25, 1.75, 1.0])
    flat = Events(rng(1).random(60_000) * 6, np.zeros(60_000, int), 1, 1, 6)

    def share(**how):
        return flat.coded(rng(2), widths, **how).histogram / 10_000

    noise = 5 * (1 / 10_000) ** 0.5
    np.testing.assert_allclose(share(), widths, atol=noise)
    # each code sees every width once; what the non-linearity at an offset shifts leaves the window at one of its ends
    turns = np.concatenate([[0.0], np.cumsum(np.tile(widths, 2))])
    parts = [np.diff(np.clip(turns[s : s + 7] - s, 0, 6)) for s in range(6)]
    np.testing.assert_allclose(share(sliding_scale=6), np.mean(parts, 0), atol=noise)
    np.testing.assert_allclose(share(sliding_scale=6)[1:5], 1.0, atol=noise)
    np.testing.assert_allclose(share(offset_bins=0.75).sum(), 5.25, atol=noise)
    # dither: the first code loses what the offset carries on, half of what is spread up to one bin
    narrow = Events(np.full(40_000, 2.25), np.zeros(40_000, int), 1, 1, 6)
    np.testing.assert_allclose(
        narrow.coded(rng(3), np.ones(6), dither=True).histogram / 40_000, [0, 0, 0.75, 0.25, 0, 0], atol=0.015
    )


def test_comparison_knows_right_from_wrong():
    rate = uneven(2.0)
    events = detect(rng(6), rate, 3000, 4, 2.6)
    right = detect(rng(7), rate, 60_000, 4, 2.6).mean
    assert 0.5 < compare(events, right).ratio < 1.5
    assert compare(events, 1.1 * right).ratio > 3
    assert compare(events, np.roll(right, 1)).ratio > 3
    with pytest.raises(ValueError, match="30 runs"):
        compare(detect(rng(), rate, 20), right)
    with pytest.raises(ValueError, match="bins"):
        compare(events, right[1:])


def test_nothing_to_see():
    dark = detect(rng(), np.zeros(4), 50, 2, 1.5)
    assert len(dark) == 0 and dark.histogram.sum() == 0
    assert len(photon_by_photon(rng(), np.zeros(4), 50, 2)) == 0
