"""Contract entries of coherent detection."""

from __future__ import annotations

from support.sensing.contract import Entry
from torchtransient.errors import UnitError
from torchtransient.sensing import BeatNoise, Compose, Speckle

# Draws are pathwise under every policy but `expected`: no score is left to collect.
PATHWISE = {"random": True, "policies": ("expected", "gaussian", "straight_through")}

ENTRIES = [
    Entry(
        "Speckle", lambda grad="expected": Speckle(3.5, grad=grad), conserves=lambda y: y.sum(),
        errors=((lambda: Speckle(0.5), UnitError),), **PATHWISE,
    ),
    Entry(
        "BeatNoise", lambda grad="expected": BeatNoise(20.0, looks=2, grad=grad),
        errors=((lambda: BeatNoise(0.0), UnitError), (lambda: BeatNoise(1.0, looks=0), UnitError)), **PATHWISE,
    ),
    Entry("Compose-beats", lambda grad=None: Compose([Speckle(2), BeatNoise(20.0, 2)], grad=grad), **PATHWISE),
]  # fmt: skip
