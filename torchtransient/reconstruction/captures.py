"""Captures as operators take them: without first and last legs, and as roots of light."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture
from torchtransient.capture.capture import computed
from torchtransient.checks import finite
from torchtransient.errors import ShapeError, UnitError
from torchtransient.reconstruction.capture_checks import checked_capture


def subtract_legs(capture: Capture) -> Capture:
    """Move each histogram of a capture back by its legs, to lengths from the spot to the sensor point.

    Values are interpolated linearly between the middles of bins, so pulses get up to half a bin wider. The new axis has
    bins of the same width and starts where the light of the pair with the shortest legs started, or at zero; its bins
    begin where that pair's bins did. Light before its start is lost, and light from after the old end is zero.
    Differentiable by the transient, not by points.

    Args:
        capture: capture with a transient; returned as it is where its scan counts no legs.

    Returns:
        Capture without legs, ``steady`` kept, in double precision where the capture is, else in float32, counts too.

    Raises:
        ShapeError: for a capture without a transient, or with phasors, whose phases would have to turn.
        UnitError: where no bin is left.
    """
    transient, axis = checked_capture(capture, "subtract_legs")
    if not capture.scan.first_and_last_leg:
        return capture
    if capture.phasor is not None:
        raise ShapeError("subtract_legs: expected a transient alone, got phasors too. Leave them out: phasor=None.")
    width = axis.bin_width_opl
    legs = capture.scan.legs.detach().to(transient.device)
    start = axis.start_opl - float(legs.min())
    skipped = max(0, math.ceil(-start / width - 1e-6))
    bins = axis.num_bins - skipped
    if bins < 1:
        raise UnitError(f"subtract_legs: expected bins behind the legs, got {axis}. Does its time axis count the legs?")
    # A zero that is one to rounding.
    first = start + skipped * width
    shorter = TimeAxis(0.0 if abs(first) < 1e-6 * width else first, width, bins)
    scan = replace(capture.scan, first_and_last_leg=False)
    return replace(capture, transient=_moved(computed(transient), legs, axis, shorter), axis=shorter, scan=scan)


def _moved(transient: Tensor, legs: Tensor, old: TimeAxis, new: TimeAxis) -> Tensor:
    """Histograms (..., T, *legs.shape) read at the middles of new bins plus legs."""
    dims = legs.ndim
    flat = transient.flatten(-dims) if dims else transient.unsqueeze(-1)
    # A bin of zeros at each end stands for what was not measured.
    padded = torch.nn.functional.pad(flat, (0, 0, 1, 1))
    read = new.centers_opl.to(legs.device)[:, None] + legs.reshape(-1)
    at = ((read - old.start_opl) / old.bin_width_opl + 0.5).clamp(0, old.num_bins + 1)
    low = at.floor().clamp_max(old.num_bins).to(torch.int64)
    share = (at - low).to(transient.dtype)
    low = low.expand(*flat.shape[:-2], *low.shape)
    before, after = torch.gather(padded, -2, low), torch.gather(padded, -2, low + 1)
    found = before + share * (after - before)
    return found.reshape(*transient.shape[: transient.ndim - dims - 1], new.num_bins, *legs.shape)


COUNTS_FLOOR = 0.25
"""Floor for photon counts: the slope is at most 2, the root of one count 0.89, that of none zero."""


def stabilized_root(transient: Tensor, floor: float = COUNTS_FLOOR) -> Tensor:
    """Take the root of light, ``H / sqrt(|H| + floor)`` of every value, with a bounded slope at empty bins.

    Odd in H: background below zero keeps its sign. Differentiable any number of times, in both modes.

    Args:
        transient: finite real numbers, any shape; whole numbers become float32.
        floor: number added to the light under the root, in the unit of the transient: 1/4 for photon counts, a small
            part of the brightest bin for radiance. With 0 it is the root itself, sign kept, whose derivative grows
            without bound towards zero and counts as zero there.

    Returns:
        Tensor of the same shape.

    Raises:
        UnitError: for a floor below zero or below the smallest number of the precision.
        ShapeError: for complex numbers.
    """
    if transient.is_complex():
        raise ShapeError(f"stabilized_root: expected a transient of real numbers, got {transient.dtype}.")
    h = transient if transient.is_floating_point() else transient.to(torch.float32)
    floor = checked_floor(floor, h.dtype)
    if floor:
        return h * torch.rsqrt(h.abs() + floor)
    empty = h == 0
    # The inner `where` keeps the infinite slope at zero out of products with zero, which would be NaN.
    magnitude = torch.where(empty, torch.ones_like(h), h.abs())
    return torch.where(empty, torch.zeros_like(h), torch.sign(h) * magnitude.sqrt())


def checked_floor(value: float, dtype: torch.dtype = torch.float64) -> float:
    """Return a floor of :func:`stabilized_root`.

    Args:
        value: number, zero or more.
        dtype: precision of the transient.

    Raises:
        UnitError: for numbers below zero or below the smallest number of ``dtype``.
    """
    floor, least = finite("stabilized_root: floor", value), torch.finfo(dtype).tiny
    # Smaller ones vanish or have few digits, and empty bins would be zero over zero.
    if floor < 0 or 0 < floor < least:
        raise UnitError(
            f"stabilized_root: expected a floor of zero or of {least:.3g} at least in {dtype}, got {floor!r}."
        )
    return floor
