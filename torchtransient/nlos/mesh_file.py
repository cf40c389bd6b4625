"""Mesh files as shapes: the same ones, read the same way, wherever a hidden thing is named by a file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torchtransient import scenes
from torchtransient.array_files.array_file import read_some
from torchtransient.errors import SceneError, StorageError, TorchTransientError

# Plugins of Mitsuba by what names of files end with; .npz is read here.
_PLUGINS = {".obj": "obj", ".ply": "ply", ".serialized": "serialized"}
MESH_FILES = (*_PLUGINS, ".npz")


def mesh_file(path: Path, where: str) -> dict[str, Any]:
    """A mesh file as a shape of a scene dictionary, without a material: .obj, .ply, .serialized, or .npz with
    ``vertices`` (V, 3) and ``faces`` (F, 3), metres.

    Its triangles are flat, as those of arrays are: normals in the file do not count, and none are interpolated. (Give
    ``{"type": "obj", "filename": ...}`` for what Mitsuba makes of them.) ``where``: what messages begin with. Raises
    SceneError for other files and those that are not there, StorageError for those that cannot be read.
    """
    suffix = path.suffix.lower()
    if suffix == ".xml":
        raise SceneError(
            f"{where}: {str(path)!r} is a complete scene, with a sensor of its own; leave scan out to simulate it as "
            "it is: tt.nlos.simulate(path)."
        )
    if suffix not in MESH_FILES:
        raise SceneError(f"{where}: expected a mesh file ({', '.join(MESH_FILES)}), got {str(path)!r}.")
    if not path.is_file():
        raise SceneError(f"{where}: no file {str(path)!r}, seen from {Path.cwd()}. Give the path of a mesh.")
    if suffix == ".npz":
        shape = mesh_arrays_shape(*mesh_of_npz(path, where), where)
        del shape["bsdf"]
        return shape
    return {"type": _PLUGINS[suffix], "filename": str(path), "face_normals": True}


def mesh_of_npz(path: Path, where: str) -> tuple[Any, Any]:
    """`vertices` and `faces` of an .npz file. Raises StorageError where they cannot be read."""
    kind = "an archive of 'vertices' and 'faces' in NumPy's .npz"
    found = read_some(path, where, ("vertices", "faces").__contains__, kind)
    if len(found) < 2:
        had = " alone".join([*found, ""]) or "neither"
        raise StorageError(f"{where}: expected 'vertices' and 'faces' in '{path}', got {had}.")
    return found["vertices"], found["faces"]


def mesh_arrays_shape(vertices: Any, faces: Any, where: str) -> dict[str, Any]:
    """`scenes.triangle_mesh`, whose errors begin with ``where``."""
    try:
        return scenes.triangle_mesh(vertices, faces)
    except TorchTransientError as error:
        raise type(error)(f"{where}: {error}") from error
