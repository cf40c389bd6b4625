"""Faces of mesh files: Mitsuba makes normals of vertices that are not there, and rays meet them, without a look."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from torchtransient.checks import check_special
from torchtransient.errors import SceneError
from torchtransient.rendering.ply_faces import smallest_vertex
from torchtransient.rendering.taken import ReadyScene

# Plugins that hand on what a file says; Mitsuba checks the faces of an 'obj' itself.
_UNCHECKED = ("ply", "serialized")
_READ = ("filename", "shape_index", "shape_name")
# Files that were found to be right, by name, time and size: a scene is built several times.
_right: dict[tuple[Any, ...], None] = {}
_MOST_REMEMBERED = 4096


def check_mesh_files(state: Any) -> None:
    """Raise ``SceneError`` where a face of a mesh file is made of vertices that the file does not have, and where any
    file is a device or a pipe, which may have no end. Must be called where Mitsuba finds the files, before the scene is
    built; what cannot be read is left to Mitsuba to say.
    """
    import mitsuba as mi

    for node in state.nodes:
        for name in [name for name in node.props.keys() if "file" in name]:  # noqa: SIM118  # of Mitsuba's properties
            if isinstance(node.props[name], str):
                place = str(mi.file_resolver().resolve(node.props[name]))
                check_special(place, f"{name} of {node.props.plugin_name()}", SceneError)
        if node.props.plugin_name() not in _UNCHECKED or not isinstance(node.props.get("filename", None), str):
            continue
        given = {name: node.props[name] for name in _READ if name in node.props}
        key = _state_of(str(mi.file_resolver().resolve(given["filename"])), node.props.plugin_name(), given)
        if key is None or key in _right:
            continue
        try:
            # Without normals of vertices a file is no more than read.
            mesh = mi.load_dict({"type": node.props.plugin_name(), "face_normals": True, **given})
        except (RuntimeError, TypeError, ValueError):
            continue
        name = f"{given['filename']} ({node.props.plugin_name()})"
        check_faces(mesh, name)
        if node.props.plugin_name() == "ply" and (least := _smallest(key[0])) < 0:
            raise SceneError(_wrong(name, mesh.vertex_count(), least))
        _right[key] = None
        while len(_right) > _MOST_REMEMBERED:
            del _right[next(iter(_right))]


def check_faces(mesh: Any, name: str) -> None:
    """Raise ``SceneError`` where a mesh has faces of vertices that are not there."""
    import mitsuba as mi

    params = mi.traverse(mesh)
    if "faces" not in params:  # a rectangle of Mitsuba is a mesh by its class
        return
    count, faces = mesh.vertex_count(), np.array(params["faces"])
    if faces.size and int(faces.max()) >= count:
        raise SceneError(_wrong(name, count, int(faces.max())))


def _smallest(path: str) -> int:
    try:
        return smallest_vertex(path)
    except (ValueError, LookupError):  # a form of header that Mitsuba reads and this library does not
        return 0


def _wrong(name: str, count: int, number: int) -> str:
    return (
        f"{name}: expected faces of vertices from 0 to {count - 1}, got the number {number}. Mend the file, or write "
        "it anew with the program that it comes from."
    )


def check_taken_meshes(taken: Any) -> None:
    """The same of the meshes that were taken as they are, and of those of scenes that were."""
    import mitsuba as mi

    for one in taken:
        held = one.scene.shapes() if isinstance(one, ReadyScene) else [one.value]
        for shape in held:
            if isinstance(shape, mi.Mesh):
                check_faces(shape, f"the mesh {shape.id()!r}")


def _state_of(path: str, plugin: str, given: dict[str, Any]) -> tuple[Any, ...] | None:
    """What tells a file, as it is now, from others; None where it is not there."""
    try:
        found = os.stat(path)
    except (OSError, ValueError):
        return None
    rest = tuple(sorted((key, str(value)) for key, value in given.items() if key != "filename"))
    return (path, plugin, rest, found.st_mtime_ns, found.st_size, found.st_ino)
