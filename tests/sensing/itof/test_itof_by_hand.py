"""Taps, phases and what is claimed of them, for numbers that can be worked out on paper."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from torchtransient import TimeAxis, sensing
from torchtransient.axes import FrequencyAxis
from torchtransient.errors import PhysicsWarning, ShapeError, UnitError
from torchtransient.sensing.itof import codes as itof_codes
from torchtransient.sensing.itof import depth as itof_depth
from torchtransient.sensing.itof import reading as itof_reading
from torchtransient.sensing.itof.correlation import rounding_of, taps_by_pixel
from torchtransient.units import SPEED_OF_LIGHT

TURN = 2 * math.pi
F = 30e6


def frames(*values):
    """(1, F N, 1, 1)."""
    return torch.tensor(values, dtype=torch.float64).reshape(1, -1, 1, 1)


def flat(x):
    return x.flatten().tolist()


# -------------------------------------------------------------------------------------------------------- readings


def test_contrast():
    """amplitude / offset of each pixel; zero without light, none of differences."""
    taps = torch.stack([frames(4, 3, 2, 3), frames(0, 0, 0, 0), frames(7, 7, 3, 3)]).squeeze(-1).movedim(0, -1)
    reading = sensing.read_itof(taps, F, 4)
    assert flat(reading.amplitude) == pytest.approx([1.0, 0.0, 2 * 2**0.5])
    assert flat(reading.offset) == [3.0, 0.0, 5.0]
    assert flat(reading.contrast) == pytest.approx([1 / 3, 0.0, 2 * 2**0.5 / 5])
    assert reading.contrast.shape == reading.amplitude.shape
    assert sensing.read_itof(taps, F, 4, readout="differential").contrast is None
    dark = taps.clone().requires_grad_()
    (slope,) = torch.autograd.grad(sensing.read_itof(dark, F, 4).contrast.sum(), dark)
    assert bool(slope.isfinite().all())


def test_phase_amplitude_and_deviation_of_four_taps():
    """X = (9, 6, 1, 4): z = (8 + 2 i) / 2; Var phi = sum g^2 X, g_n = 2 sin(theta_n - phi) / (4 a)."""
    x = frames(9, 6, 1, 4)
    phi, amplitude = math.atan2(2, 8), math.hypot(8, 2) / 2
    reading = sensing.read_itof(x, F, 4, noise=sensing.ItofNoise(read_noise_e=3.0))
    assert flat(reading.phase) == pytest.approx([phi]) and flat(reading.amplitude) == pytest.approx([amplitude])
    metres = SPEED_OF_LIGHT / (4 * math.pi * F)
    assert flat(reading.depth_m) == pytest.approx([metres * phi])
    slopes = [2 * math.sin(n * TURN / 4 - phi) / (4 * amplitude) for n in range(4)]

    def std(*variances):
        return metres * math.sqrt(sum(g**2 * v for g, v in zip(slopes, variances, strict=True)))

    assert flat(reading.depth_std_m) == pytest.approx([std(18, 15, 10, 13)])
    given = sensing.read_itof(x, F, 4, noise=sensing.ItofNoise(std_e=2.0))
    assert flat(given.depth_std_m) == pytest.approx([std(4, 4, 4, 4)])
    # 5 electrons a number: variances of (5 X + 9) / 25 numbers; of a converter, the deviation is the same
    gain = sensing.ItofNoise(read_noise_e=3.0, electrons_per_unit=5.0)
    wanted = std(*((5 * v + 9) / 25 for v in (9, 6, 1, 4)))
    for kind in (torch.float64, torch.int16):
        found = sensing.read_itof(x.to(kind), F, 4, noise=gain)
        assert flat(found.depth_std_m) == pytest.approx([wanted], rel=1e-6)
    offset = sensing.ItofNoise(read_noise_e=3.0, offset_e=20.0)
    found = sensing.read_itof(x, F, 4, readout="differential", noise=offset)
    assert flat(found.depth_std_m) == pytest.approx([std(38, 38, 38, 38)])
    two = sensing.read_itof(frames(9, 2, 6, 3, 1, 5, 4, 1), F, 4, readout="two_tap",
                            noise=sensing.ItofNoise(read_noise_e=3.0))  # fmt: skip
    z = complex(2 * (7 + 4) / 4, 2 * (3 - 3) / 4)
    slopes = [2 * math.sin(n * TURN / 4 - math.atan2(z.imag, z.real)) / (4 * abs(z)) for n in range(4)]
    assert flat(two.depth_std_m) == pytest.approx([std(11 + 18, 9 + 18, 6 + 18, 5 + 18)])
    assert flat(two.offset) == [31 / 4]


def test_numbers_below_zero_have_read_noise_alone():
    """Taps and sums of taps that noise has put below zero: no shot noise, and none taken off."""
    metres = SPEED_OF_LIGHT / (4 * math.pi * F)
    noise = sensing.ItofNoise(read_noise_e=10.0)

    def std(steps, variances):
        z = complex(steps[0] - steps[2], steps[1] - steps[3]) / 2
        slopes = [2 * math.sin(n * TURN / 4 - math.atan2(z.imag, z.real)) / (4 * abs(z)) for n in range(4)]
        return metres * math.sqrt(sum(g**2 * v for g, v in zip(slopes, variances, strict=True)))

    single = sensing.read_itof(frames(60, 55, -4, -3), F, 4, noise=noise)
    assert flat(single.depth_std_m) == pytest.approx([std((60, 55, -4, -3), (160, 155, 100, 100))])
    taps = frames(80, 20, 90, 60, -7, -5, 30, 50)
    two = sensing.read_itof(taps, F, 4, readout="two_tap", noise=noise)
    assert flat(two.depth_std_m) == pytest.approx([std((60, 30, -2, -20), (300, 350, 200, 280))])


def test_deviations_of_two_frequencies_add_by_their_shares():
    """w f^2 / sum: 1 / 10 and 9 / 10 of 20 and 60 MHz; one that is dark makes the depth unknown."""
    x = torch.cat([frames(9, 6, 1, 4), frames(20, 11, 2, 5)], 1)
    both = sensing.read_itof(x, (20e6, 60e6), 4)
    alone = [sensing.read_itof(part, f, 4).depth_std_m for part, f in ((x[:, :4], 20e6), (x[:, 4:], 60e6))]
    wanted = math.hypot(0.1 * float(alone[0]), 0.9 * float(alone[1]))
    assert flat(both.depth_std_m) == pytest.approx([wanted])
    assert itof_depth.shares_of_depth((20e6, 60e6)) == pytest.approx([0.1, 0.9])
    assert itof_depth.shares_of_depth((20e6, 60e6), (9.0, 2.0)) == pytest.approx([1 / 3, 2 / 3])
    dark = torch.cat([frames(9, 6, 1, 4), frames(3, 3, 3, 3)], 1)
    assert flat(sensing.read_itof(dark, (20e6, 60e6), 4).depth_std_m) == [math.inf]


@pytest.mark.parametrize("readout, read, known", [("single", 9.0, None), ("differential", 18.0, 40.0)])
def test_amplitudes_at_the_edge_of_what_light_can_have(readout, read, known):
    """a = 2 offset + 6 deviations is taken, a little more is not: of read noise, and of shot noise of differences."""
    number = 4
    mean = 10.0 if known is None else known
    spread = 6 / number * (read + (mean if known is not None else 0.0))
    most = (2 * mean + 6 * math.sqrt(spread)) / (1 - 1e-5)
    noise = sensing.ItofNoise(read_noise_e=3.0, **({} if known is None else {"offset_e": known}))
    for factor, taken in ((0.999, True), (1.001, False)):
        a = factor * most
        steps = frames(mean + a / 2, mean, mean - a / 2, mean) if known is None else frames(a, 0, -a, 0)
        # of tap sums the amplitude is a / 2 over an offset of the mean
        steps = frames(mean + a, mean, mean - a, mean) if known is None else steps
        if taken:
            found = sensing.read_itof(steps, F, 4, readout=readout, noise=noise)
        else:
            with pytest.warns(PhysicsWarning, match="more amplitude than their light"):
                found = sensing.read_itof(steps, F, 4, readout=readout, noise=noise)
        assert flat(found.depth_std_m.isnan()) == [not taken], factor


def test_all_of_the_light_in_one_tap_is_light():
    """a = 2 offset, but for rounding of 1e-5 of the largest tap; without noise a ten thousandth more is none."""
    assert flat(sensing.read_itof(frames(8, 0, 0, 0), F, 4).depth_std_m) == pytest.approx([0.0], abs=1e-12)
    with pytest.warns(PhysicsWarning, match="more amplitude than their light"):
        found = sensing.read_itof(frames(8, -4e-4, 0, -4e-4), F, 4)
    assert flat(found.depth_std_m.isnan()) == [True]


def test_noise_of_a_phase():
    a, b = torch.tensor([5.0, 20.0]).double(), torch.tensor([18.0, 50.0]).double()
    single = itof_reading.phase_noise_rad(a, b, 3, read_noise_e=2.0)
    assert flat(single) == pytest.approx([math.sqrt(2 * (18 + 4) / 3) / 5, math.sqrt(2 * (50 + 4) / 3) / 20])
    for readout in ("two_tap", "differential"):
        pair = itof_reading.phase_noise_rad(a, b, 3, read_noise_e=2.0, readout=readout)
        assert flat(pair) == pytest.approx([math.sqrt(2 * (18 + 8) / 3) / 5, math.sqrt(2 * (50 + 8) / 3) / 20])


def test_what_a_calibration_takes_off():
    """Offsets of several turns, in float32 too, leave a phase in [0, 2 pi)."""
    x = frames(9, 6, 1, 4).float()
    phi = math.atan2(2, 8)
    for added in (0.0, phi, phi + 1e-9, 1.0, -1.0, 11.0, -11.0):
        known = sensing.ItofCalibration(phase_offset_rad=added)
        found = float(sensing.read_itof(x, F, 4, calibration=known).phase)
        assert 0 <= found < TURN
        away = (found - (phi - added)) / TURN
        assert away == pytest.approx(round(away), abs=1e-6)
    assert not sensing.ItofCalibration(phase_offset_rad=0.1).has_map
    assert sensing.ItofCalibration(phase_map_rad=torch.ones(2, 3)).has_map
    assert sensing.ItofCalibration(depth_map_m=torch.ones(2, 3)).has_map


# ----------------------------------------------------------------------------------------------------------- depth


def test_turns_that_are_added():
    """d = 7.3 m seen by 15 and 18 MHz, between limits; half open, and no place beyond them."""
    frequencies = (15e6, 18e6)
    periods = [SPEED_OF_LIGHT / (2 * f) for f in frequencies]

    def phases(d):
        return torch.tensor([TURN * (d / p % 1.0) for p in periods], dtype=torch.float64).reshape(1, 2, 1, 1)

    longest = SPEED_OF_LIGHT / 6e6
    assert itof_depth.unambiguous_range_m(frequencies) == pytest.approx(longest)
    for d in (0.2, 7.3, 26.0, 49.0):
        assert flat(itof_depth.unwrap_depth(phases(d), frequencies)) == pytest.approx([d])
        for low in (-30.0, -3.0, 12.0):
            found = itof_depth.unwrap_depth(phases(d), frequencies, min_depth_m=low)
            away = (float(found) - d) / longest
            assert low <= float(found) < low + longest and away == pytest.approx(round(away), abs=1e-9)
    # off by 0.1 and 0.4 turns of a phase each: the depth is between, by w / period^2
    off = phases(7.3) + torch.tensor([0.02, -0.03]).double().reshape(1, 2, 1, 1)
    for weights in (None, (4.0, 1.0)):
        w = [v / p**2 for v, p in zip(weights or (1.0, 1.0), periods, strict=True)]
        parts = [(7.3 + e * p / TURN) * v for e, p, v in zip((0.02, -0.03), periods, w, strict=True)]
        found = itof_depth.unwrap_depth(off, frequencies, weights=weights)
        assert flat(found) == pytest.approx([sum(parts) / sum(w)])
    with pytest.raises(UnitError, match=r"at most 49\.97 m, after which"):
        itof_depth.unwrap_depth(off, frequencies, max_depth_m=1.11 * longest)
    assert float(itof_depth.unwrap_depth(off, frequencies, max_depth_m=1.09 * longest)) > 0
    for low, high in ((3.0, 3.0), (3.0, math.inf), (3.0, math.nan)):
        with pytest.raises(UnitError, match="expected min_depth_m < max_depth_m"):
            itof_depth.unwrap_depth(off, frequencies, min_depth_m=low, max_depth_m=high)


def test_a_difference_the_short_way():
    a = torch.tensor([0.1, 6.2, math.pi, -math.pi, 9.0], dtype=torch.float64)
    found = itof_depth.wrapped_difference(a, torch.zeros(5).double())
    assert flat(found) == pytest.approx([0.1, 6.2 - TURN, -math.pi, -math.pi, 9.0 - TURN])
    loss = itof_depth.phasor_loss(torch.tensor([3 + 4j]), torch.tensor([1 - 1j]), torch.tensor([2.0]))
    assert flat(loss) == [2 * (4 + 25)]
    turn = torch.tensor([TURN]).double()
    assert flat(itof_depth.depth_of_phase(turn, 25e6)) == pytest.approx([SPEED_OF_LIGHT / 50e6])


def test_frames_are_made_precise():
    """16 bits in float32, more in float64, halves in float32."""
    kinds = {torch.int16: torch.float32, torch.uint8: torch.float32, torch.int32: torch.float64,
             torch.int64: torch.float64, torch.float16: torch.float32, torch.bfloat16: torch.float32,
             torch.float64: torch.float64}  # fmt: skip
    for kind, wanted in kinds.items():
        assert itof_depth.steps_of(frames(9, 6, 1, 4).to(kind), 4, "single", "here").dtype == wanted
    sums = itof_depth.sums_of(frames(9, 2, 6, 3), 2, "here")
    assert flat(sums) == [11.0, 9.0]
    with pytest.raises(ShapeError, match=r"two_tap frames \(\.\.\., C, F x 2 x N, H, W\) with N = 2 >= 2"):
        itof_depth.sums_of(frames(9, 2, 6), 2, "here")
    with pytest.raises(ShapeError, match=r"single frames \(\.\.\., C, F x N, H, W\) with N = 3 >= 3"):
        itof_depth.steps_of(torch.ones(1, 0, 1, 1), 3, "single", "here")


# ----------------------------------------------------------------------------------------------------------- codes


def test_codes_by_their_definition():
    """Amplitude and phase of harmonics; every tap a step later; two of them a quarter of a turn."""
    code = itof_codes.FourierCode(3, {1: (0.6, 0.3), 2: (-0.3, 1.1)})
    x = torch.tensor([[0.07, 0.4], [1.3, -0.6]], dtype=torch.float64)
    for n in range(3):
        u = x - n / 3
        wanted = 0.6 * torch.cos(TURN * u + 0.3) - 0.3 * torch.cos(2 * TURN * u + 1.1)
        torch.testing.assert_close(code.evaluate(x)[n], wanted)
    assert code.harmonics == (1, 2) and itof_codes.square_code(3).harmonics is None
    assert flat(itof_codes.phase_steps(2)) == [0.0, 0.25] and flat(itof_codes.phase_steps(5)) == pytest.approx(
        [0, 0.2, 0.4, 0.6, 0.8]
    )
    itof_codes.FourierCode(3, {1: (0.5, 0.0), 3: (-0.5, 0.0)})  # at most one in all
    for parts in ({}, {-1: (0.1, 0.0)}, {1: (0.6, 0.0), 3: (-0.41, 0.0)}):
        with pytest.raises(UnitError, match="FourierCode: expected"):
            itof_codes.FourierCode(3, parts)
    with pytest.raises(ShapeError, match="at least 2 taps, got True"):
        itof_codes.FourierCode(True, {1: (0.5, 0.0)})


def test_lines_between_knots():
    """(0.2, 1), (0.5, -0.5), (0.9, 0.25) and round the turn; a second tap of its own."""
    knots = torch.tensor([[0.2, 0.5, 0.9], [0.0, 0.3, 0.6]], dtype=torch.float64)
    values = torch.tensor([[1.0, -0.5, 0.25], [0.0, 1.0, -1.0]], dtype=torch.float64)
    code = itof_codes.PiecewiseLinearCode(knots, values)
    x = torch.tensor([0.2, 0.35, 0.5, 0.7, 0.9, 1.05, 0.1, -0.9, 3.2], dtype=torch.float64)
    rise = 0.25 + 0.5 * 0.75
    assert flat(code.evaluate(x)[0]) == pytest.approx([1, 0.25, -0.5, -0.125, 0.25, rise, 0.25 + 2 / 3 * 0.75,
                                                       0.25 + 2 / 3 * 0.75, 1])  # fmt: skip
    assert flat(code.evaluate(x[:3])[1]) == pytest.approx([2 / 3, 1 - 0.05 / 0.3 * 2, 1 - 0.2 / 0.3 * 2])
    whole = code.bin_means(torch.tensor([0.2, 0.5, 0.9, 1.2], dtype=torch.float64))
    assert flat(whole[0]) == pytest.approx([0.25, -0.125, 0.625])
    assert flat(code.coefficients([0])[0].real) == pytest.approx([0.3 * 0.25 - 0.4 * 0.125 + 0.3 * 0.625])
    # ends of a turn, equal knots, values that are one to rounding
    itof_codes.PiecewiseLinearCode(knots, values * (1 + 1e-10))
    for wrong in ([[0.2, 0.2, 0.9]], [[0.2, 0.5, 1.2]], [[0.5, 0.2, 0.9]]):
        with pytest.raises(UnitError, match="ascend within one turn"):
            itof_codes.PiecewiseLinearCode(torch.tensor([[0.0, 0.3, 0.6], *wrong]), values)


def test_gates_against_light():
    """All of the light inside an opening is one, none is minus one, and between them it is a line."""
    code = itof_codes.binary_code(0.2, [[(0.1, 0.5)], [(0.9, 1.05), (0.3, 0.4)]])
    x = torch.tensor([0.1, 0.3, 0.4, 0.5, 0.9, 0.0, 0.85], dtype=torch.float64)
    assert flat(code.evaluate(x)[0]) == pytest.approx([1, 1, 0, -1, -1, 0, -1 + 2 * 0.25 * 0])
    # light of 0.2 turns, openings of 0.15 and 0.1
    assert flat(code.evaluate(x)[1]) == pytest.approx([-1, 0, -1, -1, 0.5, -1 + 2 * 0.05 / 0.2, 0.5])
    assert code.shifts is None
    with pytest.raises(ShapeError, match="taps of one shape"):
        itof_codes._not_none(code.shifts)
    assert itof_codes.square_code(3, 0.2, 0.3).shifts is not None
    for duties in ((0.0, 0.5), (0.5, 1.0), (1.0, 0.5), (0.5, 0.0)):
        with pytest.raises(UnitError, match=r"square_code: expected (light|gate)_duty"):
            itof_codes.square_code(3, *duties)
    top = itof_codes.square_code(3, 0.2, 0.5).evaluate(torch.tensor([0.0, 1 / 3 + 0.14, 0.34], dtype=torch.float64))
    # tap 0 sees all of the light from -0.15 to 0.15 around phase zero
    assert top[0].tolist() == pytest.approx([1.0, -1.0, -0.9])


def test_corners_of_gates_are_within_all_of_the_light():
    """Whatever rounding makes of openings and pulses."""
    for duty, a, b in ((0.29, 0.76, 1.37), (0.65, 0.28, 1.06), (0.46, 0.63, 1.44), (0.07, 0.43, 0.57)):
        code = itof_codes.binary_code(duty, [[(a, b)], [(a, b)]])
        top = code.evaluate(torch.linspace(0, 1, 101, dtype=torch.float64))
        assert float(top.max()) <= 1.0 and float(top.min()) >= -1.0


def test_measured_codes():
    """Each tap by its largest magnitude; a closed period repeats its first sample."""
    samples = torch.tensor([[0.0, 2.0, -4.0, 0.0], [3.0, 1.0, 0.0, 3.0]], dtype=torch.float64)
    closed = itof_codes.measured_code(samples, closed=True)
    x = torch.tensor([0.0, 1 / 3, 2 / 3, 1 / 6], dtype=torch.float64)
    assert flat(closed.evaluate(x)) == pytest.approx([0, 0.5, -1, 0.25, 1, 1 / 3, 0, 2 / 3])
    opened = itof_codes.measured_code(samples)
    assert flat(opened.evaluate(torch.tensor([0.25, 0.75]).double())) == pytest.approx([0.5, 0.0, 1 / 3, 1.0])
    for wrong in (torch.ones(2, 2), torch.ones(3)):
        with pytest.raises(ShapeError, match=r"samples \(N, S >= 3\)"):
            itof_codes.measured_code(wrong)
    with pytest.raises(UnitError, match="finite samples"):
        itof_codes.measured_code(torch.tensor([[1.0, math.inf, 0.0]] * 2))
    for edges in ([0.1], [0.1, 0.1], [0.3, 0.1], [[0.1, 0.3]]):
        with pytest.raises(UnitError, match="bin_means: expected one ascending row"):
            closed.bin_means(torch.tensor(edges))


# ------------------------------------------------------------------------------------------------- taps and phasors


def test_phasors_are_found_among_others():
    """At either sign, to a millionth; referred to t = 0 from where their axis starts."""
    axis = FrequencyAxis.from_hertz([0.0, 20e6, -60e6], start_opl=1.7)
    g = torch.Generator().manual_seed(0)
    bins = TimeAxis(2.0, 0.05, 90)
    light = torch.rand(2, 1, 90, 1, 2, generator=g, dtype=torch.float64)
    angle = -TURN * axis.per_metre[:, None] * (bins.centers_opl - 1.7)
    phasor = torch.einsum("ft,bcthw->bcfhw", torch.exp(1j * angle), light.to(torch.complex128))
    code = sensing.sine_code(3)
    exact = sensing.ItofCorrelation(code, (20e6, 60e6), bins, contrast=0.6, within_bin="center").expected(light)
    found = sensing.taps_from_phasor(phasor, axis, code, frequencies_hz=(20e6, 60e6), contrast=0.6)
    torch.testing.assert_close(found, exact)
    near = sensing.taps_from_phasor(phasor, axis, code, frequencies_hz=(20e6 + 19, 60e6), contrast=0.6)
    torch.testing.assert_close(near, exact)
    with pytest.raises(UnitError, match=r"expected the phasor to hold 2\.00000?2?1?e\+07 Hz|to hold 2e\+07 Hz"):
        sensing.taps_from_phasor(phasor, axis, code, frequencies_hz=(20e6 + 22, 60e6), contrast=0.6)
    with pytest.raises(UnitError, match="contrast"):
        sensing.taps_from_phasor(phasor, axis, code, frequencies_hz=20e6, contrast=1.1)
    with pytest.raises(UnitError, match="positive"):
        sensing.taps_from_phasor(phasor, axis, code, frequencies_hz=20e6, harmonics=(-1,))


def test_weights_of_pixels_one_by_one():
    """In pieces of any size, for phases of one pixel or of each: the weights made for it alone."""
    g = torch.Generator().manual_seed(1)
    axis = TimeAxis.from_seconds(1e-9, 3e-10, 11)
    light = torch.rand(1, 11, 2, 3, generator=g, dtype=torch.float64)
    code = sensing.square_code(3, 0.3, 0.4)
    phase = 9 * torch.rand(2, 3, generator=g, dtype=torch.float64) - 2
    for within in ("uniform", "center"):
        found = taps_by_pixel(light, code, 40e6, axis, 0.7, within, phase)
        assert found.shape == (1, 3, 2, 3)
        for i in range(2):
            for j in range(3):
                known = sensing.ItofCalibration(phase_offset_rad=float(phase[i, j] % TURN))
                weights = sensing.tap_weights(code, 40e6, axis, contrast=0.7, within_bin=within, calibration=known)
                torch.testing.assert_close(found[0, :, i, j], weights @ light[0, :, i, j])
    one = taps_by_pixel(light, code, 40e6, axis, 0.7, "uniform", phase[:1, :1])
    torch.testing.assert_close(one[..., 0, 0], found.new_tensor(taps_by_pixel(
        light, code, 40e6, axis, 0.7, "uniform", phase)[..., 0, 0].tolist()))  # fmt: skip
    assert taps_by_pixel(light[..., :0], code, 40e6, axis, 0.7, "uniform", phase[:, :0]).shape == (1, 3, 2, 0)


def test_rounding_of_weights():
    """An eps of the largest, of one at least, and a thousand millionth at least."""
    assert rounding_of(torch.tensor([0.5, -3.0])) == pytest.approx(3 * torch.finfo(torch.float32).eps)
    assert rounding_of(torch.tensor([0.5])) == pytest.approx(torch.finfo(torch.float32).eps)
    assert rounding_of(torch.tensor([0.5, -3.0], dtype=torch.float64)) == pytest.approx(3e-9)
    assert rounding_of(torch.ones(0)) == pytest.approx(torch.finfo(torch.float32).eps)


def test_the_state_of_half_a_camera():
    """Of weights rounded to bfloat16; what is off by more than that is another camera's."""
    axis = TimeAxis.from_seconds(0.0, 1e-9, 9)
    camera = sensing.ItofCorrelation(sensing.sine_code(3), 20e6, axis)
    half = sensing.ItofCorrelation(sensing.sine_code(3), 20e6, axis).to(torch.bfloat16)
    camera.load_state_dict(half.state_dict())
    eps = torch.finfo(torch.float32).eps
    for many, taken in ((3.5, True), (4.5, False)):
        state = sensing.ItofCorrelation(sensing.sine_code(3), 20e6, axis).float().state_dict()
        state["weights"] = state["weights"].clone()
        state["weights"][0, 3] += many * eps
        if taken:
            camera.load_state_dict(state)
        else:
            with pytest.raises(UnitError, match="got weights of another"):
                camera.load_state_dict(state)


def test_best_matches_of_many():
    """In chunks; of none there are none."""
    g = torch.Generator().manual_seed(2)
    unit, table = torch.rand(3, 5, 2, generator=g), torch.rand(7, 2, generator=g)
    wanted = np.argmax(np.einsum("abn,pn->abp", unit.numpy(), table.numpy()), -1)
    for chunk in (1, 4, 15, 100):
        assert itof_reading._best_match(unit, table, chunk).tolist() == wanted.tolist()
    assert itof_reading._best_match(unit[:0], table).shape == (0, 5)
