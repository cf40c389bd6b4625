"""Numbers of Dr.Jit in memory of numpy's."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import DTypeLike

# Bytes: the widest packet of Dr.Jit's LLVM.
_ALIGNMENT = 64


def host_numbers(value: Any, dtype: DTypeLike = np.float64) -> np.ndarray:
    """A copy of an array's numbers.

    Of a detached handle: Dr.Jit evaluates what it reads in place, and a literal that a scene shows to recordings would
    be another array afterwards.
    """
    return np.array(dr.detach(value), dtype=dtype)


def whole_numbers(values: np.ndarray) -> Any:
    """A copy of an array of numpy's as a ``mi.UInt32``."""
    return mi.UInt32(_aligned(values, np.uint32))


def floats(values: np.ndarray) -> Any:
    """A copy of an array of numpy's as a ``mi.Float``."""
    return mi.Float(_aligned(values, np.float32))


def _aligned(values: np.ndarray, dtype: DTypeLike) -> np.ndarray:
    """A copy (N,) where Dr.Jit's own arrays would lie: it shares memory with numpy, and kernels differ by how their
    arrays are aligned, so that others would be compiled in every process.
    """
    values = np.asarray(values, dtype).ravel()
    room = np.empty(values.nbytes + _ALIGNMENT, np.uint8)
    first = -room.ctypes.data % _ALIGNMENT
    copy = room[first : first + values.nbytes].view(dtype)
    copy[:] = values
    return copy
