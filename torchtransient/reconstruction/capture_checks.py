"""Checks of scans, captures and settings for operators, with the remedy in the message.

Proportions of wall, record, points and waves tell units apart: millimetres for metres and seconds for metres of path
are off by a thousand and more. Refused is a factor of ten above the largest that could mean anything, so that unusual
scans pass.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection
from typing import Any

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.checks import positive, shown, with_article
from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.reconstruction.voxels import PlanarScan, VoxelGrid

# Signal-to-noise ratios that a Wiener filter in single precision tells from none and from infinite ones.
SNR = (1e-20, 1e20)


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
    for option in options:
        if value == option:
            return option
    raise ArgumentError(f"{name}: expected one of {', '.join(map(str, options))}, got {shown(value)}.")


def checked_points(points: Any, who: str) -> Tensor:
    """Return a copy of points, float64 on the CPU, detached.

    Args:
        points: (..., 3), metres.
        who: begins the message.

    Raises:
        ShapeError: for other shapes and types.
        UnitError: for points that are not finite.
    """
    if not isinstance(points, Tensor) or points.ndim < 2 or points.shape[-1] != 3 or points.is_complex():
        raise ShapeError(f"{who}: expected a VoxelGrid or points (..., 3) as a real tensor, got {shown(points)}.")
    plain = points.detach().to("cpu", torch.float64, copy=True)
    if not bool(torch.isfinite(plain).all()):
        raise UnitError(f"{who}: expected finite points in metres, got some that are not.")
    return plain


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
    if scan.kind != "confocal":
        raise ShapeError(
            f"{who}: expected a confocal scan, got {with_article(scan.kind)} one. Take the diagonal of an exhaustive "
            "capture with capture.confocal(), bring others to midpoints with MidpointFK, or use "
            "FilteredBackprojection, which takes all."
        )
    refuse_legs(scan, who)
    return PlanarScan.of_scan(scan, who)


def refuse_pairs(scan: Scan, who: str) -> None:
    """Refuse a scan with a laser spot of its own for each sensor point.

    Args:
        scan: scan of any kind.
        who: begins the message.

    Raises:
        ShapeError: for pairs.
    """
    if scan.kind == "pairs":
        raise ShapeError(f"{who}: expected a single or an exhaustive scan, got pairs. Use FilteredBackprojection.")


def refuse_legs(scan: Scan, who: str) -> None:
    """Refuse a scan that counts the first and last leg.

    Args:
        scan: scan of any kind.
        who: begins the message.

    Raises:
        ShapeError: where legs count.
    """
    if scan.first_and_last_leg:
        raise ShapeError(
            f"{who}: expected a scan without first and last leg. Take the capture that subtract_legs(capture) gives."
        )


def checked_capture(capture: Capture, who: str) -> tuple[Tensor, TimeAxis]:
    """Return the transient and the axis of a capture.

    Args:
        capture: capture of any kind.
        who: begins the message.

    Raises:
        ShapeError: for phasors alone.
    """
    if capture.transient is None or capture.axis is None:
        raise ShapeError(f"{who}: expected a capture with a transient, got phasors alone.")
    return capture.transient, capture.axis


def checked_intensities(capture: Capture, time_axis: TimeAxis, who: str) -> Tensor:
    """Return the transient of a capture on the axis of an operator.

    Args:
        capture: capture of intensities.
        time_axis: time axis of the operator; equal to a millionth of a bin, since edges may have been computed in
            another way.
        who: begins the message.

    Raises:
        ShapeError: for another axis, polarized light and captures without a transient.
    """
    transient, axis = checked_capture(capture, who)
    if capture.polarized:
        raise ShapeError(f"{who}: expected a capture of intensities, got Stokes components. Give its transient[0].")
    off = max(abs(axis.start_opl - time_axis.start_opl), abs(axis.end_opl - time_axis.end_opl))
    if axis.num_bins != time_axis.num_bins or off > 1e-6 * time_axis.bin_width_opl:
        raise ShapeError(f"{who}: expected a capture with {time_axis}, as the operator has, got {axis}.")
    return transient


def telling(scan: Scan) -> list[Any]:
    """Return the attributes that determine the light of a scan: kind, legs, points, origins where legs count.

    Args:
        scan: scan of any kind.
    """
    names = ["kind", "first_and_last_leg", "sensor_points", "laser_points"]
    return [getattr(scan, name) for name in names + ["sensor_origin", "laser_origin"] * scan.first_and_last_leg]


def check_from_zero(time_axis: TimeAxis, who: str) -> None:
    """Check that a time axis begins at zero or later, to rounding.

    Args:
        time_axis: time axis of the transients.
        who: begins the message.

    Raises:
        UnitError: for bins before time zero.
    """
    if time_axis.start_opl < -1e-6 * time_axis.bin_width_opl:
        raise UnitError(
            f"{who}: expected a time axis from zero on, in metres of path, got {time_axis}. Use capture.crop."
        )


MOST = 10.0
_UNITS = "All lengths are metres, bins metres of optical path (TimeAxis.from_seconds takes seconds)"


def check_proportions(scan: Scan | PlanarScan, axis: TimeAxis, who: str) -> None:
    """Check that a wall and a record are of one size.

    Args:
        scan: scan with points in metres.
        axis: time axis of the record, metres of optical path.
        who: begins the message.

    Raises:
        UnitError: for a wall ten times as wide as the record is long, for one smaller than a bin, and for records that
            end far before time zero or begin thousands of walls behind it.
    """
    side, width = _width(scan), axis.bin_width_opl
    near, far = _legs(scan)
    reach, record = axis.end_opl - near, axis.end_opl - axis.start_opl
    if reach < -MOST * max(side, record):
        raise UnitError(
            f"{who}: expected a record after its legs of {near:.4g} m, got {axis}. When does the first bin begin?"
        )
    late = axis.start_opl - far > 1e3 * MOST * max(side, width)
    if side > MOST * max(reach, record) or 0 < side < width or late:
        raise UnitError(
            f"{who}: expected a wall and a record of one size, got points up to {side:.4g} m apart, bins of "
            f"{width:.4g} m and light of {axis.start_opl - far:.4g} to {reach:.4g} m of path. {_UNITS}."
        )


def check_reach(scan: Scan, points: VoxelGrid | Tensor, axis: TimeAxis, who: str, *, seen: bool = False) -> None:
    """Check that the light of hidden points arrives within ten records.

    Args:
        scan: scan with points in metres.
        points: grid, or points (..., 3), metres.
        axis: time axis of the record, metres of optical path.
        who: begins the message.
        seen: also refuse points of which no light falls into the record.

    Raises:
        UnitError: for points beyond.
    """
    corners = _corners(points) if isinstance(points, VoxelGrid) else points.reshape(-1, 3)
    low, high = corners.amin(0), corners.amax(0)
    near, far = _legs(scan)
    boxes = [(wall.amin(0), wall.amax(0)) for wall in (_plain(scan.sensor_points), _plain(scan.laser_points))]
    # Of the nearest point to the farthest one: no point of a box is nearer than the box, none farther than a corner.
    shortest = near + sum(float(torch.maximum(low - b, a - high).clamp_min(0).norm()) for a, b in boxes)
    nearest = torch.stack([torch.maximum(corners - b, a - corners).clamp_min(0).norm(dim=-1) for a, b in boxes])
    farthest = torch.stack([torch.maximum((corners - a).abs(), (corners - b).abs()).norm(dim=-1) for a, b in boxes])
    longest, last = near + float(nearest.sum(0).max()), far + float(farthest.sum(0).max())
    reach = max(axis.end_opl - near, axis.end_opl - axis.start_opl)
    beyond = longest - near > MOST * reach
    if beyond or (seen and (shortest > axis.end_opl or last < axis.start_opl)):
        begin, end = (max(0.0, x - near) / 2 for x in (axis.start_opl, axis.end_opl))
        came = f"some whose light comes after {longest:.4g}" if beyond else f"light after {shortest:.4g} to {last:.4g}"
        raise UnitError(
            f"{who}: expected points within the record, {begin:.4g} to {end:.4g} m before the wall, got {came} m of "
            f"path. {_UNITS}."
        )


def check_wavelength(wavelength: float, scan: Scan, axis: TimeAxis, who: str) -> None:
    """Check that waves are no longer than the record and ten walls, beyond which they show nothing.

    Args:
        wavelength: wavelength in metres of optical path.
        scan: scan with points in metres.
        axis: time axis of the record, metres of optical path.
        who: begins the message.

    Raises:
        UnitError: for longer waves.
    """
    record, side = axis.end_opl - axis.start_opl, _width(scan)
    most = min(record, MOST * side) if side > 0 else record
    if wavelength > most:
        raise UnitError(
            f"{who}: expected a wavelength of {most:.4g} m at most, with a record of {record:.4g} m and a wall "
            f"{side:.4g} m wide, got {wavelength:.4g} m. {_UNITS}."
        )


def check_thickness(thickness: float, scan: Scan | PlanarScan, who: str) -> None:
    """Check that a slab on the wall is at most twice as thick as the scan is wide.

    Args:
        thickness: thickness of the slab, metres.
        scan: scan with points in metres.
        who: begins the message.

    Raises:
        UnitError: for thicker ones.
    """
    side = _width(scan)
    if thickness > 2 * side:
        raise UnitError(
            f"{who}: expected a slab in metres, thinner than the scan is wide, {side:.4g} m, got {thickness:.4g} m."
        )


def check_record(axis: TimeAxis | None, end_opl: float, who: str) -> None:
    """Check that a part of a record ends at most ten records behind its beginning.

    Args:
        axis: time axis of the record, None for any.
        end_opl: end of the part, metres of optical path.
        who: begins the message.

    Raises:
        UnitError: for later ends.
    """
    if axis is not None and end_opl - axis.start_opl > MOST * (axis.end_opl - axis.start_opl):
        raise UnitError(
            f"{who}: expected lengths within the record, {axis.start_opl:.4g} to {axis.end_opl:.4g} m, got "
            f"{end_opl:.4g} m. {_UNITS}."
        )


# ------------------------------------------------------------------------------------------------------------- lengths


def _width(scan: Scan | PlanarScan) -> float:
    """Diagonal of the box around all points that are lit or seen, metres."""
    if isinstance(scan, PlanarScan):
        points = scan.points.reshape(-1, 3)
    else:
        points = torch.cat([_plain(scan.sensor_points), _plain(scan.laser_points)])
    return float((points.amax(0) - points.amin(0)).norm())


def _plain(points: Tensor) -> Tensor:
    return points.detach().to("cpu", torch.float64).reshape(-1, 3)


def _corners(grid: VoxelGrid) -> Tensor:
    """(8, 3): the outermost voxels."""
    rows, columns = ((n - 1) * pitch for n, pitch in zip(grid.size, grid.pitch, strict=True))
    places = itertools.product(grid.depths[[0, -1]], (0.0, rows), (0.0, columns))
    return torch.stack([grid.first + y * grid.along_y + x * grid.along_x + z * grid.normal for z, y, x in places])


def _legs(scan: Scan | PlanarScan) -> tuple[float, float]:
    """The shortest and the longest way from the laser and to the sensor, where they count."""
    if isinstance(scan, PlanarScan) or not scan.first_and_last_leg:
        return 0.0, 0.0
    lasers, sensors = scan.laser_legs.detach(), scan.sensor_legs.detach()
    return float(lasers.min() + sensors.min()), float(lasers.max() + sensors.max())
