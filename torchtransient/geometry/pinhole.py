"""Intrinsics and extrinsics of Mitsuba's perspective cameras, as kornia has them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Literal, get_args

import torch
from torch import Tensor

from torchtransient.checks import count, shown
from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.floating import holds, number_tensor, single, without_autocast

if TYPE_CHECKING:
    from kornia.geometry.camera import PinholeCamera

FovAxis = Literal["x", "y", "diagonal", "smaller", "larger"]
# From Mitsuba's camera, x to the left and y up, to kornia's, x to the right and y down; and back.
_HALF_TURN = (-1.0, -1.0, 1.0, 1.0)
# How far a turn times its transpose may be from one: single precision, after some products.
_RIGID = 1e-4


@without_autocast
def intrinsics(
    fov_deg: float | Tensor,
    size: Sequence[int],
    *,
    fov_axis: FovAxis = "x",
    principal_point_offset: Any = (0.0, 0.0),
    crop_offset: Sequence[int] = (0, 0),
) -> Tensor:
    """Return the camera matrix of a `perspective` or `thinlens` sensor, in pixels.

    Pixels are square. The first pixel's centre is (0, 0). Half precision is computed in float32 and given back. Values
    are not checked inside of `torch.func.vmap` and `torch.compile`.

    Args:
        fov_deg: angle of view along `fov_axis`, degrees, 0 to 180; a tensor (...) keeps its gradient (`x_fov` of a
            scene is along "x").
        size: (height, width) of the whole film.
        fov_axis: "x", "y", "diagonal", "smaller" or "larger".
        principal_point_offset: Mitsuba's `principal_point_offset_x` and `_y`, shares of the film's width and height by
            which the axis goes to the left and up, (2,) or (..., 2).
        crop_offset: `crop_offset_x` and `_y` of a film with a crop window, in pixels; the matrix is that of the window.

    Returns:
        (3, 3), or (..., 3, 3) of angles (...).

    Raises:
        UnitError, ShapeError, ArgumentError: for other arguments.
    """
    where = "intrinsics"
    height, width = image_size(size, where)
    if fov_axis not in get_args(FovAxis):
        raise ArgumentError(f"{where}: expected fov_axis among {', '.join(get_args(FovAxis))}, got {shown(fov_axis)}.")
    given = _numbers(fov_deg, "fov_deg", where)
    fov = single(given)
    if not holds((fov > 0) & (fov < 180)):
        raise UnitError(f"{where}: expected an angle of view between 0 and 180 degrees, got {shown(fov_deg)}.")
    offset = _numbers(principal_point_offset, "principal_point_offset", where).to(fov)
    if offset.shape[-1:] != (2,) or not holds(torch.isfinite(offset)):
        got = shown(principal_point_offset)
        raise ShapeError(f"{where}: expected principal_point_offset as two finite numbers, got {got}.")
    pair = list(crop_offset) if isinstance(crop_offset, Iterable) and not isinstance(crop_offset, str) else []
    if len(pair) != 2:
        raise ShapeError(f"{where}: expected crop_offset as (x, y), got {shown(crop_offset)}.")
    crop = [count(f"{where}: crop_offset", one, 0) for one in pair]
    spans = {"x": width, "y": height, "diagonal": math.hypot(width, height)}
    spans |= {"smaller": min(width, height), "larger": max(width, height)}
    focal = spans[fov_axis] / 2 / torch.tan(torch.deg2rad(fov) / 2)
    centre_u = width / 2 - 0.5 - crop[0] - offset[..., 0] * width
    centre_v = height / 2 - 0.5 - crop[1] - offset[..., 1] * height
    focal, centre_u, centre_v = torch.broadcast_tensors(focal, centre_u, centre_v)  # type: ignore[no-untyped-call]
    none, one = torch.zeros_like(focal), torch.ones_like(focal)
    rows = [focal, none, centre_u, none, focal, centre_v, none, none, one]
    return torch.stack(rows, -1).reshape(*none.shape, 3, 3).to(given.dtype)


@without_autocast
def extrinsics(to_world: Any) -> Tensor:
    """Return the transform from the world to kornia's camera.

    Args:
        to_world: pose (..., 4, 4) of a sensor, a rigid motion.

    Raises:
        ShapeError, UnitError: for other transforms.
    """
    matrix = _rigid(to_world, "extrinsics")
    return _half_turn(matrix)[:, None] * _back(matrix)


@without_autocast
def to_world_from_extrinsics(extrinsics: Any) -> Tensor:
    """Return a sensor's `to_world` of the transform from the world to kornia's camera.

    Args:
        extrinsics: (..., 4, 4), a rigid motion.

    Raises:
        ShapeError, UnitError: for other transforms.
    """
    matrix = _rigid(extrinsics, "to_world_from_extrinsics")
    return _back(matrix) * _half_turn(matrix)


@without_autocast
def camera_to_world(to_world: Any) -> Tensor:
    """Return the transform (..., 4, 4) from kornia's camera to the world, the inverse of `extrinsics`.

    Args:
        to_world: pose (..., 4, 4) of a sensor.
    """
    matrix = transforms(to_world, "camera_to_world")
    return matrix * _half_turn(matrix)


@without_autocast
def pinhole_camera(camera_matrix: Tensor, to_world: Any, size: Sequence[int]) -> PinholeCamera:
    """Return a `kornia.geometry.PinholeCamera`, a batch of one or more, whose `project` and `unproject` take points of
    the world and pixels.

    Args:
        camera_matrix: intrinsics (..., 3, 3).
        to_world: pose (..., 4, 4) of the sensor.
        size: (height, width) of the image.

    Raises:
        ShapeError: for other shapes.
    """
    from kornia.geometry.camera import PinholeCamera

    height, width = image_size(size, "pinhole_camera")
    matrix = camera_matrices(camera_matrix, "pinhole_camera")
    outside = extrinsics(to_world).to(matrix.device, matrix.dtype)
    inside = torch.nn.functional.pad(matrix, (0, 1, 0, 1)) + torch.diag(matrix.new_tensor([0.0, 0.0, 0.0, 1.0]))
    both = torch.broadcast_tensors(inside, outside)  # type: ignore[no-untyped-call]
    inside, outside = (one.reshape(-1, 4, 4) for one in both)
    full = matrix.new_ones(inside.shape[0])
    return PinholeCamera(inside, outside, full * height, full * width)


# ------------------------------------------------------------------------------------------------------------- checks


def camera_matrices(given: Any, where: str) -> Tensor:
    """Return camera matrices (..., 3, 3).

    Args:
        given: numbers of any library.
        where: subject of messages.

    Raises:
        ShapeError: for other shapes and for matrices without an inverse.
    """
    matrix = _numbers(given, "intrinsics", where)
    if matrix.ndim < 2 or matrix.shape[-2:] != (3, 3):
        raise ShapeError(f"{where}: expected intrinsics (..., 3, 3), got {tuple(matrix.shape)}.")
    if not holds(torch.linalg.det(matrix.detach().double()).abs() > 0):
        raise ShapeError(f"{where}: expected intrinsics with an inverse, got {shown(given)}.")
    return matrix


def transforms(given: Any, where: str) -> Tensor:
    """Return transforms (..., 4, 4).

    Args:
        given: numbers of any library, or a transform of Mitsuba.
        where: subject of messages.

    Raises:
        ShapeError: for other shapes.
    """
    matrix = _numbers(getattr(given, "matrix", given), "to_world", where)
    if matrix.ndim < 2 or matrix.shape[-2:] != (4, 4):
        raise ShapeError(f"{where}: expected a transform (..., 4, 4), got {tuple(matrix.shape)}.")
    return matrix


def _rigid(given: Any, where: str) -> Tensor:
    """Return transforms whose inverse is their transpose. Raises UnitError for scales, shears and mirrors."""
    matrix = transforms(given, where)
    known = matrix.detach().double()
    turn, last = known[..., :3, :3], known.new_tensor([0.0, 0.0, 0.0, 1.0])
    off = (turn @ turn.mT - torch.eye(3, dtype=turn.dtype, device=turn.device)).abs()
    near = off.amax((-2, -1)) < max(_RIGID, 4 * torch.finfo(matrix.dtype).eps)
    right = near & (torch.linalg.det(turn) > 0) & (known[..., 3, :] == last).all(-1)
    if not holds(right):
        raise UnitError(
            f"{where}: expected a rigid motion (turn and shift), got {shown(given)}. Take scales and mirrors out of "
            "the camera's to_world first."
        )
    return matrix


def _back(matrix: Tensor) -> Tensor:
    """Return the inverse of a rigid motion."""
    exact = single(matrix)
    rotation = exact[..., :3, :3].mT
    back = torch.cat([rotation, -(rotation @ exact[..., :3, 3:])], -1)
    return torch.cat([back, exact[..., 3:, :]], -2).to(matrix.dtype)


def _numbers(given: Any, name: str, where: str) -> Tensor:
    """Return a floating tensor; float32 of numbers and whole numbers, float64 of arrays of such."""
    numbers = number_tensor(given, f"{where}: expected {name} as numbers")
    return numbers if numbers is given or "float64" in str(getattr(given, "dtype", "")) else numbers.float()


def _half_turn(like: Tensor) -> Tensor:
    return torch.tensor(_HALF_TURN, dtype=like.dtype, device=like.device)


def image_size(size: Any, where: str) -> tuple[int, int]:
    """Return (height, width).

    Args:
        size: two whole numbers.
        where: subject of messages.

    Raises:
        ShapeError: for anything else.
    """
    numbers = list(size) if isinstance(size, Sequence) and not isinstance(size, str) else []
    if len(numbers) != 2:
        raise ShapeError(f"{where}: expected size as (height, width), got {shown(size)}.")
    height, width = (count(f"{where}: size", one, 1, ShapeError) for one in numbers)
    return height, width
