"""Mean histograms of cycles with several detections, with a gradient by the adjoint of the walk.

First derivatives in the light are those of `dead_time_walk`. Others (in the dead time, forward mode, higher orders) are
those of the same recursion in differentiable steps, `dead_time_cycle.detected_rows`, which takes longer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

from torchtransient.sensing.base.given import is_dual
from torchtransient.sensing.dead_time.dead_time_cycle import (
    PHOTONS,
    check_dead_bins,
    detected_rows,
    row_levels,
    whole_and_part,
)
from torchtransient.sensing.dead_time.dead_time_walk import Walk

_STATES = 1 << 24  # numbers that are held at a time while bins are cut


def _in_steps(rate: Tensor, dead_bins: Tensor) -> Tensor:
    return detected_rows(rate.T, dead_bins).T


def _gradient_in_steps(rate: Tensor, dead_bins: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    found: tuple[Tensor, Tensor] = torch.func.vjp(_in_steps, rate, dead_bins)[1](weights)
    return found


def _rate_gradient_in_steps(rate: Tensor, dead_bins: Tensor, weights: Tensor) -> Tensor:
    return _gradient_in_steps(rate, dead_bins, weights)[0]


def _tangent(of: Callable[..., Tensor], at: tuple[Tensor, ...], along: tuple[Tensor | None, ...]) -> Tensor:
    """The derivative along a direction, as the derivative of the (linear) gradient in its weights."""
    value, pull, *_ = torch.func.vjp(of, *at)
    along = tuple(torch.zeros_like(x) if t is None else t for x, t in zip(at, along, strict=True))
    found: Tensor = torch.func.vjp(pull, torch.zeros_like(value))[1](along)[0]
    return found


def walks(rate: Tensor, dead_bins: Tensor) -> Iterator[tuple[Tensor | slice, Walk]]:
    """(Columns, walk over them), bins cut as finely as the columns need."""
    dead = check_dead_bins(dead_bins)
    least = 1 if dead >= 1 - 1e-9 else 2
    level, present, _ = row_levels(rate.T, least)
    for k in present:
        pieces = least << k
        columns = None if len(present) == 1 else (level == k).nonzero().squeeze(-1)
        whole, part = whole_and_part(dead_bins.double() * pieces)
        number = rate.shape[1] if columns is None else columns.numel()
        few = max(1, _STATES // (3 * pieces * rate.shape[0]))
        for begin in range(0, number, few):
            taken = slice(begin, min(begin + few, number)) if columns is None else columns[begin : begin + few]
            own = rate[:, taken]
            largest = float(own.amax().nan_to_num(PHOTONS)) / pieces
            yield taken, Walk(own, whole, float(part), pieces, min(largest, PHOTONS))


class _Detected(torch.autograd.Function):
    """Columns (T, P) of rates -> detections per cycle, and the states of the walk where they are wanted and few."""

    @staticmethod
    def forward(rate: Tensor, dead_bins: Tensor, keep: bool) -> tuple[Tensor, Tensor]:
        detected = torch.empty_like(rate)
        kept = rate.new_empty(0)
        for columns, walk in walks(rate, dead_bins):
            states = walk.forward()
            detected[:, columns] = states[1:, 1].view(rate.shape[0], walk.pieces, -1).sum(1)
            if keep and walk.columns == rate.shape[1] and walk.pieces == 1:
                kept = states
        return detected, kept

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
        ctx.mark_non_differentiable(output[1])
        ctx.save_for_backward(inputs[0], inputs[1], output[1])
        ctx.save_for_forward(inputs[0], inputs[1])

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor | None, None]:
        rate, dead_bins, kept = ctx.saved_tensors
        # batches of torch.autograd (is_grads_batched) know no rule of ours
        if ctx.needs_input_grad[1] or torch._C._functorch.is_legacy_batchedtensor(gradients[0]):
            return *_gradient_in_steps(rate, dead_bins, gradients[0]), None
        found: Tensor = _Adjoint.apply(rate, dead_bins, gradients[0], kept)  # type: ignore[no-untyped-call]
        return found, None, None

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> tuple[Tensor, None]:
        return _tangent(_in_steps, ctx.saved_tensors, tangents[:2]), None

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[int | None, ...], rate: Tensor, dead_bins: Tensor, keep: bool
    ) -> tuple[tuple[Tensor, Tensor], tuple[int, int | None]]:
        given = _beside(info.batch_size, in_dims, rate, dead_bins)
        detected, kept = _Detected.apply(*given, keep)  # type: ignore[no-untyped-call]
        detected = detected.view(detected.shape[0], info.batch_size, -1)
        if kept.ndim == 1:
            return (detected, kept), (1, None)
        return (detected, kept.view(*kept.shape[:2], info.batch_size, -1)), (1, 2)


class _Adjoint(torch.autograd.Function):
    """Weights (T, P) of the detections -> derivatives (T, P) of their sum with respect to the rates."""

    @staticmethod
    def forward(rate: Tensor, dead_bins: Tensor, weights: Tensor, kept: Tensor) -> Tensor:
        gradient = torch.empty_like(rate)
        for columns, walk in walks(rate, dead_bins):
            states = kept if kept.ndim > 1 else walk.forward()
            given = torch.zeros_like(states)
            own = weights[:, columns]
            given[1:, 1] = own.repeat_interleave(walk.pieces, 0) if walk.pieces > 1 else own
            gradient[:, columns] = walk.adjoint(states, given)
        return gradient

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs[:3])
        ctx.save_for_forward(*inputs[:3])

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        return *torch.func.vjp(_rate_gradient_in_steps, *ctx.saved_tensors)[1](gradients[0]), None

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Tensor:
        return _tangent(_rate_gradient_in_steps, ctx.saved_tensors, tangents[:3])

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *inputs: Tensor) -> tuple[Tensor, int]:
        found: Tensor = _Adjoint.apply(*_beside(info.batch_size, in_dims, *inputs))  # type: ignore[no-untyped-call]
        return found.view(found.shape[0], info.batch_size, -1), 1


def _beside(batch: int, in_dims: tuple[int | None, ...], *inputs: Tensor) -> list[Tensor]:
    """The columns of a batch beside one another; one dead time for all of them."""
    given = []
    for place, x in zip(in_dims, inputs, strict=False):
        if x.ndim < 2:
            given.append(x)
            continue
        wide = x.unsqueeze(-2).expand(*x.shape[:-1], batch, -1) if place is None else x.movedim(place, -2)
        given.append(wide.flatten(-2))
    return given


def detected_columns(rate: Tensor, dead_bins: Tensor) -> Tensor:
    """Detections per cycle and bin for rates (T, P), float64; differentiable in both."""
    keep = torch.is_grad_enabled() and rate.requires_grad
    watched = torch.is_grad_enabled() or torch.compiler.is_compiling()
    wrapped = torch._C._functorch.is_functorch_wrapped_tensor
    if not watched and not any(is_dual(x) or wrapped(x) for x in (rate, dead_bins)):
        return _Detected.forward(rate, dead_bins, False)[0]  # calls of autograd take as long as small images
    found: Tensor = _Detected.apply(rate, dead_bins, keep)[0]  # type: ignore[no-untyped-call]
    return found
