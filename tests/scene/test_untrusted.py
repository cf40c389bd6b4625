"""Scenes of strangers are tried in a process of their own, and mesh files are looked at before Mitsuba uses them."""

from __future__ import annotations

import struct
import time
import zlib

import numpy as np
import pytest

import torchtransient as tt
from support import deadly_plugins
from support.marks import long
from tools.small_room import VARIANT, make_room
from torchtransient import plugins
from torchtransient.errors import SceneError
from torchtransient.plugins import _registry

VERTICES = np.array([(0, 0, 1), (1, 0, 1), (0, 1, 1)], np.float32)
FORMATS = ("ascii", "binary_little_endian", "binary_big_endian", "serialized")


def mesh_file(folder, form, face):
    """A triangle with the given numbers of its vertices."""
    if form == "serialized":
        body = struct.pack("<I", 0x1000) + b"m\0" + struct.pack("<QQ", 3, 1) + VERTICES.tobytes()
        body += np.array(face, np.int64).astype(np.uint32).tobytes()
        path = folder / "mesh.serialized"
        path.write_bytes(struct.pack("<HH", 0x041C, 4) + zlib.compress(body) + struct.pack("<QI", 0, 1))
        return {"type": "serialized", "filename": str(path)}
    head = f"ply\nformat {form} 1.0\ncomment end_header\nelement vertex 3\n"
    head += "property float x\nproperty float y\nproperty float z\n"
    head += "element face 1\nproperty list uchar int vertex_index\nend_header\n"
    if form == "ascii":
        body = "".join(f"{x} {y} {z}\n" for x, y, z in VERTICES) + f"3 {face[0]} {face[1]} {face[2]}\n"
        body = body.encode()
    else:
        order = "<" if "little" in form else ">"
        body = VERTICES.astype(f"{order}f4").tobytes() + struct.pack(f"{order}Biii", 3, *face)
    path = folder / "mesh.ply"
    path.write_bytes(head.encode() + body)
    return {"type": "ply", "filename": str(path)}


def render(room):
    return tt.TransientRenderer(tt.load(room, variant=VARIANT), spp=2)(seed=0).transient.sum()


@pytest.mark.parametrize("form", FORMATS)
def test_faces_of_vertices_that_are_not_there(tmp_path, form):
    """2 * 10^9 ended the process, 3 was an IndexError, both were rendered with ``face_normals``, and -1 of a PLY
    file was read as 0.
    """
    room, surface = make_room(), make_room()["box"]["bsdf"]
    room["box"] = mesh_file(tmp_path, form, (0, 1, 2)) | {"bsdf": surface}
    assert render(room) > 0
    for last in (3, -1, 2_000_000_000):
        for more in ({}, {"face_normals": True}):
            room["box"] = mesh_file(tmp_path, form, (0, 1, last)) | {"bsdf": surface} | more
            with pytest.raises(SceneError, match=rf"from 0 to 2, got the number ({last}|{last % 2**32})\."):
                render(room)


# -------------------------------------------------------------------------------------------- processes of their own


@pytest.fixture
def deadly():
    before = list(_registry._state.third_party)
    plugins.register_module(deadly_plugins.MODULE, deadly_plugins.NAMES)
    yield lambda plugin: make_room() | {"box": {"type": "cube", "bsdf": {"type": plugin}}}
    _registry._state.third_party = before
    _registry._state.variant = None
    plugins.sync()


@pytest.mark.slow
def test_a_signal_is_named(deadly):
    with pytest.raises(SceneError, match=r"the signal SIGSEGV, which ended the process in which it was tried"):
        tt.load(deadly("ends_the_process"), variant=VARIANT, trusted=False)


@pytest.mark.slow
def test_no_answer_is_an_error(deadly, monkeypatch):
    monkeypatch.setattr("torchtransient.scene.load.SECONDS", 8.0)
    started = time.perf_counter()
    with pytest.raises(SceneError, match=r"within 8 s, got no answer"):
        tt.load(deadly("never_answers"), variant=VARIANT, trusted=False)
    assert time.perf_counter() - started < 60


@pytest.mark.slow
def test_what_is_right_is_loaded_and_what_is_wrong_is_said():
    room = make_room()
    room["sensor"]["film"] |= {"width": 20000, "height": 20000}
    scene = tt.load(room, variant=VARIANT, trusted=False)
    assert isinstance(scene, tt.Scene)
    room["box"]["bsdf"] = {"type": "dffuse"}
    with pytest.raises(SceneError, match="dffuse"):
        tt.load(room, variant=VARIANT, trusted=False)


# ------------------------------------------------------------------------------------------------- long before kernels


@pytest.mark.parametrize("kind", long(["blendphase", "shapegroup"], ["shapegroup"]))
def test_thousands_of_references_are_counted_at_once(kind):
    room = make_room()
    for n in range(3000):
        inside = {"type": "ref", "id": f"n{n + 1}"}
        if kind == "blendphase":
            room[f"n{n}"] = {"type": kind, "weight": 0.5, "a": inside, "b": {"type": "hg"}}
        else:
            room[f"n{n}"] = {"type": kind, "shape": {"type": "instance", "group": inside}}
    room["n3000"] = {"type": "hg"} if kind == "blendphase" else {"type": kind, "shape": {"type": "cube"}}
    started = time.process_time()
    with pytest.raises(SceneError, match="at most 32 deep"):
        render(room)
    assert time.process_time() - started < 6  # 15 s of the processor where every look copies all nodes; now 0.2
