"""The scenes of the sweep: where a plugin stands so that its parameters matter and no silhouette moves.

Plain data, lengths in metres. What could move is wider than the view, and nothing that has an edge in view hides
something else. Captures around a corner, whose outlines may move, are in :mod:`.scans`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
Description = dict[str, Any]


# ------------------------------------------------------------------------------------------------------------- poses


def move(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Matrix:
    """A translation."""
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def turn(axis: int, degrees: float) -> Matrix:
    """A rotation about the axis of that number."""
    a, (i, j) = np.radians(degrees), [(1, 2), (2, 0), (0, 1)][axis]
    matrix = np.eye(4)
    matrix[i, i] = matrix[j, j] = np.cos(a)
    matrix[i, j], matrix[j, i] = -np.sin(a), np.sin(a)
    return matrix


def stretch(x: float, y: float | None = None, z: float | None = None) -> Matrix:
    """A scaling, by ``x`` in the directions that are not given."""
    return np.diag([x, x if y is None else y, x if z is None else z, 1.0])


def look(origin: Sequence[float], target: Sequence[float] = (0.0, 0.0, 0.0)) -> Matrix:
    """The pose of a sensor or light at ``origin`` that faces ``target``, with y upwards."""
    position, aim = np.asarray(origin, dtype=np.float64), np.asarray(target, dtype=np.float64)
    forward = (aim - position) / np.linalg.norm(aim - position)
    left = np.cross([0.0, 1.0, 0.0], forward)
    left /= np.linalg.norm(left)
    matrix = np.eye(4)
    matrix[:3] = np.stack([left, np.cross(forward, left), forward, position], axis=1)
    return matrix


# ------------------------------------------------------------------------------------------------------------- parts


def film(start: float = 3.0, bins: int = 400, width: float = 0.04) -> Description:
    """A small film. The Gaussian has no corners, over which finite differences would differ from derivatives."""
    return {
        "type": "transient_hdr_film",
        "temporal_bins": bins,
        "start_opl": start,
        "bin_width_opl": width,
        "temporal_filter": "gaussian",
        "gaussian_stddev": 1.0,
        "width": 4,
        "height": 4,
        "rfilter": {"type": "box"},
    }


def camera(origin: Sequence[float] = (0.3, 0.0, 3.0), fov: float = 10.0, **film_arguments: Any) -> Description:
    """A perspective camera that faces the origin."""
    return {
        "type": "perspective",
        "fov": fov,
        "near_clip": 0.05,
        "to_world": look(origin),
        "film": film(**film_arguments),
        "sampler": {"type": "independent"},
    }


def path(depth: int = 4) -> Description:
    return {"type": "transient_path", "max_depth": depth, "rr_depth": 100}


def matte(reflectance: float = 0.5) -> Description:
    return {"type": "diffuse", "reflectance": reflectance}


def plate_pose(half: float = 30.0) -> Matrix:
    return turn(1, 8.0) @ stretch(half)


def fading(value: float, texels: int = 16) -> Description:
    """Return a texture that fades to zero at its rim: its edge is dark in every mirror."""
    along = np.linspace(-1.0, 1.0, texels) ** 2
    data = value * np.outer(1 - along, 1 - along)[..., None].astype(np.float32)
    return {"type": "bitmap", "data": data, "raw": True, "wrap_mode": "clamp"}


def shining_wall(pose: Matrix, radiance: float) -> Description:
    """A wall that shines and scatters, most in its middle."""
    emitter = {"type": "area", "radiance": fading(radiance)}
    return {
        "type": "rectangle",
        "to_world": pose @ stretch(5.0),
        "bsdf": {"type": "diffuse", "reflectance": fading(0.6)},
        "emitter": emitter,
    }


def moving(scene: Description, body: str) -> Description:
    """A scene one of whose bodies has a velocity, before a film of rates."""
    motion = {
        "type": "rigid_motion", "of": body,
        "linear": [0.6, -0.4, 1.1], "angular": [0.3, 0.5, -0.2], "center": [0.4, -0.6, 0.8],
    }  # fmt: skip
    return {**scene, "velocity": motion, "sensor": with_rates(scene["sensor"])}


def with_rates(sensor: Description) -> Description:
    """A sensor with a film of rates, of wider bins of the optical path length."""
    bins = {"temporal_bins": 100, "bin_width_opl": 0.16, "gaussian_stddev": 0.5}
    rates = {"type": "rate_hdr_film", "rate_start": -8.0, "rate_width": 0.5, "rate_bins": 32}
    return {**sensor, "film": sensor["film"] | bins | rates}


# ------------------------------------------------------------------------------------------------------------ scenes


_FRONT, _BACK = move(0.4, 0.2, 5.0) @ turn(1, 180), move(-0.3, -0.2, -2.0)


def between_lights(bsdf: Description, grazing: bool = False) -> Description:
    """A tilted plate without a rim in reach between two shining walls: it matters what it reflects and what it lets
    through, in whichever direction. ``grazing``: seen and lit from opposite sides at grazing angles, close to those of
    the mirror.
    """
    return {
        "type": "scene",
        "integrator": path(4),
        "sensor": camera((-2.9, 0.0, 1.2), fov=4.0) if grazing else camera(),
        "lamp": {"type": "point", "position": [3.0, 0.1, 0.3] if grazing else [0.8, 0.5, 3.0], "intensity": 10.0},
        "front": shining_wall(_FRONT, 1.0),
        "back": shining_wall(_BACK, 0.7),
        "plate": {"type": "rectangle", "to_world": plate_pose(), "bsdf": bsdf},
    }


def grouped(scene: Description, pose: Matrix | None = None) -> Description:
    """A scene whose plate is the copy of a group; ``pose``: of the copy, which otherwise does what the plate's did."""
    plate = scene["plate"]
    if pose is None:
        plate, pose = plate | {"to_world": stretch(30.0)}, turn(1, 8)
    group = {"type": "shapegroup", "plate": plate}
    copy = {"type": "instance", "to_world": pose, "group": {"type": "ref", "id": "group"}}
    return {**{name: part for name, part in scene.items() if name != "plate"}, "group": group, "copy": copy}


def polarizing_sheet() -> Description:
    """A polarizer behind the plate."""
    pose = move(z=-1.0) @ stretch(30.0)
    return {"type": "rectangle", "to_world": pose, "bsdf": {"type": "polarizer", "theta": 15.0}}


def lit_by(lamp: Description, distant: bool = False) -> Description:
    """A plate under a lamp, and a panel beside it that both light. ``distant``: the light comes from the sphere around
    the scene, which is kept small.
    """
    panel = move(1.6, 0.0, 1.2) @ turn(1, -60) @ stretch(0.4)
    return {
        "type": "scene",
        "integrator": path(4),
        "sensor": camera(bins=800),
        "panel": {"type": "rectangle", "to_world": panel, "bsdf": matte(0.7)},
        "plate": {"type": "rectangle", "to_world": plate_pose(5.0 if distant else 30.0), "bsdf": matte()},
        "lamp": lamp,
    }


def seen_by(sensor: Description) -> Description:
    """A plate under a lamp, before some sensor. One that a shape carries hides nothing: the lamp is before it."""
    on_a_shape = "sensor" in sensor
    scene = lit_by({"type": "point", "position": [0.8, 0.5, 1.0 if on_a_shape else 3.0], "intensity": 10.0})
    del scene["panel"]
    return {**scene, "sensor": sensor, "integrator": path(2 if on_a_shape else 4)}


def filled(medium: Description) -> Description:
    """A slab of medium, wider than the view, between a plate and a camera with a lamp and a shining wall behind it."""
    scene = lit_by({"type": "point", "position": [0.8, 0.5, 3.0], "intensity": 10.0})
    del scene["panel"]
    scene["integrator"] = {"type": "transient_prbvolpath", "max_depth": 3, "rr_depth": 100}
    scene["front"] = shining_wall(_FRONT, 1.0)
    scene["slab"] = {
        "type": "cube",
        "to_world": move(0.0, 0.0, 1.25) @ stretch(20.0, 20.0, 0.75),
        "bsdf": {"type": "null"},
        "interior": medium,
    }
    return scene
