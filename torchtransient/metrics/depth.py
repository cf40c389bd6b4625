"""Metrics of depth maps, over the pixels where the target has a surface.

An input that is not finite where the target has a surface raises UnitError: a method that declines hard pixels would
look better than one that tries them. Leave them out by `mask`, and report their share.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchtransient.checks import positive
from torchtransient.errors import UnitError
from torchtransient.losses.checks import check_number, counted
from torchtransient.losses.depth import on_surfaces
from torchtransient.losses.results import DEPTH, DepthMap, reads
from torchtransient.metrics.tally import Finish, Kind, Reduction, Tally, check_finite

_MAP = 2


def _compared(
    input: object, target: object, mask: Tensor | None, where: str, *, above_zero: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """Return estimate and truth, 1 where no pixel counts, and the mask of pixels that count."""
    ours, theirs, counts = on_surfaces(input, target, mask, where, above_zero=above_zero)
    check_finite(ours, counts, "input", where)
    return counted(ours, counts, 1.0), counted(theirs, counts, 1.0), counts


@reads(input=DEPTH, target=DEPTH)
def depth_mae(
    input: DepthMap, target: DepthMap, *, mask: Tensor | None = None, reduction: Reduction = "mean"
) -> Tensor:
    """Compute the mean absolute error of depths, `mean(|input - target|)`.

    Args:
        input: depth maps (..., Y, X), metres.
        target: true depth maps, of the same shape and unit. Pixels that are not finite (no surface) do not count.
        mask: pixels that count.
        reduction: "mean" of all pixels, "item" of each map, or "none".

    Returns:
        Metres; scalar, (...) for "item", (..., Y, X) for "none"; NaN where no pixel counts.

    Raises:
        UnitError: for an input that is not finite where the target has a surface.
        ShapeError: for two shapes.
    """
    where = "depth_mae"
    x, y, counts = _compared(input, target, mask, where)
    return Tally((x - y).abs(), counts, _MAP).result(reduction, where)


@reads(input=DEPTH, target=DEPTH)
def depth_rmse(
    input: DepthMap, target: DepthMap, *, mask: Tensor | None = None, reduction: Reduction = "mean"
) -> Tensor:
    """Compute the root mean square error of depths, `sqrt(mean((input - target)^2))`, metres.

    Args:
        input, target: depth maps (..., Y, X), metres, see `depth_mae`.
        mask: pixels that count.
        reduction: "mean" of all pixels, "item" of each map, or "none".
    """
    where = "depth_rmse"
    x, y, counts = _compared(input, target, mask, where)
    return Tally((x - y).double().square(), counts, _MAP, Finish(Kind.ROOT)).result(reduction, where).to(x.dtype)


@reads(input=DEPTH, target=DEPTH)
def depth_bias(
    input: DepthMap, target: DepthMap, *, mask: Tensor | None = None, reduction: Reduction = "mean"
) -> Tensor:
    """Compute the mean error of depths, `mean(input - target)`, metres, positive if too far.

    Args:
        input, target: depth maps (..., Y, X), metres, see `depth_mae`.
        mask: pixels that count.
        reduction: "mean" of all pixels, "item" of each map, or "none".
    """
    where = "depth_bias"
    x, y, counts = _compared(input, target, mask, where)
    return Tally(x - y, counts, _MAP).result(reduction, where)


@reads(input=DEPTH, target=DEPTH)
def depth_median_error(input: DepthMap, target: DepthMap, *, mask: Tensor | None = None) -> Tensor:
    """Compute the median absolute error of depths over all pixels that count.

    Of an even number of pixels the lower of the two in the middle, as `torch.median`. `Running` refuses it, since a
    median is not made of sums.

    Args:
        input: depth maps (..., Y, X), metres.
        target: true depth maps, of the same shape and unit. Pixels that are not finite (no surface) do not count.
        mask: pixels that count.

    Returns:
        Scalar, metres; NaN where no pixel counts.

    Raises:
        UnitError: for an input that is not finite where the target has a surface.
        ShapeError: for two shapes.
    """
    x, y, counts = _compared(input, target, mask, "depth_median_error")
    return torch.where(counts, (x - y).abs(), torch.nan).flatten().nanmedian()


@reads(input=DEPTH, target=DEPTH)
def depth_abs_rel(
    input: DepthMap, target: DepthMap, *, mask: Tensor | None = None, reduction: Reduction = "mean"
) -> Tensor:
    """Compute the mean relative error of depths, `mean(|input - target| / target)`.

    Pixels with a target of zero or below do not count. Source: Eigen, Puhrsch and Fergus 2014.

    Args:
        input, target: depth maps (..., Y, X), metres, see `depth_mae`.
        mask: pixels that count.
        reduction: "mean" of all pixels, "item" of each map, or "none".
    """
    where = "depth_abs_rel"
    x, y, counts = _compared(input, target, mask, where, above_zero=True)
    return Tally((x - y).abs() / y, counts, _MAP).result(reduction, where)


@reads(input=DEPTH, target=DEPTH)
def depth_delta(
    input: DepthMap,
    target: DepthMap,
    *,
    threshold: float = 1.25,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Compute the share of pixels with `max(input / target, target / input) < threshold`.

    Args:
        input: depth maps (..., Y, X), metres. Depths of zero and below are outside of every threshold.
        target: true depth maps, of the same shape and unit. Pixels that are not finite or not above zero do not count.
        threshold: limit of the ratio, above 1; usually 1.25, 1.25^2 or 1.25^3.
        mask: pixels that count.
        reduction: "mean" of all pixels, "item" of each map, or "none".

    Returns:
        Shares in [0, 1], shapes as those of `depth_mae`.

    Raises:
        UnitError: for a threshold that is not above 1, and as `depth_mae`.

    Source: Eigen, Puhrsch and Fergus 2014.
    """
    where = "depth_delta"
    most = check_number("threshold", threshold, where)
    if most <= 1:
        raise UnitError(f"{where}: expected a threshold above 1, got {threshold!r}.")
    x, y, counts = _compared(input, target, mask, where, above_zero=True)
    # products, so that small depths cannot overflow a quotient
    within = (x.double() < most * y.double()) & (y.double() < most * x.double())
    return Tally(within.to(x.dtype), counts, _MAP).result(reduction, where)


@reads(input=DEPTH, target=DEPTH)
def depth_gross_errors(
    input: DepthMap, target: DepthMap, *, beyond_m: float, mask: Tensor | None = None, reduction: Reduction = "mean"
) -> Tensor:
    """Compute the share of pixels with `|input - target| > beyond_m`, in [0, 1]; arguments as in `depth_mae`.

    Args:
        beyond_m: largest error that does not count, metres, above zero.
    """
    where = "depth_gross_errors"
    most = positive(f"{where}: beyond_m", beyond_m)
    x, y, counts = _compared(input, target, mask, where)
    return Tally(((x - y).abs() > most).to(x.dtype), counts, _MAP).result(reduction, where)
