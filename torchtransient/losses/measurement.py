"""What a hidden volume would have measured against what was measured: what holds a reconstruction to its data."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import cast

import torch
from torch import Tensor, nn

from torchtransient.checks import flag, function
from torchtransient.errors import ArgumentError, ShapeError
from torchtransient.losses.comparison import (
    Reduction,
    check_dense,
    check_device,
    check_mask,
    check_pair,
    check_reduction,
    counted,
    real_product,
    reduce,
    squared_modulus,
)
from torchtransient.losses.layouts import check_held, item_dims
from torchtransient.losses.pair_losses import PairLoss, PairModule, check_compare, shared_dim
from torchtransient.losses.results import LIGHT, VALUES, Light, Volume, reads


@reads(input=LIGHT, target=LIGHT)
def squared_loss(input: Light, target: Light, *, mask: Tensor | None = None, reduction: Reduction = "mean") -> Tensor:
    """`|input - target|^2` of each element, real or complex, any shape. Symmetric. Raises ShapeError, UnitError."""
    check_reduction(reduction, "squared_loss")
    input, target = check_pair(input, target, "squared_loss", complex_too=True)
    mask = check_mask(mask, input, "squared_loss")
    return reduce(squared_modulus(counted(input, mask) - counted(target, mask)), reduction, "squared_loss", mask)


@reads(volume=VALUES, measured=LIGHT)
def measurement_consistency(
    volume: Volume,
    measured: Light,
    operator: Callable[[Tensor], Tensor],
    *,
    compare: PairLoss | PairModule = squared_loss,
    scale_invariant: bool = False,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """`compare(A volume, measured)`: what a volume would have measured against what was.

    `operator` is `A`: an operator of `tt.nlos` such as `FK`, or any function from `volume` (..., C, Z, Y, X) to the
    shape of `measured` (..., C, T, Y, X); `mask` is one of the measurement. `compare`: a function (input, target) with
    `mask` and `reduction`, of which `functools.partial` holds what else it wants, or a module of this room that holds
    the same `reduction`. Losses of torch.nn take no mask: write a function. With `scale_invariant` A volume is first
    multiplied by the real number that brings each item nearest to the measurement in least squares: powers of lasers
    and albedos are seldom calibrated. `dim`, where time is in the measurement, then says what is an item
    (`losses.layouts`); a function `compare` that wants it is told, and what `compare` holds is taken. That number may
    be negative, so keep volumes non-negative where their sign matters; it is 1 for a volume that is dark altogether,
    whose gradient then leads out of the dark.
    Not symmetric; zero where A volume is the measurement. Raises ShapeError where A volume is no tensor of the
    measurement's shape, and for another `compare`.
    """
    where = "measurement_consistency"
    check_held(reduction, dim, where)
    compared, known = _checked(operator, compare, scale_invariant, reduction, where)
    volume, measured = check_dense((volume, measured), where)
    prediction = operator(volume)
    if not isinstance(prediction, Tensor) or prediction.shape != measured.shape:
        got = tuple(prediction.shape) if isinstance(prediction, Tensor) else type(prediction).__name__
        raise ShapeError(
            f"{where}: expected the operator to make a tensor of the measurement's shape {tuple(measured.shape)} of a "
            f"volume {tuple(volume.shape)}, got {got}."
        )
    check_device(prediction, measured, where, "what the operator makes and the measurement")
    check_mask(mask, measured, where)
    dim = shared_dim(compare, known, dim, measured, where)
    if scale_invariant:
        pair = check_pair(prediction, measured, where, complex_too=True)
        prediction = _scaled(*pair, check_mask(mask, measured, where), item_dims(measured, dim, where))
    said = {"dim": dim} if dim is not None and "dim" in known else {}
    value = compared(prediction, measured, mask, **said)
    # of a tensor of one dimension, a record, even what is not reduced may be one number
    dims = value.ndim if isinstance(value, Tensor) else -1
    if dims < 0 or (dims > 0 if reduction != "none" else dims == 0 and measured.ndim > 1):
        got = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
        raise ArgumentError(f"{where}: expected compare to heed reduction {reduction!r}, got {got} of it.")
    return value


def _checked(
    operator: object, compare: PairLoss | PairModule, scale_invariant: bool, reduction: Reduction, where: str
) -> tuple[Callable[..., Tensor], dict[str, inspect.Parameter]]:
    """`compare` as a function (input, target, mask) with that reduction, and its parameters. Raises ShapeError."""
    function(f"{where}: the operator", operator, "tensors")
    flag(f"{where}: scale_invariant", scale_invariant)
    known = check_compare(compare, where, reduction)
    if not isinstance(compare, nn.Module):
        return functools.partial(_compared, compare, reduction), known
    held = getattr(compare, "reduction", None)
    if held != reduction:
        raise ArgumentError(
            f"{where}: expected reduction {reduction!r} of compare, too, got {type(compare).__name__} with {held!r}. "
            "Give both the same."
        )
    return cast(PairModule, compare), known


def _compared(
    compare: Callable[..., Tensor],
    reduction: Reduction,
    input: Tensor,
    target: Tensor,
    mask: Tensor | None,
    **said: int,
) -> Tensor:
    return compare(input, target, mask=mask, reduction=reduction, **said)


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
    power = squared_modulus(seen).sum(dims, keepdim=True)
    along = real_product(seen, counted(measured, mask)).sum(dims, keepdim=True)
    scale = torch.where(dark, torch.ones_like(along), along / torch.where(dark, torch.ones_like(power), power))
    return seen * scale


class SquaredLoss(nn.Module):
    """`squared_loss(input, target)` with its reduction held."""

    def __init__(self, reduction: Reduction = "mean") -> None:
        super().__init__()
        check_reduction(reduction, "SquaredLoss")
        self.reduction = reduction

    def forward(self, input: Light, target: Light, mask: Tensor | None = None) -> Tensor:
        return squared_loss(input, target, mask=mask, reduction=self.reduction)


class MeasurementConsistency(nn.Module):
    """`measurement_consistency(input, target)` of a volume and a measurement, with its operator and options held.

    An operator that is a module is a part of this one and moves with it.
    """

    def __init__(
        self,
        operator: Callable[[Tensor], Tensor],
        compare: PairLoss | PairModule = squared_loss,
        *,
        scale_invariant: bool = False,
        dim: int | None = None,
        reduction: Reduction = "mean",
    ) -> None:
        super().__init__()
        check_held(reduction, dim, "MeasurementConsistency")
        _checked(operator, compare, scale_invariant, reduction, "MeasurementConsistency")
        self.operator, self.compare = operator, compare
        self.scale_invariant, self.dim, self.reduction = scale_invariant, dim, reduction

    def forward(self, input: Volume, target: Light, mask: Tensor | None = None) -> Tensor:
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
