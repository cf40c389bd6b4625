"""The adjoint of `phasor_hdr_film` by itself: phases of grids and lists after long paths, arrivals read together."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from torchtransient import plugins
from torchtransient.plugins.films import phasor_sums
from torchtransient.plugins.films.colour import ChannelMatch

LENGTHS = [0.0, 0.37, 12.125, 731.0625, 1000.0 + 1 / 3, 4.1e4]
CYCLES = 1e-6
GRID = {"frequency_first": -0.4, "frequency_step": 0.11, "frequency_count": 37}
LIST = {"frequencies": "0, 3.7 -1.25, 0.5, 12.5"}


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


@pytest.mark.parametrize("count", [1, 2, 17, 1025])
def test_phases_of_a_grid(count):
    film = make_film(frequency_first=0.1, frequency_step=99.9 / 1024, frequency_count=count)
    assert film.step is not None and worst(film) < CYCLES


def test_a_grid_on_both_sides_of_zero():
    film = make_film(frequency_first=-50.0, frequency_step=1 / 3, frequency_count=301)
    assert film.step is not None and worst(film) < CYCLES


def test_phases_that_are_never_set_anew_drift_away(monkeypatch):
    """Without a phase in double precision every 16 frequencies the bound above does not hold."""
    film = make_film(frequency_first=0.1, frequency_step=99.9 / 1024, frequency_count=1025)
    monkeypatch.setattr(phasor_sums, "STEPS", 2000)
    assert worst(film) > 5 * CYCLES


@pytest.mark.parametrize("deviation, is_grid", [(5e-15, True), (1e-12, False), (1e-9, False), (1e-3, False)])
def test_spacing_that_is_only_almost_equal(deviation, is_grid):
    """Taken for a grid where no phase could show the difference, else frequency by frequency."""
    noise = np.random.default_rng(0).uniform(-1, 1, 301)
    frequencies = np.linspace(0.1, 100.0, 301) + 100 * deviation * noise
    film = make_film(frequencies=text(frequencies))
    assert (film.step is not None) == is_grid and worst(film) < CYCLES


# -------------------------------------------------------------------------------------------- arrivals together


def adjoint_block(film, pixels, rng):
    """The block of some lanes, and the adjoint of the film."""
    g = rng.normal(size=(pixels, film.frequency_count(), 2)).astype(np.float32)
    base = dr.arange(mi.UInt32, pixels) * (2 * film.frequency_count())
    match = ChannelMatch(mi.Spectrum(0), mi.Spectrum(1))
    return film.create_adjoint_block((mi.Float(g.ravel()), 2, 1), base, [mi.Float(0)], match), g


@pytest.mark.parametrize("frequencies", [GRID, LIST], ids=["grid", "list"])
@pytest.mark.parametrize("with_slope", [False, True])
def test_arrivals_together_are_arrivals_alone(frequencies, with_slope):
    film, rng, n = make_film(**frequencies), np.random.default_rng(0), 40
    block, _ = adjoint_block(film, n, rng)
    opls = [mi.Float64(rng.uniform(0, 1000, n)) for _ in range(5)]
    active = mi.Bool(rng.random(n) > 0.2)
    A, slope = block.read_together(opls, with_slope, active)
    assert (slope is None) == (not with_slope)
    for e, opl in enumerate(opls):
        alone, slope_alone = film.read(block.response, block.base, opl, active)
        np.testing.assert_array_equal(np.array(A[e][0]), np.array(alone[0]))
        if with_slope:
            np.testing.assert_array_equal(np.array(slope[e][0]), np.array(slope_alone[0]))


@pytest.mark.parametrize("count", [1, 2, 3, 37, 301])
def test_arrivals_together_are_the_transpose_of_put(count):
    film = make_film(frequency_first=0.3, frequency_step=0.21, frequency_count=count)
    rng, n = np.random.default_rng(1), 64
    block, g = adjoint_block(film, n, rng)
    opl, value = rng.uniform(0, 300, (6, n)), rng.normal(size=(6, n))
    A, _ = block.read_together([mi.Float64(o) for o in opl], False, mi.Bool(True))
    right = sum((np.array(a[0], dtype=np.float64) * v).sum() for a, v in zip(A, value, strict=True))
    phasors = (value[..., None] * np.exp(-2j * np.pi * film.frequencies * opl[..., None])).sum(0)
    left = (phasors.real * g[..., 0] + phasors.imag * g[..., 1]).sum()
    assert left == pytest.approx(right, abs=2e-6 * np.sqrt(6 * n * count))


def test_how_many_are_read_together():
    """As many as there is room for sums, one at least; none ahead where nothing is to be read."""
    film, rng = make_film(**GRID), np.random.default_rng(2)
    block, _ = adjoint_block(film, 1, rng)
    assert block.together(100, False) == phasor_sums.MOST_ARRIVALS and block.together(3, False) == 3
    film.channel_count = lambda: 12
    assert block.together(100, False) * 12 <= phasor_sums.SUMS < (block.together(100, False) + 1) * 12
    assert block.together(100, True) * 24 <= phasor_sums.SUMS < (block.together(100, True) + 1) * 24
    film.channel_count = lambda: 100
    assert block.together(100, True) == 1
    block.response = None
    assert block.together(100, False) == 0
