"""Contract entries of what differs from pixel to pixel: maps of numbers, delays, zones of SPADs."""

from __future__ import annotations

import torch

from support.sensing.contract import Entry, counts_like
from torchtransient import sensing
from torchtransient.errors import ShapeError, UnitError

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
        sensing.Optics(f_number=2.0), pulse_energy_j=1e-9, wavelength_m=532e-9, repetition_rate_hz=1e7, cycles=1000,
        bin_width_s=20 * PS, **arguments | changes,
    )  # fmt: skip


def whole_counts(shape, seed=0):
    return (60 * counts_like(shape, seed)).floor()


def skew(make, **keywords):
    delay_s = (MAP - 0.45) * 150 * PS
    return lambda **k: make(delay_s, bin_width_s=20 * PS, learnable=True, **keywords, **k)


ENTRIES = [
    Entry(
        "PhotonBudget-maps",
        budget,
        errors=(
            (lambda: budget()(torch.ones(1, 12, 2, 4)), ShapeError),
            (lambda: budget(ambient_rate_hz=MAP[0]), ShapeError),
            (lambda: budget(quantum_efficiency=2 * MAP), UnitError),
            (lambda: budget(quantum_efficiency=MAP / 0), UnitError),
            (lambda: sensing.ambient_photon_rate(
                sensing.Optics(2.0), 0.5, spectral_irradiance_w_m2_nm=1.0, filter_bandwidth_m=10.0, wavelength_m=9e-7
            ), UnitError),
        ),
    ),
    Entry("PhotonBudget-learnt", lambda: budget(learnt=True)),
    Entry("PixelSkew", skew(sensing.PixelSkew), conserves=lambda y: y.sum(-3)),
    Entry("PixelSkew-zero", skew(sensing.PixelSkew, boundary="zero")),
    Entry(
        "DetectionSkew",
        skew(sensing.DetectionSkew),
        conserves=lambda y: y.sum(-3),
        input=whole_counts,
        random=True,
        # what is drawn depends on whole counts, which have no gradient
        policies=("expected", "gaussian", "straight_through"),
        errors=(
            (lambda: sensing.DetectionSkew(50.0, bin_width_s=20 * PS), UnitError),
            (lambda: sensing.PixelSkew(50 * PS), UnitError),
            (lambda: sensing.PixelSkew(50 * PS, bin_width_s=20 * PS, boundary="open"), ShapeError),
            (lambda: skew(sensing.PixelSkew)()(torch.ones(1, 12, 3, 3)), ShapeError),
        ),
    ),
]  # fmt: skip
