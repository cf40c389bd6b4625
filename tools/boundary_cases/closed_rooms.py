"""Rooms in which walls or lamps move, seen by one pixel after many bounces. Plain data, lengths in metres."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from tools.boundary_cases.moving_edges import Array, Description, MovingEdge, mesh, moved, paint, rectangle
from torchtransient.scenes import look_at, rotate, scale, translate


def one_pixel(bins: int = 343, width: float = 0.1) -> Description:
    timing = {"temporal_bins": bins, "start_opl": 0.0, "bin_width_opl": width, "temporal_filter": "tent"}
    return {"type": "transient_hdr_film", "width": 1, "height": 1, "rfilter": {"type": "box"}, **timing}


def _view(origin: Sequence[float], target: Sequence[float], fov: float) -> Description:
    pose = look_at(origin, target, [0.0, 0.0, 1.0])
    return {"type": "perspective", "fov": fov, "near_clip": 1e-3, "to_world": pose, "film": one_pixel()}


def _deep(depth: int) -> Description:
    return {"type": "transient_path", "max_depth": depth, "rr_depth": 100000}


def closed_room(sensor: str, depth: int, lamp_radius: float = 0.2) -> Description:
    """5 x 4 x 3 m of albedo 0.7, lit by a sphere. ``sensor``: ``"meter"``, a small irradiance meter; ``"far"``, a
    camera that sees the wall at -x alone; ``"near"``, one that sees the edges of the wall at +x.
    """
    black = {"type": "diffuse", "reflectance": 0.0}
    meter = {"type": "irradiancemeter", "film": one_pixel()}
    sensors = {
        "meter": {"type": "sphere", "center": [1.2, -0.6, -0.2], "radius": 0.005, "bsdf": black, "sensor": meter},
        "far": _view([0.5, -0.6, -0.2], [-2.5, -1.0, -0.5], 12.0),
        "near": _view([-1.2, -0.6, -0.2], [2.5, 2.0, 0.2], 40.0),
    }
    lamp = {"type": "area", "radiance": 10.0 * (0.2 / lamp_radius) ** 2}
    walls = {"type": "cube", "flip_normals": True, "to_world": scale([2.5, 2.0, 1.5])}
    return {
        "type": "scene",
        "integrator": _deep(depth),
        "sensor": sensors[sensor],
        "room": walls | {"bsdf": {"type": "diffuse", "reflectance": 0.7}},
        "lamp": {"type": "sphere", "center": [-1.0, 0.5, 0.3], "radius": lamp_radius, "emitter": lamp},
    }


def wall_out(value: Array) -> Array:
    """The vertices (V, 3) of the wall at +x, outwards."""
    return np.outer(value[:, 0] > 2.4, [1.0, 0.0, 0.0])


def piston(depth: int) -> Description:
    """A wall that slides between walls that stand still."""
    base = translate([2.5, 0, 0]) @ rotate([0, 1, 0], -90) @ scale([1.5, 2, 1])
    left = translate([-2.5, 0, 0]) @ rotate([0, 1, 0], 90) @ scale([1.5, 2, 1])
    tube = {"type": "cube", "flip_normals": True, "to_world": scale([3.5, 2.0, 1.5]), "bsdf": paint(0.7)}
    return {
        "type": "scene",
        "integrator": _deep(depth),
        "sensor": _view([0.5, -0.6, -0.2], [-2.5, -1.0, -0.5], 12.0),
        "room": tube,
        "left": rectangle(left, paint(0.7)),
        "piston": rectangle(base, paint(0.7)),
        "source": {"type": "point", "position": [-1.0, 0.5, 0.3], "intensity": 1.0},
    }


def _tips(number: int = 12) -> Array:
    i, j = np.meshgrid(np.arange(number + 1), np.arange(number + 1), indexing="ij")
    inner = (i > 0) & (i < number) & (j > 0) & (j < number)
    return np.asarray(((i + j) % 2 == 1) & inner)


def pyramids(depth: int, angle: float = 30.0, direct: bool = False) -> Description:
    """A field of pyramids over a wall, whose border is fixed; seen ``direct``, or by way of the wall alone."""
    number, half = 12, 1.5
    size, odd = 2 * half / number, _tips(number)
    i, j = np.meshgrid(np.arange(number + 1), np.arange(number + 1), indexing="ij")
    z = 2.0 - size * np.tan(np.radians(angle)) * odd
    vertices = np.stack([i * size - half, j * size - half, z], -1).reshape(-1, 3)
    faces, tip = [], odd.reshape(-1)
    for row in range(number):
        for column in range(number):
            a, b = row * (number + 1) + column, (row + 1) * (number + 1) + column
            e, f = b + 1, a + 1
            # Diagonals join the neighbours of tips: others would be ridges.
            faces += [[a, f, b], [b, f, e]] if tip[b] or tip[f] else [[a, e, b], [a, f, e]]
    film = one_pixel(200, 0.05)
    pose = look_at([0.4, 0.3, 0.3], [0.3, 0.2, 2.0]) if direct else look_at([0.5, 0.3, 1.2], [0.6, 0.3, 0.0])
    return {
        "type": "scene",
        "integrator": _deep(depth),
        "sensor": {"type": "perspective", "fov": 20.0, "near_clip": 1e-3, "to_world": pose, "film": film},
        "wall": rectangle(scale([2.0, 2.0, 1.0]), paint(0.7)),
        "light": {"type": "point", "position": [-0.6, -0.2, 0.4], "intensity": 10.0},
        "body": mesh(vertices, faces, paint(0.8)),
    }


def tips_up(value: Array) -> Array:
    """The tips of the pyramids, along z."""
    return np.outer(_tips(), [0.0, 0.0, 1.0])


def _room(sensor: str, radius: float = 0.2) -> Callable[[int], MovingEdge]:
    return lambda depth: MovingEdge(
        lambda: closed_room(sensor, depth, radius), "room.vertex_positions", wall_out, 0.02, weights="arrival"
    )


# By depth.
ROOMS: dict[str, Callable[[int], MovingEdge]] = {
    "meter": _room("meter"),
    "far": _room("far"),
    "near": _room("near"),
    # A lamp that hides next to nothing.
    "far_small_lamp": _room("far", 0.02),
    "lamp": lambda depth: MovingEdge(
        lambda: closed_room("meter", depth), "lamp.to_world", moved(1.0, 0.0, 0.0), 0.02, weights="arrival"
    ),
    "piston": lambda depth: MovingEdge(
        lambda: piston(depth), "piston.to_world", moved(1.0, 0.0, 0.0), 0.01, weights="arrival"
    ),
    "pyramids": lambda depth: MovingEdge(
        lambda: pyramids(depth), "body.vertex_positions", tips_up, 0.002, weights="sine"
    ),
    "pyramids_direct": lambda depth: MovingEdge(
        lambda: pyramids(depth, direct=True), "body.vertex_positions", tips_up, 0.002, weights="sine"
    ),
}
