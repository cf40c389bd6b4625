"""Captures without their first and last leg, as methods by Fourier transforms want them."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture
from torchtransient.capture.capture import computed
from torchtransient.errors import ShapeError, UnitError
from torchtransient.reconstruction.capture_checks import checked_capture


def subtract_legs(capture: Capture) -> Capture:
    """The capture with lengths from the spot to the sensor point: each histogram moved back by its legs.

    Values are interpolated linearly between the middles of bins, so pulses get up to half a bin wider. The new axis has
    bins of the same width and starts where the light of the pair with the shortest legs started, or at zero; its bins
    begin where that pair's bins did. Light before its start is lost, and what would come from after the old end is
    zero. ``steady`` stays; a capture without legs is returned as it is. Differentiable by the transient, not by points.
    Captures in double precision stay so, all others, counts too, become float32.

    Raises ShapeError for a capture without a transient or with phasors, whose phases would have to turn, and UnitError
    where nothing is left.
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
        raise UnitError(
            f"subtract_legs: expected a capture that is longer than its shortest legs, {float(legs.min()):.4g} m, got "
            f"one up to {axis.end_opl:.4g} m. Does its time axis count the legs?"
        )
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
