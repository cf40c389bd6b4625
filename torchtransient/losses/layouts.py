"""Position of time and extent of an item in the tensors that losses compare.

Shapes are ambiguous: (2, 3, 20, 5) is two lists of five points with three channels, or two channels of three bins. The
argument `dim` of losses is the dimension of time (of frequency for phasors), with the channels right before it: -3 of
images (..., C, T, Y, X), -2 of lists of points (..., C, T, N), -5 of exhaustive captures (..., C, T, Ly, Lx, Sy, Sx).
An item of a batch is its channels and all dimensions behind them. Without `dim`, only (C, T, Y, X) and (B, C, T, Y, X)
of four bins or more are taken. A batch of lists of four channels or more has such a shape: give `dim=-2`.
"""

from __future__ import annotations

import math
import operator

from torch import Tensor

from torchtransient.errors import ShapeError, UnitError
from torchtransient.losses.checks import check_level

_IMAGES = -3
# One or three numbers before points are channels of a list rather than bins.
_FEWEST_BINS = 4
_LAYOUTS = "-3 of (..., C, T, Y, X), -2 of lists (..., C, T, N), -5 of exhaustive captures (..., C, T, Ly, Lx, Sy, Sx)"


def time_dim(x: Tensor, dim: int | None, where: str, instead: str = "") -> int:
    """Return the dimension of time as a negative number.

    Args:
        x: a record.
        dim: dimension of time as the caller gave it; None for images of four bins or more.
        where: begins the message.
        instead: alternative to `dim=` for the message.

    Raises:
        ShapeError: if it is out of range, or not given for an ambiguous shape.
    """
    if dim is None:
        if x.ndim not in (4, 5) or x.shape[_IMAGES] < _FEWEST_BINS:
            raise ShapeError(
                f"{where}: expected dim=, the dimension of time,{instead} for a tensor {tuple(x.shape)}: {_LAYOUTS}. "
                f"Without it (C, T, Y, X) and (B, C, T, Y, X) of {_FEWEST_BINS} bins or more are taken, no others."
            )
        return _IMAGES
    number = operator.index(dim)
    if not -x.ndim <= number < x.ndim:
        raise ShapeError(
            f"{where}: expected a tensor with time as its dimension {number}, got {tuple(x.shape)}. dim is {_LAYOUTS}."
        )
    return number - x.ndim if number >= 0 else number


def bins_dim(x: Tensor, dim: int | None, where: str) -> int:
    """Return `time_dim` of a record with bins.

    Args:
        x: a record.
        dim: dimension of time as the caller gave it, or None.
        where: begins the message.

    Raises:
        ShapeError: for records without bins.
    """
    place = time_dim(x, dim, where)
    if not x.shape[place]:
        raise ShapeError(f"{where}: expected one or more bins in dimension {place}, got {tuple(x.shape)}.")
    return place


def bin_width(width_opl: float | None, like: Tensor, where: str) -> Tensor:
    """Return the width of a bin in the precision of a tensor.

    Args:
        width_opl: width in metres of path.
        like: the record.
        where: begins the message.

    Raises:
        UnitError: for None, and lengths below 0.3 fs.
    """
    if width_opl is None:
        raise UnitError(
            f"{where}: expected bin_width_opl, metres of optical path, with tensors, got None. Give "
            "axis.bin_width_opl, or a result that has an axis."
        )
    return check_level("bin_width_opl", width_opl, like.new_empty(()), where)


def item_dims(x: Tensor, dim: int | None, where: str, instead: str = "") -> tuple[int, ...]:
    """Return the dimensions of an item, from its channels on. Without `dim`, a tensor (N,) is one item.

    Args:
        x: a record.
        dim: dimension of time as the caller gave it, or None.
        where: begins the message.
        instead: alternative to `dim=` for the message.

    Raises:
        ShapeError: as `time_dim`.
    """
    if dim is None and x.ndim < 2:
        return tuple(range(-x.ndim, 0))
    return tuple(range(max(time_dim(x, dim, where, instead) - 1, -x.ndim), 0))


def as_columns(x: Tensor, dim: int) -> Tensor:
    """Reshape a record to (..., T, N, 1), the layout of sensors.

    Args:
        x: a record.
        dim: dimension of time, a negative number.
    """
    if dim == _IMAGES:
        return x
    place = dim + x.ndim
    return x.reshape(*x.shape[: place + 1], math.prod(x.shape[place + 1 :]), 1)
