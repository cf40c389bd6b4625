"""Contract entries of cameras: iToF, streak, gated, polarization, devices."""

from __future__ import annotations

import torch

from support.sensing.contract import Entry
from torchtransient import sensing
from torchtransient.axes import TimeAxis

AXIS = TimeAxis(0.5, 0.2, 12)
MAP_M = 0.2 * torch.arange(6.0).reshape(2, 3)


def itof_correlation():
    return sensing.ItofCorrelation(sensing.square_code(4), (20e6, 60e6), AXIS, contrast=0.8)


def two_tap_camera():
    """Pixels of two taps whose phases differ, by a code with corners."""
    known = sensing.ItofCalibration(
        phase_offset_rad=0.3, direction=-1, phase_map_rad=0.1 * torch.arange(6.0).reshape(2, 3)
    )
    return sensing.ItofCorrelation(sensing.TwoTapCode(sensing.square_code(2)), (20e6, 60e6), AXIS, calibration=known)


def pixel_electronics(grad="expected"):
    return sensing.PixelElectronics(
        full_well_e=1e4,
        read_noise_e=3.0,
        ktc_noise_e=2.0,
        excess_noise=1.2,
        gain_e_per_dn=0.5,
        bits=14,
        black_level_dn=100.0,
        offset_map_e=torch.tensor(0.25),
        gain_map=torch.tensor(1.1),
        grad=grad,
    )


def chain(grad=None):
    return sensing.Compose(
        [
            sensing.ImpulseResponse(sensing.GaussianResponse(900e-12), AXIS, boundary="periodic"),
            itof_correlation(),
            sensing.PixelElectronics(read_noise_e=0.5),
        ],
        grad=grad,
    )


def differences(grad=None):
    """Two taps with the noise of both, and their difference."""
    code = sensing.TwoTapCode(sensing.sine_code(2))
    return sensing.Compose(
        [
            sensing.ItofCorrelation(code, 20e6, AXIS, background_e=2.0),
            sensing.PixelElectronics(read_noise_e=0.5),
            sensing.TapDifference(),
        ],
        grad=grad,
    )


def streak(grad="expected"):
    return sensing.StreakCamera(
        AXIS, time_fwhm_s=900e-12, jitter_fwhm_s=700e-12, spatial_fwhm_px=0.5, read_noise_e=0.3, grad=grad
    )


def stokes_like(shape, seed):
    """Physical Stokes vectors (..., 4, C, T, H, W), polarized by up to a half."""
    g = torch.Generator().manual_seed(seed)
    x = torch.rand(shape, generator=g, dtype=torch.float64) - 0.5
    x.select(-5, 0).add_(1.5)
    return x


ENTRIES: list[Entry] = [
    Entry("ItofCorrelation", itof_correlation, conserves=lambda y: y.sum() / (2 if y.shape[-3] == 8 else 1)),
    Entry("ItofCorrelation-two-tap", two_tap_camera, conserves=lambda y: y.sum() / (2 if y.shape[-3] == 8 else 1)),
    Entry(
        "ItofCorrelation-map",
        lambda: sensing.ItofCorrelation(
            sensing.sine_code(3), (20e6, 60e6), AXIS, calibration=sensing.ItofCalibration(depth_map_m=MAP_M)
        ),
        conserves=lambda y: y.sum() / (2 if y.shape[-3] == 6 else 1),
    ),
    Entry(
        "ItofCorrelation-learnt",
        lambda: sensing.ItofCorrelation(
            sensing.TwoTapCode(sensing.sine_code(2)),
            (20e6, 60e6),
            AXIS,
            calibration=sensing.ItofCalibration(
                phase_offset_rad=torch.nn.Parameter(torch.tensor([0.1, 0.2])),
                depth_map_m=torch.nn.Parameter(MAP_M.clone()),
            ),
        ),
        conserves=lambda y: y.sum() / (2 if y.shape[-3] == 8 else 1),
    ),
    Entry("TapDifference", sensing.TapDifference),
    Entry("PixelElectronics", pixel_electronics, random=True),
    Entry("Compose", chain, random=True),
    Entry("Compose-differences", differences, random=True),
    Entry("StreakCamera", streak, random=True),
    Entry(
        "SweepJitter",
        lambda grad="expected": sensing.SweepJitter(700e-12, AXIS, grad=grad),
        random=True,
        # Every policy but `expected` is pathwise: the draw is linear in the input, and no score is left to collect.
        policies=("expected", "gaussian", "straight_through"),
    ),
    Entry(
        "GatedIntegration",
        lambda: sensing.GatedIntegration([4e-9, 6e-9], 3e-9, AXIS, rise_s=0.8e-9, leakage=0.01, learnable=True),
    ),
    Entry(
        "PolarizationMosaic",
        lambda: sensing.PolarizationMosaic.polarsens(200.0),
        shape=(2, 4, 1, 3, 4, 5),
        input=stokes_like,
    ),
    Entry(
        "Analyzers",
        lambda: sensing.Analyzers(sensing.linear_analyzers([0, 60, 120], 50.0)),
        shape=(2, 4, 1, 3, 2, 2),
        input=stokes_like,
        # Half of the light passes an analyser: two thirds of three pictures of it are S0.
        conserves=lambda y: y.select(-5, 0).sum() if y.shape[-5] == 4 else y.sum() * 2 / 3 / (1 + 1 / 50.0),
    ),
]
