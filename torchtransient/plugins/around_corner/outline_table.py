"""Edges of meshes that can be outlines seen from points of a wall, where one thing begins to hide another.

An edge of one face is an outline from everywhere; one of two faces is one from where both are seen on the same side of
it, which a flat crease never is. Laid out with numpy, outside of kernels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.plugins.edges.joined import FLAT, Triangles, edge_keys
from torchtransient.plugins.mitsuba_compat import mesh_positions
from torchtransient.plugins.mitsuba_shapes import bounds_of

# Edges that are weighed at a time.
BLOCK = 2048
# Share of the samples that goes by length alone: outlines that the reference points do not see are found all the same.
DEFENSIVE = 0.1


@dataclass
class Edges:
    """Edges of some faces.

    Attributes:
        ends: numbers of vertices, (E, 2).
        sides: third corners of the two outermost faces, twice the same for a single face, (E, 2).
        mesh: number of the mesh of the ends, (E,).
        share: weight of the edge, (E,): one where several meshes meet is listed for each, with weights that sum to one.
        closed: no edge has a single face.
    """

    ends: np.ndarray
    sides: np.ndarray
    mesh: np.ndarray
    share: np.ndarray
    closed: bool

    @staticmethod
    def from_faces(triangles: Triangles, faces: np.ndarray) -> Edges:
        """Return the edges that can be outlines of some faces, given by their numbers (F,)."""
        corners = triangles.faces[faces]
        key, proper = edge_keys(triangles.joined[faces])
        mesh = np.repeat(triangles.mesh[faces], 3)
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
        h = [_across(triangles.vertices, ends[first[two]], sides[two, i]) for i in range(2)]
        chosen[two] = (h[0] * h[1]).sum(1) > -1 + FLAT
        for e in np.flatnonzero(count > 2):
            pair = _outermost(triangles.vertices, ends[first[e]], third[first[e] : first[e] + count[e]])
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
    """Return unit vectors (E, 3) in faces, across their edges and away from them."""
    t = v[ends[:, 1]] - v[ends[:, 0]]
    h = v[sides] - v[ends[:, 0]]
    h = h - t * ((h * t).sum(1) / (t * t).sum(1))[:, None]
    return h / np.linalg.norm(h, axis=1, keepdims=True)


def _outermost(v: np.ndarray, ends: np.ndarray, around: np.ndarray) -> np.ndarray | None:
    """Return the third corners of the two faces at an edge that bound the widest gap.

    None for a gap of at most half a turn: no plane through the edge leaves all faces on one side then.
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


class OutlineTable:
    """Edges with a density along them, and their ends, attached to the meshes.

    Args:
        triangles: triangles of the meshes.
        edges: edges of some parts.
        viewpoints, normals: points of the wall that see the edges, and their normals, (P, 3).

    The probability of an edge is the root mean square over the viewpoints of the length that it spans there over the
    square of the distance, times the cosine at the viewpoint, zero from where it is no outline; mixed with plain
    length.
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
        """Return the number of an edge, and its share over its probability; ``x``: Float64 in [0, 1)."""
        index, p = self._distribution.sample_pmf(dr.minimum(mi.Float(x), dr.one_minus_epsilon(mi.Float)))
        return index, dr.gather(mi.Float, self._share, index) / p

    def end_points(self, index: Any) -> list[Any]:
        """Return the ends (Point3f) of edges, attached where gradients are not suspended."""
        return [dr.gather(mi.Point3f, end, index) for end in self.ends]

    def third_corners(self, index: Any) -> list[Any]:
        """Return the corners (Point3f) of the outermost faces at edges."""
        return [dr.gather(mi.Point3f, side, index) for side in self._sides]


def _attached(triangles: Triangles, mesh: np.ndarray, vertices: np.ndarray) -> Any:
    """Return vertices as one Point3f, by numbers in the order of their meshes."""
    points = []
    for number in np.unique(mesh):
        rows = (vertices[mesh == number] - triangles.first[number]).astype(np.uint32)
        points.append(dr.gather(mi.Point3f, mesh_positions(triangles.meshes[number]), mi.UInt32(rows)))
    return mi.Point3f(*[dr.concat([point[axis] for point in points]) for axis in range(3)])


def _weights(p: np.ndarray, viewpoints: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return weights (E,) of edges; ``p``: their ends and sides, (E, 4, 3)."""
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


# ----------------------------------------------------------------------------------------------------------------------
# Pairs of parts of a scene of which one may hide the other from a wall: a cheap, conservative test.

# Largest number of parts of a scene that are tested; with more, every part may hide every other.
MOST_PARTS = 64
# Corners of a part that are looked at one by one; larger ones are stood for by a box.
MOST_CORNERS = 64
# Products of faces and vertices that a part's convexity is worth.
MOST_PRODUCTS = 1 << 24
# Rounding of positions, in parts of the size of what is compared.
ROUNDING = 1e-5
# Viewpoints that are requested first.
FEW = 16
# Steps in which a plane between two cones has to be found.
STEPS = 64


@dataclass
class Part:
    """Connected piece of meshes, or a whole shape without triangles.

    Attributes:
        shapes: numbers in the list of shapes.
        corners: points whose convex hull holds the part, (K, 3).
        planes: normals of planes that may separate it from others, (M, 3).
        hides_itself: the part is not known to be flat, or convex and closed.
        edges: edges of the faces, None without triangles.
    """

    shapes: frozenset[int]
    corners: np.ndarray
    planes: np.ndarray
    hides_itself: bool
    edges: Edges | None


def parts_of(shapes: list[Any]) -> tuple[list[Part], Triangles]:
    """Return the parts of all shapes, and the triangles of the meshes.

    With more than ``MOST_PARTS`` pieces each mesh is one part.

    Args:
        shapes: shapes of the scene.
    """
    numbers = [k for k, shape in enumerate(shapes) if shape.is_mesh()]
    triangles = Triangles.from_meshes([shapes[k] for k in numbers])
    label = triangles.parts()
    if label.max(initial=-1) >= MOST_PARTS:
        label = triangles.mesh
    order = np.argsort(label, kind="stable")
    pieces = np.split(order, np.flatnonzero(np.diff(label[order])) + 1) if len(order) else []
    found = [_part_of_faces(frozenset(numbers[k] for k in np.unique(triangles.mesh[f])), triangles, f) for f in pieces]
    found += [_part_of_bounds(k, shape) for k, shape in enumerate(shapes) if not shape.is_mesh()]
    return found, triangles


def _part_of_bounds(number: int, shape: Any) -> Part:
    bounds = bounds_of(shape)
    corners = _box(*(np.array(corner, dtype=np.float64).ravel() for corner in (bounds.min, bounds.max)))
    # A tube shows its inside; spheres and disks cannot hide themselves.
    hides_itself = shape.class_name() not in ("Sphere", "Disk")
    return Part(frozenset([number]), corners, np.eye(3), hides_itself, None)


def _box(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the corners (8, 3) of a box."""
    return np.array([[(low, high)[i >> axis & 1][axis] for axis in range(3)] for i in range(8)])


def _part_of_faces(shapes: frozenset[int], triangles: Triangles, faces: np.ndarray) -> Part:
    edges = Edges.from_faces(triangles, faces)
    v = triangles.vertices[np.unique(triangles.faces[faces])]
    middle = v.mean(0)
    _, axes = np.linalg.eigh((v - middle).T @ (v - middle))
    local = (v - middle) @ axes
    size = np.ptp(local, axis=0)
    flat = bool(size.min() < ROUNDING * size.max())
    hides_itself = not flat and not (edges.closed and _is_convex(triangles, faces, v, ROUNDING * size.max()))
    if len(v) > MOST_CORNERS:
        v = _box(local.min(0), local.max(0)) @ axes.T + middle
    return Part(shapes, v, axes.T, hides_itself, edges)


def _is_convex(triangles: Triangles, faces: np.ndarray, v: np.ndarray, tolerance: float) -> bool:
    if len(faces) * len(v) > MOST_PRODUCTS:
        return False
    a, b, c = (triangles.vertices[triangles.faces[faces, i]] for i in range(3))
    n = np.cross(b - a, c - a)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    heights = n @ v.T - (n * a).sum(1)[:, None]
    # Either way round: all on one side of every face.
    return bool(np.all((heights.max(1) < tolerance) | (heights.min(1) > -tolerance)))


def hiding_pairs(parts: list[Part], viewpoints: np.ndarray, is_requested: Any) -> list[tuple[int, int]]:
    """Find pairs of parts of which one may hide the other, or points of its own, from a viewpoint.

    Args:
        parts: parts of the scene, see :func:`parts_of`.
        viewpoints: points of the wall, (P, 3), metres.
        is_requested: predicate of (hider, hidden) for the pairs that count.

    Returns:
        Pairs (hider, hidden) by number. Conservative: pairs left out cannot occur. Of more than ``MOST_PARTS`` parts
        each may hide every other.
    """
    pairs = []
    some = np.unique(np.linspace(0, len(viewpoints) - 1, min(len(viewpoints), FEW)).astype(int))
    for i, hider in enumerate(parts):
        requested = [j for j in range(len(parts)) if is_requested(i, j)]
        found = [i] if i in requested and hider.hides_itself else None
        requested = [j for j in requested if j != i]
        if found is None and len(parts) > MOST_PARTS:
            found = requested[:1]
        if found is None:
            requested = [j for j in requested if not _is_beyond(hider, parts[j], viewpoints)]
            hidden = (
                j
                for q in (viewpoints[some], viewpoints)
                for j in requested
                if not _cones_apart(hider.corners, parts[j].corners, q).all()
            )
            found = [j for j in (next(hidden, None),) if j is not None]
        pairs += [(i, j) for j in found]
    return pairs


def _is_beyond(hider: Part, hidden: Part, viewpoints: np.ndarray) -> bool:
    """Return whether one of the planes tried separates the hider from the hidden points and the viewpoints."""
    everything = np.concatenate([hider.corners, hidden.corners, viewpoints])
    rounding = ROUNDING * np.ptp(everything, axis=0).max()
    before = np.concatenate([hidden.corners, viewpoints])
    sides = np.concatenate([hider.planes, hidden.planes])
    sides = np.concatenate([sides, -sides])
    return bool(np.any((hider.corners @ sides.T).min(0) >= (before @ sides.T).max(0) - rounding))


def _cones_apart(a: np.ndarray, b: np.ndarray, viewpoints: np.ndarray) -> np.ndarray:
    """Return a mask (P,) of viewpoints through which a plane is found that separates the points ``a`` and ``b``.

    The perceptron: a plane that has a point on its wrong side is turned towards it.
    """
    apart = np.zeros(len(viewpoints), dtype=bool)
    for first in range(0, len(viewpoints), 4096):
        q = viewpoints[first : first + 4096]
        u = np.concatenate([a[None] - q[:, None], q[:, None] - b[None]], 1)
        u /= np.maximum(np.linalg.norm(u, axis=2, keepdims=True), 1e-30)
        n = u.mean(1)
        for _ in range(STEPS):
            height = np.einsum("pki,pi->pk", u, n)
            worst = height.argmin(1)
            wrong = height[np.arange(len(q)), worst] <= 0
            if not wrong.any():
                break
            n = n + np.where(wrong[:, None], u[np.arange(len(q)), worst], 0)
        apart[first : first + 4096] = (np.einsum("pki,pi->pk", u, n) > 0).all(1)
    return apart
