"""Origin of the time of flight of a sensor's rays."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.mitsuba_compat import (
    is_batch,
    is_distant,
    is_irradiance_meter,
    near_clip,
    starts_off_itself,
)
from torchtransient.plugins.node_walk import objects_of
from torchtransient.plugins.polarized import rotation_between, stokes_frame_of


class View:
    """Sensor, and the lanes that look through it: several for a ``batch``, whose children share a film.

    A plain object, which Dr.Jit loops leave alone.

    Args:
        sensor: the sensor.
        active: mask of its lanes.
        reference: sphere whose tangent plane stands for a sensor at infinity, None for other sensors.
    """

    def __init__(self, sensor: Any, active: Any, reference: Any = None) -> None:
        self.sensor, self.active, self.reference = sensor, active, reference

    @property
    def near(self) -> Any:
        """Distance of the near clip plane along the axis, metres, None for sensors that are no projective cameras."""
        return near_clip(self.sensor)

    def length(self, ray: Any) -> Any:
        """Return the distance in metres from the sensor's origin to ``ray.o``, attached where the sensor is."""
        if is_distant(self.sensor):
            # From the tangent plane that the wave reaches last to where Mitsuba happens to start the ray.
            return self.reference.length(ray.o, -ray.d)
        if starts_off_itself(self.sensor):
            return mi.math.RayEpsilon * dr.norm(ray.d)
        if self.near is None:
            return mi.Float(0)
        # The near clip plane in the world: an orthographic camera may be scaled along its axis.
        axis = self.sensor.world_transform() @ mi.Vector3f(0, 0, 1)
        return self.near * dr.squared_norm(axis) / dr.dot(axis, ray.d)


class PrimaryRays:
    """Rays of one launch. A plain object, which Dr.Jit loops leave alone.

    Attributes:
        sampler: seeded sampler of the lanes.
        ray, weight: Ray3f and spectrum, attached to the sensor.
        scale: weight of a sample in its pixel, Float; None for rays that weigh nothing.
        row, column: row and column of the pixel, UInt32.
        seen: :class:`View` of every sensor.
        η: index of refraction where the rays start, attached to the glass that they start in.
        laser: number of the laser position in an exhaustive scan, else None.
        strata: stratum as (number of the sample in its pixel, number of samples), None for rays that are in no order.
        clip: distance from ``ray.o`` at which the first surface can be, None for 0.
        leg: PreliminaryIntersection3f of the first segment, None if unknown.
        meter_normal: normal of an irradiance meter at rest where each ray starts, None for other sensors.
    """

    def __init__(self, sampler, ray, weight, scale, row, column, seen, η, laser=None, strata=None, clip=None):
        self.sampler, self.ray, self.weight, self.scale = sampler, ray, weight, scale
        self.row, self.column, self.seen, self.η, self.laser, self.leg = row, column, seen, η, laser, None
        self.strata, self.clip, self.meter_normal = strata, clip, None

    def length(self):
        """Return the optical length from the sensor's origin to where the rays start, attached."""
        # Where a distance to the clip plane is given, the rays of projective cameras start at the origin.
        seen = [view for view in self.seen if self.clip is None or view.near is None]
        return length_to_sensor_origin(seen, self.ray) * self.η


def views(sensor: Any, position: Any, reference: Any) -> list[View]:
    """Return the sensors behind places of the film, each with its lanes.

    Args:
        sensor: sensor, or a ``batch``.
        position: places of the film in [0, 1]^2.
        reference: function that returns the sphere around the scene, called for sensors at infinity alone.
    """

    def view(one, active):
        return View(one, active, reference() if is_distant(one) else None)

    children = sensors_of(sensor)
    if len(children) == 1:
        return [view(children[0], True)]
    # The same rounding as in the plugin, so that a ray at the border gets the length of the sensor that made it.
    index = dr.minimum(mi.UInt32(position.x * len(children)), len(children) - 1)
    return [view(child, index == n) for n, child in enumerate(children)]


def sensors_of(sensor: Any) -> list[Any]:
    """Return the children of a ``batch`` in their order on the film, or the sensor itself.

    Args:
        sensor: one ``mi.Sensor``.
    """
    if not is_batch(sensor):
        return [sensor]
    return [child for _, child in objects_of(sensor) if isinstance(child, mi.Sensor)]


def sample_rays(sensor: Any, seen: list[View], time: Any, wavelength: Any, position: Any, aperture: Any) -> Any:
    """Sample primary rays and their weights, attached to the sensor.

    The children of a batch are asked one by one once one of them is attached, see
    :func:`~torchtransient.plugins.mitsuba_compat.is_batch`.

    Args:
        sensor: one ``mi.Sensor``.
        seen: result of :func:`views`.
        time, wavelength, position, aperture: numbers of ``sample_ray_differential``.

    Returns:
        (Ray3f, weight).
    """
    if len(seen) == 1 or not any(dr.grad_enabled(value) for _, value in mi.traverse(sensor)):
        return sensor.sample_ray_differential(time=time, sample1=wavelength, sample2=position, sample3=aperture)
    place = position.x * len(seen)
    inner = mi.Point2f(place - mi.Float(mi.UInt32(place)), position.y)
    rays, weights = None, None
    for view in seen:
        ray, weight = view.sensor.sample_ray_differential(
            time=time, sample1=wavelength, sample2=inner, sample3=aperture, active=view.active
        )
        rays = ray if rays is None else dr.select(view.active, ray, rays)
        weights = weight if weights is None else dr.select(view.active, weight, weights)
    return rays, weights


def meter_normal(sensor: Any, ray: Any, position: Any) -> Any:
    """Return the normal of an irradiance meter at the origins of its rays.

    Args:
        sensor: one ``mi.Sensor``.
        ray: its rays.
        position: numbers that they were drawn with.

    Returns:
        Normal3f; None for other sensors and for one that is attached, whose rays carry its motion.
    """
    with dr.resume_grad():
        if not is_irradiance_meter(sensor) or dr.grad_enabled(ray.o, ray.d):
            return None
    return mi.Normal3f(sensor.get_shape().sample_position(ray.time, position).n)


def length_to_sensor_origin(seen: list[View], ray: Any) -> Any:
    """Return the distance from the sensor's origin to the starts of rays, metres; 0 for rays of other sensors.

    Mitsuba's projective cameras start their rays on the near clip plane; their light travels on to the pinhole
    (perspective), to the sampled point of the aperture (thin lens) or to the sensor plane (orthographic). Radiance and
    irradiance meters lift the start off themselves by a little. Light for a sensor at infinity arrives when its wave
    front leaves the sphere around the scene, as it starts there when it comes from infinity. Other sensors start rays
    where they are.

    Args:
        seen: views of the sensors.
        ray: primary rays, Ray3f.
    """
    length = mi.Float(0)
    for view in seen:
        length = dr.select(view.active, view.length(ray), length)
    return length


def start_at_sensor(seen: list[View], ray: Any) -> tuple[Any, Any]:
    """Return rays that start at the origins of projective cameras.

    A medium around the camera attenuates and scatters light before the near clip plane, too.

    Args:
        seen: views of the sensors.
        ray: primary rays, Ray3f.

    Returns:
        (rays, attached where they are; distance to the near clip plane, detached, 0 for rays of other sensors, None
        without such cameras).
    """
    clipped = [view for view in seen if view.near is not None]
    if not clipped:
        return ray, None
    length = length_to_sensor_origin(clipped, ray)
    ray = mi.Ray3f(ray)
    ray.o = ray(-length)
    clip = dr.detach(length)
    ray.maxt = ray.maxt + clip
    return ray, clip


def index_at_sensor(seen: list[View], surroundings: Any, scene: Any) -> Any:
    """Return the index of refraction where the rays start, attached to the glass around the sensor.

    Args:
        seen: result of :func:`views`.
        surroundings: :class:`~.surroundings.Surroundings`, None for vacuum.
        scene: Mitsuba scene.
    """
    if surroundings is None:
        return mi.Float(1)
    first, *others = surroundings.indices(scene)
    for view, index in zip(seen[1:], others, strict=True):
        first = dr.select(view.active, index, first)
    return first


# --------------------------------------------------------------------- the frame in which a sensor reports polarization


def sensor_rotation(seen, ray):
    """Return the rotation from the frame of the primary ray to the sensor's, attached where the sensor's pose is.

    The sensor's horizontal axis is ``cross(d, up)`` with the ray's direction ``d`` and ``up`` the sensor's local +y in
    world space: to the right of the picture, as in Mitsuba's ``stokes`` integrator. Rays along ``up`` have no such
    axis; they keep the implicit frame of their direction.

    Args:
        seen: :class:`View` of every sensor that the rays belong to.
        ray: primary rays.
    """
    up = seen[0].sensor.world_transform() @ mi.Vector3f(0, 1, 0)
    for view in seen[1:]:
        up = dr.select(view.active, view.sensor.world_transform() @ mi.Vector3f(0, 1, 0), up)
    horizontal = dr.cross(ray.d, up)
    # The frame of the ray is the projection of a fixed vector: unit length only where nothing is attached.
    current = stokes_frame_of(ray.d)
    current = dr.normalize(current - ray.d * dr.dot(current, ray.d))
    return rotation_between(-ray.d, current, horizontal)
