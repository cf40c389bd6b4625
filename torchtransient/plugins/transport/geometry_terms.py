"""Directions, solid angles and area elements between points that move."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.transport.strategy import Local
from torchtransient.plugins.transport.surface_interactions import surface_interaction

# Cosines under which a surface is seen edge-on: its points slide along a ray by one over the cosine, which is rounding
# there. What is left out of derivatives is as rare as the cosine is small.
EDGE_ON = 1e-4


def distance(p, q, active):
    """Distance from ``p`` to ``q``, 1 where inactive."""
    return dr.norm(dr.select(active, q - p, mi.Vector3f(0, 0, 1)))


def material_point(pi, ray, active, meshes=None, surfaces=None):
    """Interaction that follows its shape, and the area element there (up to a constant).

    ``meshes`` (PointerTable or None): those that may be met. Their derivatives by texture coordinates change with
    these, or are made up where there are none; the area is that of the triangle. ``surfaces``: as in
    :func:`~.surface_interactions.surface_interaction`.
    """
    si = surface_interaction(surfaces, pi, ray, mi.RayFlags.All | mi.RayFlags.FollowShape, active)
    area = dr.cross(si.dp_du, si.dp_dv)
    if meshes is not None:
        with dr.suspend_grad():
            on_mesh = active & meshes.lists(si.shape)
        mesh = mi.MeshPtr(dr.select(on_mesh, si.shape, dr.zeros(mi.ShapePtr)))
        a, b, c = (mesh.vertex_position(i, on_mesh) for i in mesh.face_indices(pi.prim_index, on_mesh))
        sides = b - a, c - a
        if surfaces is not None:
            sides = (surfaces.to_world(si.instance, side) for side in sides)
        area = dr.select(on_mesh, dr.cross(*sides), area)
    return si, dr.norm(dr.select(active, area, mi.Vector3f(0, 0, 1)))


def slide_on_shape(pi, ray, drag, active):
    """Return the changes of a point that slides on its shape, held in place, as ``ray`` is shifted by ``drag``: ``uv,
    n`` and ``sh_n``, the shading normal, each zero with the derivative.
    """
    shifted = mi.Ray3f(ray)
    shifted.o = shifted.o + dr.select(active, drag, 0)
    # The difference, since the normal of a face that moves stays attached, whatever the flags say.
    here, there = (
        pi.compute_surface_interaction(r, mi.RayFlags.All | mi.RayFlags.DetachShape, active) for r in (ray, shifted)
    )
    uv, n, sh_n = there.uv - here.uv, there.n - here.n, there.sh_frame.n - here.sh_frame.n
    return Local(uv=displacement(uv, active), n=displacement(n, active), sh_n=displacement(sh_n, active))


def displacement(p, active):
    """Zero with the derivative of the point or vector ``p`` where active."""
    zero = dr.zeros(mi.Point2f if dr.size_v(p) == 2 else mi.Vector3f)
    return dr.select(active, dr.replace_grad(zero, type(zero)(p)), zero)


def slide(drag, d, n, active):
    """Return the displacement of the point that a ray in direction ``d`` finds on a surface of normal ``n`` when it is
    shifted by ``drag``, across its direction.
    """
    cos = dr.dot(n, d)
    return drag - d * (dr.dot(n, drag) * dr.select(active & (dr.abs(cos) > EDGE_ON), dr.rcp(cos), 0))


class DampedMotion(Local):
    """Motion of a connection to a point that follows its vertex: direction ``d`` (attached), ``J`` (one, with the
    derivative of the solid angle), ``drag`` (zero, with how far the ray to the point is shifted sideways).
    """

    def slide(self, n):
        """Zero with the derivative of the point, on a surface with normal ``n``, held in place."""
        return self.drag - self.fixed * dr.dot(n, self.drag) * self.per_cos

    def longer(self, n=None):
        """Zero with the derivative of the length: what is due to the vertex, and with ``n`` to the slide of the point.
        """
        if n is None:
            return -dr.dot(self.δ, self.fixed)
        return -dr.dot(self.δ, self.stays * self.fixed + (1 - self.stays) * self.per_cos * n)

    def of_material(self, n, area):
        """The part of ``J`` that is due to the normal ``n`` and the element ``area`` (one, attached) of a material
        point: as far as it does not slide.
        """
        tilt = dr.dot(dr.replace_grad(mi.Vector3f(0), mi.Vector3f(n)), self.fixed) * self.per_cos
        return 1 + self.stays * (area - 1 + tilt)


def damped_motion(δ, d, r, n, active, radius, nailed=None, volume=None):
    """The direction ``d`` to a point at distance ``r`` on a surface of normal ``n``, when its vertex moves by ``δ``
    against it.

    Far away the direction moves by ``-δ_perp / r``. In corners and gaps that has no bounded variance. Nearer than
    ``radius`` the point is dragged along with the vertex by a share ``a``, and the direction moves by

        -W δ_perp,    W = (1 - a) / r,    a = (1 - s^2)^2,    s = r / radius,

    so that ``W`` and ``r W'`` are bounded and do not jump. The solid angle changes by the divergence of that field,

        r W' (n.δ / n.d - d.δ) + 2 W d.δ.

    ``nailed``: where the point never slides and the measure is no area: that of a point light. ``volume``: where the
    point lies in a volume. Its distance is a coordinate of its own there, ``W`` is the same in all directions, and the
    divergence is ``2 W d.δ``.
    """
    near = r < radius
    if nailed is not None:
        near &= ~nailed
    inv_radius = dr.select(near, dr.rcp(radius), 0)
    s = dr.select(near, r * inv_radius, 1)
    s2 = dr.square(s)
    scale = dr.select(active & (r > 0), dr.select(near, s * inv_radius, dr.rcp(r)), 0)
    W, slope = (2 - s2) * scale, (2 - 3 * s2) * scale
    for unbound in (nailed, volume):
        if unbound is not None:
            slope = dr.select(unbound, 0, slope)
    cos = dr.dot(n, d)
    per_cos = dr.select(active & (dr.abs(cos) > EDGE_ON), dr.rcp(cos), 0)
    along = dr.dot(δ, d)
    across = dr.select(active, δ - d * along, mi.Vector3f(0))
    J = 1 + dr.dot(δ, dr.select(active, slope * per_cos * n + (2 * W - slope) * d, mi.Vector3f(0)))
    stays = W * r
    drag = (1 - stays) * across
    return DampedMotion(d=d - W * across, J=J, drag=drag, δ=δ, fixed=d, stays=stays, per_cos=per_cos)
