"""Edges between the sensor and the first vertex."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.edges.topology import EDGE
from torchtransient.plugins.polarized import attenuated
from torchtransient.plugins.sensors.seen_from import can_be_connected
from torchtransient.plugins.transport.boundary.sides import (
    BoundaryPass,
    at_point,
    both_sides,
    in_memory,
    is_seen_within,
    past_edge,
    place_at,
)
from torchtransient.plugins.transport.boundary.speeds import behind, sides_from, slides
from torchtransient.plugins.transport.strategy import Local

# Cosine from which on an interpolated normal faces the sensor.
FACING = 1e-3


class PrimaryPass(BoundaryPass):
    """Boundary pass of edges between the sensor and the first vertex: draws an edge point and a pixel that sees it.

    Creases count as well: a point on a camera's ray slides along the ray, and where a face ends under it the light
    jumps.
    """

    @staticmethod
    def exists(context, sensor):
        """Return True if edges can lie there: rays that are drawn from no area meet none."""
        return context.max_depth > 0 and can_be_connected(sensor)

    def run(self, mode, job):
        term = mode.term
        context, edges, sampler = term.context, term.edges, term.sampler(job)
        numbers = term.places.numbers(sampler)
        k = edges.pick(edges.of_moving, sampler.next_1d(), sampler.next_1d())
        # Along parallel rays the point of view depends on what is seen.
        eye, _ = term.places.seen_from(at_point(k.near), numbers, mi.Bool(True))
        b = edges.seen_from(k, mi.Point3f(eye.eye), mi.Bool(True))
        ds, importance = term.places.seen_from(at_point(b.p), numbers, b.valid)
        row, column, weight, inside = term.pixel(ds.uv, sampler.next_2d())
        own, share = mode.rows_in_band(row)
        inside &= own
        row, column = dr.select(inside, row, job.first_row), dr.select(inside, column, 0)
        rays = term.places.rays_at(context, sampler, ds.uv, ds.numbers, row, column, job.total)
        context.start(rays)
        view, ray = mode.view(rays), dr.detach(rays.ray)
        if term.is_meter:
            ray.o = mi.Point3f(eye.p)
        way, active = dr.norm(b.p - ray.o), b.valid & (ds.pdf > 0) & inside
        if term.has_vertex_normals:
            b.inner = where_normals_face(b)
        if context.hide_emitters:
            active &= ~b.inner.shape.is_emitter()
        medium = context.segment.medium_at(context, b.beside, ray.o, context.segment.medium_towards(b.d), active)
        place, to_sensor = place_at(b.beside, ray, medium), Local(p=ray.o, d=-b.d, dist=way)
        u = sampler.next_2d()
        active, T = context.segment.transmittance(context, place, to_sensor, u, sampler, active, seen=True)
        if term.places.is_sharp:  # what is in line with the edge may hide its inside alone
            active &= is_seen_within(context, b, ray, to_sensor, medium, sampler, active)
        factor = importance * b.sin * b.inv_pdf * weight * share
        β = attenuated(mi.Spectrum(1), mi.UnpolarizedSpectrum(T))
        past = past_edge(context, b, ray, medium, β, sampler, active, seen=True)
        held = term.is_meter and not context.wanted.sensor
        needed = mi.Bool(True), mi.Bool(True)
        in_memory(context, sampler, vars(b.k), b.n, b.p, b.dist, way, ds.uv, numbers.aperture, active, factor, β, past)
        with dr.resume_grad():
            if held:  # the first vertex is a point of its shape, see ``Vacuum.from_meter``
                radius = context.contents.damping_radius
                y = behind(context, b, *past, active)
                speeds = sides_from(context, b, edges, mi.Vector3f(0), y, radius, active)
                near = (b.dist < radius) | slides(context, b)
                needed = near, ~b.crease | near
            else:
                moves = edges.moving(b) - rays.ray.o - rays.ray.d * way
                speeds = [dr.select(active, dr.dot(b.n, moves), 0)] * 2
        first = {
            "ray": ray, "β": β, "η": dr.detach(rays.η), "τ": term.integrator.first_opl(term.film, rays),
            "prev_p": ray.o, "active": active, "medium": medium,
        }  # fmt: skip
        if context.velocities is not None:
            first["prev_v"] = context.velocities.of_sensor(ray.o)
        return both_sides(context, mode, sampler, view, b, past, first, factor, speeds, needed)


def where_normals_face(b):
    """Return the inner hit of an outline, moved from its edge to where the interpolated normal faces the sensor.

    Between there and the edge the face is black, a rim that gets as narrow as the faces of the mesh and is taken to
    move with the edge.

    Args:
        b: outlines seen from the sensor.

    Returns:
        PreliminaryIntersection3f.
    """
    u, v = b.inner.prim_uv
    w, ray = 1 - u - v, mi.Ray3f(b.V, b.d_in)
    nearest = dr.minimum(dr.minimum(dr.abs(u), dr.abs(v)), dr.abs(w))
    third = mi.Point2f(dr.select(dr.abs(u) == nearest, 1.0, 0.0), dr.select(dr.abs(v) == nearest, 1.0, 0.0))
    edge = b.valid & ~b.crease & (b.k.kind == EDGE)

    def facing(uv):
        pi = dr.copy(b.inner)
        pi.prim_uv = uv
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, edge)
        return dr.mulsign(dr.dot(si.sh_frame.n, b.d_in), dr.dot(si.n, b.d_in)), pi

    here, _ = facing(b.inner.prim_uv)
    there, _ = facing(third)
    t = dr.minimum((FACING - here) / (there - here), 1)
    moved = edge & (here < FACING) & (there > here)
    return facing(dr.lerp(b.inner.prim_uv, third, dr.select(moved, t, 0)))[1]
