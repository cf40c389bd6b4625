"""Detectors that run free with carriers trapped: a renewal chain with losses, solved with implicit gradients."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchtransient.errors import TorchTransientError
from torchtransient.sensing.dead_time.constant_light import ConstantLight
from torchtransient.sensing.dead_time.renewal_chain import RenewalChain
from torchtransient.sensing.numerics.krylov import gmres

_TOLERANCE = 1e-10  # derivatives are compared to 1e-6
_WORST = 1e-7  # of what is added to a detector: residual, above which it is an error
_ROWS_AT_ONCE = 128  # bounds the memory of the Krylov vectors


def _twice(x: Tensor) -> Tensor:
    return torch.cat([x, x], -1)


class _Chain:
    """x -> step of the share `kept` of x, and what it needs to be undone."""

    def __init__(self, loss: Tensor, kept: Tensor, part: Tensor, whole: int) -> None:
        self.chain, self.kept = RenewalChain(loss, whole, part), kept
        wait, share = 1 / loss.mean(-1, keepdim=True), kept.mean(-1, keepdim=True)
        self.constant = ConstantLight(wait, self.chain.bins, whole, part, share)

    def step(self, x: Tensor) -> Tensor:
        return self.chain.step(_twice(self.kept) * x)

    def solve(self, right: Tensor) -> Tensor:
        return self._checked(*gmres(lambda v: v - self.step(v), right, right, _TOLERANCE, self.constant.solve))

    def solve_transposed(self, right: Tensor) -> Tensor:
        def operator(v: Tensor) -> Tensor:
            return v - _twice(self.kept) * self.chain.transposed(v)

        return self._checked(*gmres(operator, right, right, _TOLERANCE, self.constant.solve_transposed))

    @staticmethod
    def _checked(found: Tensor, residual: Tensor) -> Tensor:
        if not bool((residual <= _WORST).all()):
            raise TorchTransientError(
                f"AfterpulsingSPAD: expected a relative residual of {_WORST:g} of the carriers that are trapped, got "
                f"{float(residual.max()):g}. Lower the flux per period or use fewer, wider bins."
            )
        return found


def _step(given: Sequence[Tensor], whole: int, x: Tensor) -> Tensor:
    loss, kept, source, part = given
    return RenewalChain(loss, whole, part).step(_twice(kept) * x + source)


class _Trapped(torch.autograd.Function):
    """Both modes by the implicit function theorem."""

    @staticmethod
    def forward(ctx: Any, loss: Tensor, kept: Tensor, source: Tensor, part: Tensor, whole: int) -> Tensor:
        ctx.whole = whole
        found = []
        for at in torch.split(torch.arange(loss.shape[0], device=loss.device), _ROWS_AT_ONCE):
            chain = _Chain(loss[at], kept[at], part, whole)
            found.append(chain.solve(chain.chain.step(source[at])))
        x = torch.cat(found)
        ctx.save_for_backward(loss, kept, source, part, x)
        ctx.save_for_forward(loss, kept, source, part, x)
        return x

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Tensor:
        loss, kept, source, part, x = ctx.saved_tensors
        given = (loss, kept, source, part)
        along = [torch.zeros_like(v) if t is None else t for v, t in zip(given, tangents, strict=False)]
        with torch.enable_grad():
            leaves = [v.detach().requires_grad_() for v in given]
            value = _step(leaves, ctx.whole, x)
            weights = torch.zeros_like(value, requires_grad=True)
            gradients = torch.autograd.grad(value, leaves, weights, create_graph=True)
            total = torch.stack([(g * t).sum() for g, t in zip(gradients, along, strict=True)]).sum()
            right = torch.autograd.grad(total, weights)[0]
        found = []
        for at in torch.split(torch.arange(loss.shape[0], device=loss.device), _ROWS_AT_ONCE):
            found.append(_Chain(loss[at], kept[at], part, ctx.whole).solve(right[at]))
        return torch.cat(found)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        loss, kept, source, part, x = ctx.saved_tensors
        found = []
        for at in torch.split(torch.arange(loss.shape[0], device=loss.device), _ROWS_AT_ONCE):
            found.append(_Chain(loss[at], kept[at], part, ctx.whole).solve_transposed(gradient[at]))
        with torch.enable_grad():
            leaves = [v.detach().requires_grad_() for v in (loss, kept, source, part)]
            value = _step(leaves, ctx.whole, x)
            gradients = torch.autograd.grad(value, leaves, torch.cat(found))
        return *gradients, None


def trapped_lines(loss: Tensor, kept: Tensor, source: Tensor, part: Tensor, whole: int) -> Tensor:
    """Stationary lines (R, 2 T) of all that is lost at the rates `loss` (R, T) > 0 while armed.

    Of it the shares `kept` (R, T) come back after the dead time (`whole` bins and `part` of one), and so do the lines
    `source` (R, 2 T). float64, differentiable once in all four tensors. Raises TorchTransientError where it does not
    converge.
    """
    x: Tensor = _Trapped.apply(loss, kept, source, part, whole)  # type: ignore[no-untyped-call]
    return x
