"""Contract entries of impulse responses, photon budget and photon counting."""

from __future__ import annotations

import torch
from contract import Entry

from torchtransient import sensing
from torchtransient.errors import GradientError, ShapeError, UnitError

ENTRIES = [
    Entry(
        "ShotNoise",
        sensing.ShotNoise,
        random=True,
        conserves=lambda y: y.sum(),
        errors=(
            (lambda: sensing.ShotNoise(grad="magic"), GradientError),
            (lambda: sensing.ShotNoise()(torch.ones(3)), ShapeError),
            (lambda: sensing.ShotNoise()(torch.ones(1, 4, 1, 1, dtype=torch.int64)), UnitError),
            (lambda: sensing.poisson(torch.tensor([-1.0])), UnitError),
        ),
    ),
]
