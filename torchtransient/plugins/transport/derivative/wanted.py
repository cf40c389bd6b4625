"""Which derivatives a job asks for."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.sensors.origin import shapes_of_sensors

SENSOR_KEYS = (
    "to_world",
    "x_fov",
    "principal_point_offset_x",
    "principal_point_offset_y",
    "aperture_radius",
    "focus_distance",
)


class Wanted:
    """Built once a job, outside of traced code; does not change afterwards.

    ``geometry``: path lengths change. ``light``: the position of a light without a shape does. ``emitter_shape``: the
    shape of a light moves. ``sphere_lights``: path lengths change and some lights are spheres. ``sensor``: the sensor
    moves. ``index``: an index of refraction changes. ``ray``: the ray itself is handed on, behind delta lobes or a
    sensor that moves. ``extinction``: that of a medium changes. ``carried``: the fields of the
    :class:`~..carry.Carry` that derivatives go through.
    """

    def __init__(self, scene, sensor, contents):
        shapes = any(shape.parameters_grad_enabled() for shape in scene.shapes())
        # An instance does not speak of its own transformation.
        shapes |= any(_attached(s, ("to_world",)) for s in scene.shapes() if s.class_name() == "Instance")
        self.emitter_shape = any(s.is_emitter() and s.parameters_grad_enabled() for s in scene.shapes())
        self.light = any(_attached(e, ("position", "to_world")) for e in scene.emitters() if e.get_shape() is None)
        self.sensor = _attached(sensor, SENSOR_KEYS) or any(
            shape is not None and shape.parameters_grad_enabled() for shape in shapes_of_sensors(sensor)
        )
        self.index = any(_attached(bsdf, ("eta",)) for bsdf in contents.bsdfs)
        if contents.refraction is not None:
            self.index |= dr.grad_enabled(contents.refraction.table)
        late = contents.delays is not None and dr.grad_enabled(contents.delays.lifetimes)
        self.geometry = shapes or self.light or self.sensor or self.index or late
        self.sphere_lights = self.geometry and contents.sphere_lights
        self.ray = self.geometry and (contents.delta or self.sensor)
        self.extinction = contents.media is not None and contents.media.density_attached()
        self.carried = ("β",)
        if self.geometry:
            self.carried += ("slope", "w") + (("x",) if contents.media is not None else ())
        if self.ray:
            self.carried += ("o", "d")
        if self.index:
            self.carried += ("η",)
        if contents.media is not None:
            contents.media.check_spheres(self.sphere_lights)


def _attached(plugin, names):
    """Whether one of the parameters called ``names`` of a plugin or its children carries gradients."""
    return any(key.split(".")[-1] in names and dr.grad_enabled(value) for key, value in mi.traverse(plugin))
