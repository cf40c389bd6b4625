r"""The boundary term: what derivatives gain where an edge moves, at the times of what it uncovers and hides.

A point p of an edge with tangent t is seen from x in direction d; n is normal to d and t, out of what hides; P is the
density of p by length. With the film's adjoint A(pixel, tau),

    dLoss += sum over sides  +-c [ sum over events e: A(pixel, tau_e) f_e ] (n . v_side)       + inner, - outer

Each side is a path like any other one, that goes on from a leg that is known. Three passes:

    primary   x is the sensor:           c = W sin / P                     (W: importance per area across d at p)
    vertex    x is a vertex of a path:   c = beta f_s(x, d) sin / (r^2 P)
    light     x is a point y of a light: c = -Le / pdf_omega sin / P, and the path goes on behind p, to the sensor

    v_in = v_p,     v_out = v_p - (1 - s) v_x - s v_y,     s = |p - x| / |y - x|

as interior derivatives hold their samples: a vertex slides along the ray that found it, points of lights are material,
points nearer than the damping radius are dragged along.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.edges.table import EdgeTable
from torchtransient.plugins.edges.topology import Topology
from torchtransient.plugins.integrators.launch import passes_of, seed_array
from torchtransient.plugins.polarized import attenuated, product
from torchtransient.plugins.sampling.sphere_lights import _Sphere
from torchtransient.plugins.sensors.origin import PrimaryRays, index_at_sensor, sample_rays, views
from torchtransient.plugins.sensors.stokes_frame import sensor_rotation
from torchtransient.plugins.transport.carry import total_of
from torchtransient.plugins.transport.connection.emitter_sampled import EmitterSampled
from torchtransient.plugins.transport.connection.sensor_sampled import SensorSampled
from torchtransient.plugins.transport.contents import DAMPING
from torchtransient.plugins.transport.derivative.forward import tangents_of
from torchtransient.plugins.transport.instances import surface_interaction
from torchtransient.plugins.transport.scattering.geometry_terms import displacement, material_point
from torchtransient.plugins.transport.sinks.adjoint_sum import AdjointSumSink
from torchtransient.plugins.transport.sinks.film import FilmSink
from torchtransient.plugins.transport.sinks.sink import Sink
from torchtransient.plugins.transport.strategy import Local, Proposal
from torchtransient.plugins.transport.walk import advance, go_on, start
from torchtransient.plugins.transport.world import World

_SEEDS = {"primary": 0x51, "vertex": 0x52, "light": 0x53}
# Radii of the scene from which a light at infinity is looked at along an edge.
_FAR = 300


class BoundaryTerm:
    """Beside the paths of a job. ``names``: which passes; ``share``: edge samples for each path."""

    def __init__(self, integrator, world, sensor, film, seed, samples, names, share=1.0, candidates=1):
        self.integrator, self.world, self.sensor, self.film = integrator, world, sensor, film
        self.candidates = candidates
        scene, wanted = world.scene, world.wanted
        self.names = [n for n in names if n != "vertex" or world.max_depth > 2]
        self.names = [n for n in self.names if n != "light" or (world.max_depth > 1 and len(scene.emitters()))]
        views_move = wanted.sensor or wanted.light
        topology = world.contents.memory.of("edges", b"", lambda: Topology(scene))
        self.names = self.names if topology.count else []
        self.near = EdgeTable(topology, wanted.shapes, alone=not wanted.sensor)  # edges seen by the sensor
        # Beyond, what moves may lie behind an edge that stands still.
        self.edges = EdgeTable(topology, wanted.shapes, alone=False) if not views_move else self.near
        if views_move:
            self.near = self.edges = EdgeTable(topology, frozenset(), alone=False)
        self.jobs = {}
        for name in self.names:
            own, _ = mi.sample_tea_32(seed_array(seed), mi.UInt32(_SEEDS[name]))
            count = max(1, round(samples * share))
            self.jobs[name], _ = passes_of(sensor.sampler().clone(), film, own, count, world.most_events())
        self.lights = EmitterSampled()
        self.lights.prepare(world)

    def tables(self):
        ends = [*self.near.ends, *self.edges.ends]
        return [end for end in {id(e): e for e in ends}.values() if dr.grad_enabled(end)]

    # ------------------------------------------------------------------------------------------ both modes

    def backward(self, incoming):
        for name in self.names:
            density = self._density(name)
            for job in self.jobs[name]:
                objective, _, _ = getattr(self, f"_{name}")(_Reverse(self, incoming), density, job)
                with dr.resume_grad():
                    if dr.grad_enabled(objective):
                        dr.backward_from(objective)
                dr.eval()

    def forward(self):
        for name in self.names:
            for job in self.jobs[name]:
                getattr(self, f"_{name}")(_Forward(self, job), self._density(name), job)
                dr.eval(self.film.bands[job.band][2], self.film.steady)

    def _density(self, name):
        return (self.near if name == "primary" else self.edges).by_length

    # ------------------------------------------------------------------------------------------ both sides

    def _sides(self, mode, sampler, view, b, factor, v, first):
        """The two sides of a point: paths of which ``first`` (keyword arguments of a Path's fields, and ``β``) are
        alike; ``v``: attached (inner, outer). Returns (attached objective, detached values, b).
        """
        world, place = self.world, Local(
            si=dr.zeros(mi.SurfaceInteraction3f), medium=first.pop("medium"), surface=mi.Bool(False)
        )  # fmt: skip
        active = first["active"] & dr.isfinite(factor)
        factor = dr.select(active, factor, 0)
        ray = first.pop("ray")
        rays = [mi.Ray3f(ray), mi.Ray3f(ray)]
        rays[0].o, rays[0].d = b.V, b.d_in
        rays[1].o, rays[1].d = dr.select(b.crease, b.V, b.beside), b.d
        own = sampler.clone()
        past = world.segment.depart(world, rays[1], place, first["β"], own, active & ~b.crease)
        facing = world.segment.ends_at(b.facing, place.medium)
        legs = [world.segment.ends_at(b.inner, place.medium), dr.select(b.crease, facing, past)]
        objective, values = mi.Float(0), []
        for sign, ray, leg, moves in zip((1, -1), rays, legs, mode.speeds(v), strict=True):
            path = start(world, ray, mi.Float64(0), 1)
            for key, value in first.items():
                setattr(path, key, type(getattr(path, key))(value))
            path.leg, path.active = leg, active
            # The same random numbers on both sides.
            value = mode.traced(world, own.clone(), path, view, sign * factor, moves)
            if value is not None:
                with dr.resume_grad():
                    objective += value * moves
                values.append(value)
        return objective, sum(values), b

    def _vertex_speed(self, b, v_x, y_dist, radius):
        """Attached speeds (inner, outer) of the edge against points seen from a vertex that moves by ``v_x``."""
        n_x, n_p = dr.dot(b.n, v_x), dr.dot(b.n, self._moved(b))
        s = dr.select(dr.isfinite(y_dist), b.dist / y_dist, 0)
        return n_p - drag(b.dist, radius) * n_x, n_p - ((1 - s) + s * drag(y_dist, radius)) * n_x

    def _moved(self, b):
        return b.edges.moving(b)

    # ------------------------------------------------------------------------------------------ the passes

    def _primary(self, mode, density, job):
        world, scene, sensor = self.world, self.world.scene, self.sensor
        sampler, lanes = self._sampler(job)
        aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
        wavelength = sampler.next_1d() if mi.is_spectral else mi.Float(0)
        ds, _ = sensor.sample_direction(at_point(mi.Point3f(0)), aperture)

        def worth(d, dist):  # what the sensor may see
            _, importance = sensor.sample_direction(at_point(ds.p + d * dist), aperture)
            return mi.unpolarized_spectrum(importance)[0]

        k = self.near.choose(density, sampler, mi.Point3f(ds.p), mi.Bool(True), self.candidates, worth)
        b = self.near.seen_from(k, mi.Point3f(ds.p), True)
        b.edges = self.near
        ds, importance = sensor.sample_direction(at_point(b.p), aperture, b.valid)
        meter = sensor.get_shape() is not None
        if meter:  # Mitsuba's importance of meters is pi: per area across d it is 1 / (A pdf), and rays have the weight pi
            area = sensor.get_shape().surface_area()
            importance = importance / dr.square(dr.pi) * dr.select(ds.pdf > 0, dr.rcp(area * ds.pdf), 0)
        row, column, weight, inside = self._pixel(ds.uv, sampler.next_2d())
        rays = self._rays(sampler, ds.uv, wavelength, aperture, row, column, job)
        view = mode.view(rays)
        ray = dr.detach(rays.ray)
        if meter:
            ray.o = mi.Point3f(ds.p)
        at, medium = at_point(b.beside, ray), world.segment.medium_towards(b.d)
        way = dr.norm(b.p - ray.o)
        to_lens = Local(p=ray.o, d=-b.d, dist=way)
        place = Local(at=at, si=dr.zeros(mi.SurfaceInteraction3f), medium=medium, surface=mi.Bool(False))
        active, T = world.segment.transmittance(
            world, place, to_lens, sampler.next_2d(), sampler, b.valid & (ds.pdf > 0) & inside
        )
        factor = mi.unpolarized_spectrum(importance)[0] * b.sin * b.inv_pdf * weight
        with dr.resume_grad():
            o, d = rays.ray.o, rays.ray.d
            v = dr.select(active, dr.dot(b.n, self._moved(b)) - dr.dot(b.n, o + d * way), 0)
        first = {
            "ray": ray, "β": attenuated(mi.Spectrum(1), mi.UnpolarizedSpectrum(T)), "η": dr.detach(rays.η),
            "τ": self.integrator.first_opl(self.film, rays), "prev_p": ray.o, "active": active, "medium": medium,
        }  # fmt: skip
        return self._sides(mode, sampler, view, b, factor, (v, v), first)

    def _vertex(self, mode, density, job):
        world, vertices = self.world, self.world.max_depth - 2
        rays = self.integrator.start(world.scene, world.contents, self.sensor, self.film, job)
        world.start(rays)
        view, sampler, ray = mode.view(rays), rays.sampler, dr.detach(rays.ray)
        target = dr.minimum(mi.UInt32(sampler.next_1d() * vertices), vertices - 1)
        path = start(world, ray, self.integrator.first_opl(self.film, rays), dr.detach(rays.η))
        path.leg = world.segment.first(world, ray, sampler)
        pi, _ = world.segment.surface_of(path.leg)
        radius = dr.minimum(world.contents.damping_radius, pi.t * DAMPING)
        path = advance(world, sampler, path, target)
        vertex = world.segment.arrive(world, path)
        vertex.τ, vertex.η, vertex.goes_on = path.τ + vertex.opl, path.η, path.active & vertex.valid
        world.scattering.arrive(world, path, vertex, sampler)
        x = mi.Point3f(vertex.at.p)
        n = dr.select(vertex.surface, mi.Vector3f(vertex.si.n), 0)
        worth = lambda d, dist: dr.select(vertex.surface, dr.abs_dot(n, d), 1) / dr.maximum(dr.square(dist), 1e-12)  # noqa: E731
        k = self.edges.choose(density, sampler, x, vertex.goes_on, self.candidates, worth)
        b = self.edges.seen_from(k, x, vertex.goes_on)
        b.edges = self.edges
        # Asked for as a connection asks.
        proposal = Proposal(d=b.d, active=b.valid, ds=None)
        (answer,), _ = world.scattering.scatter(world, path, vertex, [proposal], sampler)
        τ, η = vertex.delay.after(vertex.τ), vertex.η * answer.eta
        β = product(vertex.β, dr.select(b.valid, answer.matrix, 0))
        most = dr.max(dr.abs(mi.unpolarized_spectrum(β)))
        end = Local(p=b.beside, d=dr.normalize(b.beside - x), dist=b.dist)
        active, T = world.segment.transmittance(
            world, vertex, end, sampler.next_2d(), sampler, b.valid & (most > 0) & dr.isfinite(most)
        )
        factor = most * vertices * b.sin * b.inv_pdf / dr.square(b.dist)
        scene_ray = mi.Ray3f(path.ray)
        pi, _ = world.segment.surface_of(path.leg)
        share = world.segment.share_of_surface(path.leg)
        past = world.scene.ray_intersect(mi.Ray3f(b.beside, b.d), active & ~b.crease)
        y_dist = dr.select(b.crease, b.dist, dr.select(past.is_valid(), dr.norm(past.p - x), dr.inf))
        with dr.resume_grad():
            at_first = target == 0
            scene_ray.o = dr.select(at_first, rays.ray.o, scene_ray.o)
            scene_ray.d = dr.select(at_first, rays.ray.d, scene_ray.d)
            si = surface_interaction(world.surfaces, pi, scene_ray, mi.RayFlags.All, active & pi.is_valid())
            v_x = displacement(si.p, active & pi.is_valid()) * share
            v_x += displacement(scene_ray.o, active & at_first) * (1 - share)
            v = [dr.select(active, each, 0) for each in self._vertex_speed(b, v_x, y_dist, radius)]
        β = attenuated(β, mi.UnpolarizedSpectrum(T) * dr.select(most > 0, dr.rcp(most), 0))
        first = {
            "ray": path.ray, "β": dr.select(active, β, 0), "η": η, "τ": τ, "prev_p": x, "prev_n": vertex.at.n,
            # Emission past the edge is found by the pass of the lights.
            "prev_pdf": mi.Float(0), "prev_unconnected": mi.Bool(False), "depth": target + 1, "active": active,
            "medium": world.segment.medium_towards(b.d, vertex),
        }  # fmt: skip
        return self._sides(mode, sampler, view, b, factor, v, first)

    def _light(self, mode, density, job):
        world, scene, sensor, wanted = self.world, self.world.scene, self.sensor, self.world.wanted
        sampler, lanes = self._sampler(job)
        k = self.edges.pick(density, sampler.next_1d(), sampler.next_1d())
        aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
        wavelength = sampler.next_1d() if mi.is_spectral else mi.Float(0)
        center = mi.Point2f(mi.ScalarVector2f(self.film.crop_size())) / 2
        middle = self._rays(sampler, center, wavelength, aperture, None, None, job)
        near = at_point(k.near, dr.detach(middle.ray))
        u = sampler.next_2d()
        ds, weight = self.lights.sample(world, near, u, mi.Bool(True))
        far = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
        ahead = _FAR * self.integrator.reference(scene).radius
        V = dr.select(far, k.near + ds.d * ahead, ds.p)
        b = self.edges.seen_from(k, mi.Point3f(V), ds.pdf > 0)
        b.edges = self.edges
        Le = mi.unpolarized_spectrum(weight)
        # Limbs: the light was drawn from the center, with another solid angle than from the limb.
        there = dr.copy(ds)
        there.d, there.dist = -b.d, b.dist
        ratio = dr.abs_dot(ds.n, b.d) / dr.abs_dot(ds.n, ds.d) * dr.square(ds.dist / b.dist)
        other = mi.unpolarized_spectrum(scene.eval_emitter_direction(at_point(b.p, dr.detach(middle.ray)), there, b.valid & k.ball))
        other *= dr.select(ds.delta, 1, dr.select(far, 1, ratio) / ds.pdf)
        Le = dr.select(k.ball, other, Le)
        most = dr.max(dr.abs(Le))
        active = b.valid & (most > 0) & dr.isfinite(most) & ~b.crease
        medium = world.segment.medium_towards(b.d)
        place = Local(at=at_point(b.beside, dr.detach(middle.ray)), si=dr.zeros(mi.SurfaceInteraction3f), medium=medium,
                      surface=mi.Bool(False))  # fmt: skip
        to_light = Local(p=dr.select(far, b.p + ds.d * ds.dist, ds.p), d=-b.d, dist=dr.select(far, ds.dist, b.dist))
        active, T = world.segment.transmittance(world, place, to_light, sampler.next_2d(), sampler, active)
        Le = Le * mi.UnpolarizedSpectrum(T) * dr.select(most > 0, dr.rcp(most), 0)
        factor = dr.select(active, -most * b.sin * b.inv_pdf, 0)
        factor = dr.select(dr.isfinite(factor), factor, 0)
        ray = mi.Ray3f(dr.detach(middle.ray))
        ray.o, ray.d = b.beside, b.d
        light_world = self._light_world(aperture)
        τ = mi.Float64(0)
        if world.contents.distant is not None:
            τ = mi.Float64(dr.select(far, world.contents.distant.length(b.p, -b.d), 0))
        path = start(light_world, ray, τ - self.film.start_opl, dr.detach(middle.η))
        path.prev_p = dr.select(far, b.p, b.V)
        path.β = attenuated(mi.Spectrum(1), dr.select(active, Le, 0))
        path.active = active
        path.leg = light_world.segment.depart(light_world, ray, place, path.β, sampler, active)
        pi, on_surface = light_world.segment.surface_of(path.leg)
        x = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
        # ---- speeds; in media the place behind an edge is taken to stand still
        moving = active & on_surface & x.is_valid()
        x_p = light_world.segment.arrive(light_world, path).at.p
        behind = dr.norm(x_p - b.p)
        # An edge that lies on x: shadow and outline end there together, and who looks at the edge sees both.
        active &= ~on_surface | (dr.dot(x_p - b.p, b.d) > 0)
        moving &= active
        path.active = active
        t = dr.select(far, 0, behind / (behind + b.dist))
        seen, _ = sensor.sample_direction(at_point(x_p), aperture, active)
        rays = self._rays(sampler, seen.uv, wavelength, aperture, None, None, job)
        w = dr.normalize(x_p - dr.detach(rays.ray.o))
        with dr.resume_grad():
            si = surface_interaction(world.surfaces, pi, ray, mi.RayFlags.All, moving)
            q = dr.dot(x.n, displacement(si.p, moving))
            δ = displacement(rays.ray.o + rays.ray.d * dr.norm(x_p - dr.detach(rays.ray.o)), active)
            p = dr.dot(b.n, self._moved(b))

            def speed(w, δ):
                slid = δ + w * dr.select(moving & (dr.dot(x.n, w) != 0), (q - dr.dot(x.n, δ)) / dr.dot(x.n, w), 0)
                lit = self._light_moved(ds, b, x_p, slid, u, near, active & ~far)
                return dr.select(active, p - (1 - t) * dr.dot(b.n, slid) - t * dr.dot(b.n, lit), 0)

            direct = speed(w, δ)
            # What of it does not depend on the way to the sensor, and how fast x moves across itself.
            parts = dr.select(active, p - t * dr.dot(b.n, self._light_moved(ds, b, x_p, mi.Vector3f(0), u, near, active & ~far)), 0), q
        per_q = lambda w: -(1 - t) * dr.dot(b.n, w) * dr.select(moving & (dr.dot(x.n, w) != 0), dr.rcp(dr.dot(x.n, w)), 0)  # noqa: E731
        return mode.from_light(light_world, sampler, path, factor, direct, speed, b, (middle, job, sampler.next_2d()), parts, per_q)

    def _light_moved(self, ds, b, x, slid, u, near, active):
        """Displacement of the point ``ds`` of a light, as interior derivatives hold it, seen from ``x``."""
        world, wanted = self.world, self.world.wanted
        moved = mi.Vector3f(0)
        if wanted.light:
            at = active & mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.DeltaPosition)
            y, _ = world.scene.sample_emitter_direction(near, u, False, at)
            moved += displacement(y.p, at)
        on_shape = active & mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Surface)
        cone = mi.Bool(False)
        if wanted.sphere_lights:
            cone = on_shape & self.lights.claims(world, ds.emitter, ds.d, wanted)
            with dr.suspend_grad():
                table = self.lights.spheres
                s = _Sphere(table, ds.emitter, x, cone)
                c = dr.normalize(s.to_center)
                d = dr.normalize(ds.p - x)
                frame = mi.Frame3f(c)
                local = frame.to_local(d)
                phi = dr.atan2(local.y, local.x) / dr.two_pi
                v = mi.Point2f(dr.clip((1 - dr.dot(c, d)) / s.versine_max, 0, 1), phi - dr.floor(phi))
            seen_from = at_point(dr.replace_grad(mi.Point3f(x), mi.Point3f(x + slid)))
            y = _Sphere(table, ds.emitter, seen_from.p, cone).sampled(v, seen_from)
            moved += displacement(y.p, cone)
        if wanted.emitter_shape:
            with dr.suspend_grad():
                there = on_shape & ~cone
                ray = mi.Ray3f(b.beside, -b.d)
                pi = world.segment.next_surface(world, ray, there)
            y, _ = material_point(pi, ray, there & pi.is_valid(), world.contents.emitting_meshes)
            moved += displacement(y.p, there & pi.is_valid())
        return moved

    # ------------------------------------------------------------------------------------------ of the sensor

    def _light_world(self, aperture):
        world, integrator = self.world, self.integrator
        segment, scattering, _ = integrator.strategies(world.contents)
        settings = replace(integrator.settings(), camera_unwarp=False)
        strategies = segment, scattering, [SensorSampled(self.sensor, aperture)]
        return World(world.scene, world.contents, settings, strategies, None, world.window)

    def _sampler(self, job):
        lanes = int(self.film.crop_size()[0]) * job.rows * job.spp
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(job.seed, lanes)
        return sampler, lanes

    def _pixel(self, uv, u):
        """Row, column and weight of a pixel that sees a place of the film, chosen by ``u`` of those that do, and whether
        there is one.
        """
        size = mi.ScalarVector2f(self.film.crop_size())
        rfilter, weight, cell = self.film.rfilter(), mi.Float(1), dr.floor(uv)
        if not rfilter.is_box_filter():
            _, integral = self.film._offset_distribution
            n = int(2 * rfilter.radius()) + 1
            cell = dr.ceil(uv - rfilter.radius() - 0.5) + dr.minimum(dr.floor(u * n), n - 1)
            h = uv - cell - 0.5
            weight = rfilter.eval(h.x) * rfilter.eval(h.y) * (n * n / (integral * integral))
        inside = dr.all((cell >= 0) & (cell < size)) & dr.all((uv >= 0) & (uv < size))
        return mi.UInt32(dr.select(inside, cell.y, 0)), mi.UInt32(dr.select(inside, cell.x, 0)), weight, inside

    def _rays(self, sampler, uv, wavelength, aperture, row, column, job):
        """Primary rays through places of the film, attached to the sensor."""
        world, sensor = self.world, self.sensor
        position = uv / mi.ScalarVector2f(self.film.crop_size())
        seen = views(sensor, position, lambda: self.integrator.reference(world.scene))
        with dr.resume_grad():
            ray, weight = sample_rays(sensor, seen, sensor.shutter_open(), wavelength, position, aperture)
            η = index_at_sensor(seen, world.contents.surroundings, world.scene)
        return PrimaryRays(sampler, ray, weight, dr.opaque(mi.Float, 1 / job.total), row, column, seen, η)


class _Reverse:
    """Events are weighed by the film's adjoint; speeds stay attached."""

    def __init__(self, term, incoming):
        self.term, self.incoming = term, incoming

    def view(self, rays):
        return self._block(rays, rays)

    def _block(self, rays, place):
        term = self.term
        match = term.integrator.channel_match(term.world.contents, term.film, rays)
        pixel = dr.fma(place.row, int(term.film.crop_size()[0]), place.column)
        return self.incoming.block(place, pixel, match)

    def speeds(self, v):
        return v

    def traced(self, world, sampler, path, block, factor, speed):
        _, kept = go_on(world, sampler, path, AdjointSumSink(block))
        value = kept["sum"] * factor
        return dr.select(dr.isfinite(value), value, 0)

    def from_light(self, world, sampler, path, factor, direct, speed, b, about, parts, per_q):
        sink = _PixelSums(self, world, about)
        _, kept = go_on(world, sampler, path, sink)
        values = [dr.select(dr.isfinite(kept[n] * factor), kept[n] * factor, 0) for n in ("direct", "rest")]
        with dr.resume_grad():
            rest = speed(-kept["w"], mi.Vector3f(0))
            objective = values[0] * direct + values[1] * rest
        return objective, values[0] + values[1], b


class _PixelSums(Sink):
    """Sums of events that each have a pixel of their own: those of the first vertex, and of all others."""

    def __init__(self, mode, world, about):
        self.mode, self.about = mode, about

    def begin(self, world):
        return {"direct": mi.Float(0), "rest": mi.Float(0), "w": mi.Vector3f(0, 0, 1)}

    def event(self, kept, event):
        term, (middle, job, u) = self.mode.term, self.about
        first = event.depth == 2
        row, column, weight, inside = term._pixel(event.uv, u)
        place = Local(row=row, column=column, laser=None)
        A, _ = self.mode._block(seen_along(middle, event.d), place).read(event.opl, event.active & inside)
        value = dr.select(event.active & inside, total_of(A, event.value) * weight, 0)
        kept["direct"] = kept["direct"] + dr.select(first, value, 0)
        kept["rest"] = kept["rest"] + dr.select(first, 0, value)

    def vertex(self, kept, path, samples):
        out = samples["scattering"].out
        kept["w"] = dr.select(path.depth == 0, out, kept["w"])


class _Forward:
    """Events go to the film, times the tangent of the speed."""

    def __init__(self, term, job):
        self.term, self.job = term, job

    def view(self, rays):
        term = self.term
        return term.integrator.channel_match(term.world.contents, term.film, rays), *term.integrator.pixel_indices(term.film, self.job, rays)

    def speeds(self, v):
        with dr.resume_grad():
            if not dr.grad_enabled(*v):
                return [mi.Float(0)] * len(v)
            return tangents_of(list(v))

    def traced(self, world, sampler, path, view, factor, speed):
        film, (match, base, pixel) = self.term.film, view
        block = film.create_event_block(self.job, base, match, world.most_events())
        scale = factor * speed
        _, kept = go_on(world, sampler, path, _ScaledFilmSink(block, dr.select(dr.isfinite(scale), scale, 0)))
        film.add_steady(pixel, match.to_channels(kept["L"]))
        block.finish()
        return None

    def from_light(self, world, sampler, path, factor, direct, speed, b, about, parts, per_q):
        speeds = self.speeds([direct, *parts])
        go_on(world, sampler, path, _PixelFilmSink(self, about, factor, speeds, per_q))
        return mi.Float(0), None, b


class _ScaledFilmSink(FilmSink):
    def __init__(self, block, scale):
        super().__init__(block)
        self.scale = scale

    def event(self, kept, event):
        event.value = event.value * self.scale
        super().event(kept, event)


class _PixelFilmSink(Sink):
    """Events that each have a pixel of their own, times tangents of the speeds. Films of histograms."""

    def __init__(self, mode, about, factor, speeds, per_q):
        self.mode, self.about, self.factor, self.speeds, self.per_q = mode, about, factor, speeds, per_q

    def begin(self, world):
        return {"w": mi.Vector3f(0, 0, 1)}

    def event(self, kept, event):
        term, (middle, job, u) = self.mode.term, self.about
        row, column, weight, inside = term._pixel(event.uv, u)
        direct, still, q = self.speeds
        speed = dr.select(event.depth == 2, direct, still + q * self.per_q(-kept["w"]))
        match = term.integrator.channel_match(term.world.contents, term.film, seen_along(middle, event.d))
        place = Local(row=row, column=column, laser=None)
        base, pixel = term.integrator.pixel_indices(term.film, job, place)
        channels = match.to_channels(event.value * (weight * self.factor * speed))
        active = event.active & inside & dr.isfinite(speed)
        channels = [dr.select(active & dr.isfinite(c), c, 0) for c in channels]
        term.film.put(job.band, base, event.opl, channels, active)
        if term.film.keeps_steady:
            for c, value in enumerate(channels):
                index = pixel * term.film.channel_count() + c
                dr.scatter_reduce(dr.ReduceOp.Add, term.film.steady, type(term.film.steady)(value), index, active)

    def vertex(self, kept, path, samples):
        kept["w"] = dr.select(path.depth == 0, samples["scattering"].out, kept["w"])


def seen_along(rays, d):
    """Primary rays of which one arrives against ``d``: what channels of the film ask for."""
    ray = mi.Ray3f(dr.detach(rays.ray))
    ray.d = -d
    return Local(ray=ray, weight=rays.weight, scale=rays.scale, seen=rays.seen)


def at_point(p, ray=None):
    it = dr.zeros(mi.Interaction3f)
    it.p = p
    if ray is not None:
        it.time, it.wavelengths = ray.time, ray.wavelengths
    return it


def drag(r, radius):
    """The share of its vertex's motion that a point at distance ``r`` is dragged along (``damped_motion``)."""
    return dr.select(r < radius, dr.square(1 - dr.square(r / radius)), 0)
