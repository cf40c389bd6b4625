"""The oracle itself: trains of detections against closed forms, and its two ways of making them against each other."""

from __future__ import annotations

import numpy as np
import pytest

from support.sensing.event_driven import Afterpulse, compare, detect, measured_delays, photon_by_photon

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
def test_first_photons(make):
    total = 3.0
    rate = uneven(total)
    events = make(rng(), rate, RUNS, 2)
    before = np.cumsum(rate) - rate
    wanted = -np.expm1(-rate) * np.exp(-before)
    assert compare(events, wanted).ratio < 1.5
    # at most one a period, independent
    assert events.fano() == pytest.approx(np.exp(-total), rel=6 * (2 / RUNS) ** 0.5)


@both
def test_free_running_in_constant_light(make):
    """Rate n/(1 + n d), and 1/(1 + n d)^2 of the variance of photons (renewal theory, for long runs)."""
    rate, periods, runs, dead = 10 / BINS, 40, 600, 7.3
    events = make(rng(2), np.full(BINS, rate), runs, periods, dead, free_running=True)
    mean = rate / (1 + rate * dead)
    close(totals(events), mean * BINS * periods)
    gaps = 1 + rate * dead
    # the ends of a stationary run
    ends = 1 / 6 + 1 / (2 * gaps**4) - 2 / (3 * gaps**3)
    variance = mean * BINS * periods / gaps**2 + ends
    assert totals(events).var() == pytest.approx(variance, rel=6 * (2 / runs) ** 0.5)


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
