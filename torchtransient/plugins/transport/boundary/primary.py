"""Edges between the sensor and the first vertex."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.polarized import attenuated
from torchtransient.plugins.sensors.origin import can_be_sampled
from torchtransient.plugins.transport.boundary.sides import at_point, both_sides, past_edge
from torchtransient.plugins.transport.boundary.speeds import behind, sides_from, slides
from torchtransient.plugins.transport.strategy import Local


class PrimaryPass:
    """An edge point is drawn, and the pixel that sees it. Creases count, too: a point on a camera's ray slides along
    the ray, and where a face ends under it the light jumps.
    """

    def __init__(self, term):
        self.term = term

    @staticmethod
    def exists(world, sensor):
        """Return whether edges can lie there: rays that are drawn from no area meet none."""
        return world.max_depth > 0 and can_be_sampled(sensor)

    def run(self, mode, job):
        """Trace the samples of ``job``; returns the objective of reverse mode."""
        term = self.term
        world, edges, sampler = term.world, term.seen_edges, term.sampler(job)
        aperture, wavelength = term.numbers_of_sensor(sampler)
        k = edges.pick(edges.by_length, sampler.next_1d(), sampler.next_1d())
        # From a meter the point of view depends on what is seen.
        eye, _ = term.to_sensor.seen_from(at_point(k.near), aperture, mi.Bool(True))
        b = edges.seen_from(k, mi.Point3f(eye.p), mi.Bool(True))
        ds, importance = term.to_sensor.seen_from(at_point(b.p), aperture, b.valid)
        row, column, weight, inside = term.pixel(ds.uv, sampler.next_2d())
        rays = term.rays_at(sampler, ds.uv, wavelength, aperture, row, column, job)
        view, ray = mode.view(rays), dr.detach(rays.ray)
        if term.is_meter:
            ray.o = mi.Point3f(eye.p)
        medium, way = world.segment.medium_towards(b.d), dr.norm(b.p - ray.o)
        place = Local(at=at_point(b.beside, ray), si=dr.zeros(mi.SurfaceInteraction3f), medium=medium, surface=mi.Bool(False))
        to_sensor = Local(p=ray.o, d=-b.d, dist=way)
        active = b.valid & (ds.pdf > 0) & inside
        active, T = world.segment.transmittance(world, place, to_sensor, sampler.next_2d(), sampler, active)
        factor = importance * b.sin * b.inv_pdf * weight
        β = attenuated(mi.Spectrum(1), mi.UnpolarizedSpectrum(T))
        past = past_edge(world, b, ray, medium, β, sampler, active)
        held = term.is_meter and not world.wanted.sensor
        needed = mi.Bool(True), mi.Bool(True)
        with dr.resume_grad():
            if held:  # the first vertex is a point of its shape, see ``Vacuum.from_meter``
                radius = world.contents.damping_radius
                speeds = sides_from(world, b, edges, mi.Vector3f(0), behind(world, b, *past, active), radius, active)
                near = (b.dist < radius) | slides(world, b)
                needed = near, ~b.crease | near
            else:
                moves = edges.moving(b) - rays.ray.o - rays.ray.d * way
                speeds = [dr.select(active, dr.dot(b.n, moves), 0)] * 2
        first = {
            "ray": ray, "β": β, "η": dr.detach(rays.η), "τ": term.integrator.first_opl(term.film, rays),
            "prev_p": ray.o, "active": active, "medium": medium,
        }  # fmt: skip
        return both_sides(world, mode, sampler, view, b, past, first, factor, speeds, needed)
