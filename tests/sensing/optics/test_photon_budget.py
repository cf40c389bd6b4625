"""The photon budget against hand-made arithmetic, and the reports."""

from __future__ import annotations

import math

import pytest
import torch

from torchtransient import TimeAxis
from torchtransient.errors import ArgumentError, UnitError
from torchtransient.sensing import Optics, PhotonBudget, photon_energy_j

AXIS = TimeAxis.from_seconds(0.0, 16e-12, 100)


def budget(**changes):
    arguments = {
        "pulse_energy_j": 1e-9,
        "wavelength_m": 532e-9,
        "repetition_rate_hz": 10e6,
        "cycles": 100_000,
        "quantum_efficiency": 0.4,
        "ambient_rate_hz": 1e6,
        "dark_count_rate_hz": 100.0,
        "axis": AXIS,
    }
    return PhotonBudget(Optics(f_number=2.0, pixel_area_m2=1e-10, transmission=0.8), **(arguments | changes))


def test_photon_energies():
    assert photon_energy_j(532e-9) == pytest.approx(3.73e-19, rel=2e-3)
    assert photon_energy_j(905e-9) == pytest.approx(2.19e-19, rel=3e-3)


def test_by_hand():
    x = torch.full((1, 100, 2, 3), 0.25, dtype=torch.float64)
    per_unit = 1e-9 / 3.7339e-19 * (math.pi / 17 * 1e-10 * 0.8) * 0.4
    background = (1e6 * 0.4 + 100) * 16e-12
    torch.testing.assert_close(budget()(x), 0.25 * per_unit + background + 0 * x, rtol=1e-4, atol=0)
    report = budget().report(x)
    assert report.signal_per_cycle.shape == (1, 2, 3)
    assert float(report.signal_per_cycle[0, 0, 0]) == pytest.approx(25 * per_unit, rel=1e-4)
    assert report.ambient_per_cycle == pytest.approx(0.4 * 1.6e-3)
    assert report.dark_per_cycle == pytest.approx(1.6e-7)
    assert report.exposure_s == pytest.approx(0.01)
    total = report.signal_per_cycle + report.background_per_cycle
    torch.testing.assert_close(budget()(x).sum(-3), total, rtol=1e-9, atol=0)
    torch.testing.assert_close(
        report.signal_to_background, report.signal_per_cycle / (0.4 * 1.6e-3 + 1.6e-7), rtol=1e-12, atol=0
    )
    assert bool(report.piles_up.all()) == (25 * per_unit > 0.05)


def test_a_lens_gathers_as_its_cone_does():
    """On the pixel: the integral of cos over a cone of half angle atan(1 / 2F)."""
    optics = Optics.from_aperture(0.05, 0.0125, pixel_area_m2=1e-10)
    assert optics.f_number == pytest.approx(4)
    theta = torch.linspace(0, math.atan(1 / 8), 20001, dtype=torch.float64)
    cone = torch.trapezoid(2 * math.pi * theta.sin() * theta.cos(), theta)
    assert optics.etendue_m2_sr == pytest.approx(float(cone) * 1e-10, rel=1e-6)


def test_hot_pixels_and_exposure():
    dark = torch.tensor([[10.0, 1e6]], dtype=torch.float64)
    model = budget(dark_count_rate_hz=dark, ambient_rate_hz=0.0, cycles=None, exposure_s=0.5)
    assert model.cycles == 5_000_000
    y = model(torch.zeros(1, 100, 1, 2, dtype=torch.float64))
    torch.testing.assert_close(y.sum(-3), dark.unsqueeze(0) * 1.6e-9)


@pytest.mark.parametrize(
    "changes, match",
    [
        ({"wavelength_m": 532.0}, "metres"),
        ({"quantum_efficiency": 40.0}, "quantum_efficiency"),
        ({"cycles": 1.5}, "whole"),
        ({"dark_count_rate_hz": -1.0}, "dark_count_rate_hz"),
        ({"axis": None, "bin_width_s": 16.0}, "Picoseconds"),
    ],
)
def test_units(changes, match):
    with pytest.raises(UnitError, match=match):
        budget(**changes)


def test_cycles_or_exposure():
    with pytest.raises(ArgumentError, match="either cycles"):
        budget(cycles=None)


def test_window_longer_than_a_period():
    with pytest.raises(UnitError, match="laser period"):
        budget(repetition_rate_hz=1e9)(torch.zeros(1, 100, 1, 1))
    with pytest.raises(ArgumentError, match="either f_number"):
        Optics()
