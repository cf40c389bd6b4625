"""Rigid motions as six numbers: three of rotation (axis times angle, radians), three of translation (metres).

Matrices act on column vectors, as Mitsuba's `to_world`. Rotations are kornia's, which have derivatives at zero. The
exponential of SE(3) is not: kornia's turns tensors into parameters, which loses forward-mode tangents, and its Jacobian
of SO(3) has no second derivative at zero.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal, get_args

import torch
from torch import Tensor, nn

from torchtransient.errors import SceneError, ShapeError, UnitError
from torchtransient.parametrize.bounded import floating
from torchtransient.quantities import positive, real_array, shown

Frame = Literal["world", "local"]
# How far a matrix may be from a rotation: products of float32 with some hundred between the scales of a base.
_TOLERANCE = 1e-4


def pose_from_axis_angle(x: Tensor) -> Tensor:
    """(..., 4, 4) of (..., 6): turned about the origin by `x[..., :3]`, axis times angle in radians, right-handed, then
    moved by `x[..., 3:]`. Raises ShapeError.
    """
    from kornia.geometry.conversions import axis_angle_to_rotation_matrix

    x = _six(x, "pose_from_axis_angle")
    flat = x.reshape(-1, 6)
    return _assembled(axis_angle_to_rotation_matrix(flat[:, :3]), flat[:, 3:]).reshape(*x.shape[:-1], 4, 4)


def axis_angle_from_pose(pose: Tensor) -> Tensor:
    """(..., 6) of rigid motions (..., 4, 4), angles up to pi; the inverse of `pose_from_axis_angle`. At half a turn the
    sign of the axis is free, and derivatives jump. Raises ShapeError, UnitError for matrices that are no rigid motion.
    """
    return torch.cat([_rotation_vector(pose, "axis_angle_from_pose"), pose[..., :3, 3]], -1)


def pose_from_twist(x: Tensor) -> Tensor:
    """Exponential of SE(3), (..., 4, 4) of (..., 6): `x[..., :3]` the rotation (axis times angle, radians),
    `x[..., 3:]` the translation per unit of time of a screw motion, at time 1. Raises ShapeError.
    """
    from kornia.geometry.conversions import axis_angle_to_rotation_matrix

    x = _six(x, "pose_from_twist")
    flat = x.reshape(-1, 6)
    turn = flat[:, :3]
    shift = (_jacobian(turn) @ flat[:, 3:, None])[..., 0]
    return _assembled(axis_angle_to_rotation_matrix(turn), shift).reshape(*x.shape[:-1], 4, 4)


def twist_from_pose(pose: Tensor) -> Tensor:
    """Logarithm of SE(3), (..., 6) of rigid motions (..., 4, 4), angles up to pi; the inverse of `pose_from_twist`.
    Raises ShapeError, UnitError as `axis_angle_from_pose`.
    """
    turn = _rotation_vector(pose, "twist_from_pose")
    return torch.cat([turn, torch.linalg.solve(_jacobian(turn), pose[..., :3, 3:])[..., 0]], -1)


class _RigidPose(nn.Module):
    """A rigid motion of a base matrix. Subclasses say how six numbers make one."""

    base: Tensor
    centre: Tensor

    def __init__(
        self, base: Any = None, about: Any = "self", frame: Frame = "world", length_scale: float = 1.0
    ) -> None:
        super().__init__()
        name = type(self).__name__
        if frame not in get_args(Frame):
            raise SceneError(f"{name}: expected frame 'world' or 'local', got {shown(frame)}.")
        matrix = torch.eye(4) if base is None else _matrices(base, name)
        self.frame: Frame = frame
        self.length_scale = positive(f"{name}: length_scale", length_scale)
        self.register_buffer("base", matrix, persistent=False)
        self.register_buffer("centre", _centre(about, matrix, frame, name), persistent=False)

    _to_matrix: Callable[[Tensor], Tensor]
    _from_matrix: Callable[[Tensor], Tensor]

    def forward(self, x: Tensor) -> Tensor:
        name = type(self).__name__
        x = _six(x, name)
        base, centre = self.base.to(x.device, x.dtype), self.centre.to(x.device, x.dtype)
        delta = type(self)._to_matrix(torch.cat([x[..., :3], self.length_scale * x[..., 3:]], -1))
        rotation = delta[..., :3, :3]
        try:
            # About the centre: T(centre) delta T(-centre).
            shift = delta[..., :3, 3] + centre - (rotation @ centre[..., None])[..., 0]
            motion = _assembled(rotation, shift)
            return motion @ base if self.frame == "world" else base @ motion
        except RuntimeError:
            raise ShapeError(
                f"{name}: expected (..., 6) that goes with a base {tuple(base.shape)}, got {tuple(x.shape)}."
            ) from None

    def right_inverse(self, pose: Tensor) -> Tensor:
        """The six numbers of which `forward` makes `pose`. Raises ShapeError, and UnitError for a pose that is no rigid
        motion of the base.
        """
        name = type(self).__name__
        matrix, base, centre = (t.to(torch.float64) for t in (floating(pose, name), self.base, self.centre))
        if matrix.shape[-2:] != (4, 4):
            raise ShapeError(f"{name}: expected transforms (..., 4, 4), got {tuple(matrix.shape)}.")
        inverse = torch.linalg.inv(base)
        motion = matrix @ inverse if self.frame == "world" else inverse @ matrix
        _check_rigid(motion, name, "of the base; give base=renderer.values[key] to keep its scale")
        rotation = motion[..., :3, :3]
        shift = motion[..., :3, 3] - centre + (rotation @ centre[..., None])[..., 0]
        x = type(self)._from_matrix(_assembled(rotation, shift))
        return torch.cat([x[..., :3], x[..., 3:] / self.length_scale], -1).to(pose.dtype)

    def extra_repr(self) -> str:
        return f"frame={self.frame!r}, length_scale={self.length_scale:g}"


class AxisAnglePose(_RigidPose):
    """Six numbers to `to_world` (..., 4, 4): `base`, turned about a point by an axis-angle vector, then moved.

    `base`: (4, 4) or (..., 4, 4), what the numbers 0 stand for; its scale and shear are kept, so of a shape the present
    `to_world`. None: the identity, for poses that are rigid themselves. `about`: the point that stays when it turns:
    "self" (where `base` puts the origin), "world" (the world's origin), or a point [x, y, z] of the world. `frame`:
    "world" turns and moves along the world's axes (`motion @ base`), "local" along those of the thing before its
    `base` (`base @ motion`, in its units of length). `length_scale`: metres (with
    "local", units of `base`) for 1 in the last three numbers, so that one learning rate fits turns and moves.

    Turns by more than pi are taken, and come back as smaller ones. Raises SceneError, ShapeError, UnitError.
    """

    _to_matrix = staticmethod(pose_from_axis_angle)
    _from_matrix = staticmethod(axis_angle_from_pose)


class SE3Pose(_RigidPose):
    """As `AxisAnglePose`, by the exponential of SE(3): turn and move at once along a screw. To first order the same;
    the six numbers are then coordinates of one motion, for Lie-algebra optimisers and interpolation of poses.
    """

    _to_matrix = staticmethod(pose_from_twist)
    _from_matrix = staticmethod(twist_from_pose)


# ------------------------------------------------------------------------------------------------------------- parts


def _six(x: Tensor, where: str) -> Tensor:
    x = floating(x, where)
    if x.ndim < 1 or x.shape[-1] != 6:
        raise ShapeError(f"{where}: expected six numbers (..., 6), rotation and translation, got {tuple(x.shape)}.")
    return x


def _assembled(rotation: Tensor, shift: Tensor) -> Tensor:
    """(..., 4, 4) of its parts."""
    upper = torch.cat([rotation, shift[..., None]], -1)
    last = upper.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*upper.shape[:-2], 1, 4)
    return torch.cat([upper, last], -2)


def _jacobian(turn: Tensor) -> Tensor:
    """Left Jacobian of SO(3), (..., 3, 3) of (..., 3): the mean of the rotations from none to `turn`,
    `1 + (1 - cos a) / a^2 [turn] + (a - sin a) / a^3 [turn]^2`, with a power series of `a^2` below a = 0.5.
    """
    square = (turn * turn).sum(-1)[..., None, None]
    near = square < 0.25
    s, far = torch.where(near, square, 0.0), torch.where(near, 1.0, square)
    angle = far.sqrt()
    series = [torch.zeros_like(s), torch.zeros_like(s)]
    for k in range(7, -1, -1):
        sign = (-1) ** k
        series = [sign / math.factorial(2 * k + first) + s * one for first, one in zip((2, 3), series, strict=True)]
    first = torch.where(near, series[0], 2 * torch.sin(angle / 2) ** 2 / far)
    second = torch.where(near, series[1], (angle - torch.sin(angle)) / (far * angle))
    x, y, z = turn.unbind(-1)
    none = torch.zeros_like(x)
    cross = torch.stack([none, -z, y, z, none, -x, -y, x, none], -1).reshape(*turn.shape, 3)
    return torch.eye(3, dtype=turn.dtype, device=turn.device) + first * cross + second * cross @ cross


def _rotation_vector(pose: Tensor, where: str) -> Tensor:
    from kornia.geometry.conversions import rotation_matrix_to_axis_angle

    _check_rigid(pose, where)
    if not pose.numel():
        return pose.new_zeros(*pose.shape[:-2], 3)
    vector: Tensor = rotation_matrix_to_axis_angle(pose[..., :3, :3].reshape(-1, 3, 3))
    return vector.reshape(*pose.shape[:-2], 3)


def _check_rigid(pose: Tensor, where: str, of_what: str = "") -> None:
    pose = floating(pose, where)
    if pose.ndim < 2 or pose.shape[-2:] != (4, 4):
        raise ShapeError(f"{where}: expected transforms (..., 4, 4), got {tuple(pose.shape)}.")
    rotation = pose.detach()[..., :3, :3]
    off = (rotation.mT @ rotation - torch.eye(3, dtype=pose.dtype, device=pose.device)).abs().amax((-2, -1))
    rigid = (off < _TOLERANCE) & (torch.linalg.det(rotation) > 0) & torch.isfinite(pose.detach()).all(-1).all(-1)
    if not bool(rigid.all()):
        said = of_what or "(rotation and translation, no scale, no mirror)"
        raise UnitError(f"{where}: expected a rigid motion {said}, got a matrix that is off by {off.max().item():.2g}.")


def _matrices(given: Any, where: str) -> Tensor:
    if isinstance(given, Tensor) and given.is_floating_point():
        matrix = given.detach().clone()
    else:
        array = real_array(getattr(given, "matrix", given))
        if array is None:
            raise ShapeError(f"{where}: expected base as a transform (..., 4, 4), got {shown(given)}.")
        matrix = torch.tensor(array)
    if matrix.ndim < 2 or matrix.shape[-2:] != (4, 4):
        raise ShapeError(f"{where}: expected base as a transform (..., 4, 4), got {tuple(matrix.shape)}.")
    determinant = torch.linalg.det(matrix.double())
    if not bool((torch.isfinite(determinant) & (determinant != 0)).all()):
        raise UnitError(f"{where}: expected a base with an inverse, got a determinant of {determinant.min().item():g}.")
    return matrix


def _centre(about: Any, base: Tensor, frame: Frame, where: str) -> Tensor:
    """The point that stays: in the world, or before the base."""
    if isinstance(about, str):
        if about not in ("self", "world"):
            raise SceneError(f"{where}: expected about='self', 'world' or a point [x, y, z], got {about!r}.")
        if about == "self":
            return base[..., :3, 3] if frame == "world" else torch.zeros_like(base[..., :3, 3])
        point = base.new_zeros(3)
    else:
        array = real_array(about)
        if array is None or array.shape != (3,):
            raise ShapeError(f"{where}: expected about as a point [x, y, z], got {shown(about)}.")
        point = torch.as_tensor(array, dtype=base.dtype, device=base.device)
    if frame == "world":
        return point.expand((*base.shape[:-2], 3)).clone()
    before: Tensor = torch.linalg.solve(base[..., :3, :3], (point - base[..., :3, 3])[..., None])
    return before[..., 0]
