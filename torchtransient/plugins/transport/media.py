"""Segments through participating media.

A vertex in a medium slides along the ray that found it, as one on a surface does: it divides the stretch between the
surfaces before and behind it in a fixed ratio, so that it never leaves the medium when one of them moves, and the
stretch's length enters as the measure of what was integrated. Where nothing that moves bounds the stretch it is a fixed
point.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.polarized import attenuated
from torchtransient.plugins.sampling.rays import shortest
from torchtransient.plugins.transport.free_flight import (
    ARRIVING,
    CONNECTING,
    EMITTING,
    Leg,
    closed_surface,
    medium_along,
    medium_interaction,
    sample_free_flight,
    transmittance,
    with_log_slope,
)
from torchtransient.plugins.transport.geometry_terms import displacement
from torchtransient.plugins.transport.scene_contents import FlightSettings
from torchtransient.plugins.transport.strategy import Local, Vertex, VertexEnd
from torchtransient.plugins.transport.surface_interactions import distance_to, surface_interaction
from torchtransient.plugins.transport.vacuum import Vacuum, intersection, intersection_fields, intersection_numbers


class Media(Vacuum):
    """Segment that can end in a medium, and passes open boundaries.

    A leg is a dictionary: ``pi`` (the next surface), ``scatter`` (the leg ends in a medium, at distance ``t`` from the
    ray's origin), ``medium`` (at its end), ``weight`` (transmittance over density); for derivatives also ``begin`` (the
    medium at its start) and ``entry`` (the boundary passed last).

    Attributes:
        keeps_begin: legs have ``begin`` in renders, too.
    """

    clip = None
    keeps_begin = False

    def prepare(self, context):
        super().prepare(context)
        self.settings = FlightSettings(context.contents.media, context.wanted, context.hide_emitters, context.surfaces)

    def start(self, context, rays):
        super().start(context, rays)
        self.clip = rays.clip

    # ------------------------------------------------------------------------------------------------- primal

    def first(self, context, ray, sampler):
        medium = dr.zeros(mi.MediumPtr, dr.width(ray.d))
        if self.settings.at_sensor is not None:
            medium = mi.MediumPtr(self.settings.at_sensor)
        return self._leg(context, ray, medium, mi.UnpolarizedSpectrum(1), sampler, mi.Bool(True), True, self.clip)

    def depart(self, context, ray, vertex, β, sampler, active, seen=False):
        medium = medium_behind(vertex.si, ray.d, vertex.medium, vertex.surface)
        return self._leg(context, ray, medium, mi.unpolarized_spectrum(β), sampler, active, first=seen)

    def _leg(self, context, ray, medium, carried, sampler, active, first=False, clip=None):
        u, lanes = sampler.next_1d(), lane_numbers(sampler)
        end = sample_free_flight(context.scene, self.settings, ray, medium, carried, u, lanes, active, first, clip)
        t = end.t
        if self.settings.geometry:
            # A collision on top of the vertex before has no direction to it: as far as single precision can tell apart.
            t = dr.maximum(t, shortest(ray.o))
        leg = {"pi": end.pi, "scatter": end.scatter, "t": t, "medium": end.medium, "weight": end.weight}
        if self.settings.recorded or self.keeps_begin:
            leg["begin"] = medium
        if self.settings.keeps_entry:
            leg["entry"] = end.entry
        return leg

    def arrive(self, context, path):
        leg, scatter = path.leg, path.leg["scatter"]
        mei = medium_interaction(path.ray, leg["medium"], leg["t"])
        si = leg["pi"].compute_surface_interaction(path.ray, mi.RayFlags.All, ~scatter)
        at, valid = reference(si, mei, scatter), si.is_valid() | scatter
        return Vertex(
            si=si, at=at, valid=valid, surface=~scatter, β=attenuated(path.β, leg["weight"]), ray=path.ray, leg=leg,
            scatter=scatter, mei=mei, medium=leg["medium"], opl=self.optical_length(context, path, at.p, valid),
        )  # fmt: skip

    def interaction_of(self, leg, ray, flags, active=True):
        return leg["pi"].compute_surface_interaction(ray, flags, active)

    def surface_of(self, leg):
        return leg["pi"], ~leg["scatter"]

    def length_of(self, leg):
        return dr.select(leg["scatter"], leg["t"], leg["pi"].t), leg["scatter"] | leg["pi"].is_valid()

    def ends_at(self, pi, medium):
        leg = {"pi": pi, "scatter": mi.Bool(False), "t": mi.Float(pi.t), "medium": medium}
        leg["weight"] = mi.UnpolarizedSpectrum(1)
        if self.settings.recorded:
            leg["begin"] = medium
        if self.settings.keeps_entry:  # not read: nothing is recorded here
            leg["entry"] = pi
        return leg

    def medium_towards(self, d, vertex=None):
        if vertex is not None:
            return medium_behind(vertex.si, d, vertex.medium, vertex.surface)
        lanes = dr.zeros(mi.MediumPtr, dr.width(d))
        return lanes if self.settings.at_sensor is None else mi.MediumPtr(self.settings.at_sensor)

    def medium_at(self, context, p, start, medium, active):
        if not self.settings.transitions:
            return medium
        ray = mi.Ray3f(start, dr.normalize(p - start))
        ray.maxt = dr.norm(p - start)
        return medium_along(context.scene, ray, medium, active)

    def share_of_surface(self, leg):
        return dr.select(leg["scatter"], leg["t"] / leg["pi"].t, 1)

    def transmittance(self, context, vertex, ds, u, sampler, active, seen=False):
        ray = vertex.at.spawn_ray_to(ds.p)
        medium = medium_behind(vertex.si, ds.d, vertex.medium, vertex.surface)
        lanes = lane_numbers(sampler)
        hide = seen and self.settings.hide_emitters
        T, free = transmittance(context.scene, self.settings, ray, ds.dist, medium, [u.x, u.y], lanes, active, hide)
        return free, T

    def next_surface(self, context, ray, active):
        return closed_surface(context.scene, self.settings, ray, active)

    # ------------------------------------------------------------------------------------------------- record

    def fields(self, context):
        fields = super().fields(context) | {
            "scatter": mi.Bool, "t_end": mi.Float, "begin": mi.UInt32, "end": mi.UInt32,
            "weight": mi.UnpolarizedSpectrum,
        }  # fmt: skip
        return fields | (intersection_fields(context, "entry_") if self.settings.keeps_entry else {})

    def record(self, vertex):
        leg, of_ray = vertex.leg, Local(ray=vertex.ray, leg=vertex.leg["pi"])
        begin, end = (dr.reinterpret_array(mi.UInt32, leg[key]) for key in ("begin", "medium"))
        values = super().record(of_ray) | {"begin": begin, "end": end}
        values |= {"scatter": leg["scatter"], "t_end": leg["t"], "weight": leg["weight"]}
        return values | (intersection_numbers(leg["entry"], "entry_") if "entry" in leg else {})

    def restore(self, v, ray):
        r = v.record_of(self.name)
        v.scatter, v.t, v.weight = r["scatter"], r["t_end"], r["weight"]
        v.begin, v.end = (dr.reinterpret_array(mi.MediumPtr, r[name]) for name in ("begin", "end"))
        v.entry = intersection(r, v.active, "entry_") if self.settings.keeps_entry else None
        return super().restore(v, ray)

    def weight(self, v):
        return v.weight

    # ----------------------------------------------------------------------------------------------- attached

    def end(self, context, v):
        si = v.pi.compute_surface_interaction(v.ray, mi.RayFlags.Minimal, v.active & ~v.scatter)
        t = dr.select(v.scatter, v.t, si.t)
        n = dr.select(v.scatter, mi.Normal3f(0), si.n)
        return VertexEnd(t, n, v.ray.d, v.active & (si.is_valid() | v.scatter))

    def has_no_normal(self, end):
        return dr.all(end.n == 0)

    def attached(self, context, v, carry, wanted):
        start = carry.o
        if wanted.geometry:
            carry = self.from_meter(context, v, carry)
        ray = mi.Ray3f(v.ray)
        ray.o, ray.d = carry.o, carry.d
        si, mei, stretch = self._surface_or_medium(context, v, carry, ray, wanted)
        vertex = self.arrived(context, v, carry, ray, si, wanted)
        vertex.scatter, vertex.mei = v.scatter, mei
        far = ~vertex.sid.is_valid()
        clip = None if self.clip is None else dr.select(v.k == 0, self.clip, 0)
        leg = Leg(v, v.ray.o, vertex.sid.p, v.ray.d, far, v.begin, ARRIVING, clip)
        T = v.weight * with_log_slope(context.scene, self.settings, leg, carry.x, si.p, carry.β[0], v.active)
        if wanted.geometry:
            T *= dr.relative_grad(dr.select(v.scatter, stretch, 1))
        vertex.carry = replace(carry, β=attenuated(carry.β, T))
        self.add_rate(context, vertex, start, wanted)
        return vertex

    def _surface_or_medium(self, context, v, carry, ray, wanted):
        """Return (interaction, medium interaction, attached length of the stretch that a vertex in a medium divides).

        Vertices in media come as surface interactions too: at the point itself, with no normal and no shape.
        """
        si = surface_interaction(self.settings.surfaces, v.pi, ray, mi.RayFlags.All, v.active & ~v.scatter)
        along, dragged = ray, mi.Bool(False)
        if wanted.geometry:
            # How far a vertex slides sideways depends on its distance: where it divides the stretch must not depend on
            # that again.
            dragged = v.scatter & ~v.before(context.scattering.name, "delta", at_sensor=True)
            along = mi.Ray3f(ray)
            along.o = dr.select(dragged, v.ray.o, ray.o)
        t, stretch = self._attached_distance(v, carry, along, wanted)
        mei = medium_interaction(along, v.end, t)
        if wanted.geometry:
            mei.p = mei.p + displacement(ray.o, dragged)
        mei.wi = -carry.w
        mei.sh_frame = mi.Frame3f(-carry.w)
        si.t = dr.select(v.scatter, t, si.t)
        si.p = dr.select(v.scatter, mei.p, si.p)
        si.n = dr.select(v.scatter, mi.Normal3f(0), si.n)
        si.sh_frame = dr.select(v.scatter, mi.Frame3f(dr.detach(carry.w)), si.sh_frame)
        return si, mei, stretch

    def _attached_distance(self, v, carry, ray, wanted):
        """Return (distance along ``ray`` of a vertex in a medium, length of the stretch that it divides)."""
        if not wanted.geometry:
            return v.t, mi.Float(1)
        begin = dr.dot(carry.x - ray.o, ray.d)
        if self.settings.open_boundaries:
            entered = v.scatter & v.entry.is_valid()
            begin = dr.select(entered, distance_to(self.settings.surfaces, v.entry, ray, entered), begin)
        bounded = v.scatter & v.pi.is_valid()
        end = dr.select(bounded, distance_to(self.settings.surfaces, v.pi, ray, bounded), begin + 1)
        stretch = end - begin
        ratio = dr.detach((v.t - begin) / stretch)
        return dr.fma(ratio, stretch, begin), dr.select(bounded, stretch, 1)

    def attached_transmittance(self, context, vertex, connected, active):
        v = vertex.v
        if connected.ahead:
            stream, medium = EMITTING, v.after().begin
        else:
            stream, medium = CONNECTING, medium_behind(vertex.sid, connected.d, v.end, ~v.scatter)
        leg = Leg(v, vertex.sid.p, dr.detach(connected.p), connected.d, connected.far, medium, stream)
        hook = vertex.carry.β[0]
        return with_log_slope(context.scene, self.settings, leg, vertex.si.p, connected.p, hook, active)


def lane_numbers(sampler):
    """Return the number of each lane, UInt32.

    Args:
        sampler: seeded sampler of the job.
    """
    return dr.arange(mi.UInt32, sampler.wavefront_size())


def reference(si, mei, scatter):
    """Return a vertex as a point of reference, an Interaction3f.

    Args:
        si: SurfaceInteraction3f.
        mei: MediumInteraction3f.
        scatter: mask of vertices in a medium, which have no normal: rays start at the point itself.
    """
    at = dr.zeros(mi.Interaction3f)
    at.t = dr.select(scatter, mei.t, si.t)
    at.time = si.time
    at.wavelengths = si.wavelengths
    at.p = dr.select(scatter, mei.p, si.p)
    # Without a normal, rays start at the point itself.
    at.n = dr.select(scatter, mi.Normal3f(0), si.n)
    return at


def medium_behind(si, d, medium, at_surface):
    """Return the medium of a ray that leaves a vertex.

    Args:
        si: SurfaceInteraction3f of the vertex.
        d: direction of the ray, in the world.
        medium: MediumPtr that the path arrived in.
        at_surface: mask of vertices on surfaces.
    """
    changes = at_surface & si.is_medium_transition()
    return dr.select(changes, si.target_medium(d), medium)
