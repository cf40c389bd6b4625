"""Moments of decaying exponentials over a bin, smooth down to a rate of zero and differentiable."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

_SERIES_BELOW = 1.0
_SMALLEST_TERM = 1e-19


@dataclass(frozen=True)
class Moments:
    """Integrals over z from 0 to 1: of z^power exp(-x z), and of z^power (1 - exp(-x z)) / x, for powers 0 and 1."""

    decay: tuple[Tensor, Tensor]
    hit: tuple[Tensor, Tensor]


def _weights(largest: float) -> list[float]:
    """Of the powers of x, but for signs, as far as they count up to the largest x there is: dim light needs few."""
    weights = [1 / 3]
    # the relative error of derivatives is that of a term two orders lower
    while weights[-1] * largest ** max(len(weights) - 3, 0) > _SMALLEST_TERM and len(weights) < 24:
        n = len(weights)
        weights.append(1 / (math.factorial(n + 1) * (n + 3)))
    return weights


def _series(x: Tensor, largest: float) -> Tensor:
    weights = _weights(largest)
    series = torch.full_like(x, weights[-1])
    for weight in reversed(weights[:-1]):
        series = weight - x * series
    return series


def moments(x: Tensor, largest: float | None = None) -> Moments:
    """For x >= 0, float64. One of them is a series where x is small; the others follow by parts, adding up only.

    `largest`: a bound of x that is known, for x that cannot be looked at (torch.func.vmap).
    """
    if largest is not None and largest <= _SERIES_BELOW:
        hit_1 = _series(x, largest)
        decay_1 = 0.5 - x * hit_1
    else:
        small = x < _SERIES_BELOW
        near, far = torch.where(small, x, torch.zeros_like(x)), torch.where(small, torch.ones_like(x), x)
        if largest is None:
            largest = float(near.detach().amax()) if near.numel() else 0.0
        series = _series(near, min(largest, _SERIES_BELOW))
        closed = (0.5 - (1 - (1 + far) * torch.exp(-far)) / far**2) / far
        hit_1 = torch.where(small, series, closed)
        decay_1 = torch.where(small, 0.5 - near * series, (1 - (1 + far) * torch.exp(-far)) / far**2)
    decay_0 = torch.exp(-x) + x * decay_1
    return Moments((decay_0, decay_1), (decay_0 - decay_1, hit_1))


def second_moment(x: Tensor) -> Tensor:
    """Integral over z from 0 to 1 of z^2 exp(-x z), for x >= 0, float64: less the slope of the first moment."""
    small = x < _SERIES_BELOW
    near, far = torch.where(small, x, torch.zeros_like(x)), torch.where(small, torch.ones_like(x), x)
    series = torch.zeros_like(x)
    for n in range(18, -1, -1):  # the next term is below 1e-18
        series = 1 / (math.factorial(n) * (n + 3)) - near * series
    first = (1 - (1 + far) * torch.exp(-far)) / far**2
    return torch.where(small, series, (2 * first - torch.exp(-far)) / far)
