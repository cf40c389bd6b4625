"""What a hidden volume would have measured against what was measured: what holds a reconstruction to its data."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor, nn

from torchtransient.errors import ShapeError
from torchtransient.losses.comparison import (
    Reduction,
    check_dense,
    check_function,
    check_mask,
    check_pair,
    counted,
    reduce,
)
from torchtransient.losses.layouts import item_dims


class PairLoss(Protocol):
    """A loss of this room that compares two tensors; `functools.partial` holds further options of one."""

    def __call__(self, input: Tensor, target: Tensor, *, mask: Tensor | None, reduction: Reduction) -> Tensor: ...


def squared_loss(input: Tensor, target: Tensor, *, mask: Tensor | None = None, reduction: Reduction = "mean") -> Tensor:
    """`|input - target|^2` of each element, real or complex, any shape. Symmetric. Raises ShapeError, UnitError."""
    input, target = check_pair(input, target, "squared_loss", complex_too=True)
    mask = check_mask(mask, input, "squared_loss")
    return reduce(_power(counted(input, mask) - counted(target, mask)), reduction, "squared_loss", mask)


def measurement_consistency(
    volume: Tensor,
    measured: Tensor,
    operator: Callable[[Tensor], Tensor],
    *,
    compare: PairLoss = squared_loss,
    scale_invariant: bool = False,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """`compare(A volume, measured)`: what a volume would have measured against what was.

    `operator` is `A`: a `LinearOperator` of `tt.nlos` or any function from `volume` (..., C, Z, Y, X) to the shape of
    `measured` (..., C, T, Y, X); `compare` any loss (input, target) with `mask` and `reduction`, `mask` of the
    measurement. With `scale_invariant` A volume is first multiplied by the real number that brings each item nearest to
    the measurement in least squares: powers of lasers and albedos are seldom calibrated. `dim`, where time is in the
    measurement, then says what is an item (`losses.layouts`). That number may be negative, so keep volumes non-negative
    where their sign matters; it is 1 for a volume that is dark altogether, whose gradient then leads out of the dark.
    Not symmetric; zero where A volume is the measurement. Raises ShapeError where A volume is no tensor of the
    measurement's shape.
    """
    where = "measurement_consistency"
    check_dense((volume, measured), where)
    check_function("the operator", operator, where)
    check_function("compare", compare, where)
    prediction = operator(volume)
    if not isinstance(prediction, Tensor) or prediction.shape != measured.shape:
        got = tuple(prediction.shape) if isinstance(prediction, Tensor) else type(prediction).__name__
        raise ShapeError(
            f"{where}: expected the operator to make a tensor of the measurement's shape {tuple(measured.shape)} of a "
            f"volume {tuple(volume.shape)}, got {got}."
        )
    if scale_invariant:
        pair = check_pair(prediction, measured, where, complex_too=True)
        prediction = _scaled(*pair, check_mask(mask, measured, where), item_dims(measured, dim, where))
    return compare(prediction, measured, mask=mask, reduction=reduction)


def _scaled(prediction: Tensor, measured: Tensor, mask: Tensor | None, dims: tuple[int, ...]) -> Tensor:
    """The prediction times the number that brings each item nearest to the measurement."""
    if not prediction.numel():
        return prediction
    seen = counted(prediction, mask)
    peak = seen.detach().abs().amax(dims, keepdim=True)
    dark = peak == 0
    # of a prediction whose peak is 1: squares neither overflow nor vanish
    peak = torch.where(dark, torch.ones_like(peak), peak)
    seen = seen / peak
    power = _power(seen).sum(dims, keepdim=True)
    along = _product(seen, counted(measured, mask)).sum(dims, keepdim=True)
    scale = torch.where(dark, torch.ones_like(along), along / torch.where(dark, torch.ones_like(power), power))
    return seen * scale


def _power(x: Tensor) -> Tensor:
    return x.real.square() + x.imag.square() if x.is_complex() else x.square()


def _product(x: Tensor, y: Tensor) -> Tensor:
    """Re(x conj(y))."""
    return x.real * y.real + x.imag * y.imag if x.is_complex() else x * y


class SquaredLoss(nn.Module):
    """`squared_loss(input, target)` with its reduction held."""

    def __init__(self, reduction: Reduction = "mean") -> None:
        super().__init__()
        self.reduction = reduction

    def forward(self, input: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
        return squared_loss(input, target, mask=mask, reduction=self.reduction)


class MeasurementConsistency(nn.Module):
    """`measurement_consistency(input, target)` of a volume and a measurement, with its operator and options held.

    An operator that is a module is a part of this one and moves with it.
    """

    def __init__(
        self,
        operator: Callable[[Tensor], Tensor],
        compare: PairLoss = squared_loss,
        scale_invariant: bool = False,
        dim: int | None = None,
        reduction: Reduction = "mean",
    ) -> None:
        super().__init__()
        self.operator, self.compare = operator, compare
        self.scale_invariant, self.dim, self.reduction = scale_invariant, dim, reduction

    def forward(self, input: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
        return measurement_consistency(
            input,
            target,
            self.operator,
            compare=self.compare,
            scale_invariant=self.scale_invariant,
            dim=self.dim,
            mask=mask,
            reduction=self.reduction,
        )
