"""Transmittance of a rough dielectric coating, as tables that carry derivatives by roughness and index.

Mitsuba's ``roughplastic`` has the same tables, computed by the same quadrature outside of its graph.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.bsdfs.fresnel import fresnel, refract
from torchtransient.plugins.bsdfs.microfacet import normal_density, smith_g1_over_cos

ENTRIES = 64
"""Entries of a table, equally spaced in the cosine of the angle of incidence from 0 to 1."""

# Nodes of the quadrature in each of two dimensions: Mitsuba's, of which the edge of total reflection asks for more, and
# those of slopes by roughness, whose integrand has a logarithm in it.
_NODES, _NODES_TOTAL_REFLECTION, _NODES_OF_SLOPES = 32, 128, 96


# Step, in parts of what the index differs from one, of the differences that take the place of a slope where total
# reflection sets in: the slope of Fresnel's equations is infinite there, which no quadrature survives, while the
# integral is smooth. They are good to 0.5 % from alpha 0.02 to 1 and index 1.1 to 2, most of them to 0.1 %.
_STEP = 0.2
# From an index of one to where its slopes are taken.
_ABOVE = 1e-5


def external_transmittance(alpha: Any, eta: Any, ggx: bool) -> Any:
    """Return the fraction of light from outside that a rough interface lets through, by the angle of incidence.

    Light that is scattered more than once by the facets is lost, as in all of Mitsuba's rough plugins.

    Args:
        alpha: roughness, Float, attached or not.
        eta: index inside over outside, Float, attached or not.
        ggx: GGX, else Beckmann.

    Returns:
        Float (:data:`ENTRIES`,), equally spaced in the cosine of the angle.
    """

    def table(alpha: Any, eta: Any) -> Any:
        return _facet_mean(alpha, eta, ggx, transmitted=True)

    return _with_slopes(table, alpha, eta, smooth=_refracts_all(_beside_one(eta)))


def internal_reflectance(alpha: Any, eta: Any, ggx: bool) -> Any:
    """Return the fraction of diffuse light from inside that a rough interface throws back.

    Args:
        alpha: roughness, Float, attached or not.
        eta: index inside over outside, Float, attached or not.
        ggx: GGX, else Beckmann.
    """

    def number(alpha: Any, eta: Any) -> Any:
        return dr.mean(_facet_mean(alpha, dr.rcp(eta), ggx, transmitted=False) * _cosines()) * 2

    return _with_slopes(number, alpha, eta, smooth=not _refracts_all(_beside_one(eta)))


def look_up(table: Any, cos_theta: Any, active: Any) -> Any:
    """Return linear interpolation in a table of :func:`external_transmittance`.

    Args:
        table: Float (:data:`ENTRIES`,).
        cos_theta: cosine of the angle of incidence, 0 to 1.
        active: mask of lanes.
    """
    x = cos_theta * (ENTRIES - 1)
    index = dr.minimum(mi.UInt32(x), ENTRIES - 2)
    below, above = dr.gather(mi.Float, table, index, active), dr.gather(mi.Float, table, index + 1, active)
    return dr.lerp(below, above, x - mi.Float(index))


def _refracts_all(eta: Any) -> bool:
    """Return True if light refracts at every angle on its way to the side whose relative index is ``eta``."""
    return bool(dr.all(eta > 1))


def _beside_one(eta: Any) -> Any:
    """Move an index off exactly one, where its slope would divide by zero; smooth coatings have no limit there."""
    return dr.select(dr.detach(eta) == 1, 1 + _ABOVE, eta)


def _with_slopes(f: Callable[[Any, Any], Any], alpha: Any, eta: Any, smooth: bool) -> Any:
    """Evaluate ``f(alpha, eta)`` with derivatives by attached arguments in forward mode: the graph that remains
    has the size of the result instead of that of the quadrature. ``smooth``: by ``eta`` no difference is needed.
    """
    a, e = dr.detach(alpha), dr.detach(eta)
    value = f(a, e)
    result = value
    if dr.grad_enabled(alpha):
        moving = type(a)(a)
        dr.enable_grad(moving)
        dr.set_grad(moving, 1)
        result = result + dr.forward_to(f(moving, e)) * (alpha - a)
    if dr.grad_enabled(eta):
        e = _beside_one(e)
        if smooth:
            moving = type(e)(e)
            dr.enable_grad(moving)
            dr.set_grad(moving, 1)
            slope = dr.forward_to(f(a, moving))
        else:
            h = _STEP * (e - 1)
            near, far = f(a, e + h) - f(a, e - h), f(a, e + 2 * h) - f(a, e - 2 * h)
            slope = (8 * near - far) / (12 * h)
        result = result + slope * (eta - dr.detach(eta))
    return dr.replace_grad(value, result)


def _cosines() -> Any:
    return dr.maximum(dr.linspace(mi.Float, 0, 1, ENTRIES), 1e-6)


def _facet_mean(alpha: Any, eta: Any, ggx: bool, transmitted: bool) -> Any:
    """Mean over the visible facets of what one of them reflects or transmits, per cosine of the angle of incidence.

    The facets are drawn by Gauss's rule in the random numbers. They are held fixed while the roughness moves and
    weighed by their density instead, since the derivatives of Mitsuba's sampling are not finite everywhere.
    """
    count = _NODES if _refracts_all(eta) else _NODES_TOTAL_REFLECTION
    if dr.grad_enabled(alpha):
        count = max(count, _NODES_OF_SLOPES)
    nodes, weights = (mi.Float(values) for values in mi.quad.gauss_legendre(count))
    pair = dr.arange(mi.UInt32, ENTRIES * count * count)
    which, first, second = pair // (count * count), pair % count, (pair // count) % count
    u = [dr.fma(dr.gather(mi.Float, nodes, i), 0.5, 0.5) for i in (first, second)]
    weight = dr.gather(mi.Float, weights, first) * dr.gather(mi.Float, weights, second) * 0.25
    z = dr.gather(mi.Float, _cosines(), which)
    wi = mi.Vector3f(dr.sqrt(1 - z * z), 0, z)

    kind = mi.MicrofacetType.GGX if ggx else mi.MicrofacetType.Beckmann
    m = mi.Vector3f(mi.MicrofacetDistribution(kind, mi.Float(dr.detach(alpha)), True).sample(wi, mi.Point2f(*u))[0])
    dr.eval(m, wi, weight)  # each sum below is a kernel of its own, and this is the dear part
    terms = fresnel(dr.dot(wi, m), eta)
    if transmitted:
        wo, share = refract(wi, m, terms.cos_theta_t, terms.eta_ti), terms.transmittance
    else:
        wo, share = m * (2 * dr.dot(wi, m)) - wi, terms.reflectance
    leaves = wo.z < 0 if transmitted else wo.z > 0
    seen = dr.select(leaves, smith_g1_over_cos(wo, m, alpha, alpha, ggx) * dr.abs(wo.z) * share, 0)
    if not dr.grad_enabled(alpha):
        return dr.block_sum(seen * weight, count * count)
    # Of the density of visible facets only that of all facets depends on the facet; the rest goes with the norm.
    density = normal_density(m, alpha, alpha, ggx)
    drawn = density > 0
    weight *= dr.select(drawn, dr.relative_grad(dr.select(drawn, density, 1)), 1)
    return dr.block_sum(seen * weight, count * count) / dr.block_sum(weight, count * count)
