"""Gradients that are constants for autograd: a derivative of these is an error, and not a part of one.

`torch.autograd.function.once_differentiable` raises in `backward` alone: `torch.autograd.grad` by a tensor leaves its
nodes out, and second derivatives would lack what goes through them, as would `torch.autograd.functional.jvp`, which
differentiates a gradient by its weights.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NoReturn

import torch
from torch import Tensor

from torchtransient.errors import GradientError


def once(x: Tensor) -> Tensor:
    """Return a tensor whose gradient has no derivative.

    Args:
        x: any tensor.

    Raises:
        GradientError: where its gradient is differentiated.
    """
    same: Tensor = _Once.apply(x)  # type: ignore[no-untyped-call]
    return same


def once_differentiable(backward: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate the `backward` of a Function that has saved its inputs: derivatives of what it returns are refused.

    Args:
        backward: returns a gradient or None for each input; run without gradient.

    Returns:
        The decorated function, whose gradients raise GradientError where they are differentiated.
    """

    @functools.wraps(backward)
    def decorated(ctx: Any, *weights: Tensor) -> tuple[Tensor | None, ...]:
        with torch.no_grad():
            gradients = backward(ctx, *weights)
        by = (*weights, *ctx.saved_tensors)
        return tuple(None if one is None else _Refused.apply(one, *by) for one in gradients)  # type: ignore[no-untyped-call]

    return decorated


class _Once(torch.autograd.Function):
    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor) -> Tensor:
        return x.view_as(x)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        found: Tensor = _Refused.apply(gradients[0], *ctx.saved_tensors)  # type: ignore[no-untyped-call]
        return found

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor) -> Tensor:
        return tangents[0].view_as(tangents[0])


class _Refused(torch.autograd.Function):
    """A gradient, as a function of what it depends on."""

    generate_vmap_rule = True

    @staticmethod
    def forward(gradient: Tensor, *by: Tensor) -> Tensor:
        return gradient.view_as(gradient)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> NoReturn:
        raise GradientError(_MESSAGE)

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor) -> NoReturn:
        raise GradientError(_MESSAGE)


_MESSAGE = (
    "second derivatives of free-running detectors and of coates with a dead time are not available: a gradient was "
    "differentiated again. Take finite differences of gradients, and torch.autograd.forward_ad for forward mode."
)
