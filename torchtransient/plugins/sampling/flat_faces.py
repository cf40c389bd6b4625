"""Flat faces of meshes as kernels look them up: parallelograms and triangles, and those that shine."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.plugins.kernel_arrays import PointerTable, floats, registry_number
from torchtransient.plugins.mitsuba_compat import lacks_directions
from torchtransient.plugins.mitsuba_shapes import has_smooth_shape
from torchtransient.plugins.sampling.area_elements import AreaElements
from torchtransient.plugins.sampling.hidden_elements import packed

# Faces of a table that kernels look through one by one.
MOST_FACES = 64
# Numbers of a face in its table.
_ROW = 16
# Relative difference of corners that are the same.
_SAME = 1e-5
# Relative margin around the part of a face at given distances.
_MARGIN = 1e-5


class Face:
    """Face of each lane. A plain object that lives within one iteration.

    Attributes:
        o, e1, e2: corner, Point3f, and edges, Vector3f.
        most: largest sum of the coordinates along the edges: 1 of a triangle, 2 of a parallelogram.
    """

    def __init__(self, **values):
        vars(self).update(values)


class FlatFaces:
    """Faces of the meshes of a scene, in a table of at most 64 that kernels look through.

    Meshes are listed as a whole, those with the largest faces first.

    Args:
        shapes: shapes of the scene.

    Attributes:
        count: number of faces.
    """

    def __init__(self, shapes):
        meshes = []
        for shape in shapes:
            if _is_small(shape):
                elements = AreaElements.from_shapes([shape])
                faces = faces_of(elements)
                meshes.append((elements.area.sum() / max(len(faces), 1), shape, faces))
        listed, rows = [], []
        for _, shape, faces in sorted(meshes, key=lambda mesh: -mesh[0]):
            if faces and len(rows) + len(faces) <= MOST_FACES:
                listed.append(shape)
                rows += [_row(*face, registry_number(shape), i) for face, i in faces]
        self.count = len(rows)
        self._shapes = PointerTable.marking(listed)
        if rows:
            self._table = packed(np.array(rows))

    def lists(self, shape):
        """Return a mask of pointers to shapes in the table."""
        return self._shapes.lists(shape)

    def face(self, i):
        """Return face number ``i``: ``o``, ``most``, the normal ``n`` and the dual edges ``U``, ``V``.

        The coordinates of a point p along the edges are ``U.(p - o)`` and ``V.(p - o)``.
        """
        o, n, U, V = (dr.gather(mi.Vector4f, self._table, i * 4 + k) for k in range(4))
        return Face(
            o=mi.Point3f(o.x, o.y, o.z), most=o.w, n=mi.Normal3f(n.x, n.y, n.z), U=mi.Vector3f(U.x, U.y, U.z),
            V=mi.Vector3f(V.x, V.y, V.z),
        )  # fmt: skip

    def is_on(self, i, pi, active):
        """Return a mask of intersections with face number ``i``, and not with another one close to it."""
        most, shape, first = (dr.gather(mi.Float, self._table, i * _ROW + k, active) for k in (3, 7, 11))
        triangle = mi.Float(pi.prim_index) - first
        return (pi.shape == dr.reinterpret_array(mi.ShapePtr, mi.UInt32(shape))) & (triangle >= 0) & (triangle < most)


def _is_small(shape):
    """Return True for meshes that may fit into the table, where pairs of triangles are one face."""
    return shape.is_mesh() and shape.face_count() <= 2 * MOST_FACES


def faces_of(elements):
    """Return ((corner, edge, edge, ``most``), number of an element) of the faces of a mesh.

    Two triangles in a row that make up a parallelogram are one face.

    Args:
        elements: :class:`.area_elements.AreaElements` of one mesh.
    """
    o, e1, e2 = (elements.axes[:, k] for k in range(3))
    corners = np.stack([o, o + e1, o + e2], 1)
    faces, i = [], 0
    while i < len(elements):
        whole = _parallelogram(corners[i], corners[i + 1]) if i + 1 < len(elements) else None
        if elements.area[i] > 0:
            faces.append(((o[i], e1[i], e2[i], 1.0) if whole is None else (*whole, 2.0), i))
        i += 1 if whole is None else 2
    return faces


def _parallelogram(one, other):
    """Return (corner, edge, edge) of the parallelogram of two triangles (3, 3), None if they are none."""
    size = np.abs(one - one[0]).max()
    shared = [(i, k) for i in range(3) for k in range(3) if np.abs(one[i] - other[k]).max() <= _SAME * size]
    if len(shared) != 2:
        return None
    apex, far = one[3 - shared[0][0] - shared[1][0]], other[3 - shared[0][1] - shared[1][1]]
    a, b = (one[i] - apex for i, _ in shared)
    return (apex, a, b) if np.abs(apex + a + b - far).max() <= _SAME * size else None


def _row(o, e1, e2, most, shape, first):
    """Return the numbers of a face; those of plugins and triangles are small enough for single precision.

    Args:
        most: largest sum of the coordinates, which is the number of triangles.
        shape: number of the shape in Mitsuba's registry.
        first: index of the first triangle.
    """
    n = np.cross(e1, e2)
    n = n / np.linalg.norm(n)
    U, V = np.cross(e2, n), np.cross(n, e1)
    return [*o, most, *n, shape, *(U / (U @ e1)), first, *(V / (V @ e2)), 0.0]


# --------------------------------------------------------------------------------------------------------------------
# Lights.

class LightPoint:
    """Point of a light. A plain object that lives within one iteration.

    Attributes:
        p, n: Point3f, and the normal of the side that shines.
        emitter: EmitterPtr.
        pdf: density per area, 0 for none.
    """

    def __init__(self, p, n, emitter, pdf):
        self.p, self.n, self.emitter, self.pdf = mi.Point3f(p), mi.Normal3f(n), emitter, pdf


class LightFaces:
    """Faces of the area lights that shine alike everywhere, on meshes of at most 128 triangles.

    A light is chosen as scenes choose theirs (``sampling_weight``), a face of it by its area.

    Args:
        scene: Mitsuba scene.
        emits_by_place: function of an emitter that returns True if its light differs from place to place.

    Attributes:
        count: number of faces.
        holds_all: the scene has no other lights.
        share: probability that a scene chooses one of these lights.
        area: area of each face, square metres.
    """

    def __init__(self, scene, emits_by_place):
        emitters = scene.emitters()
        lit = [emitter for emitter in emitters if _is_flat_light(emitter) and not emits_by_place(emitter)]
        total = sum(emitter.sampling_weight() for emitter in emitters)
        rows, chances = [], []
        for emitter in lit:
            elements = AreaElements.from_shapes([emitter.get_shape()])
            faces = faces_of(elements)
            areas = np.array([np.linalg.norm(np.cross(e1, e2)) * most / 2 for (_, e1, e2, most), _ in faces])
            for ((o, e1, e2, most), i), area in zip(faces, areas, strict=True):
                chance = emitter.sampling_weight() / total * area / areas.sum()
                # Numbers of plugins are small enough for single precision.
                rows.append([*o, chance / area, *e1, most, *e2, chance, *elements.normal[i], registry_number(emitter)])
                chances.append(chance)
        # Arrays: as literals they would be part of kernels.
        self.area = floats(np.array([sum(chance / row[3] for chance, row in zip(chances, rows, strict=True))]))
        self.share = floats(np.array([sum(chances)]))
        self.count, self.holds_all = len(rows), len(lit) == len(emitters)
        self._emitters = PointerTable.marking(lit)
        if self.count:
            self._table = packed(np.array(rows))
            # Begin of each face's part of [0, 1], and the end of the last one.
            self._begins = packed(np.cumsum([0.0, *chances]) / sum(chances))

    def lists(self, emitter):
        """Return a mask of pointers to the lights of these faces."""
        return mi.Mask(True) if self.holds_all else self._emitters.lists(emitter)

    def sample_between(self, x, first, last, u, active):
        """Draw a :class:`LightPoint` at distances of ``first`` to ``last`` from ``x``.

        In the plane of a face these are the points between two circles around the foot of x. What of the box of the
        face, in the square of the radius and the angle, lies between them is drawn from evenly, or the face itself
        where that is smaller. The density is 0 where the box misses the face, and includes the choice of the light.

        Args:
            x: Point3f.
            first, last: distances, Float; below zero for none.
            u: two uniform numbers, Point2f.
        """
        face, v = self._face(u.x, active)
        h = dr.dot(face.n, x - face.o)
        foot = x - face.n * h
        far = dr.select(face.most > 1.5, face.e1 + face.e2, face.e1)
        # In order around a parallelogram; one edge of a triangle has no length.
        ring = [dr.detach(face.o + edge - foot) for edge in (mi.Vector3f(0), face.e1, far, face.e2)]
        forward = dr.normalize(0.25 * (ring[0] + ring[1] + ring[2] + ring[3]))
        aside = dr.cross(face.n, forward)
        nearest, farthest = mi.Float(dr.inf), mi.Float(0)
        low, high = mi.Float(dr.inf), mi.Float(-dr.inf)
        left, right = mi.Mask(True), mi.Mask(True)
        for p, q in zip(ring, ring[1:] + ring[:1], strict=True):
            angle = dr.atan2(dr.dot(p, aside), dr.dot(p, forward))
            low, high = dr.minimum(low, angle), dr.maximum(high, angle)
            farthest = dr.maximum(farthest, dr.squared_norm(p))
            edge = q - p
            along = dr.clip(-dr.dot(p, edge) / dr.maximum(dr.squared_norm(edge), dr.smallest(mi.Float)), 0, 1)
            nearest = dr.minimum(nearest, dr.squared_norm(p + edge * along))
            turn = dr.dot(face.n, dr.cross(p, edge))
            left, right = left & (turn >= 0), right & (turn <= 0)
        within = left | right
        # Around a foot within the face any direction is the first.
        forward = dr.select(within, mi.Frame3f(face.n).s, forward)
        aside = dr.cross(face.n, forward)
        low, high = dr.select(within, -dr.pi, low), dr.select(within, dr.pi, high)
        nearest, h2 = dr.select(within, 0, nearest), dr.square(h)
        begin = dr.maximum(nearest * (1 - _MARGIN), dr.square(dr.maximum(first, 0)) - h2)
        end = dr.minimum(farthest * (1 + _MARGIN), dr.square(dr.maximum(last, 0)) - h2)
        sin, cos = dr.sincos(dr.fma(u.y, high - low, low))
        p = foot + (forward * cos + aside * sin) * dr.sqrt(dr.maximum(dr.fma(v, end - begin, begin), 0))
        a, b = _coordinates(p - face.o, face.e1, face.e2)
        met = (end > begin) & (a >= 0) & (b >= 0) & (a <= 1) & (b <= 1) & (a + b <= face.most)
        box = 0.5 * (end - begin) * (high - low)
        whole = box * face.pdf > face.chance
        p = dr.select(whole, _point(face, v, u.y), p)
        pdf = dr.select(whole, face.pdf, dr.select(met, face.chance / box, 0))
        return LightPoint(p, face.n, face.emitter, dr.select(active, pdf, 0))

    def _face(self, u, active):
        """Choose a face by a number; return it and another number that is uniform."""
        i = dr.binary_search(0, self.count - 1, lambda k: dr.gather(mi.Float, self._begins, k + 1, active) <= u)
        begin, end = (dr.gather(mi.Float, self._begins, i + k, active) for k in range(2))
        u = dr.clip((u - begin) / (end - begin), 0, 1 - dr.epsilon(mi.Float))
        o, e1, e2, n = (dr.gather(mi.Vector4f, self._table, i * 4 + k, active) for k in range(4))
        emitter = dr.reinterpret_array(mi.EmitterPtr, mi.UInt32(n.w))
        face = Face(
            o=mi.Point3f(o.x, o.y, o.z), e1=mi.Vector3f(e1.x, e1.y, e1.z), e2=mi.Vector3f(e2.x, e2.y, e2.z),
            n=mi.Normal3f(n.x, n.y, n.z), pdf=o.w, most=e1.w, chance=e2.w, emitter=emitter,
        )  # fmt: skip
        return face, u


def _is_flat_light(emitter):
    shape = emitter.get_shape()
    if shape is None or not _is_small(shape) or lacks_directions(emitter) or has_smooth_shape(emitter):
        return False
    return not mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta) and emitter.sampling_weight() > 0


def _point(face, a, b):
    """Return a point of a face by two uniform numbers; those beyond the diagonal of a triangle are mirrored."""
    over = a + b > face.most
    return face.o + face.e1 * dr.select(over, 1 - a, a) + face.e2 * dr.select(over, 1 - b, b)


def _coordinates(p, e1, e2):
    """Return the coordinates of a vector along two edges."""
    a, b, c = dr.squared_norm(e1), dr.dot(e1, e2), dr.squared_norm(e2)
    u, v, determinant = dr.dot(p, e1), dr.dot(p, e2), a * c - b * b
    return (u * c - v * b) / determinant, (v * a - u * b) / determinant
