"""``nlos_capture_meter``: a sensor that scans points of a relay wall, one for each pixel of its film."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.capture.wall import first_hits
from torchtransient.checks import real_array, shown
from torchtransient.errors import SceneError
from torchtransient.plugins._registry import register
from torchtransient.plugins.mitsuba_compat import has_texcoords, mesh_faces, mesh_texcoords
from torchtransient.plugins.parameter_effect import ParameterEffect, class_of, declare_effects

# --------------------------------------------------------------------- where places of a texture lie on a triangle mesh


class PlacesOnMesh:
    """The points of ``mesh`` that have texture coordinates ``places`` (N, 2), which stay those of the same material
    points when the mesh moves. Where coordinates are used twice, the first triangle counts.

    Mitsuba's own ``eval_parameterization`` builds a scene for it, which must not happen while a kernel is traced, and
    forgets vertices that have moved. The mesh is not kept: the sensor that keeps these places is a child of it, and
    neither would ever be freed. Raises SceneError where the mesh has no point.
    """

    def __init__(self, mesh: Any, places: np.ndarray) -> None:
        faces = np.array(mesh_faces(mesh)).reshape(-1, 3)
        corners = np.zeros((len(faces), 3, 3))
        corners[:, :, :2] = np.array(mesh_texcoords(mesh), dtype=np.float64).reshape(-1, 2)[faces]
        origins = np.column_stack([places, np.full(len(places), -1.0)])
        _, triangle = first_hits(origins, np.array([0.0, 0.0, 1.0]), corners)
        missed = int((triangle < 0).sum())
        if missed:
            raise SceneError(
                f"nlos_capture_meter: expected texture coordinates of the mesh {mesh.id()!r} that fill the square from "
                f"0 to 1, got none at {missed} of {len(places)} places of the film. Give the points: an array (N, 3), "
                "one for each pixel, and the laser's as laser_points."
            )
        a, b, c = corners[triangle, :, :2].transpose(1, 0, 2)
        edges = np.stack([b - a, c - a], axis=-1)
        along = np.linalg.solve(edges, (places - a)[..., None])[..., 0]
        self._triangle = mi.UInt32(triangle.astype(np.uint32))
        self._along = [mi.Float(np.ascontiguousarray(column, dtype=np.float32)) for column in along.T]
        dr.make_opaque(self._triangle, self._along)

    def points(self, mesh: Any, index: Any) -> Any:
        """Return the points (Point3f) of places given by their index, attached where the vertices of ``mesh`` are."""
        face = mesh.face_indices(dr.gather(mi.UInt32, self._triangle, index))
        a, b, c = (mi.Point3f(mesh.vertex_position(corner)) for corner in face)
        first, second = (dr.gather(mi.Float, column, index) for column in self._along)
        return a + (b - a) * first + (c - a) * second


# ----------------------------------------------------------------------------------------------------------------------


class NLOSCaptureMeter(mi.Sensor):
    r"""Scans a relay wall (:monosp:`nlos_capture_meter`): a child of the wall's shape, or with ``points`` anywhere.

    ``sensor_origin`` (point, (0, 0, 0))
        Where the sensor stands, metres.
    ``points`` (array (N, 3) or (H, W, 3); none)
        The scanned points, in the order of the film's pixels; in a scene file a text of numbers. Without them pixel
        (i, j) of a film of W x H scans the point of the shape with texture coordinates ((i + 1/2) / W, (j + 1/2) / H),
        so that no two pixels share one: of a rectangle, or of a mesh with texture coordinates that say of all of them
        where they are. Other shapes need ``points``.
    ``laser_points`` (array (M, 3) or (Lh, Lw, 3); none)
        Where the laser points, for captures of type single (M = 1), exhaustive and pairs (one for each pixel); without
        them as the integrator ``transient_nlos_path`` says.
    ``laser_origin`` (point; that of the scene's emitter)
        Where the laser stands.
    ``laser_lookat_pixel`` (point; none)
        Of scenes from before ``laser_points``: the laser points at the place of the shape with texture coordinates
        (x / W, y / H), a place of the film.
    ``film`` (``transient_hdr_film`` or another film of this library)

    Every sample of a pixel looks along the same ray, so spatial filters do not spread it. A pixel measures the radiance
    that leaves its point towards the sensor.

    Differentiable: ``sensor_origin``, ``points``, ``laser_points`` and ``laser_origin`` (the rays follow; what they
    meet decides where the points are).
    """

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        self.origin = mi.Point3f(_place_of(props, "sensor_origin", mi.ScalarPoint3f(0)))
        self.points = _points_of(props, "points")
        self.laser_points = _points_of(props, "laser_points")
        self.laser_origin = mi.Point3f(_place_of(props, "laser_origin")) if "laser_origin" in props else None
        self.lookat_pixel = list(_place_of(props, "laser_lookat_pixel")) if "laser_lookat_pixel" in props else None
        # Older scenes repeat these properties of the integrator here.
        for name in ("account_first_and_last_bounces", "confocal"):
            props.get(name, None)
        # Of a wall that is a mesh, once they are asked for.
        self._grid = self._looked_at = None
        self._check()
        dr.make_opaque(self.origin, self.laser_origin)

    def _check(self) -> None:
        size = self.film().size()
        if self.points is not None and dr.width(self.points) != size[0] * size[1]:
            raise SceneError(
                f"nlos_capture_meter: expected one of 'points' for each of the film's {size[0]} x {size[1]} pixels, "
                f"got {dr.width(self.points)}. Set the film's width and height to the scan's."
            )
        if self.lookat_pixel is not None and not all(
            0 <= place <= n for place, n in zip(self.lookat_pixel, size, strict=False)
        ):
            raise SceneError(
                f"nlos_capture_meter: expected laser_lookat_pixel as a place of the film's {size[0]} x {size[1]} "
                f"pixels, got {self.lookat_pixel}."
            )
        if self.lookat_pixel is not None and self.laser_points is not None:
            raise SceneError(
                "nlos_capture_meter: laser_lookat_pixel and laser_points both say where the laser points; give one."
            )

    def traverse(self, cb: Any) -> None:
        super().traverse(cb)
        cb.put("sensor_origin", self.origin, mi.ParamFlags.Differentiable)
        for name in ("points", "laser_points", "laser_origin"):
            if getattr(self, name) is not None:
                cb.put(name, getattr(self, name), mi.ParamFlags.Differentiable)

    def world_transform(self) -> Any:
        """Pose of the sensor, for the frame of polarization: upright, as the world is."""
        return mi.Transform4f().translate(self.origin)

    def targets(self, pixel: Any) -> Any:
        """Return the scanned points (Point3f) of pixels, given by their index in the film."""
        if self.points is not None:
            return dr.gather(mi.Point3f, self.points, pixel)
        shape, size = self._surface(), self.film().size()
        if _is_rectangle(shape):
            row = pixel // int(size[0])
            column = pixel - row * int(size[0])
            place = (mi.Point2f(mi.Float(column), mi.Float(row)) + 0.5) / mi.ScalarVector2f(size)
            return shape.sample_position(0.0, place).p
        if self._grid is None:
            x, y = ((np.arange(int(n)) + 0.5) / int(n) for n in size)
            self._grid = PlacesOnMesh(shape, np.stack(np.meshgrid(x, y), -1).reshape(-1, 2))
        return self._grid.points(shape, pixel)

    def _surface(self) -> Any:
        """Return the shape, whose texture coordinates place the scanned points."""
        shape = self.get_shape()
        if shape is None:
            raise SceneError(
                "nlos_capture_meter: expected a shape to scan or 'points', got neither. Put the sensor into the relay "
                "wall's shape, or give the points."
            )
        if _is_rectangle(shape) or (shape.is_mesh() and has_texcoords(shape)):
            return shape
        kind = "a mesh without texture coordinates" if shape.is_mesh() else f"the shape {class_of(shape)}"
        raise SceneError(
            f"nlos_capture_meter: expected a rectangle, a mesh with texture coordinates, or 'points', got {kind}, "
            "which does not say where the points of a grid are. Give the points: an array (N, 3), one for each pixel, "
            "and the laser's as laser_points."
        )

    def scanned(self) -> Any:
        """Return the scanned points (Point3f) of all pixels of the film's crop window, row by row."""
        film = self.film()
        (width, height), (x, y) = film.crop_size(), film.crop_offset()
        index = dr.arange(mi.UInt32, int(width) * int(height))
        row = index // int(width)
        return self.targets((row + int(y)) * int(film.size()[0]) + (index - row * int(width)) + int(x))

    def spots(self) -> Any:
        """Targets of the laser (Point3f), None if the sensor sets none."""
        if self.lookat_pixel is None:
            return self.laser_points
        shape, size = self._surface(), self.film().size()
        place = self.lookat_pixel[0] / int(size[0]), self.lookat_pixel[1] / int(size[1])
        if _is_rectangle(shape):
            return shape.sample_position(0.0, mi.Point2f(*place)).p
        if self._looked_at is None:
            self._looked_at = PlacesOnMesh(shape, np.array([place]))
        return self._looked_at.points(shape, mi.UInt32(0))

    def sample_ray(self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True) -> Any:
        film = self.film()
        size, crop = film.size(), film.crop_size()
        cell = mi.Vector2u(dr.clip(mi.Vector2i(dr.floor(sample2 * mi.ScalarVector2f(crop))), 0, mi.Vector2i(crop) - 1))
        cell += mi.Vector2u(film.crop_offset())
        target = self.targets(cell.y * int(size[0]) + cell.x)
        wavelengths, weight = [], mi.Spectrum(1)
        if mi.is_spectral:
            wavelengths, weight = mi.sample_rgb_spectrum(mi.sample_shifted(sample1))
            weight = mi.unpolarized_spectrum(weight)
        ray = mi.RayDifferential3f(mi.Ray3f(self.origin, dr.normalize(target - self.origin), time, wavelengths))
        return ray, weight

    def sample_ray_differential(self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True) -> Any:
        return self.sample_ray(time, sample1, sample2, sample3, active)

    def bbox(self) -> Any:
        return mi.ScalarBoundingBox3f()

    def to_string(self) -> str:
        return f"NLOSCaptureMeter[\n  sensor_origin = {self.origin},\n  film = {self.film()}\n]"


def _is_rectangle(shape: Any) -> bool:
    """Mitsuba's own, which counts as a mesh, too."""
    return bool(shape.shape_type() == +mi.ShapeType.Rectangle)


def _place_of(props: Any, name: str, default: Any = None) -> Any:
    """Return a point of a sensor's properties. Raises SceneError unless it is one, and finite."""
    given = props.get(name, default)
    numbers = real_array(given)
    if numbers is None or numbers.shape != (3,) or not np.isfinite(numbers).all():
        raise SceneError(f"nlos_capture_meter: expected {name} as a point of three finite numbers, got {shown(given)}.")
    return mi.ScalarPoint3f(numbers)


def _points_of(props: Any, name: str) -> Any:
    """Return an array of points of a sensor's properties as a Point3f in memory, None where there is none."""
    if name not in props:
        return None
    given = props[name]
    if isinstance(given, str):
        # Scene files have no arrays: a text of numbers, point after point.
        try:
            given = np.array([float(number) for number in given.replace(",", " ").split()])
        except ValueError as error:
            raise SceneError(f"nlos_capture_meter: expected {name} as numbers with commas, {error}.") from error
        given = given.reshape(-1, 3) if given.size % 3 == 0 else given
    values = np.asarray(given, dtype=np.float32)
    if values.size == 0 or values.shape[-1] != 3 or not np.isfinite(values).all():
        raise SceneError(
            f"nlos_capture_meter: expected {name} as finite points of shape (N, 3) or (H, W, 3) in metres, got shape "
            f"{values.shape}."
        )
    points = mi.Point3f(np.ascontiguousarray(values.reshape(-1, 3).T))
    dr.make_opaque(points)
    return points


register("sensor", "nlos_capture_meter", NLOSCaptureMeter)
# What is seen from the scanned points, and lit from the spots, changes with them.
_PLACE = ParameterEffect(moves_length=True, moves_silhouette=True, role="sensor")
# The rays of the sensor do not follow the laser.
_LASER = ParameterEffect(moves_length=True, moves_silhouette=True, role="emitter")
declare_effects(
    NLOSCaptureMeter, {"sensor_origin": _PLACE, "points": _PLACE, "laser_points": _LASER, "laser_origin": _LASER}
)
