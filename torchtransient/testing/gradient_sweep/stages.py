"""The scenes of the sweep: where a plugin stands so that its parameters matter and no silhouette moves.

Plain data, lengths in metres. What could move is wider than the view, and nothing that has an edge in view hides
something else.
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


def plate_pose(tilt: float = 8.0) -> Matrix:
    return turn(1, tilt) @ stretch(30.0)


def shining_wall(pose: Matrix, radiance: float) -> Description:
    emitter = {"type": "area", "radiance": radiance}
    return {"type": "rectangle", "to_world": pose, "bsdf": matte(), "emitter": emitter}


# ------------------------------------------------------------------------------------------------------------ scenes


def between_lights(bsdf: Description, depth: int = 4) -> Description:
    """A tilted plate without a rim in reach between two shining walls: it matters what it reflects and what it lets
    through, in whichever direction.
    """
    front, back = move(0.4, 0.2, 5.0) @ turn(1, 180) @ stretch(5.0), move(-0.3, -0.2, -2.0) @ stretch(5.0)
    return {
        "type": "scene",
        "integrator": path(depth),
        "sensor": camera(),
        "lamp": {"type": "point", "position": [0.8, 0.5, 3.0], "intensity": 10.0},
        "front": shining_wall(front, 1.0),
        "back": shining_wall(back, 0.7),
        "plate": {"type": "rectangle", "to_world": plate_pose(), "bsdf": bsdf},
    }


def in_a_group(bsdf: Description, depth: int = 4) -> Description:
    """The same plate as the copy of a group."""
    scene = between_lights(bsdf, depth)
    plate = scene.pop("plate") | {"to_world": stretch(30.0)}
    group = {"type": "shapegroup", "plate": plate}
    copy = {"type": "instance", "to_world": turn(1, 8), "group": {"type": "ref", "id": "group"}}
    return {**scene, "group": group, "copy": copy}
