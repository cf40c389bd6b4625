"""``mesh_arrays``: a triangle mesh whose vertices and faces stand in the scene dictionary itself."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import SceneError
from torchtransient.plugins._registry import register


def mesh_arrays(props: Any) -> Any:
    """A Mitsuba mesh of arrays, with one normal a triangle.

    ``vertices``: (V, 3), metres, before ``to_world``; ``faces``: (F, 3), whole numbers, wound against the clock as seen
    from outside. ``to_world``, ``flip_normals`` and children (BSDF, emitter, sensor, media) as Mitsuba's meshes have
    them. Parameters are those of every mesh, ``vertex_positions`` in world space among them. Raises SceneError for
    missing arrays, sizes that are no multiples of three, numbers that are not finite and faces of vertices that are not
    there. Not supported: normals and texture coordinates at vertices.
    """
    vertices = _rows(props, "vertices")
    faces = _rows(props, "faces")
    if not np.isfinite(vertices).all():
        raise SceneError("mesh_arrays: expected finite vertices in metres, got NaN or infinity.")
    if (faces != np.round(faces)).any() or faces.min() < 0 or faces.max() >= len(vertices):
        raise SceneError(
            f"mesh_arrays: expected faces of whole numbers from 0 to {len(vertices) - 1}, one less than the vertices, "
            f"got numbers from {faces.min():g} to {faces.max():g}."
        )
    # As Mitsuba's own meshes: vertices are kept in world space, and a transform that mirrors turns the normals around.
    transform = np.array(props.get("to_world", mi.ScalarTransform4f()).matrix, dtype=np.float64)
    placed = vertices @ transform[:3, :3].T + transform[:3, 3]
    mesh = mi.Mesh(props.id(), len(placed), len(faces), props)
    params = mi.traverse(mesh)
    params["vertex_positions"] = mi.Float(np.ravel(placed).astype(np.float32))
    params["faces"] = mi.UInt32(np.ravel(faces).astype(np.uint32))
    params.update()
    return mesh


def _rows(props: Any, name: str) -> np.ndarray:
    value = props.get(name, None)
    if value is None or not dr.is_array_v(value):
        raise SceneError(
            f"mesh_arrays: expected {name} as an array (N, 3) in a scene dictionary, got "
            f"{'nothing' if value is None else type(value).__name__}. Scene files name a mesh file instead: type 'ply'."
        )
    array = np.asarray(value, dtype=np.float64).reshape(-1)
    if not array.size or array.size % 3:
        raise SceneError(f"mesh_arrays: expected {name} as rows of three numbers, got {array.size} numbers.")
    return array.reshape(-1, 3)


register("shape", "mesh_arrays", mesh_arrays)
