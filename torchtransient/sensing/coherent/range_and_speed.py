"""Distance and speed from the spectra of an up and a down chirp."""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.chirps import Chirps
from torchtransient.errors import ArgumentError, ShapeError
from torchtransient.floating import in_single
from torchtransient.sensing.checks import TIME, check_bins, check_choice, check_number

Bins = Literal["sums", "samples"]

# Offsets of a line in half a bin, of which the table is made that positions are read from.
_OFFSETS = 257
# Bins agree when they do to a millionth of one.
_SAME_BIN = 1e-6


@in_single
def range_and_speed(
    beats: Any,
    chirps: Chirps | None = None,
    axis: TimeAxis | None = None,
    *,
    threshold: float = 0.0,
    bins: Bins = "sums",
) -> tuple[Tensor, Tensor]:
    """Find distance and speed of approach by the largest bin of the up and of the down chirp.

    A position between bins is that of a single line of the window which gives the neighbours of the largest bin their
    difference over the sum of the three. Of a Hann window's line that is taken for the other kind of bins, or was
    rendered with a tent filter, it is off by up to 1 / 20 of a bin where c / B is one bin, 1 / 40 where it is two,
    1 / 150 where it is four.

    Args:
        beats: power spectra (..., 2, T, H, W), up and down, with or without noise; or a result that has some
            (`RenderOutput`, `Result` of a file).
        chirps: chirps of the beats; None for those of a result.
        axis: axis over ``opl +- k rate``; None for that of a result.
        bins: "sums" over the width of a bin, as films make them (``temporal_filter="box"``), or "samples" of the
            spectrum, as a transform and `CoherentReceiver` give them.
        threshold: power, in the unit of ``beats``, that the largest bin has to exceed to count as a return.

    Returns:
        Distances in metres, half the optical path length, and speeds of approach in m/s, half the rate with its sign
        changed, (..., H, W) each. NaN where the largest bin of one of the chirps does not exceed the threshold. Choices
        of bins are detached; positions within a bin carry the gradient.

    Raises:
        ShapeError: unless ``beats`` has two spectra over the bins of the axis.
        ArgumentError: without chirps or an axis, and for other bins.

    The largest bins of both chirps are taken for one surface: with several of them in a pixel, of unlike brightness in
    both, they may be those of two. A line beyond the axis is taken for the middle of its first or last bin.
    """
    me = "range_and_speed"
    if not isinstance(beats, Tensor):
        chirps, axis = beats.chirps if chirps is None else chirps, beats.axis if axis is None else axis
        if beats.beats is None:
            raise ShapeError(f"{me}: expected a result with beats, got one without. Render with chirps=tt.Chirps(...).")
        beats = beats.beats
    check_bins(beats, me)
    if chirps is None or axis is None:
        raise ArgumentError(f"{me}: expected chirps and axis beside a tensor of beats, got {chirps} and {axis}.")
    check_choice(bins, Bins, "bins", me)
    level = check_number(threshold, "threshold", me, low=-math.inf)
    if beats.ndim < 4 or beats.shape[-4] != 2 or beats.shape[TIME] != axis.num_bins:
        raise ShapeError(
            f"{me}: expected spectra (..., 2, {axis.num_bins}, H, W), up and down over the bins of the axis, as "
            f"out.beats of a render with chirps= has them, got {tuple(beats.shape)}."
        )
    index = beats.argmax(TIME, keepdim=True)
    here = beats.gather(TIME, index)
    inner = (index > 0) & (index < axis.num_bins - 1)
    left, right = (beats.gather(TIME, (index + step).clamp(0, axis.num_bins - 1)) for step in (-1, 1))
    total = left + here + right
    usable = inner & (total > 0)
    lean = torch.where(usable, right - left, 0.0) / torch.where(usable, total, 1.0)
    position = index.to(torch.float64) + 0.5 + _offset(lean, chirps, axis, bins).to(torch.float64)
    opl = axis.start_opl + axis.bin_width_opl * position.squeeze(TIME)
    # argmax takes NaN for the largest entry, which exceeds nothing
    opl = torch.where(here.squeeze(TIME) > level, opl, math.nan)
    up, down = opl.unbind(-3)
    distance, speed = (up + down) / 4, (down - up) / (4 * chirps.rate_scale_s)
    return distance.to(beats.dtype), speed.to(beats.dtype)


def _offset(lean: Tensor, chirps: Chirps, axis: TimeAxis, bins: Bins) -> Tensor:
    """Offset in bins, in [-1/2, 1/2], of a line that gives its neighbours that difference, over the sum of three."""
    offsets = np.linspace(0, 0.5, _OFFSETS)
    if bins == "sums":
        edges = (np.arange(-1.5, 2) - offsets[:, None]) * axis.bin_width_opl
        left, here, right = np.diff(chirps.line_shape.cumulative(edges)).T
    else:
        left, here, right = chirps.line_amplitude((np.arange(-1, 2) - offsets[:, None]) * axis.bin_width_opl).T ** 2
    leans = np.maximum.accumulate((right - left) / (left + here + right))
    knots = torch.from_numpy(leans).to(lean)
    at = torch.from_numpy(offsets).to(lean)
    side = torch.where(lean < 0, -1.0, 1.0).to(lean)  # a symmetric line has a slope, too
    amount = lean * side
    upper = torch.searchsorted(knots, amount.detach().contiguous()).clamp(1, _OFFSETS - 1)
    low, high = knots[upper - 1], knots[upper]
    share = ((amount - low) / (high - low).clamp_min(torch.finfo(lean.dtype).tiny)).clamp(0, 1)
    return side * (at[upper - 1] + share * (at[upper] - at[upper - 1]))


@in_single
def fold_beats(beats: Tensor, axis: TimeAxis) -> tuple[Tensor, TimeAxis]:
    """Add the power at negative beat frequencies to the positive ones, as a detector without quadratures sees it.

    Fold expected spectra, before `Speckle` and `BeatNoise`: waves of both signs meet in one mode.

    Args:
        beats: spectra (..., T, H, W).
        axis: axis of the spectra; zero is an edge or the middle of a bin (`tt.Chirps.time_axis`).

    Returns:
        Spectra (..., T', H, W) of the same sum, differentiable, and their axis.

    Raises:
        ShapeError: for other axes, and unless T is that of the axis.
    """
    me = "fold_beats"
    check_bins(beats, me)
    if beats.shape[TIME] != axis.num_bins:
        raise ShapeError(f"{me}: expected T = {axis.num_bins} bins as in the axis, got {tuple(beats.shape)}.")
    # Middles of bins in half bins: whole numbers, all even or all odd.
    first = 2 * axis.start_opl / axis.bin_width_opl + 1
    if abs(first - round(first)) > 2 * _SAME_BIN:
        raise ShapeError(
            f"{me}: expected an axis with zero at an edge or in the middle of a bin, got {axis}. Take that of "
            "Chirps.time_axis."
        )
    middles = (round(first) + 2 * torch.arange(axis.num_bins, device=beats.device)).abs()
    least, most = int(middles.min()), int(middles.max())
    width = axis.bin_width_opl
    folded = TimeAxis((least - 1) * width / 2, width, (most - least) // 2 + 1)
    shape = (*beats.shape[:TIME], folded.num_bins, *beats.shape[TIME + 1 :])
    return beats.new_zeros(shape).index_add(TIME, (middles - least) // 2, beats), folded
