"""Speeds of edges against the samples that interior derivatives hold.

On a line of sight from x past an edge point p to y, with s = |p - x| / |y - x|, the edge moves across by

    v_in = n . (v_p - v(p)),    v_out = n . (v_p - (1 - s) v_x - s v(y)),

where v(y) is how the interior derivative moves a sample at y: as a material point, by v_y
(:meth:`~..strategy.Segment.material_displacement`), which near x is dragged along by a share a of the motion of x:
v(y) = (1 - a) v_y + a v_x. On the inner side v_p is the motion of the surface itself, and nothing is left of it but the
drag. A point on a ray that is held, as the first one of a camera, slides along it, which n does not see.

Arguments that all functions share are explained in :mod:`.term`.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.transport.geometry_terms import displacement, slide
from torchtransient.plugins.transport.strategy import Local
from torchtransient.plugins.transport.surface_interactions import surface_interaction


def dragged_share(r, radius):
    """Return the share ``a`` of :func:`~..geometry_terms.damped_motion` at a distance.

    Args:
        r: distance from the vertex before, metres.
        radius: damping radius, metres.
    """
    return dr.select(r < radius, dr.square(1 - dr.square(r / radius)), 0)


def sides_from(context, b, edges, v_x, y, radius, active):
    """Return the speeds of both sides of outlines, ``v_in`` and ``v_out`` above, attached.

    Args:
        b: outlines seen from x.
        v_x: attached displacement of x.
        y: point behind: ``dist`` from x (infinite for none) and attached displacement ``v``, see :func:`behind`.
        radius: damping radius, metres.
    """
    n_x, n_p = dr.dot(b.n, v_x), dr.dot(b.n, edges.moving(b))
    held = n_p if context.contents.sliding is None else dr.select(slides(context, b), 0, n_p)
    n_y = dr.select(b.crease, n_p, dr.dot(b.n, y.v))
    s = dr.select(b.crease, 1, dr.select(dr.isfinite(y.dist), b.dist / y.dist, 0))
    near, far = dragged_share(b.dist, radius), dragged_share(dr.select(b.crease, b.dist, y.dist), radius)
    inner = n_p - near * n_x - (1 - near) * held
    outer = n_p - (1 - s) * n_x - s * (far * n_x + (1 - far) * n_y)
    return [dr.select(active, speed, 0) for speed in (inner, outer)]


def slides(context, b):
    """Return a mask of outlines of shapes without material points.

    Args:
        context: :class:`~..context.RenderContext` of the job.
        b: outlines.
    """
    table = context.contents.sliding
    return mi.Bool(False) if table is None else table.lists(b.inner.shape)


def behind(context, b, ray, leg, active):
    """Return the point behind outlines, with ``dist`` and ``v`` as :func:`sides_from` takes them.

    Args:
        b: outlines seen from x.
        ray, leg: ray past them, and its leg, see :func:`.sides.past_edge`.
    """
    t, found = context.segment.length_of(leg)
    pi, on_surface = context.segment.surface_of(leg)
    dist = dr.select(found, dr.norm(ray.o - b.V) + t, dr.inf)
    held = active & found & on_surface & ~b.crease
    return Local(dist=dist, v=context.segment.material_displacement(context, pi, ray, held))


def dragged(v_x, v_before, r, d, n, radius, active):
    """Return the displacement of a material point that is dragged along by the vertex before it.

    Args:
        v_x: displacement of the point as a material point.
        v_before: displacement of the vertex before.
        r: distance of both, metres.
        d: direction of the ray between them.
        n: normal at the point.
        radius: damping radius, metres.
    """
    δ = v_before - v_x
    return v_x + dr.select(active, dragged_share(r, radius) * slide(δ - d * dr.dot(d, δ), d, n, active), 0)


def along_the_ray(context, pi, ray, active):
    """Return the displacement of the place where a ray meets a surface.

    Args:
        pi: PreliminaryIntersection3f of the surface.
        ray: Ray3f, attached or not.
    """
    si = surface_interaction(context.surfaces, pi, ray, mi.RayFlags.All, active & pi.is_valid())
    return displacement(si.p, active & pi.is_valid())


def interior_displacement(context, pi, ray, active):
    """Return the displacement with which interior derivatives move a vertex.

    That of a material point, or along the ray for shapes without material points.

    Args:
        pi: PreliminaryIntersection3f of the vertex.
        ray: Ray3f that found it.
    """
    v = context.segment.material_displacement(context, pi, ray, active)
    if context.contents.sliding is None:
        return v
    slid = active & context.contents.sliding.lists(pi.shape)
    return dr.select(slid, along_the_ray(context, pi, ray, slid), v)
