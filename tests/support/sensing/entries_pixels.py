"""Contract entries of what differs from pixel to pixel: maps of numbers, delays, zones of SPADs."""

from __future__ import annotations

import torch

from support.sensing.contract import Entry, counts_like
from torchtransient import sensing

PS = 1e-12
MAP = torch.linspace(0.1, 0.9, 6, dtype=torch.float64).view(2, 3)  # one number for each pixel of the contract's input


def budget(learnt=False, **changes):
    kept = torch.nn.Parameter if learnt else torch.clone
    arguments = {
        "quantum_efficiency": kept(MAP),
        "ambient_rate_hz": kept(1e9 * MAP.flip(0)),
        "dark_count_rate_hz": 1e8 * MAP.unsqueeze(0),
    }
    return sensing.PhotonBudget(
        sensing.Optics(f_number=2.0),
        pulse_energy_j=1e-9,
        wavelength_m=532e-9,
        repetition_rate_hz=1e7,
        cycles=1000,
        bin_width_s=20 * PS,
        **arguments | changes,
    )


def whole_counts(shape, seed=0):
    return (60 * counts_like(shape, seed)).floor()


def skew(make, **keywords):
    delay_s = (MAP - 0.45) * 150 * PS
    return lambda **k: make(delay_s, bin_width_s=20 * PS, learnable=True, **keywords, **k)


def paralyzable(cycles):
    """A free-running detector with a closed form: solving for the other kind takes the time of all other entries."""
    return sensing.FreeRunningSPAD(cycles, 70 * PS, bin_width_s=20 * PS, kind="paralyzable")


def dead_times(**keywords):
    values = torch.tensor([[40.0, 70, 40], [110, 70, 55]]) * PS

    def spad(dead_time_s):
        return sensing.SynchronousSPAD(200, dead_time_s=dead_time_s, bin_width_s=20 * PS)

    return sensing.PixelGroups.by_value(values, spad, **keywords)


ENTRIES = [
    Entry("PhotonBudget-maps", budget),
    Entry("PhotonBudget-learnt", lambda: budget(learnt=True)),
    Entry("PixelSkew", skew(sensing.PixelSkew), conserves=lambda y: y.sum(-3)),
    Entry("PixelSkew-zero", skew(sensing.PixelSkew, boundary="zero")),
    Entry("DetectionSkew", skew(sensing.DetectionSkew), conserves=lambda y: y.sum(-3), input=whole_counts, random=True),
    Entry("MacroPixel", lambda **k: sensing.MacroPixel(sensing.SynchronousSPAD(50), 9, **k), random=True),
    Entry(
        "MacroPixel-weights",
        lambda **k: sensing.MacroPixel(
            sensing.SynchronousSPAD(200, dead_time_s=70 * PS, bin_width_s=20 * PS), 4, weights=[1, 3, 1, 0], **k
        ),
        random=True,
    ),
    Entry(
        "MacroPixel-free", lambda **k: sensing.MacroPixel(paralyzable(100), 4, **k), shape=(2, 1, 8, 1, 2), random=True
    ),
    Entry(
        "CoincidencePixel",
        lambda **k: sensing.CoincidencePixel(
            sensing.SynchronousSPAD(60), 6, coincidence=2, window_s=50 * PS, bin_width_s=20 * PS, **k
        ),
        shape=(2, 1, 8, 1, 2),
        random=True,
    ),
    Entry(
        "CoincidencePixel-weights",
        lambda **k: sensing.CoincidencePixel(
            paralyzable(300), 4, coincidence=2, window_s=45 * PS, weights=[1, 2, 2, 5], bin_width_s=20 * PS, **k
        ),
        shape=(2, 1, 8, 1, 2),
        random=True,
    ),
    Entry("PixelGroups", dead_times, random=True),
    Entry("ZoneSum", lambda: sensing.ZoneSum(2, 3), conserves=lambda y: y.sum((-1, -2))),
]
