"""Stokes vectors and Mueller matrices as torch tensors: degrees and angle of polarization, frames, ideal elements.

A Stokes vector ``(S0, S1, S2, S3)`` describes light in a frame across its direction of travel, seen by the receiver,
who looks towards the source: the horizontal axis x, and y a quarter turn counter-clockwise from it. ``S1 > 0`` is
horizontal light, ``S2 > 0`` light at +45 degrees, ``S3 > 0`` right circular light (Mitsuba's convention). For a camera
of this library x points to the right of the image and y up.

Tensors hold the four components along ``dim``: -5 in a transient ``(..., 4, C, T, H, W)`` (``TRANSIENT_DIM``), -4 in a
steady image ``(..., 4, C, H, W)`` (``STEADY_DIM``). Angles are radians. Any real floating dtype and device.

No function divides zero by zero, forwards or backwards: at dark and unpolarized entries value and derivative are zero,
where the functions have no derivative. Second derivatives exist away from these entries. NaN in the light gives NaN.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchtransient.checks import as_number, as_whole, index, numbers, shown
from torchtransient.errors import ArgumentError, ShapeError, UnitError

TRANSIENT_DIM = -5
STEADY_DIM = -4


# ------------------------------------------------------------------------------------------------------ measures


def degree_of_polarization(stokes: Tensor, dim: int, floor: float = 0.0) -> Tensor:
    """Return ``|(S1, S2, S3)| / S0``.

    Args:
        stokes: light with four components along ``dim``.
        dim: axis of the components.
        floor: the result is zero where ``S0 <= floor``.

    Returns:
        The shape of ``stokes`` without ``dim``. Above one where noise makes the components inconsistent: clamp it for
        display only. To fit polarization, prefer a loss on :func:`normalized_components`, which has no kink at zero.

    Raises:
        ShapeError: unless ``stokes`` has four real components along ``dim``.
        UnitError: for a negative ``floor``.
    """
    return _degree(stokes, dim, (1, 2, 3), floor)


def degree_of_linear_polarization(stokes: Tensor, dim: int, floor: float = 0.0) -> Tensor:
    """Return ``|(S1, S2)| / S0``.

    Args:
        stokes: light with four components along ``dim``.
        dim: axis of the components.
        floor: the result is zero where ``S0 <= floor``.

    Returns:
        The shape of ``stokes`` without ``dim``.

    Raises:
        ShapeError, UnitError: as :func:`degree_of_polarization`.
    """
    return _degree(stokes, dim, (1, 2), floor)


def degree_of_circular_polarization(stokes: Tensor, dim: int, floor: float = 0.0) -> Tensor:
    """Return ``S3 / S0`` in [-1, 1], positive for right circular light.

    Args:
        stokes: light with four components along ``dim``.
        dim: axis of the components.
        floor: the result is zero where ``S0 <= floor``.

    Returns:
        The shape of ``stokes`` without ``dim``.

    Raises:
        ShapeError, UnitError: as :func:`degree_of_polarization`.
    """
    return normalized_components(stokes, dim, floor).select(_axis(stokes, dim), 2)


def angle_of_linear_polarization(stokes: Tensor, dim: int, floor: float = 0.0) -> Tensor:
    """Return the angle of the plane of oscillation against the horizontal axis, counter-clockwise for the receiver.

    The angle jumps by pi at its ends, and its derivative grows as one over the linear part; a loss on
    :func:`normalized_components` has neither problem.

    Args:
        stokes: light with four components along ``dim``.
        dim: axis of the components.
        floor: value and derivative are zero where the linear part ``|(S1, S2)|`` does not exceed it.

    Returns:
        Radians in (-pi/2, pi/2], the shape of ``stokes`` without ``dim``.

    Raises:
        ShapeError, UnitError: as :func:`degree_of_polarization`.
    """
    part = _components(stokes, dim)
    floor = _checked_floor(floor)
    s1, s2 = part[1], part[2]
    largest = torch.maximum(s1.abs(), s2.abs()).detach()
    # The angle does not depend on the scale; at scale one the squares in its derivative cannot underflow.
    # The larger one alone may stay below the floor where both together do not.
    there = ~((largest <= torch.finfo(stokes.dtype).tiny) | (torch.hypot(s1, s2).detach() <= floor))
    scale = torch.where(there, largest, 1.0)
    s1, s2 = torch.where(there, s1, 1.0) / scale, torch.where(there, s2, 0.0) / scale
    return 0.5 * torch.atan2(s2, s1)


def normalized_components(stokes: Tensor, dim: int, floor: float = 0.0) -> Tensor:
    """Return ``(S1, S2, S3) / S0``.

    The first two entries are ``DoLP (cos 2 AoLP, sin 2 AoLP)``: smooth through zero polarization and around the jump of
    the angle.

    Args:
        stokes: light with four components along ``dim``.
        dim: axis of the components.
        floor: value and derivative are zero where ``S0 <= floor``.

    Returns:
        The shape of ``stokes`` with three entries along ``dim``.

    Raises:
        ShapeError, UnitError: as :func:`degree_of_polarization`.
    """
    part = _components(stokes, dim)
    lit, s0 = _intensity(part[0], floor)
    return torch.stack([torch.where(lit, p, 0.0) / s0 for p in part[1:]], dim=_axis(stokes, dim))


def _degree(stokes: Tensor, dim: int, which: tuple[int, ...], floor: float) -> Tensor:
    part = _components(stokes, dim)
    lit, s0 = _intensity(part[0], floor)
    used = torch.stack([part[i] for i in which])
    largest = used.abs().amax(0).detach()
    polarized = lit & ~(largest <= torch.finfo(stokes.dtype).tiny)
    # At scale one no square underflows, and the root is taken of a number between one and three.
    scale = torch.where(polarized, largest, 1.0)
    unit = torch.where(polarized, used, 0.0) / scale
    length = torch.where(polarized, unit.square().sum(0), 1.0).sqrt() * scale
    return torch.where(polarized, length, 0.0) / s0


def _intensity(s0: Tensor, floor: float) -> tuple[Tensor, Tensor]:
    """Return the mask of entries with light, and a divisor that is one elsewhere."""
    lit = ~(s0 <= max(_checked_floor(floor), torch.finfo(s0.dtype).tiny))
    return lit, torch.where(lit, s0, 1.0)


# -------------------------------------------------------------------------------------------------------- frames


def rotate_frame(stokes: Tensor, angle: Tensor | float, dim: int) -> Tensor:
    """Express light in a frame turned counter-clockwise, for the receiver.

    Args:
        stokes: light with four components along ``dim``.
        angle: turn of the frame, radians; a number, or a tensor that broadcasts against ``stokes`` without ``dim``.
        dim: axis of the components.

    Returns:
        The shape of ``stokes``. Light at the angle ``a`` has ``a - angle`` in the new frame.

    Raises:
        ShapeError: for angles of another shape.
    """
    s0, s1, s2, s3 = _components(stokes, dim)
    double = 2 * _real("angle", angle).to(stokes)
    c, s = torch.cos(double), torch.sin(double)
    turned = c * s1 + s * s2, c * s2 - s * s1
    if turned[0].shape != s0.shape:
        raise ShapeError(
            f"angle: expected a shape that broadcasts to {tuple(s0.shape)}, that of the Stokes tensor without its "
            f"components, got {tuple(double.shape)}."
        )
    return torch.stack([s0, *turned, s3], dim=_axis(stokes, dim))


def apply_mueller(matrix: Tensor, stokes: Tensor, dim: int) -> Tensor:
    """Return ``M S``, light after an element.

    For several elements multiply their matrices, the one that the light meets first on the right.

    Args:
        matrix: Mueller matrix, (4, 4).
        stokes: light with four components along ``dim``.
        dim: axis of the components.

    Returns:
        The shape of ``stokes``.

    Raises:
        ShapeError: for matrices of another shape.
    """
    _components(stokes, dim)
    dim, mueller = _axis(stokes, dim), _real("matrix", matrix)
    if mueller.shape != (4, 4):
        raise ShapeError(f"matrix: expected a Mueller matrix of shape (4, 4), got {tuple(mueller.shape)}.")
    return (mueller.to(stokes) @ stokes.movedim(dim, -1).unsqueeze(-1)).squeeze(-1).movedim(-1, dim)


# ------------------------------------------------------------------------------------------------ ideal elements


def rotator(angle: Tensor | float) -> Tensor:
    """Return the Mueller matrix of a change to a frame turned counter-clockwise.

    Args:
        angle: turn of the frame, radians, a number or a tensor (...).

    Returns:
        (..., 4, 4).
    """
    double = 2 * _floating("angle", angle)
    c, s = torch.cos(double), torch.sin(double)
    o, i = torch.zeros_like(c), torch.ones_like(c)
    return _matrix(((i, o, o, o), (o, c, s, o), (o, -s, c, o), (o, o, o, i)))


def linear_polarizer(angle: Tensor | float = 0.0, extinction: Tensor | float = 0.0) -> Tensor:
    """Return the Mueller matrix of a polarizer that passes light oscillating at an angle.

    Args:
        angle: angle of the axis that passes, radians, a number or a tensor (...).
        extinction: transmitted power of the light across the angle, relative to that along it, in [0, 1]: 0 is ideal,
            real sensors have 1/100 to 1/400.

    Returns:
        (..., 4, 4).

    Raises:
        UnitError: for extinctions outside [0, 1].
    """
    double, e = _together(2 * _floating("angle", angle), _floating("extinction", extinction))
    if not bool(((e >= 0) & (e <= 1)).all()):
        raise UnitError(f"extinction: expected numbers in [0, 1], got {shown(extinction)}.")
    c, s = torch.cos(double), torch.sin(double)
    plus, minus = 0.5 * (1 + e), 0.5 * (1 - e)
    # The root has no slope at zero; an ideal polarizer's derivative by its extinction leaves the cross terms out.
    root = torch.where(e > 0, torch.where(e > 0, e, 1.0).sqrt(), 0.0)
    o = torch.zeros_like(c)
    a, b = plus * c * c + root * s * s, plus * s * s + root * c * c
    m = (plus - root) * s * c
    return _matrix(((plus, minus * c, minus * s, o), (minus * c, a, m, o), (minus * s, m, b, o), (o, o, o, root)))


def linear_retarder(angle: Tensor | float, delay: Tensor | float) -> Tensor:
    """Return the Mueller matrix of a wave plate.

    Args:
        angle: angle of the fast axis, radians, a number or a tensor (...).
        delay: delay of the other axis, radians: pi/2 for a quarter-wave plate, pi for a half-wave plate.

    Returns:
        (..., 4, 4).
    """
    double, phase = _together(2 * _floating("angle", angle), _floating("delay", delay))
    c, s, cd, sd = torch.cos(double), torch.sin(double), torch.cos(phase), torch.sin(phase)
    o, i = torch.zeros_like(c), torch.ones_like(c)
    m = (1 - cd) * s * c
    return _matrix(
        (
            (i, o, o, o),
            (o, c * c + cd * s * s, m, -sd * s),
            (o, m, s * s + cd * c * c, sd * c),
            (o, sd * s, -sd * c, cd),
        )
    )


def circular_polarizer(left_handed: bool = False) -> Tensor:
    """Return the Mueller matrix (4, 4) of an ideal polarizer for circular light.

    Args:
        left_handed: pass left circular light, otherwise right circular light.
    """
    sign = -0.5 if left_handed else 0.5
    matrix = torch.zeros(4, 4)
    matrix[0, 0] = matrix[3, 3] = 0.5
    matrix[0, 3] = matrix[3, 0] = sign
    return matrix


def depolarizer() -> Tensor:
    """Return the Mueller matrix (4, 4) that keeps the power and removes the polarization."""
    matrix = torch.zeros(4, 4)
    matrix[0, 0] = 1
    return matrix


# ------------------------------------------------------------------------------------------------------- checks


def _components(stokes: Tensor, dim: int) -> tuple[Tensor, ...]:
    if not isinstance(stokes, Tensor):
        raise ShapeError(f"stokes: expected a tensor (..., 4, C, T, H, W), got {shown(stokes)}.")
    if not stokes.dtype.is_floating_point:
        raise ShapeError(f"stokes: expected real floating point numbers, got {stokes.dtype}.")
    if (place := as_whole(dim)) is None:
        raise ArgumentError(f"dim: expected a whole number, got {shown(dim)}.")
    if not -stokes.ndim <= place < stokes.ndim or stokes.shape[place] != 4:
        raise ShapeError(
            f"stokes: expected four components along dim={shown(dim)}, got shape {tuple(stokes.shape)}. They are along "
            "-5 in a transient (..., 4, C, T, H, W) and along -4 in a steady image (..., 4, C, H, W); only polarized "
            "variants render them."
        )
    return torch.unbind(stokes, place)


def _axis(stokes: Tensor, dim: int) -> int:
    return index("dim", dim, stokes.ndim)


def _checked_floor(floor: float) -> float:
    number = as_number(floor)
    if number is None or not 0 <= number < math.inf:
        raise UnitError(f"floor: expected a finite number of at least 0, got {shown(floor)}.")
    return number


def _real(name: str, value: Any) -> Tensor:
    """Return numbers as a tensor with its gradient. Raises UnitError unless they are real and finite."""
    if isinstance(value, Tensor):
        if value.is_complex() or value.dtype == torch.bool:
            raise UnitError(f"{name}: expected real numbers, got {value.dtype}.")
        return value
    array = numbers(name, value)
    if not np.isfinite(array).all():
        raise UnitError(f"{name}: expected finite numbers, got {shown(value)}.")
    return torch.from_numpy(array)


def _floating(name: str, value: Any) -> Tensor:
    """Return :func:`_real` in floating point: numbers without a precision have the default dtype of torch."""
    tensor = _real(name, value)
    own = tensor.is_floating_point() if isinstance(value, Tensor) else getattr(value, "dtype", None) == np.float64
    return tensor if own else tensor.to(torch.get_default_dtype())


def _together(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    return a + torch.zeros_like(b), b + torch.zeros_like(a)


def _matrix(rows: tuple[tuple[Tensor, ...], ...]) -> Tensor:
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
