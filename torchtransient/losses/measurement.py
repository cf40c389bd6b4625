"""Consistency of a hidden volume with its measurement under any loss."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, Protocol, cast

import torch
from torch import Tensor, nn

from torchtransient.errors import ArgumentError, ShapeError
from torchtransient.losses.checks import (
    Reduction,
    check_dense,
    check_mask,
    check_pair,
    counted,
    real_product,
    squared_modulus,
)
from torchtransient.losses.layouts import item_dims, time_dim
from torchtransient.losses.loss_module import LossModule
from torchtransient.losses.results import LIGHT, VALUES, Light, Volume, reads
from torchtransient.losses.squared import squared_loss


class PairLoss(Protocol):
    """A loss of two tensors; `functools.partial` holds further options."""

    def __call__(self, input: Tensor, target: Tensor, *, mask: Tensor | None, reduction: Reduction) -> Tensor: ...


@reads(volume=VALUES, measured=LIGHT)
def measurement_consistency(
    volume: Volume,
    measured: Light,
    operator: Callable[[Tensor], Tensor],
    *,
    compare: PairLoss | nn.Module = squared_loss,
    scale_invariant: bool = False,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Compare the measurement that a volume predicts with the one that was made, `compare(operator(volume), measured)`.

    Args:
        volume: volume (..., C, Z, Y, X).
        measured: measurement (..., C, T, Y, X).
        operator: operator of `tt.nlos` such as `FK`, or any function from a volume to the shape of the measurement.
        compare: loss `(input, target, *, mask, reduction)`, of which `functools.partial` holds further options, or a
            module of `tt.losses` with the same `reduction`. Losses of `torch.nn` take no mask: wrap them in a function.
        scale_invariant: multiply the prediction of each item by the real number that brings it nearest to the
            measurement in least squares, since powers and albedos are seldom calibrated. The number may be negative; it
            is 1 for a dark volume, whose gradient then leads out of the dark.
        dim: dimension of time in the measurement, which says what an item is (`losses.layouts`); given to `compare`
            where it takes one, and taken from there where it holds one.
        mask: elements of the measurement that count.
        reduction: "mean", "sum" or "none".

    Returns:
        Result of `compare`.

    Raises:
        ShapeError: for a prediction of another shape than the measurement's.
        ArgumentError: for a module with another reduction, or a `compare` with another `dim`.
    """
    where = "measurement_consistency"
    held = getattr(compare, "reduction", None)
    if isinstance(compare, nn.Module) and held != reduction:
        raise ArgumentError(f"{where}: expected compare of reduction {reduction!r}, got {held!r}. Give both the same.")
    volume, measured = check_dense((volume, measured), where)
    prediction = operator(volume)
    if prediction.shape != measured.shape:
        raise ShapeError(
            f"{where}: expected a prediction of the measurement's shape {tuple(measured.shape)} from the operator, got "
            f"{tuple(prediction.shape)} of a volume {tuple(volume.shape)}."
        )
    dim = shared_dim(compare, dim, measured, where)
    if scale_invariant:
        pair = check_pair(prediction, measured, where, complex_too=True)
        prediction = _scaled(*pair, check_mask(mask, measured, where), item_dims(measured, dim, where))
    if isinstance(compare, nn.Module):
        return cast(Tensor, compare(prediction, measured, mask))
    options: dict[str, Any] = {"dim": dim} if dim is not None and takes_dim(compare) else {}
    return compare(prediction, measured, mask=mask, reduction=reduction, **options)


class MeasurementConsistency(LossModule, function=measurement_consistency, by_place=("operator", "compare")):
    """`measurement_consistency` of (volume, measured), with its operator and options held.

    An operator or a `compare` that is a module is a submodule and moves with this one.
    """


def takes_dim(compare: object) -> bool:
    """Return True for a function with an argument `dim`.

    Args:
        compare: function of two tensors.
    """
    return "dim" in inspect.signature(cast(Callable[..., Any], compare)).parameters


def shared_dim(compare: object, dim: int | None, like: Tensor, where: str) -> int | None:
    """Return the dimension of time, as given or as `compare` holds it.

    Args:
        compare: function or module that compares.
        dim: dimension of time as the caller gave it, or None.
        like: the record.
        where: begins the message.

    Raises:
        ArgumentError: if both are there and differ.
    """
    held = getattr(compare, "dim", None)
    if not isinstance(compare, nn.Module) and takes_dim(compare):
        held = inspect.signature(cast(Callable[..., Any], compare)).parameters["dim"].default
    places = {time_dim(like, place, where) for place in (dim, held) if place not in (None, inspect.Parameter.empty)}
    if len(places) > 1:
        raise ArgumentError(
            f"{where}: expected time in one dimension, got dim={dim}, and dim={held} held by compare. Leave one out."
        )
    return next(iter(places), None)


def _scaled(prediction: Tensor, measured: Tensor, mask: Tensor | None, dims: tuple[int, ...]) -> Tensor:
    """Scale each item of the prediction to least squares of the measurement."""
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
