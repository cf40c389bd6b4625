"""Triangles joined by position, so that seams of texture coordinates and of separate files do not count as rims."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from torchtransient.plugins.kernel_arrays import host_numbers
from torchtransient.plugins.mitsuba_compat import mesh_faces, mesh_positions

# Creases flatter than this are no outline: 1 minus the cosine of 1.4e-3 radians.
FLAT = 1e-6
# Points of rims that are nearer than this to each other, in parts of their coordinates and rims, are one.
APART = 8e-6
# Binary ones of single precision.
_DIGITS = 24


@dataclass
class Triangles:
    """Triangles of several meshes, their vertices joined by position, of one mesh and of different ones.

    Faces without area are left out.

    Attributes:
        vertices: vertices of all meshes in their order, (V, 3).
        first: number of the first vertex of each mesh, (M,).
        faces: numbers of vertices, (F, 3).
        joined: numbers of places, (F, 3).
        mesh: number of the mesh, (F,).
    """

    meshes: list[Any]
    vertices: np.ndarray
    first: np.ndarray
    faces: np.ndarray
    joined: np.ndarray
    mesh: np.ndarray

    @staticmethod
    def from_meshes(meshes: list[Any]) -> Triangles:
        """Read the triangles of Mitsuba meshes, as they are now."""
        v = [host_numbers(mesh_positions(m), np.float32).reshape(-1, 3) for m in meshes]
        f = [np.array(mesh_faces(m), dtype=np.int64).reshape(-1, 3) for m in meshes]
        first = np.cumsum([0, *(len(one) for one in v)])
        mesh = np.repeat(np.arange(len(f)), [len(one) for one in f])
        positions = np.concatenate([np.zeros((0, 3), np.float32), *v])
        faces = np.concatenate(
            [np.zeros((0, 3), np.int64), *(one + start for one, start in zip(f, first, strict=False))]
        )
        corners = positions.astype(np.float64)[faces]
        some = np.any(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) != 0, axis=1)
        faces, mesh = faces[some], mesh[some]
        joined = joined_places(positions, faces)
        return Triangles(meshes, positions.astype(np.float64), first, faces, joined, mesh)

    def parts(self) -> np.ndarray:
        """Return the number of the connected part that each face belongs to, (F,)."""
        return merged(self.joined, int(self.joined.max(initial=-1)) + 1)[self.joined[:, 0]]


def joined_places(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the places of the corners of faces, (F, 3), the same number for corners that lie at the same place.

    Corners that differ by some bits are the same place if they lie on rims: pieces that were put together by transforms
    are off by some roundings. No face loses an edge by it: far from the origin, edges may be as short as roundings are
    long.

    Args:
        positions: positions of the vertices, (V, 3), single precision.
        faces: numbers of vertices, (F, 3).
    """
    # Adding zero makes one of the two zeros.
    keys = np.ascontiguousarray(positions + np.float32(0)).view("V12").ravel()
    _, sample, place = np.unique(keys, return_index=True, return_inverse=True)
    place = place.ravel()
    joined = place[faces]
    key, _ = edge_keys(joined)
    _, back, count = np.unique(key, return_inverse=True, return_counts=True)
    rims = joined[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)[count[back.ravel()] == 1]
    if not len(rims):
        return joined
    on_rim, back = np.unique(rims, return_inverse=True)
    p = positions[sample[on_rim]]
    ends = back.reshape(-1, 2)
    reach = np.zeros(len(on_rim))
    np.maximum.at(reach, ends, np.abs(p[ends[:, 0]] - p[ends[:, 1]]).max(1, keepdims=True))
    label = np.arange(len(sample))
    label[on_rim] = on_rim[near_places(p, reach)]
    near = label[joined]
    lost = (near == near[:, [1, 2, 0]]) & (joined != joined[:, [1, 2, 0]])
    apart = np.isin(label, near[lost])
    label[apart] = np.flatnonzero(apart)
    return label[joined]


def near_places(positions: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Return for each point the number of the first point at the same place, up to some roundings, (K,).

    Args:
        positions: positions of the points, (K, 3).
        reach: length of the longest rim at each, which a rotation may have rounded by, (K,).
    """
    p = positions.astype(np.float64)
    low = np.frexp(np.abs(p).max(axis=1, initial=0))[1] - 1
    high = np.maximum(low, np.frexp(reach)[1] - 1)
    # Of smaller coordinates nothing is left.
    low = np.maximum(low, high - _DIGITS)
    groups = [np.zeros((0, 2), np.int64)]
    # Cells for each power of two; points on both sides of one have one in common.
    for size in range(int(low.min(initial=0)), int(high.max(initial=-1)) + 2):
        some = np.flatnonzero((low <= size) & (size <= high + 1))
        cell = p[some] / np.ldexp(APART, size)
        # Two points nearer than half a cell share one in some of the eight shifted grids.
        for shift in range(8 if len(some) else 0):
            cells = np.floor(cell + 0.5 * np.array([shift & 1, shift >> 1 & 1, shift >> 2 & 1])).astype(np.int64)
            _, index, inverse = np.unique(cells, axis=0, return_index=True, return_inverse=True)
            groups.append(np.stack([some, some[index[inverse.ravel()]]], 1))
    return merged(np.concatenate(groups), len(p), numbered=False)


def merged(groups: np.ndarray, count: int, numbered: bool = True) -> np.ndarray:
    """Return a label of each thing, the same for those of one group and of groups that overlap, (count,).

    Args:
        groups: numbers of things that belong together, (G, K).
        count: number of things.
        numbered: labels run from zero on; else they are the least number of their group.
    """
    label = np.arange(count)
    while True:
        new = label.copy()
        np.minimum.at(new, groups.ravel(), np.repeat(label[groups].min(1), groups.shape[1]))
        new = new[new]
        if np.array_equal(new, label):
            return np.unique(label, return_inverse=True)[1].ravel() if numbered else label
        label = new


def edge_keys(joined: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (a number for each edge of each face, the same for the same edge; mask of proper edges), (3 F,).

    Args:
        joined: places of the corners of faces, (F, 3).
    """
    low, high = joined.ravel(), joined[:, [1, 2, 0]].ravel()
    return np.minimum(low, high) * (int(joined.max(initial=0)) + 1) + np.maximum(low, high), low != high
