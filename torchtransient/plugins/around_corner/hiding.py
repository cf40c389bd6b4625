"""Which parts of a scene may hide which, seen from points of a wall: a cheap test that never misses one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from torchtransient.plugins.around_corner.edges import Edges, Triangles
from torchtransient.plugins.mitsuba_compat import bounds_of

# Parts of a scene that are told apart; of more, everything may hide everything.
MOST_PARTS = 64
# Corners of a part that are looked at one by one; larger ones are stood for by a box.
MOST_CORNERS = 64
# Products of faces and vertices that a part's convexity is worth.
MOST_PRODUCTS = 1 << 24
# Rounding of positions, in parts of the size of what is compared.
ROUNDING = 1e-5
# Steps in which a plane between two cones has to be found.
STEPS = 64


@dataclass
class Part:
    """A connected piece of a mesh, or a whole shape without triangles (``edges`` None).

    ``shape``: number in the list of shapes; ``corners`` (K, 3): points whose convex hull holds it; ``planes`` (M, 3):
    normals of planes that may part it from others; ``hides_itself``: it is not known to be flat, or convex and closed.
    """

    shape: int
    corners: np.ndarray
    planes: np.ndarray
    hides_itself: bool
    edges: Edges | None


def parts_of(shapes: list[Any]) -> list[Part]:
    """The parts of all shapes. Meshes of very many pieces count as one."""
    found = []
    for number, shape in enumerate(shapes):
        if not shape.is_mesh():
            found.append(_of_bounds(number, shape))
            continue
        mesh = Triangles.of(shape)
        part = mesh.parts()
        count = int(part.max(initial=-1)) + 1
        if count > MOST_PARTS:
            part, count = np.zeros_like(part), 1
        order = np.split(np.argsort(part, kind="stable"), np.cumsum(np.bincount(part, minlength=count))[:-1])
        found += [_of_faces(number, mesh, faces) for faces in order if len(faces)]
    return found


def _of_bounds(number: int, shape: Any) -> Part:
    bounds = bounds_of(shape)
    low, high = (np.array(corner, dtype=np.float64).ravel() for corner in (bounds.min, bounds.max))
    corners = np.array([[(low, high)[i >> axis & 1][axis] for axis in range(3)] for i in range(8)])
    # A tube shows its inside; spheres and disks cannot hide themselves.
    hides_itself = shape.class_name() not in ("Sphere", "Disk")
    return Part(number, corners, np.eye(3), hides_itself, None)


def _of_faces(number: int, mesh: Triangles, faces: np.ndarray) -> Part:
    edges = Edges.of(mesh, faces)
    v = mesh.vertices[np.unique(mesh.faces[faces])]
    _, axes = np.linalg.eigh(np.cov((v - v.mean(0)).T))
    planes = axes.T
    size = max(float(np.ptp(v, axis=0).max()), 1e-30)
    local = (v - v.mean(0)) @ axes
    flat = float(np.ptp(local, axis=0).min()) < ROUNDING * size
    hides_itself = not flat and not (edges.closed and _is_convex(mesh, faces, v, ROUNDING * size))
    if len(v) > MOST_CORNERS:
        low, high = local.min(0), local.max(0)
        box = np.array([[(low, high)[i >> axis & 1][axis] for axis in range(3)] for i in range(8)])
        v = box @ axes.T + v.mean(0)
    return Part(number, v, planes, hides_itself, edges)


def _is_convex(mesh: Triangles, faces: np.ndarray, v: np.ndarray, tolerance: float) -> bool:
    if len(faces) * len(v) > MOST_PRODUCTS:
        return False
    a, b, c = (mesh.vertices[mesh.faces[faces, i]] for i in range(3))
    n = np.cross(b - a, c - a)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    heights = n @ v.T - (n * a).sum(1)[:, None]
    # Either way round: all on one side of every face.
    return bool(np.all((heights.max(1) < tolerance) | (heights.min(1) > -tolerance)))


def hiding_pairs(parts: list[Part], viewpoints: np.ndarray, of_interest: Any) -> list[tuple[int, int]]:
    """(hider, hidden) by number, of the parts of which one may hide the other from some of the ``viewpoints`` (P, 3).

    ``of_interest(i, j)``: which pairs are asked for. Conservative: what is left out cannot happen. A part that may hide
    points of its own is a pair with itself.
    """
    asked = [(i, j) for i in range(len(parts)) for j in range(len(parts)) if of_interest(i, j)]
    if len(parts) > MOST_PARTS:
        return asked
    return [(i, j) for i, j in asked if _may_hide(parts[i], parts[j], viewpoints, i == j)]


def _may_hide(hider: Part, hidden: Part, viewpoints: np.ndarray, itself: bool) -> bool:
    if itself:
        return hider.hides_itself
    everything = np.concatenate([hider.corners, hidden.corners, viewpoints])
    rounding = ROUNDING * np.ptp(everything, axis=0).max()
    for n in np.concatenate([hider.planes, hidden.planes]):
        for side in (n, -n):
            near = max((hidden.corners @ side).max(), (viewpoints @ side).max())
            if (hider.corners @ side).min() >= near - rounding:
                return False  # nothing of it lies before the other
    some = np.unique(np.linspace(0, len(viewpoints) - 1, min(len(viewpoints), 16)).astype(int))
    return any(not _cones_apart(hider.corners, hidden.corners, q).all() for q in (viewpoints[some], viewpoints))


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
