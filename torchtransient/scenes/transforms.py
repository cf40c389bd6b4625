"""Affine transforms as float64 arrays of shape (4, 4), column vectors, in Mitsuba's conventions.

They need no Mitsuba variant, pickle, and compose with `@`: `translate(t) @ rotate(axis, angle) @ scale(s)` scales
first, as `mi.ScalarTransform4f().translate(t).rotate(axis, angle).scale(s)` does.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from torchtransient.checks import finite, real_array, shown
from torchtransient.errors import SceneError, ShapeError

Matrix = NDArray[np.float64]
Triple = Sequence[float] | NDArray[np.float64]


def _triple(name: str, values: Triple) -> NDArray[np.float64]:
    array = real_array(values)
    if array is None or array.shape != (3,):
        raise ShapeError(f"{name}: expected three numbers, got {shown(values)}; pass [x, y, z]")
    if not np.all(np.isfinite(array)):
        raise SceneError(f"{name}: expected finite numbers, got {array.tolist()}")
    return array


def translate(offset: Triple) -> Matrix:
    """Return a shift (4, 4).

    Args:
        offset: offset (3,), metres.

    Raises:
        ShapeError: unless it has three numbers.
    """
    matrix = np.eye(4)
    matrix[:3, 3] = _triple("translate", offset)
    return matrix


def scale(factor: float | Triple) -> Matrix:
    """Return a scaling (4, 4) about the origin.

    Args:
        factor: factor of all axes, or one per axis (3,).

    Raises:
        SceneError: for a zero factor, which has no inverse: Mitsuba inverts every transform.
    """
    alone = real_array(factor)
    factors = np.full(3, alone) if alone is not None and alone.ndim == 0 else _triple("scale", factor)  # type: ignore[arg-type]
    if np.any(factors == 0) or not np.all(np.isfinite(factors)):
        raise SceneError(f"scale: expected finite factors other than zero, got {factors.tolist()}")
    return np.diag([*factors, 1.0])


def rotate(axis: Triple, angle_deg: float) -> Matrix:
    """Return a right-handed rotation (4, 4) about an axis through the origin, by Rodrigues' formula.

    Args:
        axis: axis of rotation (3,), of any length.
        angle_deg: angle of rotation, degrees.

    Raises:
        SceneError: for a zero axis.
    """
    direction = _triple("rotate", axis)
    length = np.linalg.norm(direction)
    if length == 0:
        raise SceneError("rotate: expected an axis with a direction, got [0, 0, 0]")
    x, y, z = direction / length
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = np.deg2rad(finite("rotate: angle_deg", angle_deg))
    matrix = np.eye(4)
    matrix[:3, :3] += np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)
    return matrix


def look_at(origin: Triple, target: Triple, up: Triple = (0.0, 1.0, 0.0)) -> Matrix:
    """Return a frame (4, 4) whose local +z looks at a target, local +y as near to `up` as possible.

    Local +x points to the *left* of the view, as Mitsuba's cameras expect.

    Args:
        origin: place of the viewer (3,), metres.
        target: point to look at (3,), metres.
        up: upward direction (3,), of any length.

    Raises:
        SceneError: if origin and target coincide or `up` is parallel to the view.
    """
    eye = _triple("look_at origin", origin)
    forward = _triple("look_at target", target) - eye
    distance = np.linalg.norm(forward)
    if distance == 0:
        raise SceneError(f"look_at: origin and target are the same point {eye.tolist()}; move one of them")
    forward = forward / distance
    left = np.cross(_triple("look_at up", up), forward)
    length = np.linalg.norm(left)
    if length < 1e-12:
        raise SceneError(f"look_at: up {list(map(float, up))} is parallel to the view; choose another up direction")
    left = left / length
    matrix = np.eye(4)
    matrix[:3, 0] = left
    matrix[:3, 1] = np.cross(forward, left)
    matrix[:3, 2] = forward
    matrix[:3, 3] = eye
    return matrix
