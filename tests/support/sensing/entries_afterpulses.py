"""Contract entries of afterpulses by several laws of delays, and of detectors that they obey."""

from __future__ import annotations

import torch

from support.sensing.contract import Entry
from torchtransient import sensing

PS = 1e-12
WIDTH = {"bin_width_s": 20 * PS}


def several(**keywords):
    return sensing.Afterpulsing([0.03, 0.05], [90 * PS, 300 * PS], 50 * PS, **WIDTH, learnable=True, **keywords)


def power_law(**keywords):
    law = sensing.PowerLawDelays(1.2, 5e-9, learnable=True)
    return sensing.Afterpulsing(0.05, dead_time_s=50 * PS, delays=law, **WIDTH, learnable=True, **keywords)


def measured(**keywords):
    law = sensing.MeasuredDelays(torch.tensor([50.0, 20.0, 11.0, 7.0, 5.0]), 61 * PS, start_s=15 * PS, floor=4.0)
    return sensing.Afterpulsing(0.4, dead_time_s=50 * PS, delays=law, counted_from="avalanche", **WIDTH, **keywords)


def obeyed(detector, dead_time_s=70 * PS):
    def make(**keywords):
        return sensing.AfterpulsingSPAD(
            detector(), sensing.Afterpulsing([0.03, 0.02], [90 * PS, 700 * PS], dead_time_s, **WIDTH), **keywords
        )

    return make


ENTRIES = [
    Entry("Afterpulsing-several", several, random=True),
    Entry(
        "Afterpulsing-background",
        lambda **k: several(period_s=600 * PS, background=torch.linspace(0.0, 0.5, 6).view(2, 3), **k),
        random=True,
    ),
    Entry("Afterpulsing-power-law", power_law, random=True),
    Entry("Afterpulsing-measured", measured, random=True),
    Entry("AfterpulsingSPAD", obeyed(lambda: sensing.SynchronousSPAD(500)), random=True),
    Entry(
        "AfterpulsingSPAD-dead-time",
        obeyed(lambda: sensing.SynchronousSPAD(500, dead_time_s=70 * PS, **WIDTH)),
        random=True,
    ),
    Entry(
        "AfterpulsingSPAD-free",
        obeyed(lambda: sensing.FreeRunningSPAD(500, 70 * PS, **WIDTH, kind="paralyzable")),
        shape=(2, 1, 8, 1, 2),
        random=True,
    ),
]
