"""Frequencies that a phasor film of mitransient keeps of a Fourier transform. Without Mitsuba: files have them too."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from torchtransient.errors import SceneError


def transform_bins(wl_mean: float, wl_sigma: float, bins: int, width: float) -> NDArray[np.float64]:
    """Return the frequencies of a discrete Fourier transform within three sigma of ``1 / wl_mean``.

    Follows mitransient 1.3, which includes the Nyquist frequency with its negative sign for even ``bins``.

    Args:
        wl_mean: wavelength of the mean frequency, metres.
        wl_sigma: wavelength of the standard deviation of the frequencies, metres.
        bins: number of bins of the transform.
        width: width of a bin, metres.

    Returns:
        Cycles per metre, (F,) float64.

    Raises:
        SceneError: for lengths that are not positive, no bins, and bands beyond the shortest wavelength of the bins.
    """
    for name, value in (("wl_mean", wl_mean), ("wl_sigma", wl_sigma), ("bin_width_opl", width)):
        if not (math.isfinite(value) and value > 0):
            raise SceneError(f"phasor_hdr_film: {name} must be a positive length in metres, got {value}.")
    if bins < 1:
        raise SceneError(f"phasor_hdr_film: temporal_bins must be at least 1, got {bins}.")
    window = bins * width
    mean, sigma = window / wl_mean, window / (6 * wl_sigma)
    first, last = max(0, math.floor(mean - 3 * sigma)), min(bins // 2, math.ceil(mean + 3 * sigma))
    if first > last:
        raise SceneError(
            f"phasor_hdr_film: wl_mean = {wl_mean} m lies beyond the shortest wavelength of {bins} bins of {width} m, "
            f"{2 * width} m; use narrower bins or give frequencies."
        )
    index = np.arange(first, last + 1)
    frequencies: NDArray[np.float64] = np.where((index == bins // 2) & (bins % 2 == 0), -index, index) / window
    return frequencies
