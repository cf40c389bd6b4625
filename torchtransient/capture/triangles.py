"""Parallel rays against a triangle mesh, in numpy: for laying out points on a curved wall."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_PAIRS_AT_ONCE = 2**20
# Rays through a shared edge must not slip between its triangles: the barycentric coordinates of a hit may lack this.
_EDGE = 1e-9


def first_hits(origins: Array, direction: Array, corners: Array) -> tuple[Array, NDArray[np.int64]]:
    """Distance (N,) to the first triangle that each ray meets, and its index (N,); infinity and -1 where none is met.

    `origins` (N, 3), one unit `direction` (3,) for all, `corners` (F, 3, 3). Both sides of a triangle count. The method
    of Moeller and Trumbore (1997); time and memory go by rays times triangles, in parts.
    """
    a, first, second = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(direction, second)
    determinant = (first * across).sum(1)
    # What the ray runs along has no point to meet; relative to the edges, since small triangles are triangles too.
    scale = np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
    open_to_ray = np.abs(determinant) > 1e-12 * scale
    inverse = np.where(open_to_ray, 1 / np.where(open_to_ray, determinant, 1.0), 0.0)
    distances, indices = np.full(len(origins), np.inf), np.full(len(origins), -1, dtype=np.int64)
    step = max(1, _PAIRS_AT_ONCE // max(1, len(corners)))
    for start in range(0, len(origins), step):
        to_origin = origins[start : start + step, None] - a
        u = (to_origin * across).sum(-1) * inverse
        other = np.cross(to_origin, first)
        v = (other @ direction) * inverse
        t = (other * second).sum(-1) * inverse
        met = open_to_ray & (u >= -_EDGE) & (v >= -_EDGE) & (u + v <= 1 + _EDGE) & (t > 0)
        t = np.where(met, t, np.inf)
        nearest = t.argmin(1)
        found = t[np.arange(len(t)), nearest]
        distances[start : start + step] = found
        indices[start : start + step] = np.where(np.isfinite(found), nearest, -1)
    return distances, indices


def triangle_normals(corners: Array) -> Array:
    """Unit normals (F, 3) by the winding of the corners (F, 3, 3); zero for triangles without an area."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(normals / np.where(length > 0, length, 1.0))
