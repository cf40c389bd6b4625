"""`phasor_hdr_film` by itself: which frequencies it keeps, sums of events against double precision, the adjoint."""

from __future__ import annotations

import warnings

import mitsuba as mi
import numpy as np
import pytest

from support.film_storage import storage
from torchtransient import plugins
from torchtransient.errors import SceneError, TorchTransientWarning

GRID = {"frequency_first": -0.4, "frequency_step": 0.11, "frequency_count": 37}
LIST = {"frequencies": "0, 3.7 -1.25, 0.5, 12.5"}


@pytest.fixture(autouse=True)
def _variant():
    mi.set_variant("llvm_ad_rgb")
    plugins.sync()


def make_film(width=1, height=1, **arguments):
    description = {"type": "phasor_hdr_film", "width": width, "height": height, "rfilter": {"type": "box"}, **arguments}
    with plugins.plugin_errors():
        return mi.load_dict(description)


# ------------------------------------------------------------------------------------------------- frequencies


def test_explicit_frequencies_in_any_form():
    expected = [0.0, 3.7, -1.25, 0.5, 12.5]
    assert make_film(**LIST).frequencies.tolist() == expected
    assert make_film(frequencies=mi.TensorXf(expected)).frequencies == pytest.approx(np.float32(expected))
    film = make_film(**GRID)
    np.testing.assert_array_equal(film.frequencies, -0.4 + 0.11 * np.arange(37))
    assert film.step == pytest.approx(0.11, rel=1e-12) and make_film(**LIST).step is None
    assert film.cube_shape() == (1, 1, 37, 6)


def test_a_list_that_is_a_grid_is_taken_as_one():
    assert make_film(frequencies="0.5 0.75 1.0").step == pytest.approx(0.25)
    assert make_film(frequencies="0.5 0.75 1.000001").step is None
    assert make_film(frequencies="7").step == 0.0


@pytest.mark.parametrize(
    "mean, sigma, bins, width, count",
    [(2.0, 1000.0, 400, 0.01, 3), (0.5, 0.25, 400, 0.01, 17), (1.0, 0.125, 100, 0.05, 26), (0.021, 1.0, 400, 0.01, 6)],
)
def test_bins_of_a_transform(mean, sigma, bins, width, count):
    film = make_film(wl_mean=mean, wl_sigma=sigma, temporal_bins=bins, bin_width_opl=width)
    window = bins * width
    low, high = window / mean - window / (2 * sigma), window / mean + window / (2 * sigma)
    first, last = max(0, int(np.floor(low))), min(bins // 2, int(np.ceil(high)))
    assert len(film.frequencies) == count
    np.testing.assert_allclose(film.frequencies, np.fft.fftfreq(bins, width)[first : last + 1], rtol=1e-14)


def test_defaults_are_the_peers():
    film = make_film()
    window = 4096 * 0.003
    np.testing.assert_allclose(film.frequencies, np.array([0, 1]) / window)
    assert film.start_opl == 0.0


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"frequencies": "1, two"}, "expected numbers"),
        ({"frequencies": "nan"}, "finite"),
        ({"frequencies": "1", "wl_mean": 2.0}, "exclude each other"),
        ({"frequency_first": 1.0}, "is missing"),
        ({**GRID, "frequency_count": 0}, "at least 1"),
        ({"wl_mean": 0.001}, "shortest wavelength"),
    ],
)
def test_bad_parameters(arguments, message):
    with pytest.raises(SceneError, match=message):
        make_film(**arguments)


# --------------------------------------------------------------------------------------------------- adjoint


def test_slope_of_the_adjoint():
    """The derivative of A in the path length, against the formula in double precision."""
    film, rng = make_film(**LIST), np.random.default_rng(4)
    opl, g = rng.uniform(0, 30, 200), rng.normal(size=(film.frequency_count(), 3, 2)).astype(np.float32)
    A, slope = film.read((mi.Float(g.ravel()), 6, 1), mi.UInt32(0), mi.Float64(opl), mi.Bool(True))
    ν = film.frequencies[:, None, None]
    kernel = np.exp(-2j * np.pi * ν * opl)
    weight = (g[..., 0] - 1j * g[..., 1])[..., None]
    np.testing.assert_allclose(np.array(A), (weight * kernel).real.sum(0), atol=2e-5)
    expected = (weight * (-2j * np.pi * ν) * kernel).real.sum(0)
    np.testing.assert_allclose(np.array(slope), expected, atol=2e-6 * np.abs(expected).max())


def test_slopes_are_put_as_they_are_read():
    """Sums of light and of its slope, weighed by an adjoint, are those of the adjoint and its slope at each event."""
    film, rng = make_film(**LIST), np.random.default_rng(5)
    opl, (df, fdtau) = rng.uniform(0, 30, 200), rng.normal(size=(2, 3, 200))
    g = rng.normal(size=(film.frequency_count(), 3, 2))
    cube = storage(film, g.size)
    lists = [mi.Float(row) for row in df], [mi.Float(row) for row in fdtau]
    film.put_slope(0, mi.UInt32(0), mi.Float64(opl), *lists, mi.Bool(True))
    A, slope = film.read((mi.Float(g.ravel()), 6, 1), mi.UInt32(0), mi.Float64(opl), mi.Bool(True))
    expected = (np.array(A) * df + np.array(slope) * fdtau).sum()
    assert (np.array(cube).reshape(g.shape) * g).sum() == pytest.approx(expected, rel=1e-4)


def test_defaults_that_nobody_asked_for_are_said():
    with pytest.warns(TorchTransientWarning, match=r"no frequencies are given.*mitransient's defaults, .* cycles per"):
        mi.load_dict({"type": "phasor_hdr_film"})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mi.load_dict({"type": "phasor_hdr_film", "wl_mean": 100.0})
        mi.load_dict({"type": "phasor_hdr_film", "frequencies": "0.5"})
