"""Weights of bins in the taps of indirect time of flight, for pixels that differ."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.sensing.itof.itof_codes import CorrelationCode

_TURN = 2 * math.pi
_LARGEST = 1 << 22  # numbers of a table of weights of pixels


def rounding_of(weights: Tensor) -> float:
    """What weights may be off by in their dtype."""
    most = float(weights.abs().max()) if weights.numel() else 1.0
    return max(float(torch.finfo(weights.dtype).eps), 1e-9) * max(most, 1.0)


def harmonic_rows(harmonics: Sequence[int], frequencies: Sequence[float], axis: TimeAxis, within_bin: str) -> Tensor:
    """(F x 2 harmonics, T) float64: cosine and sine of every harmonic of every frequency."""
    rows = []
    for f in frequencies:
        for h in harmonics:
            # The mean of a cosine over a bin is its value in the middle times sinc.
            turns = h * f * axis.centers_s
            keep = torch.sinc(h * f * axis.edges_s.diff()) if within_bin == "uniform" else torch.ones_like(turns)
            rows += [keep * torch.cos(_TURN * turns), keep * torch.sin(_TURN * turns)]
    return torch.stack(rows)


def taps_by_pixel(
    x: Tensor, code: CorrelationCode, f: float, axis: TimeAxis, contrast: float, within_bin: str, phase: Tensor
) -> Tensor:
    """Taps (..., N, H, W) of light (..., T, H, W), each pixel with weights of its own, at phases (H, W)."""
    light, bins = x.flatten(-2), axis.num_bins
    turns = (phase.to("cpu", torch.float64) / _TURN % 1.0).flatten()
    turns = turns.expand(light.shape[-1]) if turns.numel() == 1 else turns
    places = axis.edges_s * f if within_bin == "uniform" else axis.centers_s * f
    apart = math.ceil(float(places[-1] - places[0])) + 2.0
    rows = math.prod(light.shape[:-2]) * code.num_taps * bins
    size = max(_LARGEST // max(rows, 1), 1)
    taps = []
    for begin in range(0, light.shape[-1], size):
        here = turns[begin : begin + size]
        if within_bin == "uniform":
            # Codes are periodic: whole turns between the pixels make one ascending row of all their edges.
            edges = places + (here + apart * torch.arange(len(here), dtype=torch.float64))[:, None]
            means = torch.nn.functional.pad(code.bin_means(edges.flatten()), (0, 1))
            shape = means.reshape(code.num_taps, len(here), bins + 1)[..., :bins]
        else:
            shape = code.evaluate(places + here[:, None])
        weights = ((1 + contrast * shape) / code.num_taps).movedim(1, -1).to(x)
        # No product of matrices, which autocast would round.
        taps.append((light[..., None, :, begin : begin + size] * weights).sum(-2))
    together = torch.cat(taps, dim=-1) if taps else light.new_zeros(*light.shape[:-2], code.num_taps, 0)
    return together.reshape(*together.shape[:-1], *x.shape[-2:])
