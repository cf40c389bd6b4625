"""The confluent hypergeometric limit function 0F1, which Bessel functions of any order are made of."""

from __future__ import annotations

import math

import torch
from torch import Tensor

# Order from which on three terms of the uniform expansion are right to 1e-8.
_HIGH = 40


def log_0f1(b: float, w: Tensor) -> Tensor:
    """Evaluate the logarithm of ``0F1(; b; w) = Gamma(b) w^((1 - b) / 2) I_(b - 1)(2 sqrt(w))``.

    Args:
        b: one and more.
        w: zero and more, of any shape, float64 for all digits.

    Returns:
        Logarithm in the shape of ``w``, right to 1e-8 and differentiable, at zero too.

    Of high orders by the uniform expansion of I (DLMF 10.41.3), from there down by the recurrence of ratios
    ``q_b = 0F1(b + 1) / 0F1(b) = 1 / (1 + w / (b (b + 1)) q_(b + 1))``, in which no digits cancel.
    """
    steps = max(0, math.ceil(_HIGH - b))
    top = b + steps
    total = _of_high_order(top, w)
    ratio = (_of_high_order(top + 1, w) - total).exp()
    for step in range(steps - 1, -1, -1):
        at = b + step
        ratio = 1 / (1 + w / (at * (at + 1)) * ratio)
        total = total - ratio.log()
    return total


def _of_high_order(b: float, w: Tensor) -> Tensor:
    v = b - 1
    s = (1 + 4 * w / v**2).sqrt()
    p = 1 / s
    terms = (
        (3 * p - 5 * p**3) / (24 * v)
        + (81 * p**2 - 462 * p**4 + 385 * p**6) / (1152 * v**2)
        + (30375 * p**3 - 369603 * p**5 + 765765 * p**7 - 425425 * p**9) / (414720 * v**3)
    )
    constant = math.lgamma(b) - 0.5 * math.log(2 * math.pi * v) - v * math.log(v / 2)
    return constant + v * s - v * torch.log1p(s) - 0.5 * s.log() + torch.log1p(terms)
