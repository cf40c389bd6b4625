"""Triangle meshes as arrays: vertices float64 (V, 3) in metres and faces int64 (F, 3), against the clock as seen from
outside. `triangle_mesh` makes shapes of scene dictionaries of them, without files.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from torchtransient.checks import Numbers, checked_mesh, count, positive, transform
from torchtransient.errors import SceneError
from torchtransient.scenes.parts import SceneDict, diffuse
from torchtransient.scenes.transforms import Matrix, Triple

Vertices = NDArray[np.float64]
Faces = NDArray[np.int64]
Mesh = tuple[Vertices, Faces]
Albedo: TypeAlias = "float | Numbers"
# Corners of its triangles, wound outward.
_ICOSAHEDRON = (
    (5, 1, 0), (0, 1, 7), (11, 5, 0), (0, 7, 10), (0, 10, 11), (1, 5, 9), (8, 7, 1), (9, 8, 1), (2, 3, 4), (6, 3, 2),
    (2, 4, 11), (10, 6, 2), (11, 10, 2), (9, 4, 3), (3, 6, 8), (3, 8, 9), (9, 5, 4), (4, 5, 11), (6, 7, 8), (10, 7, 6),
)  # fmt: skip


def triangle_mesh(vertices: Any, faces: Any, *, reflectance: Albedo = 0.5, to_world: Matrix | None = None) -> SceneDict:
    """Return a diffuse shape of a scene dictionary, `mesh_arrays`.

    Its key `<name>.vertex_positions` is a parameter of the scene, (V, 3) in world space.

    Args:
        vertices: (V, 3), metres.
        faces: (F, 3).
        reflectance: albedo, one number or three of linear sRGB.
        to_world: transform (4, 4).

    Raises:
        ShapeError: for other shapes and for faces of missing vertices.
        UnitError: for vertices that are not finite and albedos outside of [0, 1].
    """
    points, triangles = checked_mesh("triangle_mesh", vertices, faces)
    shape: SceneDict = {
        "type": "mesh_arrays",
        "vertices": points,
        "faces": triangles,
        "bsdf": diffuse(reflectance),
    }
    if to_world is not None:
        shape["to_world"] = transform("triangle_mesh: to_world", to_world)
    return shape


def joined(*meshes: Mesh) -> Mesh:
    """Several meshes as one; their triangles keep their order."""
    vertices, faces, start = [], [], 0
    for points, triangles in meshes:
        vertices.append(points)
        faces.append(triangles + start)
        start += len(points)
    return np.concatenate(vertices), np.concatenate(faces)


def plate(width: float, height: float, center: Triple = (0.0, 0.0, 0.0), cells: int = 1) -> Mesh:
    """Return a rectangle across z that faces -z, of `cells` x `cells` pairs of triangles.

    Args:
        width: width of the rectangle, metres.
        height: height of the rectangle, metres.
        center: centre (3,), metres.
        cells: number of pairs of triangles along a side.
    """
    n = count("cells", cells)
    x = np.linspace(-0.5, 0.5, n + 1) * positive("width", width)
    y = np.linspace(-0.5, 0.5, n + 1) * positive("height", height)
    rows, columns = np.meshgrid(y, x, indexing="ij")
    vertices = np.stack([columns, rows, np.zeros_like(rows)], axis=-1).reshape(-1, 3) + np.asarray(center)
    i = np.arange(n * (n + 1)).reshape(n, n + 1)[:, :n].ravel()
    lower, upper = np.stack([i, i + n + 1, i + 1], axis=1), np.stack([i + 1, i + n + 1, i + n + 2], axis=1)
    return vertices, np.concatenate([lower, upper])


def ellipsoid(center: Triple, radii: float | Triple, level: int = 3) -> Mesh:
    """Return a closed ellipsoid along the axes: an icosahedron whose triangles are split, all vertices on the surface.

    Args:
        center: centre (3,), metres.
        radii: one radius, or three (3,), metres.
        level: number of times that each triangle is split in four: 20 4^level triangles.
    """
    a, b = 1.0, (1 + 5**0.5) / 2
    corners = [[-a, b, 0], [a, b, 0], [-a, -b, 0], [a, -b, 0], [0, -a, b], [0, a, b], [0, -a, -b], [0, a, -b],
               [b, 0, -a], [b, 0, a], [-b, 0, -a], [-b, 0, a]]  # fmt: skip
    vertices, faces = np.array(corners, dtype=np.float64), np.array(_ICOSAHEDRON)
    for _ in range(_times("level", level)):
        vertices, faces = subdivided((vertices, faces))
        vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    return vertices * np.asarray(radii, dtype=np.float64) + np.asarray(center, dtype=np.float64), faces


def octahedral_ellipsoid(center: Triple, radii: float | Triple, level: int = 2) -> Mesh:
    """Return an :func:`ellipsoid` made of an octahedron: triangles that are less alike, cut in planes of the axes.

    Args:
        center: centre (3,), metres.
        radii: one radius, or three (3,), metres.
        level: number of times that each triangle is split in four: 8 4^level triangles.
    """
    corners = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=np.float64)
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    vertices, faces = subdivided((corners, faces), level)
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    return vertices * np.asarray(radii, dtype=np.float64) + np.asarray(center, dtype=np.float64), faces


def subdivided(mesh: Mesh, times: int = 1) -> Mesh:
    """Return a mesh whose triangles are split in four, with a vertex in the middle of every edge, which neighbours
    share.

    Args:
        mesh: vertices and faces.
        times: number of times to split, at most 8.
    """
    vertices, faces = mesh
    for _ in range(_times("subdivide", times)):
        edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        unique, place = np.unique(edges, axis=0, return_inverse=True)
        ab, bc, ca = len(vertices) + place.reshape(3, -1)
        vertices = np.concatenate([vertices, vertices[unique].mean(1)])
        a, b, c = faces.T
        parts = [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
        faces = np.concatenate([np.stack(part, axis=1) for part in parts])
    return vertices, faces


def sheet(outline: Any, z: float = 0.0) -> Mesh:
    """Return a flat polygon across z that faces -z.

    Args:
        outline: corners (x, y), (N, 2), against the clock, x to the right and y up; simple, not crossing itself.
        z: z coordinate of the polygon, metres.
    """
    points = np.asarray(outline, dtype=np.float64)
    faces = triangulated(points)[:, ::-1]
    return np.column_stack([points, np.full(len(points), float(z))]), faces.copy()


def solid(outline: Any, z: float, thickness: float) -> Mesh:
    """Return the closed body between `sheet` at `z` and the same polygon at `z + thickness`.

    Args:
        outline: corners (x, y), (N, 2), against the clock, see `sheet`.
        z: z coordinate of the front, metres.
        thickness: thickness of the body, metres.
    """
    front, faces = sheet(outline, z)
    n = len(front)
    back = front + np.array([0.0, 0.0, positive("thickness", thickness)])
    here, there = np.arange(n), (np.arange(n) + 1) % n
    sides = [np.stack([here, there, there + n], axis=1), np.stack([here, there + n, here + n], axis=1)]
    return np.concatenate([front, back]), np.concatenate([faces, faces[:, ::-1] + n, *sides])


# More halvings of all edges make meshes of many millions of triangles.
_MOST_TIMES = 8


def _times(name: str, value: int) -> int:
    times = count(name, value, least=0)
    if times > _MOST_TIMES:
        raise SceneError(f"{name}: expected at most {_MOST_TIMES}, got {times}: each makes four triangles of one.")
    return times


def triangulated(outline: Vertices) -> Faces:
    """Return triangles (N - 2, 3) of a simple polygon, by cutting ears (Meisters 1975).

    Args:
        outline: corners (N, 2), against the clock.

    Raises:
        SceneError: for an outline with the clock or without an area, and one of which no ear can be cut.
    """
    x, y = outline.T
    if not float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum()) > 0:
        raise SceneError("outline: expected corners against the clock, with x to the right and y up")
    left, triangles = list(range(len(outline))), []
    while len(left) > 3:
        for k in range(len(left)):
            before, corner, after = left[k - 1], left[k], left[(k + 1) % len(left)]
            others = outline[[i for i in left if i not in (before, corner, after)]]
            if _is_ear(outline[before], outline[corner], outline[after], others):
                triangles.append((before, corner, after))
                del left[k]
                break
        else:
            raise SceneError("outline: expected corners against the clock, of a polygon that does not touch itself")
    return np.array([*triangles, tuple(left)], dtype=np.int64)


def _is_ear(a: Vertices, b: Vertices, c: Vertices, others: Vertices) -> bool:
    if not _turn(a, b, c) > 0:
        return False
    inside = (_turn(a, b, others) >= 0) & (_turn(b, c, others) >= 0) & (_turn(c, a, others) >= 0)
    return not bool(np.any(inside))


def _turn(a: Vertices, b: Vertices, c: Vertices) -> Any:
    return (b[0] - a[0]) * (c[..., 1] - a[1]) - (b[1] - a[1]) * (c[..., 0] - a[0])
