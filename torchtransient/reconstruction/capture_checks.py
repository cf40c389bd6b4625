"""What operators ask of their arguments and of captures; what is refused, in words."""

from __future__ import annotations

import math
import os
from collections.abc import Collection
from typing import Any

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.checks import as_whole, of_class, positive, shown, with_article
from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.reconstruction.linear import PRECISIONS
from torchtransient.reconstruction.planar_scan import PlanarScan, check_real

# Signal-to-noise ratios that a Wiener filter in single precision tells from none and from infinite ones.
SNR = (1e-20, 1e20)


def checked_precision(dtype: torch.dtype, who: str) -> torch.dtype:
    """A precision that tables are kept in. Raises UnitError for others."""
    if dtype not in PRECISIONS:
        raise UnitError(f"{who}: expected dtype torch.float32 or torch.float64, got {shown(dtype)}.")
    return dtype


def within(name: str, value: Any, low: float, high: float) -> float:
    """``value`` as a float. Raises UnitError unless it lies between the two, beyond which single precision has zero or
    nothing left.
    """
    number = positive(name, value)
    if not low <= number <= high:
        raise UnitError(f"{name}: expected a number from {low:g} to {high:g}, got {shown(value)}.")
    return number


def one_of(name: str, value: Any, options: Collection[Any]) -> Any:
    """``value`` where it equals one of ``options``, texts or whole numbers. Raises ArgumentError for others."""
    plain = value if isinstance(value, str) else as_whole(value)
    for option in options:
        if plain is not None and plain == option:
            return option
    raise ArgumentError(f"{name}: expected one of {', '.join(map(str, options))}, got {shown(value)}.")


def checked_axis(time_axis: TimeAxis, who: str) -> TimeAxis:
    """Return a time axis. Raises ArgumentError for anything else."""
    return of_class(f"{who}: time_axis", time_axis, TimeAxis)


def checked_scan(scan: Scan, who: str) -> Scan:
    """Return a scan. Raises ShapeError for anything else."""
    return of_class(f"{who}: scan", scan, Scan, error=ShapeError)


def checked_points(points: Any, who: str) -> Tensor:
    """A copy of points (..., 3), float64 on the CPU, detached. Raises ShapeError, and UnitError for some that are not
    finite.
    """
    if not isinstance(points, Tensor) or points.ndim < 2 or points.shape[-1] != 3 or points.numel() == 0:
        got = tuple(points.shape) if isinstance(points, Tensor) else shown(points)
        raise ShapeError(f"{who}: expected a VoxelGrid or points (..., 3) as a tensor, got {got}.")
    check_real(points, f"{who}: points")
    plain = points.detach().to("cpu", torch.float64, copy=True)
    if not bool(torch.isfinite(plain).all()):
        raise UnitError(f"{who}: expected finite points in metres, got some that are not.")
    return plain


def check_falloff(falloff: float, nearest: float, farthest: float, dtype: torch.dtype, who: str) -> None:
    """Raises UnitError where powers of ``nearest`` to ``farthest``, products of two distances in m^2, are beyond what a
    precision holds.
    """
    most = abs(falloff) * max(abs(math.log10(nearest)), abs(math.log10(max(farthest, nearest))))
    if most > 0.8 * math.log10(torch.finfo(dtype).max):
        raise UnitError(
            f"{who}: expected a falloff whose factors {dtype} holds, got {falloff:g} at distances whose products are "
            f"{nearest:.3g} to {farthest:.3g} m^2. Light falls with powers of 0 to 4."
        )


def confocal_wall(scan: Scan | PlanarScan, who: str) -> PlanarScan:
    """The grid of a confocal scan of a flat wall that counts no legs. Raises ShapeError for others."""
    if isinstance(scan, PlanarScan):
        return scan
    if not isinstance(scan, Scan):
        raise ShapeError(f"{who}: expected a tt.nlos.Scan or a PlanarScan, got {shown(scan)}.")
    refuse_pairs(scan, who)
    if scan.kind != "confocal":
        raise ShapeError(
            f"{who}: expected a confocal scan, got {with_article(scan.kind)} one. Take the diagonal of an exhaustive "
            "capture with capture.confocal(), bring others to midpoints with MidpointFK, or use Backprojection or "
            "PhasorField."
        )
    refuse_legs(scan, who)
    return PlanarScan.of_scan(scan, who)


def refuse_pairs(scan: Scan, who: str) -> None:
    """Raises ShapeError for a spot of its own for each sensor point."""
    if scan.kind == "pairs":
        raise ShapeError(
            f"{who}: expected a spot that stands still, follows the sensor points, or goes with each of them, got "
            "pairs of any spot and sensor point. Use FilteredBackprojection (phasor fields of any pairs) or "
            "Backprojection."
        )


def refuse_legs(scan: Scan, who: str) -> None:
    """Raises ShapeError for a scan that counts the first and last leg."""
    if scan.first_and_last_leg:
        raise ShapeError(
            f"{who}: expected lengths from the spot to the sensor point, got a scan that counts the first and last leg "
            "too. Take the capture that subtract_legs(capture) gives, with its scan and axis."
        )


def not_a_capture(given: object) -> str:
    """What to do where a capture is asked for and something else came."""
    if isinstance(given, (str, os.PathLike)):
        do = " tt.nlos.Capture.read reads files."
    elif isinstance(given, Tensor):
        do = " tt.nlos.Capture(transient, axis, scan) makes one; operators such as tt.nlos.FK take tensors."
    else:
        do = ""
    return f"expected a tt.nlos.Capture, got {shown(given)}.{do}"


def checked_capture(capture: Capture, who: str) -> tuple[Tensor, TimeAxis]:
    """Transient and axis of a capture. Raises ShapeError for what is none, or has none."""
    if not isinstance(capture, Capture):
        raise ShapeError(f"{who}: {not_a_capture(capture)}")
    if capture.transient is None or capture.axis is None:
        raise ShapeError(f"{who}: expected a capture with a transient, got phasors alone.")
    return capture.transient, capture.axis


def checked_intensities(capture: Capture, time_axis: TimeAxis, who: str) -> Tensor:
    """The transient of a capture with the axis of an operator, to a millionth of a bin: edges may have been computed in
    another way. Raises ShapeError for another axis, polarized light and captures without a transient.
    """
    transient, axis = checked_capture(capture, who)
    if capture.polarized:
        raise ShapeError(f"{who}: expected a capture of intensities, got Stokes components. Give its transient[0].")
    if not _same_bins(axis, time_axis):
        raise ShapeError(f"{who}: expected a capture with {time_axis}, as the operator has, got {axis}.")
    return transient


def _same_bins(a: TimeAxis, b: TimeAxis) -> bool:
    tolerance = 1e-6 * b.bin_width_opl
    near = abs(a.start_opl - b.start_opl) <= tolerance and abs(a.end_opl - b.end_opl) <= tolerance
    return a.num_bins == b.num_bins and near


def same_light(a: Scan, b: Scan) -> bool:
    """Whether two scans measure the same: kind, points and, where they count, legs."""
    if a is b:
        return True
    if (a.kind, a.shape, a.first_and_last_leg) != (b.kind, b.shape, b.first_and_last_leg):
        return False
    pairs = zip(telling(a)[2:], telling(b)[2:], strict=True)
    return all(torch.equal(one.cpu(), other.cpu()) for one, other in pairs)


def telling(scan: Scan) -> list[Any]:
    """What tells a scan's light from that of others: kind, whether legs count, points and, where they do, origins."""
    names = ["kind", "first_and_last_leg", "sensor_points", "laser_points"]
    return [getattr(scan, name) for name in names + ["sensor_origin", "laser_origin"] * scan.first_and_last_leg]


def check_from_zero(time_axis: TimeAxis, who: str) -> None:
    """Raises UnitError for a time axis that begins before zero, by more than rounding."""
    if time_axis.start_opl < -1e-6 * time_axis.bin_width_opl:
        raise UnitError(
            f"{who}: expected a time axis from zero on, got {time_axis}: nothing is before the wall at times before "
            "zero. Leave those bins out with capture.crop, or say when the first bin begins, in metres of path."
        )
