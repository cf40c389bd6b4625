"""Waves of evenly spaced frequencies over fields of distances."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def waves(distances: Tensor, frequencies: Tensor, falloff: float, dtype: torch.dtype, nearest: float = 0.0) -> Tensor:
    """``exp(2 pi i f r) / r^falloff``, (F, ...), of ``distances`` r (...) in metres and evenly spaced ``frequencies``
    (F,) in cycles per metre, both float64; ``dtype``: a complex one. Distances below ``nearest`` fall off as it does.

    Phases are those of double precision: single precision has none left for r of many wavelengths. A sine of each
    frequency would be most of the work of a plane, so waves follow from each other by products, which lose F ulp.
    """
    count = len(frequencies)
    wave = _turned(distances * frequencies[0])
    if falloff:
        wave = wave * distances.clamp_min(nearest).pow(-falloff)
    out = torch.empty(count, *distances.shape, dtype=dtype, device=distances.device)
    out[0] = wave
    if count > 1:
        step = _turned(distances * ((frequencies[-1] - frequencies[0]) / (count - 1)))
        for k in range(1, count):
            wave = wave.mul_(step)
            out[k] = wave
    return out


def _turned(turns: Tensor) -> Tensor:
    return torch.polar(torch.ones_like(turns), (turns - turns.round()) * (2 * math.pi))


def phase_pairs(turns: Tensor) -> Tensor:
    """(..., 2): real and imaginary part of ``exp(2 pi i turns)``, float64."""
    return torch.view_as_real(_turned(turns))
