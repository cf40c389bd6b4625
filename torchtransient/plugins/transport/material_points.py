"""Segments of captures around a corner: material points in derivatives, as in :mod:`.vacuum`, that are never dragged.

Where a scene is lit through one point and seen through another, as around a corner, hidden bodies keep their distance
from the wall, so that damping buys nothing; ends that a guide has drawn are handed on with their normals.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.around_corner.geometry import sees
from torchtransient.plugins.transport.carry import slope_only
from torchtransient.plugins.transport.geometry_terms import distance
from torchtransient.plugins.transport.strategy import Local
from torchtransient.plugins.transport.vacuum import AttachedTriangles, Vacuum


class MaterialVacuum(Vacuum):
    """Segment like :class:`.vacuum.Vacuum`, without a damping radius."""

    drags = False

    def prepare(self, context):
        super().prepare(context)
        moving = frozenset() if context.wanted is None or not context.wanted.geometry else context.wanted.shapes
        self.triangles = AttachedTriangles(context.scene.shapes(), moving)
        # Lambertian surfaces read the point and its normal alone. The segment that gathers a triangle's vertices hands
        # both on in the Carry, so that each is back-propagated to once.
        self.carried = ("p", "n") if moving and self.triangles.holds_all and context.scattering.turns_freely else ()

    def attached(self, context, v, carry, wanted):
        vertex = super().attached(context, v, carry, wanted)
        if wanted.geometry:
            # The vertex before has counted the segment between two material points.
            vertex.slope = dr.select(self._free(context, v), carry.slope, vertex.slope)
        return vertex

    def attached_surface(self, context, v, carry, ray, wanted, active):
        if not wanted.geometry:
            return super().attached_surface(context, v, carry, ray, wanted, active)
        # Each lane asks for one of the two: what is back-propagated to a surface is scattered for every active lane.
        free = self._free(context, v)
        found = super().attached_surface(context, v, carry, ray, wanted, active & ~free)
        return dr.select(free, self._material(v, carry, active & free), found)

    def _material(self, v, carry, active):
        """Return hits as material points."""
        flags = mi.RayFlags.All | mi.RayFlags.FollowShape
        if not self.carried:
            return v.pi.compute_surface_interaction(v.ray, flags, active)
        with dr.suspend_grad():
            si = v.pi.compute_surface_interaction(v.ray, flags, active)
        si.p, si.n = dr.replace_grad(si.p, carry.p), dr.replace_grad(si.n, carry.n)
        si.sh_frame.n = dr.replace_grad(si.sh_frame.n, dr.mulsign(carry.n, dr.dot(si.sh_frame.n, si.n)))
        return si

    @staticmethod
    def _free(context, v):
        return v.active & ~v.before(context.scattering.name, "delta", at_sensor=True)

    def motion(self, context, vertex, following, ahead):
        v, si = vertex.v, vertex.scattered_si
        after = v.after()
        p, n, area = self.material_hits(context, after.pi, after.ray, following.n, ahead)
        to = dr.select(ahead, p - si.p, mi.Vector3f(following.d))
        r2 = dr.squared_norm(to)
        d = to * dr.rsqrt(r2)
        cos = dr.abs_dot(dr.select(ahead, n, mi.Normal3f(d)), d)
        measure = dr.select(ahead & (cos > 0), area * cos / r2, 1)
        longer = slope_only(distance(si.p, p, ahead))
        return Local(
            d=dr.replace_grad(mi.Vector3f(following.d), d), J=dr.relative_grad(measure), drag=mi.Vector3f(0),
            longer=lambda: longer, p=dr.select(ahead, p, 0), n=dr.select(ahead, n, 0),
        )  # fmt: skip


class FoundVacuum(MaterialVacuum):
    """Segments of walks with guides, which carry the interaction at their end to the next iteration.

    The scattering looks it up before it weighs the segment. A leg is ``pi`` and ``si``, of which the loop keeps the
    fields that are used.

    Args:
        overlaps: some points that guides draw lie in another surface (:mod:`~..around_corner.scan_table`).
    """

    def __init__(self, overlaps):
        self.overlaps = overlaps

    def first(self, context, ray, sampler):
        return self.leg_to(super().first(context, ray, sampler), ray)

    def leg_to(self, pi, ray):
        return {"pi": pi, "si": pi.compute_surface_interaction(ray, mi.RayFlags.All)}

    def depart(self, context, ray, vertex, β, sampler, active):
        # One by one: of surfaces at one place, what a packet of rays meets depends on where the others go.
        pi = context.scene.ray_intersect_preliminary(ray, coherent=False, active=active)
        return {"pi": pi, "si": pi.compute_surface_interaction(ray, mi.RayFlags.All, active)}

    def depart_guided(self, context, ray, vertex, step, sampler, active):
        target = step.target
        # Of surfaces in surfaces, a ray meets one.
        if target is None or self.overlaps:
            return self.depart(context, ray, vertex, vertex.β, sampler, active)
        # What a guide has drawn is there: all that is asked is whether it is seen, which rays find faster than what
        # they meet.
        guided = active & step.guided
        pi = context.scene.ray_intersect_preliminary(ray, coherent=False, active=active & ~guided)
        start, end = Local(p=vertex.at.p, geometric_n=mi.Vector3f(vertex.at.n)), step.point
        n = dr.mulsign(mi.Vector3f(target.n), dr.dot(target.n, start.p - end))
        seen = sees(context.scene, start, end, n, guided)
        pi.t = dr.select(guided, dr.select(seen, dr.norm(end - ray.o), dr.inf), pi.t)
        pi.prim_uv = dr.select(guided, target.uv, pi.prim_uv)
        pi.prim_index = dr.select(guided, step.primitive, pi.prim_index)
        pi.shape = dr.select(guided, step.shape, pi.shape)
        pi.shape_index = dr.select(guided, 0xFFFFFFFF, pi.shape_index)
        pi.valid = dr.select(guided, seen, pi.valid)
        return {"pi": pi, "si": pi.compute_surface_interaction(ray, mi.RayFlags.All, active)}

    def surface_of(self, leg):
        return leg["pi"], mi.Bool(True)

    def interaction_of(self, leg, ray, flags, active=True):
        return leg["si"]
