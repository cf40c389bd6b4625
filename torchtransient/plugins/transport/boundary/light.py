"""Edges between the last vertex of a path and a light."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.edges.table import BESIDE
from torchtransient.plugins.polarized import attenuated
from torchtransient.plugins.sensors.seen_from import FAR, can_be_connected
from torchtransient.plugins.transport.boundary.sides import BoundaryPass, at_point, in_memory, is_seen_within, place_at
from torchtransient.plugins.transport.boundary.specular import attached_ray, ratios_of
from torchtransient.plugins.transport.boundary.speeds import along_the_ray, dragged_share
from torchtransient.plugins.transport.emitter_connections import EmitterSampled
from torchtransient.plugins.transport.geometry_terms import EDGE_ON, displacement, material_point
from torchtransient.plugins.transport.strategy import Local
from torchtransient.plugins.transport.walk import start, walk

# Distance past an edge, in parts of the largest coordinate, up to which a surface touches it: ten times as far as paths
# pass beside edges.
CONTACT = 10 * BESIDE
# Distance between an edge and a line of sight, in the same unit, up to which they are taken to touch: rays leave
# surfaces at ten times BESIDE.
_IN_LINE = 20
_STEEP = 10.0


class LightPass(BoundaryPass):
    """Boundary pass of edges between the last vertex of a path and a light.

    It draws an edge point p and a point y of a light, and follows a path behind p, on its shadow, to the sensor: a walk
    with one connection (:class:`~..light_tracing.SensorSampled`). Its first vertex x is held on the ray of the camera
    where it is connected at once (``direct``), and is a point of its shape where it goes on.
    """

    def __init__(self, context):
        self.lights = EmitterSampled()
        with dr.resume_grad():
            self.lights.prepare(context)
        delta = mi.EmitterFlags.DeltaPosition | mi.EmitterFlags.DeltaDirection
        self.is_sharp = any(mi.has_flag(emitter.flags(), delta) for emitter in context.scene.emitters())

    @staticmethod
    def exists(context, sensor):
        """Return True if there are lights and a sensor that can be connected to."""
        return context.max_depth > 1 and len(context.scene.emitters()) > 0 and can_be_connected(sensor)

    def run(self, mode, job):
        term = mode.term
        context, edges, sampler, lit = term.context, term.edges, term.sampler(job), term.light_context
        k = edges.pick(edges.by_length, sampler.next_1d(), sampler.next_1d())
        numbers = term.places.numbers(sampler)
        middle = term.places.rays_at(context, sampler, term.places.middle(numbers), numbers, total=job.total)
        lit.start(middle)
        # Nothing attached is kept that forward mode, which follows the speeds, would run into.
        middle.ray, middle.weight, middle.η = dr.detach((middle.ray, middle.weight, middle.η))
        ray = mi.Ray3f(middle.ray)
        light = self._light(term, edges, k, ray, sampler.next_2d())
        b, ds = light.b, light.ds
        most = dr.max(dr.abs(light.Le))
        active = b.valid & (most > 0) & dr.isfinite(most) & ~b.crease
        medium = context.segment.medium_at(context, b.beside, ray.o, context.segment.medium_towards(b.d), active)
        place, far = place_at(b.beside, ray, medium), light.far
        to_light = Local(p=dr.select(far, b.p + ds.d * ds.dist, ds.p), d=-b.d, dist=dr.select(far, ds.dist, b.dist))
        active, T = context.segment.transmittance(context, place, to_light, sampler.next_2d(), sampler, active)
        if self.is_sharp:  # what is in line with the edge may hide its inside alone
            active &= is_seen_within(context, b, ray, to_light, medium, sampler, active, seen=False)
        factor = dr.select(active, -most * b.sin * b.inv_pdf, 0)
        factor = dr.select(dr.isfinite(factor), factor, 0)
        ray.o, ray.d = b.beside, b.d
        τ = mi.Float64(0)
        if context.contents.distant is not None:
            τ = mi.Float64(dr.select(light.far, context.contents.distant.length(b.p, -b.d), 0))
        term.to_sensor.numbers = numbers
        through = term.through
        if through is not None:
            through.set(term.chains.draw(sampler.next_1d()), numbers, dr.detach(middle.η))
        path = start(lit, ray, τ - term.film.start_opl, dr.detach(middle.η))
        path.prev_p = dr.select(light.far, b.p, b.V)
        if context.velocities is not None:
            seen = Local(p=ds.p, emitter=ds.emitter)
            path.prev_v = context.velocities.of_sampled_light(context, at_point(b.beside, ray), seen, active & ~far)
        β = light.Le * mi.UnpolarizedSpectrum(T) * dr.select(most > 0, dr.rcp(most), 0)
        path.β, path.active = attenuated(mi.Spectrum(1), dr.select(active, β, 0)), active
        path.leg = lit.segment.depart(lit, ray, place, path.β, sampler, active)
        x = lit.segment.arrive(lit, path)
        # What touches the edge is uncovered for the light and for the vertex before at once, which counts it.
        touches = dr.dot(x.at.p - b.p, b.d) < CONTACT * (1 + dr.max(dr.abs(b.p)))
        path.active = active = active & ~touches
        term.to_sensor.in_line = None
        if self.is_sharp and term.places.is_sharp:
            term.to_sensor.in_line = self._in_line(term, edges, light, x, ray, medium, numbers, sampler, active)
        edge_state, path_state = (vars(b.k), b.n, b.p, b.dist), (x.at.p, x.si.n, path.leg, path.β, path.τ, ray)
        chain_state = None if through is None else vars(through.chain)
        in_memory(context, sampler, edge_state, path_state, chain_state, active, factor, numbers.aperture)
        with dr.resume_grad():
            speeds = self._speeds(term, edges, light, x, path, ray, numbers, sampler, active)
        u = sampler.next_2d()
        sink, factors = mode.sink_of_pixels(middle, job, u, factor, speeds)
        _, state = walk(lit, sampler, path, sink)
        return mode.sum_of_pixels(state, factors)

    def _in_line(self, term, edges, light, x, ray, medium, numbers, sampler, active):
        """Return where the sensor sees the shadow at x past the edge itself.

        The result is that of :attr:`~..light_tracing.SensorSampled.in_line`. A ray to the sensor would let rounding
        decide, once more than in the pass of the sensor. That one sees past the edge either what the light reaches, or
        the shadow: where it is not lit, the edge of the shadow is in view.
        """
        context, b, ds = term.context, light.b, light.ds
        scale = BESIDE * (1 + dr.max(dr.abs(b.p)))
        seen, _ = term.places.seen_from(x.at, numbers, active)
        off = dr.norm(dr.cross(b.p - seen.p, mi.Vector3f(seen.d)))
        near = active & x.surface & (seen.pdf > 0) & (off < _IN_LINE * scale) & (dr.norm(x.at.p - b.p) < seen.dist)
        outline = edges.seen_from(b.k, mi.Point3f(seen.eye), near)
        near &= outline.valid & ~outline.crease
        to_sensor = Local(p=seen.p, d=-outline.d, dist=dr.norm(outline.p - seen.p))
        place = place_at(outline.beside, ray, medium)
        free, _ = context.segment.transmittance(context, place, to_sensor, sampler.next_2d(), sampler, near, seen=True)
        past = mi.Ray3f(ray)
        past.o, past.d = outline.beside, outline.d
        si = context.segment.next_surface(context, past, near).compute_surface_interaction(past, mi.RayFlags.All, near)
        behind = Local(at=si, si=si, medium=medium, surface=mi.Bool(True))
        to_light = Local(p=dr.select(light.far, si.p + ds.d * ds.dist, ds.p), d=ds.d, dist=ds.dist)
        near_surface = near & si.is_valid()
        lit, _ = context.segment.transmittance(context, behind, to_light, sampler.next_2d(), sampler, near_surface)
        # Across the line of the light, on the surface.
        n, N = mi.Vector3f(b.n), mi.Vector3f(x.si.n)
        along = dr.clip(dr.dot(n, N) / dr.dot(b.d, N), -_STEEP, _STEEP)
        step = dr.select(near, (n - b.d * along) * (2 * _IN_LINE * scale), 0)
        return Local(near=near, shown=free & ~lit, step=step)

    def _light(self, term, edges, k, ray, u):
        """Return a point of a light drawn from the edge ``k``, and the outline seen from there.

        ``ds, b, far, Le`` (emission over the density per solid angle at the edge), ``near, u`` (what it was drawn
        from).
        """
        context = term.context
        near = at_point(k.near, ray)
        ds, weight = self.lights.sample(context, near, u, mi.Bool(True))
        far = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
        y = dr.select(far, k.near + ds.d * (FAR * term.radius), ds.p)
        b = edges.seen_from(k, mi.Point3f(y), ds.pdf > 0)
        Le = mi.unpolarized_spectrum(weight)
        # The light was drawn from another place than a limb, which depends on the light, with another solid angle.
        there = dr.copy(ds)
        there.d, there.dist = -b.d, b.dist
        ratio = dr.abs_dot(ds.n, b.d) / dr.abs_dot(ds.n, ds.d) * dr.square(ds.dist / b.dist)
        other = context.scene.eval_emitter_direction(at_point(b.p, ray), there, b.valid & k.ball)
        other = mi.unpolarized_spectrum(other)
        other *= dr.select(ds.delta, 1, dr.select(far, 1, ratio) / ds.pdf)
        return Local(ds=ds, b=b, far=far, Le=dr.select(k.ball, other, Le), near=near, u=u)

    def _speeds(self, term, edges, light, x, path, ray, numbers, sampler, active):
        """Return the attached speeds of the edge by :data:`.term.PixelSums.NAMES`.

        For x as the first vertex of a path of the sensor, as another one, and as the first one seen through a chain.
        """
        b = light.b
        context = term.context
        pi, on_surface = term.light_context.segment.surface_of(path.leg)
        surface = active & on_surface & pi.is_valid()
        with dr.suspend_grad():
            seen, _ = term.places.seen_from(x.at, numbers, active)
            behind = dr.norm(x.at.p - b.p)
            t = dr.select(light.far, 0, behind / (behind + b.dist))
            n = dr.select(surface, mi.Vector3f(x.si.n), 0)
        held = context.segment.material_displacement(context, pi, ray, surface)
        if term.is_meter and not context.wanted.sensor:
            first = held
        else:
            rays = term.places.rays_at(context, sampler, seen.uv, seen.numbers)
            if term.is_meter:
                with dr.suspend_grad():
                    shift = seen.p - rays.ray.o
            else:
                shift = mi.Vector3f(0)
            o = rays.ray.o + shift
            with dr.suspend_grad():
                r = dr.norm(x.at.p - o)
                w = (x.at.p - dr.detach(o)) / r
            q = dr.dot(n, along_the_ray(context, pi, ray, surface))
            first = self._on_ray(displacement(rays.ray.o + rays.ray.d * r, active), w, n, q, surface)
        motions = [first, held]
        if term.through is not None:
            motions.append(self._through_chain(term, x.at.p, n, pi, ray, surface, active))
        n_p, found, turned = dr.dot(b.n, edges.moving(b)), [], mi.Float(0)
        if self.lights.sun is not None:  # its rays turn about x
            sun = active & light.far & self.lights.sun.shines(light.ds.emitter, light.ds.d)
            to_sun = self.lights.sun.attach_direction(mi.Vector3f(light.ds.d), sun)
            turned = behind * dr.dot(b.n, displacement(to_sun, sun))
        for v_x in motions:
            v_y = self._motion(context, light, x.at.p, v_x, active & ~light.far)
            found.append(dr.select(active, n_p - (1 - t) * dr.dot(b.n, v_x) - t * dr.dot(b.n, v_y) - turned, 0))
        return found

    @staticmethod
    def _on_ray(δ, w, n, q, surface):
        """Return the displacement of a surface point on a ray in direction ``w`` that moves by ``δ``.

        The surface moves by ``q`` along its normal ``n``.
        """
        cos = dr.dot(n, w)
        return δ + w * dr.select(surface & (dr.abs(cos) > EDGE_ON), (q - dr.dot(n, δ)) / cos, 0)

    def _through_chain(self, term, x, n, pi, ray, surface, active):
        """Return the displacement of x on the ray of the sensor that sees it through a chain."""
        context, through = term.context, term.through
        with dr.suspend_grad():
            seen, rays = through.seen_from(x, active)
        found = active & seen.valid
        last = attached_ray(context, rays.ray, ratios_of(through.chain), through.chain.count, found)
        q = dr.dot(n, along_the_ray(context, pi, ray, surface))
        return self._on_ray(displacement(last.o + last.d * seen.way, found), seen.d, n, q, surface)

    def _motion(self, context, light, x, v_x, active):
        """Return the attached displacement of a light's point, as interior derivatives hold it, seen from x.

        x moves by ``v_x``. Points and spots move, areas are points of their shapes, dragged along where they are near,
        and spheres keep the place in the cone that they fill.
        """
        wanted, ds, b = context.wanted, light.ds, light.b
        v = mi.Vector3f(0)
        flags = ds.emitter.flags()
        if wanted.light:
            at = active & mi.has_flag(flags, mi.EmitterFlags.DeltaPosition)
            y, _ = context.scene.sample_emitter_direction(light.near, light.u, False, at)
            v += displacement(y.p, at)
        on_shape, cone = active & mi.has_flag(flags, mi.EmitterFlags.Surface), mi.Bool(False)
        if wanted.sphere_lights:
            cone = on_shape & self.lights.claims(context, ds.emitter, ds.d, wanted)
            moving = dr.replace_grad(mi.Point3f(x), mi.Point3f(x + v_x))
            v += displacement(self.lights.spheres.kept_in_cone(ds.emitter, x, ds.p, at_point(moving), cone).p, cone)
        held = mi.Vector3f(0)
        there = on_shape & ~cone
        if wanted.emitter_shape:
            with dr.suspend_grad():
                ray = mi.Ray3f(b.beside, -b.d)
                pi = context.segment.next_surface(context, ray, there)
            y, _ = material_point(pi, ray, there & pi.is_valid(), context.contents.emitting_meshes)
            held = displacement(y.p, there & pi.is_valid())
        share = dragged_share(dr.norm(ds.p - x), context.contents.damping_radius)
        return v + dr.select(there, held + share * (v_x - held), 0)
