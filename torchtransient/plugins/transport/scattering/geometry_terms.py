"""Directions, solid angles and area elements between points that move."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def solid_angle_over_area(p, q, n, active, volume=None):
    """``|cos| / distance^2``, the solid angle at ``p`` of an area at ``q`` with normal ``n``; 1 where inactive. Where
    ``volume``, that of an area across the direction.
    """
    # The inactive side must not see a zero vector: its derivative would be NaN and poison the sum.
    v = dr.select(active, q - p, mi.Vector3f(0, 0, 1))
    d2 = dr.squared_norm(v)
    if volume is not None:
        n = dr.select(volume, dr.normalize(v), n)
    return dr.select(active, dr.abs_dot(n, v) * dr.rsqrt(d2) / d2, 1)


def direction_to(p, q, active, otherwise):
    """Value of ``otherwise`` with the derivative of the direction from ``p`` to ``q`` where active."""
    v = dr.select(active, q - p, mi.Vector3f(0, 0, 1))
    return dr.replace_grad(otherwise, dr.select(active, dr.normalize(v), otherwise))


def distance(p, q, active):
    """Distance from ``p`` to ``q``, 1 where inactive."""
    return dr.norm(dr.select(active, q - p, mi.Vector3f(0, 0, 1)))


def material_point(pi, ray, active):
    """Interaction that follows its shape, and the area element there (up to a constant)."""
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All | mi.RayFlags.FollowShape, active)
    return si, dr.norm(dr.cross(si.dp_du, si.dp_dv))
