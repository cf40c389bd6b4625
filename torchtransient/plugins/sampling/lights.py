"""Lights as samples need them: distant ones, the box of all of them, rarely drawn ones, the sun."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.mitsuba_compat import sun_half_angle
from torchtransient.plugins.mitsuba_shapes import bounds_of

# --------------------------------------------------------------- arrival time of light from infinitely distant emitters
# Light of an environment map or a directional emitter has no point of departure. Here t = 0 when its wavefront touches
# the sphere around the scene: the plane with normal ``d`` (towards the light) at ``center + radius d``. A point ``x``
# is reached after ``radius - dot(x - center, d)``, which a plane wave demands and which no choice of path can change.


class DistantReference:
    """Sphere whose tangent planes distant light leaves at t = 0.

    Args:
        center, radius: center and radius of the sphere around the scene, metres.
    """

    def __init__(self, center: tuple[float, float, float], radius: float):
        self.center, self.radius = center, radius

    def length(self, point, direction):
        """Return the optical path length in vacuum from a tangent plane to a point, metres.

        Args:
            point: Point3f.
            direction: unit vector to the light.
        """
        return self.radius - dr.dot(point - mi.ScalarPoint3f(*self.center), direction)


def distant_reference(scene) -> DistantReference:
    """Return the sphere around all shapes of a scene, at which light from infinity starts.

    Args:
        scene: Mitsuba scene.
    """
    box = mi.ScalarBoundingBox3f()
    for shape in scene.shapes():
        box.expand(bounds_of(shape))
    if not box.valid():
        return DistantReference((0.0, 0.0, 0.0), 0.0)
    sphere = box.bounding_sphere()
    return DistantReference(tuple(float(v) for v in sphere.center), float(sphere.radius))


# ----------------------------------------------------------------------------------------------------------------------
# A lower bound of what a path still has to travel: the way to the nearest point where a light could be.
#

# Distances are single precision sums of a few terms; a bound must never be longer than what it bounds.
MARGIN = 1e-5


class LightBox:
    """Box around all lights of a scene. A plain object, which Dr.Jit loops leave alone.

    Args:
        low, high: corners of the box.
    """

    def __init__(self, low, high):
        self._low, self._high = mi.Point3f(low), mi.Point3f(high)
        dr.make_opaque(self._low, self._high)

    @staticmethod
    def from_scene(scene, bsdfs) -> LightBox | None:
        """Return the box of a scene's lights, None if it bounds no optical length.

        That is so where lights are infinitely far or have no known place, and where light can pass into a medium of
        another index, in which optical lengths may be shorter than geometric ones.

        Args:
            bsdfs: BSDFs of the scene.
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
        """Return a lower bound of the distance from ``p`` to any light, metres."""
        away = dr.maximum(dr.maximum(self._low - p, p - self._high), 0)
        return dr.norm(away) * (1 - MARGIN)


# ----------------------------------------------------------------------------------------------------------------------
# Lights that are hardly ever drawn (``sampling_weight``), which paths hit nevertheless.
# Where one strategy alone takes the derivative of a light's samples, and draws it once in a thousand samples or never,
# their light would be gone from the derivative, or come from a few of them. Such lights are left to the paths that hit
# them.

# Share of what each light would have of the samples if all were drawn alike, below which one is hardly ever drawn: in a
# scene of a thousand lights each has a thousandth of them.
_LEAST_SHARE = 1e-3


def least_probability(count: int) -> float:
    """Return the probability of being chosen below which a light counts as rarely drawn.

    Args:
        count: number of lights.
    """
    return _LEAST_SHARE / count


def _is_rare(scene: Any, light: Any) -> bool:
    """Return True if a light of a scene is rarely drawn."""
    weights = {emitter.ptr: float(emitter.sampling_weight()) for emitter in scene.emitters()}
    return weights[light.ptr] < least_probability(len(weights)) * sum(weights.values())


# -------------------------------------------------------------------- the sun in a sky whose direction has a derivative
# Its disk has an edge, and nothing but the edge tells where it is: at fixed directions hardly anything changes. So the
# directions into the disk turn with it, as points on lights follow a moving shape. The sky around keeps its directions.

# The disk is taken this much wider than Mitsuba's, whose own test of its edge rounds in single precision.
_MARGIN = 1.001


class MovingSun:
    """Disk of the sun in a sky, whose direction has a derivative.

    A plain class: Dr.Jit loops would take a dataclass apart as loop state.

    Args:
        scene: scene of the sky.
        emitter: the sky.

    Attributes:
        direction: unit vector to the sun in world space, attached.
        rare: the sky is rarely drawn (:func:`_is_rare`), so that paths that escape into the sun take its derivative.
    """

    def __init__(self, scene: Any, emitter: Any) -> None:
        self.rare = _is_rare(scene, emitter)
        params = mi.traverse(emitter)
        to_world = mi.AffineTransform4f(params["to_world"])
        # Mitsuba keeps two angles, taken as those of a unit vector whatever its length: where the sun is seen follows
        # from them alone.
        angles = mi.dir_to_sph(to_world.inverse() @ mi.Vector3f(params["sun_direction"]))
        self.direction = dr.normalize(to_world @ mi.sph_to_dir(*angles))
        self._cosine = float(dr.cos(_MARGIN * sun_half_angle(emitter)))

    @staticmethod
    def from_context(context: Any) -> MovingSun | None:
        """Return the sun of the sky that a job differentiates, or None."""
        sky = None if context.wanted is None else context.wanted.sky
        return None if sky is None else MovingSun(context.scene, sky)

    def contains(self, d: Any) -> Any:
        """Return a mask of unit directions ``d`` that point into the disk."""
        return dr.dot(self.direction, d) >= self._cosine

    def shines(self, emitter: Any, d: Any) -> Any:
        """Return a mask of light from direction ``d`` that is the sun's, and not that of a directional emitter.

        Args:
            emitter: EmitterPtr of the light.
            d: unit vector towards it.
        """
        flags = emitter.flags()
        around = mi.has_flag(flags, mi.EmitterFlags.Infinite) & ~mi.has_flag(flags, mi.EmitterFlags.DeltaDirection)
        return around & self.contains(d)

    def attach_direction(self, d: Any, active: Any) -> Any:
        """Return ``d``, attached to the rotation of the sun where ``active``."""
        turn = dr.cross(dr.detach(self.direction), self.direction)
        return dr.select(active, dr.replace_grad(d, d + dr.cross(turn, d)), d)
