"""Checks of scans, captures and settings for operators, with the remedy in the message.

Proportions of wall, record, points and waves tell units apart: millimetres for metres and seconds for metres of path
are off by a thousand and more. Refused is a factor of ten above the largest that could mean anything, so that unusual
scans pass.
"""

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
from torchtransient.reconstruction.voxels import PlanarScan, VoxelGrid, check_real

# Signal-to-noise ratios that a Wiener filter in single precision tells from none and from infinite ones.
SNR = (1e-20, 1e20)


def checked_precision(dtype: torch.dtype, who: str) -> torch.dtype:
    """Return a precision of tables.

    Args:
        dtype: float32 or float64.
        who: begins the message.

    Raises:
        UnitError: for other types.
    """
    if dtype not in PRECISIONS:
        raise UnitError(f"{who}: expected dtype torch.float32 or torch.float64, got {shown(dtype)}.")
    return dtype


def within(name: str, value: Any, low: float, high: float) -> float:
    """Return a number that single precision does not take for zero or infinity.

    Args:
        name: begins the message.
        value: number, any type.
        low, high: bounds, both allowed.

    Raises:
        UnitError: beyond the bounds.
    """
    number = positive(name, value)
    if not low <= number <= high:
        raise UnitError(f"{name}: expected a number from {low:g} to {high:g}, got {shown(value)}.")
    return number


def one_of(name: str, value: Any, options: Collection[Any]) -> Any:
    """Return the option that equals a value.

    Args:
        name: begins the message.
        value: text or whole number.
        options: texts or whole numbers.

    Raises:
        ArgumentError: for other values.
    """
    plain = value if isinstance(value, str) else as_whole(value)
    for option in options:
        if plain is not None and plain == option:
            return option
    raise ArgumentError(f"{name}: expected one of {', '.join(map(str, options))}, got {shown(value)}.")


def checked_axis(time_axis: TimeAxis, who: str) -> TimeAxis:
    """Return a time axis.

    Args:
        time_axis: any object.
        who: begins the message.

    Raises:
        ArgumentError: for other objects.
    """
    return of_class(f"{who}: time_axis", time_axis, TimeAxis)


def checked_scan(scan: Scan, who: str) -> Scan:
    """Return a scan.

    Args:
        scan: any object.
        who: begins the message.

    Raises:
        ShapeError: for other objects.
    """
    return of_class(f"{who}: scan", scan, Scan, error=ShapeError)


def checked_points(points: Any, who: str) -> Tensor:
    """Return a copy of points, float64 on the CPU, detached.

    Args:
        points: (..., 3), metres.
        who: begins the message.

    Raises:
        ShapeError: for other shapes and types.
        UnitError: for points that are not finite.
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
    """Check that powers of distances are within the range of a precision.

    Args:
        falloff: the power.
        nearest, farthest: products of two distances, m^2.
        dtype: of the tables.
        who: begins the message.

    Raises:
        UnitError: beyond 0.8 of the exponents of ``dtype``.
    """
    most = abs(falloff) * max(abs(math.log10(nearest)), abs(math.log10(max(farthest, nearest))))
    if most > 0.8 * math.log10(torch.finfo(dtype).max):
        raise UnitError(
            f"{who}: expected a falloff whose factors {dtype} holds, got {falloff:g} at distances whose products are "
            f"{nearest:.3g} to {farthest:.3g} m^2. Light falls with powers of 0 to 4."
        )


def confocal_wall(scan: Scan | PlanarScan, who: str) -> PlanarScan:
    """Return the grid of a confocal scan of a flat wall that counts no legs.

    Args:
        scan: a scan, or a grid that is returned as it is.
        who: begins the message.

    Raises:
        ShapeError: for other scans.
    """
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
    """Refuse a scan with a laser spot of its own for each sensor point.

    Args:
        scan: of any kind.
        who: begins the message.

    Raises:
        ShapeError: for pairs.
    """
    if scan.kind == "pairs":
        raise ShapeError(
            f"{who}: expected a spot that stands still, follows the sensor points, or goes with each of them, got "
            "pairs of any spot and sensor point. Use FilteredBackprojection (phasor fields of any pairs) or "
            "Backprojection."
        )


def refuse_legs(scan: Scan, who: str) -> None:
    """Refuse a scan that counts the first and last leg.

    Args:
        scan: of any kind.
        who: begins the message.

    Raises:
        ShapeError: where legs count.
    """
    if scan.first_and_last_leg:
        raise ShapeError(
            f"{who}: expected lengths from the spot to the sensor point, got a scan that counts the first and last leg "
            "too. Take the capture that subtract_legs(capture) gives, with its scan and axis."
        )


def not_a_capture(given: object) -> str:
    """Return the end of a message about an object that is no capture, with the remedy.

    Args:
        given: the object.
    """
    if isinstance(given, (str, os.PathLike)):
        do = " tt.nlos.Capture.read reads files."
    elif isinstance(given, Tensor):
        do = " tt.nlos.Capture(transient, axis, scan) makes one; operators such as tt.nlos.FK take tensors."
    else:
        do = ""
    return f"expected a tt.nlos.Capture, got {shown(given)}.{do}"


def checked_capture(capture: Capture, who: str) -> tuple[Tensor, TimeAxis]:
    """Return the transient and the axis of a capture.

    Args:
        capture: any object.
        who: begins the message.

    Raises:
        ShapeError: for other objects, and for phasors alone.
    """
    if not isinstance(capture, Capture):
        raise ShapeError(f"{who}: {not_a_capture(capture)}")
    if capture.transient is None or capture.axis is None:
        raise ShapeError(f"{who}: expected a capture with a transient, got phasors alone.")
    return capture.transient, capture.axis


def checked_intensities(capture: Capture, time_axis: TimeAxis, who: str) -> Tensor:
    """Return the transient of a capture on the axis of an operator.

    Args:
        capture: of intensities.
        time_axis: of the operator; equal to a millionth of a bin, since edges may have been computed in another way.
        who: begins the message.

    Raises:
        ShapeError: for another axis, polarized light and captures without a transient.
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
    """Return True for scans that measure the same light: equal kind, points and, where they count, legs.

    Args:
        a, b: the scans.
    """
    if a is b:
        return True
    if (a.kind, a.shape, a.first_and_last_leg) != (b.kind, b.shape, b.first_and_last_leg):
        return False
    pairs = zip(telling(a)[2:], telling(b)[2:], strict=True)
    return all(torch.equal(one.cpu(), other.cpu()) for one, other in pairs)


def telling(scan: Scan) -> list[Any]:
    """Return the attributes that tell a scan's light from that of others: kind, legs, points, origins where legs count.

    Args:
        scan: of any kind.
    """
    names = ["kind", "first_and_last_leg", "sensor_points", "laser_points"]
    return [getattr(scan, name) for name in names + ["sensor_origin", "laser_origin"] * scan.first_and_last_leg]


def check_from_zero(time_axis: TimeAxis, who: str) -> None:
    """Check that a time axis begins at zero or later, to rounding.

    Args:
        time_axis: of the transients.
        who: begins the message.

    Raises:
        UnitError: for bins before time zero.
    """
    if time_axis.start_opl < -1e-6 * time_axis.bin_width_opl:
        raise UnitError(
            f"{who}: expected a time axis from zero on, got {time_axis}: nothing is before the wall at times before "
            "zero. Leave those bins out with capture.crop, or say when the first bin begins, in metres of path."
        )


MOST = 10.0
_LENGTHS = "All lengths are in metres: millimetres are a thousandth of one"
_BINS = "bins are metres of optical path: TimeAxis.from_seconds takes seconds, and 16 ps are 16e-12 s"


def check_proportions(scan: Scan | PlanarScan, axis: TimeAxis, who: str) -> None:
    """Check that a wall and a record are of one size.

    Args:
        scan: with points in metres.
        axis: metres of optical path.
        who: begins the message.

    Raises:
        UnitError: for a wall ten times as wide as the record is long, for one smaller than a bin, and for records that
            end far before time zero or begin thousands of walls behind it.
    """
    low, high = _box(_scanned(scan))
    side = float((high - low).norm())
    near, far = _legs(scan)
    reach, record = axis.end_opl - near, axis.end_opl - axis.start_opl
    if reach < -MOST * max(side, record):
        raise UnitError(
            f"{who}: expected a record that goes on after time zero and its legs, got {axis} with legs of {near:.4g} "
            "m. When does the first bin begin?"
        )
    if side > MOST * max(reach, record):
        raise UnitError(
            f"{who}: expected a wall and a record of one size, got points up to {side:.4g} m apart and light of "
            f"{reach:.4g} m of path at most. {_LENGTHS}; {_BINS}."
        )
    if 0 < side < axis.bin_width_opl:
        raise UnitError(
            f"{who}: expected bins that are shorter than the wall is wide, got points {side:.4g} m apart at most and "
            f"bins of {axis.bin_width_opl:.4g} m. {_LENGTHS}; {_BINS}."
        )
    if axis.start_opl - far > 1e3 * MOST * max(side, axis.bin_width_opl):
        raise UnitError(
            f"{who}: expected a record of things near the wall, got one that begins at {axis.start_opl:.4g} m of path "
            f"for points {side:.4g} m apart at most. {_LENGTHS}; {_BINS}."
        )


def check_reach(scan: Scan, points: VoxelGrid | Tensor, axis: TimeAxis, who: str, *, seen: bool = False) -> None:
    """Check that the light of hidden points arrives within ten records.

    Args:
        scan: with points in metres.
        points: grid, or points (..., 3), metres.
        axis: metres of optical path.
        who: begins the message.
        seen: refuse points as well that the record has none of.

    Raises:
        UnitError: for points beyond.
    """
    corners = _corners(points) if isinstance(points, VoxelGrid) else points.reshape(-1, 3)
    lengths = [_lengths(scan, corners, side) for side in ("nearest", "farthest")]
    near, far = _legs(scan)
    # Of the nearest point to the farthest one: no point of a box is nearer than the box, none farther than a corner.
    first, last = _between_boxes(scan, corners) + near, float(lengths[1].max()) + far
    longest = float(lengths[0].max()) + near
    reach = max(axis.end_opl - near, axis.end_opl - axis.start_opl)
    begin, end = (max(0.0, x - near) / 2 for x in (axis.start_opl, axis.end_opl))
    expected = f"expected points within the record, {begin:.4g} to {end:.4g} m before the wall"
    if longest - near > MOST * reach:
        raise UnitError(
            f"{who}: {expected}, got some whose light comes after {longest:.4g} m of path. {_LENGTHS}; {_BINS}."
        )
    if seen and (first > axis.end_opl or last < axis.start_opl):
        raise UnitError(
            f"{who}: {expected}, got none: their light comes after {first:.4g} to {last:.4g} m of path. {_LENGTHS}."
        )


def check_wavelength(wavelength: float, scan: Scan, axis: TimeAxis, who: str) -> None:
    """Check that waves are no longer than the record and ten walls, beyond which they show nothing.

    Args:
        wavelength: metres of optical path.
        scan: with points in metres.
        axis: metres of optical path.
        who: begins the message.

    Raises:
        UnitError: for longer waves.
    """
    low, high = _box(_scanned(scan))
    record, side = axis.end_opl - axis.start_opl, float((high - low).norm())
    most = min(record, MOST * side) if side > 0 else record
    if wavelength > most:
        raise UnitError(
            f"{who}: expected a wavelength of {most:.4g} m at most, with a record of {record:.4g} m and a wall "
            f"{side:.4g} m wide, got {wavelength:.4g} m. {_LENGTHS}."
        )


def check_thickness(thickness: float, scan: Scan | PlanarScan, who: str) -> None:
    """Check that a slab on the wall is at most twice as thick as the scan is wide.

    Args:
        thickness: metres.
        scan: with points in metres.
        who: begins the message.

    Raises:
        UnitError: for thicker ones.
    """
    low, high = _box(_scanned(scan))
    side = float((high - low).norm())
    if thickness > 2 * side:
        raise UnitError(
            f"{who}: expected a slab that is thinner than the scan is wide, {side:.4g} m, got {thickness:.4g} m. "
            f"{_LENGTHS}, centimetres a hundredth."
        )


def check_record(axis: TimeAxis | None, end_opl: float, who: str) -> None:
    """Check that a part of a record ends at most ten records behind its beginning.

    Args:
        axis: of the record, None for any.
        end_opl: end of the part, metres of optical path.
        who: begins the message.

    Raises:
        UnitError: for later ends.
    """
    if axis is not None and end_opl - axis.start_opl > MOST * (axis.end_opl - axis.start_opl):
        raise UnitError(
            f"{who}: expected lengths within the record, {axis.start_opl:.4g} to {axis.end_opl:.4g} m, got "
            f"{end_opl:.4g} m. {_LENGTHS}."
        )


# ------------------------------------------------------------------------------------------------------------- lengths


def _scanned(scan: Scan | PlanarScan) -> Tensor:
    """(N, 3) float64: all points that are lit or seen."""
    if isinstance(scan, PlanarScan):
        return scan.points.reshape(-1, 3)
    return torch.cat([_plain(scan.sensor_points), _plain(scan.laser_points)])


def _plain(points: Tensor) -> Tensor:
    return points.detach().to("cpu", torch.float64).reshape(-1, 3)


def _box(points: Tensor) -> tuple[Tensor, Tensor]:
    return points.amin(0), points.amax(0)


def _corners(grid: VoxelGrid) -> Tensor:
    """(8, 3): the outermost voxels."""
    rows, columns = grid.size
    found = []
    for depth in (grid.depths[0], grid.depths[-1]):
        for y in (0.0, (rows - 1) * grid.pitch[0]):
            for x in (0.0, (columns - 1) * grid.pitch[1]):
                found.append(grid.first + y * grid.along_y + x * grid.along_x + depth * grid.normal)
    return torch.stack(found)


def _legs(scan: Scan | PlanarScan) -> tuple[float, float]:
    """The shortest and the longest way from the laser and to the sensor, where they count."""
    if isinstance(scan, PlanarScan) or not scan.first_and_last_leg:
        return 0.0, 0.0
    lasers, sensors = scan.laser_legs.detach(), scan.sensor_legs.detach()
    return float(lasers.min() + sensors.min()), float(lasers.max() + sensors.max())


def _lengths(scan: Scan, points: Tensor, side: str) -> Tensor:
    """(N,) float64: bounds of the way from a lit point to each hidden one and on to a seen one."""
    total = torch.zeros(len(points), dtype=torch.float64, device="cpu")
    for wall in (scan.sensor_points, scan.laser_points):
        low, high = _box(_plain(wall))
        off = torch.maximum(points - high, low - points).clamp_min(0)
        if side == "farthest":
            off = torch.maximum((points - low).abs(), (points - high).abs())
        total += off.norm(dim=-1)
    return total


def _between_boxes(scan: Scan, points: Tensor) -> float:
    low, high = _box(points)
    total = 0.0
    for wall in (scan.sensor_points, scan.laser_points):
        first, last = _box(_plain(wall))
        total += float(torch.maximum(low - last, first - high).clamp_min(0).norm())
    return total
