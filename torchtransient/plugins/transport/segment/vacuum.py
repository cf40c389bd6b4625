"""Segments through vacuum: straight lines from surface to surface."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.sampling.visible_lights import behind_area_lights
from torchtransient.plugins.transport.carry import slope_only
from torchtransient.plugins.transport.contents import DAMPING
from torchtransient.plugins.transport.derivative.vertex import AttachedVertex, VertexEnd
from torchtransient.plugins.transport.instances import surface_interaction
from torchtransient.plugins.transport.scattering.geometry_terms import damped_motion, displacement, slide
from torchtransient.plugins.transport.strategy import Segment, Vertex

# How a preliminary intersection is kept: its shape and instance as numbers in Dr.Jit's registry.
NUMBERS = {"t": "Float", "prim_uv": "Point2f", "prim_index": "UInt32", "shape_index": "UInt32"}


def intersection_fields(world, prefix=""):
    """Types of the numbers that a preliminary intersection is kept as."""
    pointers = ("shape", "instance") if world.contents.instances else ("shape",)
    return {prefix + name: getattr(mi, kind) for name, kind in NUMBERS.items()} | {
        prefix + name: mi.UInt32 for name in pointers
    }


def intersection_numbers(pi, prefix=""):
    """A preliminary intersection as numbers."""
    values = {prefix + name: getattr(pi, name) for name in NUMBERS}
    return values | {prefix + n: dr.reinterpret_array(mi.UInt32, getattr(pi, n)) for n in ("shape", "instance")}


def intersection(numbers, active, prefix=""):
    """The preliminary intersection again."""
    pi = dr.zeros(mi.PreliminaryIntersection3f)
    for name in NUMBERS:
        setattr(pi, name, numbers[prefix + name])
    for name in ("shape", "instance"):
        if prefix + name in numbers:
            setattr(pi, name, dr.reinterpret_array(mi.ShapePtr, numbers[prefix + name]))
    pi.valid = active & (pi.t < dr.inf)
    return pi


def length_to(contents, p, q, valid, d):
    """Length from ``p`` to the point ``q``, or to the distant light in direction ``d`` where ``q`` is not valid."""
    length = dr.norm(dr.select(valid, q - p, mi.Vector3f(0, 0, 1)))
    if contents.distant is None:
        return dr.select(valid, length, 0)
    return dr.select(valid, length, contents.distant.length(p, d))


class Vacuum(Segment):
    """Nothing between surfaces. A leg is the preliminary intersection at its end."""

    # ------------------------------------------------------------------------------------------------- primal

    def first(self, world, ray, sampler):
        pi = world.scene.ray_intersect_preliminary(ray, coherent=True)
        return behind_area_lights(world.scene, ray, pi) if world.hide_emitters else pi

    def depart(self, world, ray, vertex, β, sampler, active):
        return world.scene.ray_intersect_preliminary(ray, active=active)

    def arrive(self, world, path):
        si, (leg, _) = self.found(path.leg, path.ray, mi.RayFlags.All), self.surface_of(path.leg)
        return Vertex(
            si=si, at=si, valid=si.is_valid(), surface=mi.Bool(True), β=path.β, ray=path.ray, leg=leg,
            opl=self.optical_length(world, path, si.p, si.is_valid()),
        )  # fmt: skip

    def optical_length(self, world, path, p, valid):
        """Optical length of the segment that ends at ``p``, measured between hit points."""
        length = dr.norm(p - path.prev_p)
        if world.contents.distant is not None:
            length = dr.select(valid, length, world.contents.distant.length(path.prev_p, path.ray.d))
        if world.camera_unwarp:
            length = dr.select(path.depth == 0, 0, length)
        return mi.Float64(length * path.η)

    def surface_of(self, leg):
        return leg, mi.Bool(True)

    def ends_at(self, pi, medium):
        return pi

    def medium_towards(self, d, vertex=None):
        return None

    def share_of_surface(self, leg):
        return mi.Float(1)

    def found(self, leg, ray, flags, active=True):
        return leg.compute_surface_interaction(ray, flags, active)

    def transmittance(self, world, vertex, ds, u, sampler, active):
        return active & ~world.scene.ray_test(vertex.at.spawn_ray_to(ds.p), active), 1

    def next_surface(self, world, ray, active):
        return world.scene.ray_intersect_preliminary(ray, active=active)

    # ------------------------------------------------------------------------------------------------- record

    def fields(self, world):
        shifted = world.contents.delays is not None and world.contents.delays.shifts
        of_ray = {"o": mi.Point3f, "d": mi.Vector3f} | ({"wavelengths": mi.UnpolarizedSpectrum} if shifted else {})
        return of_ray | intersection_fields(world)

    def record(self, vertex):
        ray = vertex.ray
        return {"o": ray.o, "d": ray.d, "wavelengths": ray.wavelengths} | intersection_numbers(vertex.leg)

    def restore(self, v, ray):
        r = v.of(self.name)
        wavelengths = r.get("wavelengths", ray.wavelengths)
        return mi.Ray3f(r["o"], r["d"], ray.time, wavelengths), intersection(r, v.active)

    # ----------------------------------------------------------------------------------------------- attached

    def end(self, world, v):
        si = v.pi.compute_surface_interaction(v.ray, mi.RayFlags.Minimal, v.active)
        return VertexEnd(si.t, si.n, v.ray.d, si.is_valid() & v.active)

    def attached(self, world, v, carry, wanted):
        ray = mi.Ray3f(v.ray)
        if not wanted.plain:
            ray.o, ray.d = carry.o, carry.d
        return self.arrived(world, v, carry, ray, self.attached_surface(world, v, carry, ray, wanted, v.active), wanted)

    def attached_surface(self, world, v, carry, ray, wanted, active):
        """What ``ray`` finds where ``active``: attached to it and to the surface, along the ray."""
        si = surface_interaction(world.surfaces, v.pi, ray, mi.RayFlags.All, active)
        if wanted.plain:  # an attached ray would have every shape differentiated
            si.p = si.p + slide(displacement(carry.o, active), v.ray.d, dr.detach(si.n), active)
        return si

    def arrived(self, world, v, carry, ray, si, wanted):
        """The attached vertex at ``si``, behind the optical length of its segment."""
        vertex = AttachedVertex(v=v, si=si, sid=dr.detach(si), carry=carry, slope=carry.slope)
        valid = vertex.sid.is_valid()
        vertex.end = VertexEnd(vertex.sid.t, vertex.sid.n, v.ray.d, valid)
        if wanted.geometry:
            # Of what the path sees first, too: a floor without end says nothing of the things that stand on it.
            first = v.first(self.name, "t") * DAMPING
            vertex.damping_radius = dr.minimum(world.contents.damping_radius, first)
            si.wi = dr.select(valid, si.to_local(-carry.w), -carry.w)
            # Shifted sideways, a ray gets no longer.
            o = ray.o if wanted.ray else v.ray.o
            length = length_to(world.contents, o, si.p, valid, ray.d)
            if world.camera_unwarp:
                length = dr.select(v.k == 0, 0, length)
            vertex.slope = carry.slope + slope_only(carry.η * length)
        return vertex

    def motion(self, world, vertex, following, ahead):
        δ, volume = displacement(vertex.scattered_si.p, ahead), self.has_no_normal(following)
        d, radius = mi.Vector3f(following.d), vertex.damping_radius
        return damped_motion(δ, d, following.t, following.n, ahead, radius, volume=volume)
