"""Triangles that lie in each other: what a ray meets there is chance, and a sum over areas counts both."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

# A direction in which no mesh is likely to be regular.
_DIRECTION = np.array([0.6180339887498949, 0.7548776662466927, 0.5698402909980532])


def doubled_faces(shapes: list[Any]) -> dict[str, int]:
    """Names of the meshes with triangles whose corners are those of another triangle of these shapes, exactly and on a
    side that both light, and how many they are.
    """
    meshes = [shape for shape in shapes if shape.is_mesh()]
    corners = [_corners(mesh) for mesh in meshes]
    if not corners:
        return {}
    along = np.concatenate([each @ _DIRECTION for each in corners])
    order = np.sort(along, axis=1)
    total = order.sum(1)
    _, group, size = np.unique(total, return_inverse=True, return_counts=True)
    suspects = np.flatnonzero(size[group] > 1)
    if not len(suspects):
        return {}
    owner = np.repeat(np.arange(len(meshes)), [len(each) for each in corners])
    behind = np.array([bool(mi.has_flag(mesh.bsdf().flags(), mi.BSDFFlags.BackSide)) for mesh in meshes])
    every = np.concatenate(corners)
    found: dict[tuple[Any, ...], list[int]] = {}
    for number in suspects:
        found.setdefault(tuple(sorted(map(tuple, every[number].tolist()))), []).append(int(number))
    names: dict[str, int] = {}
    for faces in found.values():
        for i in faces[1:]:
            if any(_lit_together(every[i], every[k], behind[owner[i]] or behind[owner[k]]) for k in faces if k != i):
                mesh = meshes[owner[i]]
                name = mesh.id() or mesh.class_name()
                names[name] = names.get(name, 0) + 1
    return names


def _lit_together(a: np.ndarray, b: np.ndarray, behind: bool) -> bool:
    """Whether two triangles with the same corners scatter light that comes from one side."""
    n, m = (np.cross(t[1] - t[0], t[2] - t[0]) for t in (a, b))
    return bool(n.any()) and (behind or float(n @ m) > 0)


def _corners(mesh: Any) -> np.ndarray:
    v = np.array(dr.detach(mesh.vertex_positions_buffer()), dtype=np.float64).reshape(-1, 3)
    return v[np.array(mesh.faces_buffer(), dtype=np.int64).reshape(-1, 3)]
