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
    """Return the distance between points, metres, 1 where inactive.

    Args:
        p, q: Point3f, attached or not.
        active: mask of lanes.
    """
    return dr.norm(dr.select(active, q - p, mi.Vector3f(0, 0, 1)))


def material_point(pi, ray, active, meshes=None, surfaces=None):
    """Return hits as material points, which follow their shapes.

    Args:
        pi: PreliminaryIntersection3f of the hits.
        ray: Ray3f that found them.
        active: mask of lanes.
        meshes: PointerTable of the meshes that may be met, or None. Their derivatives by texture coordinates change
            with these, or are made up where there are none: the area is that of the triangle.
        surfaces: attached surfaces of the job's context, None where Mitsuba's own derivatives are right.

    Returns:
        (SurfaceInteraction3f; area element, Float, up to a constant).
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


def point_of_light(context, ref, ds, active):
    """Trace a ray to the point of a light, whose shape the hit knows.

    Args:
        context: :class:`~.context.RenderContext` of the job.
        ref: Interaction3f that the light is seen from.
        ds: the point, with ``p`` and ``emitter`` of a DirectionSample3f.
        active: mask of lanes.

    Returns:
        (ray, PreliminaryIntersection3f, mask of rays that find the light, normal of the face there).
    """
    with dr.suspend_grad():
        # Towards the point itself: a ray in direction ``ds.d`` leaves from beside ``ref``, and passes beside the point.
        ray = ref.spawn_ray_to(ds.p)
        ray.maxt = dr.inf
        pi = context.segment.next_surface(context, ray, active)
        there = active & pi.is_valid()
        found = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, there)
        return ray, pi, there & (found.emitter(context.scene) == ds.emitter), found.n


def slide_on_shape(pi, ray, drag, active):
    """Return how a hit that slides on its shape, held in place, changes as its ray is shifted.

    Args:
        pi: PreliminaryIntersection3f of the hit.
        ray: Ray3f that found it.
        drag: shift of the ray, Vector3f.
        active: mask of lanes.

    Returns:
        ``uv``, ``n`` and ``sh_n`` (shading normal), each zero with the derivative.
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
    """Return zero with the derivative of a point or vector.

    Args:
        p: Point3f, Vector3f or Point2f.
        active: mask of lanes; zero without a derivative elsewhere.
    """
    zero = dr.zeros(mi.Point2f if dr.size_v(p) == 2 else mi.Vector3f)
    return dr.select(active, dr.replace_grad(zero, type(zero)(p)), zero)


def slide(drag, d, n, active):
    """Return how a hit slides on its surface when its ray is shifted across: ``drag - d (n.drag) / (n.d)``.

    Args:
        drag: shift of the ray, Vector3f.
        d, n: direction of the ray, normal at the hit.
        active: mask of lanes.
    """
    cos = dr.dot(n, d)
    return drag - d * (dr.dot(n, drag) * dr.select(active & (dr.abs(cos) > EDGE_ON), dr.rcp(cos), 0))


class DampedMotion(Local):
    """Motion of a segment to a point that follows its vertex, by :func:`damped_motion`.

    Attributes:
        d: direction, attached.
        J: one, with the relative derivative of the solid angle.
        drag: zero, with the sideways shift of the ray to the point.
        stays: ``1 - a``, the share of the motion that the point does not follow.
    """

    def slide(self, n):
        """Return zero with the derivative of the point on a surface with normal ``n``, held in place."""
        return self.drag - self.fixed * dr.dot(n, self.drag) * self.per_cos

    def longer(self, n=None):
        """Return zero with the derivative of the length, due to the vertex alone.

        Args:
            n: normal of the point's surface, to add the length that its slide brings.
        """
        if n is None:
            return -dr.dot(self.δ, self.fixed)
        return -dr.dot(self.δ, self.stays * self.fixed + (1 - self.stays) * self.per_cos * n)

    def of_material(self, n, area):
        """Return the factor of ``J`` that is due to a material point, as far as it does not slide.

        Args:
            n: attached normal at the point.
            area: one, with the relative derivative of its area element.
        """
        tilt = dr.dot(dr.replace_grad(mi.Vector3f(0), mi.Vector3f(n)), self.fixed) * self.per_cos
        return 1 + self.stays * (area - 1 + tilt)


def damped_motion(δ, d, r, n, active, radius, nailed=None, volume=None):
    """Return the motion of a segment of length ``r`` whose vertex moves by ``δ`` against its end.

    Far away the direction moves by ``-δ_perp / r``. In corners and gaps that has no bounded variance. Nearer than
    ``radius`` the point is dragged along with the vertex by a share ``a``, and the direction moves by

        -W δ_perp,    W = (1 - a) / r,    a = (1 - s^2)^2,    s = r / radius,

    so that ``W`` and ``r W'`` are bounded and do not jump. The solid angle changes by the divergence of that field,

        r W' (n.δ / n.d - d.δ) + 2 W d.δ.

    In a volume the distance of the point is a coordinate of its own, ``W`` is the same in all directions, and the
    divergence is ``2 W d.δ``.

    Args:
        δ: displacement of the vertex, Vector3f: zero, with the derivative.
        d, r: direction and distance of the point, metres.
        n: normal of its surface.
        active: mask of lanes.
        radius: damping radius, metres.
        nailed: mask of points that never slide, whose measure is no area: those of point lights; None for none.
        volume: mask of points in a volume, None for none.
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
