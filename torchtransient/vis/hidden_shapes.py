"""Hidden shapes as polygons to draw, given in any way that a simulation takes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.capture.wall import triple
from torchtransient.checks import checked_mesh, positive, shown, transform
from torchtransient.errors import SceneError

Array = NDArray[np.float64]

# Mitsuba's square and cube.
SQUARE = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
_CUBE = np.array([[x, y, z] for z in (-1.0, 1.0) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
_CUBE_FACES = ((0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))
# Sides of a circle, and rows of a sphere.
_SIDES, _ROWS = 32, 16


def hidden_polygons(hidden: Any, who: str) -> list[list[Array]]:
    """Of each hidden thing the corners (N, 3) of its faces, metres.

    ``hidden``: shapes of Mitsuba by name, a single one, (vertices (V, 3), faces (F, 3)), an object with both, or None.
    Nodes that a shape refers to are left out. Raises SceneError for other shapes than :data:`DRAWN`
    (mesh files among them) and for what is no shape; ShapeError and UnitError for meshes and transforms that are none.
    """
    if hidden is None:
        return []
    if isinstance(hidden, Mapping):
        if "type" in hidden and hidden["type"] != "scene":
            return [_of_shape("hidden", hidden, who)]
        shapes = {name: node for name, node in hidden.items() if name != "type"}
        used = set(_references(shapes))
        return [_of_shape(name, node, who) for name, node in shapes.items() if name not in used]
    if isinstance(hidden, (tuple, list)) and len(hidden) == 2:
        vertices, faces = hidden
        return [_of_mesh(vertices, faces, f"{who}: hidden")]
    if hasattr(hidden, "vertices") and hasattr(hidden, "faces"):
        return [_of_mesh(hidden.vertices, hidden.faces, f"{who}: hidden")]
    if isinstance(hidden, (str, PathLike)):
        raise SceneError(f"{who}: mesh files are not drawn, got {str(hidden)!r}. Give its (vertices, faces).")
    raise SceneError(
        f"{who}: expected hidden as shapes by name, a shape, (vertices, faces) or an object with both, got "
        f"{shown(hidden)}."
    )


def _of_shape(name: str, shape: Any, who: str) -> list[Array]:
    where = f"{who}: hidden {name!r}"
    if not isinstance(shape, Mapping) or "type" not in shape:
        raise SceneError(f"{where}: expected a dictionary with a type, got {shown(shape)}.")
    kind = shape["type"]
    if kind not in DRAWN:
        raise SceneError(f"{where}: shapes that are drawn are {', '.join(DRAWN)}, got {kind!r}. Leave it out.")
    matrix = transform(f"{where}: to_world", shape.get("to_world", np.eye(4)))
    return [points @ matrix[:3, :3].T + matrix[:3, 3] for points in DRAWN[kind](shape, where)]


def _references(nodes: Any) -> Iterator[str]:
    """Names that nodes refer to."""
    for node in nodes.values():
        if isinstance(node, Mapping):
            if node.get("type") == "ref":
                yield str(node.get("id"))
            yield from _references(node)


# -------------------------------------------------------------------------------------- faces of each shape, unplaced


def _of_mesh(vertices: Any, faces: Any, where: str) -> list[Array]:
    points, triangles = checked_mesh(where, vertices, faces)
    return list(points[triangles])


def _mesh(shape: Mapping[str, Any], where: str) -> Sequence[Array]:
    return _of_mesh(shape.get("vertices"), shape.get("faces"), where)


def _square(shape: Mapping[str, Any], where: str) -> Sequence[Array]:
    return [SQUARE]


def _cube(shape: Mapping[str, Any], where: str) -> Sequence[Array]:
    return list(_CUBE[np.array(_CUBE_FACES)])


def _circle(shape: Mapping[str, Any], where: str) -> Sequence[Array]:
    angle = np.arange(_SIDES) * 2 * np.pi / _SIDES
    return [np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)]


def _sphere(shape: Mapping[str, Any], where: str) -> Sequence[Array]:
    center = triple(f"{where}: center", shape.get("center", (0.0, 0.0, 0.0)))
    radius = positive(f"{where}: radius", shape.get("radius", 1.0))
    up, around = np.linspace(0, np.pi, _ROWS + 1)[:, None], np.linspace(0, 2 * np.pi, _SIDES + 1)[None]
    x, y, z = np.sin(up) * np.cos(around), np.sin(up) * np.sin(around), np.cos(up) + 0 * around
    return _cells(center + radius * np.stack([x, y, z], -1))


def _cylinder(shape: Mapping[str, Any], where: str) -> Sequence[Array]:
    begin = triple(f"{where}: p0", shape.get("p0", (0.0, 0.0, 0.0)))
    end = triple(f"{where}: p1", shape.get("p1", (0.0, 0.0, 1.0)))
    radius = positive(f"{where}: radius", shape.get("radius", 1.0))
    axis = end - begin
    aside = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    aside /= np.linalg.norm(aside) or 1.0
    other = np.cross(axis, aside) / (np.linalg.norm(axis) or 1.0)
    angle = np.linspace(0, 2 * np.pi, _SIDES + 1)[:, None]
    circle = radius * (np.cos(angle) * aside + np.sin(angle) * other)
    return _cells(np.stack([begin + circle, end + circle]))


def _cells(grid: Array) -> list[Array]:
    """The quadrilaterals (4, 3) of a grid of points (M, N, 3)."""
    corners = np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], 2)
    return list(corners.reshape(-1, 4, 3))


# Shapes that are drawn, by Mitsuba's name.
DRAWN: dict[str, Callable[[Mapping[str, Any], str], Sequence[Array]]] = {
    "mesh_arrays": _mesh, "rectangle": _square, "cube": _cube, "disk": _circle, "sphere": _sphere,
    "cylinder": _cylinder,
}  # fmt: skip
