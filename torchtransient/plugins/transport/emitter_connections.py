"""Connections to the emitters of the scene: emission that a path hits, and points that are sampled on lights.

Light that is hit moves as every vertex does (``_here``), and as the sampled points do: both strategies have to move
their samples alike, or the weights between them would no longer sum to one under the motion. A sun that moves and is
rarely drawn is attached at the vertex before (``_sun_ahead``). Arguments that all methods share are explained in
:mod:`.strategy`.
"""

from __future__ import annotations

from functools import partial, reduce
from operator import or_

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.node_walk import carries_derivatives
from torchtransient.plugins.polarized import first_column, intensity, product, scatter_unpolarized
from torchtransient.plugins.sampling.lights import MovingSun
from torchtransient.plugins.transport.carry import slope_only
from torchtransient.plugins.transport.geometry_terms import (
    damped_motion,
    displacement,
    material_point,
    point_of_light,
    slide_on_shape,
)
from torchtransient.plugins.transport.strategy import Connection, Event, EventTerm, Local, Proposal, mis_weight


class EmitterFound(Connection):
    """Connection to emission where a path arrives, weighed against the strategies that could have sampled it."""

    name = "emitter_found"
    light_of_scene_alone = True

    def prepare(self, context):
        sun = MovingSun.from_context(context)
        self.sun = sun if sun is not None and sun.rare else None

    def events(self, wanted):
        return 1 if wanted is None else 1 + (self.sun is not None)

    # ------------------------------------------------------------------------------------------------- primal

    def connect(self, context, path, vertex, proposal, answer, zeros):
        seen = path.active & vertex.surface
        if context.hide_emitters:
            seen &= (path.depth > 0) | vertex.valid
        if context.discard_direct_light:
            seen &= path.depth > 0
        seen = context.deep_enough(seen, path.depth + 1)
        emitter = vertex.si.emitter(context.scene)
        hit = (emitter != None) & seen  # noqa: E711 (a Dr.Jit comparison)
        prev = dr.zeros(mi.Interaction3f)
        prev.p, prev.n = path.prev_p, path.prev_n
        prev.time, prev.wavelengths = path.ray.time, path.ray.wavelengths
        ds = mi.DirectionSample3f(context.scene, si=vertex.si, ref=prev)
        if context.contents.smooth_lights is not None:
            # The face's normal, on the side of that which emission depends on: on a mirrored mesh it is the other one.
            ds.n = dr.mulsign(vertex.si.n, dr.dot(vertex.si.n, ds.d) * dr.dot(ds.n, ds.d))
        connected = hit & ~path.prev_unconnected
        sampled = [c.density(context, prev, ds, connected) for c in context.connections if c is not self]
        sampled = sum(density for density in sampled if density is not None)
        mis = dr.select(hit, mis_weight(path.prev_pdf, sampled), 0)
        value = first_column(vertex.β) * mis * mi.unpolarized_spectrum(emitter.eval(vertex.si, hit))
        return Event(value=value, opl=vertex.τ, active=hit, depth=path.depth + 1, mis=mis)

    # ------------------------------------------------------------------------------------------------- record

    def fields(self, context):
        return {"mis": mi.Float}

    def record(self, sample):
        return {"mis": sample.event.mis}

    # ----------------------------------------------------------------------------------------------- attached

    def attached(self, context, vertex, step, wanted):
        terms = [self._here(context, vertex, wanted)]
        if self.sun is not None:
            terms.append(self._sun_ahead(context, vertex, step, wanted))
        return terms

    def _here(self, context, vertex, wanted):
        v, si = vertex.v, vertex.si
        mis = v.record_of(self.name)["mis"]
        hit = v.active & (mis > 0)
        emitter = vertex.sid.emitter(context.scene)
        elsewhere = self._claimed(context, emitter, v.ray.d, wanted)
        if self.sun is not None:
            shines = self.sun.shines(emitter, v.ray.d)
            elsewhere = shines if elsewhere is None else elsewhere | shines
        if elsewhere is not None:
            hit &= v.before(context.scattering.name, "delta", at_sensor=True) | ~elsewhere
        Le = dr.select(hit, mis * mi.unpolarized_spectrum(emitter.eval(si, hit)), 0)
        value = first_column(vertex.carry.β) * Le
        term = EventTerm(value=value, slope=vertex.slope, opl=v.τ, active=hit, arrival=v.arrival(self.name))
        if context.velocities is not None:
            term.rate, term.rate_slope = v.rate, vertex.rate_slope
        return term

    def _claimed(self, context, emitter, d, wanted):
        """Return a mask of lights in direction ``d`` that another strategy alone differentiates, None for none."""
        claims = [c.claims(context, emitter, d, wanted) for c in context.connections if c is not self]
        claims = [c for c in claims if c is not None]
        return reduce(or_, claims) if claims else None

    def _sun_ahead(self, context, vertex, step, wanted):
        """Return the term of sunlight along a path that escapes into the sun: the drawn direction turns with it."""
        following = vertex.v.after()
        mis = following.record_of(self.name)["mis"]
        lit = (step.inv_pdf > 0) & ~step.ahead & (mis > 0)
        with dr.suspend_grad():
            sky = following.pi.compute_surface_interaction(following.ray, mi.RayFlags.Minimal, lit)
            emitter = sky.emitter(context.scene)
            lit &= self.sun.shines(emitter, following.ray.d)
        d = self.sun.attach_direction(mi.Vector3f(following.ray.d), lit)
        sky.wi = -d
        towards = context.scattering.evaluate(context, vertex, d, lit)
        Le = mi.unpolarized_spectrum(emitter.eval(sky, lit))
        value = scatter_unpolarized(towards.value, vertex.rotation) * (step.inv_pdf * mis) * Le
        value = product(vertex.carry.β, dr.select(lit, value, 0))
        length = context.contents.distant.length(vertex.scattered_si.p, d)
        slope = vertex.scattered_slope + slope_only(step.carry.η * length)
        term = EventTerm(value=value, slope=slope, opl=following.τ, active=lit, arrival=following.arrival(self.name))
        if context.velocities is not None:
            term.rate = following.rate
        if wanted.rate:
            rate = step.carry.η * dr.dot(vertex.velocity, d)
            term.rate_slope = vertex.rate_slope - slope_only(dr.select(lit, rate, 0))
        return term


# --------------------------------------------------------------------------------------------------------------------
# A point sampled on a light (next-event estimation).

class EmitterSampled(Connection):
    """Connection to a point of an emitter (next-event estimation).

    Mitsuba samples the emitters, but for spheres and most textured lights
    (:mod:`~..sampling.sphere_lights`).
    """

    name = "emitter_sampled"
    light_of_scene_alone = True
    finds_light = False

    def prepare(self, context):
        lights = context.contents.sphere_lights
        self.spheres = None if lights is None else lights.read(context.scene)
        self.sun = MovingSun.from_context(context)
        # A light without attached numbers is dark where it is dark.
        self.lights_change = context.wanted is not None and any(map(carries_derivatives, context.scene.emitters()))

    def tables(self):
        return [] if self.spheres is None else self.spheres.tables()

    def sample(self, context, ref, u, active):
        """Sample a point on an emitter.

        Args:
            ref: Interaction3f that the light is seen from.
            u: two uniform numbers, Point2f.

        Returns:
            (DirectionSample3f, emission over density), attached where spherical lights and ``ref`` are.
        """
        lights = context.contents.shape_lights if self.spheres is None else self.spheres
        found = lights.sample(context.scene, ref, u, active)
        return found if context.contents.smooth_lights is None else self._by_faces(context, ref, *found, active)

    def _by_faces(self, context, ref, ds, weight, active):
        """Return the sample with the solid angle of its face; Mitsuba takes that of the interpolated normal."""
        _, _, there, n = point_of_light(context, ref, ds, active & context.contents.smooth_lights.lists(ds.emitter))
        cos = dr.abs_dot(ds.n, ds.d)
        ratio = dr.select(there & (cos > 0), dr.abs_dot(n, ds.d) / cos, 1)
        ds.pdf = dr.select(ratio > 0, ds.pdf / ratio, 0)
        return ds, weight * ratio

    # ------------------------------------------------------------------------------------------------- primal

    def propose(self, context, path, vertex, sampler):
        active = context.deep_enough(vertex.goes_on & vertex.connectable, path.depth + 2)
        u = sampler.next_2d()
        ds, weight = self.sample(context, vertex.at, u, active)
        active &= ds.pdf > 0
        return Proposal(d=ds.d, active=active, ds=ds, weight=weight, u=u, sampler=sampler)

    def density(self, context, ref, ds, active):
        smooth = active & ~ds.delta
        lights = context.contents.shape_lights if self.spheres is None else self.spheres
        pdf = lights.pdf(context.scene, ref, ds, smooth)
        # An environment map that shines in the rows at its poles alone has no distribution: NaN.
        return dr.select(ds.delta, ds.pdf, dr.select(pdf > 0, pdf, 0))

    def connect(self, context, path, vertex, proposal, answer, zeros):
        ds, active = proposal.ds, proposal.active
        pdf = dr.select(ds.delta, 0, answer.pdf)
        value = product(vertex.β, answer.value) * self.weight(context, vertex.at, ds, ds.pdf, pdf, active)
        value *= mi.unpolarized_spectrum(proposal.weight)
        # Shadow rays only where they can matter.
        active = active & (self._may_change(context, proposal, answer) if zeros else is_light(intensity(value)))
        length = self._length(context, vertex.at.p, ds, ds.d) * (vertex.η * answer.eta)
        opl = vertex.scattered_τ + mi.Float64(length)
        active = context.counted(active, opl)
        active, T = context.segment.transmittance(context, vertex, ds, proposal.u, proposal.sampler, active)
        return Event(value=value * T, opl=opl, active=active, depth=path.depth + 2, T=T, crowded=True)

    def _may_change(self, context, proposal, answer):
        """Return a mask of samples of value zero that may have a derivative.

        With an albedo of zero they may, behind a surface not.
        """
        may = mi.Bool(True)
        if not self.lights_change:
            may &= is_light(mi.unpolarized_spectrum(proposal.weight))
        if context.scattering.samples_all:
            may &= answer.pdf > 0
        return may

    @staticmethod
    def _length(context, p, ds, d):
        """Return the length from ``p`` to a sampled point of a light, or to a distant light in direction ``d``."""
        if context.contents.distant is None:
            return ds.dist
        far = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
        return dr.select(far, context.contents.distant.length(p, d), ds.dist)

    # ------------------------------------------------------------------------------------------------- record

    def fields(self, context):
        fields = {"u": mi.Point2f, "lit": mi.Bool}
        return fields if context.contents.media is None else fields | {"T": mi.UnpolarizedSpectrum}

    def record(self, sample):
        return {"u": sample.proposal.u, "lit": sample.event.active, "T": sample.event.T}

    # ----------------------------------------------------------------------------------------------- attached

    def claims(self, context, emitter, d, wanted):
        # The limb of a sphere turns away from the vertex: in area measure its derivative has infinite variance. A
        # sphere is sampled over the cone that it fills, which moves with it, and by this strategy alone. So is the sun.
        claimed = self.spheres.draws(emitter) if wanted.sphere_lights else None
        if self.sun is not None and not self.sun.rare:
            shines = self.sun.shines(emitter, d)
            claimed = shines if claimed is None else claimed | shines
        return claimed

    def numbers(self, recorded):
        return [recorded["u"].x, recorded["u"].y]

    def attached(self, context, vertex, step, wanted):
        v, si = vertex.v, vertex.scattered_si
        r = v.record_of(self.name)
        lit = r["lit"]
        light = self._light(context, si, r["u"], lit, wanted)
        d = self._move(context, vertex, light, wanted) if wanted.geometry else mi.Vector3f(light.ds.d)
        if self.sun is not None:
            d = self.sun.attach_direction(d, light.sun)
        Le = self._emission(context, si, light, d, lit, wanted)
        towards = context.scattering.evaluate(context, vertex, d, lit, ds=light.ds)
        alone = light.ds.delta | light.cone
        if self.sun is not None and not self.sun.rare:
            alone |= light.sun
        pdf = dr.select(alone, 0, towards.pdf)
        with dr.suspend_grad():
            mis = self.weight(context, si, light.ds, light.ds.pdf, pdf, lit)
        value = scatter_unpolarized(towards.value, vertex.rotation) * Le * mis
        if "T" in r:
            value *= r["T"]
        end = Local(p=light.p, d=mi.Vector3f(light.ds.d), far=light.far, ahead=False)
        value *= context.segment.attached_transmittance(context, vertex, end, lit)
        # Selected before the product: what an idle lane holds must not reach the adjoint of the throughput.
        value = product(vertex.carry.β, dr.select(lit, value, 0))
        length = (self._length(context, si.p, light.ds, d) + light.longer) * towards.eta
        opl = vertex.scattered_opl + mi.Float64(dr.detach(length) * v.η)
        slope = vertex.scattered_slope
        if wanted.geometry:
            slope = slope + slope_only(vertex.carry.η * length)
        term = EventTerm(value=value, slope=slope, opl=opl, active=lit, arrival=v.arrival(self.name))
        if context.velocities is not None:
            found = partial(self._found, context, si, light)
            end = context.velocities.of_light(light.ds.emitter, light.p, lit, found)
            set_rate(vertex, term, end, d, vertex.carry.η * towards.eta, wanted)
        return [term]

    def _light(self, context, si, u, lit, wanted):
        """Return the sampled point of a light, attached: ``p, n, uv``, its ``area`` element, masks of its kind."""
        scene = context.scene
        with dr.suspend_grad():
            ds, weight = self.sample(context, si, u, lit)
            flags = ds.emitter.flags()
            far = lit & mi.has_flag(flags, mi.EmitterFlags.Infinite)
            surface = lit & mi.has_flag(flags, mi.EmitterFlags.Surface) & ~far
        light = Local(ds=ds, weight=mi.unpolarized_spectrum(weight), far=far, near=lit & ~far, surface=surface)
        light.p, light.n, light.uv, light.area = mi.Point3f(ds.p), mi.Normal3f(ds.n), mi.Point2f(ds.uv), mi.Float(1)
        # Normal of the face; ``n`` is that which emission depends on.
        light.face_n = mi.Normal3f(ds.n)
        light.longer, light.found = mi.Float(0), None
        light.cone, light.cone_weight, light.sun = mi.Bool(False), None, mi.Bool(False)
        if self.sun is not None:
            light.sun = lit & self.sun.shines(ds.emitter, ds.d)
        if wanted.light:
            at_point = lit & mi.has_flag(flags, mi.EmitterFlags.DeltaPosition)
            moving, _ = scene.sample_emitter_direction(si, u, False, at_point)
            light.p = dr.replace_grad(light.p, dr.select(at_point, moving.p, 0))
        if wanted.sphere_lights:
            light.cone = surface & self.claims(context, ds.emitter, ds.d, wanted)
            light.surface = surface & ~light.cone
            moving, light.cone_weight = self.sample(context, si, u, light.cone)
            light.p = dr.replace_grad(light.p, dr.select(light.cone, moving.p, 0))
        if wanted.geometry and context.contents.smooth_lights is not None:
            _, _, there, n = self._found(context, si, light)
            light.face_n = dr.select(there, n, light.face_n)
        if wanted.emitter_shape:
            self._follow_shape(context, si, light)
        return light

    def _found(self, context, si, light):
        """Return :func:`~.geometry_terms.point_of_light` for the point of ``light``, traced once."""
        if light.found is None:
            light.found = point_of_light(context, si, light.ds, light.surface)
        return light.found

    def _follow_shape(self, context, si, light):
        """Make the point of ``light`` a material one of its shape."""
        ray, pi, there, _ = self._found(context, si, light)
        found, area = material_point(pi, ray, there, context.contents.emitting_meshes)
        light.p = dr.select(there, dr.replace_grad(light.p, found.p), light.p)
        light.n = dr.select(there, dr.replace_grad(light.n, found.sh_frame.n), light.n)
        light.face_n = dr.select(there, dr.replace_grad(light.face_n, found.n), light.face_n)
        light.uv = dr.select(there, dr.replace_grad(light.uv, found.uv), light.uv)
        light.area = dr.relative_grad(area)

    def _move(self, context, vertex, light, wanted):
        """Return the attached direction towards the point of a light, and set how the point moves.

        Near points slide as the next vertex of a path does (:func:`~.geometry_terms.damped_motion`).
        """
        si, ds, near, on_surface = vertex.scattered_si, light.ds, light.near, light.surface
        n = dr.detach(light.face_n)
        δ = displacement(si.p, near) - displacement(light.p, near)
        motion = damped_motion(δ, mi.Vector3f(ds.d), ds.dist, n, near, vertex.damping_radius, ~on_surface)
        light.J = motion.J
        if wanted.emitter_shape:
            light.J = light.J * motion.of_material(light.face_n, light.area)
        light.J = dr.select(on_surface, light.J, 1)
        light.p = light.p + dr.select(on_surface, motion.slide(n), 0)
        light.longer = dr.select(near, motion.longer(n), 0)
        if context.contents.patterned_lights:
            ray, pi, there, _ = self._found(context, si, light)
            slide = slide_on_shape(pi, ray, motion.drag, there)
            light.uv, light.n = light.uv + slide.uv, light.n + slide.sh_n
        return motion.d

    @staticmethod
    def _emission(context, si, light, d, lit, wanted):
        """Return emission over density, with the derivatives of the emission and of the solid angle."""
        ds = dr.copy(light.ds)
        if wanted.emitter_shape:  # a pattern that moves over the shape
            ds.uv = light.uv
        if wanted.geometry:
            ds.d, ds.dist = d, light.ds.dist + light.longer
            if wanted.emitter_shape or wanted.light or wanted.sphere_lights or context.contents.patterned_lights:
                ds.p, ds.n, ds.uv = light.p, light.n, light.uv
        inv_pdf = dr.select(light.ds.pdf > 0, dr.rcp(light.ds.pdf), 0)
        value = mi.unpolarized_spectrum(context.scene.eval_emitter_direction(si, ds, lit)) * inv_pdf
        if wanted.geometry:
            value *= light.J
        if wanted.sphere_lights:
            value = dr.select(light.cone, mi.unpolarized_spectrum(light.cone_weight), value)
        return dr.replace_grad(light.weight, value)


def set_rate(vertex, term, end, d, η, wanted):
    """Set the rate of a term whose last segment leads from the vertex to a point of a light.

    Args:
        vertex: attached vertex.
        term: :class:`~.strategy.EventTerm`, which is changed.
        end: attached velocity of that point.
        d, η: attached direction and index of the segment.
        wanted: :class:`~.context.Wanted` derivatives.
    """
    rate = dr.select(term.active, η * dr.dot(end - vertex.velocity, d), 0)
    term.rate = vertex.v.rate + dr.detach(rate)
    if wanted.rate:
        term.rate_slope = vertex.rate_slope + slope_only(rate)


def is_light(value):
    """Return a mask of spectra that are not zero.

    Args:
        value: unpolarized spectrum.
    """
    return dr.max(dr.abs(value)) > 0
