"""Every shape plugin that moves: before a background, as what casts a shadow, and seen from another surface alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tools.boundary_cases.moving_edges import (
    Array,
    Description,
    Direction,
    MovingEdge,
    far_area,
    grown,
    indirect,
    mesh,
    moved,
    paint,
    scene,
    shadow,
    turned,
)
from torchtransient.scenes import rotate, scale, translate

Parts = dict[str, Description]
# Where the body is, and half its size, in metres.
_PLACES = {"primary": ([-0.2, 0.1, 1.2], 0.45), "shadow": ([0.9, 0.35, 1.6], 0.25), "surface": ([1.0, 0.0, 0.7], 0.3)}
PLACES = tuple(_PLACES)
CHANGES = ("translate", "turn", "grow")
_PAINT = paint(0.4)
# By a unit of x: metres, and degrees about the axes.
_SHIFT, _TURN = (0.6, -0.5, 0.6), (60.0, 90.0, 30.0)


@dataclass(frozen=True)
class Body:
    """A shape that moves: parts of a scene by center, half of its size and a folder for files; the key of its pose or
    points; and how these are translated, turned and grown.
    """

    parts: Callable[[list[float], float, Path], Parts]
    key: str
    changes: dict[str, Direction]


_POSE: dict[str, Direction] = {
    "translate": moved(*_SHIFT),
    "turn": turned(*_TURN),
    "grow": grown,
}


def _rows(width: int, places: Callable[[Array], Array], others: Callable[[Array], Array] = np.zeros_like) -> Direction:
    """A change of points in rows of numbers that begin with their three coordinates."""

    def direction(value: Array) -> Array:
        rows = value.reshape(-1, width)
        change = np.concatenate([places(rows[:, :3]), others(rows[:, 3:])], 1)
        return change.reshape(value.shape)

    return direction


def _about(points: Array) -> Array:
    return np.asarray(points - points.mean(0))


def _turned_points(points: Array) -> Array:
    return np.cross(np.radians(_TURN), _about(points))


def _shifted_points(points: Array) -> Array:
    return np.broadcast_to(_SHIFT, points.shape)


def _points(width: int = 3, others: Callable[[Array], Array] = np.zeros_like) -> dict[str, Direction]:
    """Changes of points, of which growing is one that is not a similarity."""
    return {
        "translate": _rows(width, _shifted_points),
        "turn": _rows(width, _turned_points),
        "grow": _rows(width, lambda p: _about(p) * np.array([1.0, 0.5, 0.2]), others),
    }


def _pose(center: list[float], size: float) -> Array:
    turn = rotate([0, 1, 0], 25) @ rotate([1, 0, 0], 20) @ rotate([0, 0, 1], 20)
    return translate(center) @ turn @ scale([size, 0.8 * size, 0.7 * size])


def _posed(plugin: str) -> Callable[[list[float], float, Path], Parts]:
    return lambda center, size, _: {"body": {"type": plugin, "to_world": _pose(center, size), "bsdf": _PAINT}}


def _octahedron(center: list[float], size: float, _: Path) -> Parts:
    corners = np.concatenate([np.eye(3), -np.eye(3)])
    faces = [[i, j, k] if (i < 3) ^ (j < 3) ^ (k < 3) else [i, k, j] for i in (0, 3) for j in (1, 4) for k in (2, 5)]
    placed = corners @ _pose(center, size)[:3, :3].T + center
    return {"body": mesh(placed, faces, _PAINT)}


def _ball(center: list[float], size: float, _: Path) -> Parts:
    return {"body": {"type": "sphere", "center": center, "radius": size, "bsdf": _PAINT}}


def _cylinder(center: list[float], size: float, _: Path) -> Parts:
    along = size * np.array([0.3, 0.9, 0.2])
    ends = {"p0": (center - along).tolist(), "p1": (center + along).tolist()}
    return {"body": {"type": "cylinder", **ends, "radius": 0.4 * size, "bsdf": _PAINT}}


def _instance(center: list[float], size: float, _: Path) -> Parts:
    one = {"type": "cube", "to_world": _pose([0.0, 0.0, 0.0], size), "bsdf": _PAINT}
    copy = {"type": "instance", "to_world": translate(center), "shapegroup": {"type": "ref", "id": "group"}}
    return {"group": {"type": "shapegroup", "one": one}, "body": copy}


def _curve(plugin: str) -> Callable[[list[float], float, Path], Parts]:
    def parts(center: list[float], size: float, folder: Path) -> Parts:
        s = np.linspace(-1.5, 1.5, 7)
        places = center + size * np.stack([0.3 * s + 0.1 * np.sin(3 * s), 0.9 * s, 0.2 * s], 1)
        path = folder / f"{plugin}_{size}.txt"
        lines = [" ".join(f"{x:.6f}" for x in (*place, 0.3 * size)) for place in places]
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return {"body": {"type": plugin, "filename": str(path), "bsdf": _PAINT}}

    return parts


def _distances(center: list[float], size: float, _: Path) -> Parts:
    x = np.stack(np.meshgrid(*[np.linspace(-1, 1, 8)] * 3, indexing="ij"), -1)
    grid = (np.linalg.norm(x * [1.0, 1.2, 1.4], axis=-1) - 0.7)[..., None].astype(np.float32)
    pose = translate(np.asarray(center) - size) @ scale(2 * size)
    return {"body": {"type": "sdfgrid", "grid": grid, "to_world": pose, "bsdf": _PAINT}}


def _ellipsoid(plugin: str) -> Callable[[list[float], float, Path], Parts]:
    def parts(center: list[float], size: float, _: Path) -> Parts:
        form = {"scales": size / 3 * np.array([[1.0, 0.8, 0.6]]), "quaternions": np.array([[0.1, 0.2, 0.0, 0.97]])}
        return {"body": {"type": plugin, "centers": np.array([center]), **form, "bsdf": _PAINT}}

    return parts


def _blob_changes() -> dict[str, Direction]:
    def at(places: slice, values: list[float]) -> Direction:
        def direction(value: Array) -> Array:
            change = np.zeros(value.size)
            change[places] = values
            return change.reshape(value.shape)

        return direction

    shift, turn, grow = slice(0, 3), slice(6, 10), slice(3, 6)
    return {
        "translate": at(shift, list(_SHIFT)),
        "turn": at(turn, [0.6, 0.8, 0.4, 0.0]),
        "grow": at(grow, [0.1, 0.08, 0.06]),
    }


BODIES: dict[str, Body] = {
    "rectangle": Body(_posed("rectangle"), "body.to_world", _POSE),
    "disk": Body(_posed("disk"), "body.to_world", _POSE),
    "cube": Body(_posed("cube"), "body.vertex_positions", _points()),
    "cube by its pose": Body(_posed("cube"), "body.to_world", _POSE),
    "mesh": Body(_octahedron, "body.vertex_positions", _points()),
    "sphere": Body(_ball, "body.to_world", _POSE),
    "cylinder": Body(_cylinder, "body.to_world", _POSE),
    "instance": Body(_instance, "body.to_world", _POSE),
    "linearcurve": Body(_curve("linearcurve"), "body.control_points", _points(4, lambda r: r)),
    "bsplinecurve": Body(_curve("bsplinecurve"), "body.control_points", _points(4, lambda r: r)),
    "sdfgrid": Body(_distances, "body.to_world", _POSE),
    "ellipsoids": Body(_ellipsoid("ellipsoids"), "body.data", _blob_changes()),
    "ellipsoidsmesh": Body(_ellipsoid("ellipsoidsmesh"), "body.data", _blob_changes()),
}


def moving_shape(body: str, place: str, change: str, folder: Path) -> MovingEdge:
    """A case of the sweep. ``place``: one of ``PLACES``; ``change``: one of ``CHANGES``; ``folder``: for files that a
    shape reads.
    """
    center, size = _PLACES[place]
    found = BODIES[body]

    def make() -> Description:
        parts = found.parts(center, size, folder)
        if place == "primary":
            return scene(2, **parts)
        if place == "shadow":
            return shadow(far_area(), **parts)
        return {name: part for name, part in indirect().items() if name != "blk"} | parts

    return MovingEdge(make, found.key, found.changes[change], 0.004)
