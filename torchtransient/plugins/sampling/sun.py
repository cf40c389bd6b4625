"""The sun in a sky whose direction has a derivative.

Its disk has an edge, and nothing but the edge tells where it is: at fixed directions hardly anything changes. So the
directions into the disk turn with it, as points on lights follow a moving shape. The sky around keeps its directions.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.mitsuba_compat import sun_half_angle
from torchtransient.plugins.sampling.rare_lights import is_rare

# The disk is taken this much wider than Mitsuba's, whose own test of its edge rounds in single precision.
_MARGIN = 1.001


class MovingSun:
    """The disk of one sky. ``rare``: it is hardly ever drawn, and paths that escape into it have to do
    (:mod:`.rare_lights`).

    A plain class on purpose: Dr.Jit loops would take a dataclass apart as loop state.
    """

    def __init__(self, scene: Any, emitter: Any) -> None:
        self.rare = is_rare(scene, emitter)
        params = mi.traverse(emitter)
        to_world = mi.AffineTransform4f(params["to_world"])
        # Mitsuba keeps two angles, taken as those of a unit vector whatever its length: where the sun is seen follows
        # from them alone.
        angles = mi.dir_to_sph(to_world.inverse() @ mi.Vector3f(params["sun_direction"]))
        self.direction = dr.normalize(to_world @ mi.sph_to_dir(*angles))
        self._cosine = float(dr.cos(_MARGIN * sun_half_angle(emitter)))

    @staticmethod
    def of(world: Any) -> MovingSun | None:
        """The one that a job asks the derivative of, if it does."""
        sky = None if world.wanted is None else world.wanted.sky
        return None if sky is None else MovingSun(world.scene, sky)

    def contains(self, d: Any) -> Any:
        """Whether the unit direction ``d`` points into the disk."""
        return dr.dot(self.direction, d) >= self._cosine

    def shines(self, emitter: Any, d: Any) -> Any:
        """Whether light of ``emitter`` from the direction ``d`` is the sun's: of the light without a place that comes
        from all around, which a scene has one of, and not of a directional one before it.
        """
        flags = emitter.flags()
        around = mi.has_flag(flags, mi.EmitterFlags.Infinite) & ~mi.has_flag(flags, mi.EmitterFlags.DeltaDirection)
        return around & self.contains(d)

    def followed(self, d: Any, active: Any) -> Any:
        """``d``, turning with the sun where ``active``."""
        turn = dr.cross(dr.detach(self.direction), self.direction)
        return dr.select(active, dr.replace_grad(d, d + dr.cross(turn, d)), d)
