"""Adjoints and tangents that are NaN or infinite, and the derivatives that they reach, which become NaN.

Dr.Jit loses them: ``scatter_reduce``, and with it the derivative of ``gather``, skips lanes of NaN, and the sum is a
gradient of zero.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

import torch

from torchtransient.scene.physics import all_finite

Tensors = tuple[torch.Tensor, ...]


def broken_entries(tensor: torch.Tensor, count: int) -> list[bool]:
    """Return for each entry along the first dimension of size ``count`` whether it has numbers that are not finite.

    Args:
        tensor: tensor (count, ...).
        count: number of entries.
    """
    return [False] * count if all_finite(tensor) else [not all_finite(tensor[n]) for n in range(count)]


def spread_nan(derivative: Callable[[Sequence[torch.Tensor]], Tensors], given: Sequence[torch.Tensor]) -> Tensors:
    """Evaluate a derivative whose result is NaN wherever an adjoint or tangent that is not finite contributes.

    Args:
        derivative: function of adjoints or tangents, linear in them.
        given: adjoints or tangents.

    Only if some are not finite, a second evaluation finds the places: with marks in their places, zero elsewhere.
    """
    result = derivative(given)
    if all(map(all_finite, given)):
        return result
    touched = derivative([_marks(tensor) for tensor in given])
    return tuple(torch.where(mark == 0, value, math.nan) for value, mark in zip(result, touched, strict=True))


def _marks(tensor: torch.Tensor) -> torch.Tensor:
    # Different numbers between one and two: a difference of two places must not cancel.
    numbers = torch.arange(tensor.numel(), dtype=torch.float64, device=tensor.device).mul(0.6180339887498949).frac() + 1
    return torch.where(torch.isfinite(tensor), 0.0, numbers.reshape(tensor.shape).to(tensor.dtype))


def fill_broken(tensors: Iterable[torch.Tensor]) -> None:
    """Fill tensors with NaN in place.

    Args:
        tensors: tensors of any shapes.
    """
    for tensor in tensors:
        tensor.fill_(math.nan)
