"""Captures of the Zaragoza NLOS data set (Galindo et al. 2019, HDF5).

``data``, as HDF5 has its axes: confocal ([colours,] t, bounces, x, y), pairs ([colours,] t, bounces, x, y, laser x,
laser y); files with the attribute ``data order`` = ``row-major`` have all axes the other way round, those of positions
too. ``deltaT`` and ``t0`` are metres of optical path, from the laser's origin to the sensor's. The two axes of a grid
become the rows (y) and columns (x) of a scan; the axes of the scene that they run along follow from the positions.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchtransient.array_files.array_file import HDF5, array_of, replacing
from torchtransient.array_files.hdf5 import new_hdf5, write_parts
from torchtransient.capture import Capture
from torchtransient.checks import shown
from torchtransient.errors import StorageError
from torchtransient.files.captures.contents import WHAT, Contents
from torchtransient.files.captures.reading import (
    Reading,
    optional_number,
    real_in,
    same_points,
    scan_of,
    tensor_of,
    time_axis,
)
from torchtransient.files.captures.writing import cannot, hidden_volume, only_transient

NAME = "zaragoza"
ENDINGS = HDF5
_REQUIRED = {"data", "cameraGridPositions", "laserGridPositions", "deltaT"}
_GRID = ("Positions", "Normals", "Points", "Size")
_VOLUME = ("hiddenVolumePosition", "hiddenVolumeRotation", "hiddenVolumeSize")
_KNOWN = {
    *_REQUIRED, *_VOLUME, "t0", "t", "isConfocal", "cameraPosition", "laserPosition",
    *(f"{who}Grid{entry}" for who in ("camera", "laser") for entry in _GRID),
}  # fmt: skip
# What y-tal tells the axes of pairs by. The first is empty in all files: light of the second is off hidden things.
_BOUNCES, _OURS = 6, 1
_CONFOCAL, _PAIRS = 4, 6
# Files have six; each is read by itself, also bounces that are not stored.
_MOST_BOUNCES = 1000
_INT64 = 2**63


def recognises(contents: Contents) -> bool:
    """Return True for a file of the data set.

    Args:
        contents: the file.
    """
    return set(contents.shapes) >= _REQUIRED


def read(contents: Contents, reading: Reading) -> Capture:
    """Return the capture, colours as channels, bounces summed up. Single captures are pairs with one spot.

    Args:
        contents: the file.
        reading: arguments of the reader.

    Returns:
        The capture; ``metadata`` hold the number of ``bounces`` and ``hidden_volume``: position, rotation, size.

    Raises:
        StorageError: for wrong entries.
    """
    missing = sorted(_REQUIRED - set(contents.shapes))
    if missing:
        raise reading.error(f"expected {', '.join(missing)}, got {', '.join(contents.shapes) or 'nothing'}.")
    transient, bounces = _summed(contents, reading)
    sensor, laser = (_grid(contents, f"{who}GridPositions", reading) for who in ("camera", "laser"))
    if sensor is None or laser is None:
        raise reading.error("expected cameraGridPositions and laserGridPositions, got an empty one.")
    sensor_normals = _grid(contents, "cameraGridNormals", reading, sensor)
    laser_normals = _grid(contents, "laserGridNormals", reading, laser)
    sensor_origin = reading.origin("sensor_origin", contents.array("cameraPosition"), sensor, sensor_normals, True)
    laser_origin = reading.origin("laser_origin", contents.array("laserPosition"), laser, laser_normals, True)
    alone = transient.ndim == _CONFOCAL and same_points(sensor, laser)
    kind = "confocal" if alone else "single" if laser.size == 3 else "exhaustive"
    if kind == "single":
        transient = transient.reshape(*transient.shape[:2], *transient.shape[-2:])
        laser, laser_normals = laser.reshape(3), None if laser_normals is None else laser_normals.reshape(3)
    elif kind == "confocal":
        if not np.array_equal(sensor, laser):
            reading.assumed["laserGridPositions"] = "those of the camera"
        laser, laser_normals = sensor, sensor_normals
    elif transient.ndim == _CONFOCAL:
        raise reading.error("expected laserGridPositions one, or those of the camera: data has no laser axes.")
    scan = scan_of(kind, sensor, laser, sensor_origin, laser_origin, sensor_normals, laser_normals, legs=True)
    start, width = (optional_number(contents, name, reading) for name in ("t0", "deltaT"))
    axis = time_axis(reading, start, width, transient.shape[1])
    volume = {name: array.tolist() for name in _VOLUME if (array := contents.array(name)) is not None}
    left = sorted(set(contents.shapes) - _KNOWN)
    metadata = reading.metadata(bounces=bounces, hidden_volume=volume or None, not_read=left or None)
    return Capture(transient, axis, scan, metadata=metadata)


def _reversed(contents: Contents) -> bool:
    order = contents.attributes.get("data order", "column-major").strip().lower()
    if order not in ("row-major", "column-major"):
        raise StorageError(f"{WHAT}: expected 'data order' as row-major or column-major, got {shown(order)}.")
    return order == "row-major"


def _summed(contents: Contents, reading: Reading) -> tuple[torch.Tensor, int]:
    """Return (C, T, [Ly, Lx,] Sy, Sx), summed a bounce at a time: all of them would take several times the memory."""
    shape = contents.shapes["data"]
    if shape is None or len(shape) not in (4, 5, 6, 7):
        raise reading.error(f"expected data with 4 to 7 dimensions, got {shape}.")
    colours = len(shape) % 2  # 5 and 7 have them
    backwards = _reversed(contents)
    place = colours + 1
    low = high = 0
    bounce_axis = len(shape) - 1 - place if backwards else place
    if shape[bounce_axis] > _MOST_BOUNCES:
        raise reading.error(f"expected at most {_MOST_BOUNCES} bounces in data, got {shape[bounce_axis]} of {shape}.")
    total: NDArray[Any] | None = None
    for bounce in range(shape[bounce_axis]):
        part = contents.array("data", (slice(None),) * bounce_axis + (bounce,))
        if part is None:
            break
        if part.dtype.kind not in "iuf":
            raise reading.error(f"expected real numbers in data, got {part.dtype}.")
        # Counts of a few bits would overflow, and so would half precision.
        if part.dtype.kind == "f":
            part = part.astype(np.result_type(part, np.float32), copy=False)
        else:
            low, high = low + min(0, int(part.min())), high + max(0, int(part.max()))
            if low < -_INT64 or high >= _INT64:
                raise reading.error("expected counts whose sum over the bounces is below 2^63, got more.")
            part = part.astype(np.int64)
        if total is None:
            total = part
        else:
            with np.errstate(all="ignore"):
                total += part
    if total is None:
        raise reading.error("data is empty.")
    tensor = tensor_of(total)
    tensor = tensor.permute(*reversed(range(tensor.ndim))) if backwards else tensor
    tensor = tensor if colours else tensor.unsqueeze(0)
    # (C, T, x, y[, laser x, laser y]) with x and y in the other order, the laser first.
    tensor = tensor.permute(0, 1, 3, 2) if tensor.ndim == _CONFOCAL else tensor.permute(0, 1, 5, 4, 3, 2)
    return tensor, shape[bounce_axis]


def _grid(
    contents: Contents, name: str, reading: Reading, like: NDArray[Any] | None = None
) -> NDArray[np.float64] | None:
    """Return (Y, X, 3), from (3, X, Y), or (Y, X, 3) in files that have their axes the other way round."""
    array = real_in(contents, name, reading)
    if array is None:
        return None
    if not _reversed(contents):
        array = array.T
    if array.ndim == 1:
        array = array.reshape(1, 1, -1)
    if array.ndim != 3 or array.shape[-1] != 3:
        raise reading.error(f"expected {name} as a grid of points, got {array.shape}.")
    if like is not None and array.shape != like.shape:
        raise reading.error(f"expected {name} for each of the points {like.shape[:-1]}, got {array.shape[:-1]}.")
    return np.ascontiguousarray(array, np.float64)


# ------------------------------------------------------------------------------------------------------------- writing


def write(target: Path, capture: Capture) -> None:
    """Write a capture as the data set has them, in the order of HDF5. All light stands in the second of the bounces.

    Args:
        target: checked path.
        capture: a grid with normals, lengths with the first and last leg. Unknown numbers of the hidden volume are NaN.

    Raises:
        StorageError: for lists of points, for lengths that leave out the first and the last leg, for missing normals,
            and for parts of a capture that no foreign layout holds.
    """
    transient, scan = only_transient(capture, NAME, legs=True), capture.scan
    if scan.kind == "pairs":
        raise cannot(NAME, "single, confocal and exhaustive scans", "pairs of spots and sensor points")
    if len(scan.sensor_shape) != 2 or len(scan.laser_shape) == 1:
        raise cannot(NAME, "grids", f"lists of points {scan.sensor_shape}")
    if scan.kind == "exhaustive" and scan.laser_points.numel() == 3:
        raise cannot(NAME, "pairs with one spot as single captures", "an exhaustive one; write capture.single((0, 0))")
    if scan.sensor_normals is None or scan.laser_normals is None:
        raise cannot(NAME, "normals of all points", "none; give them to Scan.points")
    if scan.kind == "single":
        transient = transient[:, None, None]
    data = array_of(transient, WHAT)
    data = data.transpose(0, 2, 1) if scan.kind == "confocal" else data.transpose(0, 4, 3, 2, 1)
    volume = hidden_volume(capture, dict.fromkeys(_VOLUME, 3))
    with replacing(target, WHAT) as unfinished, new_hdf5(unfinished, WHAT) as file:
        shape = (1, len(data), _BOUNCES, *data.shape[1:])
        # A chunk holds one bounce, so that empty ones are never stored.
        chunks = (1, min(64, len(data)), 1, *(min(32, n) for n in data.shape[1:]))
        stored = file.create_dataset("data", shape, data.dtype, chunks=chunks, compression="gzip", compression_opts=1)
        write_parts(_Bounce(stored), data)
        for ours, theirs in (("sensor", "camera"), ("laser", "laser")):
            points, normals = getattr(scan, f"{ours}_points"), getattr(scan, f"{ours}_normals")
            grid = array_of(points, WHAT).reshape(*(points.shape[:-1] or (1, 1)), 3)
            file[f"{theirs}GridPositions"] = grid.T
            file[f"{theirs}GridNormals"] = array_of(normals, WHAT).reshape(grid.shape).T
            file[f"{theirs}GridPoints"] = np.array(grid.shape[1::-1])
            file[f"{theirs}GridSize"] = np.linalg.norm(grid[0, 0] - grid[[0, -1], [-1, 0]], axis=-1)
            file[f"{theirs}Position"] = array_of(getattr(scan, f"{ours}_origin"), WHAT)
        assert capture.axis is not None  # a transient has one
        for name, value in {
            "deltaT": capture.axis.bin_width_opl, "t0": capture.axis.start_opl, "t": capture.axis.num_bins,
            "isConfocal": np.uint8(scan.kind == "confocal"), **volume,
        }.items():  # fmt: skip
            file[name] = value


class _Bounce:
    """One bounce of a dataset that is written to, indexed by bins."""

    def __init__(self, dataset: Any) -> None:
        self._dataset = dataset

    def __setitem__(self, bins: Any, values: NDArray[Any]) -> None:
        self._dataset[0, bins, _OURS] = values
