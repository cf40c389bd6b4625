"""From a spectral sample to the channels of a film and back: the standard observer, or a sensor's response curves."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import SceneError
from torchtransient.plugins.polarized import FrameRotation, attenuated, rotate_stokes

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
        """Return the observer in variants with wavelengths, None in others."""
        return StandardObserver() if mi.is_spectral else None

    def matrix(self, wavelengths) -> list:
        """Return for each wavelength of a ray the share of each channel.

        Args:
            wavelengths: wavelengths, nanometres.
        """
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
    wavelengths, once per ray instead of once per event: the film's response curves (:class:`SensorResponse`), or
    the :class:`StandardObserver`.

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
        """Return the channel values of an event's contribution, list of Float.

        Args:
            value: spectrum, in polarized variants a Stokes vector.
        """
        if mi.is_polarized:
            return [c for component in rotate_stokes(value, self.rotation) for c in self._to_channels(component)]
        return self._to_channels(value)

    def to_spectrum(self, channels: list):
        """Return the transposed map: adjoint of a contribution from adjoint channel values."""
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
    """Return the mean over channels, in polarized variants over those of the power.

    Args:
        channels: Float each; in polarized variants those of all Stokes components, the power first.
    """
    if mi.is_polarized:
        channels = channels[: len(channels) // 4]
    return dr.sum(channels) / len(channels)


# The density that wavelengths are drawn from is tabulated; curves finer than this are covered by its floor.
MAX_NODES = 4096
MIN_NODES = 65
# Share of the highest density that every wavelength within reach has at least: a curve that is not zero between two
# nodes of the table is still met.
FLOOR = 1e-2


def _is_curve(props, name) -> bool:
    kinds = mi.Properties.Type
    if props.type(name) != kinds.Object:
        return props.type(name) == kinds.Spectrum
    # A look counts as use; what is not ours stays as it was, so that Mitsuba still reports misspelt parameters.
    used = props.was_queried(name)
    found = isinstance(props[name], mi.Texture)
    props.mark_queried(name, used or found)
    return found


class SensorResponse:
    """Response curves of a film's channels, and the wavelengths that are drawn for them.

    Children of the film that are spectra are its bands, under the names they have there, as in Mitsuba's ``specfilm``.
    Channel c of the film is the integral over wavelength in nanometres of radiance times curve c; the curves are not
    normalised. Wavelengths are drawn in proportion to the sum of the curves.

    ``of(props)`` raises SceneError for bands in a variant without wavelengths, and for curves that are negative or zero
    everywhere.
    """

    def __init__(self, curves: dict):
        self.names = tuple(curves)
        self.textures = list(curves.values())
        low, high = math.inf, -math.inf
        resolution = math.inf
        for curve in self.textures:
            a, b = curve.wavelength_range()
            low, high = min(low, float(a)), max(high, float(b))
            step = float(curve.spectral_resolution())
            resolution = min(resolution, step) if step > 0 else resolution
        self.range = (low, high)
        count = min(max(MIN_NODES, math.ceil((high - low) / resolution) + 1), MAX_NODES)
        self._density = mi.ContinuousDistribution(mi.ScalarVector2f(low, high), mi.Float(self._node_density(count)))
        self.sensors = []

    def _node_density(self, count: int) -> np.ndarray:
        total = np.zeros(count)
        for name, values in zip(self.names, self.tabulate(np.linspace(*self.range, count)), strict=True):
            if not np.all(np.isfinite(values)) or values.min() < 0 or values.max() == 0:
                raise SceneError(
                    f"film: the response curve {name!r} must be finite, nowhere negative and not zero everywhere, got "
                    f"values between {values.min():g} and {values.max():g}."
                )
            total += values / values.max()
        return np.maximum(total, FLOOR * total.max())

    def tabulate(self, wavelengths: np.ndarray) -> np.ndarray:
        """Return the values of the curves at wavelengths, (C, N).

        Args:
            wavelengths: wavelengths, (N,), nanometres.
        """
        values = self._evaluate(mi.UnpolarizedSpectrum(mi.Float(wavelengths)))
        return np.array([np.broadcast_to(np.array(value[0], dtype=float), len(wavelengths)) for value in values])

    def _evaluate(self, wavelengths) -> list:
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wavelengths = wavelengths
        return [mi.unpolarized_spectrum(curve.eval(si)) for curve in self.textures]

    @staticmethod
    def from_properties(props) -> SensorResponse | None:
        """Return the bands among the properties of a film; None when it has none."""
        names = [name for name in list(props.keys()) if _is_curve(props, name)]
        if not names:
            return None
        if not mi.is_spectral:
            raise SceneError(
                f"film: the response curves {', '.join(names)} need a variant that carries wavelengths, such as "
                f"llvm_ad_spectral; the active one is {mi.variant()}. Load the scene with variant='llvm_ad_spectral' "
                "or take the curves out."
            )
        return SensorResponse({name: props.get_unbounded_texture(name) for name in names})

    def sample(self, u):
        """Draw the wavelengths of rays in proportion to the curves.

        Args:
            u: uniform number per ray, Float.

        Returns:
            (wavelengths, reciprocals of their densities), both in nanometres.
        """
        shifted = mi.sample_shifted(u)
        wavelengths, weight = mi.UnpolarizedSpectrum(0), mi.UnpolarizedSpectrum(0)
        for k in range(len(shifted)):
            wavelengths[k], pdf = self._density.sample_pdf(shifted[k])
            weight[k] = dr.rcp(pdf)
        return wavelengths, weight

    def matrix(self, wavelengths) -> list:
        """Return for each wavelength of a ray the share of each channel, of which the mean is taken.

        Args:
            wavelengths: wavelengths, nanometres.
        """
        values = self._evaluate(wavelengths)
        count = len(wavelengths)
        return [[value[k] * (1 / count) for value in values] for k in range(count)]

    def draw(self, sensor, ray, weight, u):
        """Replace the wavelengths that a sensor drew for a ray.

        Args:
            sensor: the sensor.
            ray: ray of the sensor, which is changed.
            weight: weight of the ray.
            u: the number that its wavelengths were drawn from, Float.

        Returns:
            (ray, weight).

        Raises:
            SceneError: for a sensor with a response curve of its own, which would be counted twice.
        """
        self._check(sensor)
        _, drawn = mi.sample_rgb_spectrum(mi.sample_shifted(u))
        wavelengths, own = self.sample(u)
        ray.wavelengths = wavelengths
        return ray, attenuated(weight, own / mi.UnpolarizedSpectrum(drawn))

    def _check(self, sensor):
        if sensor.ptr in self.sensors:
            return
        u = mi.Float(0.25)
        ray, _ = sensor.sample_ray(0.0, u, mi.Point2f(0.5), mi.Point2f(0.5))
        expected, _ = mi.sample_rgb_spectrum(mi.sample_shifted(u))
        found = np.array(ray.wavelengths, dtype=float).ravel()
        if not np.allclose(found, np.array(expected, dtype=float).ravel(), rtol=1e-5):
            raise SceneError(
                "film: the sensor has a response curve (srf) of its own, and its film has some too; expected one of "
                "them. Take the srf out of the sensor."
            )
        self.sensors.append(sensor.ptr)
