"""What a recipe's sample is."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Sample:
    """One sample of a recipe, in memory.

    ``index``: its number. ``seed``: of the render, 0 to 2^32 - 1. ``arrays``: what is stored, in torch's layout:
    ``transient`` float32 (C, T, H, W) or ``phasor`` complex64 (C, F, H, W) or ``gated`` (C, G, H, W), ``steady`` (C, H,
    W), labels, ``measurement``; leading dimensions as in :class:`~torchtransient.RenderOutput`; a capture has its
    scan's shape behind T. ``values``: what was drawn, by key: numbers as arrays, everything else as a text.
    ``outside``: shares of the light before and after the window. ``structure``: which of the recipe's scenes.
    """

    index: int
    seed: int
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
