"""Measured colour channels: the sensor's response curves over wavelength, one per channel of a film."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import SceneError
from torchtransient.plugins.polarized import attenuated

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
        """Values of the curves (C, N) at wavelengths (N,) in nanometres."""
        values = self._evaluate(mi.UnpolarizedSpectrum(mi.Float(wavelengths)))
        return np.array([np.broadcast_to(np.array(value[0], dtype=float), len(wavelengths)) for value in values])

    def _evaluate(self, wavelengths) -> list:
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wavelengths = wavelengths
        return [mi.unpolarized_spectrum(curve.eval(si)) for curve in self.textures]

    @staticmethod
    def of(props) -> SensorResponse | None:
        """The bands among the properties of a film; None when it has none."""
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
        """Wavelengths (nm) for a uniform number per ray, and the reciprocal of their densities (nm)."""
        shifted = mi.sample_shifted(u)
        wavelengths, weight = mi.UnpolarizedSpectrum(0), mi.UnpolarizedSpectrum(0)
        for k in range(len(shifted)):
            wavelengths[k], pdf = self._density.sample_pdf(shifted[k])
            weight[k] = dr.rcp(pdf)
        return wavelengths, weight

    def matrix(self, wavelengths) -> list:
        """Per wavelength of a ray the share of each channel: the mean over the ray's wavelengths is the channel."""
        values = self._evaluate(wavelengths)
        count = len(wavelengths)
        return [[value[k] * (1 / count) for value in values] for k in range(count)]

    def draw(self, sensor, ray, weight, u):
        """Replace the wavelengths that a sensor drew for a ray from the number ``u``: (ray, weight).

        Raises SceneError for a sensor with a response curve of its own, which would be counted twice.
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
