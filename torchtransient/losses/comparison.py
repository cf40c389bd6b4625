"""What losses share: pairs of tensors of one shape, masks, scales of items, reductions.

A mask is a boolean tensor that broadcasts to the tensors compared; True counts. What it leaves out has no part in the
value and none in the gradient, whatever stands there (NaN of a dead pixel, too). A loss of whole records reads bins
that do not count as empty in both, and leaves out the pixels that have no bin left.
"""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor

from torchtransient.errors import DeviceError, ShapeError, UnitError

Reduction = Literal["none", "sum", "mean"]

# An item of a batch: its C, T, Y, X.
ITEM_DIMS = 4


def check_reduction(reduction: Reduction, where: str) -> None:
    if reduction not in get_args(Reduction):
        raise ShapeError(f"{where}: expected reduction 'none', 'sum' or 'mean', got {reduction!r}.")


def check_pair(input: Tensor, target: Tensor, where: str, *, complex_too: bool = False) -> tuple[Tensor, Tensor]:
    """Both in their common dtype: half precision in float32, as networks give it under autocast, integer counts as the
    floats of the other. Raises ShapeError for no tensors or two shapes, UnitError for other numbers, DeviceError.
    """
    if not isinstance(input, Tensor) or not isinstance(target, Tensor):
        raise ShapeError(f"{where}: expected two tensors, got {type(input).__name__} and {type(target).__name__}.")
    if input.shape != target.shape:
        raise ShapeError(
            f"{where}: expected input and target of one shape, got {tuple(input.shape)} and {tuple(target.shape)}."
        )
    if input.device != target.device:
        raise DeviceError(
            f"{where}: expected input and target on one device, got {input.device} and {target.device}. Move one of "
            "them with .to(device)."
        )
    dtype = working_dtype(torch.promote_types(input.dtype, target.dtype), where, complex_too=complex_too)
    return input.to(dtype), target.to(dtype)


def working_dtype(dtype: torch.dtype, where: str, *, complex_too: bool = False) -> torch.dtype:
    """float32 for half precision, the dtype itself for others that are floating. Raises UnitError."""
    if dtype.is_complex:
        if not complex_too:
            raise UnitError(f"{where}: expected real numbers, got {dtype}. Give the modulus, or use phasor_loss.")
        return torch.complex64 if dtype == torch.complex32 else dtype
    if not dtype.is_floating_point:
        raise UnitError(f"{where}: expected a floating dtype, got {dtype}. Convert one of the two with .float().")
    return torch.float32 if dtype in (torch.float16, torch.bfloat16) else dtype


def check_mask(mask: Tensor | None, shape: torch.Size, where: str) -> Tensor | None:
    """The mask, expanded to `shape`. Raises ShapeError unless it broadcasts to it, UnitError unless it is boolean."""
    if mask is None:
        return None
    if not isinstance(mask, Tensor) or mask.dtype != torch.bool:
        kind = mask.dtype if isinstance(mask, Tensor) else type(mask).__name__
        raise UnitError(f"{where}: expected a mask of truth values, True where it counts, got {kind}. Use mask > 0.")
    try:
        return mask.expand(shape)
    except RuntimeError:
        raise ShapeError(
            f"{where}: expected a mask that broadcasts to {tuple(shape)}, got {tuple(mask.shape)}. A mask of pixels "
            "of a transient (..., C, T, Y, X) has T = 1."
        ) from None


def counted(x: Tensor, mask: Tensor | None, fill: float = 0.0) -> Tensor:
    """`x` where the mask counts, `fill` elsewhere, without a gradient there."""
    # where on the input: a NaN that is replaced after the arithmetic still has a NaN gradient
    return x if mask is None else torch.where(mask, x, torch.full_like(x, fill))


def reduce(value: Tensor, reduction: Reduction, where: str, mask: Tensor | None = None) -> Tensor:
    """The values, their sum or their mean over what counts; 0 where nothing does."""
    check_reduction(reduction, where)
    value = counted(value, mask)
    if reduction == "none":
        return value
    if reduction == "sum":
        return value.sum()
    return value.mean() if mask is None else value.sum() / mask.sum().clamp_min(1)


def item_mean(x: Tensor, mask: Tensor | None = None) -> Tensor:
    """Mean of `|x|` over what counts of each item (its last four dimensions), without gradient; broadcasts to `x`."""
    size = counted(x.detach(), mask).abs()
    dims = tuple(range(-min(ITEM_DIMS, size.ndim), 0))
    if mask is None:
        return size.mean(dims, keepdim=True) if size.numel() else size.sum(dims, keepdim=True)
    return size.sum(dims, keepdim=True) / mask.sum(dims, keepdim=True).clamp_min(1)


def item_scale(x: Tensor, other: Tensor, mask: Tensor | None = None) -> Tensor:
    """`item_mean` of `x`; that of `other` where `x` is dark altogether, and 1 where both are."""
    own, others = item_mean(x, mask), item_mean(other, mask)
    scale = torch.where(own > 0, own, others)
    return torch.where(scale > 0, scale, torch.ones_like(scale))
