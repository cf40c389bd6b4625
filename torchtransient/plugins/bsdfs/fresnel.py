"""Fresnel's equations of glass and of metals, as amplitudes and as Mueller matrices."""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.polarized import rotate_mueller, rotation_between

# ----------------------------------------------------------------------------------------------------------------------
# Fresnel equations of a smooth dielectric interface, written so that values and derivatives keep their digits.
# The textbook amplitudes are differences of nearly equal numbers when the index approaches one, and their derivative
# is the difference of two large ones. With ``c = |cos(theta_i)|``, ``m`` the relative index in the direction of
# travel, ``d = m^2 - 1`` and ``g = m cos(theta_t) = sqrt(c^2 + d)`` the differences can be taken exactly by hand:
#
#     r_s = (c - g) / (c + g)           = -d / (c + g)^2
#     r_p = (m^2 c - g) / (m^2 c + g)   =  d (c^2 (m^2 + 1) - 1) / (m^2 c + g)^2
#     T_s = 4 c g / (c + g)^2,     T_p = 4 m^2 c g / (m^2 c + g)^2
#
# ``d`` itself is ``(eta - 1)(eta + 1)``, free of cancellation from either side of the interface.
#
# References: M. Born and E. Wolf, Principles of Optics, section 1.5; conventions of ``mitsuba.fresnel``.

# Below this value of c + g both cosines vanish, which only an index of exactly one can cause: the smallest other
# representable |eta - 1| leaves g above 2e-8 in double and 3e-4 in single precision.
_BOTH_GRAZING = 1e-8

# The slope 1 / (2 g) of g = sqrt(c^2 + d) is infinite at the critical angle: below this g it keeps its value of 5e5.
_MIN_ROOT_IN_SLOPE = 1e-6


class FresnelTerms(NamedTuple):
    """Fresnel terms of unpolarised light at an interface, one entry per direction."""

    reflectance: Any
    """Reflected fraction of the power, in [0, 1]."""
    transmittance: Any
    """Transmitted fraction, ``1 - reflectance`` without the rounding of that difference."""
    cos_theta_t: Any
    """Signed cosine of the refracted direction, opposite in sign to that of the incident one; 0 in total reflection."""
    eta_it: Any
    """Relative index in the direction of travel: the refracted side's over the incident side's."""
    eta_ti: Any
    """Reciprocal of ``eta_it``."""


def fresnel(cos_theta_i: Any, eta: Any) -> FresnelTerms:
    """Return the unpolarised Fresnel terms of a dielectric interface, differentiable in both arguments.

    Derivatives are finite everywhere: zero in total internal reflection, clamped within 1e-6 of the critical angle's
    cosine (where the true slope diverges), and exact to rounding as ``eta`` goes to one. At ``eta == 1`` the interface
    is invisible even at grazing incidence. Complex indices and polarised amplitudes are not supported here.

    Args:
        cos_theta_i: cosine between the normal and the direction towards the light's origin; negative inside.
        eta: index of the inside over that of the outside, > 0.
    """
    outside = cos_theta_i >= 0
    c = dr.abs(cos_theta_i)
    rcp_eta = dr.rcp(eta)
    eta_it = dr.select(outside, eta, rcp_eta)
    eta_ti = dr.select(outside, rcp_eta, eta)

    excess = (eta - 1) * (eta + 1)
    d = dr.select(outside, excess, -excess * rcp_eta * rcp_eta)
    m2 = d + 1

    g2 = c * c + d
    total = g2 <= 0
    g = dr.select(total, 0.0, sqrt_with_bounded_slope(dr.select(total, 1.0, g2)))

    invisible = c + g < _BOTH_GRAZING
    rcp_s = dr.rcp(dr.select(invisible, 1.0, c + g))
    rcp_p = dr.rcp(dr.select(invisible, 1.0, m2 * c + g))
    r_s = d * rcp_s * rcp_s
    r_p = d * (c * c * (m2 + 1) - 1) * rcp_p * rcp_p
    cg = 2 * c * g

    reflectance = dr.select(total, 1.0, (r_s * r_s + r_p * r_p) * 0.5)
    transmittance = dr.select(total, 0.0, cg * (rcp_s * rcp_s + m2 * rcp_p * rcp_p))
    reflectance = dr.select(invisible & (eta == 1), 0.0, reflectance)
    transmittance = dr.select(invisible & (eta == 1), 1.0, transmittance)

    cos_theta_t_abs = g * eta_ti
    cos_theta_t = dr.select(outside, -cos_theta_t_abs, cos_theta_t_abs)
    return FresnelTerms(reflectance, transmittance, cos_theta_t, eta_it, eta_ti)


def sqrt_with_bounded_slope(x: Any) -> Any:
    """Return the square root, with a slope that stays finite at zero.

    Args:
        x: Float >= 0, attached or not.
    """
    root = dr.sqrt(dr.detach(x))
    return dr.replace_grad(root, x * (0.5 / dr.maximum(root, _MIN_ROOT_IN_SLOPE)))


def refract(wi: Any, normal: Any, cos_theta_t: Any, eta_ti: Any) -> Any:
    """Return the refracted direction of ``wi`` at a facet.

    Args:
        wi: direction away from the surface, towards the light's origin, unit vector.
        normal: unit normal of the facet.
        cos_theta_t, eta_ti: signed cosine of the refracted direction and reciprocal relative index, see
            :class:`FresnelTerms`.
    """
    return normal * (dr.dot(wi, normal) * eta_ti + cos_theta_t) - wi * eta_ti


# ---------------------------------------------- mueller matrices of smooth interfaces with derivatives that stay finite
# Values and sign conventions are those of ``mitsuba.mueller`` (Verdet's: at normal incidence both amplitudes of a
# denser medium have opposite signs; x is perpendicular to the plane of incidence). Mitsuba's own functions go through
# the phase and through angles between frames; their derivatives are NaN where an amplitude vanishes (Brewster's angle),
# where two frames coincide (every optical bench), and at normal incidence. Here products of amplitudes take the place
# of roots and phases, and sines and cosines that of angles.
#
# Source: E. Collett, Field Guide to Polarization, 2005; M. Born and E. Wolf, Principles of Optics, 7th ed., 1.5.

# A direction whose sine to the normal is below 1e-9 has no plane of incidence.
_SINE_SQUARED_ALONG_NORMAL = 1e-18


class Interface:
    """Amplitudes at a dielectric interface.

    Args:
        cos_theta_i: cosine between the normal and the direction towards the light's origin; negative inside. May be
            attached.
        eta: inside over outside index. May be attached.
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
        """Return the Mueller matrix of reflection in the frames perpendicular to the plane of incidence."""
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
        """Return the Mueller matrix of refraction, as power through the interface; zero under total reflection."""
        power = 4 * self.c * self.g
        t_s, t_p = power * self.over_s * self.over_s, power * self.m2 * self.over_p * self.over_p
        cross = power * self.eta_it * self.over_s * self.over_p
        return two_by_two(0.5 * (t_s + t_p), 0.5 * (t_s - t_p), cross, mi.Float(0))


def two_by_two(a: Any, b: Any, c: Any, s: Any) -> Any:
    """Return the Mueller matrix of an element with two eigenaxes.

    Args:
        a, b: mean and half difference of the powers along them.
        c, s: cosine and sine of the retardance, times the geometric mean of the powers.
    """
    o = mi.UnpolarizedSpectrum(0)
    a, b, c, s = (mi.UnpolarizedSpectrum(x) for x in (a, b, c, s))
    return mi.Spectrum(a, b, o, o, b, a, o, o, o, o, c, -s, o, o, s, c)


def across_plane(matrix: Any, normal: Any, wi: Any, wo: Any) -> Any:
    """Convert a matrix between the frames across the plane of incidence to one between Mitsuba's implicit frames.

    Light comes along ``-wo`` and leaves along ``wi``.

    Args:
        matrix: Mueller matrix.
        normal: vector that spans the plane of incidence with the directions.
        wi, wo: unit directions away from the surface, in the local frame.
    """
    s_in, s_out = dr.cross(normal, -wo), dr.cross(normal, wi)
    along = (dr.squared_norm(s_in) < _SINE_SQUARED_ALONG_NORMAL) | (dr.squared_norm(s_out) < _SINE_SQUARED_ALONG_NORMAL)
    s_in = dr.select(along, mi.Vector3f(1, 0, 0), s_in)
    s_out = dr.select(along, mi.Vector3f(1, 0, 0), s_out)
    out = rotation_between(wi, s_out, mi.coordinate_system(wi)[0])
    into = rotation_between(-wo, s_in, mi.coordinate_system(-wo)[0])
    return rotate_mueller(matrix, out, into)


def metal_reflection(cos_theta_i: Any, eta: Any, k: Any) -> Any:
    """Return the reflection from the outside of a medium of complex index ``eta - i k``.

    Born and Wolf, 14.2, with the cosine of refraction times the index, ``p = sqrt(n^2 - sin^2)``.

    Args:
        cos_theta_i: cosine between the normal and the direction towards the light's origin, >= 0.
        eta, k: index and absorption by channel, ``k >= 0``.

    Returns:
        The Mueller matrix in the frames perpendicular to the plane of incidence; in unpolarized variants the
        reflectance.
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
    """Return 1 / x, zero at zero: a grazing direction where both indices are equal."""
    there = x > 1e-36
    return dr.select(there, dr.rcp(dr.select(there, x, 1.0)), 0.0)
