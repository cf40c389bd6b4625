"""Contract entries of coherent detection."""

from __future__ import annotations

from support.sensing.contract import Entry
from torchtransient.axes import TimeAxis
from torchtransient.chirps import Chirps
from torchtransient.sensing import BeatNoise, CoherentReceiver, Compose, Speckle

# Draws are pathwise under every policy but `expected`: no score is left to collect.
PATHWISE = {"random": True, "policies": ("expected", "gaussian", "straight_through")}

# Twelve bins, a quarter of a line each.
CHIRPS = Chirps(1e9, 1e-5, 1550e-9)
AXIS = TimeAxis(1.0, CHIRPS.resolution_opl / 4, 12)

ENTRIES = [
    Entry("Speckle", lambda grad="expected": Speckle(3.5, grad=grad), conserves=lambda y: y.sum(), **PATHWISE),
    Entry("BeatNoise", lambda grad="expected": BeatNoise(20.0, looks=2, grad=grad), **PATHWISE),
    Entry(
        "CoherentReceiver",
        lambda grad="expected": CoherentReceiver(CHIRPS, AXIS, photons_per_unit=20.0, looks=2, grad=grad),
        **PATHWISE,
    ),
    Entry("Compose-beats", lambda grad=None: Compose([Speckle(2), BeatNoise(20.0, 2)], grad=grad), **PATHWISE),
]
