"""Codes, correlation and decoding of iToF cameras against closed forms."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch

from torchtransient import sensing
from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.errors import UnitError
from torchtransient.sensing import PixelElectronics
from torchtransient.units import SPEED_OF_LIGHT

TURN = 2 * math.pi
# Peak phase error of square light and square gates in radians, of all harmonics up to 40 000 (`aliased` below).
WIGGLE = {3: 0.01950, 4: 0.07111, 5: 0.00406, 6: 0.01950, 8: 0.00802}

CODES = {
    "sine": sensing.sine_code(4),
    "harmonics": sensing.FourierCode(5, {1: (0.8, 0.3), 3: (0.15, -1.0)}),
    "square": sensing.square_code(4),
    "short_light": sensing.square_code(3, light_duty=0.2, gate_duty=0.5),
    "hamiltonian3": sensing.hamiltonian_code(3),
    "hamiltonian4": sensing.hamiltonian_code(4),
    "measured": sensing.measured_code(
        torch.stack(
            [torch.cos(TURN * (torch.arange(50) / 50 - s / 3)) + 0.2 * (torch.arange(50) % 2) for s in range(3)]
        )
    ),
}
each_code = pytest.mark.parametrize("name", CODES)


def delta(phase_turns, frequency_hz, electrons=1.0):
    """A transient (1, T, 1, P) whose P pixels hold one delta each, on an axis so fine that bins do not matter."""
    bins = 4096
    period_opl = SPEED_OF_LIGHT / frequency_hz
    axis = TimeAxis(0.0, period_opl / bins, bins)
    x = torch.zeros(1, bins, 1, len(phase_turns), dtype=torch.float64)
    index = (phase_turns * bins).round().long() % bins
    x[0, index, 0, torch.arange(len(index))] = electrons
    return x, axis, (index + 0.5) / bins


@each_code
def test_code_stays_in_its_range_and_repeats(name):
    x = torch.linspace(-2, 3, 1001, dtype=torch.float64)
    values = CODES[name].evaluate(x)
    assert values.shape == (CODES[name].num_taps, 1001)
    assert float(values.abs().max()) <= 1 + 1e-9
    torch.testing.assert_close(values, CODES[name].evaluate(x + 7), rtol=0, atol=1e-11)


@each_code
def test_bin_means_are_integrals(name):
    edges = torch.tensor([-0.3, 0.01, 0.4, 4.2], dtype=torch.float64)
    means = CODES[name].bin_means(edges)
    for k, (a, b) in enumerate(pairwise(edges)):
        n = 200_000
        x = a + (b - a) * (torch.arange(n, dtype=torch.float64) + 0.5) / n
        torch.testing.assert_close(means[:, k], CODES[name].evaluate(x).mean(1), rtol=0, atol=2e-9)


@each_code
def test_fourier_coefficients(name):
    n = 1 << 16
    x = torch.arange(n, dtype=torch.float64) / n
    spectrum = torch.fft.fft(CODES[name].evaluate(x)) / n
    found = CODES[name].coefficients([0, 1, 2, 3, 7, -3])
    # Sampling a code with corners aliases harmonics of n - h, which are of the order 50 / n^2 .
    torch.testing.assert_close(found, spectrum[:, [0, 1, 2, 3, 7, n - 3]], rtol=0, atol=2e-7)


def test_binary_code_against_a_sampled_correlation():
    """Overlap of the light with the gates, from pulses sampled as 0 and 1."""
    code, n = sensing.hamiltonian_code(4), 1200
    gates = np.zeros((4, n))
    for row, openings in zip(gates, [[(5, 11)], [(2, 8)], [(0, 3), (7, 10)], [(4, 6), (9, 13)]], strict=True):
        for a, b in openings:
            row[np.arange(a * 100, b * 100) % n] = 1
    light = np.zeros(n)
    light[:100] = 1 / 100
    overlap = np.stack([[np.dot(np.roll(light, s), gate) for s in range(n)] for gate in gates])
    x = torch.arange(n, dtype=torch.float64) / n
    np.testing.assert_allclose(code.evaluate(x).numpy(), 2 * overlap - 1, atol=1e-9)


@pytest.mark.parametrize("name", ["hamiltonian3", "hamiltonian4"])
def test_hamiltonian_codes_walk_along_the_edges_of_a_cube(name):
    """At every phase one tap is on its way, and the others are at +1 or -1."""
    weights = CODES[name].evaluate((torch.arange(240, dtype=torch.float64) + 0.5) / 240)
    assert ((weights.abs() < 1 - 1e-9).sum(0) == 1).all()


@pytest.mark.parametrize("light_duty, gate_duty", [(0.2, 0.5), (0.4, 0.25)])
def test_rectangles_of_unequal_duties_overlap_in_a_trapezoid(light_duty, gate_duty):
    """Its middle is the phase of the tap, zero of tap 0: the overlap falls as the middles of light and gate part."""
    code = sensing.square_code(3, light_duty, gate_duty)
    x = torch.linspace(0, 1, 301, dtype=torch.float64)
    for n, weight in enumerate(code.evaluate(x)):
        apart = (torch.remainder(x - n / 3 + 0.5, 1) - 0.5).abs()
        overlap = ((light_duty + gate_duty) / 2 - apart).clamp(0, min(light_duty, gate_duty)) / light_duty
        torch.testing.assert_close(weight, 2 * overlap - 1, rtol=0, atol=1e-11)  # corners are rounded to 1e-12


@pytest.mark.parametrize("num_taps", WIGGLE)
def test_wiggling(num_taps):
    """Square on square aliases the harmonics m N +- 1 into the phase: the table of peak errors, to 1e-4 rad."""
    x = torch.arange(0, 1, 1 / 20000, dtype=torch.float64)
    taps = (1 + sensing.square_code(num_taps).evaluate(x)).reshape(1, num_taps, 1, -1) / num_taps
    phase = sensing.phase_of(sensing.tap_phasor(taps, num_taps)).flatten()
    error = sensing.wrapped_difference(phase, TURN * x)
    assert abs(float(error.abs().max()) - WIGGLE[num_taps]) < 1e-4
    phi = TURN * np.arange(0, 1, 1 / 500)
    np.testing.assert_allclose(error[::40].numpy(), aliased(phi, num_taps, 2001), atol=2e-6)


def aliased(phi, num_taps, highest):
    """Phase error from the odd harmonics k = m N +- 1, of amplitude 1 / k^2, that N taps cannot tell from the first."""
    z = np.exp(1j * phi)
    for k in range(3, highest + 1, 2):
        if k % num_taps == 1:
            z += np.exp(1j * k * phi) / k**2
        if k % num_taps == num_taps - 1:
            z += np.exp(-1j * k * phi) / k**2
    return np.angle(z * np.exp(-1j * phi))


def test_wiggling_through_a_phasor_image():
    """Taps from phasors at the odd harmonics agree with those from the transient, but for the harmonics left out."""
    x, axis, _ = delta(torch.arange(0, 1, 1 / 64, dtype=torch.float64), 20e6, electrons=50.0)
    code = sensing.square_code(4)
    harmonics = tuple(range(1, 200, 2))
    axis_f = FrequencyAxis.from_hertz([0.0, *(h * 20e6 for h in harmonics)], start_opl=1.25)
    angle = -TURN * axis_f.per_metre[:, None] * (axis.centers_opl - 1.25)
    # light that is spread evenly over its bin
    kernel = torch.exp(1j * angle) * torch.sinc(axis_f.per_metre * axis.bin_width_opl)[:, None]
    phasor = torch.einsum("ft,cthw->cfhw", kernel, x.to(torch.complex128))
    kept = {"frequencies_hz": 20e6, "contrast": 0.8, "harmonics": harmonics}
    found = sensing.taps_from_phasor(phasor, axis_f, code, **kept)
    left_out = 50 * 0.8 / 4 * 2 * sum(4 / math.pi**2 / h**2 for h in range(201, 100001, 2))
    assert float((found - sensing.ItofCorrelation(code, 20e6, axis, contrast=0.8).expected(x)).abs().max()) <= left_out
    negative = FrequencyAxis(tuple(-f for f in axis_f.frequencies), 1.25)
    again = sensing.taps_from_phasor(phasor.conj(), negative, code, **kept)
    torch.testing.assert_close(again, found)


def test_sine_taps_come_from_one_phasor():
    g = torch.Generator().manual_seed(0)
    x = torch.rand(2, 1, 64, 3, 2, dtype=torch.float64, generator=g)
    axis = TimeAxis(1.0, 0.3, 64)
    axis_f = FrequencyAxis.from_hertz([30e6], start_opl=axis.start_opl)
    turns = axis_f.per_metre * (axis.centers_opl - axis.start_opl)
    # Light evenly spread over a bin has the phasor of its middle times sinc.
    weights = torch.exp(-2j * math.pi * turns) * torch.sinc(axis_f.per_metre * 0.3)
    phasor = torch.einsum("t,bcthw->bchw", weights, x.to(torch.complex128)).unsqueeze(-3)
    correlation = sensing.ItofCorrelation(sensing.sine_code(4), 30e6, axis, contrast=0.7)
    taps = correlation.expected(x)
    torch.testing.assert_close(correlation.expected_from_phasor(phasor, axis_f, steady=x.sum(-3)), taps)
    torch.testing.assert_close(taps.sum(-3), x.sum(-3))
    # The tap phasor is the conjugate of the phasor of the light, up to contrast and taps.
    z = sensing.tap_phasor(taps, 4)
    start = torch.exp(torch.tensor(2j * math.pi * float(axis_f.per_metre) * axis.start_opl))
    torch.testing.assert_close(z, 0.7 / 4 * phasor.conj() * start)


@pytest.mark.parametrize("num_taps, read_noise_e", [(3, 0.0), (4, 30.0), (5, 0.0)])
def test_phase_noise_within_two_percent(num_taps, read_noise_e):
    """Standard deviation of the phase of 80 000 noisy pixels against sqrt(2 (B + N r^2)) / A."""
    electrons, contrast, background, count = 4000.0, 0.6, 2000.0, 80_000
    x, axis, _ = delta(torch.full((1,), 0.23, dtype=torch.float64), 20e6, electrons)
    camera = sensing.ItofCorrelation(
        sensing.sine_code(num_taps), 20e6, axis, contrast=contrast, background_e=background
    )
    taps = camera.expected(x).expand(1, num_taps, 1, count)
    noisy = PixelElectronics(read_noise_e=read_noise_e).sample(taps, torch.Generator().manual_seed(5))
    phase = sensing.phase_of(sensing.tap_phasor(noisy, num_taps))
    total, modulated = electrons + background, electrons * contrast
    theory = math.sqrt(2 * (total + num_taps * read_noise_e**2)) / modulated
    # Three taps see the third harmonic of the noise: shot noise follows the light, which has the same period.
    swing = modulated * math.cos(3 * TURN * 0.23) if num_taps == 3 else 0.0
    exact = math.sqrt(theory**2 - swing / modulated**2)
    assert abs(float(phase.std()) / exact - 1) < 0.02  # its own standard error is 0.25 %
    clean = sensing.read_itof(taps[..., :1], 20e6, num_taps)
    predicted = sensing.phase_noise_rad(clean.amplitude, clean.offset, num_taps, read_noise_e=read_noise_e)
    assert abs(float(predicted) / theory - 1) < 1e-5  # the delta stands in a bin of 1 / 4096 turn
    assert abs(float(clean.amplitude / clean.offset) - modulated / total) < 1e-5


@pytest.mark.parametrize("frequencies", [(20e6, 90e6), (60e6, 100e6), (16e6, 80e6, 120e6)])
def test_unwrapping(frequencies):
    longest = sensing.unambiguous_range_m(frequencies)
    truth = torch.linspace(0.01, longest - 0.2, 1500, dtype=torch.float64).reshape(1, 1, -1)
    exact = torch.stack([truth * 2 * TURN * f / SPEED_OF_LIGHT for f in frequencies], dim=-3)
    g = torch.Generator().manual_seed(1)
    noise = 0.03 * torch.randn(exact.shape, generator=g, dtype=torch.float64)
    phase = torch.remainder(exact + noise, TURN).requires_grad_()
    depth = sensing.unwrap_depth(phase, frequencies, min_depth_m=-0.1)
    # Weighted least squares: the variance of depth is one over the sum of 1 / (variance of each frequency).
    precision = sum((2 * TURN * f / SPEED_OF_LIGHT / 0.03) ** 2 for f in frequencies)
    error = (depth - truth).detach()
    assert float(error.abs().max()) < 5 * precision**-0.5
    assert abs(float(error.std()) * precision**0.5 - 1) < 0.08
    (gradient,) = torch.autograd.grad(depth.sum(), phase)
    slope = sum(gradient.select(-3, i) * (2 * TURN * f / SPEED_OF_LIGHT) for i, f in enumerate(frequencies))
    torch.testing.assert_close(slope, torch.ones_like(slope))  # moving all phases with depth moves depth one to one


@pytest.mark.parametrize("name", ["sine", "square", "hamiltonian3", "hamiltonian4", "short_light"])
def test_decoding_by_shape(name):
    code = CODES[name]
    truth = torch.linspace(0.0, 0.999, 701, dtype=torch.float64)
    taps = (5 + 3 * code.evaluate(truth)).reshape(1, code.num_taps, 1, -1)
    phase = sensing.decode_code(taps, code)
    error = sensing.wrapped_difference(phase.flatten(), TURN * truth)
    assert float(error.abs().max()) < 2e-3  # at the corners of a code the slope is that of neither side
    assert float(error.abs().median()) < 1e-5


@pytest.mark.parametrize("name", ["sine", "hamiltonian3"])
def test_gradient_of_decoding_by_shape(name):
    """Moving the taps along the code moves the phase with it."""
    code = CODES[name]
    truth = torch.tensor([0.11, 0.47, 0.83], dtype=torch.float64, requires_grad=True)
    taps = (5 + 3 * code.evaluate(truth)).reshape(1, code.num_taps, 1, -1)
    (gradient,) = torch.autograd.grad(sensing.decode_code(taps, code).sum() / TURN, truth)
    torch.testing.assert_close(gradient, torch.ones_like(gradient), rtol=0.02, atol=0)


def test_phase_stays_below_a_turn():
    z = torch.tensor([1 - 1e-9j, 1 - 1e-30j, -1 + 0j, 1e-30 + 1e-30j], dtype=torch.complex64)
    phase = sensing.phase_of(z)
    assert bool((phase >= 0).all()) and bool((phase < TURN).all())


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


# ----------------------------------------------------------------------------------------------------------- depth


def test_turns_that_are_added():
    """d = 7.3 m seen by 15 and 18 MHz, between limits; half open, and no place beyond them."""
    frequencies = (15e6, 18e6)
    periods = [SPEED_OF_LIGHT / (2 * f) for f in frequencies]

    def phases(d):
        return torch.tensor([TURN * (d / p % 1.0) for p in periods], dtype=torch.float64).reshape(1, 2, 1, 1)

    longest = SPEED_OF_LIGHT / 6e6
    assert sensing.unambiguous_range_m(frequencies) == pytest.approx(longest)
    for d in (0.2, 7.3, 26.0, 49.0):
        assert flat(sensing.unwrap_depth(phases(d), frequencies)) == pytest.approx([d])
        for low in (-30.0, -3.0, 12.0):
            found = sensing.unwrap_depth(phases(d), frequencies, min_depth_m=low)
            away = (float(found) - d) / longest
            assert low <= float(found) < low + longest and away == pytest.approx(round(away), abs=1e-9)
    # off by 0.1 and 0.4 turns of a phase each: the depth is between, by 1 / period^2
    off = phases(7.3) + torch.tensor([0.02, -0.03]).double().reshape(1, 2, 1, 1)
    w = [1 / p**2 for p in periods]
    parts = [(7.3 + e * p / TURN) * v for e, p, v in zip((0.02, -0.03), periods, w, strict=True)]
    assert flat(sensing.unwrap_depth(off, frequencies)) == pytest.approx([sum(parts) / sum(w)])
    with pytest.raises(UnitError, match=r"at most 49\.97 m, after which"):
        sensing.unwrap_depth(off, frequencies, max_depth_m=1.11 * longest)
    assert float(sensing.unwrap_depth(off, frequencies, max_depth_m=1.09 * longest)) > 0
    for low, high in ((3.0, 3.0), (3.0, math.inf), (3.0, math.nan)):
        with pytest.raises(UnitError, match="expected min_depth_m < max_depth_m"):
            sensing.unwrap_depth(off, frequencies, min_depth_m=low, max_depth_m=high)
