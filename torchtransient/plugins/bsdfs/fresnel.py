"""Fresnel equations of a smooth dielectric interface, written so that values and derivatives keep their digits.

The textbook amplitudes are differences of nearly equal numbers when the index approaches one, and their derivative
is the difference of two large ones. With ``c = |cos(theta_i)|``, ``m`` the relative index in the direction of
travel, ``d = m^2 - 1`` and ``g = m cos(theta_t) = sqrt(c^2 + d)`` the differences can be taken exactly by hand:

    r_s = (c - g) / (c + g)           = -d / (c + g)^2
    r_p = (m^2 c - g) / (m^2 c + g)   =  d (c^2 (m^2 + 1) - 1) / (m^2 c + g)^2
    T_s = 4 c g / (c + g)^2,     T_p = 4 m^2 c g / (m^2 c + g)^2

``d`` itself is ``(eta - 1)(eta + 1)``, free of cancellation from either side of the interface.

References: M. Born and E. Wolf, Principles of Optics, section 1.5; conventions of ``mitsuba.fresnel``.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr

# Below this value of c + g both cosines vanish, which only an index of exactly one can cause: the smallest other
# representable |eta - 1| leaves g above 2e-8 in double and 3e-4 in single precision.
_BOTH_GRAZING = 1e-8

# The slope 1 / (2 g) of g = sqrt(c^2 + d) is infinite at the critical angle: below this g it keeps its value of 5e5.
_MIN_ROOT_IN_SLOPE = 1e-6


class FresnelTerms(NamedTuple):
    """What happens to unpolarised light at an interface, one entry per direction."""

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
    """Unpolarised Fresnel terms of a dielectric interface, differentiable in both arguments.

    ``cos_theta_i``: cosine between the normal and the direction towards the light's origin; negative inside.
    ``eta``: index of the inside over that of the outside, > 0.

    Derivatives are finite everywhere: zero in total internal reflection, clamped within 1e-6 of the critical angle's
    cosine (where the true slope diverges), and exact to rounding as ``eta`` goes to one. At ``eta == 1`` the interface
    is invisible even at grazing incidence. Complex indices and polarised amplitudes are not supported here.
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
    root = dr.sqrt(dr.detach(x))
    return dr.replace_grad(root, x * (0.5 / dr.maximum(root, _MIN_ROOT_IN_SLOPE)))


def refract(wi: Any, normal: Any, cos_theta_t: Any, eta_ti: Any) -> Any:
    """Refracted direction of ``wi`` (pointing away from the surface) at a facet with the given unit ``normal``."""
    return normal * (dr.dot(wi, normal) * eta_ti + cos_theta_t) - wi * eta_ti
