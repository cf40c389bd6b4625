"""Scrambled low-discrepancy points in the plane, in integer arithmetic of kernels."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

# Mitsuba's four leave seeds that follow each other so much alike that means over them are off by 6 % of a value whose
# standard deviation is 9 %.
ROUNDS = 16


def scrambled(x: Any, seed: Any) -> Any:
    """Return 32-bit fractions in Owen's nested uniform scrambling.

    By a hash: every bit is flipped by a function of the bits above it (Laine and Karras 2011, Burley 2020; constants of
    Vegdahl 2021).

    Args:
        x: fractions, UInt32.
        seed: UInt32.
    """
    x = dr.brev(x)
    x ^= x * mi.UInt32(0x3D20ADEA)
    x += seed
    x *= (seed >> 16) | 1
    x ^= x * mi.UInt32(0x05526C56)
    x ^= x * mi.UInt32(0x53A22864)
    return dr.brev(x)


def hashed(x: Any) -> Any:
    """Return a bijective hash of 32 bits (constants of Wellons' lowbias32).

    Args:
        x: UInt32.
    """
    x = mi.UInt32(x)
    x ^= x >> 16
    x *= mi.UInt32(0x7FEB352D)
    x ^= x >> 15
    x *= mi.UInt32(0x846CA68B)
    return x ^ (x >> 16)


def sobol_second(index: Any) -> Any:
    """Return the second coordinate of Sobol's points, a ``UInt32`` fraction; the first one is ``dr.brev(index)``.

    Its direction numbers are the rows of Pascal's triangle modulo 2, which five steps multiply with.

    Args:
        index: numbers of the points, UInt32.
    """
    x = dr.brev(mi.UInt32(index))
    for shift, mask in ((16, 0x0000FFFF), (8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        x ^= (x & mi.UInt32(mask)) << shift
    return x


def second_pair(index: Any) -> Any:
    """Return numbers of Sobol's points that, beside those of ``index``, spread evenly in four dimensions.

    A linear map of the bits, triangular, so that of every aligned block of ``2^m`` indices both pairs are nets. Of 16,
    64, 256, 1024 points the four coordinates are a (t, m, 4)-net of t = 1, 2, 2, 3, where Sobol's first four have 2, 2,
    3, 2; of ``2^12`` to ``2^20`` points t is 4 to 6, of ``2^23`` 7, where Sobol's stays at 3 and its second pair is no
    net. The best of some million products of shifts: each
    step brings higher bits down, without which many points would fill the same few boxes again and again.

    Args:
        index: numbers of points, UInt32.

    Returns:
        Numbers of the points whose two coordinates are the third and the fourth one, UInt32.
    """
    x = mi.UInt32(index)
    for shift, mask in (
        (3, 0x0F0F0F0F), (3, 0x33333333), (5, 0x24924924), (8, 0xFFFF00FF), (10, 0xFFFF00FF), (7, 0xFFFFFFFF),
        (6, 0x8F9CE4D7),
    ):  # fmt: skip
        x ^= (x & mi.UInt32(mask)) >> shift
    return x


def plane_points(count: int, seed: Any, sets: int = 1) -> tuple[Any, Any]:
    """Return points of the unit square, in ascending order of the first coordinate.

    Args:
        count: number of points of each set.
        seed: UInt32 of width one, in memory.
        sets: number of sets, each with its own seed.

    Returns:
        (``Float64``, ``Float``): both coordinates, one set after the other.

    Hammersley's set, the second coordinate scrambled, and both shifted by the same random part of ``1 / count`` (of the
    next power of two) for all points: every point is uniform by itself, so that means are unbiased, and with a power of
    two the points are a (0, m, 2)-net as those of Sobol's sequence are. The points are sorted by the
    first coordinate already. A common shift leaves half of the variance that shifts of their own would, where a bin of
    time is an interval of one coordinate.
    """
    j = dr.arange(mi.UInt32, sets * count)
    number = j // dr.opaque(mi.UInt32, count)
    return plane_point(j - number * dr.opaque(mi.UInt32, count), count, seed, number)


def plane_point(j: Any, count: int, seed: Any, number: Any = 0) -> tuple[Any, Any]:
    """Return points of a set of :func:`plane_points` by their numbers.

    Args:
        j: number of the point, UInt32.
        count: number of points of the set.
        seed: UInt32, of one lane or of each, which then has a set of its own.
        number: number of the set.

    Returns:
        (``Float64``, ``Float``): both coordinates.
    """
    bits = max(1, (count - 1).bit_length())
    shift, key = mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(number), ROUNDS)
    below = dr.opaque(mi.UInt32, 2 ** (32 - bits) - 1)
    # The middle of the last bit keeps both coordinates inside of (0, 1).
    x = (mi.Float64(j) + (mi.Float64(shift) + 0.5) * 2.0**-32) / dr.opaque(mi.Float64, float(count))
    common = mi.sample_tea_32(shift, key, ROUNDS)[0]
    y = (scrambled(dr.brev(j), key) & ~below) | (common & below)
    return x, unit_float(y)


# --------------------------------------- sobol's points in some dimensions, scrambled, in integer arithmetic of kernels

# Primitive polynomials and first direction numbers of the dimensions after the first one (Joe and Kuo 2008).
_INITIAL = [
    (0, (1,)), (1, (1, 3)), (1, (1, 3, 1)), (2, (1, 1, 1)), (1, (1, 1, 3, 3)), (4, (1, 3, 5, 13)),
    (2, (1, 1, 5, 5, 17)), (4, (1, 1, 5, 5, 5)), (7, (1, 1, 7, 11, 19)), (11, (1, 1, 5, 1, 1)), (13, (1, 1, 1, 3, 11)),
    (14, (1, 3, 5, 5, 31)), (1, (1, 3, 3, 9, 7, 49)),
]  # fmt: skip
DIMENSIONS = 1 + len(_INITIAL)
_BITS = 32


def _directions(dimension: int) -> list[int]:
    """Return the direction numbers of a dimension, one 32-bit fraction per bit of an index."""
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
    """Return a coordinate of Sobol's points, scrambled: a ``UInt32`` fraction.

    Each point by itself is uniform. Of every block of ``2^m`` indices that starts at a multiple of it the points are
    evenly spread, and those of neighbouring blocks fill each other's gaps.

    Args:
        index: numbers of the points, UInt32.
        dimension: number of the coordinate, 0 to ``DIMENSIONS - 1``.
        seed: UInt32 of width one, in memory, which scrambles every dimension in its own way.
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
    """Return a ``Float`` in (0, 1) from a 32-bit fraction.

    Args:
        bits: UInt32.
    """
    # With one more bit the largest would be rounded to one.
    return mi.Float(bits >> 9) * 2.0**-23 + 2.0**-24


def unit_double(bits: Any) -> Any:
    """Return a ``Float64`` in (0, 1) from a 32-bit fraction.

    Args:
        bits: UInt32.
    """
    return (mi.Float64(bits) + 0.5) * 2.0**-32
