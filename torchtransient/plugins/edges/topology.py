"""Edges and limbs of a scene: corners, faces and shapes, without positions.

Laid out with numpy once a scene. Positions are looked at to join what was put together and to order three and more
faces around an edge; all that is computed of them later is read anew (:class:`.table.EdgeTable`).
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import groupby
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.plugins.cache import Cache
from torchtransient.plugins.edges.joined import edge_keys, joined_places, near_places
from torchtransient.plugins.kernel_arrays import PointerTable, host_numbers, registry_number, whole_numbers
from torchtransient.plugins.mitsuba_compat import mesh_faces, mesh_positions
from torchtransient.plugins.mitsuba_shapes import is_instance, lacks_edges
from torchtransient.plugins.node_walk import members_of, shapes_of_scene, shown_by
from torchtransient.plugins.transport.strategy import Local

# Flags of a row: a second face; seen from between its faces alone; listed for the other face's vertices, too; faces of
# two bodies.
TWO, GAP, TWIN, SEAM = 1, 2, 4, 8
# What a row is: an edge; the limb of a ball; the two limbs of a tube; the rims of disks and tubes.
EDGE, BALL, TUBE_LEFT, TUBE_RIGHT, DISK_RIM, TUBE_RIM = range(6)
KIND = 16  # the kind's factor in the flags
# Numbers per ellipsoid: centre, semi-axes, quaternion.
_ELLIPSOID = 10


class Body:
    """Shape of the scene, or member of an instance.

    Args:
        shape: the shape.
        instance: instance that it is a member of, or None.
        index: its number among the members.
    """

    def __init__(self, shape: Any, instance: Any = None, index: int = 0xFFFFFFFF) -> None:
        self.shape, self.instance, self.index = shape, instance, index
        self._shown = {value.key: value for value in shown_by(shape)[0]}
        self._placed = None if instance is None else next(v for v in shown_by(instance)[0] if v.key == "to_world")

    def _value(self, key: str) -> Any:
        return self._shown[key].read(self.shape)

    def _to_world(self, p: Any) -> Any:
        return p if self._placed is None else mi.AffineTransform4f(self._placed.read(self.instance)) @ p

    def moves(self, moving: frozenset[Any]) -> bool:
        """Return True if the address of the shape or of its instance is one of ``moving``."""
        return self.shape.ptr in moving or (self.instance is not None and self.instance.ptr in moving)

    def vertices(self, index: Any) -> Any:
        """Return vertices of a mesh (Point3f) by their numbers, attached."""
        return self._to_world(dr.gather(mi.Point3f, mesh_positions(self.shape), index))

    def limbs(self) -> list[tuple[int, int]]:
        """Return (kind of the row, number of the ellipsoid) for each row of a shape that is no mesh."""
        name = self.shape.class_name()
        if name == "Ellipsoids":
            return [(BALL, i) for i in range(dr.width(self._value("data")) // _ELLIPSOID)]
        kinds = {"Sphere": [BALL], "Disk": [DISK_RIM], "Cylinder": [TUBE_LEFT, TUBE_RIGHT, TUBE_RIM, TUBE_RIM]}
        return [(kind, 0) for kind in kinds[name]]

    def frames(self) -> list[tuple[Any, Any, Any, Any]]:
        """Return the space in which the shape is a unit ball, disk or tube, for each row: origin and axes, attached."""
        if self.shape.class_name() == "Ellipsoids":
            return [self._ellipsoid_frames()]
        T = mi.AffineTransform4f(self._value("to_world"))
        o = self._to_world(T @ mi.Point3f(0))
        axes = [self._to_world(T @ mi.Vector3f(*[float(i == k) for k in range(3)])) for i in range(3)]
        if self.shape.class_name() != "Cylinder":
            return [(o, *axes)]
        # The rims of a tube have their face along the third axis.
        return [(o, *axes)] * 3 + [(o + axes[2], axes[0], axes[1], -axes[2])]

    def _ellipsoid_frames(self) -> tuple[Any, Any, Any, Any]:
        data = mi.Float(self._value("data"))
        first = _ELLIPSOID * dr.arange(mi.UInt32, dr.width(data) // _ELLIPSOID)
        n = [dr.gather(mi.Float, data, first + k) for k in range(_ELLIPSOID)]
        turn = dr.quat_to_matrix(mi.Matrix3f, mi.Quaternion4f(*n[6:]))
        # Mitsuba goes to the unit ball by the transpose, which is the inverse where quaternions have length one.
        rows = [mi.Vector3f(turn[0, i], turn[1, i], turn[2, i]) for i in range(3)]
        inverse = [dr.cross(rows[i - 2], rows[i - 1]) for i in range(3)]
        det = dr.dot(rows[0], inverse[0])
        axes = [inverse[i] / det * n[3 + i] * self._extent() for i in range(3)]
        return self._to_world(mi.Point3f(*n[:3])), *(self._to_world(axis) for axis in axes)

    def _extent(self) -> Any:
        if self._value("extent_adaptive_clamping"):
            return dr.sqrt(2 * dr.log(mi.Float(self._value("opacities")) / 0.01)) * (self._value("extent") / 3)
        return self._value("extent")


class _Rows(NamedTuple):
    """Edges of a mesh, numbers of vertices: ``ends`` (E, 2), ``third`` (E, 2) of both faces, ``other`` (E, 2), the ends
    as the second face has them; ``faces`` (E, 2); ``place`` (E, 4), numbers 0 to 2 of the ends in the first face and in
    the second; ``flags``; ``joined`` (E, 2), joined places of the ends.
    """

    ends: np.ndarray
    third: np.ndarray
    other: np.ndarray
    faces: np.ndarray
    place: np.ndarray
    flags: np.ndarray
    joined: np.ndarray


def _halves(joined: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return start, stop and third corner of half-edges, numbers (K, 3) in ``joined.ravel()``; one edge's run alike."""
    face, k = rows // 3 * 3, rows % 3
    start, stop = face + k, face + (k + 1) % 3
    turned = joined.ravel()[start] > joined.ravel()[stop]
    return np.stack([np.where(turned, stop, start), np.where(turned, start, stop), face + (k + 2) % 3], 1)


def _numbers_of(mesh: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices (V, 3) and faces (F, 3) of a mesh as they are now, and a mask of faces with an area (F,)."""
    positions = host_numbers(mesh_positions(mesh), np.float32).reshape(-1, 3)
    faces = np.array(mesh_faces(mesh), np.int64).reshape(-1, 3)
    corners = positions.astype(np.float64)[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return positions, faces, np.any(normals != 0, axis=1)


def _edges_of(positions: np.ndarray, faces: np.ndarray, solid: np.ndarray) -> tuple[_Rows, np.ndarray]:
    """Return (the edges of a mesh with vertices (V, 3) and faces (F, 3), flat ones included; joined places of the
    corners of its faces, (F, 3), zeros where a face is not ``solid`` (F,): has no area).
    """
    all_places = np.zeros(faces.shape, int)
    number = np.flatnonzero(solid)
    faces = faces[number]
    joined = joined_places(positions.astype(np.float32), faces)
    all_places[number] = joined
    key, proper = edge_keys(joined)
    order = np.argsort(key, kind="stable")
    order = order[proper[order]]
    first = np.diff(key[order], prepend=-1) != 0
    group = np.cumsum(first) - 1
    count = np.bincount(group)[group] if len(group) else group
    at = faces.ravel()
    many = np.flatnonzero(count > 2)
    if len(many):
        # Around each edge, from its first face on.
        angle = _angles(positions.astype(np.float64)[at[_halves(joined, order[many])]], group[many])
        order[many] = order[many][np.lexsort((angle, group[many]))]
    last = np.append(first[1:], True)
    start = np.maximum.accumulate(np.where(first, np.arange(len(order)), 0))
    following = np.where(last, start, np.arange(len(order)) + 1)
    a, b = _halves(joined, order), _halves(joined, order[following])
    twin = (count == 2) & np.any(at[a[:, :2]] != at[b[:, :2]], axis=1)
    kept = first | (count > 2) | twin
    flags = (TWO * (count > 1) + GAP * (count > 2) + TWIN * twin)[kept]
    a, b = a[kept], b[kept]
    third, number = np.stack([at[a[:, 2]], at[b[:, 2]]], 1), number[np.stack([a[:, 0], b[:, 0]], 1) // 3]
    place = np.concatenate([a[:, :2], b[:, :2]], 1) % 3
    return _Rows(at[a[:, :2]], third, at[b[:, :2]], number, place, flags, joined.ravel()[a[:, :2]]), all_places


def _angles(p: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Return angles of faces (K,) around their edges against the first of their group, from ends and third corner."""
    t = p[:, 1] - p[:, 0]
    t /= np.linalg.norm(t, axis=1, keepdims=True)
    w = p[:, 2] - p[:, 0]
    h = w - t * (w * t).sum(1, keepdims=True)
    _, first, back = np.unique(group, return_index=True, return_inverse=True)
    x = h[first][back.ravel()]
    return np.arctan2((np.cross(t, x) * h).sum(1), (x * h).sum(1)) % (2 * np.pi)


class Corners:
    """Numbers of vertices, and flags, that tables are made from (:class:`.table.EdgeTable`): ``ends`` by mesh,
    ``third`` and ``other`` as in :class:`_Rows`.
    """

    # No state of recorded calls, which put arrays of their own in place of those that they are handed: kernels of
    # tables would be compiled again for these.
    only_remembers = True

    def __init__(self, ends: list[np.ndarray], third: np.ndarray, other: np.ndarray, flags: np.ndarray) -> None:
        self.ends = [[whole_numbers(each[:, i]) for each in ends] for i in (0, 1)]
        self.third, self.other = ([whole_numbers(x[:, i]) for i in (0, 1)] for x in (third, other))
        self.flags = whole_numbers(flags)
        dr.make_opaque(self.ends, self.third, self.other, self.flags)


class Topology:
    """Edges and limbs of a scene, without positions.

    A plain object of Dr.Jit arrays, to be kept with the scene and to be named as state of recorded calls.

    Two meshes that touch along rims have edges there with one face of each, listed for both, with half of the light:
    where they come apart later, each is a rim of its own. What comes together later is not joined, and the order of
    three and more faces around an edge stays. Faces without area are left out (:func:`topology_of` looks again).

    Args:
        scene: Mitsuba scene.
        hides: function of a shape that says whether it hides light, None for all.

    Attributes:
        count: number of rows.
        rounds: number of limbs and rims of shapes without triangles, the last of the rows.
        bodies: :class:`Body` objects with rows.
    """

    def __init__(self, scene: Any, hides: Callable[[Any], bool] | None = None) -> None:
        bodies = [body for body in bodies_of(scene) if hides is None or hides(body.shape)]
        found = self._found([body.shape for body in bodies if body.shape.is_mesh()])
        self._meshes = [body for body in bodies if body.shape.ptr in found]
        self._others = [body for body in bodies if not body.shape.is_mesh()]
        self.bodies = self._meshes + self._others
        self.areas_at_first = self.areas()
        rows, owners, starts = self._edges(found)
        # Ends in numbers of each mesh: gathered from what was gathered, gradients would not arrive (see `ends`).
        own = [rows.ends[owners[:, 0] == k] - start for k, start in enumerate(starts)]
        limbs = [(k, *limb) for k, body in enumerate(self._others, len(starts)) for limb in body.limbs()]
        owner, kind, number = np.array(limbs, int).reshape(-1, 3).T
        owners = np.concatenate([owners, np.stack([owner, owner], 1)])
        faces = np.concatenate([rows.faces, np.stack([number, number], 1)])
        place = np.concatenate([rows.place, np.zeros((len(limbs), 4), int)]) @ [1, 4, 16, 64]
        flags = np.concatenate([rows.flags, kind * KIND])

        self.rounds, self.count = len(limbs), len(flags)
        self.has_gaps, self.has_twins = bool((flags & GAP).any()), bool((flags & TWIN).any())
        self.corners = Corners(own, rows.third, rows.other, flags)
        self.faces, self.owners = ([whole_numbers(x[:, i]) for i in (0, 1)] for x in (faces, owners))
        index = np.array([body.index for body in self.bodies])
        self.place, self.index = whole_numbers(place), whole_numbers(index)
        self.shape, self.instance = (
            whole_numbers(np.array([0 if x is None else registry_number(x) for x in each]))
            for each in ([b.shape for b in self.bodies], [b.instance for b in self.bodies])
        )
        # Rows follow each other by what they belong to.
        self._runs = [(k, len(list(run))) for k, run in groupby(owners[:, 0].tolist())]
        dr.make_opaque(self.faces, self.owners, self.place, self.index, self.shape, self.instance)

    def _found(self, meshes: list[Any]) -> dict[int, tuple[_Rows, np.ndarray]]:
        """Results of :func:`_edges_of`, one per mesh with edges."""
        self._flat, found = [], {}
        for mesh in {mesh.ptr: mesh for mesh in meshes}.values():
            positions, faces, solid = _numbers_of(mesh)
            if not solid.all():
                self._flat.append(mesh)
            if solid.any():
                found[mesh.ptr] = _edges_of(positions, faces, solid)
        return found

    def areas(self) -> bytes:
        """Return masks of the faces with an area now, of the meshes in which some had none; empty without such meshes.
        """
        return b"".join(np.packbits(_numbers_of(mesh)[2]).tobytes() for mesh in self._flat)

    def _edges(self, found: dict[int, tuple[_Rows, np.ndarray]]) -> tuple[_Rows, np.ndarray, np.ndarray]:
        """Return (edges of all meshes, vertices counted through; bodies of both faces, (E, 2); first vertices of
        meshes).
        """
        parts = [found[body.shape.ptr][0] for body in self._meshes]
        self.spokes = None
        if parts:
            faces = [found[body.shape.ptr][1] for body in self._meshes]
            listed = [body.instance is None for body in self._meshes]
            self.spokes = Spokes([b.shape for b in self._meshes], faces, [part.joined for part in parts], listed)
        starts = np.cumsum([0, *(body.shape.vertex_count() for body in self._meshes)])[:-1]
        owner = np.repeat(np.arange(len(parts)), [len(part.flags) for part in parts])
        rows, owners = _stacked(parts, starts), np.stack([owner, owner], 1)
        if len(parts) > 1:
            rows, owners = _joined_rims(rows, owners, host_numbers(self.points()).T)
        return rows, owners, starts

    def points(self) -> Any:
        """Return the vertices of all meshes (Point3f), one after the other, detached."""
        with dr.suspend_grad():
            return _concatenated([b.vertices(dr.arange(mi.UInt32, b.shape.vertex_count())) for b in self._meshes])

    def ends(self) -> list[Any]:
        """Return the ends of all rows, two Point3f, attached where they are.

        Starts and stops of all edges; behind them origins and second axes, first and third axes of the limbs. By a
        single gather from the scene's parameters: Dr.Jit's ``isolate_grad`` loses what arrives at gathers of gathers
        that were made before.
        """
        edges = [[body.vertices(i) for body, i in zip(self._meshes, each, strict=True)] for each in self.corners.ends]
        frames = [frame for body in self._others for frame in body.frames()]
        o, x, y, z = ([frame[k] for frame in frames] for k in range(4))
        return [_concatenated([*part, *first, *then]) for part, first, then in zip(edges, (o, x), (y, z), strict=True)]

    def moves(self, moving: frozenset[Any]) -> Any:
        """Return ones for the rows of bodies that move (Float), None where none does.

        Args:
            moving: addresses of the shapes that move.
        """
        moves = [self.bodies[k].moves(moving) for k, _ in self._runs]
        if not any(moves):
            return None
        return dr.concat([dr.full(mi.Float, float(m), n) for m, (_, n) in zip(moves, self._runs, strict=True)])


def topology_of(scene: Any, memory: Cache, hides: Callable[[Any], bool] | None = None) -> Topology:
    """Return the :class:`Topology` of a scene as it is now, cached.

    Args:
        scene: Mitsuba scene.
        memory: cache of the scene.
        hides: function of a shape that says whether it hides light, None for all.
    """
    meshes = [shape for shape in shapes_of_scene(scene) if shape.is_mesh()]
    sizes = np.array([(mesh.vertex_count(), mesh.face_count()) for mesh in meshes], np.int64).tobytes()
    found = memory.get("edges", sizes, lambda: Topology(scene, hides))
    if (areas := found.areas()) == found.areas_at_first:
        return found
    return memory.get("edges", sizes + areas, lambda: Topology(scene, hides))


def bodies_of(scene: Any) -> list[Body]:
    """Return the bodies of a scene that have edges or limbs, ordered by name.

    Mitsuba orders what it merges by addresses, and kernels would differ from process to process.

    Args:
        scene: Mitsuba scene.
    """
    bodies = []
    for shape in sorted(scene.shapes(), key=lambda shape: str(shape.id())):
        if is_instance(shape):
            bodies += [Body(member, shape, k) for k, member in enumerate(members_of(scene, shape))]
        else:
            bodies.append(Body(shape))
    return [body for body in bodies if not lacks_edges(body.shape)]


def _concatenated(parts: list[Any]) -> Any:
    return mi.Point3f(*[dr.concat([mi.Float(part[k]) for part in parts]) for k in range(3)])


def _stacked(parts: list[_Rows], starts: np.ndarray) -> _Rows:
    """Return the rows of all meshes, vertices counted through."""
    if not parts:
        none = np.zeros((0, 2), int)
        return _Rows(none, none, none, none, np.zeros((0, 4), int), np.zeros(0, int), none)
    shifted = [
        part._replace(ends=part.ends + n, third=part.third + n, other=part.other + n)
        for part, n in zip(parts, starts, strict=True)
    ]
    return _Rows(*(np.concatenate(columns) for columns in zip(*shifted, strict=True)))


def _joined_rims(rows: _Rows, owners: np.ndarray, positions: np.ndarray) -> tuple[_Rows, np.ndarray]:
    """Return the rows with rims of two bodies at the same place joined in pairs; more than two stay as they are."""
    rims = np.flatnonzero(rows.flags & TWO == 0)
    if not len(rims):
        return rows, owners
    ends = rows.ends[rims]
    lengths = np.abs(positions[ends[:, 0]] - positions[ends[:, 1]]).max(1)
    place = near_places(positions[ends].reshape(-1, 3), np.repeat(lengths, 2)).reshape(-1, 2)
    rims, place = (each[place[:, 0] != place[:, 1]] for each in (rims, place))
    low = np.sort(place, axis=1)
    _, group, count = np.unique(low, axis=0, return_inverse=True, return_counts=True)
    group = group.ravel()
    order = np.argsort(group, kind="stable")
    order = order[count[group[order]] == 2].reshape(-1, 2)
    order = order[owners[rims[order[:, 0]], 0] != owners[rims[order[:, 1]], 0]]
    new = _Rows(*(each.copy() for each in rows))
    owners = owners.copy()
    for own, other in (order.T, order.T[::-1]):
        a, b = rims[own], rims[other]
        same = (place[own] == place[other])[:, :1]
        turned = lambda x, same=same: np.where(same, x, x[:, ::-1])  # noqa: E731
        new.other[a] = turned(rows.ends[b])
        new.place[a, 2:] = turned(rows.place[b, :2])
        new.third[a, 1], new.faces[a, 1], owners[a, 1] = rows.third[b, 0], rows.faces[b, 0], owners[b, 0]
        new.flags[a] = TWO + TWIN + SEAM
    return new, owners


class Spokes:
    """Edges by the corners of faces: candidates for viewers on a mesh, next to which draws by length hardly find edges.

    Args:
        shapes: meshes.
        faces: joined places of the corners of all faces of each shape, (F, 3).
        ends: joined places of the ends of all edges of each shape, (E, 2), in the order of the table's rows.
        listed: points of a shape are asked for, by shape: members of instances are not.
    """

    def __init__(self, shapes: list[Any], faces: list[np.ndarray], ends: list[np.ndarray], listed: list[bool]) -> None:
        places = np.cumsum([0, *(int(each.max(initial=-1)) + 1 for each in faces)])
        first = np.cumsum([0, *(len(each) for each in faces)])[:-1]
        corner = np.concatenate([each + start for each, start in zip(faces, places, strict=False)])
        end = np.concatenate([each + start for each, start in zip(ends, places, strict=False)])
        kept = [(shape, 1 + start) for shape, start, some in zip(shapes, first, listed, strict=True) if some]
        self._faces = PointerTable([shape for shape, _ in kept], [int(start) for _, start in kept])
        self._corners, self._ends = whole_numbers(corner.ravel()), whole_numbers(end.ravel())
        self._rows = whole_numbers(np.argsort(end.ravel(), kind="stable") // 2)
        self._starts = whole_numbers(np.cumsum([0, *np.bincount(end.ravel(), minlength=places[-1])]))
        dr.make_opaque(self._corners, self._ends, self._rows, self._starts)

    def around(self, pi: Any, V: Any, active: Any) -> Local:
        """Return the corners of the faces that viewers lie on: ``active``, ``places``, and ``V``.

        Args:
            pi: PreliminaryIntersection3f of the viewers.
            V: viewers, Point3f.
        """
        face = self._faces.look_up(pi.shape, active & pi.is_valid())
        active = active & (face > 0) & (dr.reinterpret_array(mi.UInt32, pi.instance) == 0)
        first = (face - 1 + pi.prim_index) * 3
        places = [dr.gather(mi.UInt32, self._corners, first + i, active) for i in range(3)]
        return Local(active=active, places=places, V=mi.Point3f(V))

    def draw(self, around: Local, x: Any) -> tuple[Any, Any]:
        """Return (row of an edge, mask of edges that run from their corner on) for a uniform number ``x``."""
        x = x * 3
        corner = dr.minimum(mi.UInt32(x), 2)
        place = dr.select(corner == 0, around.places[0], dr.select(corner == 1, around.places[1], around.places[2]))
        start, degree = self._span(place, around.active)
        row = start + dr.minimum(mi.UInt32((x - mi.Float(corner)) * degree), mi.UInt32(degree) - 1)
        row = dr.gather(mi.UInt32, self._rows, row, around.active)
        return row, dr.gather(mi.UInt32, self._ends, 2 * row, around.active) == place

    def place(self, around: Local, k: Local, forward: Any, u: Any) -> Any:
        """Return the place in [0, 1] along edges ``k``, with a density near ``1 / squared distance from V``.

        Args:
            around: corners by :meth:`around`.
            k: rows of the table.
            forward: mask of edges that run from their corner on.
            u: uniform number.
        """
        L, corner = dr.norm(k.b - k.a), dr.select(forward, k.a, k.b)
        ρ = dr.norm(corner - around.V)
        along = ρ * u / dr.maximum(ρ + L * (1 - u), 1e-20)
        return dr.select(forward, along, 1 - along)

    def density(self, around: Local, k: Local) -> Any:
        """Return the density by length of the points of edges ``k`` that :meth:`draw` and :meth:`place` have."""
        L, total = dr.norm(k.b - k.a), mi.Float(0)
        for i, (corner, along) in enumerate(((k.a, k.u), (k.b, 1 - k.u))):
            place = dr.gather(mi.UInt32, self._ends, 2 * k.e + i, around.active & (2 * k.e + i < dr.width(self._ends)))
            _, degree = self._span(place, around.active)
            ρ = dr.norm(corner - around.V)
            by_length = ρ * (ρ + L) / (L * dr.square(ρ + along * L))
            share = sum(dr.select(place == other, 1.0, 0.0) for other in around.places) / (3 * degree)
            total += dr.select(dr.isfinite(by_length), by_length * share, 0)
        return dr.select(around.active & (2 * k.e < dr.width(self._ends)), total, 0)

    def _span(self, place: Any, active: Any) -> tuple[Any, Any]:
        start, stop = (dr.gather(mi.UInt32, self._starts, place + i, active) for i in (0, 1))
        return start, mi.Float(dr.maximum(stop - start, 1))
