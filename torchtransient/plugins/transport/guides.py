"""Guide of scattering in NLOS scenes: some of the next vertices are drawn over the area of the hidden surfaces."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.transport.strategy import Guide, GuidedPoint


class HiddenGeometry(Guide):
    """Draws points on hidden surfaces, more of them where the relay wall sees most of the light.

    ``elements``: the :class:`~torchtransient.plugins.sampling.hidden_elements.HiddenElements` of the job.
    ``at_wall``: its share of the samples that leave the first vertex; ``beyond``: of the others. Hidden surfaces light
    each other best as their BSDFs say, so ``beyond`` is small, and less than one since a body close to another one
    would have no bounded variance.
    """

    name = "hidden_geometry"

    def __init__(self, elements, at_wall, beyond):
        self.elements, self.at_wall, self.share = elements, at_wall, beyond

    def share_at(self, depth):
        return dr.select(depth == 0, mi.Float(self.at_wall), mi.Float(self.share))

    def draw(self, context, vertex, x, y):
        p, n, uv, shape, primitive = self.elements.draw_with_surface(x, y, vertex.goes_on)
        return GuidedPoint(p, shape, primitive, n, uv)

    def density(self, context, p, q, n, shape, active, primitive=None):
        v = dr.select(active, q - p, mi.Vector3f(0, 0, 1))
        if primitive is None:  # a light was asked for a point of its shape, and does not say of which triangle
            ray = mi.Ray3f(mi.Point3f(p), dr.normalize(v))
            with dr.suspend_grad():
                primitive = shape_hit(context, ray, shape, active)
        per_area = self.elements.per_area(shape, primitive, q, active)
        d2 = dr.squared_norm(v)
        cos = dr.abs_dot(n, v) * dr.rsqrt(d2)
        return dr.select(active & (cos > 0), per_area * d2 / cos, 0)


def shape_hit(context, ray, shape, active):
    """Number of the triangle of ``shape`` that a ray meets first (of what is hidden from there, any will do)."""
    found = context.segment.next_surface(context, ray, active)
    return dr.select(active & (found.shape == shape), found.prim_index, 0)
