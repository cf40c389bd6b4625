"""Captures of the phasor-field data (Liu et al. 2019, MATLAB): a structure ``dataset``.

In the order of HDF5: ``data`` (t, camera points, laser points), ``laserPos``, ``cameraPos`` (3, N), ``laserNorm``,
``cameraNorm`` (3, N) or (3, 1), ``laserOrigin``, ``cameraOrigin``; ``t`` the number of bins, ``deltat`` and ``t0`` in
metres of optical path, from the laser's origin to the camera's. One camera point and many laser points are the same by
reciprocity as one laser spot and many sensor points, which is what the capture says, as y-tal does; the cosines at the
two points of the wall, and the origins, change places with them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.array_files.array_file import array_of
from torchtransient.capture import Capture
from torchtransient.files.captures.contents import WHAT, Contents
from torchtransient.files.captures.matlab import write_mat
from torchtransient.files.captures.reading import (
    Reading,
    numbers_in,
    optional_number,
    real_in,
    scan_of,
    tensor_of,
    time_axis,
)
from torchtransient.files.captures.writing import cannot, hidden_volume, only_transient

NAME = "phasor_field"
ENDINGS = (".mat",)
_VOLUME = {"minimalpos": 3, "maximalpos": 3, "sampling_grid_spacing": 1}
_REQUIRED = {"data", "laserPos", "cameraPos", "deltat"}
_FIELDS = {*_REQUIRED, "laserNorm", "cameraNorm", "laserOrigin", "cameraOrigin", "t", "t0"}


def recognises(contents: Contents) -> bool:
    """Return True for a file of this layout.

    Args:
        contents: the file.
    """
    return "dataset" in contents.shapes and contents.fields("dataset") >= _REQUIRED


def read(contents: Contents, reading: Reading) -> Capture:
    """Return a single capture of a list of points, or all pairs of two lists.

    Args:
        contents: the file.
        reading: arguments of the reader.

    Returns:
        The capture; ``metadata["reciprocal"]`` is True if camera and laser have changed places, ``hidden_volume`` has
        corners and spacing.

    Raises:
        StorageError: for wrong entries.
    """
    data = numbers_in(contents, "dataset/data", reading, 3)
    points = {who: _points(contents, f"{who}Pos", reading) for who in ("camera", "laser")}
    normals = {who: _normals(contents, f"{who}Norm", points[who], reading) for who in points}
    bins = _number(contents, "t", reading)
    if bins not in (None, len(data)):
        raise reading.error(f"dataset.t says {bins:g} bins, dataset.data {data.shape} has {len(data)}.")
    reciprocal = data.shape[1] == 1
    sensor, laser = ("laser", "camera") if reciprocal else ("camera", "laser")
    sensor_origin, laser_origin = (
        reading.origin(f"{ours}_origin", _field(contents, f"{who}Origin", reading), points[who], normals[who], True)
        for ours, who in (("sensor", sensor), ("laser", laser))
    )
    spots, spot_normals = points[laser], normals[laser]
    if reciprocal:
        spots, spot_normals = spots.reshape(3), None if spot_normals is None else spot_normals.reshape(3)
    kind = "single" if reciprocal else "exhaustive"
    scan = scan_of(kind, points[sensor], spots, sensor_origin, laser_origin, normals[sensor], spot_normals, legs=True)
    tensor = tensor_of(data)
    tensor = tensor[:, 0] if reciprocal else tensor.transpose(1, 2)
    axis = time_axis(reading, _number(contents, "t0", reading), _number(contents, "deltat", reading), len(data))
    volume = {name: array.reshape(-1).tolist() for name in _VOLUME if (array := contents.array(name)) is not None}
    fields = {f"dataset/{name}" for name in contents.fields("dataset") - _FIELDS}
    left = sorted(fields | set(contents.shapes) - {"dataset", *_VOLUME})
    metadata = reading.metadata(reciprocal=reciprocal, hidden_volume=volume or None, not_read=left or None)
    return Capture(tensor[None], axis, scan, metadata=metadata)


def _field(contents: Contents, name: str, reading: Reading) -> NDArray[Any] | None:
    return real_in(contents, f"dataset/{name}", reading) if name in contents.fields("dataset") else None


def _points(contents: Contents, name: str, reading: Reading) -> NDArray[np.float64]:
    array = _field(contents, name, reading)
    if array is None or array.ndim != 2 or 3 not in array.shape:
        raise reading.error(f"expected dataset.{name} (3, N), got {None if array is None else array.shape}.")
    return np.ascontiguousarray(array.T if array.shape[0] == 3 else array, np.float64)


def _normals(contents: Contents, name: str, points: NDArray[Any], reading: Reading) -> NDArray[np.float64] | None:
    if name not in contents.fields("dataset"):
        return None
    found = _points(contents, name, reading)
    if found.shape not in (points.shape, (1, 3)):
        raise reading.error(
            f"expected dataset.{name} one, or for each of the points {points.shape}, got {found.shape}."
        )
    return np.ascontiguousarray(np.broadcast_to(found, points.shape))


def _number(contents: Contents, name: str, reading: Reading) -> float | None:
    return optional_number(contents, f"dataset/{name}", reading) if name in contents.fields("dataset") else None


def write(target: Path, capture: Capture) -> None:
    """Write a single or exhaustive capture as MATLAB 7.3. Grids become lists, row after row.

    Args:
        target: checked path.
        capture: a single one is written as the data has it: sensor points as those of the laser, the spot as the
            camera's.

    Raises:
        StorageError: for confocal captures, for lengths that leave out the first and the last leg, for missing normals.
    """
    transient, scan = only_transient(capture, NAME, legs=True), capture.scan
    if scan.kind in ("confocal", "pairs"):
        raise cannot(NAME, "single captures and all pairs", repr(scan))
    if scan.kind == "exhaustive" and scan.sensor_points.numel() == 3:
        raise cannot(NAME, "pairs with one sensor point as single captures, laser and camera exchanged", "such pairs")
    if scan.sensor_normals is None or scan.laser_normals is None:
        raise cannot(NAME, "normals of all points", "none; give them to Scan.points")
    single = scan.kind == "single"
    names = ("camera", "laser") if not single else ("laser", "camera")
    data = array_of(transient, WHAT).reshape(len(transient), -1, scan.sensor_points[..., 0].numel())
    assert capture.axis is not None  # a transient has one
    dataset: dict[str, Any] = {
        "data": data if single else data.swapaxes(1, 2), "deltat": capture.axis.bin_width_opl,
        "t0": capture.axis.start_opl, "t": float(capture.axis.num_bins),
    }  # fmt: skip
    for ours, theirs in zip(("sensor", "laser"), names, strict=True):
        dataset[f"{theirs}Pos"] = array_of(getattr(scan, f"{ours}_points"), WHAT).reshape(-1, 3).T
        dataset[f"{theirs}Norm"] = array_of(getattr(scan, f"{ours}_normals"), WHAT).reshape(-1, 3).T
        dataset[f"{theirs}Origin"] = array_of(getattr(scan, f"{ours}_origin"), WHAT).reshape(3, 1)
    volume = {name: array.reshape(-1, 1) for name, array in hidden_volume(capture, _VOLUME).items()}
    write_mat(target, {"dataset": dataset, **volume})
