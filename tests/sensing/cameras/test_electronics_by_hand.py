"""Pixels without noise, and budgets: numbers that can be worked out on paper, at the limits of what is taken."""

from __future__ import annotations

import math

import pytest
import torch

from torchtransient import TimeAxis, sensing
from torchtransient.errors import UnitError
from torchtransient.sensing.electronics import clipped_normal_mean, clipped_normal_variance, ktc_noise
from torchtransient.units import SPEED_OF_LIGHT

PLANCK_J_S = 6.62607015e-34


def light(*values):
    return torch.tensor(values, dtype=torch.float64).reshape(1, -1, 1, 1)


def flat(x):
    return x.flatten().tolist()


# ------------------------------------------------------------------------------------------------------ electronics


def test_the_order_of_a_pixel():
    """Gain, dark electrons, full well, offset, black level, rounding, range: one after the other."""
    gain = torch.tensor([[[2.0]], [[0.5]], [[1.0]], [[1.0]]], dtype=torch.float64)
    offset = torch.tensor([[[3.0]], [[-4.0]], [[7.0]], [[0.0]]], dtype=torch.float64)
    pixel = sensing.PixelElectronics(shot_noise=False, dark_e=5.0, full_well_e=60.0, gain_e_per_dn=4.0, bits=4,
                                     black_level_dn=2.0, gain_map=gain, offset_map_e=offset)  # fmt: skip
    x = light(10.0, 8.0, 90.0, 20.0)
    # 25 + 3 = 28; 9 - 4 = 5; 60 + 7 = 67, of at most 13 steps; 25
    assert flat(pixel.collected(x)) == [25.0, 9.0, 95.0, 25.0]
    assert flat(pixel.sample(x)) == [28.0, 4.0, 52.0, 24.0]
    assert pixel.range_dn == (0.0, 15.0) and pixel.range_e == (-8.0, 52.0)
    signed = sensing.PixelElectronics(shot_noise=False, gain_e_per_dn=4.0, bits=4, signed=True, black_level_dn=2.0)
    assert signed.range_dn == (-8.0, 7.0) and signed.range_e == (-40.0, 20.0)
    bare = sensing.PixelElectronics(full_well_e=60.0)
    assert bare.range_e == (-math.inf, 60.0) and sensing.PixelElectronics().range_e == (-math.inf, math.inf)
    for black in (-0.01, 15.01):
        with pytest.raises(UnitError, match="black_level_dn"):
            sensing.PixelElectronics(gain_e_per_dn=4.0, bits=4, black_level_dn=black)
    sensing.PixelElectronics(gain_e_per_dn=4.0, bits=4, black_level_dn=15.0)


def test_variances_by_hand():
    x = light(50.0, 20.0)
    given = {"read_noise_e": 3.0, "ktc_noise_e": 4.0, "dark_e": 6.0}
    assert flat(sensing.PixelElectronics(**given).variance(x)) == [56 + 25, 26 + 25]
    assert flat(sensing.PixelElectronics(**given, excess_noise=1.5).variance(x)) == [1.5 * 56 + 25, 1.5 * 26 + 25]
    drawn = sensing.PixelElectronics(**given, excess_noise=1.5, shot_noise=False)
    assert flat(drawn.variance(x)) == [0.5 * 56 + 25, 0.5 * 26 + 25]
    rounded = sensing.PixelElectronics(gain_e_per_dn=6.0, bits=8)
    assert flat(rounded.variance(x)) == [50 + 3.0, 20 + 3.0]
    assert flat(sensing.PixelElectronics(**given).expected(x)) == [56.0, 26.0]


@pytest.mark.parametrize("policy", ["gaussian", "score"])
def test_gradients_through_a_converter(policy):
    """One where the code is inside of the range, zero beyond it, whatever the rounding."""
    pixel = sensing.PixelElectronics(shot_noise=False, gain_e_per_dn=4.0, bits=4, grad=policy)
    x = light(-9.0, 13.0, 30.5, 90.0).requires_grad_()
    y = pixel(x, generator=torch.Generator().manual_seed(0))
    assert flat(y) == [0.0, 12.0, 32.0, 60.0]
    assert flat(torch.autograd.grad(y.sum(), x)[0]) == [0.0, 1.0, 1.0, 0.0]


def test_normal_numbers_that_are_clipped():
    """Far inside nothing happens, far beyond the limit is all; without limits there is none."""
    mean, variance = torch.tensor([2.0, 500.0, -500.0]).double(), torch.tensor([4.0, 4.0, 4.0]).double()
    assert clipped_normal_mean(mean, variance) is mean
    assert clipped_normal_variance(mean, variance, math.inf) is variance
    assert flat(clipped_normal_mean(mean, variance, -90.0, 80.0)) == pytest.approx([2.0, 80.0, -90.0])
    assert flat(clipped_normal_mean(mean, variance, high=80.0)) == pytest.approx([2.0, 80.0, -500.0])
    assert flat(clipped_normal_mean(mean, variance, low=-90.0)) == pytest.approx([2.0, 500.0, -90.0])
    assert flat(clipped_normal_variance(mean, variance, 80.0)) == pytest.approx([4.0, 0.0, 4.0])
    # half of a normal number: variance 1/2 - 1/(2 pi) of a clip at the mean, mean lower by 1/sqrt(2 pi)
    at = torch.tensor(80.0).double()
    wide = torch.tensor(1e6).double()
    assert float(clipped_normal_mean(at, wide, high=80.0)) == pytest.approx(80 - 1e3 / math.sqrt(2 * math.pi))
    assert float(clipped_normal_variance(at, wide, 80.0)) == pytest.approx(1e6 * (0.5 - 0.5 / math.pi))
    assert float(clipped_normal_variance(at, -wide, 80.0)) == 0.0


def test_no_variance_is_below_zero():
    """A charge below zero has no noise of its own, and that of normal numbers without variance is none."""
    at = torch.tensor([70.0, 90.0]).double()
    assert flat(clipped_normal_mean(at, torch.full_like(at, -9.0), high=80.0)) == pytest.approx([70.0, 80.0], abs=1e-9)
    x = light(-20.0, 10.0)
    drawn = sensing.PixelElectronics(shot_noise=False, excess_noise=1.5, read_noise_e=2.0)
    assert flat(drawn.variance(x)) == [4.0, 0.5 * 10 + 4.0]
    spread = drawn.sample(light(-20.0).expand(1, 1, 1, 40_000), torch.Generator().manual_seed(0)).var()
    assert float(spread) == pytest.approx(4.0, rel=0.05)


def test_a_full_well_far_away_takes_nothing():
    """However far: squares of standard deviations are not subtracted from one another."""
    mean, variance = torch.tensor(5.0).double(), torch.tensor(4.0).double()
    for high in (1e3, 1e6, 1e12):
        assert float(clipped_normal_variance(mean, variance, high)) == pytest.approx(4.0, rel=1e-12)
        assert float(clipped_normal_variance(mean.float(), variance.float(), high)) == pytest.approx(4.0, rel=1e-4)
        assert 0 <= float(clipped_normal_variance(mean + 2 * high, variance, high)) < 1e-30


def test_reset_noise():
    """sqrt(k T C) / q, of up to a nanofarad."""
    assert ktc_noise(4e-15, 250.0) == pytest.approx(math.sqrt(1.380649e-23 * 250 * 4e-15) / 1.602176634e-19)
    assert ktc_noise(1e-9) > 0
    for wrong in ((1.1e-9,), (-1e-15,), (1e-15, -1.0)):
        with pytest.raises(UnitError, match="ktc_noise"):
            ktc_noise(*wrong)


# ---------------------------------------------------------------------------------------------------------- budgets

AXIS = TimeAxis.from_seconds(0.0, 1e-9, 10)


def budget(optics=None, **changes):
    given = {"pulse_energy_j": 2e-9, "wavelength_m": 600e-9, "repetition_rate_hz": 20e6, "cycles": 3000, "axis": AXIS}
    return sensing.PhotonBudget(optics or sensing.Optics(f_number=1.5), **(given | changes))


def test_optics_by_hand():
    """pi A t / (4 F^2 + 1), or the solid angle itself."""
    lens = sensing.Optics(f_number=1.5, pixel_area_m2=3e-10, transmission=0.7)
    assert lens.etendue_m2_sr == pytest.approx(math.pi / 10 * 3e-10 * 0.7)
    cone = sensing.Optics(solid_angle_sr=0.4, pixel_area_m2=3e-10, transmission=0.7)
    assert cone.etendue_m2_sr == pytest.approx(0.4 * 3e-10 * 0.7)
    assert sensing.Optics.from_aperture(0.06, 0.04, pixel_area_m2=3e-10, transmission=0.7) == lens
    assert sensing.photon_energy_j(600e-9) == pytest.approx(PLANCK_J_S * SPEED_OF_LIGHT / 600e-9)
    for focal, diameter in ((1e-3, 1.01e-2), (1.0, 0.99e-3)):
        with pytest.raises(UnitError, match="in one unit, metres"):
            sensing.Optics.from_aperture(focal, diameter, pixel_area_m2=1e-10)
    for wrong in ({"f_number": 0.09}, {"f_number": 1001.0}, {"f_number": 2.0, "pixel_area_m2": 1.1e-4},
                  {"f_number": 2.0, "pixel_area_m2": 0.0}, {"f_number": 2.0, "transmission": 1.01}):  # fmt: skip
        with pytest.raises(UnitError, match="Optics: expected"):
            sensing.Optics(**wrong)
    sensing.Optics(f_number=0.1, pixel_area_m2=1e-4, transmission=1.0), sensing.Optics(f_number=1e3)


def test_the_sun_on_a_pixel():
    """irradiance bandwidth / pi etendue / energy albedo illumination."""
    optics = sensing.Optics(f_number=1.5, pixel_area_m2=3e-10)
    given = {"spectral_irradiance_w_m2_nm": 1.5, "filter_bandwidth_m": 20e-9, "wavelength_m": 600e-9}
    rate = sensing.ambient_photon_rate(optics, 0.3, illumination=0.6, **given)
    energy = PLANCK_J_S * SPEED_OF_LIGHT / 600e-9
    assert rate == pytest.approx(1.5 * 20 / math.pi * (math.pi / 10 * 3e-10) / energy * 0.3 * 0.6)
    assert sensing.ambient_photon_rate(optics, 0.3, **given) == pytest.approx(rate / 0.6)
    edge = {**given, "spectral_irradiance_w_m2_nm": 20.0, "filter_bandwidth_m": 1e-6}
    assert sensing.ambient_photon_rate(optics, 1.0, **edge) > 0
    for name, value in (("spectral_irradiance_w_m2_nm", 20.1), ("filter_bandwidth_m", 1.01e-6)):
        with pytest.raises(UnitError, match=f"ambient_photon_rate: expected {name}"):
            sensing.ambient_photon_rate(optics, 0.3, **{**given, name: value})
    for name in ("albedo", "illumination"):
        with pytest.raises(UnitError, match=name):
            sensing.ambient_photon_rate(optics, **{"albedo": 0.3, **given, name: torch.full((2, 2), 1.01)})


def test_a_budget_of_maps():
    """Signal, background and what the report says of them, pixel by pixel."""
    efficiency = torch.tensor([[0.2, 0.5, 0.4]], dtype=torch.float64)
    ambient = torch.tensor([[3e6, 0.0, 1e6]], dtype=torch.float64)
    dark = torch.tensor([[100.0, 0.0, 700.0]], dtype=torch.float64)
    model = budget(quantum_efficiency=efficiency, ambient_rate_hz=ambient, dark_count_rate_hz=dark)
    per_unit = 2e-9 * model.optics.etendue_m2_sr / model.photon_energy_j * efficiency
    torch.testing.assert_close(model.detections_per_unit, per_unit)
    x = torch.arange(30, dtype=torch.float64).reshape(1, 10, 1, 3)
    background = (ambient * efficiency + dark) * 1e-9
    torch.testing.assert_close(model.signal(x), x * per_unit)
    torch.testing.assert_close(model(x), x * per_unit + background)
    torch.testing.assert_close(model.background_counts, background * 3000)
    report = model.report(x)
    torch.testing.assert_close(report.signal_per_cycle, (x * per_unit).sum(1))
    torch.testing.assert_close(report.ambient_per_cycle.reshape(1, 3), ambient * efficiency * 1e-8)
    torch.testing.assert_close(report.dark_per_cycle.reshape(1, 3), dark * 1e-8)
    torch.testing.assert_close(report.background_per_cycle.reshape(1, 3), background * 10)
    ratio = report.signal_to_background
    assert float(ratio[0, 0, 1]) == math.inf
    torch.testing.assert_close(ratio[0, 0, ::2], (report.signal_per_cycle[0] / (background * 10))[0, ::2])
    assert (report.cycles, report.exposure_s) == (3000, 1.5e-4)
    plain = budget(ambient_rate_hz=3e6, quantum_efficiency=0.2, dark_count_rate_hz=100.0)
    assert plain.background_counts == pytest.approx((0.6e6 + 100) * 1e-9 * 3000)
    assert isinstance(plain.background_counts, float)


def test_pile_up_is_said_above_five_percent():
    model = budget(dark_count_rate_hz=1e6)
    per_unit = float(model.detections_per_unit)
    x = torch.zeros(1, 10, 1, 2, dtype=torch.float64)
    x[:, 3] = torch.tensor([0.039, 0.041], dtype=torch.float64) / per_unit
    assert flat(model.report(x).piles_up) == [False, True]


def test_limits_of_a_budget():
    """An hour, a kilowatt, one cycle, one period: that much is taken and hardly more."""
    assert budget(exposure_s=3600.0, cycles=None).exposure_s == 3600.0
    assert budget(exposure_s=0.9999995 / 20e6, cycles=None).cycles == 1
    assert budget(exposure_s=7.6 / 20e6, cycles=None).cycles == 8
    budget(pulse_energy_j=50e-6)
    for changes, words in (
        ({"exposure_s": 3600.1, "cycles": None}, "an exposure of at most 3600 s"),
        ({"exposure_s": 0.99 / 20e6, "cycles": None}, "at least one laser period"),
        ({"pulse_energy_j": 50.1e-6}, "at most 1000 W on average, got .* 1002 W"),
        ({"pulse_energy_j": 1001.0}, "pulse_energy_j"),
        ({"quantum_efficiency": 1.01}, "quantum_efficiency"),
        ({"cycles": 0}, "cycles"),
    ):
        with pytest.raises(UnitError, match=words):
            budget(**changes)
    x = torch.ones(1, 10, 1, 1)
    budget(repetition_rate_hz=1e8 * (1 + 9e-7))(x)
    with pytest.raises(UnitError, match="window to fit into a laser period of 9"):
        budget(repetition_rate_hz=1e8 * (1 + 2e-6))(x)
