"""Pile-up, jitter of each detection and unequal codes together, against detections followed one by one."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from support.sensing.event_driven import compare, detect, exponential_delays, gaussian_delays
from torchtransient.sensing import TDC, Compose, DetectionJitter, SynchronousSPAD, TailedResponse, random_code_widths

BINS, WIDTH_S, CYCLES = 24, 1e-10, 6000
WIDTHS = random_code_widths(BINS, 0.1, torch.Generator().manual_seed(0))
FWHM, TAIL, SHARE = 3.0, 2.5, 0.3  # of the jitter, in bins


def shapes():
    """Rows with sum 1: a pulse in ambient light; light in the first and the last bin."""
    t = np.arange(BINS)
    pulse = 0.3 / BINS + np.exp(-0.5 * ((t - 0.6 * BINS) / 2) ** 2) / 7
    ends = 0.3 / BINS + 1.0 * ((t == 0) | (t == BINS - 1))
    return {name: row / row.sum() for name, row in (("pulse", pulse), ("ends", ends))}


def chain(dead, cycles=1):
    again = {} if dead is None else {"dead_time_s": dead * WIDTH_S, "bin_width_s": WIDTH_S}
    response = TailedResponse(FWHM * WIDTH_S, [TAIL * WIDTH_S], [SHARE])
    jitter = DetectionJitter(response, bin_width_s=WIDTH_S)
    return Compose([SynchronousSPAD(cycles, **again), jitter, TDC(WIDTHS, dither=True)])


def stamped(rng, events):
    """The detections with a delay each, in the codes of the converter, round the window."""
    normal, late = gaussian_delays(FWHM / 2.3548200450309493), exponential_delays(TAIL)

    def delays(rng, number):
        return normal(rng, number) + late(rng, number) * (rng.random(number) < SHARE)

    jittered = events.jittered(rng, delays)
    dithered = jittered.jittered(rng, lambda rng, number: rng.random(number))
    return dithered.coded(rng, WIDTHS.numpy())


@pytest.mark.parametrize("dead", [None, 6.3])
@pytest.mark.parametrize("shape, total", list(zip(sorted(shapes()), (0.1, 10.0, 1.0), strict=False)))
def test_chain_against_events(shape, total, dead):
    rng = np.random.default_rng(2)
    rate = total * shapes()[shape]
    events = stamped(rng, detect(rng, rate, CYCLES, 1, dead))
    x = torch.as_tensor(rate, dtype=torch.float64).reshape(1, -1, 1, 1)
    # the place in a bin that the detector takes for even: early by r/12 bins where a bin has r photons
    early = float((rate.max() / 12) if rate.max() > 0.3 else 0) / FWHM
    agreement = compare(events, chain(dead).expected(x).flatten())
    assert agreement.within(1.5, exact=1e-5 + early), agreement
    h = chain(dead, 50).sample(x.expand(CYCLES // 50, 1, BINS, 1, 1), torch.Generator().manual_seed(0))
    assert torch.equal(h, h.round())
    agreement = compare(events, h.view(-1, BINS).mean(0).numpy() / 50)
    assert agreement.within(1.5 * 2**0.5, exact=1e-5 + early), agreement


def test_detections_crowd_at_the_start_of_bright_bins():
    """The limit that the page names: early by r/12 bins for r photons in a bin, and gone in finer bins."""
    r, rng = 3.0, np.random.default_rng(3)
    rate = np.zeros(BINS)
    rate[10:14] = r
    events = detect(rng, rate, 20_000)
    first = events.times % 1
    mean = 1 / r - 1 / np.expm1(r)
    assert first[events.times < 11].mean() == pytest.approx(mean, abs=5 * 0.3 / 20_000**0.5)
    assert 0.5 - mean == pytest.approx(r / 12, rel=0.2)
