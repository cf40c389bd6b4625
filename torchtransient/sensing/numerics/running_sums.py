"""Sums over the earlier bins, in float64."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchtransient.sensing.base.layout import TIME

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
