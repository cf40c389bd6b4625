"""Arrays of meshes under the names and in the layouts of Mitsuba 3.9 and 3.10."""

from __future__ import annotations

import re
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from torchtransient import plugins
from torchtransient.plugins import mitsuba_compat as compat

PACKAGE = Path(compat.__file__).parents[1]
POSITIONS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], np.float32)
NORMALS = np.tile(np.float32([0, 0, 1]), (4, 1))
TEXCOORDS = POSITIONS[:, :2]
FACES = np.array([[0, 1, 2], [2, 1, 3]], np.uint32)
# Users' keys of the arrays, and their names and types in Mitsuba 3.10.
NEW = {
    "vertex_positions": ("positions", POSITIONS),
    "vertex_normals": ("normals", NORMALS),
    "vertex_texcoords": ("texcoords", TEXCOORDS),
    "faces": ("faces", FACES),
}


@pytest.fixture(autouse=True)
def _variant():
    mi.set_variant("llvm_ad_rgb")
    plugins.sync()


def mesh_of_arrays():
    return mi.load_dict(
        {
            "type": "mesh_arrays",
            "vertices": mi.TensorXf(POSITIONS),
            "faces": mi.TensorXf(FACES.astype(np.float32)),
            "normals": mi.TensorXf(NORMALS),
            "texcoords": mi.TensorXf(TEXCOORDS),
        }
    )


@pytest.fixture(params=["3.9", "3.10"])
def mesh(request, monkeypatch):
    """A mesh; that of version 3.10 shows rows under other names, and has no buffers."""
    found = mesh_of_arrays()
    if request.param == "3.9":
        return found
    monkeypatch.setattr(compat, "shows_rows", lambda: True)
    tensors = {name: (mi.TensorXu if name == "faces" else mi.TensorXf)(array) for name, array in NEW.values()}
    monkeypatch.setattr(compat.mi, "traverse", lambda shape: tensors if shape is None else pytest.fail("a buffer"))
    return None


def test_arrays(mesh):
    for read, array in [
        (compat.mesh_positions, POSITIONS), (compat.mesh_normals, NORMALS), (compat.mesh_texcoords, TEXCOORDS),
        (compat.mesh_faces, FACES),
    ]:  # fmt: skip
        found = read(mesh)
        assert isinstance(found, mi.UInt32 if array is FACES else mi.Float)
        np.testing.assert_array_equal(np.array(found), array.ravel())


def test_keys_of_users(monkeypatch):
    mesh = mesh_of_arrays()
    shown = set(mi.traverse(mesh).properties)
    for rows in (False, True):
        monkeypatch.setattr(compat, "shows_rows", lambda rows=rows: rows)
        for key, (new, _) in NEW.items():
            assert key in shown or rows
            assert compat.users_name(mesh, new if rows else key) == key
        assert compat.users_name(mesh, "vertex_color") == "vertex_color"
        assert compat.users_name(mesh.bsdf(), "positions") == "positions"


def test_new_meshes_are_handed_their_arrays(monkeypatch):
    made = {}
    monkeypatch.setattr(compat, "shows_rows", lambda: True)
    monkeypatch.setattr(compat.mi, "Mesh", lambda name, **given: made.update(given))
    compat.mesh_of_arrays(mi.Properties("mesh_arrays"), POSITIONS, FACES, None, TEXCOORDS)
    assert set(made) == {"props", "positions", "faces", "texcoords"}
    assert made["positions"].shape == (4, 3) and made["faces"].shape == (2, 3)
    assert isinstance(made["faces"], mi.TensorXu)


@pytest.mark.parametrize(("version", "rows"), [("3.9.1", False), ("3.10.0", True), ("3.10.0.dev2", True), ("4.0", 1)])
def test_versions(monkeypatch, version, rows):
    monkeypatch.setattr(mi, "__version__", version)
    assert compat.shows_rows() == rows


def test_buffers_are_read_in_one_file():
    for path in PACKAGE.rglob("*.py"):
        if path.stem != "mitsuba_compat":
            found = re.search(r"(vertex_\w+|faces)_buffer\(", path.read_text(encoding="utf-8"))
            assert found is None, f"{path}: {found}"
