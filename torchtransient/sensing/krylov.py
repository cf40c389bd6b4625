"""GMRES for many small independent systems at once, each row its own."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchtransient.errors import TorchTransientError

_VECTORS = 40
_RESTARTS = 25


def gmres(operator: Callable[[Tensor], Tensor], right: Tensor, start: Tensor, tolerance: float) -> Tensor:
    """Solve operator(x) = right for rows (P, T), float64, to |residual| <= tolerance |right| in every row.

    Restarted after 40 vectors. The operator has to be linear and to act on every row alone. Raises TorchTransientError
    when a thousand steps do not get within 1e4 times the tolerance. Source: Saad and Schultz, SIAM J. Sci. Stat.
    Comput. 7 (1986).
    """
    x = start
    scale = right.norm(dim=-1).clamp_min(1e-300)
    worst = float("inf")
    for _ in range(_RESTARTS):
        residual = right - operator(x)
        length = residual.norm(dim=-1)
        before, worst = worst, float((length / scale).amax())
        if worst <= tolerance:
            return x
        if worst > 0.5 * before and worst <= 1e4 * tolerance:
            return x  # rounding does not let it come closer
        x = x + _cycle(operator, residual, length, 0.1 * tolerance * scale)
    residual = right - operator(x)
    worst = min(worst, float((residual.norm(dim=-1) / scale).amax()))
    if not worst <= 1e4 * tolerance:
        raise TorchTransientError(
            f"gmres: expected a residual of {tolerance:g}, got {worst:g} after {_RESTARTS * _VECTORS} steps. Lower the "
            "flux per period or use fewer, wider bins."
        )
    return x


def _cycle(operator: Callable[[Tensor], Tensor], residual: Tensor, length: Tensor, goal: Tensor) -> Tensor:
    """The correction in the Krylov space of one restart."""
    rows = residual.shape[0]
    safe = length.clamp_min(1e-300).unsqueeze(-1)
    basis = [residual / safe]
    table = residual.new_zeros(rows, _VECTORS + 1, _VECTORS)
    used = 0
    for k in range(_VECTORS):
        v = operator(basis[k])
        stacked = torch.stack(basis, 1)
        # Gram-Schmidt twice is as good as the modified one, and two matrix products
        for _ in range(2):
            overlap = torch.bmm(stacked, v.unsqueeze(-1))
            v = v - torch.bmm(overlap.transpose(1, 2), stacked).squeeze(1)
            table[:, : k + 1, k] += overlap.squeeze(-1)
        norm = v.norm(dim=-1)
        table[:, k + 1, k] = norm
        basis.append(torch.where((norm > 1e-14).unsqueeze(-1), v / norm.clamp_min(1e-300).unsqueeze(-1), v * 0))
        used = k + 1
        if used % 8 == 0 and bool((_solve(table, used, length)[1] <= goal).all()):
            break
    coefficients, _ = _solve(table, used, length)
    return torch.einsum("pk,pkt->pt", coefficients, torch.stack(basis[:used], 1))


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
