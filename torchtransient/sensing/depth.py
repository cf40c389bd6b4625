"""Depth from histograms of photon arrivals: peaks, matched filters, likelihoods, first and several returns.

Histograms are (..., C, T, H, W); positions (..., C, H, W) count bins from the start of the axis, so that the middle of
bin k is at ``k + 1/2`` (`distance_of_position` makes metres of them). Choices of a bin are detached; what is added to
them, within a bin, carries the gradient. Each function says whether it is differentiable.

`log_matched_filter` is the likelihood of light anywhere in a bin, and the parabola of `peak_position` finds the place
in it where that is a parabola: normal pulses of a bin and more. Tails and edges are none. `ml_position` takes the exact
likelihood of the response at shares of a bin.

Sources: Kirmani et al., "First-photon imaging" (Science 2014) and Shin et al. (IEEE TCI 2015) for the log-matched
filter; Shin, Xu, Venkatraman, Lussana, Villa, Zappa, Goyal, Wong & Shapiro (Nat. Commun. 2016) for several returns;
Kay, Fundamentals of statistical signal processing I (1993), 7, for the greatest likelihood.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.errors import ShapeError, UnitError
from torchtransient.floating import in_single
from torchtransient.sensing.checks import (
    TIME,
    bin_width_of,
    check_bins,
    check_count,
    check_number,
    check_seconds,
    check_transient,
    reals,
)
from torchtransient.sensing.responses import FWHM_PER_SIGMA, Response, kernel_of
from torchtransient.sensing.time_convolution import Boundary, convolve_time
from torchtransient.tensor_record import TensorRecord
from torchtransient.units import SPEED_OF_LIGHT


@in_single
def log_matched_filter(
    histogram: Tensor,
    kernel: Tensor,
    first: int = 0,
    *,
    signal_to_background: float = 1e3,
    boundary: Boundary = "zero",
) -> Tensor:
    """Log-likelihood of every arrival bin, up to a constant.

    ``score[t] = sum_j histogram[t + first + j] log(1 + s kernel[j])`` with ``s`` the signal to background. Its largest
    entry is the maximum-likelihood bin of one return in Poisson counts of constant background; for large ``s`` it
    becomes ``sum histogram log kernel``. Differentiable in histogram and kernel.

    Args:
        histogram: (..., C, T, H, W).
        kernel: shares (K,) of the impulse response (`Response.kernel`).
        first: lag of the kernel's first entry in bins.
        signal_to_background: detections of the signal over detections of the background in one bin.
        boundary: treatment of the window's ends, "zero" or "periodic", see `convolve_time`.

    Returns:
        (..., C, T, H, W).

    Raises:
        UnitError: unless the ratio is above zero and the kernel holds shares (>= 0).
    """
    me = "log_matched_filter"
    ratio = check_number(signal_to_background, "signal_to_background", me, open_low=True)
    check_transient(histogram, me)
    if bool((kernel < 0).any()):
        raise UnitError(f"{me}: expected shares >= 0 in the kernel, got {float(kernel.min()):g}.")
    weights = torch.log1p(ratio * kernel.to(histogram.device))
    return convolve_time(histogram, weights.flip(0), -(first + kernel.numel() - 1), boundary=boundary)


@in_single
def peak_position(scores: Tensor) -> Tensor:
    """Position of the largest entry: the top of the parabola through it and its neighbours, within half a bin of it.

    A normal pulse makes the log-matched filter a parabola, so that it is exact there; of a histogram itself it is
    pulled towards the middle of the bin. Differentiable through the parabola only. In the first or last bin and where
    the three entries are equal, it is the middle of the bin with derivative zero.

    Args:
        scores: (..., C, T, H, W).

    Returns:
        (..., C, H, W) in bins; NaN for scores with NaN.
    """
    check_bins(scores, "peak_position")
    index = scores.argmax(TIME, keepdim=True)
    position = index.squeeze(TIME).to(scores.dtype) + 0.5 + _parabola(scores, index).squeeze(TIME)
    # argmax takes NaN for the largest entry; a position from it would look like any other
    return torch.where(scores.gather(TIME, index).squeeze(TIME).isnan(), math.nan, position)


def _parabola(scores: Tensor, index: Tensor) -> Tensor:
    """Offset in bins, in [-1/2, 1/2], of the top of the parabola around each index (..., R, H, W)."""
    last = scores.shape[TIME] - 1
    inner = (index > 0) & (index < last)
    here = scores.gather(TIME, index)
    left = scores.gather(TIME, (index - 1).clamp(min=0))
    right = scores.gather(TIME, (index + 1).clamp(max=last))
    bend = 2 * here - left - right
    usable = inner & (bend > torch.finfo(scores.dtype).eps * here.abs())
    offset = 0.5 * (right - left) / torch.where(usable, bend, 1.0)
    return torch.where(usable, offset, 0.0).clamp(-0.5, 0.5)


@in_single
def center_of_mass(
    histogram: Tensor, *, background: Tensor | float = 0.0, half_width_bins: int | None = None
) -> Tensor:
    """Mean arrival position of the counts above the background.

    Negative differences count as they are, which keeps the mean unbiased, as long as their sum S is more than its noise
    N, ``N^2 = sum excess^2``; entries that are all positive always have that much. A sum of less does not say where
    light is: the result goes to the middle as ``S^2 / N^2``, its derivative stays bounded, and it never leaves the
    window (or the bins that count). Half precision is summed in float32.

    Args:
        histogram: (..., C, T, H, W).
        background: counts per bin, a number or (..., C, H, W), subtracted before; a background left in pulls the
            result to the middle of the window. Where most bins hold nothing else, it is their median.
        half_width_bins: distance in bins from the largest one within which bins count; None for all.

    Returns:
        (..., C, H, W) in bins, differentiable in histogram and background; where nothing is left the middle of the
        window (or of the largest bin), derivative zero.
    """
    check_bins(histogram, "center_of_mass")
    excess = histogram - _per_pixel(background, histogram, "center_of_mass", "background")
    bins = _positions(histogram)
    if half_width_bins is None:
        reference = torch.full_like(histogram.select(TIME, 0).unsqueeze(TIME), bins.numel() / 2)
    else:
        check_count(half_width_bins, "half_width_bins", "center_of_mass", low=0)
        reference = histogram.argmax(TIME, keepdim=True).to(histogram.dtype) + 0.5
        excess = torch.where((bins - reference).abs() <= half_width_bins + 0.25, excess, 0.0)
    # Shares of the largest entry, whose squares do not overflow.
    largest = excess.detach().abs().amax(TIME, keepdim=True)
    excess = excess / torch.where(largest > 0, largest, 1.0)
    total = excess.sum(TIME, keepdim=True)
    weight = (histogram.abs() / torch.where(largest > 0, largest, 1.0)).sum(TIME, keepdim=True)
    # "not below" lets NaN through
    there = ~(total <= torch.finfo(histogram.dtype).eps * weight)
    # Around the reference, so that float32 does not cancel far from the start of the axis.
    moment = (excess * (bins - reference)).sum(TIME, keepdim=True)
    noise = excess.square().sum(TIME, keepdim=True)
    # The sum of positive entries is never below its noise but by rounding.
    weak = there & (total.square() < noise * (1 - 64 * torch.finfo(histogram.dtype).eps))
    over = torch.where(weak, noise / torch.where(weak, total, 1.0), torch.where(there, total, 1.0))
    position = reference + torch.where(there, moment, 0.0) / over
    reach = 0.5 * bins.numel() if half_width_bins is None else half_width_bins + 0.5
    first, last = (reference - reach).clamp(min=0.0), (reference + reach).clamp(max=float(bins.numel()))
    return torch.minimum(torch.maximum(position, first), last).squeeze(TIME)


@in_single
def soft_argmax(scores: Tensor, temperature: float = 1.0) -> Tensor:
    """Smooth stand-in for the largest entry: ``sum_k softmax(scores / temperature)_k (k + 1/2)``.

    With the log-matched filter and temperature 1 it is the posterior mean of the arrival under a flat prior. Larger
    temperatures and background pull it to the middle of the window; with so many counts (or so small a temperature)
    that the posterior is narrower than half a bin, it snaps to the middle of a bin. Differentiable everywhere.

    Args:
        scores: (..., C, T, H, W).
        temperature: temperature of the softmax, above 0, in the unit of the scores.

    Returns:
        (..., C, H, W) in bins.
    """
    check_bins(scores, "soft_argmax")
    scale = check_number(temperature, "temperature", "soft_argmax", open_low=True)
    weights = torch.softmax(scores / scale, dim=TIME)
    middle = scores.shape[TIME] / 2
    return (weights * (_positions(scores) - middle)).sum(TIME) + middle


@dataclass(frozen=True, eq=False, repr=False)
class Returns(TensorRecord):
    """Returns of a pixel in order of time; entries that are not valid come last and hold zero.

    Attributes:
        position: position of the returns in bins, (..., C, R, H, W).
        strength: entry at the position, of the same shape.
        valid: mask of the returns that were found, of the same shape.
    """

    position: Tensor
    strength: Tensor
    valid: Tensor


@in_single
def first_return(histogram: Tensor, threshold: Tensor | float) -> Returns:
    """First crossing of a threshold: `Returns` with R = 1.

    The crossing lies on the straight line between the middles of the bins before and at it, and is differentiable in
    histogram and threshold; in the very first bin it is its middle. Earlier than the peak by a share of the pulse: a
    leading-edge discriminator has the same walk error. An entry of zero or less is no return, whatever the threshold: a
    share of the largest entry is 0 in an empty pixel.

    Args:
        histogram: (..., C, T, H, W).
        threshold: counts that a return reaches, a number or (..., C, H, W).
    """
    check_bins(histogram, "first_return")
    level = _per_pixel(threshold, histogram, "first_return", "threshold")
    # NaN counts as reached, and is then what is found
    reached = ~((histogram < level) | (histogram <= 0))
    valid = reached.any(TIME, keepdim=True)
    index = reached.to(torch.uint8).argmax(TIME, keepdim=True)
    here, before = histogram.gather(TIME, index), histogram.gather(TIME, (index - 1).clamp(min=0))
    inside = valid & (index > 0)
    # `before` is below the level, or no light, and `here` is not, so that the step between them is positive.
    share = torch.where(inside, level - before, 0.0) / torch.where(inside, here - before, 1.0)
    share = share.clamp(0, 1)  # of a level below zero
    position = torch.where(inside, index - 0.5 + share, index + 0.5).to(histogram.dtype)
    return Returns(torch.where(valid, position, 0.0), torch.where(valid, here, 0.0), valid)


@in_single
def multi_return(scores: Tensor, max_returns: int, *, threshold: float, min_separation_bins: int = 1) -> Returns:
    """Local maxima of at least a threshold, the strongest ones, in order of time.

    Positions are refined by a parabola and strengths are the entries themselves; both are differentiable there. Takes
    histograms, filtered ones, or scores. A pixel of equal entries, an empty one too, has no maximum, whatever the
    threshold. Memory and time grow as R.

    Args:
        scores: (..., C, T, H, W).
        max_returns: largest number of returns R.
        threshold: least score of a return.
        min_separation_bins: least distance in bins; maxima closer than that to a stronger one are left out.
    """
    me = "multi_return"
    check_bins(scores, me)
    check_count(max_returns, "max_returns", me)
    separation = check_count(min_separation_bins, "min_separation_bins", me)
    # NaN is no maximum anywhere: a histogram with one has no returns that could be told
    unknown = scores.isnan().any(TIME, keepdim=True)
    low = torch.full_like(scores.select(TIME, 0).unsqueeze(TIME), -math.inf)
    before = torch.cat([low, scores.narrow(TIME, 0, scores.shape[TIME] - 1)], TIME)
    after = torch.cat([scores.narrow(TIME, 1, scores.shape[TIME] - 1), low], TIME)
    above = (scores >= threshold) & (scores > scores.amin(TIME, keepdim=True))
    left = torch.where((scores >= before) & (scores > after) & above, scores, -math.inf)
    bins = torch.arange(scores.shape[TIME], device=scores.device).reshape(-1, 1, 1)
    found = []
    for _ in range(max_returns):
        best = left.argmax(TIME, keepdim=True)
        found.append(torch.where(left.gather(TIME, best) > -math.inf, best, -1))
        left = torch.where((bins - best).abs() < separation, -math.inf, left)
    index = torch.cat(found, TIME)
    late = torch.iinfo(index.dtype).max
    index = torch.where(index < 0, late, index).sort(TIME).values
    valid = index != late
    index = torch.where(valid, index, 0)
    position = index.to(scores.dtype) + 0.5 + _parabola(scores, index)
    strength = scores.gather(TIME, index)
    position, strength = torch.where(valid, position, 0.0), torch.where(valid, strength, 0.0)
    return Returns(torch.where(unknown, math.nan, position), torch.where(unknown, math.nan, strength), valid & ~unknown)


@in_single
def distance_of_position(position: Tensor, axis: TimeAxis) -> Tensor:
    """Distance one way of positions in bins: half the optical path ``start_opl + position bin_width_opl``.

    For light that leaves from and returns to the sensor; t = 0 when it leaves. Computed in float64 from the axis and
    returned in the dtype given: float32 resolves 4e-6 m at 100 m.

    Args:
        position: position in bins, any shape.
        axis: axis of the histogram.

    Returns:
        Metres.
    """
    (position,) = reals("distance_of_position", position=position)
    return (0.5 * (axis.start_opl + position.to(torch.float64) * axis.bin_width_opl)).to(position.dtype)


@in_single
def distance_to_points(distance_m: Tensor, intrinsics: Tensor) -> Tensor:
    """Points in the frame of the camera for distances along the rays of its pixels. Differentiable in both arguments.

    The camera is kornia's: x right, y down, z forward, pixel centres at *integer* coordinates, so that the middle of a
    picture is ``((W - 1) / 2, (H - 1) / 2)``.

    Args:
        distance_m: distances (..., H, W) in metres, Euclidean, as times of flight are; not depths along z.
        intrinsics: camera matrix (3, 3), or (B, 3, 3) for distances (B, H, W).

    Returns:
        (..., H, W, 3) in metres.

    Raises:
        ShapeError: for other shapes.
    """
    batched = intrinsics.ndim == 3
    fits = not batched or (distance_m.ndim == 3 and distance_m.shape[0] == intrinsics.shape[0])
    if intrinsics.shape[-2:] != (3, 3) or intrinsics.ndim > 3 or distance_m.ndim < 2 or not fits:
        raise ShapeError(
            f"distance_to_points: expected distances (..., H, W) and intrinsics (3, 3), or (B, H, W) and (B, 3, 3), "
            f"got {tuple(distance_m.shape)} and {tuple(intrinsics.shape)}."
        )
    from kornia.geometry.depth import depth_to_3d_v2

    camera = (intrinsics if batched else intrinsics.unsqueeze(0)).to(distance_m)
    flat = distance_m.reshape(-1, *distance_m.shape[-2:])
    # One grid of rays serves all distances.
    points: Tensor = depth_to_3d_v2(flat, camera, normalize_points=True)
    return points.reshape(*distance_m.shape, 3)


@in_single
def range_deviation_m(response_fwhm_s: float, detections: Tensor | float) -> Tensor:
    """Cramer-Rao bound of the distance from one normal pulse without background: ``c sigma / (2 sqrt(N))``.

    The bins count as narrow beside the pulse; `crlb` knows bins, background, pile-up and other responses, and is this
    in its limit.

    Args:
        response_fwhm_s: full width at half maximum of the pulse in seconds.
        detections: expected signal detections, a number or any shape; infinite deviation at zero, NaN below.

    Returns:
        Metres.

    Raises:
        UnitError: for widths that are no seconds.
    """
    width = check_seconds(response_fwhm_s, "response_fwhm_s", "range_deviation_m", open_low=True)
    return 0.5 * SPEED_OF_LIGHT * width / FWHM_PER_SIGMA / torch.as_tensor(detections).sqrt()


def _per_pixel(value: Tensor | float, histogram: Tensor, where: str, name: str) -> Tensor:
    """Broadcast a number, or one for each pixel (..., C, H, W), to a histogram."""
    value = value if isinstance(value, Tensor) else check_number(value, name, where, low=-math.inf)
    if not isinstance(value, Tensor) or value.ndim == 0:
        return torch.as_tensor(value, dtype=histogram.dtype, device=histogram.device)
    wanted = (*histogram.shape[:TIME], *histogram.shape[TIME + 1 :])
    if value.shape != wanted:
        raise ShapeError(f"{where}: expected {name} to be a number or {wanted}, got {tuple(value.shape)}.")
    return value.unsqueeze(TIME)


def _positions(x: Tensor) -> Tensor:
    """(T, 1, 1): the middles of the bins, in bins."""
    return (torch.arange(x.shape[TIME], dtype=x.dtype, device=x.device) + 0.5).reshape(-1, 1, 1)


# ------------------------------------------------------------------------------------- greatest likelihood within a bin


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
    """Position of one return in Poisson counts, by the greatest likelihood within its bin.

    Maximises ``sum_k histogram[k] log(1 + s share_k(position))``, share_k what bin k holds of the response around the
    position and ``s`` the signal to background, as in `log_matched_filter`, which finds the bin. At the Cramer-Rao
    bound from some 30 photons on, for tails and in wide bins too (docs/photon_counting.md). Where the likelihood is
    flat, as of a pulse that lies inside one bin, it is the middle of the flat part. What the window cuts off of the
    response is taken for light that was not there: for returns inside the window. Of pile-up, give it the rate of
    `coates`. Computed in float64.

    Differentiable in the histogram and in the parameters of the response, by how the top of the likelihood moves; zero
    where it is flat.

    Args:
        histogram: (..., C, T, H, W).
        response: impulse response.
        axis: axis of the histogram, or
        bin_width_s: its bin width in seconds.
        signal_to_background: detections of the signal over detections of the background in one bin.

    Returns:
        (..., C, H, W) in bins, for `distance_of_position`; NaN for a histogram with NaN, 1/2 for one without counts.

    Raises:
        ShapeError: for another T than that of the axis.
        UnitError: for numbers out of range.
    """
    where = "ml_position"
    check_bins(histogram, where)
    width = bin_width_of(axis, bin_width_s, where)
    bins = histogram.shape[TIME]
    if axis is not None and axis.num_bins != bins:
        raise ShapeError(f"{where}: expected T = {axis.num_bins} as in the axis, got {bins}.")
    ratio = check_number(signal_to_background, "signal_to_background", where, open_low=True)
    first, kernel = kernel_of(response, width, "uniform")
    counts = histogram.to(torch.float64)
    with torch.no_grad():
        scores = log_matched_filter(counts, kernel, first, signal_to_background=ratio)
        best = scores.argmax(TIME)
    rows, start = counts.movedim(TIME, -1).reshape(-1, bins), best.reshape(-1, 1)
    # bins that the response may reach from any place around the best one, counted from that
    low, high = max(first - _AROUND, -bins), min(first + kernel.numel() + _AROUND, bins)
    places = torch.arange(-_AROUND * _STEPS, (1 + _AROUND) * _STEPS + 1, device=rows.device) / _STEPS
    edges = (torch.arange(low, high + 1, device=rows.device) - places.double().unsqueeze(-1)) * width
    table = torch.log1p(ratio * response.mass(edges))
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
