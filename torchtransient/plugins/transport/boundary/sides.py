"""Paths on both sides of an edge. Arguments that all functions share are explained in :mod:`.term`."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.transport.strategy import Local
from torchtransient.plugins.transport.walk import start


class BoundaryPass:
    """Base of the passes: edges between two kinds of points of a path, see :mod:`.term`.

    Built once a job. A pass does not hold its :class:`.term.BoundaryTerm`, whose derivatives would outlive the job.
    """

    def __init__(self, context):
        """Prepare the data that launches share."""

    @staticmethod
    def exists(context, sensor):
        """Return True if a job has such edges."""
        raise NotImplementedError

    def run(self, mode, job):
        """Trace the edge samples of a launch.

        Returns:
            In reverse mode the attached objective: sums of events times the film's adjoint, times speeds of edges.
        """
        raise NotImplementedError


def past_edge(context, b, ray, medium, β, sampler, active, seen=False):
    """Return the rays past outlines; for a crease they end at its other face.

    Args:
        b: outlines seen from x.
        ray: ray of the path that led to x, for time and wavelengths.
        seen: x is the sensor, which may see no lights.

    Returns:
        (Ray3f from beside the outline, its leg).
    """
    place = Local(si=dr.zeros(mi.SurfaceInteraction3f), medium=medium, surface=mi.Bool(False))
    past = mi.Ray3f(ray)
    past.o, past.d = dr.select(b.crease, b.V, b.beside), b.d
    leg = context.segment.depart(context, past, place, β, sampler, active & ~b.crease, seen)
    return past, dr.select(b.crease, context.segment.ends_at(b.facing, medium), leg)


def both_sides(context, mode, sampler, view, b, past, first, factor, speeds, needed, lit=None):
    """Trace the two sides of outlines.

    Args:
        view: film block or adjoint block of the samples, see ``mode.view``.
        b: outlines seen from x.
        past: ray past them and its leg, see :func:`past_edge`.
        first: fields of the paths at x: ``ray``, ``medium`` and those of :class:`~..walk.Path`.
        factor: detached weight of a sample.
        speeds: attached (inner, outer).
        needed: masks (inner, outer) of the sides that can have a speed; None where a side has none.
        lit: masks (inner, outer) of the sides whose own emission counts, in full; None: as ``first`` says.

    Returns:
        In reverse mode the attached objective.
    """
    active, ray = first["active"] & dr.isfinite(factor), first.pop("ray")
    factor = dr.select(active, factor, 0)
    near = mi.Ray3f(ray)
    near.o, near.d = b.V, b.d_in
    sides = (near, context.segment.ends_at(b.inner, first["medium"])), past
    fields = {key: value for key, value in first.items() if key != "medium"}
    objective = mi.Float(0)
    for k, ((ray, leg), speed, need) in enumerate(zip(sides, mode.speeds(speeds), needed, strict=True)):
        if need is None:
            continue
        sign = 1 - 2 * k
        path = start(context, ray, mi.Float64(0), 1)
        for key, value in fields.items():
            setattr(path, key, type(getattr(path, key))(value))
        path.leg, path.active = leg, active & need
        if lit is not None:
            path.prev_unconnected = mi.Bool(lit[k])
            path.prev_pdf = dr.select(path.prev_unconnected, mi.Float(1), 0)
        # The same random numbers on both sides.
        value = mode.follow(context, sampler.clone(), path, view, dr.select(need, sign * factor, 0), speed)
        if value is not None:
            in_memory(mode.term.context, None, value)
            with dr.resume_grad():
                objective += value * speed
    return objective


def in_memory(context, sampler, *values):
    """Evaluate the values that speeds are made of, where the sensor moves.

    Each entry of its pose is a sum over lanes by itself, which would trace the paths once more.

    Args:
        sampler: sampler whose state is evaluated as well, or None.
        values: trees of arrays.
    """
    if context.wanted.sensor:
        if sampler is not None:
            sampler.schedule_state()
        dr.eval(values)


def is_seen_within(context, b, ray, end, medium, sampler, active, seen=True):
    """Return a mask of outlines whose inner side is seen from a point, too.

    It is hidden where something in front ends in line with it: then there is one edge, that of the shape in front.

    Args:
        ray: ray for time and wavelengths.
        end: the point, Local with ``p, d, dist``.
        seen: the point is the sensor.
    """
    place = place_at(b.within, ray, medium)
    return context.segment.transmittance(context, place, end, sampler.next_2d(), sampler, active, seen)[0]


def at_point(p, ray=None):
    """Return an Interaction3f without a normal.

    Args:
        p: Point3f.
        ray: ray whose time and wavelengths it takes, or None.
    """
    it = dr.zeros(mi.Interaction3f)
    it.p = p
    if ray is not None:
        it.time, it.wavelengths = ray.time, ray.wavelengths
    return it


def place_at(p, ray, medium):
    """Return a vertex in space, on no surface, which rays of a segment may leave.

    Args:
        p: Point3f.
        ray: ray whose time and wavelengths it takes.
    """
    return Local(at=at_point(p, ray), si=dr.zeros(mi.SurfaceInteraction3f), medium=medium, surface=mi.Bool(False))
