"""Which derivatives a job asks for, from what the scene's attached parameters move."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mitsuba as mi

from torchtransient.plugins.parameter_effect import ParameterEffect
from torchtransient.plugins.sensors.origin import sensors_of, shapes_of_sensors
from torchtransient.plugins.transport.boundary.moving_edges import moves_edges


class Wanted:
    """Built once a job, outside of traced code; does not change afterwards.

    ``nodes``: pointers of the plugins with attached parameters. ``geometry``: path lengths change. ``silhouettes``:
    edges move against what is behind them. ``shapes``: pointers of the shapes that move. ``light``: an emitter without
    a shape moves. ``sky``: the emitter whose sun moves, or None.
    ``emitter_shape``: the shape of a light does. ``sphere_lights``: path lengths change and some lights are spheres.
    ``sensor``: the sensor moves. ``index``: an index of refraction changes. ``ray``: the ray itself is handed on,
    behind delta lobes or a sensor that moves. ``plain``: where a point slides on its surface, nothing but its place
    changes. ``extinction``: that of a medium changes. ``carried``: the fields of the :class:`~..carry.Carry` that
    derivatives go through, beside those of the segments.

    ``effects``: (plugin, key, effect) of the attached parameters, see :mod:`torchtransient.plugins.parameters`.
    """

    def __init__(self, effects: Sequence[tuple[Any, str, ParameterEffect]], sensor: Any, contents: Any) -> None:
        def moved(role):
            return [node for node, _, effect in effects if effect.role == role]

        sensors = {one.ptr for one in sensors_of(sensor)}
        carriers = {shape.ptr for shape in shapes_of_sensors(sensor) if shape is not None}
        self.nodes = frozenset(node.ptr for node, _, _ in effects)
        self.geometry = any(effect.moves_length for _, _, effect in effects)
        self.silhouettes = any(moves_edges(key, effect) for _, key, effect in effects)
        self.shapes = frozenset(shape.ptr for shape in moved("shape"))
        self.light, self.index = bool(moved("emitter")), bool(moved("index"))
        self.sky = next(iter(moved("sun")), None)
        self.emitter_shape = any(isinstance(node, mi.Shape) and node.is_emitter() for node in moved("shape"))
        self.sensor = any(node.ptr in sensors for node in moved("sensor"))
        self.sensor |= any(node.ptr in carriers for node in moved("shape"))
        self.sphere_lights = self.geometry and contents.sphere_lights is not None
        self.ray = self.geometry and (contents.delta or self.sensor)
        bent = any(key.endswith(("vertex_normals", "vertex_positions")) for _, key, _ in effects)
        self.plain = self.geometry and not (self.ray or bent or contents.patterned)
        self.extinction = any(effect.moves_medium for _, _, effect in effects)
        self.carried: tuple[str, ...] = ("β",)
        if self.geometry:
            self.carried += ("slope", "w", "o")
        if self.geometry and contents.media is not None:
            self.carried += ("x",)
        if self.ray:
            self.carried += ("d",)
        if self.index:
            self.carried += ("η",)
        if contents.media is not None:
            contents.media.check_spheres(self.sphere_lights)
            contents.media.check_sun(self.sky is not None)
