"""Arguments that would give plausible, wrong numbers: shapes, units, axes, NaN; and what a subclass lacks."""

from __future__ import annotations

import math

import pytest
import torch

from support.sweeps import together
from torchtransient import Chirps, FrequencyAxis, Pulse, TimeAxis, sensing
from torchtransient.errors import ArgumentError, GradientError, ShapeError, TorchTransientError, UnitError

PS, F = 1e-12, 20e6
AXIS = TimeAxis.from_seconds(0.0, 100 * PS, 6)
WIDTH = {"bin_width_s": 100 * PS}
LIGHT = torch.full((1, 6, 2, 3), 0.2)
STOKES = torch.ones(4, 1, 1, 2, 2)
FRAMES = torch.ones(1, 4, 2, 3)
PULSE = sensing.GaussianResponse(300 * PS)
SINE, SQUARE = sensing.sine_code(4), sensing.square_code(4)
LENS = sensing.Optics(f_number=2.0)
ROWS = sensing.linear_analyzers([0.0, 45.0])
SUN = {"spectral_irradiance_w_m2_nm": 0.9, "filter_bandwidth_m": 1e-8, "wavelength_m": 9e-7}
CHIRPS = Chirps(1e9, 1e-5, 1550e-9)
BOUND = {"distance_m": 0.05, "signal": 3.0}
MAPS = [torch.full((1, 2, 3), v, dtype=torch.float64) for v in (0.05, 3.0)]
PHASOR = torch.ones(1, 1, 2, 3, dtype=torch.complex64)


def budget(**given):
    light = {"pulse_energy_j": 1e-9, "wavelength_m": 905e-9, "repetition_rate_hz": 10e6, "cycles": 1000, "axis": AXIS}
    return sensing.PhotonBudget(LENS, **{**light, **given})


def ran_away(value):
    response = sensing.GaussianResponse(60 * PS, learnable=True)
    torch.nn.init.constant_(response.log_fwhm_s, value)
    return sensing.ImpulseResponse(response, **WIDTH)(LIGHT)


def mean(distance, signal):
    return sensing.return_rates(PULSE, AXIS, distance_m=distance, signal=signal).movedim(-1, -3)


SPAD = sensing.SynchronousSPAD(5)
FREE = sensing.FreeRunningSPAD(9, 200 * PS, **WIDTH)
COUNTED = torch.tensor([5.0, 3.0, 1.0])


def after(probability=0.05, tau_s=1e-9, dead_time_s=1e-10, **given):
    return sensing.Afterpulsing(probability, tau_s, dead_time_s, **{**WIDTH, **given})


def coincidence(detector=SPAD, spads=2, window_s=1e-10, k=2):
    return sensing.CoincidencePixel(detector, spads, coincidence=k, window_s=window_s, **WIDTH)


def other_state(camera, **changed):
    return camera.load_state_dict({**camera.state_dict(), **changed})


def calibrated(**numbers):
    return sensing.ItofCorrelation(SINE, F, AXIS, calibration=sensing.ItofCalibration(**numbers))


SHAPES = [
    lambda: sensing.covariance_bound(lambda *p: mean(*p)[0], MAPS),
    lambda: sensing.first_return(LIGHT, torch.ones(6)),
    lambda: sensing.center_of_mass(LIGHT, background=torch.ones(1, 1, 2, 3)),
    lambda: sensing.ml_position(LIGHT, PULSE, TimeAxis.from_seconds(0.0, 100 * PS, 5)),
    lambda: sensing.peak_position(LIGHT[:, :0]),
    lambda: sensing.distance_to_points(torch.ones(4, 5), torch.ones(2, 3, 3)),
    lambda: sensing.distance_to_points(torch.ones(2, 4, 5), torch.ones(3, 4)),
    lambda: sensing.distance_to_points(torch.ones(5), torch.eye(3)),
    lambda: sensing.measured_code(torch.ones(10)),
    lambda: sensing.PiecewiseLinearCode(torch.ones(2, 3), torch.ones(2, 4)),
    lambda: sensing.correlate(LIGHT, torch.ones(4, 5)),
    lambda: sensing.tap_phasor(FRAMES, 3),
    lambda: sensing.decode_code(FRAMES[:, :2], sensing.sine_code(2)),
    lambda: sensing.read_itof(torch.ones(1, 8, 2, 3), F, 4),
    lambda: sensing.read_itof(FRAMES, F, 4, code=sensing.sine_code(3)),
    lambda: sensing.read_itof(FRAMES, F, 4, calibration=sensing.ItofCalibration(depth_map_m=torch.zeros(3, 2))),
    lambda: sensing.unwrap_depth(torch.ones(1, 3, 1, 1), (F, 50e6)),
    lambda: calibrated(phase_map_rad=torch.ones(3)),
    lambda: calibrated(phase_offset_rad=[0.1, 0.2]),
    lambda: calibrated(phase_map_rad=torch.zeros(2, 2, 3)),
    lambda: calibrated(phase_map_rad=torch.zeros(3, 2)).expected(LIGHT),
    lambda: calibrated(phase_map_rad=torch.zeros(2, 1), depth_map_m=torch.zeros(2, 3)),
    lambda: sensing.taps_from_phasor(LIGHT, FrequencyAxis((0.0,)), SINE, frequencies_hz=F),
    lambda: sensing.analyze(torch.ones(3, 1, 1, 2, 2), ROWS),
    lambda: sensing.analyze(STOKES, ROWS[None]),
    lambda: sensing.PolarizationMosaic(torch.ones(2, 4)),
    lambda: sensing.demosaic(torch.ones(1, 1, 1, 5)),
    lambda: sensing.project_physical(torch.ones(3, 1, 1, 2, 2)),
    lambda: sensing.blur_image(LIGHT, torch.ones(3, 4)),
    lambda: sensing.gate_profiles(torch.ones(2, 2), torch.ones(2), AXIS, rise_s=1e-10, fall_s=1e-10),
    lambda: sensing.PixelElectronics(gain_map=torch.ones(3, 2))(LIGHT),
    lambda: sensing.apply_pulse(LIGHT[:, :5], AXIS, Pulse.gaussian(0.1)),
    lambda: sensing.apply_pulse(LIGHT, AXIS, Pulse.gaussian(0.1), keep=TimeAxis(0.01, AXIS.bin_width_opl, 3)),
    lambda: sensing.SynchronousSPAD(10, gate=torch.ones(2, 6)),
    lambda: sensing.SynchronousSPAD(10, gate=torch.ones(5))(LIGHT),
    lambda: sensing.TDC(torch.ones(5))(LIGHT),
    lambda: sensing.TailedResponse(PS, [PS, 2 * PS], [0.1]),
    lambda: sensing.convolve_time(LIGHT, torch.ones(2, 2)),
    lambda: sensing.PixelGroups.by_value(torch.ones(3), lambda value: sensing.SynchronousSPAD(7)),
    lambda: sensing.ShotNoise()(LIGHT[0]),
    lambda: after(period_s=2e-9, background=torch.ones(2, 2))(LIGHT),
    lambda: sensing.MeasuredDelays(torch.ones(2, 2), 1e-9),
    lambda: after([0.1, 0.1], [1e-9]),
    lambda: sensing.TapDifference()(LIGHT[:, :5]),
    lambda: sensing.GatedIntegration([], 1e-9, AXIS),
    lambda: budget(quantum_efficiency=torch.ones(2, 4))(LIGHT),
    lambda: budget(ambient_rate_hz=torch.ones(3)),
    lambda: sensing.PixelSkew(torch.ones(2, 2) * PS, **WIDTH)(LIGHT),
    lambda: sensing.MacroPixel(SPAD, 3, weights=[1.0]),
    lambda: sensing.PixelGroups([SPAD], torch.ones(2, 3)),
    lambda: sensing.PixelGroups([SPAD], torch.zeros(3, 3))(LIGHT),
    lambda: sensing.ZoneSum(2, 2)(LIGHT),
    lambda: sensing.fourier_codes(4, 9),
    lambda: sensing.range_and_speed(LIGHT[None, :1, :5], CHIRPS, AXIS),
    lambda: sensing.fold_beats(LIGHT, TimeAxis(-0.7, 1.0, 6)),
]  # fmt: skip
UNITS = [
    lambda: sensing.crlb(PULSE, AXIS, distance_m=-0.6, signal=3.0),
    lambda: sensing.crlb(PULSE, AXIS, distance_m=0.6, signal=math.nan),
    lambda: sensing.covariance_bound(lambda *p: -mean(*p), MAPS),
    lambda: sensing.covariance_bound(mean, MAPS, cycles=2),
    lambda: sensing.log_matched_filter(LIGHT, -torch.ones(3)),
    lambda: sensing.FourierCode(4, {1: (0.8, 0), 3: (0.3, 0)}),
    lambda: sensing.square_code(4, light_duty=1.2),
    lambda: sensing.binary_code(0.1, [[(0, 0.5), (0.4, 0.6)]] * 3),
    lambda: sensing.binary_code(0.1, [[(0.4, 0.2)]] * 2),
    lambda: sensing.PiecewiseLinearCode(torch.tensor([[0.5, 0.2]] * 2), torch.zeros(2, 2)),
    lambda: sensing.PiecewiseLinearCode(torch.tensor([[0.1, 0.2]] * 2), torch.full((2, 2), 1.1)),
    lambda: SINE.bin_means(torch.tensor([1.0, 0.0])),
    lambda: sensing.measured_code(torch.zeros(3, 10)),
    lambda: sensing.ReversedCode(sensing.hamiltonian_code(4)),
    lambda: sensing.tap_weights(SINE, 20.0, AXIS),
    lambda: sensing.taps_from_phasor(PHASOR, FrequencyAxis((0.0,)), SINE, frequencies_hz=F),
    lambda: sensing.taps_from_phasor(PHASOR, FrequencyAxis((0.0,)), SQUARE, frequencies_hz=F),
    lambda: sensing.offset_of(FRAMES, 4, "differential"),
    lambda: sensing.tap_phasor(FRAMES > 0, 4),
    lambda: sensing.depth_of_phase(PHASOR, F),
    lambda: other_state(calibrated(), weights=calibrated().weights + 1e-3),
    lambda: sensing.GatedIntegration([1e-10], 1e-10, AXIS, rise_s=6.1e-9),
    lambda: sensing.PhotonBudget(2.0, pulse_energy_j=1e-9, wavelength_m=9e-7, repetition_rate_hz=1e7, cycles=9),
    lambda: sensing.multi_return(LIGHT, 0, threshold=0.1),
    lambda: sensing.unwrap_depth(torch.ones(1, 2, 1, 1), (F, 50e6), max_depth_m=-1.0),
    lambda: sensing.unwrap_depth(torch.ones(1, 2, 1, 1), (F, 50e6), max_depth_m=7000.0),
    lambda: sensing.unambiguous_range_m((F, 50.5e3 + 0.5)),
    lambda: calibrated(phase_offset_rad=90.0),
    lambda: calibrated(depth_map_m=torch.full((2, 3), 12.0)),
    lambda: calibrated(phase_map_rad=torch.full((2, 3), math.nan)),
    lambda: sensing.linear_analyzers([0.0], 0.01),
    lambda: sensing.Optics(f_number=2.0, pixel_area_m2=100.0),
    lambda: sensing.Optics(solid_angle_sr=6.3),
    lambda: sensing.ambient_photon_rate(LENS, 0.5, **{**SUN, "spectral_irradiance_w_m2_nm": 1300.0}),
    lambda: budget(pulse_energy_j=0.2),
    lambda: budget(wavelength_m=0.94),
    lambda: budget(repetition_rate_hz=10.0, cycles=100_000),
    lambda: budget(cycles=None, exposure_s=1e-9),
    lambda: budget(repetition_rate_hz=2e9)(LIGHT),
    lambda: sensing.frames_to_rate(torch.tensor([4.0, 32.0]), 16),
    lambda: sensing.SpatialPSF(torch.tensor([[3.0, -1.0, 1.0]])),
    lambda: sensing.SweepJitter(1.5e-9, AXIS)(LIGHT),
    lambda: sensing.PixelElectronics(gain_e_per_dn=2.0),
    lambda: sensing.SynchronousSPAD(10, gate=torch.full((6,), 1.1)),
    lambda: sensing.SynchronousSPAD(10, dead_time_s=5 * PS, bin_width_s=20 * PS),
    lambda: sensing.FreeRunningSPAD(10, 50 * PS, **WIDTH),
    lambda: sensing.coates(LIGHT, 10, 0.7),
    lambda: sensing.paralyzable_histogram(LIGHT, -0.5),
    lambda: sensing.first_photon_log_prob(LIGHT + 9, LIGHT, 10),
    lambda: sensing.TDC(torch.full((6,), 100.0)),
    lambda: sensing.TailedResponse(PS, [PS, 2 * PS], [0.6, 0.5]),
    lambda: ran_away(math.nan),
    lambda: ran_away(-2.0),
    lambda: sensing.DetectionJitter(PULSE, AXIS, grad="straight_through")(LIGHT * math.nan),
    lambda: sensing.ShotNoise()(PHASOR),
    lambda: sensing.ShotNoise()(LIGHT.long()),
    lambda: after(5.0),
    lambda: after([0.3, 0.3], [1e-9, 1e-8]),
    lambda: after(background=-1.0),
    lambda: after(period_s=1e-10)(LIGHT),
    lambda: after(tau_s=None, dead_time_s=0.0, delays=sensing.PowerLawDelays(1.0, 1e-8)),
    lambda: after(tau_s=None, delays=sensing.PowerLawDelays(1.0, 1e-8), counted_from="avalanche"),
    lambda: after(tau_s=None, dead_time_s=9e-9, delays=sensing.MeasuredDelays(COUNTED, 1e-9)),
    lambda: sensing.MeasuredDelays(COUNTED, 1e-9, floor=5.0),
    lambda: sensing.AfterpulsingSPAD(FREE, after()),
    lambda: sensing.Crosstalk(0.5),
    lambda: sensing.Speckle(0.5),
    lambda: sensing.BeatNoise(0.0),
    lambda: sensing.Speckle().sample(-LIGHT),
    lambda: sensing.CoherentReceiver(CHIRPS, TimeAxis(1.0, 0.1, 12)),
    lambda: sensing.heterodyne_speed(LIGHT, LIGHT, F, duration_s=5e-3),
    lambda: sensing.MacroPixel(SPAD, 2, weights=[1.0, -1.0]),
    lambda: sensing.MacroPixel(SPAD, 2, weights=[0.0, 0.0]),
    lambda: coincidence(k=3),
    lambda: coincidence(FREE, window_s=3e-10),
    lambda: coincidence(window_s=7e-10).expected(LIGHT),
    lambda: sensing.PixelGroups([sensing.ShotNoise(), SPAD], torch.zeros(2, 3)),
    lambda: sensing.PixelGroups.by_value(torch.rand(20, 20), lambda d: SPAD),
    lambda: sensing.MeasuredResponse(torch.ones(4), PS),
    lambda: sensing.hot_pixel_rates(2, 2, median_hz=1.0, hot_fraction=2.0),
    lambda: sensing.equi_depth_edges(-LIGHT, 4),
]  # fmt: skip
OTHERS = [
    (lambda: sensing.ShotNoise(grad="sometimes"), ArgumentError),
    (lambda: sensing.ImpulseResponse(torch.ones(5), AXIS)(LIGHT), ArgumentError),
    (lambda: sensing.read_itof(FRAMES, F, 4, readout="double"), ArgumentError),
    (lambda: sensing.decode_code(FRAMES, sensing.TwoTapCode(sensing.sine_code(2))), ArgumentError),
    (lambda: sensing.TDC(torch.ones(4), acts_on="light"), ArgumentError),
    (lambda: sensing.DetectionJitter(PULSE, **WIDTH, boundary="open"), ArgumentError),
    (lambda: sensing.FreeRunningSPAD(500, 75 * PS), ArgumentError),
    (lambda: budget(cycles=None), ArgumentError),
    (lambda: sensing.Optics(), ArgumentError),
    (lambda: sensing.Moves(0, torch.ones(2, 6) / 2, "zero").log_prob(torch.ones(2, 1)), GradientError),
    (lambda: sensing.detections_with_dead_time(torch.full((1, 6, 1, 1), 1e12), 1.5), TorchTransientError),
]  # fmt: skip


@together("call, error", [*((call, ShapeError) for call in SHAPES), *((call, UnitError) for call in UNITS), *OTHERS])
def test_wrong_arguments(call, error):
    with pytest.raises(error, match=r"expected|overlap|needs"):
        call()


def test_limits_are_taken():
    assert sensing.Optics(solid_angle_sr=2 * math.pi).etendue_m2_sr > 0
    assert budget(exposure_s=3600.0, cycles=None).exposure_s == 3600.0
    assert not sensing.TailedResponse(PS, [PS, 2 * PS], [0.6, 0.4]).has_core
    assert torch.equal(sensing.paralyzable_histogram(LIGHT, 0.0), LIGHT)


def test_a_subclass_lacks_its_mean():
    with pytest.raises(NotImplementedError, match="has to define expected"):
        sensing.RandomSensor()(LIGHT)
    with pytest.raises(GradientError, match="grad='score' is not supported"):
        sensing.RandomSensor().log_prob(LIGHT, LIGHT)
