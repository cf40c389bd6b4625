"""Tensors whose gradients are constants for autograd: a derivative of these is an error, and not a part of one.

`torch.autograd.function.once_differentiable` raises in `backward` alone: `torch.autograd.grad` by a tensor leaves its
nodes out, and second derivatives would lack what goes through them.
"""

from __future__ import annotations

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
    """A gradient, as a function of what it is a gradient by."""

    generate_vmap_rule = True

    @staticmethod
    def forward(gradient: Tensor, x: Tensor) -> Tensor:
        return gradient.view_as(gradient)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> NoReturn:
        raise GradientError(_MESSAGE)

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor) -> NoReturn:
        raise GradientError(_MESSAGE)


_MESSAGE = (
    "second derivatives of free-running detectors and of coates with a dead time are not available: a gradient was "
    "differentiated again. Take finite differences of gradients."
)
