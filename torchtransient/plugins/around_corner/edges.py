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

from torchtransient.plugins.host_numbers import host_numbers

# Creases flatter than this are no outline: 1 minus the cosine of 1.4e-3 radians.
FLAT = 1e-6
# Rims that are nearer than this to each other, in parts of the largest coordinate, are one.
APART = 8e-6
# Edges that are weighed at a time.
BLOCK = 2048
# Share of the samples that goes by length alone: outlines that the reference points do not see are found all the same.
DEFENSIVE = 0.1


@dataclass
class Triangles:
    """The triangles of several ``meshes``, their vertices joined by position, of one mesh and of different ones.

    ``vertices`` (V, 3), of all meshes in their order; ``first`` (M,), number of each one's first; ``faces`` (F, 3),
    numbers of vertices; ``joined`` (F, 3), numbers of places; ``mesh`` (F,), number of the mesh. Faces without area are
    left out.
    """

    meshes: list[Any]
    vertices: np.ndarray
    first: np.ndarray
    faces: np.ndarray
    joined: np.ndarray
    mesh: np.ndarray

    @staticmethod
    def of(meshes: list[Any]) -> Triangles:
        """Those of Mitsuba meshes, as they are now."""
        v = [host_numbers(m.vertex_positions_buffer(), np.float32).reshape(-1, 3) for m in meshes]
        f = [np.array(m.faces_buffer(), dtype=np.int64).reshape(-1, 3) for m in meshes]
        first = np.cumsum([0, *(len(one) for one in v)])
        mesh = np.repeat(np.arange(len(f)), [len(one) for one in f])
        positions = np.concatenate([np.zeros((0, 3), np.float32), *v])
        faces = np.concatenate(
            [np.zeros((0, 3), np.int64), *(one + start for one, start in zip(f, first, strict=False))]
        )
        corners = positions.astype(np.float64)[faces]
        some = np.any(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) != 0, axis=1)
        faces, mesh = faces[some], mesh[some]
        joined = _joined(positions, faces)
        return Triangles(meshes, positions.astype(np.float64), first, faces, joined, mesh)

    def parts(self) -> np.ndarray:
        """Number of the connected part that each face belongs to, ``(F,)``."""
        return _merged(self.joined, int(self.joined.max(initial=-1)) + 1)[self.joined[:, 0]]


def _joined(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Places of the corners of faces. What is not the same to the bit is the same place if it lies on rims: pieces that
    were put together by transforms are off by some roundings.
    """
    # Adding zero makes one of the two zeros.
    keys = np.ascontiguousarray(positions + np.float32(0)).view("V12").ravel()
    _, sample, place = np.unique(keys, return_index=True, return_inverse=True)
    place = place.ravel()
    joined = place[faces]
    key, _ = _edge_keys(joined)
    _, back, count = np.unique(key, return_inverse=True, return_counts=True)
    on_rim = np.unique(joined[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)[count[back.ravel()] == 1])
    if not len(on_rim):
        return joined
    p = positions[sample[on_rim]].astype(np.float64)
    cell = p / (APART * max(float(np.abs(p).max()), 1e-30))
    # Two points nearer than half a cell share one in some of the eight shifted grids.
    groups = []
    for shift in range(8):
        of_grid = np.floor(cell + 0.5 * np.array([shift & 1, shift >> 1 & 1, shift >> 2 & 1])).astype(np.int64)
        _, index, inverse = np.unique(of_grid, axis=0, return_index=True, return_inverse=True)
        groups.append(np.stack([np.arange(len(p)), index[inverse.ravel()]], 1))
    label = np.arange(len(sample))
    label[on_rim] = on_rim[_merged(np.concatenate(groups), len(p), numbered=False)]
    return label[joined]


def _merged(groups: np.ndarray, count: int, numbered: bool = True) -> np.ndarray:
    """A label for each of ``count`` things, the same for those that a row of ``groups`` (G, K) names: the least number
    of its like, or ``numbered`` from zero on.
    """
    label = np.arange(count)
    while True:
        new = label.copy()
        np.minimum.at(new, groups.ravel(), np.repeat(label[groups].min(1), groups.shape[1]))
        new = new[new]
        if np.array_equal(new, label):
            return np.unique(label, return_inverse=True)[1].ravel() if numbered else label
        label = new


def _edge_keys(joined: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A number for each edge of each face, the same for the same edge, and whether it is one at all: ``(3 F,)``."""
    low, high = joined.ravel(), joined[:, [1, 2, 0]].ravel()
    return np.minimum(low, high) * (int(joined.max(initial=0)) + 1) + np.maximum(low, high), low != high


@dataclass
class Edges:
    """Edges of some faces, ``E`` of them: ``ends`` (E, 2) and ``sides`` (E, 2), numbers of vertices; ``mesh`` (E,),
    that of the ends. ``sides``: the third corners of the two outermost faces, twice the same where there is one.
    ``share`` (E,): an edge at which several meshes meet is listed for each of them, with shares that sum to one.
    ``closed``: no edge has a single face.
    """

    ends: np.ndarray
    sides: np.ndarray
    mesh: np.ndarray
    share: np.ndarray
    closed: bool

    @staticmethod
    def of(all_of_them: Triangles, faces: np.ndarray) -> Edges:
        """The edges that can be outlines of some faces (F,), given by their numbers."""
        corners = all_of_them.faces[faces]
        key, proper = _edge_keys(all_of_them.joined[faces])
        mesh = np.repeat(all_of_them.mesh[faces], 3)
        order = np.lexsort((mesh, key))
        order = order[proper[order]]
        ends = np.stack([corners.ravel(), corners[:, [1, 2, 0]].ravel()], 1)[order]
        third, mesh, key = corners[:, [2, 0, 1]].ravel()[order], mesh[order], key[order]
        new = np.diff(key, prepend=-1) != 0
        first = np.flatnonzero(new)
        count = np.diff(first, append=len(key))
        sides = np.stack([third[first], third[np.minimum(first + 1, len(third) - 1)]], 1)
        sides[count == 1, 1] = sides[count == 1, 0]
        chosen, two = np.ones(len(first), dtype=bool), count == 2
        h = [_across(all_of_them.vertices, ends[first[two]], sides[two, i]) for i in range(2)]
        chosen[two] = (h[0] * h[1]).sum(1) > -1 + FLAT
        for e in np.flatnonzero(count > 2):
            pair = _outermost(all_of_them.vertices, ends[first[e]], third[first[e] : first[e] + count[e]])
            chosen[e] = pair is not None
            if pair is not None:
                sides[e] = pair
        listed = np.flatnonzero(new | (np.diff(mesh, prepend=-1) != 0))
        group = (np.cumsum(new) - 1)[listed]
        share = 1 / np.bincount(group, minlength=len(first))[group] if len(group) else np.zeros(0)
        some = chosen[group]
        closed = bool(np.all(count > 1))
        return Edges(ends[listed][some], sides[group][some], mesh[listed][some], share[some], closed)


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
    """Some edges of ``triangles`` with a density along them, and their attached ends. ``viewpoints`` and ``normals``
    ``(P, 3)``: points that see them, some of the wall.

    The probability of an edge is the root mean square over the viewpoints of what it spans there over the square of
    the distance, times the cosine at the viewpoint, zero from where it is no outline; mixed with plain length.
    """

    def __init__(self, triangles: Triangles, edges: list[Edges], viewpoints: np.ndarray, normals: np.ndarray) -> None:
        mesh = np.concatenate([part.mesh for part in edges])
        order = np.argsort(mesh, kind="stable")
        mesh, ends, sides, share = (
            mesh[order],
            *(np.concatenate([getattr(part, name) for part in edges])[order] for name in ("ends", "sides", "share")),
        )
        p = triangles.vertices[np.concatenate([ends, sides], 1)]
        length = np.linalg.norm(p[:, 1] - p[:, 0], axis=1)
        plain = length / length.sum()
        weight = _weights(p, viewpoints, normals)
        total = weight.sum()
        probability = (1 - DEFENSIVE) * weight / total + DEFENSIVE * plain if total > 0 else plain
        self._distribution = mi.DiscreteDistribution(mi.Float(probability.astype(np.float32)))
        self._share = mi.Float(share.astype(np.float32))
        self._sides = [mi.Point3f(p[:, i].T.astype(np.float32)) for i in (2, 3)]
        with dr.resume_grad():
            self.ends = [_attached(triangles, mesh, ends[:, i]) for i in range(2)]
        dr.eval(self.ends, self._sides, self._share)

    def sample(self, x: Any) -> tuple[Any, Any]:
        """Number of an edge for a ``Float64`` in [0, 1), and one over its probability, times its share."""
        index, p = self._distribution.sample_pmf(dr.minimum(mi.Float(x), dr.one_minus_epsilon(mi.Float)))
        return index, dr.gather(mi.Float, self._share, index) / p

    def end_points(self, index: Any) -> list[Any]:
        """The ends (Point3f) of edges, attached where gradients are not suspended."""
        return [dr.gather(mi.Point3f, end, index) for end in self.ends]

    def third_corners(self, index: Any) -> list[Any]:
        """Those (Point3f) of the outermost faces at edges."""
        return [dr.gather(mi.Point3f, side, index) for side in self._sides]


def _attached(triangles: Triangles, mesh: np.ndarray, vertices: np.ndarray) -> Any:
    """Vertices, given by their numbers and in the order of their meshes, as one Point3f."""
    points = []
    for number in np.unique(mesh):
        rows = (vertices[mesh == number] - triangles.first[number]).astype(np.uint32)
        points.append(dr.gather(mi.Point3f, triangles.meshes[number].vertex_positions_buffer(), mi.UInt32(rows)))
    return mi.Point3f(*[dr.concat([point[axis] for point in points]) for axis in range(3)])


def _weights(p: np.ndarray, viewpoints: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """``(E,)``, of edges with ends and sides ``p`` (E, 4, 3)."""
    blocks = [_weights_of_some(p[i : i + BLOCK], viewpoints, normals) for i in range(0, len(p), BLOCK)]
    return np.concatenate(blocks)


def _weights_of_some(p: np.ndarray, viewpoints: np.ndarray, normals: np.ndarray) -> np.ndarray:
    # Products of matrices, (E, P), that stay in a processor's cache.
    middle, t = (p[:, 0] + p[:, 1]) / 2, p[:, 1] - p[:, 0]
    q = viewpoints.T
    r2 = np.maximum((middle**2).sum(1)[:, None] - 2 * middle @ q + (q**2).sum(0), 1e-30)
    along = (t * middle).sum(1)[:, None] - t @ q
    spans = np.maximum((t**2).sum(1)[:, None] * r2 - along**2, 0)
    height = np.maximum(middle @ normals.T - (q.T * normals).sum(1), 0)
    # On which sides of the plane through the edge and a viewpoint the faces lie.
    first, second = (
        (np.cross(t, middle) * s).sum(1)[:, None] - np.cross(s, t) @ q for s in (p[:, 2] - middle, p[:, 3] - middle)
    )
    return np.sqrt(np.where(first * second > 0, spans * height**2 / r2**4, 0).sum(1))
