"""Scrambled low-discrepancy points in the plane, in integer arithmetic of kernels."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

# Mitsuba's four leave seeds that follow each other so much alike that means over them are off by 6 % of a value whose
# standard deviation is 9 %.
ROUNDS = 16


def scrambled(x: Any, seed: Any) -> Any:
    """Owen's nested uniform scrambling of 32-bit fractions by a hash: every bit is flipped by a function of the bits
    above it (Laine and Karras 2011, Burley 2020; constants of Vegdahl 2021).
    """
    x = dr.brev(x)
    x ^= x * mi.UInt32(0x3D20ADEA)
    x += seed
    x *= (seed >> 16) | 1
    x ^= x * mi.UInt32(0x05526C56)
    x ^= x * mi.UInt32(0x53A22864)
    return dr.brev(x)


def plane_points(count: int, seed: Any, sets: int = 1) -> tuple[Any, Any]:
    """``count`` points of the unit square, (``Float64``, ``Float``), in ascending order of the first coordinate; of
    several ``sets``, with seeds of their own, one set after the other.

    Hammersley's set, the second coordinate scrambled, and both shifted by the same random part of ``1 / count`` (of the
    next power of two) for all points: every point is uniform by itself, so that means are unbiased, and with a power of
    two the points are a (0, m, 2)-net as those of Sobol's sequence are. What is sorted by the first coordinate needs no
    sorting afterwards. A common shift leaves half of the variance that shifts of their own would, where a bin of time
    is an interval of one coordinate. ``seed``: UInt32 of width one, in memory.
    """
    j = dr.arange(mi.UInt32, sets * count)
    number = j // dr.opaque(mi.UInt32, count)
    return plane_point(j - number * dr.opaque(mi.UInt32, count), count, seed, number)


def plane_point(j: Any, count: int, seed: Any, number: Any = 0) -> tuple[Any, Any]:
    """Point number ``j`` (UInt32) of the set ``number`` of :func:`plane_points`; ``seed`` (UInt32) may be another one
    in each lane, which then has a set of its own.
    """
    bits = max(1, (count - 1).bit_length())
    shift, key = mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(number), ROUNDS)
    below = dr.opaque(mi.UInt32, 2 ** (32 - bits) - 1)
    # The middle of the last bit keeps both coordinates inside of (0, 1).
    x = (mi.Float64(j) + (mi.Float64(shift) + 0.5) * 2.0**-32) / dr.opaque(mi.Float64, float(count))
    common = mi.sample_tea_32(shift, key, ROUNDS)[0]
    y = (scrambled(dr.brev(j), key) & ~below) | (common & below)
    return x, mi.Float(y >> 8) * 2.0**-24 + 2.0**-25
