"""Parallel rays against a triangle mesh, in numpy: for laying out points on a curved wall."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_PAIRS_AT_ONCE = 2**20
# Rays through a shared edge must not slip between its triangles: the barycentric coordinates of a hit may lack this.
_EDGE = 1e-9


def first_hits(origins: Array, direction: Array, corners: Array) -> tuple[Array, Indices]:
    """Distance (N,) to the first triangle that each ray meets, and its index (N,); infinity and -1 where none is met.

    `origins` (N, 3), one unit `direction` (3,) for all, `corners` (F, 3, 3). Both sides of a triangle count. The method
    of Moeller and Trumbore (1997), for the triangles alone that share a cell with a ray on a grid across the rays.
    """
    cells = _Cells(corners, direction)
    distances, indices = np.full(len(origins), np.inf), np.full(len(origins), -1, dtype=np.int64)
    rows, counts = cells.candidates(origins)
    ends = np.cumsum(counts)
    start = 0
    while start < len(origins):
        # As many rays as fit, and one at least.
        base = ends[start] - counts[start]
        stop = max(start + 1, int(np.searchsorted(ends, base + _PAIRS_AT_ONCE, side="right")))
        here = counts[start:stop]
        ray = np.repeat(np.arange(start, stop), here)
        within = np.arange(len(ray)) - np.repeat(np.cumsum(here) - here, here)
        triangle = cells.triangles[np.repeat(rows[start:stop], here) + within]
        t = _distances(origins[ray], direction, corners[triangle])
        # Of equally near ones the first in the mesh, as a search over all triangles would have it.
        order = np.lexsort((triangle, t, ray))
        rays, first = np.unique(ray[order], return_index=True)
        nearest = t[order][first]
        distances[rays] = nearest
        indices[rays] = np.where(np.isfinite(nearest), triangle[order][first], -1)
        start = stop
    return distances, indices


def _distances(origins: Array, direction: Array, corners: Array) -> Array:
    """Along each ray (N, 3) to a triangle (N, 3, 3) of its own; infinity where it passes."""
    a, first, second = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(direction, second)
    determinant = (first * across).sum(1)
    # What the ray runs along has no point to meet; relative to the edges, since small triangles are triangles too.
    scale = np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
    open_to_ray = np.abs(determinant) > 1e-12 * scale
    inverse = np.where(open_to_ray, 1 / np.where(open_to_ray, determinant, 1.0), 0.0)
    to_origin = origins - a
    u = (to_origin * across).sum(1) * inverse
    other = np.cross(to_origin, first)
    v = (other @ direction) * inverse
    t = (other * second).sum(1) * inverse
    met = open_to_ray & (u >= -_EDGE) & (v >= -_EDGE) & (u + v <= 1 + _EDGE) & (t > 0)
    return np.where(met, t, np.inf)


class _Cells:
    """Which triangles reach into which cell of a grid across a direction."""

    def __init__(self, corners: Array, direction: Array):
        helper = np.eye(3)[np.abs(direction).argmin()]
        first = np.cross(direction, helper)
        first /= np.linalg.norm(first)
        self._frame = np.stack([first, np.cross(direction, first)], axis=1)
        flat = corners @ self._frame
        low, high = flat.min(1), flat.max(1)
        self._low = low.min(0)
        self._size = np.maximum(high.max(0) - self._low, 1e-300)
        # A triangle that reaches into many cells is listed in each: fewer cells until the lists stay short.
        self._count = max(1, int(np.sqrt(len(corners))))
        while self._count > 1 and self._spans(low, high)[2].sum() > 16 * len(corners):
            self._count = (self._count + 1) // 2
        begin, width, number = self._spans(low, high)
        triangle = np.repeat(np.arange(len(corners)), number)
        within = np.arange(len(triangle)) - np.repeat(np.cumsum(number) - number, number)
        wide = np.repeat(width[:, 0], number)
        cell = self._index(np.repeat(begin, number, axis=0) + np.stack([within % wide, within // wide], axis=1))
        order = np.argsort(cell, kind="stable")
        self.triangles = triangle[order]
        self._starts = np.searchsorted(cell[order], np.arange(self._count**2 + 1))

    def candidates(self, origins: Array) -> tuple[Indices, Indices]:
        """Where in `triangles` the list of each ray begins, and its length; 0 beside the grid."""
        place = origins @ self._frame
        slack = 1e-9 * self._size
        inside = ((place >= self._low - slack) & (place <= self._low + self._size + slack)).all(1)
        cell = self._index(self._cell(place))
        return self._starts[cell], np.where(inside, self._starts[cell + 1] - self._starts[cell], 0)

    def _cell(self, places: Array) -> Indices:
        scaled = np.floor((places - self._low) / self._size * self._count)
        return np.asarray(np.clip(scaled, 0, self._count - 1), dtype=np.int64)

    def _spans(self, low: Array, high: Array) -> tuple[Indices, Indices, Indices]:
        """First cells (F, 2) of triangles, numbers of cells along both axes, and in all."""
        slack = 1e-6 * self._size / self._count
        begin, end = self._cell(low - slack), self._cell(high + slack)
        width = end - begin + 1
        return begin, width, width.prod(1)

    def _index(self, cells: Indices) -> Indices:
        return np.asarray(cells[..., 1] * self._count + cells[..., 0])


def triangle_normals(corners: Array) -> Array:
    """Unit normals (F, 3) by the winding of the corners (F, 3, 3); zero for triangles without an area."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(normals / np.where(length > 0, length, 1.0))
