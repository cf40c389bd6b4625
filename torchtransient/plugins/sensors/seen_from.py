"""Film positions of scene points: the inverse of a sensor's primary rays."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.mitsuba_compat import is_irradiance_meter, near_clip
from torchtransient.plugins.sensors.origin import (
    PrimaryRays,
    index_at_sensor,
    sample_rays,
    sensors_of,
    start_at_sensor,
    views,
)
from torchtransient.plugins.transport.strategy import Local

# Radii of the scene from which what is seen along parallel rays is looked at.
FAR = 300


def can_be_connected(sensor: Any) -> bool:
    """Return True if rays of a sensor fill a solid angle or a beam in which a point of the scene is found again.

    Args:
        sensor: one ``mi.Sensor``; of a batch all are asked.
    """
    return all(is_irradiance_meter(one) or near_clip(one) is not None for one in sensors_of(sensor))


def has_eye(sensor: Any) -> bool:
    """Return True if rays of a sensor start at a point that their random numbers choose, wherever they go.

    Args:
        sensor: one ``mi.Sensor``; of a batch all are asked.
    """
    return all(near_clip(one) is not None and not _sees_in_parallel(one) for one in sensors_of(sensor))


def sees_one_line(sensor: Any) -> bool:
    """Return True if each sensor sees along one ray, which no edge meets but for moments.

    Args:
        sensor: one ``mi.Sensor``; of a batch all are asked.
    """
    return all(one.class_name() == "RadianceMeter" for one in sensors_of(sensor))


def clip_planes_at(camera: Any, place: Any) -> tuple[Any, Any]:
    """Return the points of both clip planes that a camera sees, through the middle of its lens.

    Args:
        camera: projective camera, with :func:`~..mitsuba_compat.near_clip`.
        place: place on the film, Point2f in [0, 1]^2.

    Returns:
        (near, far), Point3f in the world.
    """
    _, near, far = _axis_and_clips(camera)
    o, way = SensorPlaces._line(camera, (place.x, place.y), mi.Point2f(0.5))
    return o + way * near, o + way * far


class SensorPlaces:
    """Places of the film by the points that they see.

    Args:
        sensor: projective camera, irradiance meter, or a ``batch`` of cameras.
        film: film of the sensor.
        radius: radius of the scene.

    Cameras are known by three rays each: on a plane across the axis, places of the film are an affine grid. This holds
    beyond the film, from where reconstruction filters bring light to its pixels.
    """

    def __init__(self, sensor: Any, film: Any, radius: Any) -> None:
        self.sensor, self.film, self.radius = sensor, film, radius
        self.cameras = sensors_of(sensor)
        self.is_meter = is_irradiance_meter(sensor)
        self.size = mi.ScalarVector2f(film.crop_size())
        # Whether each place of the film sees along one ray: edges may be in line with others or with lights then.
        self.is_sharp = not (self.is_meter or any(camera.needs_aperture_sample() for camera in self.cameras))

    def numbers(self, sampler: Any) -> Local:
        """Draw the numbers that choose a point of the sensor: ``aperture``, ``wavelength``, ``camera``.

        Constants where there is no choice.
        """
        aperture = mi.Point2f(0.5) if self.is_sharp else sampler.next_2d()
        wavelength = sampler.next_1d() if mi.is_spectral else mi.Float(0)
        camera, count = mi.UInt32(0), len(self.cameras)
        if count > 1:
            camera = dr.minimum(mi.UInt32(sampler.next_1d() * count), count - 1)
        return Local(aperture=aperture, wavelength=wavelength, camera=camera)

    def middle(self, numbers: Any) -> Any:
        """Return the middle of the film of the chosen camera, Point2f, pixels."""
        return mi.Point2f((mi.Float(numbers.camera) + 0.5) / len(self.cameras), 0.5) * self.size

    def eye(self, numbers: Any) -> Any:
        """Return the point from which the chosen camera sees, see :func:`has_eye`."""
        found = [self._line(camera, (0.5, 0.5), numbers.aperture)[0] for camera in self.cameras]
        eye = found[0]
        for number, other in enumerate(found[1:], 1):
            eye = dr.select(numbers.camera == number, other, eye)
        return eye

    def rays_at(
        self, context: Any, sampler: Any, uv: Any, numbers: Any, row: Any = None, column: Any = None,
        total: int | None = None, η: Any = None,
    ) -> PrimaryRays:
        """Return the primary rays through places of the film, attached to the sensor.

        Args:
            uv: places, Point2f, pixels.
            numbers: result of :meth:`numbers`.
            row, column: their pixels, None if unknown.
            total: samples of a pixel, None where the rays weigh nothing.
            η: index of refraction where they start, None to look it up, which cannot be done within loops.
        """
        position = uv / self.size
        # Sensors at infinity, which ask for a sphere around the scene, cannot be connected.
        seen = views(self.sensor, position, lambda: None)
        with dr.resume_grad():
            u, clip = numbers.wavelength, None
            ray, weight = sample_rays(self.sensor, seen, self.sensor.shutter_open(), u, position, numbers.aperture)
            if self.film.curves is not None:
                ray, weight = self.film.curves.draw(self.sensor, ray, weight, u)
            if η is None:
                η = index_at_sensor(seen, context.contents.surroundings, context.scene)
            if context.contents.media is not None and context.contents.media.at_sensor is not None:
                ray, clip = start_at_sensor(seen, ray)
        scale = None if total is None else dr.opaque(mi.Float, 1 / total)
        return PrimaryRays(sampler, ray, weight, scale, row, column, seen, η, clip=clip)

    def seen_from(self, at: Any, numbers: Any, active: Any) -> tuple[Any, Any]:
        """Return where the sensor sees a point, and the importance there.

        Args:
            at: Interaction3f of the point.
            numbers: result of :meth:`numbers`.

        Returns:
            (Local with ``uv`` (in pixels), ``p`` (the sensor's point), ``eye`` (a point on the line of sight from which
            everything near is seen as by the sensor), ``d, dist`` (to ``p``), ``pdf`` (zero where nothing is seen),
            ``numbers`` (those of the ray through ``uv`` that meets ``at``); importance per area across, Float).
        """
        if self.is_meter:
            return self._seen_from_meter(at, numbers, active)
        result, count = None, len(self.cameras)
        for number, camera in enumerate(self.cameras):
            found = self._seen_from_camera(camera, at.p, numbers.aperture)
            if count > 1:  # rays beyond the rim of a child's film are those of the next child
                found.valid &= dr.all((found.uv >= 0) & (found.uv <= 1))
                found.uv.x = (found.uv.x + number) / count
            if result is None:
                result = found
                continue
            chosen = numbers.camera == number
            for name, value in vars(found).items():
                setattr(result, name, dr.select(chosen, value, getattr(result, name)))
        valid = active & result.valid & dr.isfinite(result.importance)
        way = result.p - at.p
        dist = dr.norm(way)
        uv, pdf = result.uv * self.size, dr.select(valid, mi.Float(1), 0)
        ds = Local(uv=uv, p=result.p, eye=result.eye, d=way / dist, dist=dist, pdf=pdf, numbers=numbers, emitter=None)
        return ds, dr.select(valid, result.importance, 0)

    @staticmethod
    def _line(camera: Any, place: Any, aperture: Any) -> tuple[Any, Any]:
        """Return (start on the plane of the lens, direction with a unit part along the axis) of the ray through a
        ``place`` of the film in [0, 1]^2.
        """
        axis, near, _ = _axis_and_clips(camera)
        ray, _ = camera.sample_ray_differential(camera.shutter_open(), 0.5, mi.Point2f(*place), aperture)
        way = ray.d / dr.dot(ray.d, axis)
        return mi.Point3f(ray.o - way * near), mi.Vector3f(way)

    def _seen_from_camera(self, camera: Any, p: Any, aperture: Any) -> Local:
        axis, near, far = _axis_and_clips(camera)
        lines = [self._line(camera, place, aperture) for place in ((0, 0), (1, 0), (0, 1))]
        starts, ways = zip(*lines, strict=True)
        depth = dr.dot(p - starts[0], axis)
        corner, right, up = (start + way * depth for start, way in zip(starts, ways, strict=True))
        right, up, at = right - corner, up - corner, p - corner
        n = dr.cross(right, up)
        area = dr.norm(n)
        n /= dr.square(area)
        uv = mi.Point2f(dr.dot(dr.cross(at, up), n), dr.dot(dr.cross(right, at), n))
        o = starts[0] + (starts[1] - starts[0]) * uv.x + (starts[2] - starts[0]) * uv.y
        way = p - o
        cos = dr.dot(way, axis) / dr.norm(way)
        # Parallel rays start at different points and have no eye.
        eye = o
        if _sees_in_parallel(camera):
            eye = o - way / dr.norm(way) * (FAR * self.radius)
        valid = (depth > near) & (depth < far)
        return Local(uv=uv, p=o, eye=mi.Point3f(eye), importance=dr.rcp(area * cos), valid=valid)

    def _seen_from_meter(self, at: Any, numbers: Any, active: Any) -> tuple[Any, Any]:
        ps = self.sensor.get_shape().sample_position(at.time, numbers.aperture, active)
        way = ps.p - at.p
        dist = dr.norm(way)
        d = way / dist
        cos = -dr.dot(ps.n, d)
        valid = active & (cos > 0)
        uv, p, pdf = numbers.aperture * self.size, mi.Point3f(ps.p), dr.select(valid, mi.Float(1), 0)
        # Places are drawn by what stands for the film, directions by what stands for the aperture.
        local = mi.Frame3f(ps.n).to_local(-d)
        towards = mi.warp.uniform_disk_to_square_concentric(mi.Point2f(local.x, local.y))
        asked = Local(aperture=towards, wavelength=numbers.wavelength, camera=numbers.camera)
        ds = Local(uv=uv, p=p, eye=p, d=d, dist=dist, pdf=pdf, n=mi.Normal3f(ps.n), numbers=asked, emitter=None)
        # The weight of its rays holds a pi.
        return ds, dr.select(valid, cos * dr.inv_pi / dr.square(dist), 0)


def _axis_and_clips(camera: Any) -> tuple[Any, Any, Any]:
    """Return (unit vector along the axis, distances of both clip planes) of a camera, in the world."""
    axis = mi.Vector3f(camera.world_transform() @ mi.Vector3f(0, 0, 1))
    scale = dr.norm(axis)
    return axis / scale, near_clip(camera) * scale, camera.far_clip() * scale


def _sees_in_parallel(camera: Any) -> bool:
    return bool(camera.class_name() == "OrthographicCamera")
