"""PSNR and SSIM of pictures, and of transients as pictures, by kornia.

The range of the values decides both metrics, so a target beyond its range raises UnitError.
"""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor

from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.floating import is_true
from torchtransient.losses.checks import check_level
from torchtransient.losses.layouts import time_dim
from torchtransient.losses.results import STEADY, TRANSIENT, Picture, Transient, reads
from torchtransient.losses.similarity import WINDOW, ssim_loss
from torchtransient.metrics.tally import Reduction, Tally, measured_pair

View = Literal["sum", "bins"]
_PICTURE = (-3, -2, -1)
_IMAGES = -3


@reads(input=STEADY, target=STEADY)
def psnr(
    input: Picture,
    target: Picture,
    *,
    value_range: float | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Compute the peak signal-to-noise ratio, `10 log10(value_range^2 / mean((input - target)^2))`, decibels.

    Args:
        input: pictures (..., C, Y, X).
        target: pictures of the same shape.
        value_range: range of the values; None: the highest value of each target.
        mask: pixels that count.
        reduction: "mean" over pictures, "item" or "none" of each.

    Returns:
        Decibels, infinite for equal pictures; scalar, or (...) for "item" and "none"; NaN where nothing counts.

    Raises:
        UnitError: for values that are not finite, a target beyond its range, and a dark target without a range.
        ShapeError: for two shapes.
    """
    where = "psnr"
    x, y, given, limit = _pictures(input, target, value_range, mask, where)
    return _psnr(x, y, given, limit).result(reduction, where)


@reads(input=STEADY, target=STEADY)
def ssim(
    input: Picture,
    target: Picture,
    *,
    window: int = WINDOW,
    value_range: float | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Compute the structural similarity, `1 - tt.losses.ssim_loss`, in [-1, 1].

    Args:
        input: pictures (..., C, Y, X).
        target: pictures of the same shape.
        window: width of the Gaussian window in pixels, odd; reflected at the borders.
        value_range: range of the values; None: the highest value of each target.
        mask: pixels that count; the others are 0 in both for the windows that reach them.
        reduction: "mean" of all pixels, "item" of each picture, or "none".

    Returns:
        Scalar, (...) for "item", the shape of the input for "none"; NaN where nothing counts.

    Raises:
        UnitError, ShapeError: as `psnr`; ShapeError for pictures smaller than the window.

    Source: Wang, Bovik, Sheikh and Simoncelli 2004.
    """
    where = "ssim"
    x, y, given, limit = _pictures(input, target, value_range, mask, where)
    return _ssim(x, y, given, limit, window).result(reduction, where)


@reads(input=TRANSIENT, target=TRANSIENT)
def transient_psnr(
    input: Transient,
    target: Transient,
    *,
    view: View = "sum",
    value_range: float | None = None,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Compute `psnr` of transients as pictures.

    Args:
        input: transients (..., C, T, Y, X).
        target: transients of the same shape.
        view: "sum", the light of all bins, (..., C, Y, X), or "bins", each bin a picture, (..., T, C, Y, X), with one
            range for all bins of an item.
        value_range: range of the values of the view; None: the highest value of the target.
        dim: dimension of time, which is -3.
        mask: bins that count; a pixel of a sum counts where one of its bins does.
        reduction: "mean" over pictures, "item" or "none" of each, see `psnr`.

    Returns:
        Decibels, shapes as those of `psnr` of the view.

    Raises:
        UnitError, ShapeError: as `psnr`; ShapeError for other layouts.
    """
    where = "transient_psnr"
    x, y, given, limit = _transients(input, target, view, value_range, dim, mask, where)
    return _psnr(x, y, given, limit).result(reduction, where)


@reads(input=TRANSIENT, target=TRANSIENT)
def transient_ssim(
    input: Transient,
    target: Transient,
    *,
    view: View = "sum",
    window: int = WINDOW,
    value_range: float | None = None,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Compute `ssim` of transients as pictures.

    Empty bins are alike, and dominate a mean over the bins of most scenes.

    Args:
        input, target: transients (..., C, T, Y, X).
        view: "sum", the light of all bins, or "bins", each bin a picture, see `transient_psnr`.
        window: width of the Gaussian window in pixels, odd, see `ssim`.
        value_range: range of the values of the view; None: the highest value of the target.
        dim: dimension of time, which is -3.
        mask: bins that count; a pixel of a sum counts where one of its bins does.
        reduction: "mean" of all pixels, "item" of each picture, or "none".
    """
    where = "transient_ssim"
    x, y, given, limit = _transients(input, target, view, value_range, dim, mask, where)
    return _ssim(x, y, given, limit, window).result(reduction, where)


def _psnr(x: Tensor, y: Tensor, mask: Tensor | None, limit: Tensor) -> Tally:
    from kornia.metrics import psnr as decibels

    shape = x.shape[:-3]
    stacked = (shape.numel(), *x.shape[-3:])
    ours, theirs = ((picture / limit).double().reshape(stacked) for picture in (x, y))
    kept = torch.ones_like(ours, dtype=torch.bool) if mask is None else mask.reshape(stacked)
    counts = kept.flatten(1).any(1)
    # a picture without a pixel has no mean
    pairs = zip(ours, theirs, kept, counts, strict=True)
    values = [decibels(a[m], b[m], 1.0) if counted else a.new_zeros(()) for a, b, m, counted in pairs]
    found = torch.stack(values) if values else ours.new_zeros(0)
    return Tally(found.to(x.dtype).reshape(shape), counts.reshape(shape))


def _ssim(x: Tensor, y: Tensor, mask: Tensor | None, limit: Tensor, window: int) -> Tally:
    # in units of the range; masked pixels are zero already
    unlike = ssim_loss(x / limit, y / limit, window=window, value_range=1.0, reduction="none")
    return Tally(1 - unlike, mask, -_IMAGES)


def _pictures(
    input: object, target: object, value_range: float | None, mask: Tensor | None, where: str
) -> tuple[Tensor, Tensor, Tensor | None, Tensor]:
    x, y, given = measured_pair(input, target, mask, where)
    if x.ndim < -_IMAGES:
        raise ShapeError(f"{where}: expected pictures (..., C, Y, X), got {tuple(x.shape)}.")
    return x, y, given, _range(y, value_range, _PICTURE, given, where)


def _transients(
    input: object,
    target: object,
    view: View,
    value_range: float | None,
    dim: int | None,
    mask: Tensor | None,
    where: str,
) -> tuple[Tensor, Tensor, Tensor | None, Tensor]:
    """Return the pictures of both transients, their mask and their ranges."""
    if view not in get_args(View):
        raise ArgumentError(f"{where}: expected view 'sum' or 'bins', got {view!r}.")
    x, y, given = measured_pair(input, target, mask, where)
    place = time_dim(x, dim, where)
    if place != _IMAGES or x.ndim < 4:
        raise ShapeError(
            f"{where}: expected transients (..., C, T, Y, X), which are pictures, got {tuple(x.shape)} with time in "
            f"dimension {place}."
        )
    if view == "sum":
        x, y = x.sum(_IMAGES), y.sum(_IMAGES)
        given = None if given is None else given.any(_IMAGES)
        return x, y, given, _range(y, value_range, _PICTURE, given, where)
    limit = _range(y, value_range, (-4, *_PICTURE), given, where)
    given = None if given is None else given.movedim(_IMAGES, -4)
    return x.movedim(_IMAGES, -4), y.movedim(_IMAGES, -4), given, limit


def _range(target: Tensor, value_range: float | None, dims: tuple[int, ...], mask: Tensor | None, where: str) -> Tensor:
    """Return the range of the values, which broadcasts to the target."""
    if value_range is not None:
        limit = check_level("value_range", value_range, target.new_empty(()), where)
        low, high = target.clamp(max=0), target.clamp_min(0)
        spread = high.amax(dims, keepdim=True) - low.amin(dims, keepdim=True)
        if not is_true(spread <= limit * (1 + 1e-5)):
            raise UnitError(
                f"{where}: expected a target within value_range {value_range}, got values over "
                f"{float(spread.max()):.4g}. Give the range of the data, or none."
            )
        return limit
    top = target.amax(dims, keepdim=True)
    needed = torch.ones_like(top, dtype=torch.bool) if mask is None else mask.to(top.dtype).amax(dims, keepdim=True) > 0
    if not is_true((top > 0) | ~needed):
        raise UnitError(
            f"{where}: expected targets with light, whose highest value is their range, got one without. Give "
            "value_range=, that of the data."
        )
    return torch.where(top > 0, top, torch.ones_like(top))
