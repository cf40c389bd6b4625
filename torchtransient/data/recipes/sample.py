"""What a recipe's sample is, and its arrays in the order that they are stored in."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

# Numbers from which on arrays are turned in blocks, and pixels of a block.
_LARGE, _BLOCK = 2**15, 64


@dataclass(frozen=True, eq=False)
class Sample:
    """One sample of a recipe, in memory.

    ``index``: its number. ``seed``: of the render, 0 to 2^32 - 1. ``arrays``: what is stored, in torch's layout:
    ``transient`` float32 (C, T, H, W) or ``phasor`` complex64 (C, F, H, W), ``gated`` (C, G, H, W), ``rates`` (C, R, T,
    H, W), ``beats`` (C, 2, T, H, W), ``steady`` (C, H, W), labels, ``measurement``; leading dimensions as in
    :class:`~torchtransient.RenderOutput`; a capture has its scan's shape behind T. ``values``: what was drawn, by key:
    numbers as arrays, everything else as a text. ``outside``: shares of the light before and after the window.
    ``structure``: which of the recipe's scenes.
    """

    index: int
    seed: int
    _: KW_ONLY
    arrays: dict[str, NDArray[Any]]
    values: dict[str, NDArray[Any] | str] = field(default_factory=dict)
    outside: tuple[float, float] = (0.0, 0.0)
    structure: str = ""

    def tensors(self) -> dict[str, torch.Tensor]:
        """``arrays`` as tensors, on the same memory."""
        return {name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in self.arrays.items()}

    def __repr__(self) -> str:
        shapes = ", ".join(f"{name} {array.shape}" for name, array in self.arrays.items())
        return f"Sample({self.index}: {shapes}; drawn: {', '.join(self.values) or 'nothing'})"


def in_order(tensor: torch.Tensor) -> NDArray[Any]:
    """A tensor as an array in C order. Films have the pixels first in memory and torch has them last: a copy from end
    to end would meet one line of the cache again and again where bins are a power of two.
    """
    array: NDArray[Any] = tensor.cpu().numpy()
    pixels = array.shape[-1] * array.shape[-2] if array.ndim > 2 else 0
    if array.flags.c_contiguous or array.size < _LARGE or pixels < _BLOCK:
        return np.ascontiguousarray(array)
    found = np.empty(array.shape, array.dtype)
    target = found.reshape(*array.shape[:-2], pixels)
    try:
        source = tensor.view(target.shape).cpu().numpy()
    except RuntimeError:
        # Rows and columns are no single axis in memory.
        return np.ascontiguousarray(array)
    for first in range(0, pixels, _BLOCK):
        target[..., first : first + _BLOCK] = source[..., first : first + _BLOCK]
    return found
