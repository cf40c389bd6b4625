"""Where time is in what losses are given, and which dimensions are one item of a batch: one rule for all of them.

Shapes do not say it: (2, 3, 20, 5) is two lists of five points, or two channels of three bins. So there is `dim`, the
dimension of time (of frequency), with the channels right before it: -3 of images (..., C, T, Y, X), -2 of lists of
points (..., C, T, N), -5 of exhaustive captures (..., C, T, Ly, Lx, Sy, Sx). An item of a batch is its channels and
everything behind them. Without `dim`, (C, T, Y, X) and (B, C, T, Y, X) are taken, of four
bins or more: fewer may be channels. What is left to say is a batch of lists of as many channels.
"""

from __future__ import annotations

import math

from torch import Tensor

from torchtransient.checks import MOST, as_whole, shown
from torchtransient.errors import ShapeError, UnitError
from torchtransient.losses.comparison import Reduction, check_level, check_reduction

_IMAGES = -3
# One or three numbers before points are channels of a list rather than bins.
_FEWEST_BINS = 4
_LAYOUTS = "-3 of (..., C, T, Y, X), -2 of lists (..., C, T, N), -5 of exhaustive captures (..., C, T, Ly, Lx, Sy, Sx)"


def time_dim(x: Tensor, dim: int | None, where: str, instead: str = "") -> int:
    """The dimension of time of `x`, below zero. Raises ShapeError where it is not there, or neither said nor clear;
    `instead`: what else a user may say.
    """
    if dim is None:
        if x.ndim not in (4, 5) or x.shape[_IMAGES] < _FEWEST_BINS:
            raise ShapeError(
                f"{where}: expected dim=, the dimension of time,{instead} for a tensor {tuple(x.shape)}: {_LAYOUTS}. "
                f"Without it (C, T, Y, X) and (B, C, T, Y, X) of {_FEWEST_BINS} bins or more are taken, no others."
            )
        return _IMAGES
    number = check_dim(dim, where)
    if not -x.ndim <= number < x.ndim:
        raise ShapeError(
            f"{where}: expected a tensor with time as its dimension {number}, got {tuple(x.shape)}. dim is {_LAYOUTS}."
        )
    return number - x.ndim if number >= 0 else number


def check_dim(dim: int, where: str) -> int:
    """Raises ShapeError for what is no number of a dimension."""
    number = as_whole(dim)
    if number is None or abs(number) > MOST:
        raise ShapeError(
            f"{where}: expected dim, the dimension of time, to be a whole number, got {shown(dim)}. It is {_LAYOUTS}."
        )
    return number


def check_held(reduction: Reduction, dim: int | None, where: str) -> None:
    """The options that most modules hold. Raises ShapeError."""
    check_reduction(reduction, where)
    if dim is not None:
        check_dim(dim, where)


def bins_dim(x: Tensor, dim: int | None, where: str) -> int:
    """`time_dim` of a record, which has one bin or more."""
    place = time_dim(x, dim, where)
    if not x.shape[place]:
        raise ShapeError(f"{where}: expected one or more bins in dimension {place}, got {tuple(x.shape)}.")
    return place


def bin_width(width_opl: float | None, like: Tensor, where: str) -> Tensor:
    """The width of a bin, metres of optical path, in the precision of `like`. Raises UnitError, also for none."""
    if width_opl is None:
        raise UnitError(
            f"{where}: expected bin_width_opl, metres of optical path, with tensors, got None. Give "
            "axis.bin_width_opl, or a result that has an axis."
        )
    return check_level("bin_width_opl", width_opl, like.new_empty(()), where)


def item_dims(x: Tensor, dim: int | None, where: str, instead: str = "") -> tuple[int, ...]:
    """Dimensions of an item, from its channels on. Without `dim`, a tensor of one dimension is one item."""
    if dim is None and x.ndim < 2:
        return tuple(range(-x.ndim, 0))
    return tuple(range(max(time_dim(x, dim, where, instead) - 1, -x.ndim), 0))


def as_columns(x: Tensor, dim: int) -> Tensor:
    """(..., T, N, 1) of a tensor with time as its dimension `dim` < 0: the layout of the sensors."""
    if dim == _IMAGES:
        return x
    place = dim + x.ndim
    return x.reshape(*x.shape[: place + 1], math.prod(x.shape[place + 1 :]), 1)
