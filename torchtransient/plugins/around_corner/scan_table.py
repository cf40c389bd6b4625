"""Which points a scan looks at, and where its laser falls: computed once a job, attached where parameters are."""

from __future__ import annotations

import warnings
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import SceneError, TorchTransientWarning
from torchtransient.interfaces import CaptureType

# A beam that ends so much before its target, in parts of its length, was stopped by something else.
SAME_PLACE = 1e-3
# Wall points along each side of a scan that stand for all of it in densities.
ACROSS = 5
_FIELDS = ("p", "n", "sh_frame", "uv", "dp_du", "dp_dv")


class LaserSpots:
    """The spots of a laser on what its beam meets first.

    ``si`` (SurfaceInteraction3f of all spots), ``length`` (Float, from the laser), ``origin`` (Point3f).
    """

    def __init__(self, scene: Any, laser: Any, aims: Any, origin: Any) -> None:
        self.emitter, self.origin = laser, origin
        there = dr.norm(aims)
        _check_not_at(dr.detach(there), "laser", "emitter's to_world or laser_origin")
        self.ray = mi.Ray3f(self.origin, aims / there)
        with dr.suspend_grad():
            pi = scene.ray_intersect_preliminary(dr.detach(self.ray), coherent=True)
            dr.eval(pi)
        si = pi.compute_surface_interaction(self.ray, mi.RayFlags.All)
        _check_hit(np.array(pi.t), "laser")
        self.length = dr.norm(si.p - self.origin)
        # What lanes read of it and may be attached, see :meth:`arrays`; its other fields are told by the lanes.
        self.si = dr.detach(si)
        for name in _FIELDS:
            setattr(self.si, name, getattr(si, name))
        dr.eval(self.si, self.length, self.ray, self.origin)

    def arrays(self) -> list[Any]:
        """What is attached where the scene's parameters are."""
        frame = self.si.sh_frame
        fields = [getattr(self.si, name) for name in _FIELDS if name != "sh_frame"]
        return [*fields, frame.s, frame.t, frame.n, self.length, self.ray.d]

    def energy(self, wavelengths: Any, index: Any, cos: Any, active: Any) -> Any:
        """What falls on a spot, per colour, and per cosine ``cos`` of the beam there (UnpolarizedSpectrum).

        A ``laser_beam`` brings its energy however it falls. For Mitsuba's emitters the irradiance at the spot is taken
        over a square metre, as mitransient does, with the emitter turned towards it.
        """
        if hasattr(self.emitter, "energy_at"):
            return self.emitter.energy_at(wavelengths, active) * dr.select(cos > 0, dr.rcp(cos), 0)
        it = dr.zeros(mi.Interaction3f)
        forward = self.emitter.world_transform() @ mi.Vector3f(0, 0, 1)
        length = dr.gather(mi.Float, self.length, index, active)
        it.p = mi.Point3f(self.emitter.world_transform().translation()) + forward * length
        it.wavelengths = wavelengths
        _, weight = self.emitter.sample_direction(it, mi.Point2f(0.5), active)
        return mi.unpolarized_spectrum(weight)


def laser_of(scene: Any) -> Any:
    """The one emitter of an NLOS scene. Raises SceneError for another number."""
    emitters = scene.emitters()
    if len(emitters) != 1:
        names = ", ".join(repr(e.id()) for e in emitters) or "none"
        raise SceneError(
            f"transient_nlos_path: expected one emitter, the laser, with nlos_laser_sampling, got {len(emitters)} "
            f"({names}). Leave one laser in the scene, or set nlos_laser_sampling to false."
        )
    return emitters[0]


def origin_of(scene: Any, sensor: Any) -> Any:
    """Where the laser stands (Point3f)."""
    given = getattr(sensor, "laser_origin", None)
    return mi.Point3f(laser_of(scene).world_transform().translation()) if given is None else given


def aims_of(scene: Any, sensor: Any, capture: CaptureType, fov: float | None) -> Any:
    """Where the laser points from its origin (Vector3f, of any length): one direction, or one for every pixel, or one
    for every laser position.

    ``fov``: horizontal field of view in degrees of a grid of laser positions around the emitter's axis, None for those
    of the sensor. Raises SceneError where two say where the laser points, and for a field of view that is none.
    """
    transform, origin = laser_of(scene).world_transform(), origin_of(scene, sensor)
    _check_said_once(sensor, capture, fov)
    given = sensor.spots() if hasattr(sensor, "spots") and capture is not CaptureType.CONFOCAL else None
    if given is not None:
        return given - origin
    if capture is CaptureType.SINGLE:
        return transform @ mi.Vector3f(0, 0, 1)
    if fov is None:
        return scanned_points(scene, sensor) - origin
    film = sensor.film()
    columns, rows = film.laser_scan_width, film.laser_scan_height
    index = dr.arange(mi.UInt32, columns * rows)
    half = float(np.tan(np.radians(fov / 2)))
    x = (mi.Float(index % columns) + 0.5) / columns * 2 - 1
    y = (mi.Float(index // columns) + 0.5) / rows * 2 - 1
    return transform @ mi.Vector3f(-x * half, -y * half * rows / columns, 1)


def _check_said_once(sensor: Any, capture: CaptureType, fov: float | None) -> None:
    given = getattr(sensor, "laser_points", None) is not None
    if given and capture is CaptureType.CONFOCAL:
        raise SceneError(
            "scan: a confocal capture lights its scanned points, got laser_points beside them. Leave laser_points out "
            "of the sensor, or set capture_type to single or exhaustive."
        )
    if given and fov is not None:
        raise SceneError(
            "scan: laser_points and force_equal_illumination_scanning = false (a grid of illumination_scan_fov degrees "
            "around the laser's axis) both say where the laser points; leave one of them out."
        )
    if fov is not None and not 0 < fov < 180:
        raise SceneError(f"scan: illumination_scan_fov: expected an angle between 0 and 180 degrees, got {fov}.")


def scan_rays(sensor: Any) -> Any:
    """One ray (Ray3f) for each pixel of a sensor's film, to the scanned point or along the pixel's axis; attached where
    the sensor is.
    """
    if hasattr(sensor, "scanned"):
        origin = mi.Point3f(sensor.origin)
        return mi.Ray3f(origin, dr.normalize(sensor.scanned() - origin))
    size = sensor.film().crop_size()
    index = dr.arange(mi.UInt32, int(size[0]) * int(size[1]))
    row = index // int(size[0])
    place = mi.Point2f(mi.Float(index - row * int(size[0])), mi.Float(row)) + 0.5
    ray, _ = sensor.sample_ray(0.0, 0.5, place / mi.ScalarVector2f(size), mi.Point2f(0.5))
    return mi.Ray3f(ray.o, ray.d)


def scanned_points(scene: Any, sensor: Any) -> Any:
    """The scanned points (Point3f): as the sensor says, or what its pixels see."""
    if hasattr(sensor, "scanned"):
        return sensor.scanned()
    ray = scan_rays(sensor)
    with dr.suspend_grad():
        pi = scene.ray_intersect_preliminary(dr.detach(ray), coherent=True)
        dr.eval(pi)
    si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal)
    return dr.select(si.is_valid(), si.p, ray.o + ray.d)


def reference_points(scene: Any, sensor: Any) -> tuple[np.ndarray, np.ndarray]:
    """Some 5 x 5 points of the relay wall, spread over the scan, and the normals there on the sensor's side: ``(P,
    3)``.
    """
    size = sensor.film().crop_size()
    columns, rows = (np.unique(np.linspace(0, int(n) - 1, min(int(n), ACROSS)).round().astype(int)) for n in size)
    index = (rows[:, None] * int(size[0]) + columns).ravel()
    rays = dr.gather(mi.Ray3f, dr.detach(scan_rays(sensor)), mi.UInt32(index.astype(np.uint32)))
    si = scene.ray_intersect(rays)
    p, n = np.array(si.p).T, np.array(dr.select(si.wi.z < 0, -si.n, si.n)).T
    found = np.array(si.is_valid())
    if not found.any():
        _check_hit(np.array(si.t), "sensor")
    return p[found], n[found]


def check_count(aims: Any, sensor: Any, capture: CaptureType) -> None:
    """Raise SceneError unless the laser has as many aims as the capture asks for."""
    film, count = sensor.film(), dr.width(aims)
    if capture is CaptureType.SINGLE and count != 1:
        raise SceneError(
            f"scan: a single capture has one laser spot, got {count} laser_points. Give one, or set capture_type to "
            "exhaustive."
        )
    if capture is CaptureType.EXHAUSTIVE and count != film.laser_count():
        raise SceneError(
            f"scan: the film has a grid of {film.laser_scan_width} x {film.laser_scan_height} laser positions, and the "
            f"laser {count} points to aim at. Set laser_scan_width and laser_scan_height to the sensor's grid (or to "
            "that of laser_points), or force_equal_illumination_scanning to false for a grid around the laser's axis."
        )


def _check_not_at(there: Any, what: str, where: str) -> None:
    if not bool(dr.all(there > 0)):
        raise SceneError(f"scan: the {what} stands in a point that it aims at; move it by its {where}.")


def _check_hit(t: np.ndarray, what: str) -> None:
    missed = int(np.sum(~np.isfinite(t)))
    if missed == len(t):
        raise SceneError(
            f"scan: the {what} meets nothing in the scene with any of its {len(t)} rays. Aim it at the relay wall."
        )
    if missed:
        warnings.warn(
            f"scan: {missed} of the {what}'s {len(t)} rays meet nothing in the scene; their values are zero.",
            TorchTransientWarning,
            stacklevel=2,
        )
