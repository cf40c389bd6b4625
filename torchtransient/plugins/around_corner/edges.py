"""Edges of meshes at which one thing may begin to hide another: where outlines can be, seen from points of a wall.

Triangles are joined by position, so that seams of texture coordinates and of separate files do not count as rims. An
edge of one face is an outline from everywhere; one of two faces is one from where both are seen on the same side of it,
which a flat crease never is. Laid out with numpy, outside of kernels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

# Creases flatter than this are no outline: 1 minus the cosine of 1.4e-3 radians.
FLAT = 1e-6
# Share of the samples that goes by length alone: outlines that the reference points do not see are found all the same.
DEFENSIVE = 0.1


@dataclass
class Triangles:
    """A mesh with its vertices joined by position. ``vertices`` (V, 3), as in the mesh; ``faces`` (F, 3), numbers of
    vertices; ``joined`` (F, 3), numbers of places. Faces without area are left out.
    """

    vertices: np.ndarray
    faces: np.ndarray
    joined: np.ndarray

    @staticmethod
    def of(mesh: Any) -> Triangles:
        """Those of a Mitsuba mesh, as it is now."""
        positions = np.array(dr.detach(mesh.vertex_positions_buffer()), dtype=np.float32).reshape(-1, 3)
        faces = np.array(mesh.faces_buffer(), dtype=np.int64).reshape(-1, 3)
        # Adding zero makes one of the two zeros.
        keys = np.ascontiguousarray(positions + np.float32(0)).view("V12").ravel()
        place = np.unique(keys, return_inverse=True)[1].ravel()
        v = positions.astype(np.float64)
        twice = np.linalg.norm(np.cross(v[faces[:, 1]] - v[faces[:, 0]], v[faces[:, 2]] - v[faces[:, 0]]), axis=1)
        faces = faces[twice > 0]
        return Triangles(v, faces, place[faces])

    def parts(self) -> np.ndarray:
        """Number of the connected part that each face belongs to, ``(F,)``."""
        count = int(self.joined.max(initial=-1)) + 1
        label = np.arange(count)
        while True:
            lowest = label[self.joined].min(1)
            new = label.copy()
            np.minimum.at(new, self.joined.ravel(), np.repeat(lowest, 3))
            new = new[new]
            if np.array_equal(new, label):
                return np.unique(label[self.joined[:, 0]], return_inverse=True)[1].ravel()
            label = new


@dataclass
class Edges:
    """Edges of one mesh, ``E`` of them: ``ends`` (E, 2) and ``sides`` (E, 2), numbers of vertices. ``sides``: the third
    corners of the two outermost faces, twice the same where there is one. ``closed``: no edge has a single face.
    """

    ends: np.ndarray
    sides: np.ndarray
    closed: bool

    @staticmethod
    def of(mesh: Triangles, faces: np.ndarray) -> Edges:
        """The edges that can be outlines of some faces (F,) of a mesh, given by their numbers."""
        corners, places = mesh.faces[faces], mesh.joined[faces]
        a, b, c = ([0, 1, 2], [1, 2, 0], [2, 0, 1])
        low, high = places[:, a].ravel(), places[:, b].ravel()
        key = np.minimum(low, high) * (int(places.max(initial=0)) + 1) + np.maximum(low, high)
        order = np.argsort(key, kind="stable")
        first = np.flatnonzero(np.diff(key[order], prepend=-1))
        count = np.diff(first, append=len(key))
        ends = np.stack([corners[:, a].ravel(), corners[:, b].ravel()], 1)[order]
        third = corners[:, c].ravel()[order]
        sides = np.stack([third[first], third[np.minimum(first + 1, len(third) - 1)]], 1)
        sides[count == 1, 1] = sides[count == 1, 0]
        rows, chosen = ends[first], np.ones(len(first), dtype=bool)
        two = count == 2
        h = [_across(mesh.vertices, rows[two], sides[two, i]) for i in range(2)]
        chosen[two] = (h[0] * h[1]).sum(1) > -1 + FLAT
        for e in np.flatnonzero(count > 2):
            around = third[first[e] : first[e] + count[e]]
            pair = _outermost(mesh.vertices, rows[e], around)
            chosen[e] = pair is not None
            if pair is not None:
                sides[e] = pair
        return Edges(rows[chosen], sides[chosen], bool(np.all(count > 1)))


def _across(v: np.ndarray, ends: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """Unit vectors ``(E, 3)`` in faces, across their edges, away from them."""
    t = v[ends[:, 1]] - v[ends[:, 0]]
    h = v[sides] - v[ends[:, 0]]
    h = h - t * ((h * t).sum(1) / (t * t).sum(1))[:, None]
    return h / np.linalg.norm(h, axis=1, keepdims=True)


def _outermost(v: np.ndarray, ends: np.ndarray, around: np.ndarray) -> np.ndarray | None:
    """Of more than two faces at an edge those on both sides of the widest gap, None where it is no wider than half a
    turn: no plane through the edge leaves all faces on one side then.
    """
    h = _across(v, np.repeat(ends[None], len(around), 0), around)
    t = v[ends[1]] - v[ends[0]]
    y = np.cross(t / np.linalg.norm(t), h[0])
    angle = np.arctan2(h @ y, h @ h[0])
    order = np.argsort(angle)
    gap = np.diff(angle[order], append=angle[order[0]] + 2 * np.pi)
    widest = int(np.argmax(gap))
    if np.cos(gap[widest]) <= -1 + FLAT or gap[widest] < np.pi:
        return None
    return around[order[[widest, (widest + 1) % len(order)]]]


class EdgeTable:
    """Edges of several ``meshes`` (pairs of a Mitsuba mesh and its :class:`Edges`) with a density along them, and their
    attached ends. ``viewpoints`` and ``normals`` ``(P, 3)``: points that see them, some of the wall.

    The probability of an edge is the root mean square over the viewpoints of what it spans there over the square of
    the distance, times the cosine at the viewpoint, zero from where it is no outline; mixed with plain length.
    """

    def __init__(self, meshes: list[tuple[Any, Edges]], viewpoints: np.ndarray, normals: np.ndarray) -> None:
        corners = [np.concatenate([edges.ends, edges.sides], 1) for _, edges in meshes]
        points = []
        for (mesh, _), numbers in zip(meshes, corners, strict=True):
            v = np.array(dr.detach(mesh.vertex_positions_buffer()), dtype=np.float64).reshape(-1, 3)
            points.append(v[numbers])
        p = np.concatenate(points)
        length = np.linalg.norm(p[:, 1] - p[:, 0], axis=1)
        plain = length / length.sum()
        weight = _weights(p, viewpoints, normals)
        total = weight.sum()
        probability = (1 - DEFENSIVE) * weight / total + DEFENSIVE * plain if total > 0 else plain
        self.distribution = mi.DiscreteDistribution(mi.Float(probability.astype(np.float32)))
        with dr.resume_grad():
            self.ends = [_gathered(meshes, [row[:, i] for row in corners]) for i in range(2)]
            with dr.suspend_grad():
                self.sides = [_gathered(meshes, [row[:, i] for row in corners]) for i in (2, 3)]
        dr.eval(self.ends, self.sides)

    def sample(self, x: Any, y: Any) -> tuple[Any, Any, Any, Any]:
        """For two numbers in [0, 1) (``Float64``, ``Float``): number of an edge, the place on it in [0, 1), the density
        per unit of that place, and the third corners of the faces there.
        """
        index, pmf = self.distribution.sample_pmf(dr.minimum(mi.Float(x), dr.one_minus_epsilon(mi.Float)))
        return index, y, pmf, [dr.gather(mi.Point3f, side, index) for side in self.sides]

    def end_points(self, index: Any) -> list[Any]:
        """The ends (Point3f) of edges, attached where gradients are not suspended."""
        return [dr.gather(mi.Point3f, end, index) for end in self.ends]


def _gathered(meshes: list[tuple[Any, Edges]], numbers: list[np.ndarray]) -> Any:
    """Vertices of several meshes as one Point3f."""
    points = [
        dr.gather(mi.Point3f, mesh.vertex_positions_buffer(), mi.UInt32(rows.astype(np.uint32)))
        for (mesh, _), rows in zip(meshes, numbers, strict=True)
    ]
    return mi.Point3f(*[dr.concat([point[axis] for point in points]) for axis in range(3)])


def _weights(p: np.ndarray, viewpoints: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """``(E,)``, of edges with ends and sides ``p`` (E, 4, 3)."""
    middle, t = (p[:, 0] + p[:, 1]) / 2, p[:, 1] - p[:, 0]
    square = np.zeros(len(p))
    for q, n in zip(viewpoints, normals, strict=True):
        d = middle - q
        r2 = np.maximum((d * d).sum(1), 1e-30)
        m = np.cross(t, d)
        outline = np.prod([(m * (p[:, i] - middle)).sum(1) for i in (2, 3)], 0) > 0
        cos = np.maximum(d @ n, 0) / np.sqrt(r2)
        square += np.where(outline, (m * m).sum(1) / r2 * cos**2 / r2**2, 0)
    return np.sqrt(square)
