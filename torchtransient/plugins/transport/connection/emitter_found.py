"""Emission of what a path runs into.

Light that is found moves as every vertex does (``_here``), and as the points of connections do: both strategies must
move their samples alike, or the weights between them would no longer sum to one under the motion. A sun that moves and
is hardly ever drawn is attached at the vertex before (``_sun_ahead``).
"""

from __future__ import annotations

from functools import reduce
from operator import or_

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.polarized import first_column, product, scatter_unpolarized
from torchtransient.plugins.sampling.lights import MovingSun
from torchtransient.plugins.transport.carry import slope_only
from torchtransient.plugins.transport.strategy import Connection, Event, EventTerm, mis_weight


class EmitterFound(Connection):
    """Emission where a path arrives, weighed against the strategies that could have connected to it."""

    name = "emitter_found"
    light_of_scene_alone = True

    def prepare(self, world):
        sun = MovingSun.of(world)
        self.sun = sun if sun is not None and sun.rare else None

    def events(self, wanted):
        return 1 if wanted is None else 1 + (self.sun is not None)

    # ------------------------------------------------------------------------------------------------- primal

    def connect(self, world, path, vertex, proposal, answer, zeros):
        seen = path.active & vertex.surface
        if world.hide_emitters:
            seen &= (path.depth > 0) | vertex.valid
        if world.discard_direct_light:
            seen &= path.depth > 0
        seen = world.deep_enough(seen, path.depth + 1)
        emitter = vertex.si.emitter(world.scene)
        hit = (emitter != None) & seen  # noqa: E711 (a Dr.Jit comparison)
        prev = dr.zeros(mi.Interaction3f)
        prev.p, prev.n = path.prev_p, path.prev_n
        prev.time, prev.wavelengths = path.ray.time, path.ray.wavelengths
        ds = mi.DirectionSample3f(world.scene, si=vertex.si, ref=prev)
        if world.contents.smooth_lights is not None:
            # The face's area, on the side that emission is told by: on a mirrored mesh it is the other one.
            ds.n = dr.mulsign(vertex.si.n, dr.dot(vertex.si.n, ds.d) * dr.dot(ds.n, ds.d))
        connected = hit & ~path.prev_unconnected
        sampled = [c.density(world, prev, ds, connected) for c in world.connections if c is not self]
        sampled = sum(density for density in sampled if density is not None)
        mis = dr.select(hit, mis_weight(path.prev_pdf, sampled), 0)
        value = first_column(vertex.β) * mis * mi.unpolarized_spectrum(emitter.eval(vertex.si, hit))
        return Event(value=value, opl=vertex.τ, active=hit, depth=path.depth + 1, mis=mis)

    # ------------------------------------------------------------------------------------------------- record

    def fields(self, world):
        return {"mis": mi.Float}

    def record(self, sample):
        return {"mis": sample.event.mis}

    # ----------------------------------------------------------------------------------------------- attached

    def attached(self, world, vertex, step, wanted):
        terms = [self._here(world, vertex, wanted)]
        if self.sun is not None:
            terms.append(self._sun_ahead(world, vertex, step))
        return terms

    def _here(self, world, vertex, wanted):
        v, si = vertex.v, vertex.si
        mis = v.of(self.name)["mis"]
        hit = v.active & (mis > 0)
        emitter = vertex.sid.emitter(world.scene)
        elsewhere = self._claimed(world, emitter, v.ray.d, wanted)
        if self.sun is not None:
            shines = self.sun.shines(emitter, v.ray.d)
            elsewhere = shines if elsewhere is None else elsewhere | shines
        if elsewhere is not None:
            hit &= v.before(world.scattering.name, "delta", at_sensor=True) | ~elsewhere
        Le = dr.select(hit, mis * mi.unpolarized_spectrum(emitter.eval(si, hit)), 0)
        value = first_column(vertex.carry.β) * Le
        return EventTerm(value=value, slope=vertex.slope, opl=v.τ, active=hit, arrival=v.arrival(self.name))

    def _claimed(self, world, emitter, d, wanted):
        """Mask of the emitters, in the direction ``d``, that derivatives reach by another strategy alone; None for
        none.
        """
        claims = [c.claims(world, emitter, d, wanted) for c in world.connections if c is not self]
        claims = [c for c in claims if c is not None]
        return reduce(or_, claims) if claims else None

    def _sun_ahead(self, world, vertex, step):
        """Light of the sun along a path that escapes into it: the direction that was drawn turns with it."""
        following = vertex.v.after()
        mis = following.of(self.name)["mis"]
        lit = (step.inv_pdf > 0) & ~step.ahead & (mis > 0)
        with dr.suspend_grad():
            sky = following.pi.compute_surface_interaction(following.ray, mi.RayFlags.Minimal, lit)
            emitter = sky.emitter(world.scene)
            lit &= self.sun.shines(emitter, following.ray.d)
        d = self.sun.followed(mi.Vector3f(following.ray.d), lit)
        sky.wi = -d
        towards = world.scattering.evaluate(world, vertex, d, lit)
        Le = mi.unpolarized_spectrum(emitter.eval(sky, lit))
        value = scatter_unpolarized(towards.value, vertex.rotation) * (step.inv_pdf * mis) * Le
        value = product(vertex.carry.β, dr.select(lit, value, 0))
        length = world.contents.distant.length(vertex.scattered_si.p, d)
        slope = vertex.scattered_slope + slope_only(step.carry.η * length)
        return EventTerm(value=value, slope=slope, opl=following.τ, active=lit, arrival=following.arrival(self.name))
