"""Numbers of Dr.Jit in memory of numpy's."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import DTypeLike


def host_numbers(value: Any, dtype: DTypeLike = np.float64) -> np.ndarray:
    """A copy of an array's numbers.

    Of a detached handle: Dr.Jit evaluates what it reads in place, and a literal that a scene shows to recordings would
    be another array afterwards.
    """
    return np.array(dr.detach(value), dtype=dtype)


def whole_numbers(values: np.ndarray) -> Any:
    """An array of numpy's as a ``mi.UInt32`` in memory of Dr.Jit's own: what it shares with numpy may lie anywhere, and
    kernels differ by how their arrays are aligned.
    """
    shared = mi.UInt32(np.ascontiguousarray(values, np.uint32))
    return shared | dr.opaque(mi.UInt32, 0) if len(values) else shared
