"""Chirps: beats of lengths and rates, and the line of an arrival, against chirps that are simulated in time."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.signal import get_window

from torchtransient import Chirps, TimeAxis
from torchtransient.chirps import WINDOWS
from torchtransient.errors import UnitError
from torchtransient.units import SPEED_OF_LIGHT

CHIRPS = Chirps(bandwidth_hz=1e9, duration_s=10e-6, wavelength_m=1550e-9)
SAMPLES = 2048


def beat(chirps, opl, rate, sign):
    """Samples of the beat over a chirp: phase of the local oscillator minus that of light delayed by opl(t) / c."""
    t = (np.arange(SAMPLES) + 0.5) / SAMPLES * chirps.duration_s - chirps.duration_s / 2
    delay = (opl + rate * t) / SPEED_OF_LIGHT
    sweep, carrier = chirps.bandwidth_hz / chirps.duration_s, SPEED_OF_LIGHT / chirps.wavelength_m
    # The difference of the two quadratic phases, written out: 1e14 turns leave no digits to subtract.
    phase = carrier * (delay - opl / SPEED_OF_LIGHT) + sign * sweep * (t * delay - delay**2 / 2)
    return np.exp(2j * np.pi * sign * phase)


@pytest.mark.parametrize(("opl", "rate"), [(6.434, -3.66), (6.434, 3.66), (0.8, 0.0), (40.0, -0.5)])
@pytest.mark.parametrize("sign", [1, -1])
def test_beats_are_those_of_chirps_in_time(opl, rate, sign):
    """`beat_up = (opl + k rate) B / (T c)`, `beat_down` with the other sign, both seen from the sweep's direction."""
    pad = 64
    spectrum = np.abs(np.fft.fft(beat(CHIRPS, opl, rate, sign) * np.hanning(SAMPLES), SAMPLES * pad))
    found = np.fft.fftfreq(SAMPLES * pad, CHIRPS.duration_s / SAMPLES)[np.argmax(spectrum)]
    expected = CHIRPS.hertz_per_metre * (opl + sign * CHIRPS.rate_scale_s * rate)
    # A grid of 1 / 64 of a line, and lengths that change by rate T f0 / f0: 1e-4 of a line.
    assert found == pytest.approx(expected, abs=0.6 / pad / CHIRPS.duration_s)


def test_beats_of_an_axis():
    axis = TimeAxis(-1.0, 0.5, 4)
    beats = CHIRPS.beats_hz(axis)
    assert beats.dtype == torch.float64
    np.testing.assert_allclose(beats, np.array([-0.75, -0.25, 0.25, 0.75]) / 0.299792458 / 10e-6, rtol=1e-14)
    assert CHIRPS.resolution_opl * CHIRPS.hertz_per_metre == pytest.approx(1 / CHIRPS.duration_s)


@pytest.mark.parametrize("window", WINDOWS)
def test_line_is_the_power_spectrum_of_the_window(window):
    """Against the transform of scipy's window, padded 16 times."""
    chirps, pad = Chirps(1e9, 10e-6, 1550e-9, window=window), 16
    power = np.abs(np.fft.fftshift(np.fft.fft(get_window(window, SAMPLES), SAMPLES * pad))) ** 2
    power /= power.sum() / pad  # a density over lines of c / B
    at = (np.arange(SAMPLES * pad) - SAMPLES * pad // 2) / pad
    edges = np.linspace(-2, 2, 65)
    shares = np.diff(chirps.line_shape.cumulative(edges * chirps.resolution_opl))
    fine = np.linspace(-2, 2, 64 * 40 + 1)
    middle = 0.5 * (fine[1:] + fine[:-1])
    expected = np.interp(middle, at, power).reshape(64, 40).sum(1) * (fine[1] - fine[0])
    # A thousandth of the line is cut off; both tables are linear between their values.
    np.testing.assert_allclose(shares, expected, atol=3e-3 * expected.max())


@pytest.mark.parametrize("window", WINDOWS)
def test_line_is_whole_and_even(window):
    line = Chirps(1e9, 10e-6, 1550e-9, window=window).line_shape
    x = np.linspace(-30, 30, 241)
    low, high = line.support_opl
    assert low == -high
    np.testing.assert_array_equal(line.cumulative([low, high]), [0, 1])
    np.testing.assert_allclose(line.cumulative(x) + line.cumulative(-x), 1, atol=1e-12)


def test_axis_holds_both_spectra():
    axis = CHIRPS.time_axis((1.0, 20.0), (-3.0, 5.0), bins_per_line=2)
    shift = CHIRPS.rate_scale_s * 10.0
    assert axis.bin_width_opl == pytest.approx(CHIRPS.resolution_opl / 2)
    margin = np.array([2 - shift - axis.start_opl, axis.end_opl - (40 + shift)]) / CHIRPS.resolution_opl
    assert (margin >= 4).all() and (margin < 6).all()
    assert axis.centers_opl.abs().min().item() < 1e-9
    still = CHIRPS.time_axis((1.0, 20.0))
    assert still.start_opl < 2.0 and still.end_opl > 40.0 and still.num_bins < axis.num_bins / 2


@pytest.mark.parametrize(
    ("numbers", "word"),
    [((1.0, 10e-6, 1550e-9), "hertz"), ((1e9, 10.0, 1550e-9), "seconds"), ((1e9, 10e-6, 1550.0), "metres"),
     ((-1e9, 10e-6, 1550e-9), "greater than zero")],
)  # fmt: skip
def test_numbers_of_another_unit_are_refused(numbers, word):
    with pytest.raises(UnitError, match=word):
        Chirps(*numbers)
