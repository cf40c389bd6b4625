"""Arrival time of light from infinitely distant emitters.

Light of an environment map or a directional emitter has no point of departure. Here t = 0 when its wavefront touches
the sphere around the scene: the plane with normal ``d`` (towards the light) at ``center + radius d``. A point ``x`` is
reached after ``radius - dot(x - center, d)``, which a plane wave demands and which no choice of path can change.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.mitsuba_compat import bounds_of


class DistantReference:
    """Sphere whose tangent planes distant light leaves at t = 0."""

    def __init__(self, center: tuple[float, float, float], radius: float):
        self.center, self.radius = center, radius

    def length(self, point, direction):
        """Optical path length in vacuum from the tangent plane to ``point``; ``direction`` points to the light."""
        return self.radius - dr.dot(point - mi.ScalarPoint3f(*self.center), direction)


def distant_reference(scene) -> DistantReference:
    """The sphere around all shapes of ``scene``."""
    box = mi.ScalarBoundingBox3f()
    for shape in scene.shapes():
        box.expand(bounds_of(shape))
    if not box.valid():
        return DistantReference((0.0, 0.0, 0.0), 0.0)
    sphere = box.bounding_sphere()
    return DistantReference(tuple(float(v) for v in sphere.center), float(sphere.radius))
