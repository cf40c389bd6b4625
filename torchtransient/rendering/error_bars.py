"""Error bars of renders: the samples of a call in batches with seeds of their own, and what the batches differ by.

With means ``m_b`` of ``n_b`` samples and weights ``w_b = n_b / N`` the render is ``x = sum_b w_b m_b``, and

    d_b = w_b (m_b - x) / sqrt(1 - sum_b w_b^2),    E sum_b <A, d_b>^2 = Var <A, x>

for every linear functional ``A``, whatever sampler each batch has, since the batches are independent. Two batches
differ by one number, ``sqrt(w_1 w_2) (m_1 - m_2)``. Pixels are independent of each other, so that their squares are
added up, one degree of freedom each; where pixels share light, the functional as a whole is squared.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import torch

# Independent batches of a call: two keep most of the stratification of samplers such as `owen`, and pixels add up to
# many degrees of freedom. Where pixels share light there are none but those of the batches.
BATCHES, BATCHES_OF_SHARED_LIGHT = 2, 8
# Cells that differences are summed over, in bins, rows and columns.
CELL_BINS, CELL_PIXELS = 8, 4


class ErrorCells(NamedTuple):
    """Layout of the differences between batches.

    Attributes:
        bins, rows, columns: entries that each difference sums up.
        shared: pixels share light and are not independent of each other.
    """

    bins: int
    rows: int
    columns: int
    shared: bool


@dataclass
class BatchErrors:
    """Request for the error bars of a call, and what its batches differ by.

    Args:
        cells: layout of the differences.
        response_first, steady_first: put the film's arrays (items, ...) in the order of torch.

    Attributes:
        differences: for each run of the job (R, items, [4,] T, H, W), summed over cells; R is 1 for two batches.
        squares: likewise (items, [4,] T, H, W), their squares, summed over R and cells.
        steady: likewise (R, items, [4,] H, W), pixel by pixel.
    """

    cells: ErrorCells
    response_first: Callable[[torch.Tensor], torch.Tensor]
    steady_first: Callable[[torch.Tensor], torch.Tensor]
    differences: list[torch.Tensor] = field(default_factory=list)
    squares: list[torch.Tensor] = field(default_factory=list)
    steady: list[torch.Tensor] = field(default_factory=list)

    @property
    def batches(self) -> int:
        """Number of batches."""
        return BATCHES_OF_SHARED_LIGHT if self.cells.shared else BATCHES


def in_cells(values: torch.Tensor, cells: ErrorCells) -> torch.Tensor:
    """Sum over cells.

    Args:
        values: (..., T, H, W).
        cells: layout; those at the ends of a dimension may hold fewer entries.

    Returns:
        (..., ceil(T / bins), ceil(H / rows), ceil(W / columns)).
    """
    for dim, size in ((-3, cells.bins), (-2, cells.rows), (-1, cells.columns)):
        values = _sum_of_runs(values, dim, size)
    return values.contiguous()


class SquaresOfBatches:
    """Sum over batches of the squared differences, bin by bin, of batches that come one after the other."""

    def __init__(self) -> None:
        self._first: torch.Tensor | None = None
        self._sums: list[torch.Tensor] = []

    def add(self, mean: torch.Tensor, weight: float) -> None:
        """Add the mean of a batch, which counts with ``weight``. Deviations from the first one keep their digits."""
        if self._first is None:
            self._first, self._sums = mean, [torch.zeros_like(mean) for _ in range(3)]
            self._sums[2] = self._sums[2].real.clone() if mean.is_complex() else self._sums[2]
            self._weights = [weight]
            return
        off = mean - self._first
        for total, term in zip(self._sums, (off * weight, off * weight**2, (off.abs() * weight).square()), strict=True):
            total += term
        self._weights.append(weight)

    def result(self) -> torch.Tensor:
        """Return ``sum_b |d_b|^2``."""
        whole = sum(self._weights)
        squares = sum(w * w for w in self._weights)
        linear, by_square, square = self._sums
        mean = linear / whole
        cross = (mean.conj() * by_square).real if mean.is_complex() else mean * by_square
        total = square - 2 * cross + mean.abs().square() * squares
        return (total / (whole**2 - squares)).clamp(min=0)


def cell_weights(weights: torch.Tensor, cells: ErrorCells) -> torch.Tensor:
    """Return the weights of cells along time, pixel by pixel.

    Within a cell, bins are taken as independent: one that is covered in part counts with the root of its mean square.

    Args:
        weights: (..., T, H, W).

    Returns:
        (..., ceil(T / bins), H, W).
    """
    length = weights.shape[-3]
    sizes = _sizes(length, cells.bins, weights)[:, None, None]
    mean = _sum_of_runs(weights, -3, cells.bins) / sizes
    square = _sum_of_runs(weights.square(), -3, cells.bins) / sizes
    return torch.where(mean < 0, -square.sqrt(), square.sqrt())


def variance(differences: torch.Tensor, weights: torch.Tensor, cells: ErrorCells) -> torch.Tensor:
    """Return the variance of a weighted sum.

    Args:
        differences: (..., T', H', W', R) in cells.
        weights: (..., T, H, W), real.
        cells: layout of the differences.

    Returns:
        (...).
    """
    along = cell_weights(weights, cells)
    height, width = along.shape[-2:]
    spread = differences.repeat_interleave(cells.rows, -3)[..., :height, :, :]
    spread = spread.repeat_interleave(cells.columns, -2)[..., :width, :]
    # Of each pixel the sum over time, as if all pixels of its cell had the weights of this one.
    sums = (spread * along[..., None]).sum(-4)
    number = _sizes(height, cells.rows, along).repeat_interleave(cells.rows)[:height, None]
    number = number * _sizes(width, cells.columns, along).repeat_interleave(cells.columns)[:width]
    if cells.shared:
        return (sums / number[..., None]).sum((-3, -2)).abs().square().sum(-1)
    return (sums.abs().square().sum(-1) / number).sum((-2, -1))


def local_errors(squares: torch.Tensor, cells: ErrorCells, shape: Sequence[int]) -> torch.Tensor:
    """Return the standard error of every bin: of its cell, or of the 3 x 3 x 3 bins around it.

    Args:
        squares: (..., T', H', W') in cells.
        cells: layout.
        shape: (T, H, W).

    Returns:
        (..., T, H, W).
    """
    lengths = zip(shape, (cells.bins, cells.rows, cells.columns), strict=True)
    t, h, w = (_sizes(length, size, squares) for length, size in lengths)
    mean = squares / (t[:, None, None] * h[:, None] * w)
    if cells.rows == 1:
        flat = mean.reshape(-1, 1, *mean.shape[-3:])
        mean = torch.nn.functional.avg_pool3d(flat, 3, stride=1, padding=1, count_include_pad=False).reshape(mean.shape)
    for dim, length, size in zip((-3, -2, -1), shape, (cells.bins, cells.rows, cells.columns), strict=True):
        mean = mean.repeat_interleave(size, dim).narrow(dim, 0, length)
    return mean.sqrt()


def differences_of(parts: Sequence[torch.Tensor], weights: Sequence[float]) -> torch.Tensor:
    """Return the differences ``d_b`` between the means of batches, (R, ...)."""
    if len(parts) == 2:
        return (math.sqrt(weights[0] * weights[1]) * (parts[0] - parts[1]))[None]
    mean = sum(w * part for w, part in zip(weights, parts, strict=True))
    scale = math.sqrt(1 - sum(w * w for w in weights))
    return torch.stack([(part - mean) * (w / scale) for w, part in zip(weights, parts, strict=True)])


def _sizes(length: int, size: int, like: torch.Tensor) -> torch.Tensor:
    """Return the number of entries of each cell along a dimension."""
    real = like.real if like.is_complex() else like
    sizes = torch.full((-(-length // size),), float(size), dtype=real.dtype, device=real.device)
    sizes[-1] = length - size * (len(sizes) - 1)
    return sizes


def _sum_of_runs(tensor: torch.Tensor, dim: int, size: int) -> torch.Tensor:
    """Sum ``size`` entries in a row along a dimension; the last run may be shorter."""
    if size == 1:
        return tensor
    length = tensor.shape[dim]
    missing = -length % size
    if missing:
        padding = [0] * (2 * -dim)
        padding[-1] = missing
        tensor = torch.nn.functional.pad(tensor, padding)
    where = tensor.ndim + dim
    return tensor.reshape(*tensor.shape[:where], -1, size, *tensor.shape[where + 1 :]).sum(dim)
