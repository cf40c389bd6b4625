"""Pixels of two taps, differences, calibrations and the noise of depth, against closed forms and draws."""

from __future__ import annotations

import math
import os
from itertools import product as pairs
from pathlib import Path

import numpy as np
import pytest
import torch

from support.sweeps import together
from torchtransient import sensing
from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.errors import ShapeError, UnitError
from torchtransient.units import SPEED_OF_LIGHT

TURN = 2 * math.pi
F = 20e6
PERIOD = TimeAxis(0.0, SPEED_OF_LIGHT / F / 4096, 4096)
READOUTS = ("single", "two_tap", "differential")


def measured(num_taps):
    """Samples of a function that is neither even nor of few harmonics, moved along."""
    x = TURN * (torch.arange(60) / 60 - torch.arange(num_taps)[:, None] / (num_taps if num_taps > 2 else 4))
    return sensing.measured_code(torch.cos(x + 0.4) + 0.2 * torch.cos(3 * x - 1.0) + 0.05)


CODES = {
    **{f"sine{n}": sensing.sine_code(n) for n in (2, 3, 4, 7)},
    **{f"square{n}": sensing.square_code(n) for n in (2, 3, 4, 5)},
    **{f"measured{n}": measured(n) for n in (2, 4, 5, 8)},
    "hamiltonian3": sensing.hamiltonian_code(3),
    "hamiltonian4": sensing.hamiltonian_code(4),
    "harmonics": sensing.FourierCode(5, {1: (0.8, 0.3), 3: (0.15, -1.0)}),
}


def frames(code, turns, readout, light=1000.0, contrast=0.7, background=300.0):
    """Means (1, frames, 1, P) of pixels that see a delta at the phases given, by the definition of each readout."""
    shape = contrast * code.evaluate(turns) * light
    if readout == "single":
        found = (light + background + shape) / code.num_taps
    elif readout == "differential":
        found = shape / code.num_taps
    else:
        both = torch.stack([light + background + shape, light + background - shape], 1)
        found = both.flatten(0, 1) / (2 * code.num_taps)
    return found[None, :, None]


@pytest.mark.parametrize(
    "name, readout",
    [
        (name, readout)
        for n, name in enumerate(CODES)
        for readout in (READOUTS if CODES[name].num_taps in (2, 4) else READOUTS[n % 3 :][:1])
    ],
)
def test_every_code_and_readout_gives_the_phase(name, readout):
    """Decoded by shape, through a transient and through the definition; two steps of one tap are refused."""
    code, turns = CODES[name], torch.linspace(0.003, 0.997, 101, dtype=torch.float64)
    x = torch.zeros(1, 4096, 1, 101, dtype=torch.float64)
    index = (turns * 4096).long()
    x[0, index, 0, torch.arange(101)] = 1000.0
    turns = (index.double() + 0.5) / 4096
    gates = code if readout == "single" else sensing.TwoTapCode(code)
    if code.num_taps == 2 and readout == "single":
        with pytest.raises(ShapeError, match="TwoTapCode"):
            sensing.ItofCorrelation(gates, F, PERIOD)
        with pytest.raises(ShapeError, match="N = 2 >= 3"):
            sensing.decode_code(torch.ones(1, 2, 1, 1), code)
        return
    camera = sensing.ItofCorrelation(gates, F, PERIOD, contrast=0.7, background_e=300.0)
    taps = camera.expected(x)
    if readout != "single":
        torch.testing.assert_close(taps.sum(-3), x.sum(-3) + 300.0)  # every electron goes to A or to B
    taps = sensing.TapDifference().expected(taps) if readout == "differential" else taps
    # The mean of a code over 1 / 4096 turn is its value in the middle, but within its corners.
    slope = 1000.0 * 0.7 * 40 / 4096
    torch.testing.assert_close(taps, frames(code, turns, readout), rtol=0, atol=slope)
    reading = sensing.read_itof(taps, F, code.num_taps, readout=readout, code=gates)
    # Corners that lie between two of the 1024 phases of the decoder.
    assert float(sensing.wrapped_difference(reading.phase.flatten(), TURN * turns).abs().max()) < TURN / 1024
    assert (reading.offset is None) == (readout == "differential")
    if readout == "two_tap" or (readout == "single" and "sine" in name):  # others leave harmonics in it
        torch.testing.assert_close(reading.offset, torch.full_like(reading.offset, 1300.0 / code.num_taps))


@together("num_taps, readout", [p for p in pairs(range(2, 9), READOUTS) if p != (2, "single")])
def test_the_fourier_sum_means_the_same_in_every_readout(num_taps, readout):
    turns = torch.linspace(0, 0.99, 50, dtype=torch.float64)
    taps = frames(sensing.sine_code(num_taps), turns, readout)
    z = sensing.tap_phasor(taps, num_taps, readout)
    torch.testing.assert_close(sensing.amplitude_of(z), torch.full_like(z.real, 700.0 / num_taps))
    assert float(sensing.wrapped_difference(sensing.phase_of(z).flatten(), TURN * turns).abs().max()) < 1e-12
    if readout == "differential":
        with pytest.raises(UnitError, match="cancelled"):
            sensing.offset_of(taps, num_taps, readout)
    else:
        torch.testing.assert_close(
            sensing.offset_of(taps, num_taps, readout), torch.full_like(z.real, 1300.0 / num_taps)
        )


def test_two_quadrature_steps_of_two_taps_wiggle_as_four_taps():
    """A_0, A_1, B_0, B_1 are the four taps a quarter of a turn apart: 71.11 mrad at most for square codes."""
    turns = torch.arange(0, 1, 1 / 5000, dtype=torch.float64)
    for readout in ("two_tap", "differential"):
        z = sensing.tap_phasor(frames(sensing.square_code(2), turns, readout), 2, readout)
        error = sensing.wrapped_difference(sensing.phase_of(z).flatten(), TURN * turns)
        assert abs(float(error.abs().max()) - 0.07111) < 1e-4
    four = frames(sensing.square_code(4), turns, "single")
    two = frames(sensing.square_code(2), turns, "two_tap")
    torch.testing.assert_close(two[:, [0, 2, 1, 3]], four)


# ------------------------------------------------------------------------------------------------------------- noise


def test_deviation_of_an_unwrapped_depth():
    frequencies, count = (60e6, 100e6), 20_000
    axis = TimeAxis(0.0, 0.005, 800)
    x = torch.zeros(1, 800, 1, 1, dtype=torch.float64)
    x[0, 300] = 1e5
    camera = sensing.ItofCorrelation(sensing.TwoTapCode(sensing.sine_code(3)), frequencies, axis, contrast=0.5)
    taps = camera.expected(x).expand(1, -1, 1, count)
    noisy = sensing.PixelElectronics().sample(taps, torch.Generator().manual_seed(1))
    reading = sensing.read_itof(noisy, frequencies, 3, readout="two_tap", min_depth_m=-0.2)
    assert abs(float(reading.depth_m.mean()) - 300.5 * 0.005 / 2) < 1e-3
    ratio = float(reading.depth_std_m.mean()) / float(reading.depth_m.std())
    assert abs(ratio - 1) < 0.03


@pytest.mark.parametrize("readout", READOUTS)
def test_dark_pixels(readout):
    """Depth zero of infinite deviation; gradients are finite, also of the deviation."""
    taps = torch.zeros(1, 8 if readout == "two_tap" else 4, 1, 2, dtype=torch.float64)
    taps[..., 1] = 3.0 if readout != "differential" else 0.0
    taps.requires_grad_()
    for code in (None, sensing.sine_code(4)):
        reading = sensing.read_itof(
            taps, F, 4, readout=readout, code=code, noise=sensing.ItofNoise(read_noise_e=2.0, offset_e=5.0)
        )
        assert bool(reading.depth_std_m.isinf().all()) and bool((reading.depth_m == 0).all())
        (slope,) = torch.autograd.grad(reading.depth_std_m.sum() + reading.depth_m.sum(), taps)
        assert bool(torch.isfinite(slope).all())


@pytest.mark.parametrize("readout", READOUTS)
def test_readings_have_gradients(readout):
    g = torch.Generator().manual_seed(2)
    size = (1, 8 if readout == "two_tap" else 4, 2, 2)
    taps = (1 + torch.rand(size, dtype=torch.float64, generator=g)).requires_grad_()
    known = sensing.ItofCalibration(
        phase_offset_rad=0.3,
        direction=-1,
        phase_map_rad=torch.rand(2, 2, generator=g),
        depth_map_m=torch.rand(2, 2, generator=g),
    )
    noise = sensing.ItofNoise(read_noise_e=0.5, offset_e=3.0)

    def read(taps):
        found = sensing.read_itof(taps, F, 4, readout=readout, calibration=known, noise=noise)
        return found.depth_m, found.amplitude, found.depth_std_m

    assert torch.autograd.gradcheck(read, taps, fast_mode=True)


# ------------------------------------------------------------------------------------------------------- calibration

MAP = 0.8 * torch.rand(3, 4, generator=torch.Generator().manual_seed(5), dtype=torch.float64) - 0.4
DEPTHS = 0.3 * torch.rand(3, 4, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
AXIS = TimeAxis(0.4, 0.11, 70)
FREQUENCIES = (30e6, 70e6)
LIGHT = torch.rand(2, 1, 70, 3, 4, generator=torch.Generator().manual_seed(4), dtype=torch.float64)


@together(
    "name, direction",
    [*pairs(["sine2", "sine4", "harmonics", "square2", "square3"], [1, -1]), ("measured4", 1)],
)
def test_maps_are_delays_of_the_light(name, direction):
    """Taps of every pixel against weights made for that pixel alone, on an axis that begins later by its delay."""
    code = CODES[name]
    gates = sensing.TwoTapCode(code) if code.num_taps == 2 or name == "measured4" else code
    known = sensing.ItofCalibration(
        phase_offset_rad=(0.2, -1.1), direction=direction, phase_map_rad=torch.stack([MAP, 2 * MAP]), depth_map_m=DEPTHS
    )
    camera = sensing.ItofCorrelation(gates, FREQUENCIES, AXIS, contrast=0.8, background_e=3.0, calibration=known)
    found = camera.expected(LIGHT)
    turned = sensing.ReversedCode(code) if direction < 0 else code
    turned = sensing.TwoTapCode(turned) if isinstance(gates, sensing.TwoTapCode) else turned
    for i, j in ((0, 0), (2, 3), (1, 2)):
        rows = []
        for k, f in enumerate(FREQUENCIES):
            phase = (0.2, -1.1)[k] + (k + 1) * float(MAP[i, j]) + 4 * math.pi * f * float(DEPTHS[i, j]) / SPEED_OF_LIGHT
            later = TimeAxis(AXIS.start_opl + phase / TURN * SPEED_OF_LIGHT / f, AXIS.bin_width_opl, AXIS.num_bins)
            rows.append(sensing.tap_weights(turned, f, later, contrast=0.8))
        wanted = torch.einsum("mt,bct->bcm", torch.cat(rows), LIGHT[..., i, j]) + 3.0 / gates.num_taps
        torch.testing.assert_close(found[..., i, j], wanted, rtol=1e-9, atol=1e-9)


def test_reversed_steps():
    """Step n of a reversed code is the function at x + n / N."""
    code = CODES["harmonics"]
    x = torch.linspace(-1, 2, 31, dtype=torch.float64)
    back = sensing.ReversedCode(code)
    for n in range(5):
        torch.testing.assert_close(back.evaluate(x)[n], code.evaluate(x + n / 5)[0])
        torch.testing.assert_close(back.bin_means(x)[n], code.bin_means(x + n / 5)[0])
    size = 1 << 10
    spectrum = torch.fft.fft(back.evaluate(torch.arange(size, dtype=torch.float64) / size)) / size
    torch.testing.assert_close(back.coefficients([0, 1, 3, -3]), spectrum[:, [0, 1, 3, size - 3]], rtol=0, atol=1e-12)


@pytest.mark.slow
@together(
    "name, readout",
    [
        *pairs(["sine3", "square4", "hamiltonian4", "measured4"], READOUTS),
        ("square2", "differential"),
    ],
)
@together("direction", [1, -1])
def test_what_a_calibration_puts_in_a_reading_takes_off(name, readout, direction):
    """A camera with offsets, reversed steps and maps reads the depths of one without; both through a transient."""
    code = CODES[name]
    known = sensing.ItofCalibration(
        phase_offset_rad=[0.7, 2.9], direction=direction, phase_map_rad=MAP, depth_map_m=DEPTHS
    )
    gates = code if readout == "single" else sensing.TwoTapCode(code)
    axis = TimeAxis(0.0, 0.002, 1500)
    x = torch.zeros(1, 1500, 3, 4, dtype=torch.float64)
    at = torch.randint(100, 1400, (3, 4), generator=torch.Generator().manual_seed(1))
    x.scatter_(1, at[None, None], 1e4)
    if direction < 0 and code.shifts is None:
        with pytest.raises(UnitError, match="one function moved along"):
            sensing.ItofCorrelation(gates, FREQUENCIES, axis, calibration=known)
        return
    camera = sensing.Compose(
        [
            sensing.ItofCorrelation(gates, FREQUENCIES, axis, contrast=0.8, background_e=50.0, calibration=known),
            *([sensing.TapDifference()] if readout == "differential" else []),
        ]
    )
    decoder = None if name.startswith("sine") else gates
    reading = sensing.read_itof(
        camera.expected(x), FREQUENCIES, code.num_taps, readout=readout, code=decoder, calibration=known,
        max_depth_m=1.6, min_depth_m=-0.1,
    )  # fmt: skip
    wanted = (at + 0.5) * 0.002 / 2
    # A turn of 30 MHz is 5 m of depth; the decoder's table has 1024 phases with corners between them.
    tolerance = 1e-6 if decoder is None else SPEED_OF_LIGHT / (2 * 30e6) / 1024
    assert float((reading.depth_m[0] - wanted).abs().max()) < tolerance


def test_maps_through_a_phasor_image():
    known = sensing.ItofCalibration(phase_offset_rad=0.4, direction=-1, phase_map_rad=MAP, depth_map_m=DEPTHS)
    axis_f = FrequencyAxis.from_hertz([0.0, *FREQUENCIES], start_opl=0.3)
    angle = -TURN * axis_f.per_metre[:, None] * (AXIS.centers_opl - 0.3)
    # light that is spread evenly over its bin
    kernel = torch.exp(1j * angle) * torch.sinc(axis_f.per_metre * AXIS.bin_width_opl)[:, None]
    phasor = torch.einsum("ft,bcthw->bcfhw", kernel, LIGHT.to(torch.complex128))
    camera = sensing.ItofCorrelation(sensing.TwoTapCode(sensing.sine_code(2)), FREQUENCIES, AXIS, calibration=known)
    torch.testing.assert_close(camera.expected_from_phasor(phasor, axis_f), camera.expected(LIGHT))
    with pytest.raises(ShapeError, match=r"\(3, 4\) pixels"):
        camera.expected_from_phasor(phasor[..., :2], axis_f)


# ---------------------------------------------------------------------------------------------------------- measured


def error_of_measured(samples, readout, kind):
    """rms error in radians of raw frames A, B (2 N, S) of one period, by a code from every seventh of them."""
    raw = torch.from_numpy(samples[:, :-1].round().astype(kind))  # the last sample is the first again
    count = raw.shape[1]
    assert count % 7 == 0
    a, b = raw[0::2, ::7].double(), raw[1::2, ::7].double()
    frames = raw if readout == "two_tap" else raw[0::2] - raw[1::2]
    code = sensing.TwoTapCode(sensing.measured_code(a - b))
    reading = sensing.read_itof(frames[None, :, None], 2e6, len(a), readout=readout, code=code)
    truth = TURN * torch.arange(count, dtype=torch.float64) / count
    error = sensing.wrapped_difference(reading.phase.flatten().double(), truth)[torch.arange(count) % 7 > 0]
    return float(error.square().mean().sqrt())


@pytest.mark.parametrize("readout", ["two_tap", "differential"])
def test_frames_of_a_measured_camera(readout):
    """Raw numbers of a camera of two taps (Gutierrez-Barragan et al., MIT licence, see measured_hamiltonian_k3.md).

    Numbers go from -928 to 930, so that rounding alone leaves 1 / sqrt(12) of 1900 in a difference of two, over a
    slope of about 6 in a turn: 0.2 mrad.
    """
    samples = np.load(Path(__file__).parent / "measured_hamiltonian_k3.npy")
    assert error_of_measured(samples, readout, "int16") < 0.6e-3


@pytest.mark.measured
@pytest.mark.parametrize("taps, limit", [(3, 0.6e-3), (4, 3e-3)])
def test_frames_of_measured_cameras(taps, limit):
    named = os.environ.get("TORCHTRANSIENT_MEASURED_DATA")
    if not named:
        pytest.fail("the tests marked 'measured' need TORCHTRANSIENT_MEASURED_DATA, a folder", pytrace=False)
    samples = np.load(Path(named) / "spad_irf" / f"keatof_2MHz_ham-k{taps}_min.npy")
    for readout in ("two_tap", "differential"):
        assert error_of_measured(samples, readout, "int16") < limit


# ------------------------------------------------------------------------------------------------- frames and numbers


@pytest.mark.parametrize("kind", ["int16", "uint16", "int32", "uint8", "float16", "float32"])
def test_raw_frames_of_whole_numbers(kind):
    """As arrays and as tensors; differences of unsigned numbers do not wrap."""
    turns = torch.linspace(0, 0.95, 20, dtype=torch.float64)
    exact = frames(sensing.sine_code(4), turns, "two_tap", light=900.0, background=100.0).round()
    wanted = sensing.read_itof(exact, F, 4, readout="two_tap")
    array = exact.numpy().astype(kind)
    for given in (array, torch.from_numpy(array)):
        found = sensing.read_itof(given, F, 4, readout="two_tap")
        assert found.phase.dtype in (torch.float32, torch.float64)
        assert float(sensing.wrapped_difference(found.phase.double(), wanted.phase).abs().max()) < 1e-5
        torch.testing.assert_close(found.offset.double(), wanted.offset)
    full = torch.full((1, 4, 1, 1), 65535, dtype=torch.uint16)
    assert float(sensing.offset_of(full, 2, "two_tap")) == 2 * 65535


@pytest.mark.slow
@pytest.mark.parametrize("readout", ["differential", "single"])
def test_the_standard_deviation_at_the_corners_of_a_square_code(readout):
    """The slope has two values at a corner: one of them was claimed, up to 19 % too small."""
    axis = TimeAxis.from_seconds(0.0, 1e-10, 256)
    code = sensing.square_code(5)
    pixel = code if readout == "single" else sensing.TwoTapCode(code)
    x = torch.full((1, 256, 1, 1), 2.0, dtype=torch.float64)
    x[0, 150] = 4000.0
    mean = sensing.ItofCorrelation(pixel, [20e6], axis).expected(x)
    number = 4000
    many = mean.expand(number, *mean.shape[-4:]).contiguous()
    frames = torch.poisson(many, generator=torch.Generator().manual_seed(1))
    noise = None
    if readout == "differential":
        frames, noise = sensing.TapDifference()(frames), sensing.ItofNoise(offset_e=float(x.sum()) / 5)
    reading = sensing.read_itof(frames, [20e6], 5, readout=readout, code=pixel, noise=noise)
    claimed = float(reading.depth_std_m.square().mean().sqrt())
    # four deviations of a standard deviation of so many, and what second order leaves of the average
    assert float(reading.depth_m.std()) == pytest.approx(claimed, rel=4 / (2 * number) ** 0.5 + 0.01)
