"""Mueller matrices of smooth interfaces with derivatives that stay finite.

Values and sign conventions are those of ``mitsuba.mueller`` (Verdet's: at normal incidence both amplitudes of a denser
medium have opposite signs; x is perpendicular to the plane of incidence). Mitsuba's own functions go through the phase
and through angles between frames; their derivatives are NaN where an amplitude vanishes (Brewster's angle), where two
frames coincide (every optical bench), and at normal incidence. Here products of amplitudes take the place of roots and
phases, and sines and cosines that of angles.

Source: E. Collett, Field Guide to Polarization, 2005; M. Born and E. Wolf, Principles of Optics, 7th ed., 1.5.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.bsdfs.fresnel import sqrt_with_bounded_slope
from torchtransient.plugins.polarized import rotate_mueller, rotation_between

# A direction whose sine to the normal is below 1e-9 has no plane of incidence.
_SINE_SQUARED_ALONG_NORMAL = 1e-18


class Interface:
    """Amplitudes at a dielectric interface.

    ``cos_theta_i``: cosine between the normal and the direction towards the light's origin; negative inside. ``eta``:
    inside over outside index. Both may be attached.
    """

    def __init__(self, cos_theta_i: Any, eta: Any) -> None:
        outside = cos_theta_i >= 0
        rcp_eta = dr.rcp(eta)
        self.eta_it = dr.select(outside, eta, rcp_eta)
        excess = (eta - 1) * (eta + 1)
        self.d = dr.select(outside, excess, -excess * rcp_eta * rcp_eta)
        self.c = dr.abs(cos_theta_i)
        g2 = self.c * self.c + self.d
        self.total = g2 <= 0
        # eta_it times the cosine of refraction; its imaginary part under total reflection.
        self.g = dr.select(self.total, 0.0, sqrt_with_bounded_slope(dr.select(self.total, 1.0, g2)))
        self.q = dr.select(self.total, sqrt_with_bounded_slope(dr.select(self.total, -g2, 1.0)), 0.0)
        self.m2 = self.d + 1
        # Both sums vanish together, at grazing incidence on an interface that is not there.
        grazing = self.c + self.g < 1e-18
        self.over_s = dr.select(grazing, 0.0, dr.rcp(dr.select(grazing, 1.0, self.c + self.g)))
        self.over_p = dr.select(grazing, 0.0, dr.rcp(dr.select(grazing, 1.0, self.m2 * self.c + self.g)))

    def reflection(self) -> Any:
        """Mueller matrix of reflection in the frames perpendicular to the plane of incidence."""
        r_s = -self.d * self.over_s * self.over_s
        r_p = self.d * (self.c * self.c * (self.m2 + 1) - 1) * self.over_p * self.over_p
        # Under total reflection both amplitudes have modulus one, and their phases differ by twice that of z.
        re, im = self.m2 * self.c * self.c + self.q * self.q, self.q * self.c * (1 - self.m2)
        there = self.total & (re > 0)
        scale = dr.rcp(dr.select(there, re * re + im * im, 1.0))
        cos_d, sin_d = dr.select(there, (re * re - im * im) * scale, 1.0), 2 * re * im * scale
        a = dr.select(self.total, 1.0, 0.5 * (r_s * r_s + r_p * r_p))
        b = dr.select(self.total, 0.0, 0.5 * (r_s * r_s - r_p * r_p))
        c = dr.select(self.total, cos_d, r_s * r_p)
        return two_by_two(a, b, c, sin_d)

    def transmission(self) -> Any:
        """Mueller matrix of refraction, as power through the interface; zero under total reflection."""
        power = 4 * self.c * self.g
        t_s, t_p = power * self.over_s * self.over_s, power * self.m2 * self.over_p * self.over_p
        cross = power * self.eta_it * self.over_s * self.over_p
        return two_by_two(0.5 * (t_s + t_p), 0.5 * (t_s - t_p), cross, mi.Float(0))


def two_by_two(a: Any, b: Any, c: Any, s: Any) -> Any:
    """Mueller matrix of an element with two eigenaxes: ``a, b`` mean and half difference of the powers along them,
    ``c, s`` cosine and sine of the retardance times the geometric mean of the powers.
    """
    o = mi.UnpolarizedSpectrum(0)
    a, b, c, s = (mi.UnpolarizedSpectrum(x) for x in (a, b, c, s))
    return mi.Spectrum(a, b, o, o, b, a, o, o, o, o, c, -s, o, o, s, c)


def across_plane(matrix: Any, normal: Any, wi: Any, wo: Any) -> Any:
    """A matrix between the frames across the plane of incidence, given between Mitsuba's implicit frames instead.

    Light comes along ``-wo`` and leaves along ``wi``; ``normal`` spans the plane with them.
    """
    s_in, s_out = dr.cross(normal, -wo), dr.cross(normal, wi)
    along = (dr.squared_norm(s_in) < _SINE_SQUARED_ALONG_NORMAL) | (dr.squared_norm(s_out) < _SINE_SQUARED_ALONG_NORMAL)
    s_in = dr.select(along, mi.Vector3f(1, 0, 0), s_in)
    s_out = dr.select(along, mi.Vector3f(1, 0, 0), s_out)
    out = rotation_between(wi, s_out, mi.coordinate_system(wi)[0])
    into = rotation_between(-wo, s_in, mi.coordinate_system(-wo)[0])
    return rotate_mueller(matrix, out, into)


def metal_reflection(cos_theta_i: Any, eta: Any, k: Any) -> Any:
    """Reflection from the outside of a medium of complex index ``eta - i k`` (spectra, ``k >= 0``).

    The Mueller matrix in the frames perpendicular to the plane of incidence; in unpolarized variants the reflectance.
    Born and Wolf, 14.2, with the cosine of refraction times the index, ``p = sqrt(n^2 - sin^2)``.
    """
    c = cos_theta_i
    n2_re, n2_im = (eta - k) * (eta + k), -2 * eta * k
    a, b = n2_re - (1 - c * c), n2_im
    modulus = dr.sqrt(dr.maximum(a * a + b * b, 1e-36))
    # The lesser part of the root from their product: the difference under its own root has no digits and no slope left
    # where the index or the absorption is small.
    large = sqrt_with_bounded_slope(0.5 * (modulus + dr.abs(a)))
    small = eta * k / large
    p_re, p_im = dr.select(a < 0, small, large), -dr.select(a < 0, large, small)
    p2 = p_re * p_re + p_im * p_im
    u_re, u_im = n2_re * c, n2_im * c

    over_s = _reciprocal(dr.square(c + p_re) + p_im * p_im)
    s_re, s_im = (c * c - p2) * over_s, -2 * c * p_im * over_s
    over_p = _reciprocal(dr.square(u_re + p_re) + dr.square(u_im + p_im))
    r_re, r_im = (u_re * u_re + u_im * u_im - p2) * over_p, 2 * (u_im * p_re - u_re * p_im) * over_p

    power_s, power_p = s_re * s_re + s_im * s_im, r_re * r_re + r_im * r_im
    mean = 0.5 * (power_s + power_p)
    if not mi.is_polarized:
        return mean
    return two_by_two(mean, 0.5 * (power_s - power_p), r_re * s_re + r_im * s_im, r_im * s_re - r_re * s_im)


def _reciprocal(x: Any) -> Any:
    """One over ``x``, zero where it is zero: a grazing direction on a medium that is not there."""
    there = x > 1e-36
    return dr.select(there, dr.rcp(dr.select(there, x, 1.0)), 0.0)
