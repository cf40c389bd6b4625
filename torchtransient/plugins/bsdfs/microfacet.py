"""Microfacet distributions with derivatives that stay finite: normal density, Smith masking and the half vector.

The values are those of ``mitsuba.MicrofacetDistribution``. Its derivatives are not usable everywhere: ``0 * inf`` at
normal incidence (Beckmann masking), at half vectors in the surface's plane and at grazing directions.

References: B. Walter et al. 2007, Microfacet Models for Refraction through Rough Surfaces; E. Heitz 2014, Understanding
the Masking-Shadowing Function in Microfacet-Based BRDFs.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

ALPHA_MIN = 1e-3
"""Smallest roughness. Below it the density exceeds 3e5 and single precision no longer resolves the lobe."""

# mitsuba.MicrofacetDistribution.eval drops densities whose product with the cosine is below this.
_DENSITY_FLOOR = 1e-20

# Beyond this argument exp(-x) is below 2e-20: the density is dropped anyway, and its derivative would be 0 * inf.
_BECKMANN_CUTOFF = 45.0


def normal_density(m: Any, alpha_u: Any, alpha_v: Any, ggx: bool) -> Any:
    """Return the density of microfacet normals per solid angle.

    Its integral times ``m.z`` over the hemisphere is one.

    Args:
        m: unit normal of the facet in the shading frame, ``m.z >= 0``.
        alpha_u, alpha_v: roughness along both tangents.
        ggx: GGX, else Beckmann.
    """
    slope2 = dr.square(m.x / alpha_u) + dr.square(m.y / alpha_v)
    z2 = m.z * m.z
    if ggx:
        total = slope2 + z2
        density = dr.rcp(dr.pi * alpha_u * alpha_v * total * total)
    else:
        visible = slope2 < _BECKMANN_CUTOFF * z2
        z2 = dr.select(visible, z2, 1.0)
        slope2 = dr.select(visible, slope2, 0.0)
        density = dr.select(visible, dr.exp(-slope2 / z2) / (dr.pi * alpha_u * alpha_v * z2 * z2), 0.0)
    return dr.select(density * m.z > _DENSITY_FLOOR, density, 0.0)


def smith_g1_over_cos(v: Any, m: Any, alpha_u: Any, alpha_v: Any, ggx: bool) -> Any:
    """Return Smith's masking of a direction divided by ``|v.z|``, which stays finite along the surface.

    Zero where ``v`` sees the facet and the surface from two sides.

    Args:
        v: unit direction in the shading frame.
        m: unit normal of the facet.
        alpha_u, alpha_v: roughness along both tangents.
        ggx: GGX, else Beckmann.
    """
    xy2 = dr.square(alpha_u * v.x) + dr.square(alpha_v * v.y)
    z = dr.abs(v.z)
    z_above = dr.select(z > 0, z, 1.0)
    slanted = xy2 > 0
    xy2 = dr.select(slanted, xy2, 1.0)
    if ggx:
        result = 2.0 / (z + dr.sqrt(z * z + xy2))
    else:
        # Walter's rational fit of the masking, a = 1 / (alpha tan(theta)); no masking from a = 1.6 on.
        rcp_width = dr.rsqrt(xy2)
        a = z * rcp_width
        masked = slanted & (a < 1.6)
        a = dr.select(masked, a, 1.0)
        fit = rcp_width * (3.535 + 2.181 * a) / (1 + a * (2.276 + 2.577 * a))
        result = dr.select(masked, fit, dr.rcp(z_above))
    result = dr.select(slanted, result, dr.rcp(z_above))
    return dr.select(dr.dot(v, m) * v.z > 0, result, 0.0)


def half_vector(wi: Any, wo: Any, weight: Any) -> tuple[Any, Any]:
    """Return the unit vector along ``wi + weight * wo``, turned to the side of ``+z``, and a mask where it is defined.

    It is undefined where the sum vanishes, as it does for straight transmission through an interface of index one.

    Args:
        wi, wo: unit directions away from the surface.
        weight: 1 for reflection, the relative index in the direction of travel for refraction.
    """
    h = mi.Vector3f(wi + wo * weight)
    h2 = dr.squared_norm(h)
    defined = h2 > 1e-13
    h = dr.select(defined, h, mi.Vector3f(0, 0, 1)) * dr.rsqrt(dr.select(defined, h2, 1.0))
    return dr.select(h.z < 0, -h, h), defined
