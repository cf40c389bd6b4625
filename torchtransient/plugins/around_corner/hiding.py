"""Which parts of a scene may hide which, seen from points of a wall: a cheap test that never misses one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from torchtransient.plugins.around_corner.outline_table import Edges
from torchtransient.plugins.edges.joined import Triangles
from torchtransient.plugins.mitsuba_compat import bounds_of

# Parts of a scene that are told apart; of more, everything may hide everything.
MOST_PARTS = 64
# Corners of a part that are looked at one by one; larger ones are stood for by a box.
MOST_CORNERS = 64
# Products of faces and vertices that a part's convexity is worth.
MOST_PRODUCTS = 1 << 24
# Rounding of positions, in parts of the size of what is compared.
ROUNDING = 1e-5
# Viewpoints that are asked first.
FEW = 16
# Steps in which a plane between two cones has to be found.
STEPS = 64


@dataclass
class Part:
    """A connected piece of meshes, or a whole shape without triangles (``edges`` None).

    ``shapes``: numbers in the list of shapes; ``corners`` (K, 3): points whose convex hull holds it; ``planes`` (M, 3):
    normals of planes that may part it from others; ``hides_itself``: it is not known to be flat, or convex and closed.
    """

    shapes: frozenset[int]
    corners: np.ndarray
    planes: np.ndarray
    hides_itself: bool
    edges: Edges | None


def parts_of(shapes: list[Any]) -> tuple[list[Part], Triangles]:
    """The parts of all shapes, and the triangles of the meshes. Of very many pieces those of a mesh count as one."""
    numbers = [k for k, shape in enumerate(shapes) if shape.is_mesh()]
    triangles = Triangles.of([shapes[k] for k in numbers])
    label = triangles.parts()
    if label.max(initial=-1) >= MOST_PARTS:
        label = triangles.mesh
    order = np.argsort(label, kind="stable")
    pieces = np.split(order, np.flatnonzero(np.diff(label[order])) + 1) if len(order) else []
    found = [_of_faces(frozenset(numbers[k] for k in np.unique(triangles.mesh[f])), triangles, f) for f in pieces]
    found += [_of_bounds(k, shape) for k, shape in enumerate(shapes) if not shape.is_mesh()]
    return found, triangles


def _of_bounds(number: int, shape: Any) -> Part:
    bounds = bounds_of(shape)
    corners = _box(*(np.array(corner, dtype=np.float64).ravel() for corner in (bounds.min, bounds.max)))
    # A tube shows its inside; spheres and disks cannot hide themselves.
    hides_itself = shape.class_name() not in ("Sphere", "Disk")
    return Part(frozenset([number]), corners, np.eye(3), hides_itself, None)


def _box(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The corners ``(8, 3)`` of a box."""
    return np.array([[(low, high)[i >> axis & 1][axis] for axis in range(3)] for i in range(8)])


def _of_faces(shapes: frozenset[int], triangles: Triangles, faces: np.ndarray) -> Part:
    edges = Edges.of(triangles, faces)
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


def hiding_pairs(parts: list[Part], viewpoints: np.ndarray, of_interest: Any) -> list[tuple[int, int]]:
    """(hider, hidden) by number: a pair for each part that may hide another, or points of its own, from some of the
    ``viewpoints`` (P, 3).

    ``of_interest(i, j)``: which pairs are asked for. Conservative: what is left out cannot happen. Of more than
    ``MOST_PARTS`` each one may hide another.
    """
    pairs = []
    some = np.unique(np.linspace(0, len(viewpoints) - 1, min(len(viewpoints), FEW)).astype(int))
    for i, hider in enumerate(parts):
        asked = [j for j in range(len(parts)) if of_interest(i, j)]
        found = [i] if i in asked and hider.hides_itself else None
        asked = [j for j in asked if j != i]
        if found is None and len(parts) > MOST_PARTS:
            found = asked[:1]
        if found is None:
            asked = [j for j in asked if not _is_beyond(hider, parts[j], viewpoints)]
            hidden = (
                j
                for q in (viewpoints[some], viewpoints)
                for j in asked
                if not _cones_apart(hider.corners, parts[j].corners, q).all()
            )
            found = [j for j in (next(hidden, None),) if j is not None]
        pairs += [(i, j) for j in found]
    return pairs


def _is_beyond(hider: Part, hidden: Part, viewpoints: np.ndarray) -> bool:
    """Whether a plane is found beyond which the hider lies altogether, with all else before it."""
    everything = np.concatenate([hider.corners, hidden.corners, viewpoints])
    rounding = ROUNDING * np.ptp(everything, axis=0).max()
    before = np.concatenate([hidden.corners, viewpoints])
    sides = np.concatenate([hider.planes, hidden.planes])
    sides = np.concatenate([sides, -sides])
    return bool(np.any((hider.corners @ sides.T).min(0) >= (before @ sides.T).max(0) - rounding))


def _cones_apart(a: np.ndarray, b: np.ndarray, viewpoints: np.ndarray) -> np.ndarray:
    """From which viewpoints ``(P,)`` a plane through them is found that parts the points ``a`` and ``b``.

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
