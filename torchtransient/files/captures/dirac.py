"""NLOS Dirac captures: confocal grids on the wall z = 0 (HDF5, a layout that y-tal calls deprecated).

``data_t`` (T, X, Y), ``xg`` and ``yg`` (X, Y) in metres, ``xa`` (X,), ``ya`` (Y,), ``da`` (T,), the optical path in
metres at which each bin starts. ``offset_laser`` and ``offset_camera``: the legs that were taken off all lengths; if
the laser's is zero, they count. The places of sensor and laser are not stored.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from torchtransient.array_files.array_file import HDF5, array_of, replacing
from torchtransient.array_files.hdf5 import new_hdf5, write_parts
from torchtransient.capture import Capture
from torchtransient.files.captures.contents import WHAT, Contents
from torchtransient.files.captures.reading import Reading, numbers_in, scan_of, tensor_of, time_axis
from torchtransient.files.captures.writing import cannot, only_transient
from torchtransient.reconstruction.voxels import hidden_side

NAME = "dirac"
ENDINGS = HDF5
_REQUIRED = {"data_t", "xg", "yg", "da", "offset_laser"}
_KEPT = ("offset_laser", "offset_camera", "sample_x", "sample_y")
_KNOWN = {*_REQUIRED, *_KEPT, "xa", "ya"}
# Bins are equal to what single precision makes of their starts.
_UNEVEN = 1e-3


def recognises(contents: Contents) -> bool:
    """Return True for a file of this layout.

    Args:
        contents: the file.
    """
    return set(contents.shapes) >= _REQUIRED


def read(contents: Contents, reading: Reading) -> Capture:
    """Return the confocal capture.

    Args:
        contents: the file.
        reading: arguments of the reader; if the legs count, ``sensor_origin=`` and ``laser_origin=`` are needed.

    Raises:
        StorageError: for wrong entries, uneven bins, and missing arguments.
    """
    data, da = numbers_in(contents, "data_t", reading, 3), numbers_in(contents, "da", reading).reshape(-1)
    x, y = numbers_in(contents, "xg", reading, 2), numbers_in(contents, "yg", reading, 2)
    if x.shape != data.shape[1:] or y.shape != data.shape[1:] or len(da) != len(data) or len(da) < 2:
        raise reading.error(
            f"expected data_t (T, X, Y), xg and yg (X, Y), da (T,) with T of 2 or more, got {data.shape}, {x.shape}, "
            f"{y.shape}, {da.shape}."
        )
    starts = da.astype(np.float64)
    with np.errstate(all="ignore"):
        steps = np.diff(starts)
        width = float(starts[-1] - starts[0]) / (len(da) - 1)
        even = np.all(np.abs(steps - width) <= _UNEVEN * abs(width))
    if not even:
        raise reading.error(f"expected equal steps in da, got {steps.min():.6g} to {steps.max():.6g} m.")
    points = np.stack(np.broadcast_arrays(x.T, y.T, 0.0), -1).astype(np.float64)
    normals = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    legs = not np.any(numbers_in(contents, "offset_laser", reading))
    sensor_origin, laser_origin = (
        reading.origin(f"{who}_origin", None, points, normals, legs) for who in ("sensor", "laser")
    )
    scan = scan_of("confocal", points, points, sensor_origin, laser_origin, normals, normals, legs=legs)
    kept = {name: array.tolist() for name in _KEPT if (array := contents.array(name)) is not None}
    axis = time_axis(reading, float(da[0]), width, len(da))
    left = sorted(set(contents.shapes) - _KNOWN)
    metadata = reading.metadata(**kept, not_read=left or None)
    return Capture(tensor_of(data).transpose(1, 2)[None], axis, scan, metadata=metadata)


def write(target: Path, capture: Capture) -> None:
    """Write a confocal capture of a grid along x and y on the wall z = 0, hidden side +z, of two bins or more.

    Args:
        target: checked path.
        capture: if its legs do not count, their lengths stand in the offsets. Origins are lost; :func:`read` asks for
            them if they count.

    Raises:
        StorageError: for other captures.
    """
    transient, scan = only_transient(capture, NAME), capture.scan
    points = array_of(scan.sensor_points, WHAT)
    x, y = points[..., 0], points[..., 1]
    if (
        scan.kind != "confocal"
        or points.ndim != 3
        or np.any(points[..., 2])
        or np.any(x != x[:1])
        or np.any(y != y[:, :1])
    ):
        raise cannot(NAME, "confocal grids along x and y on the wall z = 0", repr(scan))
    if float(hidden_side(scan, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))[2]) < 0:
        raise cannot(NAME, "scans whose hidden side is that of +z", "one of -z, of which a mirror image would be read")
    assert capture.axis is not None  # a transient has one
    if capture.axis.num_bins < 2:
        raise cannot(NAME, "two bins or more, whose starts say how wide they are", "one")
    legs = scan.first_and_last_leg
    laser, sensor = array_of(scan.laser_legs, WHAT), array_of(scan.sensor_legs, WHAT)
    data = array_of(transient, WHAT).transpose(0, 2, 1)
    with replacing(target, WHAT) as unfinished, new_hdf5(unfinished, WHAT) as file:
        write_parts(file.create_dataset("data_t", data.shape, data.dtype), data)
        for name, value in {
            "xg": x.T, "yg": y.T, "xa": x[0], "ya": y[:, 0], "da": capture.axis.edges_opl[:-1].numpy(),
            "offset_laser": np.zeros((1, 1)) if legs else np.full((1, 1), laser.mean()),
            "offset_camera": np.zeros(sensor.T.shape) if legs else sensor.T,
            "sample_x": np.nan, "sample_y": np.nan,
        }.items():  # fmt: skip
            file[name] = value
