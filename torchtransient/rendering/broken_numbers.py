"""Adjoints and tangents that are NaN or infinite: they go on into what they touch, so that nobody takes a broken step
for a small one.

Dr.Jit cannot be left to it. Where the lanes of a kernel add up at one place, those that hold nothing but NaN are taken
to hold nothing (``scatter_reduce``, and with it the derivative of ``gather``): a sum of them is a gradient of zero.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

import torch

from torchtransient.scene.physics import are_finite, smallest_and_largest

Tensors = tuple[torch.Tensor, ...]


def all_finite(tensor: torch.Tensor) -> bool:
    """Whether a real tensor holds numbers alone. What ``expand`` has repeated is looked at once."""
    for dim, stride in enumerate(tensor.stride()):
        if stride == 0 and tensor.shape[dim] > 1:
            tensor = tensor.narrow(dim, 0, 1)
    return are_finite(*smallest_and_largest(tensor))


def broken_entries(tensor: torch.Tensor, count: int) -> list[bool]:
    """For each of ``count`` entries along the first dimension, whether it is not finite."""
    return [False] * count if all_finite(tensor) else [not all_finite(tensor[n]) for n in range(count)]


def carried_on(derivative: Callable[[Sequence[torch.Tensor]], Tensors], given: Sequence[torch.Tensor]) -> Tensors:
    """A derivative, linear in the adjoints or tangents ``given``, that is NaN wherever one that is not finite arrives.

    What those touch is found by a derivative of its own, with other numbers in their places and zero in all others: it
    is run only where there are any.
    """
    found = derivative(given)
    if all(map(all_finite, given)):
        return found
    touched = derivative([_marks(tensor) for tensor in given])
    return tuple(torch.where(mark == 0, value, math.nan) for value, mark in zip(found, touched, strict=True))


def _marks(tensor: torch.Tensor) -> torch.Tensor:
    # Numbers between one and two that are not alike: a difference of two places must not cancel.
    numbers = torch.arange(tensor.numel(), dtype=torch.float64, device=tensor.device).mul(0.6180339887498949).frac() + 1
    return torch.where(torch.isfinite(tensor), 0.0, numbers.reshape(tensor.shape).to(tensor.dtype))


def fill_broken(tensors: Iterable[torch.Tensor]) -> None:
    """NaN in place of all their numbers."""
    for tensor in tensors:
        tensor.fill_(math.nan)
