"""``mesh_arrays``: a triangle mesh whose arrays stand in the scene dictionary itself."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import SceneError
from torchtransient.plugins._registry import register
from torchtransient.plugins.mitsuba_compat import VELOCITY, mesh_of_arrays
from torchtransient.plugins.parameter_effect import ParameterEffect, declare_effects


def mesh_arrays(props: Any) -> Any:
    """Return a Mitsuba mesh of arrays.

    Properties, beside ``to_world``, ``face_normals``, ``flip_normals`` and children (BSDF, emitter, sensor, media) as
    Mitsuba's meshes have them:

    ``vertices``: (V, 3), metres, before ``to_world``.
    ``faces``: (F, 3), whole numbers, wound against the clock as seen from outside.
    ``normals``: (V, 3), directions at the vertices before ``to_world``; without them there is one normal a triangle.
    ``texcoords``: (V, 2).
    ``vertex_velocity``: (V, 3), m/s in the world, for films that measure how fast path lengths change.

    Parameters are those of every mesh, ``vertex_positions`` in world space among them.

    Args:
        props: ``mi.Properties``.

    Raises:
        SceneError: for missing arrays, sizes that do not fit, numbers that are not finite and faces of vertices that
            are not there.

    Not supported: other attributes of vertices and faces.
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
    normals, texcoords = _at_vertices(props, "normals", len(vertices)), _at_vertices(props, "texcoords", len(vertices))
    # As Mitsuba's own meshes: vertices are kept in world space, and a transform that mirrors turns the normals around.
    transform = np.array(props.get("to_world", mi.ScalarTransform4f()).matrix, dtype=np.float64)
    placed = vertices @ transform[:3, :3].T + transform[:3, 3]
    if normals is not None and "to_world" in props:
        normals = normals @ np.linalg.inv(transform[:3, :3])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    velocities = _at_vertices(props, VELOCITY, len(vertices))
    mesh = mesh_of_arrays(props, placed, faces, normals, texcoords)
    if velocities is not None:
        mesh.add_attribute(VELOCITY, 3, np.ravel(velocities).astype(np.float32).tolist())
    return mesh


# Arrays of a mesh have rows of so many numbers.
_COLUMNS = {"texcoords": 2}


def _at_vertices(props: Any, name: str, count: int) -> np.ndarray | None:
    if name not in props:
        return None
    rows = _rows(props, name)
    if len(rows) != count or not np.isfinite(rows).all():
        raise SceneError(
            f"mesh_arrays: expected {name} as finite numbers, one row for each of the {count} vertices, got "
            f"{len(rows)} rows{'' if np.isfinite(rows).all() else ' with NaN or infinity'}."
        )
    return rows


def _rows(props: Any, name: str) -> np.ndarray:
    value, columns = props.get(name, None), _COLUMNS.get(name, 3)
    if value is None or not dr.is_array_v(value):
        raise SceneError(
            f"mesh_arrays: expected {name} as an array (N, {columns}) in a scene dictionary, got "
            f"{'nothing' if value is None else type(value).__name__}. Scene files name a mesh file instead: type 'ply'."
        )
    array = np.asarray(value, dtype=np.float64).reshape(-1)
    if not array.size or array.size % columns:
        words = {2: "two", 3: "three"}[columns]
        raise SceneError(f"mesh_arrays: expected {name} as rows of {words} numbers, got {array.size} numbers.")
    return array.reshape(-1, columns)


register("shape", "mesh_arrays", mesh_arrays)
declare_effects("Mesh", {VELOCITY: ParameterEffect(moves_length=True, role="velocity")})
