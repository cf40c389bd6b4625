"""The three autograd functions: a render, its reverse derivative and its forward derivative.

``Render`` keeps no Dr.Jit graph. It saves its inputs, and its derivatives are renders of their own: ``RenderVJP``
and ``RenderJVP``, linear in the cotangents and tangents. They are functions of torch too, so that ``torch.func`` can
batch them, and each is the other's derivative by what it is linear in (``torch.autograd.functional.jvp`` rests on
that). Differentiating them by the *values* is refused (``OnceDifferentiable``), since the integrators have no second
derivatives. All of them are real: complex phasors are a view that torch differentiates itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NoReturn

import torch

from torchtransient.errors import GradientError
from torchtransient.render import engine
from torchtransient.render.older_vmap import each_of_older_vmap
from torchtransient.render.session import RenderJob


class OnceDifferentiable(torch.autograd.Function):
    """The values of a derivative: a derivative by them would be a second one. Only where one is really asked for does
    autograd come here; a derivative by the cotangent or tangent alone passes by.
    """

    @staticmethod
    def forward(value: torch.Tensor) -> torch.Tensor:
        return value.view_as(value)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> NoReturn:
        _refuse_second("the gradient or tangent of a render was differentiated again in reverse mode")

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> NoReturn:
        _refuse_second("the gradient or tangent of a render was differentiated again in forward mode")

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], value: torch.Tensor) -> tuple[Any, Any]:
        return OnceDifferentiable.apply(value), in_dims[0]


def _once(values: Sequence[torch.Tensor]) -> list[torch.Tensor]:
    return [OnceDifferentiable.apply(value) for value in values]


def _given(tensors: Sequence[torch.Tensor | None]) -> list[torch.Tensor]:
    return [tensor for tensor in tensors if tensor is not None]


def _those(needs: Sequence[bool], asked: Sequence[torch.Tensor | None]) -> tuple[bool, ...]:
    """Which values have a tangent, where ``asked`` has an entry for each of those that need a derivative."""
    remaining = iter(asked)
    return tuple(need and next(remaining) is not None for need in needs)


def _refuse_second(what: str) -> NoReturn:
    raise GradientError(
        f"second derivatives of a render are not available: {what}. Expected a first derivative; for curvature use "
        "finite differences of gradients, or a Gauss-Newton product J^T J v from torch.func.jvp and torch.func.vjp."
    )


def _each(
    function: Any, info: Any, in_dims: tuple[Any, ...], args: tuple[Any, ...]
) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """``vmap`` by one call per entry: what a loop over the entries would give, with the seed that is written, or with
    each entry's own where ``vmap`` drew them.
    """
    columns = []
    for i in range(info.batch_size):
        entry = [arg if dim is None else arg.select(dim, i) for arg, dim in zip(args, in_dims, strict=True)]
        columns.append(function.apply(*entry))
    outputs = tuple(torch.stack(column) for column in zip(*columns, strict=True))
    return outputs, (0,) * len(outputs)


class Render(torch.autograd.Function):
    """(job, seed, *values) -> (steady, response) in the film's layout. ``seed``: None, or a number that is known only
    inside of a ``vmap``.
    """

    @staticmethod
    def forward(job: RenderJob, seed: torch.Tensor | None, *values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return engine.primal(job.seeded(seed), values)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        job, *tensors = inputs
        ctx.job = job
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*tensors)
        ctx.save_for_forward(*tensors)

    @staticmethod
    def backward(ctx: Any, g_steady: torch.Tensor | None, g_response: torch.Tensor | None) -> tuple[Any, ...]:
        needs = tuple(ctx.needs_input_grad[2:])
        if (g_steady is None and g_response is None) or not any(needs):
            return (None,) * (2 + len(needs))
        seed, *values = ctx.saved_tensors
        grads = iter(RenderVJP.apply(replace(ctx.job, needs=needs), seed, g_steady, g_response, *_once(values)))
        return (None, None, *(next(grads) if need else None for need in needs))

    @staticmethod
    def jvp(ctx: Any, _: None, __: None, *tangents: torch.Tensor | None) -> tuple[torch.Tensor, torch.Tensor]:
        needs = tuple(tangent is not None for tangent in tangents)
        seed, *values = ctx.saved_tensors
        return RenderJVP.apply(replace(ctx.job, needs=needs), seed, *_given(tangents), *_once(values))

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> tuple[Any, Any]:
        return _each(Render, info, in_dims, args)


class RenderVJP(torch.autograd.Function):
    """(job, seed, g_steady, g_response, *values) -> gradients of the values that need one."""

    @staticmethod
    def forward(
        job: RenderJob,
        seed: torch.Tensor | None,
        g_steady: torch.Tensor | None,
        g_response: torch.Tensor | None,
        *values: torch.Tensor,
    ) -> tuple[torch.Tensor, ...]:
        def run(*given: torch.Tensor | None) -> tuple[torch.Tensor, ...]:
            return tuple(engine.vjp(job.seeded(seed), values, *given))

        return each_of_older_vmap(run, g_steady, g_response)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        ctx.job, seed, _, _, *values = inputs
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(seed, *values)
        ctx.save_for_forward(seed, *values)

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor | None) -> tuple[Any, ...]:
        seed, *values = ctx.saved_tensors
        job = replace(ctx.job, needs=_those(ctx.job.needs, grads))
        d_steady = d_response = None
        if any(job.needs):
            d_steady, d_response = RenderJVP.apply(job, seed, *_given(grads), *values)
        of_cotangents = [
            d if need else None for d, need in zip((d_steady, d_response), ctx.needs_input_grad[2:4], strict=True)
        ]
        return (None, None, *of_cotangents, *(torch.zeros_like(value) for value in values))

    @staticmethod
    def jvp(ctx: Any, _: None, __: None, *tangents: torch.Tensor | None) -> tuple[torch.Tensor, ...]:
        seed, *values = ctx.saved_tensors
        return RenderVJP.apply(ctx.job, seed, *tangents[:2], *values)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> tuple[Any, Any]:
        return _each(RenderVJP, info, in_dims, args)


class RenderJVP(torch.autograd.Function):
    """(job, seed, *tangents of the values that need one, *values) -> derivatives of (steady, response)."""

    @staticmethod
    def forward(job: RenderJob, seed: torch.Tensor | None, *tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        count = sum(job.needs)

        def run(*tangents: torch.Tensor) -> tuple[torch.Tensor, ...]:
            return engine.jvp(job.seeded(seed), tensors[count:], tangents)

        return each_of_older_vmap(run, *tensors[:count])

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        ctx.job, seed, *tensors = inputs
        ctx.set_materialize_grads(False)
        values = tensors[sum(ctx.job.needs) :]
        ctx.save_for_backward(seed, *values)
        ctx.save_for_forward(seed, *values)

    @staticmethod
    def backward(ctx: Any, g_steady: torch.Tensor | None, g_response: torch.Tensor | None) -> tuple[Any, ...]:
        seed, *values = ctx.saved_tensors
        grads: tuple[Any, ...] = (None,) * sum(ctx.job.needs)
        if g_steady is not None or g_response is not None:
            grads = RenderVJP.apply(ctx.job, seed, g_steady, g_response, *values)
        return (None, None, *grads, *(torch.zeros_like(value) for value in values))

    @staticmethod
    def jvp(ctx: Any, _: None, __: None, *tangents: torch.Tensor | None) -> tuple[torch.Tensor, ...]:
        seed, *values = ctx.saved_tensors
        asked = tangents[: sum(ctx.job.needs)]
        job = replace(ctx.job, needs=_those(ctx.job.needs, asked))
        return RenderJVP.apply(job, seed, *_given(asked), *values)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> tuple[Any, Any]:
        return _each(RenderJVP, info, in_dims, args)
