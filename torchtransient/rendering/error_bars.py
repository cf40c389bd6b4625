"""Error bars of renders: the samples of a call in batches with seeds of their own, and what the batches differ by.

With means ``m_b`` of ``n_b`` of ``N`` samples in ``K`` batches, the render is ``x = sum_b n_b m_b / N``, and

    d_b = sqrt(n_b / ((K - 1) N)) (m_b - x),    E sum_b <A, d_b>^2 = Var <A, x>

for every linear functional ``A``, whatever sampler each batch has, since the batches are independent. Two batches
differ by one number, ``sqrt(n_1 n_2) / N (m_1 - m_2)``. Pixels are independent of each other, so that their squares are
added up, one degree of freedom each; where pixels share light, the functional as a whole is squared.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch

from torchtransient.errors import ArgumentError, ShapeError
from torchtransient.rendering.films import layout_of_output

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
    """Request for the error bars of a call, and the differences between its batches.

    Args:
        cells: layout of the differences.
        components: Stokes components of the film's channels.
        is_complex: the film's array has real and imaginary parts in turn.
        rows: the film has several histograms a pixel, which come before H.

    Attributes:
        differences: differences of the batches for each run of the job (R, items, [4,] [rows,] H, W, T), summed over
            cells; R is 1 for two batches.
        squares: squares of the differences (items, [4,] [rows,] H, W, T), summed over R and cells.
        steady: differences of the steady images (R, items, [4,] H, W), pixel by pixel.
    """

    cells: ErrorCells
    components: int
    is_complex: bool
    rows: bool = False
    differences: list[torch.Tensor] = field(default_factory=list)
    squares: list[torch.Tensor] = field(default_factory=list)
    steady: list[torch.Tensor] = field(default_factory=list)

    @property
    def batches(self) -> int:
        """Number of batches."""
        return BATCHES_OF_SHARED_LIGHT if self.cells.shared else BATCHES

    def mean_of(self, array: torch.Tensor, dims: int, is_complex: bool = False) -> torch.Tensor:
        """Return the mean over channels.

        Args:
            array: array (H, W, ..., channels) of ``dims + 1`` dimensions, with or without one of items.
            dims: number of dimensions of a film without channels.
            is_complex: channels have real and imaginary parts in turn, and the mean is complex.

        Returns:
            (items, [4,] H, W, ...), of several histograms a pixel (items, [4,] rows, H, W, T).
        """
        mean = channel_mean(array.reshape(-1, *array.shape[-dims - 1 :]), self.components, is_complex)
        mean = mean if self.components == 1 else mean.movedim(-1, 1)
        return mean.movedim(-2, -4) if dims > 3 else mean


def channel_mean(array: torch.Tensor, components: int, is_complex: bool = False) -> torch.Tensor:
    """Return the mean over the channels of a film's array, in its own order of dimensions.

    Args:
        array: array (..., channels), of Stokes components one after the other; real and imaginary parts in turn if
            ``is_complex``.
        components: number of Stokes components.
        is_complex: return complex numbers.

    Returns:
        (..., [4]).
    """
    parts = 2 if is_complex else 1
    channels = array.shape[-1] // (components * parts)
    # A product is several times faster than `mean` over a dimension of three entries.
    matrix = torch.eye(components * parts).reshape(components, 1, parts, -1).expand(-1, channels, -1, -1) / channels
    mean = array.detach() @ matrix.reshape(array.shape[-1], -1).to(array)
    if is_complex:
        mean = torch.view_as_complex(mean.reshape(*mean.shape[:-1], components, 2))
    return mean.squeeze(-1) if components == 1 else mean


def in_cells(values: torch.Tensor, cells: ErrorCells) -> torch.Tensor:
    """Sum over cells.

    Args:
        values: array (..., H, W, T).
        cells: layout; those at the ends of a dimension may hold fewer entries.

    Returns:
        (..., ceil(H / rows), ceil(W / columns), ceil(T / bins)), memory of its own.
    """
    size = (cells.rows, cells.columns, cells.bins)
    if size == (1, 1, 1):
        return values.clone()
    if values.is_complex():
        return torch.complex(in_cells(values.real, cells), in_cells(values.imag, cells))
    flat = values.reshape(-1, *values.shape[-3:])
    kernel = [min(pair) for pair in zip(size, flat.shape[-3:], strict=True)]
    found = torch.nn.functional.avg_pool3d(flat, kernel, ceil_mode=True, divisor_override=1)
    return found.reshape(*values.shape[:-3], *found.shape[-3:])


class RunningMean:
    """Mean of batches that come one after the other, and the square of its error (Welford)."""

    def __init__(self) -> None:
        self.number, self.batches = 0, 0
        self.mean = self._squares = torch.zeros(())

    def add(self, mean: torch.Tensor, number: int, *, last: bool) -> None:
        """Add the mean of a batch of ``number`` samples, which may be changed; ``last``: none follows."""
        self.number, self.batches = self.number + number, self.batches + 1
        if self.batches == 1:
            self.mean = mean
            return
        off = mean.sub_(self.mean)
        if not last:
            self.mean.add_(off, alpha=number / self.number)
        square = (off.abs() if off.is_complex() else off).square_().mul_(number * (1 - number / self.number))
        self._squares = square if self.batches == 2 else self._squares.add_(square)

    def squared_error(self) -> torch.Tensor:
        """Return the estimate of the variance of the mean, of two batches and more."""
        return self._squares.div_((self.batches - 1) * self.number)


def differences_of(sums: Sequence[torch.Tensor], numbers: Sequence[int]) -> torch.Tensor:
    """Return the differences ``d_b`` between means of batches, (R, ...).

    Args:
        sums: mean of each batch.
        numbers: number of samples of each batch.
    """
    total = sum(numbers)
    if len(sums) == 2:
        return (math.sqrt(numbers[0] * numbers[1]) / total * (sums[0] - sums[1]))[None]
    mean = sum(n / total * part for n, part in zip(numbers, sums, strict=True))
    scale = 1 / ((len(sums) - 1) * total)
    return torch.stack([(part - mean) * math.sqrt(n * scale) for n, part in zip(numbers, sums, strict=True)])


def cell_weights(weights: torch.Tensor, cells: ErrorCells) -> torch.Tensor:
    """Return the weights of cells along time, pixel by pixel.

    Within a cell, bins are taken as independent: one that is covered in part counts with the root of its mean square.

    Args:
        weights: weights of bins, (..., H, W, T).

    Returns:
        (..., H, W, ceil(T / bins)).
    """
    along = ErrorCells(cells.bins, 1, 1, cells.shared)
    sizes = _sizes(weights.shape[-1], cells.bins, weights)
    mean, square = in_cells(weights, along) / sizes, in_cells(weights.square(), along) / sizes
    return torch.where(mean < 0, -square.sqrt(), square.sqrt())


def variance(
    differences: torch.Tensor, weights: torch.Tensor, cells: ErrorCells, rows: bool = False
) -> torch.Tensor:
    """Return the variance of a weighted sum.

    Args:
        differences: differences in cells, (..., T', H', W', R).
        weights: real weights of bins, (..., T, H, W).
        cells: layout of the differences.
        rows: the last of the leading dimensions has the histograms of a pixel, which the sum is over, too.

    Returns:
        (...).
    """
    along = cell_weights(weights.movedim(-3, -1), cells)
    height, width = along.shape[-3:-1]
    spread = differences.movedim(-4, -1)  # (..., H', W', R, T')
    spread = spread.repeat_interleave(cells.rows, -4)[..., :height, :, :, :]
    spread = spread.repeat_interleave(cells.columns, -3)[..., :width, :, :]
    # Of each pixel the sum over time, as if all pixels of its cell had the weights of this one.
    sums = (spread * along[..., None, :]).sum(-1)
    sums = sums.sum(-4) if rows else sums
    number = _sizes(height, cells.rows, along).repeat_interleave(cells.rows)[:height, None]
    number = number * _sizes(width, cells.columns, along).repeat_interleave(cells.columns)[:width]
    if cells.shared:
        return (sums / number[..., None]).sum((-3, -2)).abs().square().sum(-1)
    return (sums.abs().square().sum(-1) / number).sum((-2, -1))


def local_mean(values: torch.Tensor, dims: tuple[int, ...]) -> torch.Tensor:
    """Return the mean over each entry and its neighbours along ``dims``; at rims over those that exist.

    Args:
        values: tensor of any shape.
        dims: dimensions, each with its neighbours on both sides.

    Returns:
        The shape of ``values``.
    """
    for dim in dims:
        size = values.shape[dim]
        if size == 1:
            continue
        total, number = values.clone(), torch.full((size,), 3.0, dtype=values.dtype, device=values.device)
        total.narrow(dim, 1, size - 1).add_(values.narrow(dim, 0, size - 1))
        total.narrow(dim, 0, size - 1).add_(values.narrow(dim, 1, size - 1))
        number[0] -= 1
        number[-1] -= 1
        shape = [1] * values.ndim
        shape[dim] = size
        values = total.div_(number.reshape(shape))
    return values


def local_errors(
    squares: torch.Tensor, cells: ErrorCells, shape: Sequence[int], near: tuple[int, ...]
) -> torch.Tensor:
    """Return the standard error of every bin: of its cell, or where cells hold one pixel of those around it, too.

    Args:
        squares: squared differences in cells, (..., T', H', W').
        cells: layout of the cells.
        shape: sizes (T, H, W) of the film.
        near: dimensions along which neighbours are alike.

    Returns:
        (..., T, H, W).
    """
    sides = list(zip((-3, -2, -1), shape, (cells.bins, cells.rows, cells.columns), strict=True))
    t, h, w = (_sizes(length, size, squares) for _, length, size in sides)
    mean = squares / (t[:, None, None] * h[:, None] * w)
    if cells.rows == 1:
        mean = local_mean(mean, near)
    for dim, length, size in sides:
        mean = mean.repeat_interleave(size, dim).narrow(dim, 0, length)
    return mean.sqrt()


def _sizes(length: int, size: int, like: torch.Tensor) -> torch.Tensor:
    """Return the number of entries of each cell along a dimension."""
    real = like.real if like.is_complex() else like
    sizes = torch.full((-(-length // size),), float(size), dtype=real.dtype, device=real.device)
    sizes[-1] = length - size * (len(sizes) - 1)
    return sizes


class ErrorBars:
    """Error bars of a result with ``differences``, ``squares``, ``steady_differences`` and ``cells``."""

    steady: torch.Tensor
    differences: torch.Tensor | None
    squares: torch.Tensor | None
    steady_differences: torch.Tensor | None
    cells: ErrorCells | None

    def standard_error(self, weights: Any = None, *, steady: bool = False) -> torch.Tensor:
        """Return the standard error of a weighted sum of the measurement, mean over channels.

        It is right on average, and known as well as many cells of light were added up: that of one cell of 4 x 4 pixels
        and 8 bins rests on one number (of one pixel with ``errors="bins"``). See ``docs/accuracy.md``.

        Args:
            weights: real numbers or truth values that broadcast to (T, H, W) ((F, H, W) of phasors, (G, H, W) of
                gates, (R, T, H, W) of rates, (2, T, H, W) of beats), behind dimensions of Stokes components and items;
                None for ones. (H, W) with ``steady``.
            steady: return that of the steady image.

        Returns:
            (...), without the dimensions of one film, or of its steady image.

        Raises:
            ArgumentError: for a render without ``errors=``.
            ShapeError: for weights of another shape.
        """
        differences, shape, cells = self._error_layout(steady)
        given = torch.ones((), device=differences.device) if weights is None else torch.as_tensor(weights).detach()
        if given.is_complex():
            raise ArgumentError("standard_error: expected real weights, got complex ones.")
        real = differences.real if differences.is_complex() else differences
        # Squares of bright light have no room in single precision.
        differences = differences.to(torch.complex128 if differences.is_complex() else torch.float64)
        try:
            given = given.to(differences.device, torch.float64).broadcast_to(*differences.shape[:-4], *shape)
        except RuntimeError as error:
            raise ShapeError(
                f"standard_error: expected weights that broadcast to {(*differences.shape[:-4], *shape)}, got "
                f"{tuple(given.shape)}. Weights of times are weights[:, None, None]."
            ) from error
        return variance(differences, given, cells, not steady and self._film_dims() > 3).sqrt().to(real.dtype)

    def error_map(self, *, steady: bool = False) -> torch.Tensor:
        """Return the standard error of every bin, (..., T, H, W) as the film has it, (..., H, W) with ``steady``.

        It is that of its neighbourhood, the cell of 4 x 4 pixels x 8 bins, or 3 x 3 x 3 bins with ``errors="bins"``
        (3 x 3 pixels of gates and frequencies): single dark bins have seen too few events to know their own.

        Args:
            steady: return that of the steady image.

        Raises:
            ArgumentError: for a render without ``errors=``.
        """
        differences, shape, cells = self._error_layout(steady)
        squares = differences.abs().square().sum(-1) if steady or self.squares is None else self.squares
        layout = layout_of_output(self)
        in_order = not steady and layout is not None and layout.has_bins
        found = local_errors(squares, cells, shape, (-3, -2, -1) if in_order else (-2, -1))
        return found.squeeze(-3) if steady else found

    def relative_error(self) -> float | None:
        """Return the largest relative standard error of the sum over the whole measurement; None without light.

        Raises:
            ArgumentError: for a render without ``errors=``.
        """
        error = self.standard_error()
        tensor = self._measured()
        assert tensor is not None
        dims = self._film_dims()
        total = tensor.detach().mean(-1 - dims).sum(tuple(range(-dims, 0))).abs()
        if getattr(self, "polarized", False):  # the others may sum to nothing
            error, total = error[..., 0], total[..., 0]
        found = (error / total)[total > 0]
        return float(found.max()) if found.numel() else None

    def _measured(self) -> torch.Tensor | None:
        layout = layout_of_output(self)
        return None if layout is None else layout.tensor(self)

    def _film_dims(self) -> int:
        """Return the number of dimensions of one channel."""
        layout = layout_of_output(self)
        return 2 + len(() if layout is None else layout.shape)

    def _error_layout(self, steady: bool) -> tuple[torch.Tensor, tuple[int, ...], ErrorCells]:
        """Return (differences (..., T', H', W', R), (T, H, W), cells); one bin of time with ``steady``."""
        if self.differences is None or self.steady_differences is None or self.cells is None:
            raise ArgumentError("standard_error: expected a render with errors=True or errors='bins', got one without.")
        if steady:
            image = self.steady_differences
            return image.unsqueeze(-4), (1, *image.shape[-3:-1]), ErrorCells(1, 1, 1, self.cells.shared)
        tensor = self._measured()
        if tensor is None:
            raise ArgumentError("standard_error: expected what the film measured, got a steady image alone.")
        return self.differences, tuple(tensor.shape[-3:]), self.cells
