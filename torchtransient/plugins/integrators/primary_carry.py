"""What derivatives of the paths of a pass have to do with the sensor: the Carry of its primary rays."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.polarized import rotation_tangent
from torchtransient.plugins.sensors.origin import sensor_rotation
from torchtransient.plugins.transport.carry import Carry
from torchtransient.plugins.transport.derivative.forward import tangents_of


def objective_of(world: Any, rays: Any, adjoint: Carry) -> Any:
    """``<adjoint, Carry>`` of the primary rays."""
    parts = {"η": adjoint.η}
    if not world.camera_unwarp:
        parts["slope"] = adjoint.slope
    if world.wanted.sensor:
        parts |= {"o": adjoint.o + adjoint.x, "d": adjoint.d + adjoint.w}
        if mi.is_polarized:
            parts["turn"] = dr.sum(adjoint.β[1, 2] - adjoint.β[2, 1])
    # Each entry of a pose is a sum over lanes by itself: without numbers in memory each traces the paths once more.
    dr.eval(parts)
    objective = parts["η"] * rays.η
    if "slope" in parts:
        objective += parts["slope"] * rays.length()
    if world.wanted.sensor:
        objective += dr.dot(parts["o"], rays.ray.o) + dr.dot(parts["d"], rays.ray.d)
    if "turn" in parts:
        objective += parts["turn"] * sensor_rotation(rays.seen, rays.ray).angle()
    return objective


def tangent_of(world: Any, rays: Any) -> Carry:
    """The tangent of the Carry of the primary rays."""
    tangent = Carry.zeros()
    with dr.resume_grad():
        if not (world.wanted.sensor or dr.grad_enabled(rays.η)):
            return tangent
        attached = [rays.ray.o, rays.ray.d, rays.length(), rays.η]
        if mi.is_polarized:
            attached.append(sensor_rotation(rays.seen, rays.ray).angle())
        o, d, length, η, *rotation = tangents_of(attached)
    tangent.o, tangent.x = mi.Vector3f(o), mi.Vector3f(o)
    tangent.d, tangent.w = mi.Vector3f(d), mi.Vector3f(d)
    tangent.slope = mi.Float(0) if world.camera_unwarp else mi.Float(length)
    tangent.η = mi.Float(η)
    if mi.is_polarized:
        tangent.β = rotation_tangent(rotation[0])
    return tangent
