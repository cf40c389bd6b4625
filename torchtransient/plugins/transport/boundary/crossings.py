"""Lines that no table of edges holds: where bodies run into each other, and where a camera's clip planes cut shapes.

Two bodies run into each other where edges of one cross faces of the other. The line in which they meet is no edge of
either one. Bodies that touch or stand on each other have no such line.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.plugins.edges.joined import joined_places, merged
from torchtransient.plugins.edges.table import BESIDE
from torchtransient.plugins.edges.topology import BALL, DISK_RIM, Body, bodies_of
from torchtransient.plugins.kernel_arrays import floats, host_numbers, registry_number
from torchtransient.plugins.mitsuba_compat import mesh_faces, mesh_positions, near_clip
from torchtransient.plugins.mitsuba_shapes import bounds_of
from torchtransient.plugins.node_walk import shapes_of_scene
from torchtransient.plugins.sensors.origin import sensors_of
from torchtransient.plugins.sensors.seen_from import clip_planes_at
from torchtransient.plugins.transport.scene_contents import is_open

# How deep an edge reaches through a face at least, in parts of the largest coordinate of both bodies: edges that lie
# less deep, by rounding, in what they stand on are found.
_DEPTH = BESIDE
# Least cosine between an edge and the normal of a face that it crosses.
_GRAZING = 1e-3
# How far inside of a triangle an edge crosses it, in parts of the triangle's height: edges of what stands on bodies
# side by side run along the rims of the faces in which these touch.
_INSIDE = 1e-3
# Sides of a circle, which is 1e-3 of its radius away from them; of many ellipsoids at least so many. No corner lies on
# an axis, and none on the equator: there other bodies end.
_SIDES, _FEWEST = 62, 10
_FIRST_ANGLE = 0.03
# Where the corners of smaller triangles lie along the sides of each face, in parts: edges may run through the middle of
# a rectangle, which is a rim of its two triangles.
_ALONG = (0.31, 0.57, 0.43)
# Faces that are looked at along an edge, the body's own ones included.
_MOST_FACES = 64
# Faces and connected parts of a mesh up to which these are looked at one by one.
_MOST_SPLIT, _MOST_PARTS = 10_000, 256
# Lines across the picture, in each direction, along which clip planes are searched; surfaces that are met along each.
_LINES, _MOST_HITS = 64, 1024


class _Solid:
    """Triangles of a body, of the faces ``rows`` of a mesh, or of a grid of points on balls, disks and tubes.

    ``points`` (V, 3), ``faces`` (F, 3), their boxes ``low``, ``high`` (F, 3), ``reach``, the largest coordinate, and
    ``near`` (F,), which of them reach into another body's box.
    """

    def __init__(self, body: Body, rows: np.ndarray | None, points: np.ndarray, faces: np.ndarray) -> None:
        self.body, self.rows, self.points = body, rows, points
        self.faces = faces if rows is None else faces[rows]
        corners = self.points[self.faces]
        self.low, self.high = corners.min(1), corners.max(1)
        self.reach = float(np.abs(corners).max(initial=0))
        self.near = np.zeros(len(self.faces), bool)

    def mark(self, other: _Solid) -> None:
        """Mark the faces of both that reach into the other's box, if both have some."""
        depth = _DEPTH * max(self.reach, other.reach)
        found = [one._reaching_into(two, depth) for one, two in ((self, other), (other, self))]
        if all(rows.any() for rows in found):
            self.near |= found[0]
            other.near |= found[1]

    def _reaching_into(self, other: _Solid, depth: float) -> np.ndarray:
        low, high = other.low.min(0), other.high.max(0)
        return ((self.low + depth < high) & (low + depth < self.high)).all(1)

    def segments(self) -> np.ndarray:
        """Return the ends (E, 2, 3) of edges of ``near`` faces and of triangles inside them, which may cross a face."""
        faces = self.faces[self.near]
        pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        keys = np.unique(pairs[:, 0] * len(self.points) + pairs[:, 1])
        edges = self.points[np.stack(np.divmod(keys, len(self.points)), 1)]
        corners = self.points[faces]
        small = corners + (np.roll(corners, -1, axis=1) - corners) * np.array(_ALONG)[:, None]
        return np.concatenate([edges, np.stack([small, np.roll(small, -1, axis=1)], 2).reshape(-1, 2, 3)])


def _triangles(body: Body) -> tuple[np.ndarray, np.ndarray]:
    """Return points and triangles of a body in world space."""
    shape = body.shape
    if not shape.is_mesh():
        return _grid(body)
    if body.instance is None:
        points = host_numbers(mesh_positions(shape)).reshape(-1, 3)
    else:
        points = host_numbers(body.vertices(dr.arange(mi.UInt32, shape.vertex_count()))).T
    return points, np.array(mesh_faces(shape), np.int64).reshape(-1, 3)


def _grid(body: Body) -> tuple[np.ndarray, np.ndarray]:
    """Return points and triangles of balls, of a disk or of a tube."""
    o, x, y, z = (host_numbers(each).T[:, None, None] for each in body.frames()[0])
    kind = body.limbs()[0][0]
    around = max(_FEWEST, round(_SIDES / len(o) ** 0.5))
    if kind == BALL:
        slope = np.linspace(0, np.pi, around // 4 * 2 + 2)
        radius, height = np.sin(slope), np.cos(slope)
    else:
        radius, height = (np.arange(2), np.zeros(2)) if kind == DISK_RIM else (np.ones(2), np.arange(2))
    angle = _FIRST_ANGLE + np.arange(around) * 2 * np.pi / around
    circle = x * np.cos(angle)[:, None] + y * np.sin(angle)[:, None]
    points = o + radius[:, None, None] * circle + height[:, None, None] * z
    first = np.arange(points[..., 0].size).reshape(points.shape[:-1])
    a, b = first[:, :-1], first[:, 1:]
    c, d = np.roll(a, -1, axis=2), np.roll(b, -1, axis=2)
    faces = np.stack([np.stack([a, b, c], -1), np.stack([b, d, c], -1)])
    return points.reshape(-1, 3), faces.reshape(-1, 3)


def crossing_bodies(scene: Any) -> list[tuple[Body, Body]]:
    """Return the pairs of bodies of a scene that run into each other, each once.

    A pair is a body and itself where parts of one mesh do. Open boundaries of media are left out: light does not jump
    there. Rays are traced along the edges of faces that reach into the box of another body; scenes without such faces
    run no kernel for it.

    Args:
        scene: Mitsuba scene.
    """
    with dr.suspend_grad():
        bodies = [body for body in bodies_of(scene) if not (body.shape.is_medium_transition() and is_open(body.shape))]
        parts = [(body, rows) for body in bodies for rows in _parts(body.shape)]
        triangles = cache(_triangles)
        pairs = _overlapping([_box(body, rows, triangles) for body, rows in parts])
        solids = {k: _Solid(*parts[k], *triangles(parts[k][0])) for k in sorted({k for pair in pairs for k in pair})}
        for i, j in pairs:
            solids[i].mark(solids[j])
        return _crossings(scene, [solid for solid in solids.values() if solid.near.any()])


def _parts(shape: Any) -> list[np.ndarray | None]:
    """Return the faces of the connected parts of a mesh, None for all: Mitsuba merges rectangles of one material."""
    if not shape.is_mesh() or not 0 < shape.face_count() <= _MOST_SPLIT:
        return [None]
    faces = np.array(mesh_faces(shape), np.int64).reshape(-1, 3)
    joined = joined_places(host_numbers(mesh_positions(shape), np.float32).reshape(-1, 3), faces)
    label = merged(joined, int(joined.max()) + 1)[joined[:, 0]]
    numbers = np.unique(label)
    return [np.flatnonzero(label == k) for k in numbers] if 1 < len(numbers) <= _MOST_PARTS else [None]


def _box(body: Body, rows: np.ndarray | None, triangles: Callable[[Body], Any]) -> np.ndarray:
    """Return the corners (2, 3) of the box of a body, or of the faces ``rows`` of it."""
    if rows is None:
        bounds = bounds_of(body.instance or body.shape)
        return np.array([bounds.min, bounds.max]).reshape(2, 3)
    points, faces = triangles(body)
    corners = points[faces[rows]]
    return np.stack([corners.min((0, 1)), corners.max((0, 1))])


def _overlapping(boxes: list[np.ndarray]) -> list[tuple[int, int]]:
    """Return the pairs of boxes that reach into each other."""
    low, high = np.moveaxis(np.array(boxes).reshape(-1, 2, 3), 1, 0)
    depth = _DEPTH * np.maximum(np.abs(low), np.abs(high)).max(1, initial=0)
    pairs = []
    for i in range(len(boxes) - 1):
        others = slice(i + 1, None)
        d = np.maximum(depth[others], depth[i])[:, None]
        found = ((low[others] + d < high[i]) & (low[i] + d < high[others])).all(1)
        pairs += [(i, i + 1 + j) for j in np.flatnonzero(found).tolist()]
    return pairs


def _crossings(scene: Any, solids: list[_Solid]) -> list[tuple[Body, Body]]:
    """Return the bodies that cross each other, found by rays along the edges near others."""
    if not solids:
        return []
    reach = np.array([solid.reach for solid in solids])
    is_mesh = np.array([solid.body.shape.is_mesh() for solid in solids])
    ends = [solid.segments() for solid in solids]
    own = np.repeat(np.arange(len(solids)), [len(each) for each in ends])
    start, stop = np.moveaxis(np.concatenate(ends), 1, 0)
    length = np.linalg.norm(stop - start, axis=1)
    at, rows = _DEPTH * reach[own], np.arange(len(own))
    owners = _Owners(solids)
    found: set[tuple[int, int]] = set()
    for _ in range(_MOST_FACES):
        rows = rows[at[rows] < length[rows] - _DEPTH * reach[own[rows]]]
        if not len(rows):
            break
        d = (stop[rows] - start[rows]) / length[rows, None]
        t, address, cosine, inside = _next_face(scene, start[rows] + d * at[rows, None], d, length[rows] - at[rows])
        hit = np.isfinite(t)
        rows, address, cosine, inside = rows[hit], address[:, hit], cosine[hit], inside[hit]
        at[rows] += t[hit]
        other = owners.find(address)
        depth = cosine * np.minimum(at[rows], length[rows] - at[rows])
        counts = (other >= 0) & (other != own[rows]) & (cosine > _GRAZING) & (inside | ~is_mesh[other])
        counts &= depth > _DEPTH * np.maximum(reach[own[rows]], reach[other])
        pairs = np.unique(np.sort(np.stack([own[rows], other], 1)[counts], axis=1), axis=0)
        found |= {(i, j) for i, j in pairs.tolist()}
        at[rows] += _DEPTH * reach[own[rows]]
    return list(dict.fromkeys((solids[i].body, solids[j].body) for i, j in sorted(found)))


class _Owners:
    """Numbers of the solids that faces belong to."""

    def __init__(self, solids: list[_Solid]) -> None:
        self._numbers: dict[tuple[int, int], np.ndarray] = {}
        for k, solid in enumerate(solids):
            shape, instance = solid.body.shape, solid.body.instance
            address = registry_number(shape), 0 if instance is None else registry_number(instance)
            count = 1 if solid.rows is None else shape.face_count()
            numbers = self._numbers.setdefault(address, np.full(count, -1))
            numbers[slice(None) if solid.rows is None else solid.rows] = k

    def find(self, address: np.ndarray) -> np.ndarray:
        """Return the numbers for registry numbers of shapes and instances and numbers of faces (3, N), -1 for none."""
        found = np.full(address.shape[1], -1)
        for pair in np.unique(address[:2], axis=1).T:
            numbers = self._numbers.get((int(pair[0]), int(pair[1])))
            if numbers is not None:
                here = (address[:2] == pair[:, None]).all(0)
                found[here] = numbers[address[2, here] if len(numbers) > 1 else 0]
        return found


def _next_face(
    scene: Any, o: np.ndarray, d: np.ndarray, length: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Trace rays from ``o`` (N, 3) along unit vectors ``d``.

    Returns:
        Distances (N,), infinite for none; registry numbers of shapes and instances and numbers of faces (3, N); cosines
        to normals; whether the place is inside of a triangle and not at its rim.
    """
    ray = mi.Ray3f(mi.Point3f(*map(floats, o.T)), mi.Vector3f(*map(floats, d.T)))
    ray.maxt = floats(length)
    pi = scene.ray_intersect_preliminary(ray, coherent=False)
    si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal)
    u, v = pi.prim_uv
    inside = dr.minimum(dr.minimum(u, v), 1 - u - v) > _INSIDE
    t = dr.select(pi.is_valid(), pi.t, dr.inf)
    address = [*(dr.reinterpret_array(mi.UInt32, each) for each in (pi.shape, pi.instance)), pi.prim_index]
    cosine = dr.abs(dr.dot(si.n, ray.d))
    dr.eval(t, address, cosine, inside)
    numbers = np.array([np.array(each, np.int64) for each in address])
    return host_numbers(t), numbers, host_numbers(cosine), np.array(inside)


# -------------------------------------------------------------------------------------------------------- clip planes


def clipped_shapes(scene: Any, sensors: Sequence[Any]) -> list[Any]:
    """Return the shapes, instances included, that clip planes cut within the picture, hidden ones too.

    Searched along lines of the planes, so that a cut that is shorter than 1 / 64 of the picture may be missed.

    Args:
        scene: Mitsuba scene.
        sensors: some of its sensors.
    """
    found: set[int] = set()
    with dr.suspend_grad():
        for camera in [one for sensor in sensors for one in sensors_of(sensor) if near_clip(one) is not None]:
            across = (dr.arange(mi.Float, _LINES) + 0.5) / _LINES
            low, high = dr.zeros(mi.Float, _LINES), dr.ones(mi.Float, _LINES)
            starts = mi.Point2f(dr.concat([low, across]), dr.concat([across, low]))
            stops = mi.Point2f(dr.concat([high, across]), dr.concat([across, high]))
            for start, stop in zip(clip_planes_at(camera, starts), clip_planes_at(camera, stops), strict=True):
                found |= _met(scene, mi.Ray3f(start, stop - start))
    shapes = [shape for shape in shapes_of_scene(scene) if registry_number(shape) in found]
    return [shape for shape in shapes if not (shape.is_medium_transition() and is_open(shape))]


def _met(scene: Any, ray: Any) -> set[int]:
    """Return the registry numbers of shapes and instances that rays meet at distances below one."""
    found: set[int] = set()
    ray.maxt = mi.Float(1)
    active = mi.Bool(True)
    for _ in range(_MOST_HITS):
        pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
        active &= pi.is_valid()
        numbers = [dr.reinterpret_array(mi.UInt32, pointer) for pointer in (pi.shape, pi.instance)]
        met = [np.array(dr.select(active, number, 0)) for number in numbers]
        if not any(one.any() for one in met):
            break
        found |= {int(number) for one in met for number in np.unique(one)}
        step = pi.t + 1e-4
        ray.o, ray.maxt = ray.o + ray.d * step, ray.maxt - step
        active &= ray.maxt > 0
    return found - {0}
