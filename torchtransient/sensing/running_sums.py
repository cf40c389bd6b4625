"""Sums over the earlier bins, in float64, and the chain of detectors that are armed or dead."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from torchtransient.errors import UnitError
from torchtransient.sensing.layout import TIME

_WIDE = 64  # images at least this large are summed row by row: torch.cumsum strides through memory along time


def _sum_before(x: Tensor, reverse: bool) -> Tensor:
    if x.device.type != "cpu" or x.shape[-1] * x.shape[-2] < _WIDE:
        wide = x.to(torch.float64)
        if reverse:
            return wide.flip(TIME).cumsum(TIME).flip(TIME) - wide
        return wide.cumsum(TIME) - wide
    out = torch.empty(x.shape, dtype=torch.float64, device=x.device)
    bins = x.shape[TIME]
    total = torch.zeros_like(x.select(TIME, 0), dtype=torch.float64)
    for k in range(bins - 1, -1, -1) if reverse else range(bins):
        out.select(TIME, k).copy_(total)
        total += x.select(TIME, k)
    return out


class _SumBefore(torch.autograd.Function):
    @staticmethod
    def forward(x: Tensor, reverse: bool) -> Tensor:
        return _sum_before(x, reverse)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.dtype, ctx.reverse = inputs[0].dtype, inputs[1]

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return _apply(gradients[0], not ctx.reverse).to(ctx.dtype), None

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Tensor:
        return _sum_before(tangents[0], ctx.reverse)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], x: Tensor, reverse: bool) -> tuple[Tensor, int]:
        # time is counted from the end, so a batch in front changes nothing
        return _apply(x.movedim(in_dims[0] or 0, 0), reverse), 0


def _apply(x: Tensor, reverse: bool) -> Tensor:
    result: Tensor = _SumBefore.apply(x, reverse)  # type: ignore[no-untyped-call]
    return result


def sum_before(x: Tensor) -> Tensor:
    """Sum of all earlier bins along the time axis of (..., T, H, W), float64, differentiable any number of times."""
    return _apply(x, False)


def split_dead_time(dead_bins: Tensor | float) -> tuple[int, Tensor]:
    """(m, f): a detection in bin i re-arms at the start of bin i + m with weight 1 - f and of i + m + 1 with f.

    A detection lies in the middle of its bin on average, so that the detector is armed again dead_bins + 1/2 bins
    after the start of it; that number is m + f. f is differentiable in the dead time. Raises UnitError for dead times
    below half a bin: a bin holds one detection of a cycle at most.
    """
    delay = torch.as_tensor(dead_bins, dtype=torch.float64) + 0.5
    value = float(delay.detach())
    if not 1 - 1e-9 <= value < 1e9:
        raise UnitError(
            f"dead time: expected at least half a bin, got {value - 0.5:g} bins. Use narrower bins, or no dead time "
            "(ShotNoise) where it does not matter."
        )
    # a whole number that rounding has put just below itself is still that number
    whole = max(1, math.floor(value + 1e-9))
    return whole, (delay - whole).clamp_min(0)


def detections_with_dead_time(rate: Tensor, dead_bins: Tensor | float) -> Tensor:
    """Probability of a detection per cycle and bin, armed at the start, with dead time: float64 (..., T, H, W).

    armed[k+1] = armed[k] exp(-rate[k]) + re-armed[k+1], the recursion of a renewal process over one cycle.
    `dead_bins`: dead time in bins, >= 0, a number or a scalar tensor (differentiable).
    """
    whole, part = split_dead_time(dead_bins)
    bins = rate.shape[TIME]
    fire = -torch.expm1(-rate.to(torch.float64))
    columns = fire.unbind(TIME)
    armed = torch.ones_like(columns[0])
    detected: list[Tensor] = []
    for k in range(bins):
        if k >= whole:
            armed = armed + (1 - part) * detected[k - whole]
            if k > whole:
                armed = armed + part * detected[k - whole - 1]
        hit = armed * columns[k]
        detected.append(hit)
        armed = armed - hit
    return torch.stack(detected, TIME)


def armed_cycles(counts: Tensor, cycles: float, dead_bins: float | None = None) -> Tensor:
    """Cycles whose detector was armed at the start of each bin, from the histogram alone: float64 (..., T, H, W).

    `dead_bins` None: one detection per cycle. With a dead time the histogram tells who was dead, exactly if
    dead_bins + 1/2 is a whole number of bins, else on average.
    """
    before = sum_before(counts)
    if dead_bins is None:
        return cycles - before
    whole, part = split_dead_time(dead_bins)
    bins = counts.shape[TIME]

    def delayed(by: int) -> Tensor:
        """Sum of the counts of all bins that re-arm up to bin k when they take `by` bins to do so."""
        if by >= bins:
            return torch.zeros_like(before)
        inclusive = before + counts.to(torch.float64)
        return torch.cat([torch.zeros_like(before.narrow(TIME, 0, by)), inclusive.narrow(TIME, 0, bins - by)], TIME)

    f = float(part)
    return cycles - before + (1 - f) * delayed(whole) + f * delayed(whole + 1)
