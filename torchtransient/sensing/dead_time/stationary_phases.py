"""The stationary distribution of detection phases: a preconditioned Krylov solve, with implicit gradients.

In dim light the chain forgets within a few steps. In bright light it turns the phases almost rigidly; the chain in
constant light of the same mean wait, inverted in the frequencies of the period, turns them alike and takes the
slowness away. Gradients are one more solve, with the transpose.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchtransient.errors import TorchTransientError
from torchtransient.sensing.dead_time.banded_solve import solve_banded
from torchtransient.sensing.dead_time.constant_light import ConstantLight
from torchtransient.sensing.dead_time.renewal_chain import RenewalChain
from torchtransient.sensing.numerics.krylov import gmres

_TOLERANCE = 1e-11  # of the distribution, in the norm of a row
_ENOUGH = 5e-11  # residual above which rows are solved directly
_WORST = 1e-9  # residual of that, above which it is an error
_PLAIN_STEPS = 4
_PIXELS_AT_ONCE = 128  # bounds the memory of the Krylov vectors


def _counts(chain: RenewalChain, lines: Tensor) -> Tensor:
    return lines[:, : chain.bins].sum(-1, keepdim=True)


def _constant(chain: RenewalChain, pi: Tensor) -> ConstantLight:
    return ConstantLight(chain.waiting(pi) / _counts(chain, pi), chain.bins, chain.whole, chain.part)


def _check(residual: Tensor) -> None:
    worst = float(residual.max())
    if not worst <= _WORST:
        raise TorchTransientError(
            f"stationary_phases: expected a relative residual of {_WORST:g}, got {worst:g}, by iteration and directly. "
            "Lower the flux per period or use fewer, wider bins."
        )


def _stationary(chain: RenewalChain) -> Tensor:
    """Fixed point of the chain with counts that sum to 1, rows (P, 2 T)."""
    pi = torch.cat([chain.rate / chain.rate.sum(-1, keepdim=True), torch.zeros_like(chain.rate)], -1)
    for _ in range(_PLAIN_STEPS):
        pi = chain.step(pi)
        pi = pi / _counts(chain, pi)
    # (1 - F + u 1^T) pi = u has the stationary pi as its only solution when sum u = 1; start from what we have
    u = pi

    def operator(v: Tensor) -> Tensor:
        return v - chain.step(v) + u * _counts(chain, v)

    pi, residual = gmres(operator, u, pi, _TOLERANCE, _constant(chain, pi).solve)
    pi = pi / _counts(chain, pi)
    rows = (~(residual <= _ENOUGH)).nonzero().flatten()
    if rows.numel():
        hard = RenewalChain(chain.rate[rows], chain.whole, chain.part)
        pinned = u[rows, : chain.bins].argmax(-1)
        right = torch.zeros_like(u[rows]).scatter_(1, pinned.unsqueeze(-1), 1.0)
        direct = solve_banded(hard, right, pinned, transposed=False)
        direct = direct / _counts(hard, direct)
        _check((hard.step(direct) - direct).norm(dim=-1) / direct.norm(dim=-1))
        pi = pi.index_copy(0, rows, direct)
    return pi


def _adjoint(chain: RenewalChain, pi: Tensor, gradient: Tensor) -> Tensor:
    """Solution of (1 - F^T) x = gradient less its product with pi, with pi x = 0."""
    ones = torch.cat([torch.ones_like(chain.rate), torch.zeros_like(chain.rate)], -1)

    def operator(v: Tensor) -> Tensor:
        return v - chain.transposed(v) + ones * (pi * v).sum(-1, keepdim=True)

    # the constant part of the gradient meets sum d pi = 0 and drops out
    right = gradient - ones * (pi * gradient).sum(-1, keepdim=True)
    found, residual = gmres(operator, right, torch.zeros_like(right), _TOLERANCE, _constant(chain, pi).solve_transposed)
    rows = (~(residual <= _ENOUGH)).nonzero().flatten()
    if rows.numel():
        hard, p, g = RenewalChain(chain.rate[rows], chain.whole, chain.part), pi[rows], right[rows]
        direct = solve_banded(hard, g, p[:, : chain.bins].argmax(-1), transposed=True)
        direct = direct - ones[rows] * (p * direct).sum(-1, keepdim=True)
        _check((direct - hard.transposed(direct) - g).norm(dim=-1) / direct.norm(dim=-1))
        found = found.index_copy(0, rows, direct)
    return found


def _tangent(chain: RenewalChain, pi: Tensor, right: Tensor) -> Tensor:
    """Solution of (1 - F) x = right with counts that sum to 0, for `right` whose counts do."""

    def operator(v: Tensor) -> Tensor:
        return v - chain.step(v) + pi * _counts(chain, v)

    found, residual = gmres(operator, right, torch.zeros_like(right), _TOLERANCE, _constant(chain, pi).solve)
    rows = (~(residual <= _ENOUGH)).nonzero().flatten()
    if rows.numel():
        hard, p, r = RenewalChain(chain.rate[rows], chain.whole, chain.part), pi[rows], right[rows]
        direct = solve_banded(hard, r, p[:, : chain.bins].argmax(-1), transposed=False)
        direct = direct - p * _counts(hard, direct)
        _check((direct - hard.step(direct) - r).norm(dim=-1) / direct.norm(dim=-1))
        found = found.index_copy(0, rows, direct)
    return found


def tangent_phases(chain: RenewalChain, pi: Tensor, right: Tensor) -> Tensor:
    """All that becomes of lines `right` (P, 2 T) whose counts sum to 0: themselves and every detection after them.

    Up to a multiple of the stationary lines `pi`; its own counts sum to 0. Without gradient.
    """
    found = []
    for r, p, d in zip(*(torch.split(rows, _PIXELS_AT_ONCE) for rows in (chain.rate, pi, right)), strict=True):
        # rounding is no excess
        d = d - p * _counts(chain, d)
        found.append(_tangent(RenewalChain(r, chain.whole, chain.part), p, d))
    return torch.cat(found)


def _step_along(rate: Tensor, whole: int, part: Tensor, pi: Tensor, by_rate: Tensor, by_part: Tensor) -> Tensor:
    """Derivative of one step of the chain from `pi` along changes of the rate and of the fraction of a bin.

    Backward twice: the gradient is linear in its weights, and its derivative by these is the one looked for.
    """
    with torch.enable_grad():
        leaves = rate.detach().requires_grad_(), part.detach().requires_grad_()
        value = RenewalChain(leaves[0], whole, leaves[1]).step(pi)
        weights = torch.zeros_like(value, requires_grad=True)
        gradients = torch.autograd.grad(value, leaves, weights, create_graph=True)
        along = (gradients[0] * by_rate).sum() + gradients[1] * by_part
        return torch.autograd.grad(along, weights)[0]


class _StationaryPhases(torch.autograd.Function):
    """rate (P, T) and the fraction of a bin -> stationary lines; both modes by the implicit function theorem."""

    @staticmethod
    def forward(ctx: Any, rate: Tensor, part: Tensor, whole: int) -> Tensor:
        ctx.whole = whole
        pi = torch.cat([_stationary(RenewalChain(r, whole, part)) for r in torch.split(rate, _PIXELS_AT_ONCE)])
        ctx.save_for_backward(rate, part, pi)
        ctx.save_for_forward(rate, part, pi)
        return pi

    @staticmethod
    def jvp(ctx: Any, by_rate: Tensor | None, by_part: Tensor | None, _: None) -> Tensor:
        rate, part, pi = ctx.saved_tensors
        by_rate = torch.zeros_like(rate) if by_rate is None else by_rate
        by_part = torch.zeros_like(part) if by_part is None else by_part
        found = []
        for r, p, d in zip(*(torch.split(rows, _PIXELS_AT_ONCE) for rows in (rate, pi, by_rate)), strict=True):
            right = _step_along(r, ctx.whole, part, p, d, by_part)
            found.append(_tangent(RenewalChain(r, ctx.whole, part), p, right))
        return torch.cat(found)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        rate, part, pi = ctx.saved_tensors
        by_rate, by_part = [], torch.zeros_like(part)
        for r, p, g in zip(*(torch.split(rows, _PIXELS_AT_ONCE) for rows in (rate, pi, gradient)), strict=True):
            adjoint = _adjoint(RenewalChain(r, ctx.whole, part), p, g)
            with torch.enable_grad():
                leaves = r.detach().requires_grad_(), part.detach().requires_grad_()
                value = RenewalChain(leaves[0], ctx.whole, leaves[1]).step(p)
                found = torch.autograd.grad(value, leaves, adjoint)
            by_rate.append(found[0])
            by_part = by_part + found[1]
        return torch.cat(by_rate), by_part, None


def stationary_phases(rate: Tensor, part: Tensor, whole: int) -> Tensor:
    """Stationary lines (P, 2 T) of detections, counts summing to 1, for rates (P, T) per period, float64, rows above 0.

    `whole`, `part`: the dead time in bins, split. Differentiable once in `rate` and `part`.
    """
    pi: Tensor = _StationaryPhases.apply(rate, part, whole)  # type: ignore[no-untyped-call]
    return pi
