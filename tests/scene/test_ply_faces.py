"""The smallest number of a vertex in a PLY file, whatever stands around the faces."""

from __future__ import annotations

import numpy as np
import pytest

from support.sweeps import together
from torchtransient.scene.checks import smallest_vertex

FACES = [(0, 1, 2), (2, -7, 1), (1, 2, -3)]
KINDS = {"char": "i1", "int16": "i2", "int": "i4"}


def ply(form, kind="int", *, faces=FACES, before="list", name="vertex_indices", behind=True):
    """Two vertices of four properties, three edges with a list each, then faces with a number before and a colour
    behind their vertices.
    """
    head = [f"ply\nformat {form} 1.0\ncomment element face 9\nelement vertex 2"]
    head += [f"property {one} {n}" for n, one in enumerate(("float", "double", "uchar", "short"))]
    head += ["element edge 3", "property list uchar float ends" if before == "list" else "property float length"]
    head += [f"element face {len(faces)}", "property ushort number", f"property list uchar {kind} {name}"]
    head += ["property float shade"] * behind + ["end_header\n"]
    order = ">" if "big" in form else "<"
    vertex = np.dtype([(str(n), order + one) for n, one in enumerate(("f4", "f8", "u1", "i2"))])
    edge = np.dtype([("n", "u1"), ("ends", order + "f4", 3)] if before == "list" else [("l", order + "f4")])
    face = np.dtype([("number", order + "u2"), ("n", "u1"), ("at", order + KINDS.get(kind, "u4"), 3)]
                    + [("shade", order + "f4")] * behind)  # fmt: skip
    vertices = np.array([(-9.5, -99.0, 7, -8), (1.0, 2.0, 3, 4)], vertex)
    edges = np.array([(3, (-50.0, 1, 2))] * 3 if before == "list" else [(-50.0,)] * 3, edge)
    rows = np.array([(40000, 3, at) + (-60.0,) * behind for at in faces], face)
    if form != "ascii":
        return "\n".join(head).encode() + vertices.tobytes() + edges.tobytes() + rows.tobytes()
    lines = [
        " ".join(str(number) for number in _flat(row.tolist())) for part in (vertices, edges, rows) for row in part
    ]
    return ("\n".join(head) + "\n".join(lines) + "\n").encode()


def _flat(row):
    for entry in row:
        yield from np.ravel(entry).tolist()


@together("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@together("kind", KINDS)
@together("before", ["list", "number"])
@together("behind", [True, False])
def test_the_smallest_number(tmp_path, form, kind, before, behind):
    file = tmp_path / "mesh.ply"
    file.write_bytes(ply(form, kind, before=before, behind=behind))
    assert smallest_vertex(str(file)) == -7
    file.write_bytes(ply(form, kind, faces=[(5, 4, 3), (8, 7, 6)], before=before, behind=behind))
    assert smallest_vertex(str(file)) == 0


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_faces_without_a_negative_number(tmp_path, form):
    """None at all, of numbers without a sign, or of another name."""
    file = tmp_path / "mesh.ply"
    for content in (ply(form, faces=[]), ply(form, "uint", faces=[(1, 2, 3)]), ply(form, name="texture")):
        file.write_bytes(content)
        assert smallest_vertex(str(file)) == 0
    file.write_bytes(ply(form, name="vertex_index"))
    assert smallest_vertex(str(file)) == -7
    file.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n-4\n")
    assert smallest_vertex(str(file)) == 0
