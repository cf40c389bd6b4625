"""Depth maps against the truth, where there is a surface.

Maps are (..., Y, X) in one unit, metres. Pixels whose target is not finite (NaN or infinite: no surface there) do not
count, nor those that `mask` leaves out. An estimate that is not finite where one is asked for is an error: what a
method gives no answer for is left out by `mask`, and its share belongs beside the metric. Sources: Eigen, Puhrsch and
Fergus 2014 for the relative error and the thresholds.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchtransient.checks import positive
from torchtransient.errors import UnitError
from torchtransient.losses.comparison import check_mask, check_number, check_pair, counted
from torchtransient.losses.results import DEPTH, DepthMap, reads
from torchtransient.metrics.tally import Finish, Kind, Reduction, Tally, check_finite

_MAP = 2


def _compared(
    input: object, target: object, mask: Tensor | None, where: str, *, positive_only: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """Estimate, truth and the pixels that count; 1 elsewhere."""
    ours, theirs = check_pair(input, target, where)
    surface = torch.isfinite(theirs) & (theirs > 0) if positive_only else torch.isfinite(theirs)
    given = check_mask(mask, theirs, where)
    counts = surface if given is None else given & surface
    check_finite(ours, counts, "input", where)
    return counted(ours, counts, 1.0), counted(theirs, counts, 1.0), counts


@reads(input=DEPTH, target=DEPTH)
def depth_mae(
    input: DepthMap, target: DepthMap, *, mask: Tensor | None = None, reduction: Reduction = "mean"
) -> Tensor:
    """Mean of `|input - target|` over the pixels of depth maps (..., Y, X), metres.

    `reduction`: "mean" of all pixels, (); "item", of each map, (...); "none", of each pixel, (..., Y, X). NaN where no
    pixel counts. Raises ShapeError, UnitError.
    """
    where = "depth_mae"
    x, y, counts = _compared(input, target, mask, where)
    return Tally((x - y).abs(), counts, _MAP).result(reduction, where)


@reads(input=DEPTH, target=DEPTH)
def depth_rmse(
    input: DepthMap, target: DepthMap, *, mask: Tensor | None = None, reduction: Reduction = "mean"
) -> Tensor:
    """Root of the mean of `(input - target)^2` over the pixels of depth maps (..., Y, X), metres; as `depth_mae`."""
    where = "depth_rmse"
    x, y, counts = _compared(input, target, mask, where)
    return Tally((x - y).double().square(), counts, _MAP, Finish(Kind.ROOT)).result(reduction, where).to(x.dtype)


@reads(input=DEPTH, target=DEPTH)
def depth_bias(
    input: DepthMap, target: DepthMap, *, mask: Tensor | None = None, reduction: Reduction = "mean"
) -> Tensor:
    """Mean of `input - target` over the pixels of depth maps (..., Y, X), metres: above zero where it is too far.

    As `depth_mae` otherwise.
    """
    where = "depth_bias"
    x, y, counts = _compared(input, target, mask, where)
    return Tally(x - y, counts, _MAP).result(reduction, where)


@reads(input=DEPTH, target=DEPTH)
def depth_median_error(input: DepthMap, target: DepthMap, *, mask: Tensor | None = None) -> Tensor:
    """Median of `|input - target|` over all pixels that count of depth maps (..., Y, X), metres, shape ().

    Of an even number of pixels the lower of the two in the middle, as `torch.median`. NaN where no pixel counts. A
    median is not made of sums: `Running` does not take it. Raises ShapeError, UnitError.
    """
    x, y, counts = _compared(input, target, mask, "depth_median_error")
    return torch.where(counts, (x - y).abs(), torch.nan).flatten().nanmedian()


@reads(input=DEPTH, target=DEPTH)
def depth_abs_rel(
    input: DepthMap, target: DepthMap, *, mask: Tensor | None = None, reduction: Reduction = "mean"
) -> Tensor:
    """Mean of `|input - target| / target` over the pixels of depth maps (..., Y, X), without unit.

    Targets of zero and below have no relative error and do not count. As `depth_mae` otherwise.
    """
    where = "depth_abs_rel"
    x, y, counts = _compared(input, target, mask, where, positive_only=True)
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
    """Share of pixels with `max(input / target, target / input) < threshold` of depth maps (..., Y, X), in [0, 1].

    The usual thresholds are 1.25, 1.25**2 and 1.25**3. Estimates of zero and below are outside of every threshold;
    targets of zero and below do not count. As `depth_mae` otherwise; UnitError for a threshold that is not above 1.
    """
    where = "depth_delta"
    most = check_number("threshold", threshold, where)
    if most <= 1:
        raise UnitError(f"{where}: expected a threshold above 1, got {threshold!r}.")
    x, y, counts = _compared(input, target, mask, where, positive_only=True)
    # products, so that small depths cannot overflow a quotient
    within = (x.double() < most * y.double()) & (y.double() < most * x.double())
    return Tally(within.to(x.dtype), counts, _MAP).result(reduction, where)


@reads(input=DEPTH, target=DEPTH)
def depth_gross_errors(
    input: DepthMap,
    target: DepthMap,
    *,
    beyond_m: float,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Share of pixels with `|input - target| > beyond_m` of depth maps (..., Y, X), in [0, 1].

    `beyond_m`: metres, above zero. As `depth_mae` otherwise.
    """
    where = "depth_gross_errors"
    most = positive(f"{where}: beyond_m", beyond_m)
    x, y, counts = _compared(input, target, mask, where)
    return Tally(((x - y).abs() > most).to(x.dtype), counts, _MAP).result(reduction, where)
