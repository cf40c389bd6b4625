"""Seconds, metres of optical path, metres of distance, and bins: the same scene in all of them, and mix-ups refused."""

import pytest
import torch

from torchtransient import sensing
from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.errors import UnitError
from torchtransient.units import SPEED_OF_LIGHT, opl_to_seconds, seconds_to_opl

DISTANCE_M = 3.0007  # there and back: 6.0014 m of optical path, 20.018 ns
AXIS = TimeAxis(start_opl=1.5, bin_width_opl=0.006, num_bins=1500)
SAME = TimeAxis.from_seconds(opl_to_seconds(1.5), opl_to_seconds(0.006), 1500)


def wall(axis=AXIS, electrons=1e5):
    """(1, T, 1, 1): light that travelled to a wall and back, in the bin of its arrival."""
    x = torch.zeros(1, axis.num_bins, 1, 1, dtype=torch.float64)
    x[0, int(axis.bin_index(2 * DISTANCE_M))] = electrons
    return x


def test_every_sensor_finds_the_same_wall():
    """Half a bin of optical path is 1.5 mm of distance."""
    x, half_bin = wall(), AXIS.bin_width_opl / 4
    position = sensing.peak_position(x)
    assert abs(float(sensing.distance_of_position(position, AXIS)) - DISTANCE_M) <= half_bin
    taps = sensing.ItofCorrelation(sensing.sine_code(4), (20e6, 50e6), AXIS)(x)
    assert abs(float(sensing.read_itof(taps, (20e6, 50e6), 4).depth_m) - DISTANCE_M) <= half_bin
    phasor_axis = FrequencyAxis.from_hertz([20e6])
    turns = phasor_axis.per_metre * 2 * DISTANCE_M
    phasor = torch.exp(-2j * torch.pi * turns).reshape(1, 1, 1, 1)
    steady = torch.ones(1, 1, 1, dtype=torch.float64)
    taps = sensing.taps_from_phasor(phasor, phasor_axis, sensing.sine_code(4), frequencies_hz=20e6, steady=steady)
    assert abs(float(sensing.read_itof(taps, 20e6, 4).depth_m) - DISTANCE_M) < 1e-9
    arrival_s = opl_to_seconds(2 * DISTANCE_M)
    gates = sensing.GatedIntegration([arrival_s - 0.1e-9, arrival_s + 0.1e-9], 0.2e-9, AXIS, rise_s=1e-12)(x)
    assert float(gates[0, 0]) > 0.99e5 and float(gates[0, 1]) < 1.0


def test_axes_in_seconds_and_in_metres_are_the_same_axis():
    x = torch.rand(1, 1500, 1, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    for make in (
        lambda a: sensing.ItofCorrelation(sensing.square_code(3), 80e6, a),
        lambda a: sensing.GatedIntegration([12e-9], 3e-9, a),
        lambda a: sensing.ImpulseResponse(sensing.GaussianResponse(100e-12), a),
        lambda a: sensing.SweepJitter(50e-12, a),
    ):
        torch.testing.assert_close(make(AXIS)(x), make(SAME)(x), rtol=1e-9, atol=1e-9)
    by_width = sensing.ImpulseResponse(sensing.GaussianResponse(100e-12), bin_width_s=AXIS.bin_width_s)
    assert torch.equal(by_width(x), sensing.ImpulseResponse(sensing.GaussianResponse(100e-12), AXIS)(x))


def test_one_speed_of_light():
    """With 3e8 m/s the last of 1500 bins would be one bin off."""
    last_s = 1500 * AXIS.bin_width_s
    assert abs(seconds_to_opl(last_s) - 1500 * AXIS.bin_width_opl) < 1e-12
    assert abs(3e8 * last_s - 1500 * AXIS.bin_width_opl) > AXIS.bin_width_opl
    assert sensing.unambiguous_range_m(20e6) == SPEED_OF_LIGHT / 40e6
    one_turn = sensing.depth_of_phase(torch.tensor(2 * torch.pi, dtype=torch.float64), 20e6)
    assert abs(float(one_turn) - SPEED_OF_LIGHT / 40e6) < 1e-12


@pytest.mark.parametrize(
    "call",
    [
        lambda: sensing.GaussianResponse(60.0),  # picoseconds
        lambda: sensing.ItofCorrelation(sensing.sine_code(4), 80.0, AXIS),  # megahertz
        lambda: sensing.GatedIntegration([20.0], 1e-9, AXIS),  # nanoseconds
        lambda: sensing.StreakCamera(AXIS, jitter_fwhm_s=0.5).expected(wall()),
        lambda: sensing.SynchronousSPAD(100, dead_time_s=75.0, bin_width_s=1e-10),
        lambda: sensing.photon_energy_j(532.0),  # nanometres
        lambda: sensing.ktc_noise(10.0),  # femtofarads
        lambda: sensing.linear_analyzers([0.0], extinction_ratio=1 / 300),  # its inverse
        lambda: sensing.range_deviation_m(500.0, torch.ones(1)),
        lambda: sensing.center_of_mass(wall(), half_width_bins=0.5e-9),  # seconds, where bins are meant
        lambda: sensing.multi_return(wall(), 2, threshold=1.0, min_separation_bins=0.2),
    ],
)
def test_mixed_up_units_are_refused(call):
    with pytest.raises(UnitError, match="expected"):
        call()


def test_lengths_in_float32_stay_in_their_bin():
    """A kilometre away, positions are counted from the start of the axis and lose nothing."""
    axis = TimeAxis(2000.0, 0.006, 1500)
    position = torch.tensor([700.25], dtype=torch.float64)
    exact = sensing.distance_of_position(position, axis)
    single = sensing.distance_of_position(position.float(), axis)
    assert abs(float(exact) - (2000.0 + 700.25 * 0.006) / 2) < 1e-9
    assert abs(float(single) - float(exact)) < 6.2e-5  # what float32 holds of a kilometre, no more is lost
    x = torch.zeros(1, 1500, 1, 1)
    x[0, 700] = 1.0
    taps = sensing.ItofCorrelation(sensing.sine_code(4), 100e6, axis)(x)
    phase = float(sensing.phase_of(sensing.tap_phasor(taps, 4)))
    wanted = 2 * torch.pi * ((2000.0 + 700.5 * 0.006) * 100e6 / SPEED_OF_LIGHT % 1.0)
    assert abs(phase - wanted) < 2e-6  # the weights are made in float64
