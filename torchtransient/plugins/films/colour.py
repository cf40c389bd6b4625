"""From a spectral sample to the channels of the film, and back for the adjoint."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.polarized import FrameRotation, rotate_stokes

# Mitsuba's tables of the CIE 1931 observer: nodes, and their range in nanometres.
_NODES, _FIRST, _LAST = 95, 360.0, 830.0


class StandardObserver:
    """From wavelengths to linear sRGB, as ``mi.spectrum_to_srgb`` does it, off a table of one's own: Mitsuba's is no
    part of any scene, so that a recorded call could not read it.
    """

    def __init__(self) -> None:
        nodes = mi.UnpolarizedSpectrum(dr.linspace(mi.Float, _FIRST, _LAST, _NODES))
        unit = mi.UnpolarizedSpectrum(0)
        unit[0] = 1
        self._tables = [mi.Float(curve) for curve in mi.spectrum_to_srgb(unit, nodes)]
        dr.make_opaque(self._tables)

    @staticmethod
    def of_variant() -> StandardObserver | None:
        """The observer in variants with wavelengths, None in others."""
        return StandardObserver() if mi.is_spectral else None

    def matrix(self, wavelengths) -> list:
        """Per wavelength of a ray the share of each channel."""
        return [self._shares(wavelengths[k]) for k in range(len(wavelengths))]

    def _shares(self, wavelength):
        inside = (wavelength >= _FIRST) & (wavelength <= _LAST)
        x = (wavelength - _FIRST) * ((_NODES - 1) / (_LAST - _FIRST))
        i = dr.clip(mi.UInt32(x), 0, _NODES - 2)
        b = x - mi.Float(i)
        ends = [[dr.gather(mi.Float, table, i + k, inside) for k in (0, 1)] for table in self._tables]
        return [dr.fma(1 - b, low, b * high) for low, high in ends]


class ChannelMatch:
    """Linear map from a sample's spectrum to the film's channels, weight of the primary ray included.

    Monochromatic and RGB variants copy the channels; spectral variants integrate against ``response`` at the ray's own
    wavelengths, once per ray instead of once per event: the film's response curves (:mod:`.response`), or the
    :class:`StandardObserver`.

    In polarized variants a sample is a Stokes vector in the frame of its ray, and the channels are those of S0, S1, S2,
    S3 one after the other, in the frame of the sensor that ``rotation`` leads to.
    """

    def __init__(self, wavelengths, weight, response=None, rotation=None):
        self.weight = mi.unpolarized_spectrum(weight)
        self.rotation = rotation
        self.matrix = None
        if response is not None:
            self.matrix = [[r * self.weight[k] for r in row] for k, row in enumerate(response.matrix(wavelengths))]

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
