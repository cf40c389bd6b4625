"""The likeliest place of a return, within its bin too: for responses of any shape.

`log_matched_filter` asks how likely light anywhere in a bin is, and the parabola of `peak_position` finds the place in
it where the answer is a parabola: normal pulses of a bin and more. Tails and edges are none. Here the exact likelihood
of the response is taken at shares of a bin. Source: Kay, Fundamentals of statistical signal processing I (1993), 7.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.errors import ShapeError
from torchtransient.floating import in_single
from torchtransient.sensing.base.layout import TIME, bin_width_of, check_bins, check_number
from torchtransient.sensing.estimation.cramer_rao import shares_between
from torchtransient.sensing.estimation.depth import log_matched_filter
from torchtransient.sensing.response.impulse_response import check_response
from torchtransient.sensing.response.responses import Response

_STEPS = 64  # parts of a bin; between them a parabola, whose third order is then 1e-4 bins over the width
_AROUND = 1  # bins on each side of the best one
_EQUAL = 1e-13  # of a likelihood, by rounding


@in_single
def ml_position(
    histogram: Tensor,
    response: Response,
    axis: TimeAxis | None = None,
    *,
    bin_width_s: float | None = None,
    signal_to_background: float = 1e3,
) -> Tensor:
    """Position (..., C, H, W) in bins of one return in Poisson counts, by the greatest likelihood within its bin.

    Maximises ``sum_k histogram[k] log(1 + s share_k(position))``, share_k what bin k holds of the response around the
    position and ``s`` the detections of the signal over those of the background in one bin, as in `log_matched_filter`,
    which finds the bin. At the Cramer-Rao bound from some 30 photons on, for tails and in wide bins too
    (docs/photon_counting.md). For `distance_of_position`. Where the likelihood is flat, as of a pulse that lies inside
    one bin, it is the middle of the flat part. NaN in a histogram is NaN; one without counts gives 1/2.

    Differentiable in the histogram and in the parameters of the response, by how the top of the likelihood moves; zero
    where it is flat. Bins are those of ``axis`` or ``bin_width_s``. What the window cuts off of the response is taken
    for light that was not there: for returns inside the window. Of pile-up, give it the rate of `coates`. Computed in
    float64. Raises ShapeError, UnitError.
    """
    where = "ml_position"
    check_bins(histogram, where)
    check_response(response, where)
    width = bin_width_of(axis, bin_width_s, where)
    bins = histogram.shape[TIME]
    if axis is not None and axis.num_bins != bins:
        raise ShapeError(f"{where}: expected T = {axis.num_bins} as in the axis, got {bins}.")
    ratio = check_number(signal_to_background, "signal_to_background", where, open_low=True)
    first, kernel = response.kernel(width)
    counts = histogram.to(torch.float64)
    with torch.no_grad():
        scores = log_matched_filter(counts, kernel, first, signal_to_background=ratio)
        best = scores.argmax(TIME)
    rows, start = counts.movedim(TIME, -1).reshape(-1, bins), best.reshape(-1, 1)
    # bins that the response may reach from any place around the best one, counted from that
    low, high = max(first - _AROUND, -bins), min(first + kernel.numel() + _AROUND, bins)
    places = torch.arange(-_AROUND * _STEPS, (1 + _AROUND) * _STEPS + 1, device=rows.device) / _STEPS
    edges = (torch.arange(low, high + 1, device=rows.device) - places.double().unsqueeze(-1)) * width
    table = torch.log1p(ratio * shares_between(response, edges, width))
    reached = start + torch.arange(low, high, device=rows.device)
    inside = (reached >= 0) & (reached < bins)
    seen = torch.where(inside, rows.gather(1, reached.clamp(0, bins - 1)), 0.0)
    found = start + places
    likely = (seen @ table.T).masked_fill((found < 0) | (found > bins), -math.inf)
    position = start.squeeze(1) + places[0] + _top(likely) / _STEPS
    position = torch.where((rows == 0).all(1), 0.5, position)
    position = torch.where(rows.isnan().any(1), math.nan, position)
    return position.reshape(best.shape).to(histogram.dtype)


def _top(values: Tensor) -> Tensor:
    """Index (N,) of the largest entry of (N, M), between entries by a parabola, or the middle of a flat top."""
    highest = values.amax(1, keepdim=True)
    top = values >= highest - _EQUAL * highest.abs()
    # the flat part that the first largest entry is in
    begin = top.to(torch.uint8).argmax(1, keepdim=True)
    number = torch.arange(values.shape[1], device=values.device)
    ends = torch.where(~top & (number > begin), number, values.shape[1]).amin(1, keepdim=True) - 1
    flat = ends > begin
    last = values.shape[1] - 1
    here = values.gather(1, begin)
    left, right = values.gather(1, (begin - 1).clamp(min=0)), values.gather(1, (begin + 1).clamp(max=last))
    usable = ~flat & (begin > 0) & (begin < last) & left.isfinite() & right.isfinite()
    one = torch.ones_like(here)
    # both neighbours are lower, so that it lies within half a step
    bend = torch.where(usable, 2 * here - left - right, one)
    offset = torch.where(usable, 0.5 * (right - left) / bend, torch.zeros_like(here))
    middle = 0.5 * (begin + ends).to(values.dtype)
    return (middle + offset).squeeze(1)
