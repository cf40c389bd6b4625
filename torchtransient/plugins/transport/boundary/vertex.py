"""Edges between two vertices of a path."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.mitsuba_shapes import is_sphere
from torchtransient.plugins.polarized import attenuated, product
from torchtransient.plugins.sensors.seen_from import sees_one_line
from torchtransient.plugins.transport.boundary.sides import BoundaryPass, both_sides, in_memory, past_edge
from torchtransient.plugins.transport.boundary.specular import attached_ray
from torchtransient.plugins.transport.boundary.speeds import (
    along_the_ray,
    behind,
    dragged,
    interior_displacement,
    sides_from,
    slides,
)
from torchtransient.plugins.transport.geometry_terms import displacement
from torchtransient.plugins.transport.scene_contents import DAMPING
from torchtransient.plugins.transport.strategy import Local, Proposal
from torchtransient.plugins.transport.walk import advance, first_leg, start

# Edges that one is chosen from, which costs no rays.
CANDIDATES = 8
# Probability of the last vertex, which only sees the rims of near lights.
_SELDOM = 0.1


class VertexPass(BoundaryPass):
    """Boundary pass of edges between two vertices of a path.

    It traces a path to a vertex x, chosen uniformly of those that may have one after them. An edge point seen from
    there is chosen of several candidates in proportion to its span over the squared distance (resampling, Talbot et al.
    2005). Vertices behind the edge are points of their shapes, so that only outlines matter, and of them the outer
    side, but for surfaces near x that are dragged along, lights included. Lights past edges are found by the pass of
    the lights, or here where paths of lights do not find the sensor.
    """

    @staticmethod
    def exists(context, sensor):
        """Return True if paths have two vertices."""
        at_last = context.finds_light and (sees_one_line(sensor) or _has_lights_with_rims(context))
        return context.max_depth > (1 if at_last else 2)

    def run(self, mode, job):
        term = mode.term
        context, edges = term.context, term.edges
        finds_light = context.finds_light and sees_one_line(term.sensor)
        rays = term.integrator.start(context.scene, context.contents, term.sensor, term.film, job)
        context.start(rays)
        view, sampler, ray = mode.view(rays), rays.sampler, dr.detach(rays.ray)
        target, inv_pmf = self._target(context, sampler.next_1d(), finds_light)
        path = start(context, ray, term.integrator.first_opl(term.film, rays), dr.detach(rays.η))
        path.leg = first_leg(context, sampler, ray, rays.leg)
        pi, _ = context.segment.surface_of(path.leg)
        radius = dr.minimum(context.contents.damping_radius, pi.t * DAMPING) if context.segment.drags else mi.Float(0)
        lead = None
        if term.chains is None:
            path, before = advance(context, sampler, path, target)
        else:
            lead = term.chains.lead(context, path, sampler, target)
            path, before = lead.path, lead.before
        vertex = context.segment.arrive(context, path)
        vertex.τ, vertex.η, vertex.goes_on = path.τ + vertex.opl, path.η, path.active & vertex.valid
        context.scattering.arrive(context, path, vertex, sampler)
        x, n = mi.Point3f(vertex.at.p), dr.select(vertex.surface, mi.Vector3f(vertex.si.n), 0)

        def worth(d, dist, crease):
            falls = dr.select(vertex.surface, dr.abs_dot(n, d), 1) / dr.maximum(dr.square(dist), 1e-12)
            return dr.select(~crease | (dist < radius), falls, 0)

        at = context.segment.surface_of(path.leg)
        k = edges.choose(edges.by_length, sampler, x, at, vertex.goes_on, CANDIDATES, worth)
        b = edges.seen_from(k, x, vertex.goes_on)
        near = (b.dist < radius) | slides(context, b)
        b.valid &= ~b.crease | near
        # Asked for as a connection asks.
        asked = Proposal(d=b.d, active=b.valid, ds=Local(emitter=None))
        (answer,), _ = context.scattering.scatter(context, path, vertex, [asked], sampler)
        τ, η = vertex.delay.after(vertex.τ), vertex.η * answer.eta
        β = product(vertex.β, dr.select(b.valid, answer.matrix, 0))
        most = dr.max(dr.abs(mi.unpolarized_spectrum(β)))
        end = Local(p=b.beside, d=dr.normalize(b.beside - x), dist=dr.norm(b.beside - x))
        active = b.valid & (most > 0) & dr.isfinite(most)
        active, T = context.segment.transmittance(context, vertex, end, sampler.next_2d(), sampler, active)
        factor = most * inv_pmf * b.sin * b.inv_pdf / dr.square(b.dist)
        # A throughput that is handed to roulette is no larger than one.
        β = attenuated(β, mi.UnpolarizedSpectrum(T) * dr.select(most > 0, dr.rcp(most), 0))
        β = dr.select(active, β, 0)
        medium = context.segment.medium_at(context, b.beside, x, context.segment.medium_towards(b.d, vertex), active)
        past = past_edge(context, b, path.ray, medium, β, sampler, active)
        edge_state = vars(b.k), b.n, b.p, b.dist, b.crease, b.inner, b.facing
        path_state = before, path.ray, path.prev_p, at, target, radius, vertex.at.p, vertex.at.n, τ, η
        lead_state = None if lead is None else (lead.all, lead.ratios, path.prev_unconnected)
        in_memory(context, sampler, edge_state, path_state, lead_state, past, active, factor, β)
        with dr.resume_grad():
            v_x = self._motion(context, rays, path, before, lead, target, vertex, radius, active)
            speeds = sides_from(context, b, edges, v_x, behind(context, b, *past, active), radius, active)
        first = {
            "ray": path.ray, "β": β, "η": η, "τ": τ, "prev_p": x, "prev_n": vertex.at.n,
            "depth": target + 1, "active": active, "medium": medium,
        }  # fmt: skip
        if context.velocities is not None:
            context.velocities.arrive(context, path, vertex)
            first |= {"rate": vertex.rate, "prev_v": vertex.velocity}
        lit = None
        if context.finds_light:  # Elsewhere a density of zero leaves out emission.
            dragged_along = b.dist < radius
            lit = finds_light | (dragged_along & self._is_dragged(context, b.inner.shape))
            lit = lit, finds_light | (dragged_along & b.crease & self._is_dragged(context, b.facing.shape))
        stays = not context.segment.drags and context.contents.sliding is None
        needed = (None, mi.Bool(True)) if stays else (near, ~b.crease | near)
        return both_sides(context, mode, sampler, view, b, past, first, factor, speeds, needed, lit)

    def _target(self, context, u, finds_light):
        """Return (number of a vertex, one over its probability).

        The last vertex, which only has emission after it, is chosen rarely where only lights with rims need it.
        """
        if finds_light:
            count = context.max_depth - 1
            return dr.minimum(mi.UInt32(u * count), count - 1), mi.Float(count)
        count, seldom = context.max_depth - 2, _SELDOM
        if not _has_lights_with_rims(context):
            return dr.minimum(mi.UInt32(u * count), count - 1), mi.Float(count)
        if count == 0:
            return dr.zeros(mi.UInt32, dr.width(u)), mi.Float(1)
        last = u < seldom
        number = dr.minimum(mi.UInt32((u - seldom) * (count / (1 - seldom))), count - 1)
        return dr.select(last, mi.UInt32(count), number), dr.select(last, 1 / seldom, count / (1 - seldom))

    def _is_dragged(self, context, shape):
        """Return a mask of lights whose derivatives drag near points along with the vertex that sees them."""
        mask = shape.is_emitter()
        if context.wanted.sphere_lights:
            mask &= ~context.contents.sphere_lights.marks.lists(shape.emitter())
        return mask

    def _motion(self, context, rays, path, before, lead, target, vertex, radius, active):
        """Return the attached displacement of x, as interior derivatives hold it."""
        at_first = target == 0
        pi, _ = context.segment.surface_of(path.leg)
        surface, first = active & vertex.surface, active & at_first
        primary = mi.Ray3f(path.ray)
        primary.o = dr.select(at_first, rays.ray.o, path.ray.o)
        primary.d = dr.select(at_first, rays.ray.d, path.ray.d)
        held = interior_displacement(context, pi, path.ray, surface)
        # Of the vertex before, its own drag is left out.
        pi_before, ray_before = before
        camera = mi.Ray3f(ray_before)
        second = target == 1
        camera.o, camera.d = dr.select(second, rays.ray.o, ray_before.o), dr.select(second, rays.ray.d, ray_before.d)
        if rays.meter_normal is None:
            v_before = dr.select(
                second,
                along_the_ray(context, pi_before, camera, active & second),
                interior_displacement(context, pi_before, ray_before, active & (target > 1)),
            )
            follows = surface & ~at_first
        else:
            v_before = interior_displacement(context, pi_before, ray_before, active & (target > 0))
            follows = surface
        r = dr.norm(vertex.at.p - path.prev_p)
        v = dragged(held, v_before, r, path.ray.d, vertex.si.n, radius, follows)
        if rays.meter_normal is None:
            v = dr.select(at_first, along_the_ray(context, pi, primary, first & vertex.surface), v)
        if lead is not None:
            # Behind delta lobes a point slides along the ray that found it.
            found = surface & path.prev_unconnected & ~at_first
            last, bent = mi.Ray3f(path.ray), attached_ray(context, rays.ray, lead.ratios, target, found & lead.all)
            last.o = dr.select(lead.all, dr.replace_grad(last.o, bent.o), last.o)
            last.d = dr.select(lead.all, dr.replace_grad(last.d, bent.d), last.d)
            v = dr.select(found, along_the_ray(context, pi, last, found), v)
        if context.contents.media is None:
            return dr.select(active, v, 0)
        # A point in a medium divides the way to the surface behind it in a fixed ratio.
        share = context.segment.share_of_surface(path.leg)
        inside = along_the_ray(context, pi, primary, active & ~vertex.surface) * share
        inside += displacement(primary.o, first) * (1 - share)
        return dr.select(active, dr.select(vertex.surface, v, inside), 0)


def _has_lights_with_rims(context):
    """Return True if paths find area lights other than spheres."""
    return context.finds_light and any(
        mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface) and not is_sphere(emitter.get_shape())
        for emitter in context.scene.emitters()
    )
