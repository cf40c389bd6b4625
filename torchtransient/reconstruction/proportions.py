"""Whether a scan, a record, points and wavelengths are of one size, or one of them is in another unit.

Millimetres for metres and seconds for metres of path are off by a thousand and more. What is refused here is off by ten
and more from the largest that could mean anything, so that unusual scans pass.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.capture import Scan
from torchtransient.errors import UnitError
from torchtransient.reconstruction.planar_scan import PlanarScan
from torchtransient.reconstruction.voxels import VoxelGrid

MOST = 10.0
_LENGTHS = "All lengths are in metres: millimetres are a thousandth of one"
_BINS = "bins are metres of optical path: TimeAxis.from_seconds takes seconds, and 16 ps are 16e-12 s"


def check_proportions(scan: Scan | PlanarScan, axis: TimeAxis, who: str) -> None:
    """Raises UnitError for a wall that is ten times as wide as the record is long, for one that is smaller than a bin,
    and for records that end far before time zero or begin thousands of walls behind it.
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
    """Raises UnitError for hidden points whose light takes ten times as long as the record lasts; with ``seen`` also
    where the record has none of them.
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
    """Raises UnitError for waves that are longer than the record, or than ten walls: nothing is seen by them."""
    low, high = _box(_scanned(scan))
    record, side = axis.end_opl - axis.start_opl, float((high - low).norm())
    most = min(record, MOST * side) if side > 0 else record
    if wavelength > most:
        raise UnitError(
            f"{who}: expected a wavelength of {most:.4g} m at most, with a record of {record:.4g} m and a wall "
            f"{side:.4g} m wide, got {wavelength:.4g} m. {_LENGTHS}."
        )


def check_thickness(thickness: float, scan: Scan | PlanarScan, who: str) -> None:
    """Raises UnitError for a slab on the wall that is twice as thick as the scan is wide."""
    low, high = _box(_scanned(scan))
    side = float((high - low).norm())
    if thickness > 2 * side:
        raise UnitError(
            f"{who}: expected a slab that is thinner than the scan is wide, {side:.4g} m, got {thickness:.4g} m. "
            f"{_LENGTHS}, centimetres a hundredth."
        )


def check_record(axis: TimeAxis | None, end_opl: float, who: str) -> None:
    """Raises UnitError for a part of a record that ends ten records behind it."""
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
