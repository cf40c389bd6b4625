"""What is done to captures before a method sees them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch

from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture
from torchtransient.capture.capture import precision_of, summed
from torchtransient.checks import count, shown
from torchtransient.errors import DeviceError, ShapeError
from torchtransient.nlos.measured_light import checked_light
from torchtransient.reconstruction import DiffusionDeconvolution, subtract_legs
from torchtransient.reconstruction.capture_checks import checked_capture


def sum_bins(capture: Capture, number: int) -> Capture:
    """The capture with so many neighbouring bins added up; what is left over at the record's end is dropped.

    Counts stay whole (int64), half precision becomes float32; phasors beside a transient stay. Raises ShapeError
    without a transient and for more bins than there are, SceneError for a number that is none.
    """
    number = count("sum_bins: number", number)
    transient, axis = checked_capture(capture, "sum_bins")
    if number == 1:
        return capture
    bins = axis.num_bins // number
    if bins < 1:
        raise ShapeError(f"sum_bins: expected {axis.num_bins} bins at most, got {number}.")
    dim = transient.ndim - len(capture.scan.shape) - 1
    together = summed(transient.narrow(dim, 0, bins * number).unflatten(dim, (bins, number)), dim + 1)  # type: ignore[no-untyped-call]
    return replace(capture, transient=together, axis=TimeAxis(axis.start_opl, axis.bin_width_opl * number, bins))


def without_slab(capture: Capture, thickness: float, snr: float) -> Capture:
    """A confocal capture without the foam slab on its wall, ``thickness`` metres, by :class:`DiffusionDeconvolution`
    with the foam of Lindell and Wetzstein (2020); intensities below zero are zero, the other Stokes components are as
    they come. Without legs, in double precision where the capture is, else in single. Raises as it does.
    """
    checked_capture(capture, "without_slab")
    capture = subtract_legs(capture)
    transient, axis = checked_capture(capture, "without_slab")
    checked_light(capture, "without_slab")
    # The Wiener filter works at the brightness of the data; float64 keeps what the slab lost.
    slab = DiffusionDeconvolution(capture.scan, time_axis=axis, thickness=thickness, snr=snr, dtype=torch.float64)
    clear = slab.to(transient.device).reconstruct(transient.double())
    if capture.polarized:
        stokes = -len(capture.scan.shape) - 3
        intensity, others = clear.split((1, 3), stokes)  # type: ignore[no-untyped-call]
        clear = torch.cat([intensity.clamp_min(0), others], stokes)
    else:
        clear = clear.clamp_min(0)
    return replace(capture, transient=clear.to(precision_of(transient)), phasor=None, frequencies=None, steady=None)


def moved_to(capture: Capture, device: Any) -> Capture:
    """The capture on a device. Raises DeviceError where there is none of that name."""
    try:
        return capture.to(device)
    except (RuntimeError, AssertionError, TypeError) as error:
        reason = str(error).splitlines()[0]
        raise DeviceError(f"reconstruct: expected a device that torch has, got {shown(device)}: {reason}") from None
