"""The scan of a scene that is built: where the rays of sensor and laser end."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchtransient.capture import Scan
from torchtransient.errors import SceneError, TorchTransientWarning
from torchtransient.plugins.parameter_effect import class_of

# Two points are one up to this part of the scan's size.
SAME_POINT = 1e-3
_REMEDY = "tt.TransientRenderer renders other scenes, without a scan."


@dataclass(frozen=True)
class Ends:
    """Ends of rays.

    ``points`` and unit ``normals`` (N, 3) on the side that they come from, float64, ``shapes``: names of the shapes
    that they meet, "" for nothing, ``origins`` and ``directions`` (N, 3).
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    shapes: list[str]
    origins: NDArray[np.float64]
    directions: NDArray[np.float64]

    def missed(self) -> NDArray[np.int64]:
        """Return the indices of the rays that meet nothing."""
        return np.flatnonzero([not name for name in self.shapes])

    def of(self, which: NDArray[np.int64]) -> Ends:
        """Return the ends of some rays, by their indices."""
        arrays = (self.points, self.normals, self.origins, self.directions)
        points, normals, origins, directions = (array[which] for array in arrays)
        return Ends(points, normals, [self.shapes[i] for i in which], origins, directions)


def scan_of_scene(scene: Any) -> Scan:
    """Return the scan that a built scene's sensor, laser and integrator ``transient_nlos_path`` make, without a wall.

    Points are the ends of the rays of pixel centres, rows as the film has them; where some look past the wall, a
    warning says so, and their points are on its plane. Call it inside ``active_variant``.

    Args:
        scene: a built Mitsuba scene.

    Raises:
        SceneError: for another integrator, a laser that has no spot, rays that meet nothing or the back of a wall, and
            spots of a confocal capture that are no sensor points.
    """
    integrator, sensor = scene.integrator(), scene.sensors()[0]
    if not hasattr(integrator, "capture"):
        raise SceneError(
            f"simulate: expected a scene with the integrator transient_nlos_path, got {class_of(integrator)}. {_REMEDY}"
        )
    sensor, film = integrator.resolve(scene, sensor)
    kind = integrator.capture.name.lower()
    columns, rows = (int(n) for n in film.crop_size())
    ends = _sensor_ends(scene, sensor)
    if hasattr(sensor, "scanned"):
        aimed = _array(sensor.scanned())
        _check_same(ends, aimed, aimed, "sensor")
        _check_hidden(scene, ends)
    seen, there = _on_extended_wall(ends, (rows, columns))
    points = seen.points.reshape(rows, columns, 3)
    normals = seen.normals.reshape(rows, columns, 3)
    laser_origin, spots = _laser_ends(scene, sensor, integrator)
    if kind == "confocal":
        _check_same(spots.of(there), seen.points[there], seen.points, "laser")
        laser_points, laser_normals = points, normals
    else:
        missed = spots.missed()
        if len(missed):
            way = np.array2string(spots.directions[missed[0]], precision=4)
            raise SceneError(
                f"scan: {len(missed)} of the laser's {len(spots.shapes)} beams meet nothing, the first is number "
                f"{missed[0]}, along {way}. Aim the laser at the relay wall."
            )
        grid = (film.laser_scan_height, film.laser_scan_width, 3)
        shape: Any = {"single": (3,), "pairs": points.shape}.get(kind, grid)
        laser_points, laser_normals = spots.points.reshape(shape), spots.normals.reshape(shape)
    return Scan(
        kind=kind,
        sensor_points=torch.from_numpy(points),
        laser_points=torch.from_numpy(laser_points),
        sensor_origin=torch.from_numpy(_origin(sensor)),
        laser_origin=torch.from_numpy(laser_origin),
        sensor_normals=torch.from_numpy(normals),
        laser_normals=torch.from_numpy(laser_normals),
        first_and_last_leg=bool(integrator.legs),
    )


def check_scan_is_seen(scene: Any, scan: Scan) -> None:
    """Check that rays of a scan's own scene end at its points, and that something hidden is before the wall.

    Call it inside ``active_variant``.

    Args:
        scene: a built Mitsuba scene.
        scan: scan that was made of the scene.

    Raises:
        SceneError: otherwise.
    """
    sensor = scene.sensors()[0]
    points = scan.sensor_points.detach().cpu().numpy().reshape(-1, 3)
    ends = _sensor_ends(scene, sensor)
    _check_same(ends, points, points, "sensor")
    _check_hidden(scene, ends)
    spots = scan.laser_points.detach().cpu().numpy().reshape(-1, 3)
    _check_same(_laser_ends(scene, sensor, scene.integrator())[1], spots, points, "laser")


def tolerance_of(scan: Scan) -> float:
    """Return the distance from a point of a scan at which a ray that looks at it may end, metres.

    Args:
        scan: scan of any kind.
    """
    points = scan.sensor_points.detach().cpu().numpy().reshape(-1, 3)
    return SAME_POINT * max(_extent(points), float(scan.sensor_legs.detach().max()))


# ---------------------------------------------------------------------------------------------------------------- rays


def _sensor_ends(scene: Any, sensor: Any) -> Ends:
    """Ends of the rays of pixel centres, row by row."""
    from torchtransient.plugins.around_corner.scan_table import scan_rays

    return _ends(scene, scan_rays(sensor))


def _laser_ends(scene: Any, sensor: Any, integrator: Any) -> tuple[NDArray[np.float64], Ends]:
    """Return the laser's origin (3,), and the ends of its beams."""
    import drjit as dr
    import mitsuba as mi

    from torchtransient.interfaces import CaptureType
    from torchtransient.plugins.around_corner.scan_table import aims_of, check_count, laser_of, origin_of

    laser = laser_of(scene)
    if laser.get_shape() is not None or mi.has_flag(laser.flags(), mi.EmitterFlags.Infinite):
        raise SceneError(
            f"simulate: expected a laser whose beam falls on a spot, got the emitter {class_of(laser)}. {_REMEDY}"
        )
    fov = None
    if integrator.capture is CaptureType.EXHAUSTIVE and not integrator.equal_grids:
        fov = integrator.laser_fov
    origin, aims = origin_of(scene, sensor), aims_of(scene, sensor, integrator.capture, fov)
    check_count(aims, sensor, integrator.capture)
    return _array(origin).reshape(3), _ends(scene, mi.Ray3f(origin, dr.normalize(aims)))


def _ends(scene: Any, ray: Any) -> Ends:
    import drjit as dr
    import mitsuba as mi

    with dr.suspend_grad():
        si = scene.ray_intersect(ray)
        # A surface without a back side scatters nothing to those behind it.
        behind = si.is_valid() & (si.wi.z < 0) & ~mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.BackSide)
        normals = dr.select(si.wi.z < 0, -si.n, si.n)
        shapes = [shape.id() or class_of(shape) for shape in scene.shapes()]
        addresses = {shape.ptr: name for shape, name in zip(scene.shapes(), shapes, strict=True)}
        dr.eval(si, behind, normals)
    valid = np.array(si.is_valid())
    hit = [addresses.get(shape.ptr, "a part of a group") if shape is not None else "" for shape in _shapes(si, valid)]
    dark = np.flatnonzero(np.array(behind))
    if len(dark):
        raise SceneError(
            f"scan: {len(dark)} of {len(hit)} rays end on the back of {hit[dark[0]]!r}, which scatters nothing there. "
            "Move sensor_origin or laser_origin to the side that its normals point to, in front of the wall and of "
            "what is hidden; or turn it (flip_normals), or make it twosided."
        )
    count = len(valid)
    origins = np.broadcast_to(_array(ray.o), (count, 3))
    return Ends(_array(si.p), _array(normals), hit, origins, _array(ray.d))


def _shapes(si: Any, valid: NDArray[np.bool_]) -> list[Any]:
    """The shape that each ray meets, None for nothing."""
    import drjit as dr
    import mitsuba as mi

    numbers = np.array(dr.reinterpret_array(mi.UInt32, si.shape))
    known = {int(n): dr.gather(mi.ShapePtr, si.shape, int(np.flatnonzero(numbers == n)[0])) for n in np.unique(numbers)}
    return [known[int(n)][0] if there else None for n, there in zip(numbers, valid, strict=True)]


def _array(points: Any) -> NDArray[np.float64]:
    return np.array(points, dtype=np.float64).T.copy()


def _origin(sensor: Any) -> NDArray[np.float64]:
    import mitsuba as mi

    return _array(mi.Point3f(sensor.world_transform().translation())).reshape(3)


# -------------------------------------------------------------------------------------------------------------- checks


def _on_extended_wall(ends: Ends, size: tuple[int, int]) -> tuple[Ends, NDArray[np.int64]]:
    """Return the ends, with rays that look past the wall continued to the plane of the nearest pixel that meets
    something, and the indices of the rays that do meet it; ``size``: rows and columns of the film.
    """
    missed = ends.missed()
    met = np.setdiff1d(np.arange(len(ends.shapes)), missed)
    if not len(met):
        raise SceneError(
            f"scan: the sensor meets nothing in the scene with any of its {len(missed)} rays. Aim it at the relay wall."
        )
    if not len(missed):
        return ends, met
    rows, columns = np.divmod(np.arange(size[0] * size[1]), size[1])
    apart = (rows[missed, None] - rows[met]) ** 2 + (columns[missed, None] - columns[met]) ** 2
    near = met[apart.argmin(1)]
    normals, points = ends.normals.copy(), ends.points.copy()
    origins, directions = ends.origins[missed], ends.directions[missed]
    slope = (directions * normals[near]).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = ((points[near] - origins) * normals[near]).sum(1) / slope
    lost = int((~((slope < 0) & (distance > 0))).sum())
    if lost:
        raise SceneError(
            f"scan: {len(missed)} of the sensor's {len(ends.shapes)} rays meet nothing in the scene, {lost} of them "
            f"not even if the wall went on. A capture has a point of the wall for each: aim the sensor at it. {_REMEDY}"
        )
    points[missed], normals[missed] = origins + distance[:, None] * directions, normals[near]
    warnings.warn(
        f"scan: {len(missed)} of the sensor's {len(ends.shapes)} rays look past the wall. Their values are zero, and "
        "their points those where they would meet it if it went on.",
        TorchTransientWarning,
        stacklevel=2,
    )
    return Ends(points, normals, ends.shapes, ends.origins, ends.directions), met


def _check_hidden(scene: Any, wall: Ends) -> None:
    """Raise SceneError unless a shape that rays do not meet reaches before the wall."""
    seen = set(wall.shapes)
    hidden = [shape for shape in scene.shapes() if (shape.id() or class_of(shape)) not in seen]
    if not hidden:
        raise SceneError(
            "hidden: expected at least one shape beside the wall, got none. Add the hidden things as shapes."
        )
    _check_areas(hidden)
    if reaches_before(hidden, wall.points, wall.normals):
        return
    raise SceneError(
        "hidden: expected something before the wall, got nothing there. Move it, or turn the wall (flip_normals)."
    )


def _extent(points: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def reaches_before(shapes: list[Any], points: NDArray[np.float64], normals: NDArray[np.float64]) -> bool:
    """Return True where the box of a shape reaches before the wall at one of its points.

    Args:
        shapes: Mitsuba shapes.
        points: points on the wall, (N, 3).
        normals: wall normals at the points, (N, 3).
    """
    for shape in shapes:
        box = shape.bbox()
        corners = np.array(np.meshgrid(*zip(box.min, box.max, strict=True))).reshape(3, -1).T
        # Mostly the first point tells.
        for chosen in (slice(0, 1), slice(1, None)):
            if bool((((corners[:, None] - points[chosen]) * normals[chosen]).sum(-1) > 0).any()):
                return True
    return False


def _check_areas(shapes: list[Any]) -> None:
    """Raise SceneError where no shape has an area that light could fall on, or one has none that is a number."""
    areas = {}
    for shape in shapes:
        try:
            areas[shape.id() or class_of(shape)] = float(np.array(shape.surface_area()).reshape(-1)[0])
        except RuntimeError:
            return  # of shapes that do not know theirs, such as copies of groups
    told = ", ".join(f"{name!r} ({area:.3g} m^2)" for name, area in areas.items())
    if not all(np.isfinite(area) for area in areas.values()):
        raise SceneError(f"hidden: expected shapes of finite area, got {told}. Give lengths in metres.")
    if not any(area > 0 for area in areas.values()):
        raise SceneError(f"hidden: expected shapes with an area that light falls on, got {told}.")


def _check_same(ends: Ends, points: NDArray[np.float64], scanned: NDArray[np.float64], who: str) -> None:
    """Check that rays end at ``points``; ``scanned``: the points that tell the size of the scan. Raises SceneError."""
    legs = np.linalg.norm(points - ends.origins, axis=-1)
    size = max(_extent(scanned), float(legs.max()))
    off = np.linalg.norm(ends.points - points, axis=-1)
    wrong = np.flatnonzero((off > SAME_POINT * size) | np.array([not name for name in ends.shapes]))
    if not len(wrong):
        return
    first = int(wrong[0])
    met = f"meets {ends.shapes[first]!r} {off[first]:.3g} m away from it" if ends.shapes[first] else "meets nothing"
    what = "sensor points" if who == "sensor" else "laser spots"
    raise SceneError(
        f"scan: {len(wrong)} of {len(points)} {what} are not what the {who} looks at from its origin: the ray to "
        f"number {first}, {np.array2string(points[first], precision=4)}, {met}. Move {who}_origin, or what stands "
        "between it and the wall."
    )
