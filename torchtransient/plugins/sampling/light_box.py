"""A lower bound of what a path still has to travel: the way to the nearest point where a light could be."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

# Distances are single precision sums of a few terms; a bound must never be longer than what it bounds.
MARGIN = 1e-5


class LightBox:
    """The box around all lights of a scene. A plain object, which Dr.Jit loops leave alone."""

    def __init__(self, low, high):
        self._low, self._high = mi.Point3f(low), mi.Point3f(high)
        dr.make_opaque(self._low, self._high)

    @staticmethod
    def of(scene, bsdfs) -> LightBox | None:
        """The box of a scene's lights; None where lights are infinitely far, have no known place, or where light can
        pass into a medium of another index, in which optical lengths may be shorter than geometric ones.
        """
        if any(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Transmission) for bsdf in bsdfs):
            return None
        total = mi.ScalarBoundingBox3f()
        for emitter in scene.emitters():
            if mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite):
                return None
            shape = emitter.get_shape()
            box = emitter.bbox() if shape is None else shape.bbox()
            if not box.valid():
                return None
            total.expand(box)
        return LightBox(total.min, total.max) if total.valid() else None

    def distance(self, p):
        """Least distance from ``p`` to a light."""
        away = dr.maximum(dr.maximum(self._low - p, p - self._high), 0)
        return dr.norm(away) * (1 - MARGIN)
