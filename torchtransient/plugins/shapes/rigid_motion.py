"""``rigid_motion``: velocity of a rigid body."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins._registry import register
from torchtransient.plugins.parameter_effect import ParameterEffect, declare_effects
from torchtransient.plugins.properties import vector

PARAMETERS = ("linear", "angular", "center")


class RigidMotion(mi.Texture):
    r"""Velocity of a rigid body (:monosp:`rigid_motion`): a point p has ``linear + angular x (p - center)``.

    ``linear`` (m/s), ``angular`` (rad/s, right-handed), ``center`` (m): three numbers each, in the world; zero.
    ``of`` (string): name of the body, for a motion that is a child of the scene: a shape, an instance, an emitter, a
    sensor or a medium. A shape may hold its motion itself, as its child ``velocity``: it is a texture since shapes take
    textures of any name as children.

    Poses stay those of one instant. Films of rates measure how fast the lengths of paths change there.
    """

    def __init__(self, props):
        super().__init__(props)
        self.of = str(props.get("of", ""))
        for name in PARAMETERS:
            value = mi.Vector3f(vector(props, name, (0.0, 0.0, 0.0)))
            dr.make_opaque(value)
            setattr(self, name, value)

    def traverse(self, cb):
        for name in PARAMETERS:
            cb.put(name, getattr(self, name), mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys):
        pass

    def rows(self):
        """Return (velocity of the body's point at the origin of the world, angular velocity), Vector3f."""
        return self.linear - dr.cross(self.angular, self.center), self.angular

    def to_string(self):
        values = ", ".join(f"{name} = {getattr(self, name)}" for name in PARAMETERS)
        return f"RigidMotion[of = {self.of!r}, {values}]"


register("texture", "rigid_motion", RigidMotion)
declare_effects(RigidMotion, dict.fromkeys(PARAMETERS, ParameterEffect(moves_length=True, role="velocity")))
