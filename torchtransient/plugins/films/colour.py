"""From a spectral sample to the channels of the film, and back for the adjoint."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.polarized import FrameRotation, rotate_stokes


class ChannelMatch:
    """Linear map from a sample's spectrum to the film's channels, weight of the primary ray included.

    Monochromatic and RGB variants copy the channels; spectral variants integrate against the CIE curves at the ray's
    own wavelengths, or against the film's response curves (see :mod:`.response`), whose weights are evaluated once per
    ray instead of once per event.

    In polarized variants a sample is a Stokes vector in the frame of its ray, and the channels are those of S0, S1, S2,
    S3 one after the other, in the frame of the sensor that ``rotation`` leads to.
    """

    def __init__(self, wavelengths, weight, response=None, rotation=None):
        self.weight = mi.unpolarized_spectrum(weight)
        self.rotation = rotation
        self.matrix = None
        if response is not None:
            self.matrix = [[r * self.weight[k] for r in row] for k, row in enumerate(response.matrix(wavelengths))]
        elif mi.is_spectral:
            self.matrix = []
            for k in range(len(wavelengths)):
                unit = mi.UnpolarizedSpectrum(0)
                unit[k] = 1
                rgb = mi.spectrum_to_srgb(unit, wavelengths)
                self.matrix.append([rgb[c] * self.weight[k] for c in range(3)])

    def to_channels(self, value) -> list:
        """Channel values (list of Float) of what an event contributes."""
        if mi.is_polarized:
            return [c for component in rotate_stokes(value, self.rotation) for c in self._to_channels(component)]
        return self._to_channels(value)

    def to_spectrum(self, channels: list):
        """The transposed map: adjoint of a contribution from adjoint channel values."""
        if mi.is_polarized:
            n = len(channels) // 4
            parts = [self._to_spectrum(channels[n * i : n * (i + 1)]) for i in range(4)]
            return rotate_stokes(mi.SpectrumEntry(*parts), FrameRotation(self.rotation.c, -self.rotation.s))
        return self._to_spectrum(channels)

    def _to_channels(self, value) -> list:
        if self.matrix is None:
            weighted = value * self.weight
            return [weighted[c] for c in range(len(weighted))]
        return [sum(value[k] * row[c] for k, row in enumerate(self.matrix)) for c in range(len(self.matrix[0]))]

    def _to_spectrum(self, channels: list):
        if self.matrix is None:
            result = mi.UnpolarizedSpectrum(0)
            for c, a in enumerate(channels):
                result[c] = a * self.weight[c]
            return result
        result = mi.UnpolarizedSpectrum(0)
        for k, row in enumerate(self.matrix):
            result[k] = sum(a * r for a, r in zip(channels, row, strict=True))
        return result


def mean_of(channels: list):
    """Mean over the channels, those of the power in polarized variants."""
    if mi.is_polarized:
        channels = channels[: len(channels) // 4]
    return dr.sum(channels) / len(channels)
