"""Contract entries of impulse responses, photon budget and photon counting."""

from __future__ import annotations

import torch

from support.sensing.contract import Entry, counts_like
from torchtransient import sensing

PS = 1e-12


def impulse(response, **keywords):
    return lambda: sensing.ImpulseResponse(response(), bin_width_s=20 * PS, **keywords)


def jitter(response, **keywords):
    return lambda **k: sensing.DetectionJitter(response(), bin_width_s=20 * PS, **keywords, **k)


def whole_counts(shape, seed=0):
    return torch.poisson(30 * counts_like(shape, seed), generator=torch.Generator().manual_seed(seed))


def tails():
    return sensing.TailedResponse(50 * PS, [30 * PS, 80 * PS], [0.3, 0.1], learnable=True)


def measured():
    counts = torch.tensor([3.0, 2, 3, 40, 90, 50, 30, 12, 3, 2, 3, 3, 2, 3, 2, 3, 3])
    return sensing.MeasuredResponse(counts, 13 * PS, learnable=True)


def composed():
    return sensing.ComposedResponse(
        [sensing.GaussianResponse(30 * PS, learnable=True), sensing.emg_response(20 * PS, 40 * PS)]
    )


ENTRIES = [
    Entry("ImpulseResponse-gaussian", impulse(lambda: sensing.GaussianResponse(50 * PS, learnable=True))),
    Entry("ImpulseResponse-even", impulse(lambda: sensing.UniformResponse(47 * PS, 3 * PS, learnable=True))),
    Entry("ImpulseResponse-tails", impulse(tails)),
    Entry("ImpulseResponse-measured", impulse(measured, boundary="periodic"), conserves=lambda y: y.sum(-3)),
    Entry("ImpulseResponse-composed", impulse(composed, boundary="periodic"), conserves=lambda y: y.sum(-3)),
    Entry(
        "LensBlur",
        lambda: sensing.LensBlur(0.5, "circular", learnable=True),
        shape=(2, 1, 3, 4, 5),
        conserves=lambda y: y.sum((-1, -2)),
    ),
    Entry(
        "SpatialPSF", lambda: sensing.SpatialPSF(torch.arange(9.0).view(3, 3), learnable=True), shape=(2, 1, 3, 4, 5)
    ),
    Entry(
        "PhotonBudget",
        lambda: sensing.PhotonBudget(
            sensing.Optics(f_number=2.0),
            pulse_energy_j=1e-9,
            wavelength_m=532e-9,
            repetition_rate_hz=1e7,
            cycles=1000,
            ambient_rate_hz=1e6,
            bin_width_s=20 * PS,
        ),
    ),
    Entry("SynchronousSPAD", lambda **k: sensing.SynchronousSPAD(500, **k), random=True),
    Entry(
        "SynchronousSPAD-gate",
        lambda **k: sensing.SynchronousSPAD(500, gate=torch.linspace(0, 1, 12), **k),
        random=True,
    ),
    Entry(
        "SynchronousSPAD-dead-time",
        lambda **k: sensing.SynchronousSPAD(500, dead_time_s=70 * PS, bin_width_s=20 * PS, **k),
        random=True,
    ),
    Entry(
        "FreeRunningSPAD",
        lambda **k: sensing.FreeRunningSPAD(500, 75 * PS, bin_width_s=20 * PS, learnable=True, **k),
        random=True,
    ),
    Entry(
        "FreeRunningSPAD-paralyzable",
        lambda **k: sensing.FreeRunningSPAD(500, 75 * PS, bin_width_s=20 * PS, kind="paralyzable", learnable=True, **k),
        random=True,
    ),
    Entry(
        "Afterpulsing",
        lambda **k: sensing.Afterpulsing(0.05, 90 * PS, 50 * PS, bin_width_s=20 * PS, learnable=True, **k),
        random=True,
    ),
    Entry("Crosstalk", lambda **k: sensing.Crosstalk(0.05, diagonal_ratio=0.3, learnable=True, **k), random=True),
    Entry(
        "TDC",
        lambda **k: sensing.TDC(sensing.random_code_widths(12, 0.2, torch.Generator().manual_seed(0)), **k),
        input=whole_counts,
        conserves=lambda y: y.sum(-3),
        random=True,
        # none of its numbers is learnt: nothing for a score of its own
        policies=("expected", "gaussian", "straight_through"),
    ),
    Entry(
        "TDC-dither",
        lambda **k: sensing.TDC(torch.ones(12), dither=True, sliding_scale=3, offset_bins=0.3, **k),
        input=whole_counts,
        conserves=lambda y: y.sum(-3),
        random=True,
        policies=("expected", "gaussian", "straight_through"),
    ),
    Entry("TDC-rates", lambda: sensing.TDC(torch.ones(12), dither=True, acts_on="rates", boundary="zero")),
    Entry("DetectionJitter", jitter(tails), input=whole_counts, conserves=lambda y: y.sum(-3), random=True),
    Entry("DetectionJitter-zero", jitter(measured, boundary="zero"), input=whole_counts, random=True),
    Entry("DetectionJitter-composed", jitter(composed, within_bin="center"), input=whole_counts, random=True),
    Entry("BinaryFrames", lambda **k: sensing.BinaryFrames(50, **k), random=True),
    Entry("EquiDepthHistogram", lambda: sensing.EquiDepthHistogram(5)),
    Entry("CodedHistogram", lambda: sensing.CodedHistogram(sensing.fourier_codes(12, 4), learnable=True)),
    Entry("ShotNoise", sensing.ShotNoise, random=True, conserves=lambda y: y.sum()),
]
