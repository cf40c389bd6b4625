"""Lines of a transform around a wavelength."""

from __future__ import annotations

import numpy as np
import pytest

from support.sweeps import together
from torchtransient.errors import SceneError
from torchtransient.plugins.films.transform_bins import transform_bins


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
