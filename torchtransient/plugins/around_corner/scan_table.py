"""Scanned points and laser spots of a capture, computed once a job and attached where parameters are."""

from __future__ import annotations

import warnings
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import SceneError, TorchTransientWarning
from torchtransient.interfaces import CaptureType
from torchtransient.plugins.around_corner.geometry import OFFSET, WallPoints, front_normal, points_of, sees
from torchtransient.plugins.bsdfs.lambertian import is_lambertian
from torchtransient.plugins.kernel_arrays import host_numbers, registry_number
from torchtransient.plugins.mitsuba_compat import mesh_positions
from torchtransient.plugins.mitsuba_shapes import is_flat_shape
from torchtransient.plugins.node_walk import shown_by
from torchtransient.plugins.sampling.area_elements import TRIANGLE, has_shading_normals
from torchtransient.plugins.sampling.hidden_elements import HiddenElements
from torchtransient.plugins.sampling.point_sets import plane_points
from torchtransient.plugins.transport.strategy import Local

# ----------------------------------------------------------------------------------------------------------------------
# Surfaces that lie in each other: what a ray meets there is chance, and a sum over areas counts both.
# Lines to drawn points end just before them (:func:`.geometry.occluded`), so nothing that lies nearer than that can
# hide a point: of two surfaces at one place both are seen. Whether there are such places is asked of drawn points
# themselves, of shapes of all kinds: what is free to see, has a ray that is sent there met it?

# Points that are looked at from the wall, and as many from those that are seen.
POINTS = 2**13
# So many of them have to lie in something else. Where surfaces cross, rounding finds one in a hundred thousand.
FEWEST = 3
# Heights over each other, in offsets, at which lines see both of two surfaces.
_HEIGHT = 4.0
# Share of a triangle's barycentric coordinates that belongs to its edges, where a ray may meet the neighbour.
_EDGE = 0.01
_SEEDS = (0x51ED270B, 0x7FEB352D)


def overlaps(scene: Any, elements: HiddenElements, points: np.ndarray, normals: np.ndarray) -> list[str]:
    """Return the names of shapes that lie in others, or whose own triangles lie in each other.

    Overlaps count where light finds them: seen from the wall, or from points that the wall sees. Those of less than one
    in two thousand of the density of ``elements`` may stay unnoticed.

    Args:
        scene: built scene.
        elements: table of the hidden elements.
        points, normals: wall points and their normals, (P, 3).
    """
    with dr.suspend_grad():
        index = dr.arange(mi.UInt32, POINTS) % dr.opaque(mi.UInt32, len(points))
        p, n = mi.Point3f(points.T), mi.Vector3f(normals.T)
        dr.make_opaque(p, n)
        viewer = Local(p=dr.gather(mi.Point3f, p, index), geometric_n=dr.gather(mi.Vector3f, n, index))
        found, active = np.zeros(0, dtype=np.uint32), mi.Mask(True)
        for seed in _SEEDS:
            target, active, contested = _look(scene, elements, viewer, dr.opaque(mi.UInt32, seed), active)
            numbers = dr.reinterpret_array(mi.UInt32, target.shape)
            dr.eval(target.p, target.geometric_n, active, contested, numbers)
            found = np.concatenate([found, np.array(numbers)[np.array(contested)]])
            viewer = target
    if len(found) < FEWEST:
        return []
    met = {int(number) for number in np.unique(found)}
    return [shape.id() or shape.class_name() for shape in elements.shapes if registry_number(shape) in met]


def _look(scene: Any, elements: HiddenElements, viewer: Local, seed: Any, active: Any) -> tuple[Local, Any, Any]:
    """Draw points. Return them with the normals of the sides that are seen, a mask of those that are seen, and of
    these a mask of those that something else lies in.
    """
    x, y = plane_points(POINTS, seed)
    # Points in another order than those that see them.
    turn = dr.opaque(mi.UInt32, 0x9E3779B1 % POINTS | 1)
    order = dr.arange(mi.UInt32, POINTS) * turn % dr.opaque(mi.UInt32, POINTS)
    x, y = dr.gather(mi.Float64, x, order), dr.gather(mi.Float, y, order)
    element, a = elements.select_element(x)
    p, n = elements.point(element, a, y)
    shape, primitive = elements.surface(element)
    to = mi.Vector3f(p - viewer.p)
    target = Local(p=p, geometric_n=dr.mulsign(mi.Vector3f(n), -dr.dot(n, to)), shape=shape)
    # From behind, too: what turns its back to the viewer may be what the ray meets of two surfaces.
    seen = sees(scene, viewer, p, target.geometric_n, active)
    # A ray that starts where the line does, and goes on.
    length = dr.norm(to)
    offset = OFFSET * (dr.max(dr.abs(p)) + length)
    o = mi.Point3f(viewer.p + viewer.geometric_n * dr.mulsign(offset, dr.dot(viewer.geometric_n, to)))
    ray = mi.Ray3f(o, dr.normalize(p - o))
    pi = scene.ray_intersect_preliminary(ray, coherent=False, active=seen)
    height = dr.abs(dr.dot(target.geometric_n, o + ray.d * pi.t - p))
    other = seen & pi.is_valid() & ((pi.shape != shape) | (pi.prim_index != primitive))
    return target, seen, other & (height <= _HEIGHT * offset) & _is_inside(elements, element, a, y)


def _is_inside(elements: HiddenElements, element: Any, a: Any, y: Any) -> Any:
    """Return a mask of points off the edges of their triangles."""
    uv = elements.coordinates(element, a, y)
    least = dr.minimum(dr.minimum(uv.x, uv.y), 1 - uv.x - uv.y)
    return (elements.kind(element) != TRIANGLE) | (least > _EDGE)


# ----------------------------------------------------------------------------------------------------------------------

# Wall points along each side of a scan that stand for all of it in densities.
ACROSS = 5
# Height of points over a plane, in parts of their extent, that single precision cannot tell from none.
FLAT = 1e-6
_FIELDS = ("p", "n", "sh_frame", "uv", "dp_du", "dp_dv")


class ScanTable:
    """Scanned points and laser spots of a capture, traced once a job, with gradients enabled and outside of loops.

    Attributes:
        scene, sensor: built scene, and sensor of the capture.
        rays: rays to the scanned points, one a pixel, attached where the sensor is (Ray3f).
        hits: intersections of the rays (PreliminaryIntersection3f).
        spots: the :class:`LaserSpots`, None where lights are sampled.
        wall: shapes of a flat relay wall, None for another one.
    """

    def __init__(self, scene: Any, contents: Any, capture: CaptureType, fov: float | None, laser: bool) -> None:
        sensor = contents.sensor
        self.scene, self.sensor, self.memory = scene, sensor, contents.memory
        self.rays, self.spots = scan_rays(sensor), None
        with dr.suspend_grad():
            self.hits = scene.ray_intersect_preliminary(self.rays, coherent=True)
            dr.eval(self.hits)
        if laser:
            aims = aims_of(scene, sensor, capture, fov)
            check_count(aims, sensor, capture)
            self.spots = LaserSpots(scene, laser_of(scene), aims, origin_of(scene, sensor))
        self.wall = self._wall()
        self._elements: dict[frozenset[Any], HiddenElements] = {}

    @property
    def looks_at_points(self) -> bool:
        """Return whether all samples of a pixel look at one point, which cameras do not."""
        return hasattr(self.sensor, "scanned")

    def elements(self, without: list[Any]) -> HiddenElements:
        """Return the table of elements of all shapes but those of ``without``, computed once and not to be changed."""
        left_out = frozenset(shape.ptr for shape in without)
        if left_out not in self._elements:
            every = self.scene.shapes()
            shapes, beside = ([s for s in every if (s.ptr in left_out) == other] for other in (False, True))
            made = HiddenElements.cached(self.memory, shapes, *self.reference_points(), beside)
            self._elements[left_out] = made
        return self._elements[left_out]

    def overlaps(self, with_wall: bool) -> list[str]:
        """Return the names of hidden shapes that lie in others; ``with_wall``: a flat wall counts as one."""
        elements = self.elements([] if with_wall or self.wall is None else self.wall)

        def found() -> list[str]:
            return overlaps(self.scene, elements, *self.reference_points())

        return self.memory.get("overlaps", elements.key, found) if elements.key else found()

    def lambertian_spots(self, legs: bool) -> WallPoints | None:
        """Return the spots as points of a flat diffuse wall, None if they cannot be described so: on curved walls, with
        normals that are interpolated, or in light with wavelengths or a polarization.
        """
        if self.wall is None or mi.is_spectral or mi.is_polarized:
            return None
        diffuse = all(is_lambertian(shape.bsdf()) and not has_shading_normals(shape) for shape in self.wall)
        return self.spots.points(legs) if diffuse else None

    def interactions(self) -> Any:
        """Return the interactions of the rays (SurfaceInteraction3f), attached where sensor or shape are."""
        return self.hits.compute_surface_interaction(self.rays, mi.RayFlags.All)

    def reference_points(self) -> tuple[np.ndarray, np.ndarray]:
        """Return some 5 x 5 points of the relay wall over the whole scan, and normals on the sensor's side, (P, 3)."""
        size = self.sensor.film().crop_size()
        columns, rows = (np.unique(np.linspace(0, int(n) - 1, min(int(n), ACROSS)).round().astype(int)) for n in size)
        index = mi.UInt32((rows[:, None] * int(size[0]) + columns).ravel().astype(np.uint32))
        with dr.suspend_grad():
            found = dr.gather(mi.PreliminaryIntersection3f, self.hits, index)
            si = found.compute_surface_interaction(dr.gather(mi.Ray3f, self.rays, index), mi.RayFlags.All)
            n = front_normal(si)
            n = dr.select(si.wi.z < 0, -n, n)
            dr.eval(si.p, n, si.t)
        valid = np.isfinite(np.array(si.t))
        if not valid.any():
            _check_hit(np.array(si.t), "sensor")
        return np.array(si.p).T[valid], np.array(n).T[valid]

    def _wall(self) -> list[Any] | None:
        """Return the shapes that rays and beams end on, if all lie in one plane, where no point lights another.

        None for other walls, and without laser spots.
        """
        if self.spots is None:
            return None
        met = {int(k) for each in (self.hits.shape, self.spots.shape) for k in np.unique(_numbers(each))} - {0}
        shapes = [shape for shape in self.scene.shapes() if registry_number(shape) in met]
        return shapes if len(shapes) == len(met) and _in_one_plane(shapes) else None


def _numbers(pointers: Any) -> np.ndarray:
    return np.array(dr.reinterpret_array(mi.UInt32, pointers))


def _in_one_plane(shapes: list[Any]) -> bool:
    corners = [_corners(shape) for shape in shapes]
    if not shapes or any(each is None for each in corners):
        return False
    v = np.concatenate(corners)
    spread = np.linalg.svd(v - v.mean(0), compute_uv=False)
    return bool(spread[2] <= FLAT * max(spread[0], np.abs(v).max()))


def _corners(shape: Any) -> np.ndarray | None:
    """Return points that span a shape, (N, 3); None for a curved one."""
    if shape.is_mesh():
        return host_numbers(mesh_positions(shape)).reshape(-1, 3)
    if not is_flat_shape(shape):
        return None
    shown = next(v for v in shown_by(shape)[0] if v.key == "to_world")
    m = host_numbers(shown.read(shape).matrix).reshape(4, 4)
    return m[:3, 3] + np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]) @ m[:3, :3].T


class LaserSpots:
    """Spots of a laser on the surfaces that its beam meets first.

    Args:
        scene: built scene.
        laser: the emitter.
        aims: directions of the beam, of any length, one or one for each spot (:func:`aims_of`).
        origin: position of the laser (Point3f).

    Attributes:
        si: the spots (SurfaceInteraction3f).
        length: distance from the laser (Float, metres).
        shape: shapes that the spots lie on (ShapePtr).
    """

    def __init__(self, scene: Any, laser: Any, aims: Any, origin: Any) -> None:
        self.emitter, self.origin = laser, origin
        there = dr.norm(aims)
        _check_not_at(there, "laser", "emitter's to_world or laser_origin")
        self.ray = mi.Ray3f(self.origin, aims / there)
        with dr.suspend_grad():
            pi = scene.ray_intersect_preliminary(self.ray, coherent=True)
            dr.eval(pi)
        si = pi.compute_surface_interaction(self.ray, mi.RayFlags.All)
        self.shape = pi.shape
        _check_hit(np.array(pi.t), "laser")
        self.length = dr.norm(si.p - self.origin)
        # What lanes read of it and may be attached, see :meth:`arrays`; the lanes provide its other fields.
        self.si = dr.detach(si)
        for name in _FIELDS:
            setattr(self.si, name, getattr(si, name))
        dr.eval(self.si, self.length, self.ray, self.origin)

    def arrays(self) -> list[Any]:
        """Return the arrays that are attached where the scene's parameters are."""
        frame = self.si.sh_frame
        fields = [getattr(self.si, name) for name in _FIELDS if name != "sh_frame"]
        return [*fields, frame.s, frame.t, frame.n, self.length, self.ray.d]

    def lit_interactions(self) -> Any:
        """Return the spots (SurfaceInteraction3f), with ``wi`` towards the laser."""
        si = dr.copy(self.si)
        si.wi = si.to_local(-self.ray.d)
        return si

    def points(self, legs: bool, *, energy: bool = True) -> WallPoints:
        """Return the spots as points of a diffuse wall, in variants without wavelengths.

        Args:
            legs: the way from the laser counts.
            energy: values hold the light that falls on the spots; False for that of a beam of one joule.
        """
        si, factor = self.lit_interactions(), mi.UnpolarizedSpectrum(1)
        if energy:
            cos = dr.abs_dot(si.n, self.ray.d)
            factor = self.energy([], dr.arange(mi.UInt32, dr.width(si.p)), cos, si.is_valid()) * cos
        return points_of(si, factor * dr.inv_pi, self.length if legs else mi.Float(0))

    def energy(self, wavelengths: Any, index: Any, cos: Any, active: Any) -> Any:
        """Return the energy on spots by colour, over the cosine of the beam (UnpolarizedSpectrum).

        A ``laser_beam`` brings its energy however it falls. For Mitsuba's emitters the irradiance at the spot is taken
        over a square metre, as mitransient does, with the emitter turned towards it.

        Args:
            wavelengths: wavelengths of the paths, in spectral variants.
            index: numbers of the spots (UInt32).
            cos: cosine of the beam on the surface.
            active: mask.
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


def capture_type(given: Any) -> CaptureType:
    """Return a capture type.

    Args:
        given: number or name.

    Raises:
        SceneError: for others.
    """
    if isinstance(given, str) and not given.strip().lstrip("-").isdigit():
        names = {c.name.lower(): c for c in CaptureType}
        if given.lower() in names:
            return names[given.lower()]
    elif float(given) in (c.value for c in CaptureType):
        return CaptureType(int(given))
    raise SceneError(
        f"transient_nlos_path: capture_type: expected single, confocal, exhaustive or pairs (or 1 to 4), got {given!r}."
    )


def laser_of(scene: Any) -> Any:
    """Return the one emitter of an NLOS scene.

    Args:
        scene: built scene.

    Raises:
        SceneError: for another number of emitters.
    """
    emitters = scene.emitters()
    if len(emitters) != 1:
        names = ", ".join(repr(e.id()) for e in emitters) or "none"
        raise SceneError(
            f"transient_nlos_path: expected one emitter, the laser, with nlos_laser_sampling, got {len(emitters)} "
            f"({names}). Leave one laser in the scene, or set nlos_laser_sampling to false."
        )
    return emitters[0]


def origin_of(scene: Any, sensor: Any) -> Any:
    """Return the position of the laser (Point3f, metres).

    Args:
        scene: built scene.
        sensor: sensor of the capture, whose ``laser_origin`` counts if it has one.
    """
    given = getattr(sensor, "laser_origin", None)
    return mi.Point3f(laser_of(scene).world_transform().translation()) if given is None else given


def aims_of(scene: Any, sensor: Any, capture: CaptureType, fov: float | None) -> Any:
    """Return the directions of the laser from its origin (Vector3f, of any length): one direction, or one for every
    pixel, or one for every laser position.

    Args:
        scene: built scene.
        sensor: sensor of the capture.
        capture: type of the capture.
        fov: horizontal field of view in degrees of a grid of laser positions around the emitter's axis, None for the
            laser positions of the sensor.

    Raises:
        SceneError: if several of the scene's parts aim the laser, or the field of view is not an angle.
    """
    transform, origin = laser_of(scene).world_transform(), origin_of(scene, sensor)
    _check_aimed_once(sensor, capture, fov)
    given = sensor.spots() if hasattr(sensor, "spots") and capture is not CaptureType.CONFOCAL else None
    if given is not None:
        return given - origin
    if capture is CaptureType.PAIRS:
        raise SceneError(
            "scan: a capture of pairs has a laser spot for each scanned point. Give laser_points of nlos_capture_meter."
        )
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


def _check_aimed_once(sensor: Any, capture: CaptureType, fov: float | None) -> None:
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
    """Return a ray for each pixel of a sensor's film, to the scanned point or along the pixel's axis (Ray3f).

    Attached where the sensor is.

    Args:
        sensor: sensor of the capture.
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
    """Return the scanned points (Point3f): the sensor's targets, or the points that its pixels see.

    Args:
        scene: built scene.
        sensor: sensor of the capture.
    """
    if hasattr(sensor, "scanned"):
        return sensor.scanned()
    ray = scan_rays(sensor)
    with dr.suspend_grad():
        pi = scene.ray_intersect_preliminary(ray, coherent=True)
        dr.eval(pi)
    si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal)
    return dr.select(si.is_valid(), si.p, ray.o + ray.d)


def check_count(aims: Any, sensor: Any, capture: CaptureType) -> None:
    """Check that the laser has as many aims as the capture asks for.

    Args:
        aims: directions of the laser.
        sensor: sensor of the capture.
        capture: type of the capture.

    Raises:
        SceneError: for another number.
    """
    film, count = sensor.film(), dr.width(aims)
    if capture is CaptureType.SINGLE and count != 1:
        raise SceneError(
            f"scan: a single capture has one laser spot, got {count} laser_points. Give one, or set capture_type to "
            "exhaustive."
        )
    if capture is CaptureType.PAIRS and count != (pixels := int(film.crop_size()[0]) * int(film.crop_size()[1])):
        raise SceneError(
            f"scan: a capture of pairs has a laser spot for each of its {pixels} scanned points, got {count} "
            "laser_points. Give as many, in the order of the film's pixels."
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
