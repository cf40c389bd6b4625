"""Convolutions and running sums along the time axis of (..., C, T, H, W)."""

from __future__ import annotations

import math
from typing import Any, Literal

import torch
from torch import Tensor
from torch.nn import functional

from torchtransient.axes import fast_length
from torchtransient.errors import ShapeError
from torchtransient.floating import single, without_autocast
from torchtransient.sensing.checks import TIME, check_choice, check_transient, reals

Boundary = Literal["zero", "periodic"]
# Up to here a direct convolution is as fast as the transform, and it keeps the relative precision of faint late bins.
_DIRECT_TAPS = 192
# Short kernels over images: whole images are added, shifted in time, which leaves the layout as it is.
# A backward pass writes an image of zeros for every shift.
_SHIFTED_TAPS = 96
_SHIFTED_TAPS_BACKWARD = 24
_SHIFTED_PIXELS = 64
_WIDE = 64  # images at least this large are summed row by row: torch.cumsum strides through memory along time


@without_autocast
def convolve_time(x: Tensor, kernel: Tensor, first: int = 0, *, boundary: Boundary = "zero") -> Tensor:
    """Convolve along time: y[t] = sum over j of kernel[j] x[t - first - j].

    Kernels of up to 192 bins are summed in the dtype of `x`. Longer ones are applied by a transform in float64, since
    the rounding of one in float32 (1e-7 of the largest bin) would drown late bins, padded to T + K - 1 and more for
    "zero". Half precision is computed in float32. Differentiable in `x` and `kernel`.

    Args:
        x: (..., C, T, H, W).
        kernel: (K,), share of a bin's light that arrives `first + j` bins later.
        first: lag of kernel[0] in bins, of either sign.
        boundary: "zero": light that leaves the window is lost, none enters; "periodic": the window is one period, sums
            are conserved.

    Returns:
        Shape, dtype and device of `x`.

    Raises:
        ShapeError: for wrong layouts or an empty kernel.
        ArgumentError: for an unknown boundary.
    """
    check_transient(x, "convolve_time")
    check_choice(boundary, Boundary, "boundary", "convolve_time")
    (kernel,) = reals("convolve_time", kernel=kernel)
    if kernel.ndim != 1 or kernel.numel() == 0:
        raise ShapeError(f"convolve_time: expected a kernel (K,) with K >= 1, got {tuple(kernel.shape)}.")
    bins, kernel = x.shape[TIME], kernel.to(x.device)
    kernel, first = window_lags(kernel, first, bins, boundary)
    if kernel.numel() == 0:
        return x * 0
    backward = torch.is_grad_enabled() and (x.requires_grad or kernel.requires_grad)
    shifts = _SHIFTED_TAPS_BACKWARD if backward else _SHIFTED_TAPS
    if kernel.numel() <= shifts and x.shape[-1] * x.shape[-2] >= _SHIFTED_PIXELS:
        return _by_shifts(x, kernel, first, boundary)
    rows = x.movedim(TIME, -1)
    convolve = _direct if kernel.numel() <= _DIRECT_TAPS else _by_fft
    return convolve(rows, kernel, first, boundary).movedim(-1, TIME)


def window_lags(kernel: Tensor, first: int, bins: int, boundary: Boundary) -> tuple[Tensor, int]:
    """Fold a kernel into one period, or crop it to lags inside a window.

    Args:
        kernel: (K,).
        first: lag of kernel[0] in bins.
        bins: length of the window.
        boundary: "periodic" folds, "zero" crops.

    Returns:
        Kernel and its first lag; an empty kernel if it misses the window.
    """
    if boundary == "periodic":
        if kernel.numel() <= bins:
            return kernel, first % bins
        lags = (torch.arange(kernel.numel(), device=kernel.device) + first) % bins
        return kernel.new_zeros(bins).index_add(0, lags, kernel), 0
    begin = min(max(0, 1 - bins - first), kernel.numel())
    end = max(min(kernel.numel(), bins - first), begin)
    return kernel[begin:end], first + begin


def _by_shifts(x: Tensor, kernel: Tensor, first: int, boundary: Boundary) -> Tensor:
    """Sum of shifted images, which keeps the layout."""
    bins, taps = x.shape[TIME], kernel.numel()
    work = single(x)
    if boundary == "periodic":
        work, first, left = work.roll(first, TIME), 0, taps - 1
        padded = torch.cat([work.narrow(TIME, bins - left, left), work], TIME)
    else:
        left = max(first + taps - 1, 0)
        padded = functional.pad(work, (0, 0, 0, 0, left, max(-first, 0)))
    weights = kernel.to(work.dtype)
    total = padded.narrow(TIME, left - first, bins) * weights[0]
    for j in range(1, taps):
        total.addcmul_(padded.narrow(TIME, left - first - j, bins), weights[j])
    return total.to(x.dtype)


def _direct(rows: Tensor, kernel: Tensor, first: int, boundary: Boundary) -> Tensor:
    bins, taps = rows.shape[-1], kernel.numel()
    flat = single(rows.reshape(-1, 1, bins))
    weights = kernel.flip(0).to(flat.dtype).view(1, 1, -1)
    if boundary == "periodic":
        # bins `first + taps - 1` before the start, taken from the end of the period
        flat = torch.cat([flat.roll(first, -1)[..., bins - taps + 1 :], flat.roll(first, -1)], -1)
        return functional.conv1d(flat, weights).to(rows.dtype).view(rows.shape)
    left, right = first + taps - 1, -first
    padded = functional.pad(flat, (max(left, 0), max(right, 0)))
    y = functional.conv1d(padded, weights)
    y = y[..., max(-left, 0) :][..., :bins]
    return functional.pad(y, (0, bins - y.shape[-1])).to(rows.dtype).view(rows.shape)


def _by_fft(rows: Tensor, kernel: Tensor, first: int, boundary: Boundary) -> Tensor:
    bins, taps = rows.shape[-1], kernel.numel()
    # Twice the bins hold every lag in (-bins, bins) without wrapping into the window: at least bins + taps - 1 if the
    # lags lie on one side, and one side does not reach the other.
    length = bins if boundary == "periodic" else fast_length(2 * bins + taps)
    transfer = torch.fft.rfft(kernel.to(torch.float64), n=length)
    return filter_rows(rows.to(torch.float64), transfer, length, first, bins).to(rows.dtype)


def filter_rows(rows: Tensor, transfer: Tensor, length: int, first: int, keep: int) -> Tensor:
    """Multiply rows by a transfer function.

    Results that rounding puts below zero are set to 0 (a transform leaves 1e-17 of either sign in the dark, and no
    detector draws from a negative rate); the gradient is that of the transform alone.

    Args:
        rows: (..., T) float64.
        transfer: (length // 2 + 1,) complex128.
        length: period of the transform, in bins.
        first: shift to later bins.
        keep: bins of the result.

    Returns:
        (..., keep) float64.
    """
    if rows.numel() == 0:
        return rows.new_zeros(*rows.shape[:-1], keep)
    y: Tensor = torch.fft.irfft(torch.fft.rfft(rows, n=length) * transfer, n=length).roll(first, -1)[..., :keep]
    # the rounding of a transform is about eps log2(length) of the length of the row (Higham, chapter 24)
    scale = torch.linalg.vector_norm(rows, dim=-1, keepdim=True) * transfer.abs().amax()
    slack = 4 * torch.finfo(torch.float64).eps * math.log2(2 * length) * scale
    value = y.detach()
    return y - torch.where((value < 0) & (value >= -slack), value, 0.0)


# --------------------------------------------------------------------------------------------------------- running sums


def _sum_before(x: Tensor, reverse: bool) -> Tensor:
    """Sum of the earlier bins (of the later ones with `reverse`), without gradient."""
    if x.device.type != "cpu" or x.shape[-1] * x.shape[-2] < _WIDE:
        wide = x.to(torch.float64)
        if reverse:
            return wide.flip(TIME).cumsum(TIME).flip(TIME) - wide
        return wide.cumsum(TIME) - wide
    out = torch.empty(x.shape, dtype=torch.float64, device=x.device)
    bins = x.shape[TIME]
    total = torch.zeros_like(x.select(TIME, 0), dtype=torch.float64)
    for k in range(bins - 1, -1, -1) if reverse else range(bins):
        out.select(TIME, k).copy_(total)
        total += x.select(TIME, k)
    return out


class _SumBefore(torch.autograd.Function):
    @staticmethod
    def forward(x: Tensor, reverse: bool) -> Tensor:
        return _sum_before(x, reverse)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.dtype, ctx.reverse = inputs[0].dtype, inputs[1]

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return _apply(gradients[0], not ctx.reverse).to(ctx.dtype), None

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Tensor:
        return _sum_before(tangents[0], ctx.reverse)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], x: Tensor, reverse: bool) -> tuple[Tensor, int]:
        # time is counted from the end, so a batch in front changes nothing
        return _apply(x.movedim(in_dims[0] or 0, 0), reverse), 0


def _apply(x: Tensor, reverse: bool) -> Tensor:
    result: Tensor = _SumBefore.apply(x, reverse)  # type: ignore[no-untyped-call]
    return result


def sum_before(x: Tensor) -> Tensor:
    """Sum of the earlier bins, differentiable to any order.

    Args:
        x: (..., T, H, W).

    Returns:
        Shape of `x`, float64.
    """
    return _apply(x, False)
