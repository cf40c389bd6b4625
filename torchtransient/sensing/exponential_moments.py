"""Moments of decaying exponentials over a bin, smooth down to a rate of zero and differentiable."""

from __future__ import annotations

import math

import torch
from torch import Tensor

_TERMS = 20  # of the series, used below 1: the last is under 1e-19
_SERIES_BELOW = 1.0


def decay_moment(power: int, x: Tensor) -> Tensor:
    """Integral over z from 0 to 1 of z^power exp(-x z), power 0 or 1, x >= 0, float64."""
    small, near, far = _ranges(x)
    decayed = torch.exp(-far)
    closed = (1 - decayed) / far if power == 0 else (1 - (1 + far) * decayed) / far**2
    weights = [1 / (math.factorial(n) * (n + power + 1)) for n in range(_TERMS)]
    return torch.where(small, _alternating(weights, near), closed)


def hit_moment(power: int, x: Tensor) -> Tensor:
    """Integral over z from 0 to 1 of z^power (1 - exp(-x z)) / x, power 0 or 1, x >= 0, float64."""
    small, near, far = _ranges(x)
    decayed = torch.exp(-far)
    missed = (1 - decayed) / far if power == 0 else (1 - (1 + far) * decayed) / far**2
    closed = (1 / (power + 1) - missed) / far
    weights = [1 / (math.factorial(n + 1) * (n + power + 2)) for n in range(_TERMS)]
    return torch.where(small, _alternating(weights, near), closed)


def _ranges(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Where the series is used, and x with harmless values where it, or the closed form, is not."""
    small = x < _SERIES_BELOW
    return small, torch.where(small, x, torch.zeros_like(x)), torch.where(small, torch.ones_like(x), x)


def _alternating(weights: list[float], x: Tensor) -> Tensor:
    total = torch.full_like(x, weights[-1])
    for weight in reversed(weights[:-1]):
        total = weight - x * total
    return total
