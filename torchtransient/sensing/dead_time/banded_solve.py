"""Direct solution of the renewal chain, for light that locks the phase: a few diagonals round a ring of bins.

A bin is linked to the one before, through detectors that stay armed, and to two others, through those that come back.
Numbered by s k mod T, with s such that s times the dead time is nearly whole periods, all three are close by (about
sqrt(T) at worst, a few bins where phases lock). Block elimination takes T/width steps on blocks of that width: memory
O(T width), and no iterations.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchtransient.sensing.dead_time.renewal_chain import RenewalChain

_UNKNOWNS = 3  # of a bin: armed at its end, count and slope of its detections
_BLOCK = 6  # bins of a block at least: smaller ones cost more calls than they save
_ROWS_AT_ONCE = 32


def _numbering(bins: int, whole: int) -> tuple[Tensor, int]:
    """Place of every bin in the new numbering, and the widest link in it."""
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


def solve_banded(chain: RenewalChain, right: Tensor, pinned: Tensor, *, transposed: bool) -> Tensor:
    """x of (1 - F + e e^T) x = right, F the step of the chain or its transpose; lines (P, 2 T).

    e is the count of the bin `pinned` (P,), different in every row if need be, one where the stationary counts are
    large. 1 - F alone is singular. right = e gives the stationary lines up to a factor, and with the transpose any
    `right` whose product with these is 0 gives a solution without the pin.
    """
    found = []
    for rows in torch.split(torch.arange(right.shape[0], device=right.device), _ROWS_AT_ONCE):
        piece = RenewalChain(chain.rate[rows], chain.whole, chain.part)
        found.append(_solve_rows(piece, right[rows], pinned[rows], transposed))
    return torch.cat(found)


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
    """Blocks (P, B, 3, b, b): diagonal, next, previous, B >= 3; right (P, B, b, 1)."""
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
