"""Sobol's points in some dimensions, scrambled, in integer arithmetic of kernels."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.sampling.point_sets import scrambled

# Primitive polynomials and first direction numbers of the dimensions after the first one (Joe and Kuo 2008).
_INITIAL = [
    (0, (1,)), (1, (1, 3)), (1, (1, 3, 1)), (2, (1, 1, 1)), (1, (1, 1, 3, 3)), (4, (1, 3, 5, 13)),
    (2, (1, 1, 5, 5, 17)), (4, (1, 1, 5, 5, 5)), (7, (1, 1, 7, 11, 19)), (11, (1, 1, 5, 1, 1)), (13, (1, 1, 1, 3, 11)),
    (14, (1, 3, 5, 5, 31)), (1, (1, 3, 3, 9, 7, 49)),
]  # fmt: skip
DIMENSIONS = 1 + len(_INITIAL)
_BITS = 32


def _directions(dimension: int) -> list[int]:
    """What each bit of an index adds, 32-bit fractions."""
    if dimension == 0:
        return [1 << (_BITS - 1 - i) for i in range(_BITS)]
    polynomial, m = _INITIAL[dimension - 1]
    degree = len(m)
    v = [m[i] << (_BITS - 1 - i) for i in range(degree)]
    for i in range(degree, _BITS):
        new = v[i - degree] ^ (v[i - degree] >> degree)
        for k in range(1, degree):
            if (polynomial >> (degree - 1 - k)) & 1:
                new ^= v[i - k]
        v.append(new)
    return v


def sobol(index: Any, dimension: int, seed: Any) -> Any:
    """Coordinate ``dimension`` (0 to ``DIMENSIONS - 1``) of the points ``index`` (UInt32): a ``UInt32`` fraction.

    ``seed`` (UInt32 of width one, in memory) scrambles every dimension in its own way, so that each point by itself is
    uniform. Of every block of ``2^m`` indices that starts at a multiple of it the points are evenly spread, and those
    of neighbouring blocks fill each other's gaps.
    """
    if dimension == 0:
        bits = dr.brev(index)
    else:
        bits = mi.UInt32(0)
        for i, v in enumerate(_directions(dimension)):
            bits ^= dr.select((index >> i) & 1 == 1, mi.UInt32(v), 0)
    key = mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(0x5D588B65 + dimension))[0]
    return scrambled(bits, key)


def unit_float(bits: Any) -> Any:
    """A ``Float`` in (0, 1) from a 32-bit fraction."""
    return mi.Float(bits >> 8) * 2.0**-24 + 2.0**-25


def unit_double(bits: Any) -> Any:
    """A ``Float64`` in (0, 1) from a 32-bit fraction."""
    return (mi.Float64(bits) + 0.5) * 2.0**-32
