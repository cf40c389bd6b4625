"""The modified Bessel function of order zero, scaled so that it never overflows, in single precision with its slope.

    I0(x) exp(-x),   of slope   (I1(x) - I0(x)) exp(-x)

Both orders are nearly equal for large arguments, so that the difference is not taken of values but of the
coefficients of their asymptotic series. That one is used beyond x = 10, where its last term is below rounding, and
the power series before it.

References: Abramowitz and Stegun, Handbook of Mathematical Functions, 9.6.10 and 9.7.1.
"""

from __future__ import annotations

from math import factorial, pi, prod
from typing import Any

import drjit as dr

# Where one series takes over from the other.
BORDER = 10.0
_POWERS, _INVERSE_POWERS = 21, 12


def _power_coefficients(order: int) -> list[float]:
    """Of ``(x / 2)^order sum_k c_k (x^2 / 4)^k``."""
    return [1 / (factorial(k) * factorial(k + order)) for k in range(_POWERS)]


def _asymptotic_coefficients(order: int) -> list[float]:
    """Of ``exp(x) / sqrt(2 pi x) sum_k c_k / x^k``."""
    return [
        prod((2 * j - 1) ** 2 - 4 * order**2 for j in range(1, k + 1)) / (factorial(k) * 8**k)
        for k in range(_INVERSE_POWERS)
    ]


_SMALL_0, _SMALL_1 = (_power_coefficients(order) for order in (0, 1))
_LARGE_0 = _asymptotic_coefficients(0)
# The leading ones are equal.
_LARGE_DIFFERENCE = [one - zero for zero, one in zip(_LARGE_0, _asymptotic_coefficients(1), strict=True)][1:]


def scaled_i0(x: Any) -> Any:
    """``I0(x) exp(-x)`` for x >= 0, to 1e-6 of its value, with a slope that is as good."""
    with dr.suspend_grad():
        is_large = x > BORDER
        small, large = dr.minimum(x, BORDER), dr.maximum(x, BORDER)
        quarter, inverse = 0.25 * small * small, dr.rcp(large)
        fading, root = dr.exp(-small), dr.sqrt(inverse * (0.5 / pi))
        near = _polynomial(_SMALL_0, quarter)
        value = dr.select(is_large, root * _polynomial(_LARGE_0, inverse), fading * near)
        slope_near = fading * (0.5 * small * _polynomial(_SMALL_1, quarter) - near)
        slope_far = root * inverse * _polynomial(_LARGE_DIFFERENCE, inverse)
        slope = dr.select(is_large, slope_far, slope_near)
    return dr.replace_grad(value, x * slope)


def _polynomial(coefficients: list[float], x: Any) -> Any:
    value = type(x)(coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        value = dr.fma(value, x, coefficient)
    return value
