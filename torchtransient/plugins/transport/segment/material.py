"""Segments through vacuum whose ends follow their shapes in derivatives: vertices are material points.

Where a scene is lit through one point and seen through another, as around a corner, its outlines are what changes most
when a body moves. Vertices that slide along the rays that found them leave the outlines to a boundary term. Material
points carry them along: with the density held fixed per material area, the integral over the area of a body,

    I = int  f G  dA(theta),   G = cos cos' / r^2,

has no boundary that moves, and what is left are the edges of bodies that hide each other.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.transport.carry import slope_only
from torchtransient.plugins.transport.scattering.geometry_terms import distance, material_point
from torchtransient.plugins.transport.segment.vacuum import Vacuum
from torchtransient.plugins.transport.strategy import Local


class MaterialVacuum(Vacuum):
    """In renders as :class:`.vacuum.Vacuum`. In derivatives the ray decides over the first vertex alone, and over those
    behind delta lobes: all others are points of their shapes.
    """

    def attached(self, world, v, carry, wanted):
        vertex = super().attached(world, v, carry, wanted)
        if not wanted.geometry:
            return vertex
        free = self._free(world, v)
        followed, _ = material_point(v.pi, v.ray, free & vertex.sid.is_valid(), world.contents.meshes)
        si = dr.select(free, dr.replace_grad(vertex.sid, followed), vertex.si)
        si.wi = dr.select(vertex.sid.is_valid(), si.to_local(-carry.w), -carry.w)
        vertex.si = si
        # The vertex before has counted the segment between two material points.
        vertex.slope = dr.select(free, carry.slope, vertex.slope)
        return vertex

    @staticmethod
    def _free(world, v):
        return v.active & ~v.before(world.scattering.name, "delta", at_sensor=True)

    def motion(self, world, vertex, following, ahead):
        v, si = vertex.v, vertex.scattered_si
        after = v.after()
        point, area = material_point(after.pi, after.ray, ahead, world.contents.meshes)
        to = dr.select(ahead, point.p - si.p, mi.Vector3f(following.d))
        r2 = dr.squared_norm(to)
        d = to * dr.rsqrt(r2)
        cos = dr.abs_dot(dr.select(ahead, point.n, mi.Normal3f(dr.detach(d))), d)
        measure = dr.select(ahead & (cos > 0), area * cos / r2, 1)
        longer = slope_only(distance(si.p, point.p, ahead))
        return Local(
            d=dr.replace_grad(mi.Vector3f(following.d), d), J=dr.relative_grad(measure), drag=mi.Vector3f(0),
            longer=lambda: longer,
        )  # fmt: skip


class FoundVacuum(MaterialVacuum):
    """The same for walks with guides, which look at the end of a segment before they weigh it: what was found there is
    carried to the next turn of the loop. A leg is ``pi`` and ``si``, of which the loop keeps what is used.
    """

    def first(self, world, ray, sampler):
        return self.known(super().first(world, ray, sampler), ray)

    def known(self, pi, ray):
        return {"pi": pi, "si": pi.compute_surface_interaction(ray, mi.RayFlags.All)}

    def depart(self, world, ray, vertex, β, sampler, active):
        pi = super().depart(world, ray, vertex, β, sampler, active)
        return {"pi": pi, "si": pi.compute_surface_interaction(ray, mi.RayFlags.All, active)}

    def surface_of(self, leg):
        return leg["pi"], mi.Bool(True)

    def found(self, leg, ray, flags, active=True):
        return leg["si"]
