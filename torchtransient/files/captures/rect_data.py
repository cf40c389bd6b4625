"""Rectified grids in MATLAB files: ``rect_data`` of the light-cone transform (O'Toole et al. 2018) and of phasor-field
diffraction (Liu et al. 2020), ``meas`` of f-k migration (Lindell et al. 2019).

As MATLAB has them, axes are (x, y, t) in the data of the light-cone transform, as their reconstruction shows them, and
(y, x, t) in the others; from HDF5 they come the other way round. Lengths count from wall to wall, the direct light is
in the first bin, but in ``meas``, where the ``tofgrid`` of another file says when each point is lit. ``width`` is half
the side of a confocal scan in metres. Files with ``SPAD_index`` have one fixed point, (x, y) counted from 0 as y-tal
does, ``ts`` seconds for a bin and ``sampling_spacing`` metres between points.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.array_files.array_file import array_of
from torchtransient.capture import Capture
from torchtransient.errors import ShapeError
from torchtransient.files.captures.contents import WHAT, Contents
from torchtransient.files.captures.matlab import write_mat
from torchtransient.files.captures.reading import (
    Reading,
    flat_scan,
    grid_points,
    numbers_in,
    optional_number,
    tensor_of,
    time_axis,
)
from torchtransient.files.captures.writing import cannot, only_transient
from torchtransient.reconstruction.voxels import PlanarScan, hidden_side
from torchtransient.units import opl_to_seconds, seconds_to_opl

NAME = "rect_data"
ENDINGS = (".mat",)
_OFF_GRID = 1e-3


def recognises(contents: Contents) -> bool:
    """Return True for ``rect_data``, or ``meas`` whose last two axes are a square.

    Args:
        contents: the file.
    """
    shape = contents.shapes.get("meas")
    square = shape is not None and len(shape) == 3 and shape[1] == shape[2] != shape[0]
    return contents.shapes.get("rect_data") is not None or square


def read(contents: Contents, reading: Reading) -> Capture:
    """Return a confocal capture, or with ``SPAD_index`` a single one, on the plane z = 0 around the origin, hidden side
    +z.

    Args:
        contents: the file.
        reading: arguments of the reader, for values that the file lacks: ``bin_width_s=`` (4 ps for the data of the
            light-cone transform, 32 ps for those of f-k migration), ``wall_size=``. Origins are assumed: their
            distances do not count.

    Raises:
        StorageError: for wrong entries and missing arguments.
    """
    name = "rect_data" if "rect_data" in contents.shapes else "meas"
    data = numbers_in(contents, name, reading, 3)
    spad = contents.array("SPAD_index")
    tensor = tensor_of(data)
    tensor = tensor if name == "rect_data" and spad is None else tensor.transpose(1, 2)
    size = tensor.shape[1], tensor.shape[2]
    width, ts = _positive(contents, "width", reading), _positive(contents, "ts", reading)
    spacing = _positive(contents, "sampling_spacing", reading)
    if width is not None and spacing is not None and abs(size[1] * spacing - 2 * width) > 1.01 * spacing:
        raise reading.error(
            f"width says that the scan is {2 * width:g} m wide, sampling_spacing {size[1] * spacing:g} m. Correct one "
            "of them in the file."
        )
    # Where both are there, by a cell apart, each goes with its own layout.
    side = None if width is None else (2 * width, 2 * width)
    side = (size[1] * spacing, size[0] * spacing) if spacing is not None and (spad is not None or not side) else side
    points = grid_points(size, reading.extent(side))
    spot = None if spad is None else points[_index(spad, size, reading)]
    scan = flat_scan("confocal" if spot is None else "single", points, reading, spot)
    axis = time_axis(reading, None, None if ts is None else seconds_to_opl(ts), len(data))
    left = sorted(set(contents.shapes) - {name, "width", "ts", "sampling_spacing", "SPAD_index"})
    metadata = reading.metadata(not_read=left or None)
    return Capture(tensor[None], axis, scan, metadata=metadata)


def _positive(contents: Contents, name: str, reading: Reading) -> float | None:
    value = optional_number(contents, name, reading)
    if value is not None and not (np.isfinite(value) and value > 0):
        raise reading.error(f"expected {name} as one number above zero, got {value!r}.")
    return value


def _index(spad: NDArray[Any], size: tuple[int, int], reading: Reading) -> tuple[int, int]:
    numbers = spad.reshape(-1).tolist()
    whole = [int(n) for n in numbers if not isinstance(n, complex) and n == np.floor(n)]
    if len(numbers) != 2 or len(whole) != 2 or not (0 <= whole[0] < size[1] and 0 <= whole[1] < size[0]):
        raise reading.error(f"expected SPAD_index (x, y) below {size[::-1]}, got {numbers[:4]}.")
    return whole[1], whole[0]


def write(target: Path, capture: Capture) -> None:
    """Write a confocal capture, or a single one whose spot is a sensor point, as MATLAB 7.3.

    Args:
        target: checked path.
        capture: its axis starts at 0, lengths without the first and last leg. The place of the grid in space is lost;
            ``ts`` stands beside ``rect_data`` in both kinds.

    Raises:
        StorageError: for grids that are not regular and at right angles, confocal ones that are not square, grids that
            run the other way round (a reflection would be lost), and other lengths.
    """
    transient, scan = only_transient(capture, NAME, legs=False), capture.scan
    points = array_of(scan.sensor_points, WHAT)
    if scan.kind not in ("confocal", "single") or points.ndim != 3 or min(points.shape[:2]) < 2:
        raise cannot(NAME, "confocal and single captures of grids", repr(scan))
    assert capture.axis is not None  # a transient has one
    if capture.axis.start_opl != 0:
        raise cannot(NAME, "lengths from 0", f"an axis that starts at {capture.axis.start_opl:g} m")
    try:
        grid = PlanarScan.of(scan.sensor_points, who=NAME)
    except ShapeError:
        raise cannot(NAME, "regular grids at right angles", f"{scan!r} of other points") from None
    dy, dx = grid.pitch
    if float(hidden_side(scan, grid.normal) @ grid.normal) < 0:
        raise cannot(
            NAME, "grids whose columns, rows and hidden side are x, y and z of a right-handed frame",
            "one of which a mirror image would be read; turn over its rows, in the points and in the transient",
        )  # fmt: skip
    data = array_of(transient, WHAT)
    data = data if scan.kind == "confocal" else data.swapaxes(1, 2)
    variables: dict[str, Any] = {"rect_data": data, "ts": opl_to_seconds(capture.axis.bin_width_opl)}
    height, width = dy * points.shape[0], dx * points.shape[1]
    if scan.kind == "confocal":
        if abs(height - width) > _OFF_GRID * width:
            raise cannot(NAME, "square confocal scans", f"one of {width:.4g} x {height:.4g} m")
        variables["width"] = width / 2
    else:
        if abs(dx - dy) > _OFF_GRID * dx:
            raise cannot(NAME, "one distance between points", f"{dx:.4g} m along x and {dy:.4g} m along y")
        off = np.linalg.norm(points - array_of(scan.laser_points, WHAT), axis=-1)
        y, x = np.unravel_index(int(off.argmin()), off.shape)
        if off[y, x] > _OFF_GRID * dx:
            raise cannot(NAME, "a spot that is a sensor point", f"one {off[y, x]:.3g} m away from the nearest")
        variables |= {"sampling_spacing": dx, "SPAD_index": np.array([[x], [y]], np.float64)}
    write_mat(target, variables)
