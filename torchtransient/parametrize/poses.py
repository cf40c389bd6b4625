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
from torch import Tensor

from torchtransient.checks import positive, shown
from torchtransient.errors import ArgumentError, SceneError, ShapeError, UnitError
from torchtransient.floating import floating, holds, number_tensor, single, without_autocast
from torchtransient.parametrize.settings import Settings, choice_code, choice_of

Frame = Literal["world", "local"]
_FRAMES: tuple[str, ...] = get_args(Frame)
_KINDS = ("AxisAnglePose", "SE3Pose")
_LAST_ROW = (0.0, 0.0, 0.0, 1.0)
# How far a matrix may be from a rotation: products of float32 with some hundred between the scales of a base.
_TOLERANCE = 1e-4


@without_autocast
def pose_from_axis_angle(x: Tensor) -> Tensor:
    """Return rigid motions: turned about the origin by `x[..., :3]`, then moved by `x[..., 3:]`.

    Args:
        x: (..., 6), axis times angle in radians, right-handed, and translation in metres.

    Returns:
        (..., 4, 4).

    Raises:
        ShapeError: for another shape.
    """
    from kornia.geometry.conversions import axis_angle_to_rotation_matrix

    x = _six(x, "pose_from_axis_angle")
    flat = single(x).reshape(-1, 6)
    pose = _assembled(axis_angle_to_rotation_matrix(flat[:, :3]), flat[:, 3:])
    return pose.reshape(*x.shape[:-1], 4, 4).to(x.dtype)


@without_autocast
def axis_angle_from_pose(pose: Tensor) -> Tensor:
    """Return the six numbers of rigid motions, the inverse of `pose_from_axis_angle`.

    At half a turn the sign of the axis is free, and derivatives jump.

    Args:
        pose: (..., 4, 4).

    Returns:
        (..., 6), angles up to pi.

    Raises:
        ShapeError: for another shape.
        UnitError: for matrices that are no rigid motion (a turn, with the last row 0, 0, 0, 1), to 1e-4 or the rounding
            of half precision.
    """
    _check_rigid(pose, "axis_angle_from_pose")
    return _axis_angle_of(single(pose)).to(pose.dtype)


@without_autocast
def pose_from_twist(x: Tensor) -> Tensor:
    """Return the exponential of SE(3).

    Args:
        x: (..., 6), `x[..., :3]` the rotation (axis times angle, radians), `x[..., 3:]` the translation per unit of
            time of a screw motion, at time 1, metres.

    Returns:
        (..., 4, 4).

    Raises:
        ShapeError: for another shape.
    """
    from kornia.geometry.conversions import axis_angle_to_rotation_matrix

    x = _six(x, "pose_from_twist")
    flat = single(x).reshape(-1, 6)
    turn = flat[:, :3]
    shift = (_jacobian(turn) @ flat[:, 3:, None])[..., 0]
    return _assembled(axis_angle_to_rotation_matrix(turn), shift).reshape(*x.shape[:-1], 4, 4).to(x.dtype)


@without_autocast
def twist_from_pose(pose: Tensor) -> Tensor:
    """Return the logarithm of SE(3), the inverse of `pose_from_twist`.

    Args:
        pose: (..., 4, 4).

    Returns:
        (..., 6), angles up to pi.

    Raises:
        ShapeError, UnitError: as `axis_angle_from_pose`.
    """
    _check_rigid(pose, "twist_from_pose")
    return _twist_of(single(pose)).to(pose.dtype)


def _axis_angle_of(pose: Tensor) -> Tensor:
    return torch.cat([_rotation_vector(pose), pose[..., :3, 3]], -1)


def _twist_of(pose: Tensor) -> Tensor:
    turn = _rotation_vector(pose)
    return torch.cat([turn, torch.linalg.solve(_jacobian(turn), pose[..., :3, 3:])[..., 0]], -1)


class _RigidPose(Settings):
    """A rigid motion of a base matrix. Subclasses say how six numbers make one."""

    base: Tensor
    center: Tensor
    length_scale: Tensor

    def __init__(
        self, base: Any = None, *, about: Any = "self", frame: Frame = "world", length_scale: float = 1.0
    ) -> None:
        super().__init__()
        name = type(self).__name__
        if frame not in _FRAMES:
            raise ArgumentError(f"{name}: expected frame 'world' or 'local', got {shown(frame)}.")
        matrix = torch.eye(4) if base is None else _matrices(base, name)
        self.frame: str = frame
        self._keep("length_scale", positive(f"{name}: length_scale", length_scale))
        self._keep("base", matrix)
        self._keep("center", _centre(about, self.base, frame, name))

    _kind: str
    _to_matrix: Callable[[Tensor], Tensor]
    _from_matrix: Callable[[Tensor], Tensor]

    @without_autocast
    def forward(self, x: Tensor) -> Tensor:
        exact = single(_six(x, type(self).__name__))
        base, centre, unit = (one.to(exact) for one in (self.base, self.center, self.length_scale))
        delta = type(self)._to_matrix(torch.cat([exact[..., :3], unit * exact[..., 3:]], -1))
        rotation = delta[..., :3, :3]
        # About the centre: T(centre) delta T(-centre).
        motion = _assembled(rotation, delta[..., :3, 3] + centre - (rotation @ centre[..., None])[..., 0])
        return (motion @ base if self.frame == "world" else base @ motion).to(x.dtype)

    @without_autocast
    def right_inverse(self, pose: Tensor) -> Tensor:
        """Return the six numbers that `forward` maps to `pose`. Raises ShapeError, and UnitError for a pose that is no
        rigid motion of the base.
        """
        name = type(self).__name__
        matrix = _four_by_four(pose, name).to(torch.float64)
        base, centre = self.base.to(matrix.device), self.center.to(matrix.device)
        inverse = torch.linalg.inv(base)
        motion = matrix @ inverse if self.frame == "world" else inverse @ matrix
        what = "of the base; give base=renderer.values[key] to keep its scale"
        _check_rigid(motion, name, what, _tolerance(pose.dtype))
        rotation = motion[..., :3, :3]
        shift = motion[..., :3, 3] - centre + (rotation @ centre[..., None])[..., 0]
        x = type(self)._from_matrix(_assembled(rotation, shift))
        return torch.cat([x[..., :3], x[..., 3:] / self.length_scale.to(x.device)], -1).to(pose.dtype)

    def get_extra_state(self) -> Tensor:
        return torch.stack([choice_code(_KINDS, self._kind), choice_code(_FRAMES, self.frame)])

    def set_extra_state(self, state: Any) -> None:
        name = type(self).__name__
        codes = torch.as_tensor(state).flatten().tolist()
        # The same six numbers are another motion.
        if len(codes) != 2 or choice_of(_KINDS, codes[0], name) != self._kind:
            raise SceneError(f"{name}: expected the state of a pose of this kind, got {shown(state)}.")
        self.frame = choice_of(_FRAMES, codes[1], name)

    def extra_repr(self) -> str:
        return f"frame={self.frame!r}, length_scale={self.length_scale.item():g}"


class AxisAnglePose(_RigidPose):
    """Six numbers to `to_world` (..., 4, 4): `base`, turned about a point by an axis-angle vector, then moved.

    Turns by more than pi are taken, and come back as smaller ones. All but `about` itself is part of `state_dict` (the
    point in its place), in float64, also when the module is made half: a state that is loaded brings its own base.

    Args:
        base: pose for six numbers of 0, (4, 4) or (..., 4, 4); its scale and shear are kept. For a shape, give its
            present `to_world`. None: the identity, for poses that are rigid themselves.
        about: point that stays as it turns: "self" (where `base` puts the origin), "world" (the world's origin), or a
            point [x, y, z] of the world.
        frame: "world" turns and moves along the world's axes (`motion @ base`), "local" along those of the thing before
            its `base` (`base @ motion`, in its units of length).
        length_scale: metres (with "local", units of `base`) for 1 in the last three numbers, so that one learning rate
            fits turns and moves.

    Raises:
        SceneError, ShapeError, UnitError: for other poses and points; SceneError also for a state of the other kind.
    """

    _kind = "AxisAnglePose"
    _to_matrix = staticmethod(pose_from_axis_angle)
    _from_matrix = staticmethod(_axis_angle_of)


class SE3Pose(_RigidPose):
    """As `AxisAnglePose`, by the exponential of SE(3): turn and move at once along a screw. To first order the same;
    the six numbers are then coordinates of one motion, for Lie-algebra optimisers and interpolation of poses.

    Args:
        base: pose for six numbers of 0, (4, 4) or (..., 4, 4), None for the identity, see `AxisAnglePose`.
        about: point that stays as it turns, "self", "world" or [x, y, z].
        frame: "world" or "local".
        length_scale: metres (with "local", units of `base`) for 1 in the last three numbers.
    """

    _kind = "SE3Pose"
    _to_matrix = staticmethod(pose_from_twist)
    _from_matrix = staticmethod(_twist_of)


# ------------------------------------------------------------------------------------------------------------- parts


def _six(x: Tensor, where: str) -> Tensor:
    x = floating(x, where)
    if x.ndim < 1 or x.shape[-1] != 6:
        raise ShapeError(f"{where}: expected six numbers (..., 6), rotation and translation, got {tuple(x.shape)}.")
    return x


def _assembled(rotation: Tensor, shift: Tensor) -> Tensor:
    """(..., 4, 4) of its parts."""
    upper = torch.cat([rotation, shift[..., None]], -1)
    last = upper.new_tensor(_LAST_ROW).expand(*upper.shape[:-2], 1, 4)
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


def _rotation_vector(pose: Tensor) -> Tensor:
    from kornia.geometry.conversions import rotation_matrix_to_axis_angle

    vector: Tensor = rotation_matrix_to_axis_angle(pose[..., :3, :3].reshape(-1, 3, 3))
    return vector.reshape(*pose.shape[:-2], 3)


def _four_by_four(pose: Any, where: str) -> Tensor:
    matrix = floating(pose, where)
    if matrix.ndim < 2 or matrix.shape[-2:] != (4, 4):
        raise ShapeError(f"{where}: expected transforms (..., 4, 4), got {tuple(matrix.shape)}.")
    return matrix


def _tolerance(dtype: torch.dtype) -> float:
    return max(_TOLERANCE, 4 * torch.finfo(dtype).eps)


def _check_rigid(pose: Tensor, where: str, of_what: str = "", tolerance: float | None = None) -> None:
    known = single(_four_by_four(pose, where).detach())
    rotation = known[..., :3, :3]
    off = (rotation.mT @ rotation - torch.eye(3, dtype=known.dtype, device=known.device)).abs().amax((-2, -1))
    # What a projection has in the last row, six numbers have no place for.
    off = torch.maximum(off, (known[..., 3, :] - known.new_tensor(_LAST_ROW)).abs().amax(-1))
    near = off < (_tolerance(pose.dtype) if tolerance is None else tolerance)
    if not holds(near & (torch.linalg.det(rotation) > 0) & torch.isfinite(known).all(-1).all(-1)):
        said = of_what or "(rotation and translation, no scale, no mirror, no projection)"
        raise UnitError(f"{where}: expected a rigid motion {said}, got a matrix that is off by {off.max().item():.2g}.")


def _matrices(given: Any, where: str) -> Tensor:
    expected = f"{where}: expected base as a transform (..., 4, 4)"
    matrix = number_tensor(getattr(given, "matrix", given), expected).detach().double()
    if matrix.ndim < 2 or matrix.shape[-2:] != (4, 4):
        raise ShapeError(f"{expected}, got {tuple(matrix.shape)}.")
    determinant = torch.linalg.det(matrix)
    if not holds(torch.isfinite(determinant) & (determinant != 0)):
        raise UnitError(f"{where}: expected a base with an inverse, got a determinant of {determinant.min().item():g}.")
    if not holds((matrix[..., 3, :] - matrix.new_tensor(_LAST_ROW)).abs() < _TOLERANCE**2):
        raise UnitError(f"{where}: expected a base with the last row 0, 0, 0, 1, got {matrix[..., 3, :].tolist()}.")
    return matrix


def _centre(about: Any, base: Tensor, frame: Frame, where: str) -> Tensor:
    """The point that stays: in the world, or before the base."""
    if isinstance(about, str) and about == "self":
        return base[..., :3, 3] if frame == "world" else torch.zeros_like(base[..., :3, 3])
    place = (0.0, 0.0, 0.0) if isinstance(about, str) and about == "world" else about
    expected = f"{where}: expected about='self', 'world' or a point [x, y, z]"
    point = number_tensor(place, expected).detach().to(base)
    if point.shape != (3,) or not holds(torch.isfinite(point)):
        raise ShapeError(f"{expected}, got {shown(about)}.")
    if frame == "world":
        return point.expand((*base.shape[:-2], 3)).clone()
    before: Tensor = torch.linalg.solve(base[..., :3, :3], (point - base[..., :3, 3])[..., None])
    return before[..., 0]
