"""Lengths that transforms are fast at, and the lines of a transform around a wavelength."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from support.sweeps import together
from torchtransient.axes import fast_length
from torchtransient.errors import SceneError
from torchtransient.transform_bins import transform_bins

SMOOTH = sorted(2**a * 3**b * 5**c for a, b, c in itertools.product(range(13), range(8), range(6)))


@pytest.mark.parametrize("multiple", [1, 2, 7])
def test_the_next_length_of_small_factors(multiple):
    """Beside the list of all products of 2, 3 and 5."""
    for least in (*range(1, 700), 4097, 4375):
        assert fast_length(least, multiple) == next(multiple * n for n in SMOOTH if multiple * n >= least)


@together("bins", [1, 2, 63, 64, 300])
@together("wl_mean, wl_sigma", [(1.1, 0.6), (0.21, 1.0), (100.0, 2.0), (0.35, 0.1)])
def test_lines_around_a_wavelength(bins, wl_mean, wl_sigma):
    """Beside NumPy's frequencies: from the last line below the mean less three sigma to the first one above it."""
    width = 0.1
    mean, half = 1 / wl_mean, 0.5 / wl_sigma
    lines = np.fft.rfftfreq(bins, width)
    step = 1 / (bins * width)
    kept = lines[(lines > mean - half - step * (1 - 1e-9)) & (lines < mean + half + step * (1 - 1e-9))]
    if kept.size == 0:
        with pytest.raises(SceneError, match="shortest wavelength"):
            transform_bins(wl_mean, wl_sigma, bins, width)
        return
    found = transform_bins(wl_mean, wl_sigma, bins, width)
    np.testing.assert_allclose(np.abs(found), kept, rtol=1e-12)
    # The Nyquist frequency is that of a negative line, as in NumPy's list of all.
    assert np.all(np.isin(np.round(found, 9), np.round(np.fft.fftfreq(bins, width), 9)))


@pytest.mark.parametrize(
    "arguments, message",
    [((0.0, 1.0, 64, 0.1), "wl_mean"), ((1.0, -1.0, 64, 0.1), "wl_sigma"), ((1.0, 1.0, 64, np.inf), "bin_width_opl"),
     ((1.0, 1.0, 0, 0.1), "at least 1"), ((1e-3, 1.0, 64, 0.1), "shortest wavelength")],
)  # fmt: skip
def test_errors(arguments, message):
    with pytest.raises(SceneError, match=message):
        transform_bins(*arguments)
