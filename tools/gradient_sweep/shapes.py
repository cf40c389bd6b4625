"""The shapes of the sweep: those that fill the view as the plate does, and the files that some of them read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from tools.gradient_sweep.stages import Description, move, stretch, turn

# Half the size of plates, in metres: their rims are out of reach.
_HALF = 30.0
_TILT = turn(1, 8)
Maker = Callable[[Path], Description]
# Mitsuba refuses some inside groups.
NOT_IN_GROUPS = ("sdfgrid",)
# Vertices along a side of a mesh.
_GRID = 5


def grid_mesh() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(vertices, normals, texture coordinates, faces) of a square from -1 to 1 with normals that lean."""
    x, y = (a.reshape(-1) for a in np.meshgrid(*[np.linspace(-1.0, 1.0, _GRID)] * 2))
    vertices = np.stack([x, y, 0 * x], axis=1)
    normals = np.stack([0.2 * np.sin(9 * x), 0.2 * np.cos(7 * y), 1 + 0 * x], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    corner = (np.arange(_GRID - 1)[:, None] * _GRID + np.arange(_GRID - 1)).reshape(-1)
    right, up = corner + 1, corner + _GRID
    faces = np.concatenate([np.stack([corner, right, up + 1], 1), np.stack([corner, up + 1, up], 1)])
    return vertices, normals, np.stack([x, y], axis=1) / 2 + 0.5, faces


def write_obj(path: Path) -> Path:
    vertices, normals, texcoords, faces = grid_mesh()
    lines = [f"v {a} {b} {c}" for a, b, c in vertices]
    lines += [f"vn {a} {b} {c}" for a, b, c in normals]
    lines += [f"vt {a} {b}" for a, b in texcoords]
    lines += ["f " + " ".join(f"{i}/{i}/{i}" for i in face) for face in faces + 1]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def write_ply(path: Path) -> Path:
    """With a colour and a share at each vertex."""
    vertices, normals, texcoords, faces = grid_mesh()
    rng = np.random.default_rng(4)
    colours, shares = rng.uniform(0.3, 0.7, (len(vertices), 3)), rng.uniform(0.3, 0.6, (len(vertices), 1))
    names = ("x", "y", "z", "nx", "ny", "nz", "u", "v", "r", "g", "b", "share_x")
    header = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}", *(f"property float {n}" for n in names)]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    rows = np.concatenate([vertices, normals, texcoords, colours, shares], axis=1)
    lines = [" ".join(f"{n:.6f}" for n in row) for row in rows] + ["3 " + " ".join(map(str, f)) for f in faces]
    path.write_text("\n".join([*header, *lines]) + "\n", encoding="utf-8")
    return path


def write_curve(path: Path) -> Path:
    """A thick, straight fibre along y, whose front is where the plate is."""
    points = [f"{0.1 * np.sin(y)} {y} -3 3.0" for y in np.linspace(-30.0, 30.0, 7)]
    path.write_text("\n".join(points) + "\n", encoding="utf-8")
    return path


def _in_place(to_world: np.ndarray) -> Description:
    """The square of the mesh files, without normals and texture coordinates."""
    vertices, _, _, faces = grid_mesh()
    return {"type": "mesh_arrays", "vertices": vertices, "faces": faces, "to_world": to_world}


def _sdf_slab() -> Description:
    """A slab of signed distances, a metre thick and 20 m wide. Mitsuba's cannot be rotated."""
    z = np.linspace(-1.0, 1.0, 8, dtype=np.float32)
    grid = np.broadcast_to(np.abs(z) - 0.5, (8, 8, 8)).transpose(2, 1, 0)[..., None]
    pose = move(-10.0, -10.0, -1.5) @ stretch(20.0, 20.0, 2.0)
    return {"type": "sdfgrid", "grid": np.ascontiguousarray(grid), "to_world": pose}


def _blobs(plugin: str) -> Description:
    """One ellipsoid that is wider than the view, its front where the plate is."""
    return {
        "type": plugin,
        "centers": np.array([[0.2, 0.1, -4.0]]),
        "scales": np.array([[1.6, 1.5, 1.4]]),
        "quaternions": np.array([[0.1, 0.2, 0.0, 0.97]]),
    }


def shapes() -> dict[str, Maker]:
    """Every shape, by the name of its plugin."""
    flat = _TILT @ stretch(_HALF)
    return {
        "rectangle": lambda _: {"type": "rectangle", "to_world": flat},
        "disk": lambda _: {"type": "disk", "to_world": flat},
        "cube": lambda _: {"type": "cube", "to_world": _TILT @ stretch(_HALF, _HALF, 1.0) @ move(z=-1.0)},
        "sphere": lambda _: {"type": "sphere", "center": [0.2, 0.1, -4.0], "radius": 4.0},
        "cylinder": lambda _: {"type": "cylinder", "p0": [0.1, -_HALF, -3.0], "p1": [0.0, _HALF, -3.0], "radius": 3.0},
        "obj": lambda folder: {"type": "obj", "filename": str(write_obj(folder / "plate.obj")), "to_world": flat},
        "ply": lambda folder: {"type": "ply", "filename": str(write_ply(folder / "plate.ply")), "to_world": flat},
        "mesh_arrays": lambda _: _in_place(flat),
        "sdfgrid": lambda _: _sdf_slab(),
        "bsplinecurve": lambda folder: {"type": "bsplinecurve", "filename": str(write_curve(folder / "fibre.txt"))},
        "linearcurve": lambda folder: {"type": "linearcurve", "filename": str(write_curve(folder / "fibre.txt"))},
        "ellipsoids": lambda _: _blobs("ellipsoids"),
        "ellipsoidsmesh": lambda _: _blobs("ellipsoidsmesh"),
    }


def lamp_shapes() -> dict[str, Maker]:
    """Shapes that lamps have: small, beside the camera, facing the plate. Without the ones that Mitsuba refuses."""
    facing = move(0.8, 0.3, 2.5) @ turn(1, 190) @ stretch(0.3)
    return {
        "rectangle": lambda _: {"type": "rectangle", "to_world": facing},
        "disk": lambda _: {"type": "disk", "to_world": facing},
        "cube": lambda _: {"type": "cube", "to_world": facing @ stretch(0.5)},
        "sphere": lambda _: {"type": "sphere", "center": [0.8, 0.3, 2.5], "radius": 0.2},
        "cylinder": lambda _: {
            "type": "cylinder", "p0": [0.8, 0.1, 2.5], "p1": [0.9, 0.6, 2.4], "radius": 0.1,
        },
        "obj": lambda folder: {"type": "obj", "filename": str(write_obj(folder / "lamp.obj")), "to_world": facing},
        "ply": lambda folder: {"type": "ply", "filename": str(write_ply(folder / "lamp.ply")), "to_world": facing},
    }  # fmt: skip
