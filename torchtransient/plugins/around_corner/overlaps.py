"""Surfaces that lie in each other: what a ray meets there is chance, and a sum over areas counts both.

Lines to drawn points end just before them (:func:`.geometry.occluded`), so nothing that lies nearer than that can hide
a point: of two surfaces at one place both are seen. Whether there are such places is asked of drawn points themselves,
of shapes of all kinds: what is free to see, has a ray that is sent there met it?
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.plugins.around_corner.geometry import OFFSET, sees
from torchtransient.plugins.pointer_table import registry_number
from torchtransient.plugins.sampling.area_elements import TRIANGLE
from torchtransient.plugins.sampling.hidden_elements import HiddenElements
from torchtransient.plugins.sampling.point_sets import plane_points
from torchtransient.plugins.transport.strategy import Local

# Points that are looked at from the wall, and as many from those that are seen.
POINTS = 2**13
# So many of them have to lie in something else. Where surfaces cross, rounding finds one in a hundred thousand.
FEWEST = 3
# Heights over each other, in offsets, at which lines see both of two surfaces.
_HEIGHT = 4.0
# Share of a triangle's barycentric coordinates that belongs to its edges, where a ray may meet the neighbour.
_EDGE = 0.01
_SEEDS = (0x51ED270B, 0x7FEB352D)


def overlaps(scene: Any, elements: HiddenElements, points: np.ndarray, normals: np.ndarray) -> list[str]:
    """Names of the shapes that lie in others, or whose own triangles lie in each other, where light finds them: seen
    from wall points ``(P, 3)``, or from what those see. Overlaps of less than one in two thousand of the density of
    ``elements`` may stay unnoticed.
    """
    with dr.suspend_grad():
        index = dr.arange(mi.UInt32, POINTS) % dr.opaque(mi.UInt32, len(points))
        p, n = mi.Point3f(points.T), mi.Vector3f(normals.T)
        dr.make_opaque(p, n)
        viewer = Local(p=dr.gather(mi.Point3f, p, index), geometric_n=dr.gather(mi.Vector3f, n, index))
        found, active = np.zeros(0, dtype=np.uint32), mi.Mask(True)
        for seed in _SEEDS:
            target, active, contested = _look(scene, elements, viewer, dr.opaque(mi.UInt32, seed), active)
            numbers = dr.reinterpret_array(mi.UInt32, target.shape)
            dr.eval(target.p, target.geometric_n, active, contested, numbers)
            found = np.concatenate([found, np.array(numbers)[np.array(contested)]])
            viewer = target
    if len(found) < FEWEST:
        return []
    met = {int(number) for number in np.unique(found)}
    return [shape.id() or shape.class_name() for shape in elements.shapes if registry_number(shape) in met]


def _look(scene: Any, elements: HiddenElements, viewer: Local, seed: Any, active: Any) -> tuple[Local, Any, Any]:
    """(drawn points with the normals of the sides that are seen, which of them are seen, and of these the ones that
    something else lies in).
    """
    x, y = plane_points(POINTS, seed)
    # Points in another order than those that see them.
    turn = dr.opaque(mi.UInt32, 0x9E3779B1 % POINTS | 1)
    order = dr.arange(mi.UInt32, POINTS) * turn % dr.opaque(mi.UInt32, POINTS)
    x, y = dr.gather(mi.Float64, x, order), dr.gather(mi.Float, y, order)
    element, a = elements.select_element(x)
    p, n = elements.point(element, a, y)
    shape, primitive = elements.surface(element)
    to = mi.Vector3f(p - viewer.p)
    target = Local(p=p, geometric_n=dr.mulsign(mi.Vector3f(n), -dr.dot(n, to)), shape=shape)
    # From behind, too: what turns its back to the viewer may be what the ray meets of two surfaces.
    seen = sees(scene, viewer, p, target.geometric_n, active)
    # A ray that starts where the line does, and goes on.
    length = dr.norm(to)
    offset = OFFSET * (dr.max(dr.abs(p)) + length)
    o = mi.Point3f(viewer.p + viewer.geometric_n * dr.mulsign(offset, dr.dot(viewer.geometric_n, to)))
    ray = mi.Ray3f(o, dr.normalize(p - o))
    pi = scene.ray_intersect_preliminary(ray, coherent=False, active=seen)
    height = dr.abs(dr.dot(target.geometric_n, o + ray.d * pi.t - p))
    other = seen & pi.is_valid() & ((pi.shape != shape) | (pi.prim_index != primitive))
    return target, seen, other & (height <= _HEIGHT * offset) & _is_inside(elements, element, a, y)


def _is_inside(elements: HiddenElements, element: Any, a: Any, y: Any) -> Any:
    """Whether points are off the edges of their triangles."""
    uv = elements.coordinates(element, a, y)
    least = dr.minimum(dr.minimum(uv.x, uv.y), 1 - uv.x - uv.y)
    return (elements.kind(element) != TRIANGLE) | (least > _EDGE)
