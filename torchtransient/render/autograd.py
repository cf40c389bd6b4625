"""The three autograd functions: a render, its reverse derivative and its forward derivative.

``Render`` keeps no Dr.Jit graph. It saves its inputs, and its derivatives are renders of their own: ``RenderVJP``
and ``RenderJVP``, linear in the cotangents and tangents. They are functions of torch too, so that ``torch.func`` can
batch them; differentiating *them* is refused, since the integrators have no second derivatives. All of them are real:
complex phasors are a view that torch differentiates itself.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NoReturn

import torch

from torchtransient.errors import GradientError
from torchtransient.render import engine
from torchtransient.render.engine import RenderJob


def _refuse_second(what: str) -> NoReturn:
    raise GradientError(
        f"second derivatives of a render are not available: {what}. Expected a first derivative; for curvature use "
        "finite differences of gradients, or a Gauss-Newton product J^T J v from torch.func.jvp and torch.func.vjp."
    )


def _each(
    function: Any, info: Any, in_dims: tuple[Any, ...], args: tuple[Any, ...]
) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """``vmap`` by one call per entry, with the seed of the job for each: what a loop over the entries would give."""
    columns = []
    for i in range(info.batch_size):
        entry = [arg if dim is None else arg.select(dim, i) for arg, dim in zip(args, in_dims, strict=True)]
        columns.append(function.apply(*entry))
    outputs = tuple(torch.stack(column) for column in zip(*columns, strict=True))
    return outputs, (0,) * len(outputs)


class Render(torch.autograd.Function):
    """(job, *values) -> (steady, response) in the film's layout."""

    @staticmethod
    def forward(job: RenderJob, *values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return engine.primal(job, values)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        job, *values = inputs
        ctx.job = job
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*values)
        ctx.save_for_forward(*values)

    @staticmethod
    def backward(ctx: Any, g_steady: torch.Tensor | None, g_response: torch.Tensor | None) -> tuple[Any, ...]:
        needs = tuple(ctx.needs_input_grad[1:])
        if (g_steady is None and g_response is None) or not any(needs):
            return (None,) * (1 + len(needs))
        grads = iter(RenderVJP.apply(replace(ctx.job, needs=needs), g_steady, g_response, *ctx.saved_tensors))
        return (None, *(next(grads) if need else None for need in needs))

    @staticmethod
    def jvp(ctx: Any, _: None, *tangents: torch.Tensor | None) -> tuple[torch.Tensor, torch.Tensor]:
        needs = tuple(tangent is not None for tangent in tangents)
        given = [tangent for tangent in tangents if tangent is not None]
        return RenderJVP.apply(replace(ctx.job, needs=needs), *given, *ctx.saved_tensors)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> tuple[Any, Any]:
        return _each(Render, info, in_dims, args)


class RenderVJP(torch.autograd.Function):
    """(job, g_steady, g_response, *values) -> gradients of the values that need one."""

    @staticmethod
    def forward(
        job: RenderJob, g_steady: torch.Tensor | None, g_response: torch.Tensor | None, *values: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        return tuple(engine.vjp(job, values, g_steady, g_response))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> NoReturn:
        _refuse_second("the gradient of a render was differentiated again (create_graph=True, then backward)")

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> NoReturn:
        _refuse_second("forward mode over reverse mode (torch.func.hessian, jvp of a gradient)")

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> tuple[Any, Any]:
        return _each(RenderVJP, info, in_dims, args)


class RenderJVP(torch.autograd.Function):
    """(job, *tangents of the values that need one, *values) -> derivatives of (steady, response)."""

    @staticmethod
    def forward(job: RenderJob, *tensors: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        count = sum(job.needs)
        return engine.jvp(job, tensors[count:], tensors[:count])

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> NoReturn:
        _refuse_second("reverse mode over forward mode (backward through a tangent)")

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> NoReturn:
        _refuse_second("forward mode over forward mode (nested torch.func.jvp)")

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> tuple[Any, Any]:
        return _each(RenderJVP, info, in_dims, args)
