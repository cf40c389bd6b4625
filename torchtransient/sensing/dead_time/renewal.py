"""A non-paralyzable detector as a renewal process: the Markov chain of the phases of its detections.

In every bin the density of detections is a straight line with two coefficients (of 1 and of sqrt(3) (2 y - 1), y from 0
to 1 across the bin). The dead time shifts the lines, also by fractions of a bin; their decay while detectors are armed
is integrated exactly and projected on a straight line that keeps count and mean position. Exact for constant light, and
for a dead time of whole periods in any light; third order in the width of bins otherwise. One step is a shift followed
by a decaying sum round the period, O(T) in time and memory (`RenewalChain`).

The stationary distribution (`stationary_phases`) is found by GMRES, preconditioned with the chain in constant light of
the same mean wait, which is diagonal in the frequencies of the period (`ConstantLight`); rows that do not converge are
solved directly (`solve_banded`). Gradients follow from the implicit function theorem.

Sources: Rapp, Ma, Dawson, Goyal, Dead time compensation for high-flux ranging, IEEE TSP 67 (2019), for the chain; Saad
and Schultz, SIAM J. Sci. Stat. Comput. 7 (1986), for GMRES.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.autograd.functional import jvp

from torchtransient.errors import TorchTransientError, UnitError
from torchtransient.sensing.checks import one_number
from torchtransient.sensing.dead_time.once import once_differentiable

ROOT3 = math.sqrt(3.0)
_SERIES_BELOW = 1.0
_SMALLEST_TERM = 1e-19
_SAFE_EXPONENT = 600.0  # exp(+-x) of running sums stays inside float64; above, sums are made in blocks
_VECTORS, _RESTARTS = 40, 2  # of GMRES
_TOLERANCE = 1e-11  # of stationary lines, relative, in the norm of a row
_CONVERGED = 5e-11  # residual above which rows are solved directly
_LARGEST_RESIDUAL = 1e-9  # of the direct solution, above which it is an error
_POWER_STEPS = 4
_ROWS_OF_GMRES = 128  # bounds the memory of the Krylov vectors
_UNKNOWNS = 3  # of a bin: armed at its end, count and slope of its detections
_BLOCK = 6  # bins of a block at least: smaller ones cost more calls than they save
_ROWS_OF_BLOCKS = 32


def check_dead_bins(dead_bins: Tensor | float) -> float:
    """Return a dead time in bins as a number.

    Args:
        dead_bins: dead time in bins, number or scalar tensor.

    Raises:
        UnitError: below half a bin, or not finite.
    """
    given = one_number(dead_bins, "dead_bins", "dead time")
    value = float(given.detach()) if isinstance(given, Tensor) else given
    if not 0.5 - 1e-9 <= value < 1e9:
        raise UnitError(
            f"dead time: expected at least half a bin, got {value:g} bins. Use narrower bins, or no dead time "
            "(ShotNoise) where it does not matter."
        )
    return value


def split_dead_time(dead: Tensor) -> tuple[int, Tensor]:
    """Split a dead time into whole bins and the fraction of one that is left.

    Args:
        dead: dead time in bins, scalar.

    Returns:
        Whole bins, and the fraction, differentiable.
    """
    # a whole number that rounding has put just below itself is still that number
    whole = math.floor(float(dead.detach()) + 1e-9)
    part = dead - whole
    return whole, part - part.detach().clamp_max(0)


# -------------------------------------------------------------------------------------------------------------- one bin


@dataclass(frozen=True)
class Moments:
    """Integrals over z in [0, 1] of z^k exp(-x z) (`decay`) and of z^k (1 - exp(-x z)) / x (`hit`), k = 0 and 1."""

    decay: tuple[Tensor, Tensor]
    hit: tuple[Tensor, Tensor]


def _series_weights(largest: float) -> list[float]:
    """Coefficients of powers of -x in `hit[1]`, as many as count for x up to `largest`."""
    weights = [1 / 3]
    # the relative error of derivatives is that of a term two orders lower
    while weights[-1] * largest ** max(len(weights) - 3, 0) > _SMALLEST_TERM and len(weights) < 24:
        n = len(weights)
        weights.append(1 / (math.factorial(n + 1) * (n + 3)))
    return weights


def _series(x: Tensor, largest: float) -> Tensor:
    """Power series of `hit[1]`, for x in [0, 1]."""
    weights = _series_weights(largest)
    series = torch.full_like(x, weights[-1])
    for weight in reversed(weights[:-1]):
        series = weight - x * series
    return series


def moments(x: Tensor, largest: float | None = None) -> Moments:
    """Moments of exponentials: a series where x is small, recurrences that only add up otherwise.

    Args:
        x: >= 0, float64.
        largest: known bound of x, for x that cannot be read (torch.func.vmap).
    """
    if largest is not None and largest <= _SERIES_BELOW:
        hit_1 = _series(x, largest)
        decay_1 = 0.5 - x * hit_1
    else:
        small = x < _SERIES_BELOW
        near, far = torch.where(small, x, torch.zeros_like(x)), torch.where(small, torch.ones_like(x), x)
        if largest is None:
            largest = float(near.detach().amax()) if near.numel() else 0.0
        series = _series(near, min(largest, _SERIES_BELOW))
        closed = (0.5 - (1 - (1 + far) * torch.exp(-far)) / far**2) / far
        hit_1 = torch.where(small, series, closed)
        decay_1 = torch.where(small, 0.5 - near * series, (1 - (1 + far) * torch.exp(-far)) / far**2)
    decay_0 = torch.exp(-x) + x * decay_1
    return Moments((decay_0, decay_1), (decay_0 - decay_1, hit_1))


def second_moment(x: Tensor) -> Tensor:
    """Integral over z in [0, 1] of z^2 exp(-x z).

    Args:
        x: >= 0, float64.
    """
    small = x < _SERIES_BELOW
    near, far = torch.where(small, x, torch.zeros_like(x)), torch.where(small, torch.ones_like(x), x)
    series = torch.zeros_like(x)
    for n in range(18, -1, -1):  # the next term is below 1e-18
        series = 1 / (math.factorial(n) * (n + 3)) - near * series
    first = (1 - (1 + far) * torch.exp(-far)) / far**2
    return torch.where(small, series, (2 * first - torch.exp(-far)) / far)


@dataclass(frozen=True)
class BinResponse:
    """Response of a bin of constant rate to detectors that are rearmed in it, and to those armed at its start.

    Inflow (rearmed detectors) has four parts, dimension 1 of (P, 4, T): constant and slope of the line from `whole`
    bins ago, then of the line from one bin earlier.
    """

    kept: Tensor  # inflow still armed at the end of the bin
    waited: Tensor  # bins that the inflow waits, armed, in this bin
    hit: Tensor  # inflow detected in this bin
    hit_slope: Tensor  # slope coefficient of these detections
    fire: Tensor  # (P, T), of those armed at the start: detected,
    slope: Tensor  # slope coefficient of these detections,
    wait: Tensor  # bins waited,
    decay: Tensor  # still armed at the end


def bin_response(rate: Tensor, part: Tensor, largest: float | None = None) -> BinResponse:
    """Response of bins to their inflow, differentiable in both arguments.

    Args:
        rate: (P, T) per bin, float64.
        part: fraction of a bin in the dead time, scalar float64.
        largest: known bound of the rates.
    """
    first = 1 - part  # inflow of the younger line lasts from `part` to the end of the bin, `first` long

    def parts(near: tuple[Tensor, Tensor], whole: tuple[Tensor, Tensor]) -> Tensor:
        """Four parts from integrals of g(z), z g(z), z the time to the end of the bin, up to `first` and over all."""
        rest = whole[0] - near[0], whole[1] - near[1]
        young = (2 * first - 1) * near[0] - 2 * near[1]
        old = (2 * first + 1) * rest[0] - 2 * rest[1]
        return torch.stack([near[0], ROOT3 * young, rest[0], ROOT3 * old], 1)

    near, over = moments(rate * first, largest), moments(rate, largest)
    kept = parts((first * near.decay[0], first**2 * near.decay[1]), over.decay)
    waited = parts((first**2 * near.hit[0], first**3 * near.hit[1]), over.hit)
    one = torch.ones(1, 1, dtype=rate.dtype, device=rate.device)
    count = parts((first * one, first**2 * one / 2), (one, one / 2))
    place = parts((first**2 * one / 2, first**3 * one / 3), (one / 2, one / 3))
    wait, decay = over.decay[0], torch.exp(-rate)
    return BinResponse(
        kept=kept,
        waited=waited,
        hit=rate.unsqueeze(1) * waited,
        # 2 y - 1 of a detection: by parts, from where the inflow is, how long it waits and what is left
        hit_slope=ROOT3 * (count - 2 * place + 2 * waited - kept),
        fire=-torch.expm1(-rate),
        slope=ROOT3 * (2 * wait - 1 - decay),
        wait=wait,
        decay=decay,
    )


# ------------------------------------------------------------------------------------------------------------ the chain


class RenewalChain:
    """One step of the chain, from the lines of a detection to those of the next one.

    Args:
        rate: (P, T) per bin and period, float64.
        whole, part: dead time in bins, split.

    Lines are (P, 2 T) float64: counts of all bins, then slopes.
    """

    def __init__(self, rate: Tensor, whole: int, part: Tensor) -> None:
        self.bins = rate.shape[-1]
        self.response = bin_response(rate, part)
        total = rate.sum(-1, keepdim=True)
        # a detector that waits for a whole period without a detection: the sum over all periods is 1/(1 - exp(-total))
        self.rounds = 1 / -torch.expm1(-total)
        self.rate, self.whole, self.part = rate, whole, part
        before = rate.cumsum(-1) - rate
        self.reached = torch.exp(-before)
        self.blocks = self._blocks(before)

    def _blocks(self, before: Tensor) -> list[tuple[int, int, Tensor, Tensor]]:
        """(begin, end, exp(-flux since begin), exp(+flux since begin)) of stretches short enough for float64."""
        begin, blocks = 0, []
        while begin < self.bins:
            flux = before[:, begin:] - before[:, begin : begin + 1]
            inside = int((flux.amax(0) <= _SAFE_EXPONENT).sum())
            end = begin + max(1, inside)
            part = flux[:, : end - begin]
            blocks.append((begin, end, torch.exp(-part), torch.exp(part)))
            begin = end
        return blocks

    def armed(self, rearmed: Tensor) -> Tensor:
        """Armed at the start of bins, (P, T), from rearmed ones: A[k] = A[k-1] exp(-rate[k-1]) + rearmed[k]."""
        parts, carry = [], torch.zeros_like(rearmed[:, :1])
        for begin, end, falling, rising in self.blocks:
            piece = falling * (carry + (rearmed[:, begin:end] * rising).cumsum(-1))
            parts.append(piece)
            carry = piece[:, -1:] * self.response.decay[:, end - 1 : end]
        # what is left at the end of the period starts the next one, and the one after, ...
        return torch.cat(parts, -1) + carry * self.rounds * self.reached

    def armed_transposed(self, weights: Tensor) -> Tensor:
        """Transpose of `armed`."""
        carry = (weights * self.reached).sum(-1, keepdim=True) * self.rounds
        parts = []
        # the last bin hands `carry` on through its own decay
        carry = carry * self.response.decay[:, -1:]
        for begin, end, falling, rising in reversed(self.blocks):
            inner = (weights[:, begin:end] * falling).flip(-1).cumsum(-1).flip(-1)
            piece = rising * (inner + carry * falling[:, -1:])
            parts.append(piece)
            if begin > 0:
                carry = piece[:, :1] * self.response.decay[:, begin - 1 : begin]
        return torch.cat(parts[::-1], -1)

    def inflow(self, lines: Tensor) -> Tensor:
        """Four parts (P, 4, T) of the detectors that are rearmed in every bin."""
        pair = lines.view(-1, 2, self.bins)
        return torch.cat([pair.roll(self.whole, -1), pair.roll(self.whole + 1, -1)], 1)

    def at_start(self, inflow: Tensor) -> Tensor:
        """Armed at the start of every bin, (P, T), from the inflow."""
        return self.armed((self.response.kept * inflow).sum(1).roll(1, -1))

    def step(self, lines: Tensor) -> Tensor:
        """Lines of the next detection."""
        back, bins = self.inflow(lines), self.response
        armed = self.at_start(back)
        count = armed * bins.fire + (bins.hit * back).sum(1)
        slope = armed * bins.slope + (bins.hit_slope * back).sum(1)
        return torch.cat([count, slope], -1)

    def transposed(self, weights: Tensor) -> Tensor:
        """Transpose of `step`."""
        count, slope = weights.view(-1, 2, self.bins).unbind(1)
        bins = self.response
        kept = self.armed_transposed(bins.fire * count + bins.slope * slope).roll(-1, -1)
        back = bins.kept * kept.unsqueeze(1) + bins.hit * count.unsqueeze(1) + bins.hit_slope * slope.unsqueeze(1)
        pair = back[:, :2].roll(-self.whole, -1) + back[:, 2:].roll(-self.whole - 1, -1)
        return pair.reshape(-1, 2 * self.bins)

    def waiting(self, lines: Tensor) -> Tensor:
        """Time (P, 1) in bins that detectors are armed before the next detection, summed over the period."""
        back = self.inflow(lines)
        spent = self.at_start(back) * self.response.wait + (self.response.waited * back).sum(1)
        return spent.sum(-1, keepdim=True)


class ConstantLight:
    """Inverse of 1 - F + 1/T (sum of counts) for the step F in constant light, as a preconditioner for other light.

    In bright light phases turn almost rigidly with every detection, and 1 - F is nearly singular for patterns that the
    dead time maps on themselves. Their place and decay depend on dead time and mean wait alone.

    Args:
        mean_wait: mean wait in bins, (P, 1).
        bins: number of bins T.
        whole, part: dead time in bins, split.
        kept: (P, 1), share below 1 of detections that are followed: the inverse is then that of 1 - kept F.
    """

    def __init__(self, mean_wait: Tensor, bins: int, whole: int, part: Tensor, kept: Tensor | None = None) -> None:
        self.bins = bins
        bin_ = bin_response(1 / mean_wait, part)
        turn = -2j * math.pi / bins * torch.arange(bins // 2 + 1, device=mean_wait.device, dtype=torch.float64)
        shifts = torch.exp(turn * (whole % bins)), torch.exp(turn * ((whole + 1) % bins))

        def moved(inflow: Tensor) -> Tensor:
            """Response (P, 2, K) to constants and slopes."""
            return inflow[:, :2] * shifts[0] + inflow[:, 2:] * shifts[1]

        late = torch.exp(turn) / (1 - bin_.decay * torch.exp(turn))
        armed = late.unsqueeze(1) * moved(bin_.kept)
        count = -(moved(bin_.hit) + bin_.fire.unsqueeze(1) * armed)
        slope = -(moved(bin_.hit_slope) + bin_.slope.unsqueeze(1) * armed)
        if kept is not None:
            count, slope = count * kept.unsqueeze(-1), slope * kept.unsqueeze(-1)
        a, b, c, d = count[:, 0] + 1, count[:, 1], slope[:, 0], slope[:, 1] + 1
        if kept is None:
            # detections are conserved: the mean of the counts is left to the rank-one term
            a[:, 0], b[:, 0] = 1, 0
        determinant = a * d - b * c
        self.inverse = torch.stack([d, -b, -c, a], 1) / determinant.unsqueeze(1)

    def solve(self, lines: Tensor) -> Tensor:
        return self._apply(lines, self.inverse)

    def solve_transposed(self, lines: Tensor) -> Tensor:
        return self._apply(lines, self.inverse[:, [0, 2, 1, 3]].conj())

    def _apply(self, lines: Tensor, m: Tensor) -> Tensor:
        count, slope = torch.fft.rfft(lines.view(-1, 2, self.bins)).unbind(1)
        found = torch.stack([m[:, 0] * count + m[:, 1] * slope, m[:, 2] * count + m[:, 3] * slope], 1)
        solved: Tensor = torch.fft.irfft(found, n=self.bins).reshape(-1, 2 * self.bins)
        return solved


# ------------------------------------------------------------------------------------------------------- linear solvers

Operator = Callable[[Tensor], Tensor]


def gmres(
    operator: Operator, right: Tensor, start: Tensor, tolerance: float, precondition: Operator = lambda v: v
) -> tuple[Tensor, Tensor]:
    """Solve operator(x) = right by restarted GMRES, every row its own system.

    Args:
        operator: linear function of (P, T), acting on every row alone.
        right, start: (P, T) float64.
        tolerance: largest |residual| / |right| in every row.
        precondition: approximate inverse of `operator`, applied from the right, so that residuals are true ones.

    Returns:
        x (P, T), and |residual| / |right| (P,), to be checked by the caller: it stops after two restarts of 40 vectors.
    """
    x = start
    scale = right.norm(dim=-1).clamp_min(1e-300)
    residual = right - operator(x)
    length = residual.norm(dim=-1)
    for _ in range(_RESTARTS):
        if bool((length <= tolerance * scale).all()):
            break
        x = x + precondition(_krylov_correction(operator, precondition, residual, length, 0.1 * tolerance * scale))
        residual = right - operator(x)
        length = residual.norm(dim=-1)
    return x, length / scale


def _krylov_correction(
    operator: Operator, precondition: Operator, residual: Tensor, length: Tensor, goal: Tensor
) -> Tensor:
    """Correction, before `precondition`, in the Krylov space of one restart."""
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
        if used % 4 == 0 and bool((_least_squares(table, used, length)[1] <= goal).all()):
            break
    coefficients, _ = _least_squares(table, used, length)
    return torch.bmm(coefficients.unsqueeze(1), basis[:, :used]).squeeze(1)


def _least_squares(table: Tensor, used: int, length: Tensor) -> tuple[Tensor, Tensor]:
    """Least squares of every row in its Krylov space: coefficients (P, used), residual lengths (P,)."""
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


def solve_banded(chain: RenewalChain, right: Tensor, pinned: Tensor, *, transposed: bool) -> Tensor:
    """Solve (1 - F + e e^T) x = right directly, F the step of the chain or its transpose.

    A bin is linked to the one before, through detectors that stay armed, and to two others, through rearmed ones.
    Numbered by s k mod T, with s such that s dead times are nearly whole periods, all three are close by (about sqrt(T)
    at worst, a few bins where phases lock). Block elimination takes T/width steps on blocks of that width, O(T width)
    memory.

    Args:
        chain: the chain.
        right: lines (P, 2 T).
        pinned: (P,) bins whose count is e, where stationary counts are large; 1 - F alone is singular.
        transposed: solve with the transpose.

    Returns:
        Lines (P, 2 T). right = e gives the stationary lines up to a factor; with the transpose, a `right` orthogonal to
        these gives a solution without the pin.
    """
    found = []
    for rows in torch.split(torch.arange(right.shape[0], device=right.device), _ROWS_OF_BLOCKS):
        piece = RenewalChain(chain.rate[rows], chain.whole, chain.part)
        found.append(_solve_rows(piece, right[rows], pinned[rows], transposed))
    return torch.cat(found)


def _numbering(bins: int, whole: int) -> tuple[Tensor, int]:
    """Number of every bin that keeps linked bins close, and the widest link."""
    k = torch.arange(bins)
    best, width = k, bins
    for s in range(1, min(bins, int(2 * bins**0.5) + 2)):
        place = torch.argsort(torch.argsort(s * k % bins, stable=True))
        widest = 0
        for offset in (1, whole, whole + 1):
            apart = (place - place.roll(offset)).abs()
            widest = max(widest, int(torch.minimum(apart, bins - apart).max()))
        if widest < width:
            best, width = place, widest
    return best, width


def _entries(chain: RenewalChain) -> tuple[Tensor, Tensor, Tensor]:
    """Rows, columns (E,) and values (P, E) of the equations; unknown u of bin k has number 3 k + u."""
    bins, response = chain.bins, chain.response
    k = torch.arange(bins, device=chain.rate.device)
    earlier = [(k - chain.whole) % bins, (k - chain.whole - 1) % bins]
    rows, columns, values = [], [], []

    def add(unknown: int, row: Tensor, value: Tensor) -> None:
        rows.append(_UNKNOWNS * k + unknown)
        columns.append(row)
        values.append(value)

    for unknown, left, parts in (
        (0, response.decay, response.kept),
        (1, response.fire, response.hit),
        (2, response.slope, response.hit_slope),
    ):
        add(unknown, _UNKNOWNS * k + unknown, torch.ones_like(chain.rate))
        add(unknown, _UNKNOWNS * ((k - 1) % bins), -left)
        for part in range(4):
            add(unknown, _UNKNOWNS * earlier[part // 2] + 1 + part % 2, -parts[:, part])
    return torch.cat(rows), torch.cat(columns), torch.cat(values, -1)


def _solve_rows(chain: RenewalChain, right: Tensor, pinned: Tensor, transposed: bool) -> Tensor:
    pixels, bins = right.shape[0], chain.bins
    place, width = _numbering(bins, chain.whole % bins)
    blocks = bins // max(width, _BLOCK)
    blocks = blocks if blocks >= 3 else 1
    block = (place * blocks) // bins
    first = torch.searchsorted(torch.sort(block).values, torch.arange(blocks))
    size = _UNKNOWNS * -(-bins // blocks)
    unknown = torch.arange(_UNKNOWNS)
    inside = (_UNKNOWNS * (place - first[block]).unsqueeze(-1) + unknown).flatten().to(right.device)
    block = block.repeat_interleave(_UNKNOWNS).to(right.device)
    row, column, value = _entries(chain)
    if transposed:
        row, column = column, row
    matrix = right.new_zeros(pixels, blocks, min(blocks, 3), size, size)  # diagonal, next, previous block
    offset = (block[column] - block[row]) % blocks
    offset = torch.where(offset == blocks - 1, torch.full_like(offset, min(blocks, 3) - 1), offset)
    flat = (((block[row] * min(blocks, 3) + offset) * size) + inside[row]) * size + inside[column]
    matrix.view(pixels, -1).index_add_(1, flat, value.expand(pixels, -1).contiguous())
    # unknowns that only fill up a block are 0
    used = torch.zeros(blocks, size, dtype=torch.bool, device=right.device)
    used[block, inside] = True
    matrix[:, :, 0].diagonal(dim1=-2, dim2=-1).add_((~used).to(right.dtype))
    pin = _UNKNOWNS * pinned + 1
    matrix[torch.arange(pixels, device=right.device), block[pin], 0, inside[pin], inside[pin]] += 1
    vector = right.new_zeros(pixels, blocks, size, 1)
    number = _UNKNOWNS * torch.arange(bins, device=right.device)
    lines = torch.cat([number + 1, number + 2])
    vector[:, block[lines], inside[lines], 0] = right
    if blocks == 1:
        solved = torch.linalg.solve(matrix[:, 0, 0], vector[:, 0]).unsqueeze(1)
    else:
        solved = _cyclic_tridiagonal(matrix, vector)
    found: Tensor = solved[:, block[lines], inside[lines], 0]
    return found


def _cyclic_tridiagonal(matrix: Tensor, right: Tensor) -> Tensor:
    """Solve blocks (P, B, 3, b, b) (diagonal, next, previous; B >= 3) for right sides (P, B, b, 1)."""
    last = matrix.shape[1] - 1
    diagonal, after, before = matrix.unbind(2)
    by_next: list[Tensor] = []
    by_last: list[Tensor] = []  # what the right side gives, then minus what the last block gives
    for i in range(last):
        corner = before[:, 0] if i == 0 else (after[:, i] if i == last - 1 else torch.zeros_like(before[:, 0]))
        side = torch.cat([right[:, i], corner], -1)
        middle = diagonal[:, i]
        if i > 0:
            middle = middle - before[:, i] @ by_next[-1]
            side = side - before[:, i] @ by_last[-1]
        solved = torch.linalg.solve(middle, torch.cat([after[:, i], side], -1))
        by_next.append(solved[..., : middle.shape[-1]])
        by_last.append(solved[..., middle.shape[-1] :])
    for i in range(last - 2, -1, -1):
        by_last[i] = by_last[i] - by_next[i] @ by_last[i + 1]
    near = before[:, last] @ by_last[last - 1] + after[:, last] @ by_last[0]
    end = torch.linalg.solve(diagonal[:, last] - near[..., 1:], right[:, last] - near[..., :1])
    return torch.stack([piece[..., :1] - piece[..., 1:] @ end for piece in by_last] + [end], 1)


# ------------------------------------------------------------------------------------------ the stationary distribution


def _total(chain: RenewalChain, lines: Tensor) -> Tensor:
    return lines[:, : chain.bins].sum(-1, keepdim=True)


def _constant_light(chain: RenewalChain, pi: Tensor) -> ConstantLight:
    return ConstantLight(chain.waiting(pi) / _total(chain, pi), chain.bins, chain.whole, chain.part)


def _check_residual(residual: Tensor) -> None:
    worst = float(residual.max())
    if not worst <= _LARGEST_RESIDUAL:
        raise TorchTransientError(
            f"stationary_phases: expected a relative residual of {_LARGEST_RESIDUAL:g}, got {worst:g}, by iteration "
            "and directly. Lower the flux per period or use fewer, wider bins."
        )


def _solve_stationary(chain: RenewalChain) -> Tensor:
    """Fixed point (P, 2 T) of the chain with counts that sum to 1."""
    pi = torch.cat([chain.rate / chain.rate.sum(-1, keepdim=True), torch.zeros_like(chain.rate)], -1)
    for _ in range(_POWER_STEPS):
        pi = chain.step(pi)
        pi = pi / _total(chain, pi)
    # (1 - F + u 1^T) pi = u has the stationary pi as its only solution when sum u = 1; start from what we have
    u = pi

    def operator(v: Tensor) -> Tensor:
        return v - chain.step(v) + u * _total(chain, v)

    pi, residual = gmres(operator, u, pi, _TOLERANCE, _constant_light(chain, pi).solve)
    pi = pi / _total(chain, pi)
    rows = (~(residual <= _CONVERGED)).nonzero().flatten()
    if rows.numel():
        hard = RenewalChain(chain.rate[rows], chain.whole, chain.part)
        pinned = u[rows, : chain.bins].argmax(-1)
        right = torch.zeros_like(u[rows]).scatter_(1, pinned.unsqueeze(-1), 1.0)
        direct = solve_banded(hard, right, pinned, transposed=False)
        direct = direct / _total(hard, direct)
        _check_residual((hard.step(direct) - direct).norm(dim=-1) / direct.norm(dim=-1))
        pi = pi.index_copy(0, rows, direct)
    return pi


def _solve_singular(chain: RenewalChain, pi: Tensor, right: Tensor, *, transposed: bool) -> Tensor:
    """Solution of (1 - F) x = right with P x = 0, P = pi 1^T the projector on counts, or of the transposes.

    `right` has P right = 0: its part along the null space meets nothing.
    """
    step = chain.transposed if transposed else chain.step
    constant = _constant_light(chain, pi)
    inverse = constant.solve_transposed if transposed else constant.solve

    def projected(v: Tensor, p: Tensor) -> Tensor:
        if transposed:
            ones = torch.cat([torch.ones_like(v[:, : chain.bins]), torch.zeros_like(v[:, chain.bins :])], -1)
            return ones * (p * v).sum(-1, keepdim=True)
        return p * _total(chain, v)

    def operator(v: Tensor) -> Tensor:
        return v - step(v) + projected(v, pi)

    found, residual = gmres(operator, right, torch.zeros_like(right), _TOLERANCE, inverse)
    rows = (~(residual <= _CONVERGED)).nonzero().flatten()
    if rows.numel():
        hard, p, r = RenewalChain(chain.rate[rows], chain.whole, chain.part), pi[rows], right[rows]
        direct = solve_banded(hard, r, p[:, : chain.bins].argmax(-1), transposed=transposed)
        direct = direct - projected(direct, p)
        stepped = hard.transposed(direct) if transposed else hard.step(direct)
        _check_residual((direct - stepped - r).norm(dim=-1) / direct.norm(dim=-1))
        found = found.index_copy(0, rows, direct)
    return found


def sum_of_detections(chain: RenewalChain, pi: Tensor, right: Tensor) -> Tensor:
    """Sum over all later detections of the chain started from `right`: (1 - F)^-1 right, up to a multiple of `pi`.

    Args:
        chain: the chain.
        pi: stationary lines of the chain (P, 2 T).
        right: lines (P, 2 T) whose counts sum to 0.

    Returns:
        Lines (P, 2 T) whose counts sum to 0, without gradient.
    """
    found = []
    for r, p, d in zip(*(torch.split(rows, _ROWS_OF_GMRES) for rows in (chain.rate, pi, right)), strict=True):
        # rounding is no excess
        d = d - p * _total(chain, d)
        found.append(_solve_singular(RenewalChain(r, chain.whole, chain.part), p, d, transposed=False))
    return torch.cat(found)


def _step(whole: int, lines: Tensor, rate: Tensor, part: Tensor) -> Tensor:
    return RenewalChain(rate, whole, part).step(lines)


class _StationaryPhases(torch.autograd.Function):
    """Stationary lines of (rate, part), with both modes by the implicit function theorem."""

    @staticmethod
    def forward(ctx: Any, rate: Tensor, part: Tensor, whole: int) -> Tensor:
        ctx.whole = whole
        pi = torch.cat([_solve_stationary(RenewalChain(r, whole, part)) for r in torch.split(rate, _ROWS_OF_GMRES)])
        ctx.save_for_backward(rate, part, pi)
        ctx.save_for_forward(rate, part, pi)
        return pi

    @staticmethod
    def jvp(ctx: Any, by_rate: Tensor | None, by_part: Tensor | None, _: None) -> Tensor:
        rate, part, pi = ctx.saved_tensors
        by_rate = torch.zeros_like(rate) if by_rate is None else by_rate
        by_part = torch.zeros_like(part) if by_part is None else by_part
        found = []
        for r, p, d in zip(*(torch.split(rows, _ROWS_OF_GMRES) for rows in (rate, pi, by_rate)), strict=True):
            # by two backward passes, which are the derivative of the gradient in its weights
            right = jvp(partial(_step, ctx.whole, p), (r, part), (d, by_part))[1]  # type: ignore[no-untyped-call]
            found.append(_solve_singular(RenewalChain(r, ctx.whole, part), p, right, transposed=False))
        return torch.cat(found)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        rate, part, pi = ctx.saved_tensors
        by_rate, by_part = [], torch.zeros_like(part)
        for r, p, g in zip(*(torch.split(rows, _ROWS_OF_GMRES) for rows in (rate, pi, gradient)), strict=True):
            # the constant part of the gradient meets sum d pi = 0 and drops out
            ones = torch.cat([torch.ones_like(r), torch.zeros_like(r)], -1)
            right = g - ones * (p * g).sum(-1, keepdim=True)
            adjoint = _solve_singular(RenewalChain(r, ctx.whole, part), p, right, transposed=True)
            with torch.enable_grad():
                leaves = r.detach().requires_grad_(), part.detach().requires_grad_()
                found = torch.autograd.grad(_step(ctx.whole, p, *leaves), leaves, adjoint)
            by_rate.append(found[0])
            by_part = by_part + found[1]
        return torch.cat(by_rate), by_part, None


def stationary_phases(rate: Tensor, part: Tensor, whole: int) -> Tensor:
    """Stationary distribution of detection phases, differentiable once in `rate` and `part`.

    Args:
        rate: (P, T) per bin and period, float64, with light in every row.
        part, whole: dead time in bins, split.

    Returns:
        Lines (P, 2 T) whose counts sum to 1.

    Raises:
        TorchTransientError: if neither the iteration nor the direct solution reaches its residual.
    """
    pi: Tensor = _StationaryPhases.apply(rate, part, whole)  # type: ignore[no-untyped-call]
    return pi
