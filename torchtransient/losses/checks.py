"""Parts of every loss: checks of pairs of tensors, options and masks; scales of items; reductions.

A mask is a boolean tensor that broadcasts to the tensors compared; True counts. Masked elements, NaN included, have no
part in value and gradient. Losses of whole records take masked bins for empty ones in both records, and leave out
pixels without any bin that counts.

The argument `where` of the checks is the name of the public function, which begins their messages.
"""

from __future__ import annotations

import functools
import math
from typing import Literal, cast, get_args

import torch
from torch import Tensor

from torchtransient.checks import count, finite, shown
from torchtransient.errors import ArgumentError, ShapeError, TorchTransientError, UnitError
from torchtransient.floating import is_true
from torchtransient.sensing.checks import refuse_cut_off
from torchtransient.units import SHORTEST_OPL

Reduction = Literal["none", "sum", "mean"]


def check_pair(
    input: object, target: object, where: str, *, complex_too: bool = False, names: str = "input and target"
) -> tuple[Tensor, Tensor]:
    """Return both tensors in their `working_dtype`.

    Args:
        input, target: dense tensors of one shape.
        where: begins the message.
        complex_too: take complex tensors.
        names: names of the two tensors in the message.

    Raises:
        ShapeError: for other types than dense tensors, and for two shapes, broadcastable or not.
        UnitError: for two integer tensors, and for complex ones unless `complex_too`.
    """
    input, target = check_dense((input, target), where)
    if input.shape != target.shape:
        raise ShapeError(f"{where}: expected {names} of one shape, got {tuple(input.shape)} and {tuple(target.shape)}.")
    dtype = working_dtype((input, target), where, complex_too=complex_too)
    return input.to(dtype), target.to(dtype)


def masked_pair(
    input: object, target: object, mask: Tensor | None, where: str, *, complex_too: bool = False, fill: float = 0.0
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Return both tensors of `check_pair`, input `fill` and target 0 where the mask does not count, and the mask.

    Args:
        input, target: dense tensors of one shape, see `check_pair`.
        complex_too: take complex tensors.
        mask: boolean tensor that broadcasts, None for all, see `check_mask`.
        where: begins the message.
        fill: value of masked elements of the input.
    """
    input, target = check_pair(input, target, where, complex_too=complex_too)
    mask = check_mask(mask, input, where)
    return counted(input, mask, fill), counted(target, mask), mask


def check_dense(tensors: tuple[object, ...], where: str) -> tuple[Tensor, ...]:
    """Return the tensors.

    Args:
        tensors: any objects.
        where: begins the message.

    Raises:
        ShapeError: for other types and for sparse tensors.
    """
    for x in tensors:
        if not isinstance(x, Tensor) or x.layout != torch.strided:
            raise ShapeError(f"{where}: expected dense tensors, got {shown(x)}.")
    return cast("tuple[Tensor, ...]", tensors)


def working_dtype(tensors: tuple[Tensor, ...], where: str, *, complex_too: bool = False) -> torch.dtype:
    """Return the dtype of a comparison: that of the most precise floating tensor, float32 at least.

    Integer and boolean tensors (counts, frames) have no say.

    Args:
        tensors: tensors that are compared.
        where: begins the message.
        complex_too: take complex tensors.

    Raises:
        UnitError: if all are integer or boolean, and for complex tensors unless `complex_too`.
    """
    dtypes = [x.dtype for x in tensors if x.dtype.is_floating_point or x.dtype.is_complex]
    if not dtypes:
        raise UnitError(f"{where}: expected a floating dtype, got {tensors[0].dtype}. Convert one with .float().")
    dtype = functools.reduce(torch.promote_types, map(_single, dtypes))
    if dtype.is_complex and not complex_too:
        raise UnitError(f"{where}: expected real numbers, got {dtype}. Give the modulus, or use phasor_loss.")
    return dtype


def _single(dtype: torch.dtype) -> torch.dtype:
    if dtype.is_complex:
        return torch.complex64 if dtype.itemsize < 8 else dtype
    return torch.float32 if dtype.itemsize < 4 else dtype


def check_level(
    name: str, value: Tensor | float, like: Tensor, where: str, *, zero: bool = False, square: bool = False
) -> Tensor:
    """Return a level (floor, background, width) in the precision of `like`.

    Args:
        value: number, or tensor that broadcasts to `like`; greater than zero (`zero`: or zero), and a normal number of
            the precision (`square`: its square too). Values of tensors are not checked under `torch.vmap`.

    Raises:
        UnitError: for other numbers; for a length (`..._opl`) below 0.3 fs, since that is a time in seconds.
        ShapeError: for a tensor that does not broadcast.
    """
    dtype = like.real.dtype if like.is_complex() else like.dtype
    limits = torch.finfo(dtype)
    least, most = (math.sqrt(limits.tiny), math.sqrt(limits.max)) if square else (limits.tiny, limits.max)
    length = name.endswith("_opl")
    least = max(least, SHORTEST_OPL) if length else least
    if isinstance(value, Tensor):
        if value.is_complex() or value.dtype == torch.bool:
            raise UnitError(f"{where}: expected {name} of real numbers, got {value.dtype}.")
        expanded(value, like, name, where)
        # of whole numbers and narrower ones in the precision they are used in
        level = value if value.dtype == torch.float64 else value.to(dtype)
        fits = is_true((level >= least) & (level <= most) | (level == 0 if zero else torch.zeros_like(level).bool()))
    else:
        number = check_number(name, value, where)
        fits = least <= number <= most or (zero and number == 0)
    if not fits:
        got = "some that are not" if isinstance(value, Tensor) and value.ndim else shown(value)
        name += " in metres of optical path," if length else ""
        hint = " Seconds? Times 299792458 they are metres." if length else ""
        raise UnitError(
            f"{where}: expected {name} {'of zero or ' if zero else ''}greater than zero ({least:.2g} to {most:.1g}), "
            f"got {got}.{hint}"
        )
    return value.to(like.device, dtype) if isinstance(value, Tensor) else like.new_full((), number, dtype=dtype)


def expanded(x: Tensor, like: Tensor, name: str, where: str) -> Tensor:
    """Return a tensor in the shape of another one.

    Args:
        x: any tensor.
        like: tensor of the wanted shape.
        name: name of `x` in the message.
        where: begins the message.

    Raises:
        ShapeError: unless it broadcasts.
    """
    try:
        return x.expand(like.shape)
    except RuntimeError:
        raise ShapeError(
            f"{where}: expected a {name} that broadcasts to {tuple(like.shape)}, got {tuple(x.shape)}. For each pixel "
            "of a transient (..., C, T, Y, X) it has T = 1."
        ) from None


def check_number(name: str, value: object, where: str) -> float:
    """Return one finite number.

    Args:
        name: name of the number in the message.
        value: number of any type.
        where: begins the message.

    Raises:
        UnitError: for other values.
        GradientError: for a tensor with a gradient, which a number would drop.
    """
    refuse_cut_off(value, name, where)
    return finite(f"{where}: {name}", value)


def check_whole(name: str, value: object, where: str, error: type[TorchTransientError] = ShapeError) -> int:
    """Return a whole number of at least 1; 3.0 is one.

    Args:
        name: name of the number in the message.
        value: number of any type.
        where: begins the message.
        error: raised for numbers that are not whole or below 1.

    Raises:
        UnitError: for no number.
    """
    check_number(name, value, where)
    return count(f"{where}: {name}", value, 1, error)


def check_mask(mask: Tensor | None, like: Tensor, where: str) -> Tensor | None:
    """Return the mask expanded to the shape of `like`.

    Args:
        mask: boolean tensor, or None.
        like: tensor that is masked.
        where: begins the message.

    Raises:
        ShapeError: unless it broadcasts.
        UnitError: unless it is boolean (0.5 would count as True).
    """
    if mask is None:
        return None
    if not isinstance(mask, Tensor) or mask.dtype != torch.bool:
        kind = mask.dtype if isinstance(mask, Tensor) else type(mask).__name__
        raise UnitError(f"{where}: expected a mask of truth values, True where it counts, got {kind}. Use mask > 0.")
    return expanded(mask, like, "mask", where)


def counted(x: Tensor, mask: Tensor | None, fill: float = 0.0) -> Tensor:
    """Return `x` where the mask counts, and `fill` without gradient elsewhere.

    Args:
        x: tensor of any shape.
        mask: boolean tensor of the same shape, None for all.
        fill: value of masked elements.
    """
    # where on the input: a NaN that is replaced after the arithmetic still has a NaN gradient
    return x if mask is None else torch.where(mask, x, torch.full_like(x, fill))


def squared_modulus(x: Tensor) -> Tensor:
    """Return `|x|^2`, with a finite slope at zero.

    Args:
        x: real or complex, any shape.
    """
    return x.real.square() + x.imag.square() if x.is_complex() else x.square()


def real_product(x: Tensor, y: Tensor) -> Tensor:
    """Return `Re(x conj(y))`.

    Args:
        x, y: two real or two complex tensors of one shape.
    """
    return x.real * y.real + x.imag * y.imag if x.is_complex() else x * y


def reduce(value: Tensor, reduction: Reduction, where: str, mask: Tensor | None = None) -> Tensor:
    """Return the values, their sum, or their mean over the elements that count; 0 where nothing counts.

    Args:
        value: loss of each element.
        reduction: "none", "sum" or "mean".
        where: begins the message.
        mask: boolean tensor of the same shape, None for all.

    Raises:
        ArgumentError: for another reduction.
    """
    if reduction not in get_args(Reduction):
        raise ArgumentError(f"{where}: expected reduction 'none', 'sum' or 'mean', got {shown(reduction)}.")
    value = counted(value, mask)
    if reduction == "none":
        return value
    if reduction == "sum":
        return value.sum()
    if mask is None:
        return value.mean() if value.numel() else value.sum()
    return value.sum() / mask.sum().clamp_min(1)


def item_mean(x: Tensor, dims: tuple[int, ...], mask: Tensor | None = None) -> Tensor:
    """Return the mean of `|x|` over the counted elements of each item, detached.

    Args:
        x: tensor of any shape.
        dims: dimensions of an item, see `layouts.item_dims`.
        mask: boolean tensor of the same shape, None for all.

    Returns:
        Tensor that broadcasts to `x`.
    """
    size = counted(x.detach(), mask).abs()
    if not dims:  # torch takes no dimensions for all of them
        return size
    if mask is None:
        return size.mean(dims, keepdim=True)
    return size.sum(dims, keepdim=True) / mask.sum(dims, keepdim=True).clamp_min(1)


def item_scale(x: Tensor, other: Tensor, dims: tuple[int, ...], mask: Tensor | None = None) -> Tensor:
    """Return `item_mean` of `x`, or that of `other` where `x` is all zero, or 1 where both are.

    Args:
        x, other: two tensors of one shape.
        dims: dimensions of an item, see `layouts.item_dims`.
        mask: boolean tensor of the same shape, None for all.
    """
    own, others = item_mean(x, dims, mask), item_mean(other, dims, mask)
    scale = torch.where(own > 0, own, others)
    return torch.where(scale > 0, scale, torch.ones_like(scale))
