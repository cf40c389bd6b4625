"""Tables that kernels load four or two numbers at a time."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np


def packed(values: np.ndarray) -> Any:
    """A flat ``Float`` of the numbers, in memory of Dr.Jit's own.

    Dr.Jit lays its array over numpy's memory otherwise. Where that does not begin at a multiple of 16 bytes, which is
    chance, packets are loaded number by number, by a kernel of its own.
    """
    source = mi.Float(np.ravel(values).astype(np.float32))
    target = dr.empty(mi.Float, dr.width(source))
    dr.scatter(target, source, dr.arange(mi.UInt32, dr.width(source)))
    dr.eval(target)
    return target


def packed_columns(rows: list[list[Any]], count: int) -> Any:
    """A flat ``Float`` with ``rows`` of four numbers (``Float`` arrays) for each lane, one lane after the other, filled
    up with zeros to ``count`` lanes.
    """
    width = max(dr.width(column) for row in rows for column in row)
    target = dr.zeros(mi.Float, 4 * len(rows) * count)
    lane = dr.arange(mi.UInt32, width)
    for i, row in enumerate(rows):
        dr.scatter(target, mi.Vector4f(*row), lane * len(rows) + i)
    dr.eval(target)
    return target
