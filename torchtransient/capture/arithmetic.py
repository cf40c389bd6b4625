"""What captures are computed in. Files hold numbers of all kinds, and few of them can be added or subtracted as they
are: whole numbers wrap around, half precision overflows, and torch has no arithmetic for some.
"""

from __future__ import annotations

import torch
from torch import Tensor


def precision_of(tensor: Tensor) -> torch.dtype:
    """float64 of captures in double precision, else float32: what operators compute in."""
    return torch.float64 if tensor.dtype == torch.float64 else torch.float32


def computed(tensor: Tensor) -> Tensor:
    """Measured numbers of any kind as those that arithmetic is done with, by :func:`precision_of`."""
    return tensor.to(precision_of(tensor))


def summed(tensor: Tensor, dim: int) -> Tensor:
    """The sum over a dimension. Counts stay whole (int64; those of uint64, which int64 cannot hold, are float64), other
    numbers are :func:`computed`.
    """
    if tensor.is_floating_point():
        return computed(tensor).sum(dim)
    wide = torch.float64 if tensor.dtype == torch.uint64 else torch.int64
    return tensor.to(wide).sum(dim)
