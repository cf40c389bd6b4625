"""Contract entries of afterpulses by several laws of delays, and of detectors that they obey."""

from __future__ import annotations

import torch

from support.sensing.contract import Entry
from torchtransient import sensing
from torchtransient.errors import ArgumentError, ShapeError, UnitError

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
        errors=(
            (lambda: several(background=-1.0), UnitError),
            (lambda: several(period_s=600 * PS, background=torch.ones(2, 2))(torch.ones(1, 12, 2, 3)), ShapeError),
        ),
    ),
    Entry(
        "Afterpulsing-power-law",
        power_law,
        random=True,
        errors=(
            (lambda: sensing.Afterpulsing(0.05, dead_time_s=0.0, delays=sensing.PowerLawDelays(1.0, 1e-8), **WIDTH),
             UnitError),
            (lambda: power_law(counted_from="avalanche"), UnitError),
            (lambda: power_law(counted_from="photon"), ArgumentError),
            (lambda: sensing.PowerLawDelays(-1.0, 1e-8), UnitError),
            (lambda: sensing.PowerLawDelays(1.0, 10.0), UnitError),
        ),
    ),
    Entry(
        "Afterpulsing-measured",
        measured,
        random=True,
        errors=(
            (lambda: sensing.MeasuredDelays(torch.ones(2, 2), 1e-9), ShapeError),
            (lambda: sensing.MeasuredDelays("delays.csv", 1e-9), ShapeError),
            (lambda: sensing.MeasuredDelays(torch.ones(3), 1e-9, floor=2.0), UnitError),
            (lambda: sensing.MeasuredDelays(-torch.ones(3), 1e-9), UnitError),
            (lambda: sensing.Afterpulsing([0.1, 0.1], [1e-9], 0.0, **WIDTH), ShapeError),
            (lambda: sensing.Afterpulsing([0.3, 0.3], [1e-9, 1e-8], 0.0, **WIDTH), UnitError),
            (lambda: sensing.Afterpulsing([], [], 0.0, **WIDTH), UnitError),
            (lambda: sensing.Afterpulsing(0.1, 1e-9, **WIDTH), UnitError),
            (lambda: sensing.Afterpulsing(0.1, dead_time_s=1e-9, **WIDTH), UnitError),
            (lambda: sensing.Afterpulsing(
                0.1, dead_time_s=9e-9, delays=sensing.MeasuredDelays(torch.ones(3), 1e-9), counted_from="avalanche",
                **WIDTH), UnitError),
        ),
    ),
    Entry(
        "AfterpulsingSPAD",
        obeyed(lambda: sensing.SynchronousSPAD(500)),
        random=True,
        errors=(
            (lambda: sensing.AfterpulsingSPAD(sensing.ShotNoise(), several()), UnitError),
            (lambda: sensing.AfterpulsingSPAD(sensing.SynchronousSPAD(5), 0.1), UnitError),
            (lambda: sensing.AfterpulsingSPAD(sensing.FreeRunningSPAD(5, 75 * PS, **WIDTH), several()), UnitError),
        ),
    ),
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
]  # fmt: skip
