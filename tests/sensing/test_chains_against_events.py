"""Chains of detectors, jitter and converters against events: dim to blinding, first and last bins, odd dead times."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from support.sensing.event_driven import compare, detect, photon_by_photon
from torchtransient import sensing

BINS, WIDTH_S, SIGMA = 32, 1e-10, 0.8
T = np.arange(BINS)
GATE = np.clip((T - 3) / 4, 0, 1)
WIDTHS = sensing.random_code_widths(BINS, 0.2, torch.Generator().manual_seed(0))
SHAPES = {
    "pulse": 0.4 / BINS + np.exp(-0.5 * ((T - 11.3) / 1.5) ** 2) / 6,
    "ends": 0.4 / BINS + 0.1 * np.exp(-0.5 * (np.minimum(T + 0.5, BINS - T - 0.5) / 2.5) ** 2),
    "spikes": 0.4 / BINS + 0.3 * (T == 0) + 0.3 * (T == BINS - 1),
}


def seconds(bins):
    return {"dead_time_s": bins * WIDTH_S, "bin_width_s": WIDTH_S}


def jitter():
    return sensing.DetectionJitter(
        sensing.GaussianResponse(SIGMA * 2 * (2 * np.log(2)) ** 0.5 * WIDTH_S), bin_width_s=WIDTH_S
    )


# name: (stages for one cycle, events); light is even inside a bin in both
CHAINS = {
    "first photon": (lambda: [sensing.SynchronousSPAD(1)], lambda rng, rate, n: detect(rng, rate, n)),
    "first photon, gate": (
        lambda: [sensing.SynchronousSPAD(1, gate=torch.tensor(GATE))],
        lambda rng, rate, n: detect(rng, rate, n, gate=GATE),
    ),
    "several hits": (
        lambda: [sensing.SynchronousSPAD(1, **seconds(1.3))],
        lambda rng, rate, n: detect(rng, rate, n, 1, 1.3),
    ),
    "several hits, gate, jitter": (
        lambda: [sensing.SynchronousSPAD(1, gate=torch.tensor(GATE), **seconds(7.6)), jitter()],
        lambda rng, rate, n: detect(rng, rate, n, 1, 7.6, gate=GATE).jittered(rng, SIGMA),
    ),
    "several hits, jitter, codes": (
        lambda: [sensing.SynchronousSPAD(1, **seconds(2.4)), jitter(), sensing.TDC(WIDTHS)],
        lambda rng, rate, n: detect(rng, rate, n, 1, 2.4).jittered(rng, SIGMA).coded(WIDTHS.numpy()),
    ),
    "free-running": (
        lambda: [sensing.FreeRunningSPAD(1, **seconds(20.3))],
        lambda rng, rate, n: detect(rng, rate, n // 20, 20, 20.3, free_running=True, warm_up=30),
    ),
    "free-running, jitter": (
        lambda: [sensing.FreeRunningSPAD(1, **seconds(45.7)), jitter()],
        lambda rng, rate, n: detect(rng, rate, n // 20, 20, 45.7, free_running=True, warm_up=30).jittered(rng, SIGMA),
    ),
    "paralyzable": (
        lambda: [sensing.FreeRunningSPAD(1, kind="paralyzable", **seconds(5.7))],
        lambda rng, rate, n: photon_by_photon(
            rng, rate, n // 20, 20, 5.7, kind="paralyzable", free_running=True
        ),
    ),
}  # fmt: skip

# in bins of a photon and more detections crowd at an edge; jitter and codes take them as even
ROUGH = {1.0: 1e-4, 10.0: 6e-3, 100.0: 3e-2}
DEFAULT = {
    ("several hits, jitter, codes", "ends", 10.0),
    ("free-running, jitter", "pulse", 1.0),
    ("first photon, gate", "pulse", 10.0),
    ("paralyzable", "spikes", 1.0),
}
CASES = [
    pytest.param(chain, shape, total, marks=() if (chain, shape, total) in DEFAULT else pytest.mark.slow)
    for chain in CHAINS
    for shape in SHAPES
    for total in ROUGH
    # jitter and codes know light by its bins: where it is steep in a bin, they do not
    if shape != "spikes" or "jitter" not in chain
]


@pytest.mark.parametrize("chain, shape, total", CASES)
def test_mean_against_events(chain, shape, total):
    stages, events = CHAINS[chain]
    rate = total * SHAPES[shape] / SHAPES[shape].sum()
    seen = events(np.random.default_rng(11), rate, 20_000 if total < 50 else 6000)
    mean = sensing.Compose(stages()).expected(torch.tensor(rate).view(1, BINS, 1, 1)).flatten().numpy()
    # a paralyzable detector in a flood sees almost nothing, and does not move detections
    alone = len(stages()) == 1 and "running" not in chain
    agreement = compare(seen, mean)
    assert agreement.within(1.5, exact=1e-5 if alone else ROUGH[total]), agreement


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
