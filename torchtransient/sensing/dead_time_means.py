"""Mean histograms of cycles with several detections, with a gradient by the adjoint of the walk.

First derivatives in the light are those of `dead_time_walk`. Others (in the dead time, forward mode, higher orders) are
those of the same recursion in differentiable steps, `dead_time_cycle.detected_rows`, which takes longer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

from torchtransient.sensing.dead_time_cycle import (
    PHOTONS,
    check_dead_bins,
    detected_rows,
    row_levels,
    whole_and_part,
)
from torchtransient.sensing.dead_time_walk import Walk

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
    value, pull = torch.func.vjp(of, *at)
    along = tuple(torch.zeros_like(x) if t is None else t for x, t in zip(at, along, strict=True))
    found: Tensor = torch.func.vjp(pull, torch.zeros_like(value))[1](along)[0]
    return found


def _walks(rate: Tensor, dead_bins: Tensor) -> Iterator[tuple[Tensor | slice, Walk]]:
    """(Columns, walk over them), bins cut as finely as the columns need."""
    dead = check_dead_bins(dead_bins)
    least = 1 if dead >= 1 - 1e-9 else 2
    level, present, _ = row_levels(rate.T, least)
    for k in present:
        pieces = least << k
        columns = None if len(present) == 1 else (level == k).nonzero().squeeze(-1)
        whole, part = whole_and_part(dead_bins.detach().double() * pieces)
        number = rate.shape[1] if columns is None else columns.numel()
        few = max(1, _STATES // (3 * pieces * rate.shape[0]))
        for begin in range(0, number, few):
            taken = slice(begin, min(begin + few, number)) if columns is None else columns[begin : begin + few]
            own = rate[:, taken]
            largest = float(own.amax().nan_to_num(PHOTONS)) / pieces
            yield taken, Walk(own, whole, float(part), pieces, min(largest, PHOTONS))


class _Detected(torch.autograd.Function):
    """Columns (T, P) of rates -> detections per cycle."""

    @staticmethod
    def forward(rate: Tensor, dead_bins: Tensor) -> Tensor:
        detected = torch.empty_like(rate)
        for columns, walk in _walks(rate, dead_bins):
            detected[:, columns] = walk.forward()[1:, 1].view(rate.shape[0], walk.pieces, -1).sum(1)
        return detected

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)
        ctx.save_for_forward(*inputs)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor | None]:
        rate, dead_bins = ctx.saved_tensors
        if ctx.needs_input_grad[1]:
            return _gradient_in_steps(rate, dead_bins, gradients[0])
        found: Tensor = _Adjoint.apply(rate, dead_bins, gradients[0])  # type: ignore[no-untyped-call]
        return found, None

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Tensor:
        return _tangent(_in_steps, ctx.saved_tensors, tangents)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], rate: Tensor, dead_bins: Tensor) -> tuple[Tensor, int]:
        return _mapped(_Detected, info.batch_size, in_dims, rate, dead_bins)


class _Adjoint(torch.autograd.Function):
    """Weights (T, P) of the detections -> derivatives (T, P) of their sum with respect to the rates."""

    @staticmethod
    def forward(rate: Tensor, dead_bins: Tensor, weights: Tensor) -> Tensor:
        gradient = torch.empty_like(rate)
        for columns, walk in _walks(rate, dead_bins):
            states = walk.forward()
            given = torch.zeros_like(states)
            own = weights[:, columns]
            given[1:, 1] = own.repeat_interleave(walk.pieces, 0) if walk.pieces > 1 else own
            gradient[:, columns] = walk.adjoint(states, given)
        return gradient

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)
        ctx.save_for_forward(*inputs)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        found: tuple[Tensor, Tensor, Tensor] = torch.func.vjp(_rate_gradient_in_steps, *ctx.saved_tensors)[1](
            gradients[0]
        )
        return found

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Tensor:
        return _tangent(_rate_gradient_in_steps, ctx.saved_tensors, tangents)

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[int | None, ...], rate: Tensor, dead_bins: Tensor, weights: Tensor
    ) -> tuple[Tensor, int]:
        return _mapped(_Adjoint, info.batch_size, in_dims, rate, dead_bins, weights)


def _mapped(
    function: type[torch.autograd.Function], batch: int, in_dims: tuple[int | None, ...], *inputs: Tensor
) -> tuple[Tensor, int]:
    """Over a batch of columns, beside one another; one dead time for all of them."""
    given = []
    for place, x in zip(in_dims, inputs, strict=True):
        if x.ndim < 2:
            given.append(x)
            continue
        wide = x.unsqueeze(1).expand(-1, batch, -1) if place is None else x.movedim(place, 1)
        given.append(wide.reshape(wide.shape[0], -1))
    found: Tensor = function.apply(*given)  # type: ignore[no-untyped-call]
    return found.view(found.shape[0], batch, -1), 1


def detected_columns(rate: Tensor, dead_bins: Tensor) -> Tensor:
    """Detections per cycle and bin for rates (T, P), float64; differentiable in both."""
    found: Tensor = _Detected.apply(rate, dead_bins)  # type: ignore[no-untyped-call]
    return found
