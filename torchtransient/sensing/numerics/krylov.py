"""GMRES for many small independent systems at once, each row its own."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

_VECTORS = 40
_RESTARTS = 2

Operator = Callable[[Tensor], Tensor]


def _as_it_is(x: Tensor) -> Tensor:
    return x


def gmres(
    operator: Operator, right: Tensor, start: Tensor, tolerance: float, precondition: Operator = _as_it_is
) -> tuple[Tensor, Tensor]:
    """Solve operator(x) = right for rows (P, T), float64, to |residual| <= tolerance |right| in every row.

    Returns x and |residual| / |right| (P,), which the caller has to look at: it stops after two restarts of 40 vectors
    each. Both operators have to be linear and to act on every row alone; `precondition` is about the inverse of
    `operator`, and applied from the right, so that residuals are true ones. Source: Saad and Schultz, SIAM J. Sci.
    Stat. Comput. 7 (1986).
    """
    x = start
    scale = right.norm(dim=-1).clamp_min(1e-300)
    residual = right - operator(x)
    length = residual.norm(dim=-1)
    for _ in range(_RESTARTS):
        if bool((length <= tolerance * scale).all()):
            break
        x = x + precondition(_cycle(operator, precondition, residual, length, 0.1 * tolerance * scale))
        residual = right - operator(x)
        length = residual.norm(dim=-1)
    return x, length / scale


def _cycle(operator: Operator, precondition: Operator, residual: Tensor, length: Tensor, goal: Tensor) -> Tensor:
    """The correction, before `precondition`, in the Krylov space of one restart."""
    rows, size = residual.shape
    basis = residual.new_empty(rows, _VECTORS + 1, size)
    basis[:, 0] = residual / length.clamp_min(1e-300).unsqueeze(-1)
    table = residual.new_zeros(rows, _VECTORS + 1, _VECTORS)
    used = 0
    for k in range(_VECTORS):
        v = operator(precondition(basis[:, k]))
        spanned = basis[:, : k + 1]
        # Gram-Schmidt twice is as good as the modified one, and two matrix products
        for _ in range(2):
            overlap = torch.bmm(spanned, v.unsqueeze(-1))
            v = v - torch.bmm(overlap.transpose(1, 2), spanned).squeeze(1)
            table[:, : k + 1, k] += overlap.squeeze(-1)
        norm = v.norm(dim=-1)
        table[:, k + 1, k] = norm
        basis[:, k + 1] = torch.where((norm > 1e-14).unsqueeze(-1), v / norm.unsqueeze(-1), 0.0)
        used = k + 1
        if used % 4 == 0 and bool((_solve(table, used, length)[1] <= goal).all()):
            break
    coefficients, _ = _solve(table, used, length)
    return torch.bmm(coefficients.unsqueeze(1), basis[:, :used]).squeeze(1)


def _solve(table: Tensor, used: int, length: Tensor) -> tuple[Tensor, Tensor]:
    """Least squares of every row in its Krylov space: coefficients (P, used) and residual lengths (P,)."""
    matrix = table[:, : used + 1, :used]
    right = torch.zeros_like(matrix[:, :, 0])
    right[:, 0] = length
    q, r = torch.linalg.qr(matrix)
    diagonal = r.diagonal(dim1=-2, dim2=-1)
    # a row that is solved early has zero columns behind; they get no weight
    dead = diagonal.abs() < 1e-13
    r = r + torch.diag_embed(dead.to(r.dtype))
    projected = torch.einsum("pij,pi->pj", q, right) * (~dead)
    coefficients = torch.linalg.solve_triangular(r, projected.unsqueeze(-1), upper=True).squeeze(-1) * (~dead)
    residual = right - torch.einsum("pij,pj->pi", matrix, coefficients)
    return coefficients, residual.norm(dim=-1)
