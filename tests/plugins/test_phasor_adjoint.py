"""The adjoint of `phasor_hdr_film` by itself: phases of grids and lists after long paths, arrivals read together."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from torchtransient import plugins

LENGTHS = [0.0, 0.37, 12.125, 731.0625, 1000.0 + 1 / 3, 4.1e4]
CYCLES = 1e-6


@pytest.fixture(autouse=True)
def _variant():
    mi.set_variant("llvm_ad_mono")
    plugins.sync()


def make_film(**arguments):
    description = {"type": "phasor_hdr_film", "width": 1, "height": 1, "rfilter": {"type": "box"}, **arguments}
    with plugins.plugin_errors():
        return mi.load_dict(description)


def text(frequencies):
    return " ".join(repr(float(f)) for f in frequencies)


def kernel(film, opl):
    """exp(-2 pi i nu opl) as the adjoint sees it, and its slope over -2 pi i nu, which is the same: lane
    k has an adjoint of 1 and of i at frequency number k alone, so that no sum hides the error of a phase.
    """
    F = film.frequency_count()
    flat = np.zeros((F, F, 2, 2), np.float32)
    flat[np.arange(F), np.arange(F), 0, 0] = flat[np.arange(F), np.arange(F), 1, 1] = 1
    flat = mi.Float(flat.ravel())
    parts, slopes = [], []
    for part in range(2):
        base = dr.arange(mi.UInt32, F) * (4 * F) + 2 * part
        A, slope = film.read((flat, 4, 1), base, dr.opaque(mi.Float64, opl), mi.Bool(True))
        dr.eval(A, slope)  # in one kernel, for all lengths
        parts.append(np.array(A[0], dtype=np.float64))
        slopes.append(np.array(slope[0], dtype=np.float64))
    ω = 2 * np.pi * film.frequencies
    with np.errstate(invalid="ignore"):  # nothing of frequency zero
        return parts[0] + 1j * parts[1], (slopes[0] + 1j * slopes[1]) / (-1j * ω)


def worst(film, lengths=LENGTHS):
    """Largest error of a phase in cycles; amplitudes and slopes are checked on the way."""
    found = 0.0
    for opl in lengths:
        value, slope = kernel(film, opl)
        turns = np.multiply(film.frequencies, opl, dtype=np.longdouble)
        expected = np.exp(-2j * np.pi * (turns - np.round(turns)).astype(np.float64))
        found = max(found, np.abs(value - expected).max() / (2 * np.pi))
        some = film.frequencies != 0
        np.testing.assert_allclose(slope[some], value[some], atol=1e-6)
    return found


@pytest.mark.parametrize("count", [1, 2, 1025])
def test_phases_of_a_grid(count):
    film = make_film(frequency_first=0.1, frequency_step=99.9 / 1024, frequency_count=count)
    assert film.step is not None and worst(film) < CYCLES


def test_a_grid_on_both_sides_of_zero():
    film = make_film(frequency_first=-50.0, frequency_step=1 / 3, frequency_count=301)
    assert film.step is not None and worst(film) < CYCLES


@pytest.mark.parametrize("deviation, is_grid", [(5e-15, True), (1e-12, False), (1e-3, False)])
def test_spacing_that_is_only_almost_equal(deviation, is_grid):
    """Taken for a grid where no phase could show the difference, else frequency by frequency."""
    noise = np.random.default_rng(0).uniform(-1, 1, 301)
    frequencies = np.linspace(0.1, 100.0, 301) + 100 * deviation * noise
    film = make_film(frequencies=text(frequencies))
    assert (film.step is not None) == is_grid and worst(film) < CYCLES


