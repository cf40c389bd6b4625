"""The three autograd functions of calls that are run, and run again for their derivatives.

``Run`` keeps no Dr.Jit graph. It saves its inputs, and its derivatives are runs of their own: ``Pullback`` and
``Pushforward``, linear in the cotangents and tangents. They are functions of torch too, so that ``torch.func`` can
batch them, and each is the other's derivative by its linear arguments (``torch.autograd.functional.jvp`` rests on
that). Differentiating them by the *values* is refused (``OnceDifferentiable``), since Dr.Jit has no second derivatives.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NoReturn, Protocol

import torch

from torchtransient.errors import GradientError, ShapeError
from torchtransient.interfaces import BACKWARD, FORWARD, RENDER
from torchtransient.rendering import engine
from torchtransient.rendering.batches import run_in_batches
from torchtransient.rendering.job import RenderJob

Tensors = tuple[torch.Tensor, ...]


@dataclass(frozen=True)
class Request:
    """Derivatives that are requested of a call.

    Args:
        needs: truth value of each input tensor, whether there is a derivative by it.
        has_cotangent: truth value of each real output, whether it has a cotangent.
    """

    needs: tuple[bool, ...]
    has_cotangent: tuple[bool, ...] = ()


class Replayable(Protocol):
    """Call that is run, and run again for its derivatives.

    Tensors are those of the call, in its order. Cotangents are those of the real outputs that have one, tangents those
    of the tensors that need a derivative.
    """

    @property
    def what(self) -> str:
        """Name of the call in messages."""

    def primal(self, tensors: Sequence[torch.Tensor]) -> Tensors:
        """Return the outputs."""

    def pullback(
        self, request: Request, tensors: Sequence[torch.Tensor], cotangents: Sequence[torch.Tensor]
    ) -> Tensors:
        """Return the gradients of the sum over outputs of <cotangent, output> by the tensors that need one."""

    def pushforward(
        self, request: Request, tensors: Sequence[torch.Tensor], tangents: Sequence[torch.Tensor]
    ) -> Tensors:
        """Return the derivatives of all real outputs along tangents of the tensors that need one."""


def run(job: Replayable, *tensors: torch.Tensor) -> Tensors:
    """Return the outputs of a call, differentiable by the real ones of its tensors.

    Args:
        job: job that is executed now, and again for its derivatives.
        tensors: values of its parameters, in the order of its keys.
    """
    outputs: Tensors = Run.apply(job, *tensors)  # type: ignore[no-untyped-call]
    return outputs


class OnceDifferentiable(torch.autograd.Function):
    """Value of a derivative, by which a derivative would be a second one.

    Autograd calls it only where one is asked for; a derivative by the cotangent or tangent alone passes by.
    """

    @staticmethod
    def forward(what: str, value: torch.Tensor) -> torch.Tensor:
        return value.view_as(value)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        ctx.what = inputs[0]

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> NoReturn:
        _refuse_second(ctx.what, "reverse")

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> NoReturn:
        _refuse_second(ctx.what, "forward")

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], what: str, value: torch.Tensor) -> tuple[Any, Any]:
        return OnceDifferentiable.apply(what, value), in_dims[1]  # type: ignore[no-untyped-call]


def _refuse_second(what: str, mode: str) -> NoReturn:
    raise GradientError(
        f"second derivatives of {what} are not available: its gradient or tangent was differentiated again in {mode} "
        "mode. Expected a first derivative; for curvature use finite differences of gradients, or a Gauss-Newton "
        "product J^T J v from torch.func.jvp and torch.func.vjp."
    )


def _once(job: Replayable, tensors: Sequence[torch.Tensor]) -> list[torch.Tensor]:
    return [OnceDifferentiable.apply(job.what, t) if t.is_floating_point() else t for t in tensors]  # type: ignore[no-untyped-call]


def _check_runs(job: Replayable, tensors: Sequence[torch.Tensor]) -> None:
    """Raise ``GradientError`` where a run would become a constant of a graph that torch is tracing, and for the batches
    of ``torch.autograd``, which reach ``forward`` as one tensor without memory.
    """
    if any(torch._C._functorch.is_legacy_batchedtensor(tensor) for tensor in tensors):
        raise GradientError(
            f"{job.what} has no rule for the batches of torch.autograd (jacobian and hessian with vectorize=True, grad "
            "with is_grads_batched=True). Expected torch.func.jacrev, torch.func.jacfwd or torch.func.vmap, or "
            "vectorize=False."
        )
    modes: Any = torch._ops
    key = torch._C._TorchDispatchModeKey.PROXY
    tracing = torch._C._get_dispatch_mode(key) or modes._get_dispatch_mode_pre_dispatch(key)
    fake = sys.modules.get("torch._subclasses.fake_tensor")
    if tracing is None and not (fake is not None and any(isinstance(tensor, fake.FakeTensor) for tensor in tensors)):
        return
    raise GradientError(
        f"{job.what} cannot be traced: in the graphs of torch.func.linearize, torch.export and make_fx it would be a "
        "constant, and tensors without memory have no values. Expected tensors with values: use torch.func.jvp and "
        "torch.func.vjp, which are evaluated again for every tangent."
    )


def _without_none(tensors: Sequence[torch.Tensor | None]) -> list[torch.Tensor]:
    return [tensor for tensor in tensors if tensor is not None]


def _flags_with_tensor(flags: Sequence[bool], tensors: Sequence[torch.Tensor | None]) -> tuple[bool, ...]:
    """Return the flags whose entry in ``tensors``, which has one for each flag that is set, is not None."""
    remaining = iter(tensors)
    return tuple(flag and next(remaining) is not None for flag in flags)


def _zeros(tensors: Sequence[torch.Tensor]) -> list[torch.Tensor | None]:
    return [torch.zeros_like(tensor) if tensor.is_floating_point() else None for tensor in tensors]


def _vmap_by_loop(
    function: Any, info: Any, in_dims: tuple[Any, ...], args: tuple[Any, ...]
) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """Return outputs and their batch dimensions under ``vmap``, by one call for each entry."""
    if not info.batch_size:
        raise ShapeError(f"{args[0].what}: expected a batch of at least one entry under torch.func.vmap, got none.")
    columns = []
    for i in range(info.batch_size):
        entry = [arg if dim is None else arg.select(dim, i) for arg, dim in zip(args, in_dims, strict=True)]
        columns.append(function.apply(*entry))
    outputs = tuple(torch.stack(column) for column in zip(*columns, strict=True))
    return outputs, (0,) * len(outputs)


class Run(torch.autograd.Function):
    """Function of torch: (job, *tensors) -> outputs."""

    @staticmethod
    def forward(job: Replayable, *tensors: torch.Tensor) -> Tensors:
        _check_runs(job, tensors)
        return job.primal(tensors)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        ctx.job, *tensors = inputs
        ctx.is_real = [out.is_floating_point() for out in output]
        ctx.mark_non_differentiable(*(out for out in output if not out.is_floating_point()))
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*tensors)
        ctx.save_for_forward(*tensors)

    @staticmethod
    def backward(ctx: Any, *cotangents: torch.Tensor | None) -> tuple[Any, ...]:
        real = [g for g, is_real in zip(cotangents, ctx.is_real, strict=True) if is_real]
        request = Request(tuple(ctx.needs_input_grad[1:]), tuple(g is not None for g in real))
        if not any(request.has_cotangent) or not any(request.needs):
            return (None,) * (1 + len(request.needs))
        found = iter(Pullback.apply(ctx.job, request, *_without_none(real), *_once(ctx.job, ctx.saved_tensors)))  # type: ignore[no-untyped-call]
        return (None, *(next(found) if need else None for need in request.needs))

    @staticmethod
    def jvp(ctx: Any, _: None, *tangents: torch.Tensor | None) -> tuple[Any, ...]:
        request = Request(tuple(tangent is not None for tangent in tangents))
        found = iter(Pushforward.apply(ctx.job, request, *_without_none(tangents), *_once(ctx.job, ctx.saved_tensors)))  # type: ignore[no-untyped-call]
        return tuple(next(found) if is_real else None for is_real in ctx.is_real)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> tuple[Any, Any]:
        return _vmap_by_loop(Run, info, in_dims, args)


class Pullback(torch.autograd.Function):
    """Function of torch: (job, request, *cotangents, *tensors) -> gradients of the tensors that need one."""

    @staticmethod
    def forward(job: Replayable, request: Request, *tensors: torch.Tensor) -> Tensors:
        _check_runs(job, tensors)
        count = sum(request.has_cotangent)
        return job.pullback(request, tensors[count:], tensors[:count])

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        ctx.job, ctx.request, *tensors = inputs
        ctx.set_materialize_grads(False)
        values = tensors[sum(ctx.request.has_cotangent) :]
        ctx.save_for_backward(*values)
        ctx.save_for_forward(*values)

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor | None) -> tuple[Any, ...]:
        values, request = ctx.saved_tensors, replace(ctx.request, needs=_flags_with_tensor(ctx.request.needs, grads))
        found: Sequence[Any] = [None] * len(request.has_cotangent)
        if any(request.needs):
            found = Pushforward.apply(ctx.job, request, *_without_none(grads), *values)  # type: ignore[no-untyped-call]
        of_cotangents = [d for d, is_given in zip(found, request.has_cotangent, strict=True) if is_given]
        wanted = ctx.needs_input_grad[2 : 2 + len(of_cotangents)]
        return (
            None,
            None,
            *(d if want else None for d, want in zip(of_cotangents, wanted, strict=True)),
            *_zeros(values),
        )

    @staticmethod
    def jvp(ctx: Any, _: None, __: None, *tangents: torch.Tensor | None) -> Tensors:
        of_cotangents = tangents[: sum(ctx.request.has_cotangent)]
        request = replace(ctx.request, has_cotangent=_flags_with_tensor(ctx.request.has_cotangent, of_cotangents))
        found: Tensors = Pullback.apply(ctx.job, request, *_without_none(of_cotangents), *ctx.saved_tensors)  # type: ignore[no-untyped-call]
        return found

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> tuple[Any, Any]:
        return _vmap_by_loop(Pullback, info, in_dims, args)


class Pushforward(torch.autograd.Function):
    """Function of torch: (job, request, *tangents, *tensors) -> derivatives of the real outputs."""

    @staticmethod
    def forward(job: Replayable, request: Request, *tensors: torch.Tensor) -> Tensors:
        _check_runs(job, tensors)
        count = sum(request.needs)
        return job.pushforward(request, tensors[count:], tensors[:count])

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        ctx.job, ctx.request, *tensors = inputs
        ctx.set_materialize_grads(False)
        values = tensors[sum(ctx.request.needs) :]
        ctx.save_for_backward(*values)
        ctx.save_for_forward(*values)

    @staticmethod
    def backward(ctx: Any, *cotangents: torch.Tensor | None) -> tuple[Any, ...]:
        request = replace(ctx.request, has_cotangent=tuple(g is not None for g in cotangents))
        grads: Sequence[Any] = (None,) * sum(request.needs)
        if any(request.has_cotangent):
            grads = Pullback.apply(ctx.job, request, *_without_none(cotangents), *ctx.saved_tensors)  # type: ignore[no-untyped-call]
        return (None, None, *grads, *_zeros(ctx.saved_tensors))

    @staticmethod
    def jvp(ctx: Any, _: None, __: None, *tangents: torch.Tensor | None) -> Tensors:
        of_tangents = tangents[: sum(ctx.request.needs)]
        request = replace(ctx.request, needs=_flags_with_tensor(ctx.request.needs, of_tangents))
        found: Tensors = Pushforward.apply(ctx.job, request, *_without_none(of_tangents), *ctx.saved_tensors)  # type: ignore[no-untyped-call]
        return found

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> tuple[Any, Any]:
        return _vmap_by_loop(Pushforward, info, in_dims, args)


# ------------------------------------------------------------------------------------------------------------ renders


@dataclass(frozen=True)
class RenderCall:
    """Render of a job, as a call of :func:`run`.

    Args:
        job: the job.
        seeds: number of leading tensors that are seeds, known inside of a ``vmap`` alone: 0 or 1.
    """

    job: RenderJob
    seeds: int

    @property
    def what(self) -> str:
        return "a render"

    def primal(self, tensors: Sequence[torch.Tensor]) -> Tensors:
        """Return steady and response."""
        job, values = self._seeded(tensors), tensors[self.seeds :]
        return engine.run(job, RENDER, values) if job.errors is None else run_in_batches(job, values)

    def pullback(
        self, request: Request, tensors: Sequence[torch.Tensor], cotangents: Sequence[torch.Tensor]
    ) -> Tensors:
        """Return the gradients of the values that need one."""
        given = iter(cotangents)
        adjoints = [next(given) if is_given else None for is_given in request.has_cotangent]
        return engine.run(self._seeded(tensors, request), BACKWARD, tensors[self.seeds :], adjoints)

    def pushforward(
        self, request: Request, tensors: Sequence[torch.Tensor], tangents: Sequence[torch.Tensor]
    ) -> Tensors:
        """Return the derivatives of steady and response."""
        return engine.run(self._seeded(tensors, request), FORWARD, tensors[self.seeds :], tangents)

    def _seeded(self, tensors: Sequence[torch.Tensor], request: Request | None = None) -> RenderJob:
        job = self.job.seeded(tensors[0] if self.seeds else None)
        return job if request is None else replace(job, needs=request.needs[self.seeds :])
