"""The Markov chain of detection phases under a non-paralyzable dead time, and its stationary distribution.

One step is a shift by the dead time followed by a decaying sum round the period: O(T) in time and memory, never the
T x T matrix of a pixel. Where plain iteration stalls (high flux: phases then move almost rigidly) GMRES finishes it.
Gradients are implicit: one more solve, with the transpose.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchtransient.sensing.krylov import gmres

_TOLERANCE = 1e-11  # of the distribution, summed over a period
_PLAIN_STEPS = 24
_PIXELS_AT_ONCE = 256  # bounds the memory of the Krylov vectors
# exp(+-x) of the running sums stays inside float64 below this flux; beyond, sums are made in blocks
_SAFE_EXPONENT = 600.0


class RenewalChain:
    """One step of the Markov chain of detections and its transpose, for rows (P, T) of rates per period, float64."""

    def __init__(self, rate: Tensor, whole: int, part: Tensor) -> None:
        self.fire = -torch.expm1(-rate)
        self.decay = torch.exp(-rate)
        total = rate.sum(-1, keepdim=True)
        # a detector that waits for a whole period without a detection: the sum over all periods is 1/(1 - exp(-total))
        self.rounds = 1 / -torch.expm1(-total)
        self.rate, self.total, self.whole, self.part = rate, total, whole, part
        before = rate.cumsum(-1) - rate
        self.blocks = self._blocks(before)

    def _blocks(self, before: Tensor) -> list[tuple[int, int, Tensor, Tensor]]:
        """(begin, end, exp(-flux since begin), exp(+the same)) for stretches short enough for float64."""
        bins = before.shape[-1]
        begin, blocks = 0, []
        while begin < bins:
            flux = before[:, begin:] - before[:, begin : begin + 1]
            inside = int((flux.amax(0) <= _SAFE_EXPONENT).sum())
            end = begin + max(1, inside)
            part = flux[:, : end - begin]
            blocks.append((begin, end, torch.exp(-part), torch.exp(part)))
            begin = end
        return blocks

    def armed(self, rearmed: Tensor) -> Tensor:
        """Armed probabilities from the inflow: A[k] = A[k-1] exp(-rate[k-1]) + rearmed[k], round the period."""
        parts, carry = [], torch.zeros_like(rearmed[:, :1])
        for begin, end, falling, rising in self.blocks:
            piece = falling * (carry + (rearmed[:, begin:end] * rising).cumsum(-1))
            parts.append(piece)
            carry = piece[:, -1:] * self.decay[:, end - 1 : end]
        once = torch.cat(parts, -1)
        # what is left at the end of the period starts the next one, and the one after, ...
        rest = carry * self.rounds
        return once + rest * torch.exp(-(self.rate.cumsum(-1) - self.rate))

    def armed_transposed(self, weights: Tensor) -> Tensor:
        """The transpose of `armed`."""
        before = self.rate.cumsum(-1) - self.rate
        carry = (weights * torch.exp(-before)).sum(-1, keepdim=True) * self.rounds
        parts = []
        # the last bin hands `carry` on through its own decay
        carry = carry * self.decay[:, -1:]
        for begin, end, falling, rising in reversed(self.blocks):
            inner = (weights[:, begin:end] * falling).flip(-1).cumsum(-1).flip(-1)
            piece = rising * (inner + carry * falling[:, -1:])
            parts.append(piece)
            if begin > 0:
                carry = piece[:, :1] * self.decay[:, begin - 1 : begin]
        return torch.cat(parts[::-1], -1)

    def shift(self, detected: Tensor) -> Tensor:
        return (1 - self.part) * detected.roll(self.whole, -1) + self.part * detected.roll(self.whole + 1, -1)

    def step(self, detected: Tensor) -> Tensor:
        """Distribution of the next detection's phase."""
        return self.fire * self.armed(self.shift(detected))

    def transposed(self, weights: Tensor) -> Tensor:
        back = self.armed_transposed(self.fire * weights)
        return (1 - self.part) * back.roll(-self.whole, -1) + self.part * back.roll(-self.whole - 1, -1)


def _stationary(chain: RenewalChain) -> Tensor:
    """Fixed point of the chain with sum 1, rows (P, T)."""
    pi = chain.rate / chain.total
    for _ in range(_PLAIN_STEPS):
        following = chain.step(pi)
        following = following / following.sum(-1, keepdim=True)
        change = (following - pi).abs().sum(-1).amax()
        pi = following
        if float(change) <= 0.1 * _TOLERANCE:
            return pi
    # (1 - F + u 1^T) pi = u has the stationary pi as its only solution when sum u = 1; start from what we have
    u = pi

    def operator(v: Tensor) -> Tensor:
        return v - chain.step(v) + u * v.sum(-1, keepdim=True)

    pi = gmres(operator, u, pi, _TOLERANCE)
    pi = pi.clamp_min(0)
    return pi / pi.sum(-1, keepdim=True)


class _StationaryPhases(torch.autograd.Function):
    """rate (P, T) and the fraction of a bin -> stationary distribution; backward by the implicit function theorem."""

    @staticmethod
    def forward(ctx: Any, rate: Tensor, part: Tensor, whole: int) -> Tensor:
        ctx.whole = whole
        rows = []
        for piece in torch.split(rate, _PIXELS_AT_ONCE):
            rows.append(_stationary(RenewalChain(piece, whole, part)))
        pi = torch.cat(rows)
        ctx.save_for_backward(rate, part, pi)
        return pi

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        rate, part, pi = ctx.saved_tensors
        by_rate, by_part = [], torch.zeros_like(part)
        for r, p, g in zip(*(torch.split(rows, _PIXELS_AT_ONCE) for rows in (rate, pi, gradient)), strict=True):
            chain = RenewalChain(r, ctx.whole, part)

            def operator(v: Tensor, chain: RenewalChain = chain, p: Tensor = p) -> Tensor:
                return v - chain.transposed(v) + (p * v).sum(-1, keepdim=True)

            # the constant part of the gradient meets sum d pi = 0 and drops out
            right = g - (p * g).sum(-1, keepdim=True)
            adjoint = gmres(operator, right, torch.zeros_like(right), _TOLERANCE)
            with torch.enable_grad():
                leaves = r.detach().requires_grad_(), part.detach().requires_grad_()
                value = RenewalChain(leaves[0], ctx.whole, leaves[1]).step(p)
                found = torch.autograd.grad(value, leaves, adjoint)
            by_rate.append(found[0])
            by_part = by_part + found[1]
        return torch.cat(by_rate), by_part, None


def stationary_phases(rate: Tensor, part: Tensor, whole: int) -> Tensor:
    """Distribution (P, T) of the phases of detections for rates (P, T) per period, float64, each row above 0.

    `whole`, `part`: from `split_dead_time`. Differentiable once in `rate` and `part`.
    """
    pi: Tensor = _StationaryPhases.apply(rate, part, whole)  # type: ignore[no-untyped-call]
    return pi
