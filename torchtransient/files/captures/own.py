"""Captures in the library's own layout: HDF5 (`.h5`, `.hdf5`) or NumPy's `.npz`, chosen by the file's ending.

Both hold the same names, arrays in torch's order as :class:`~torchtransient.capture.Capture` has them: `transient` (C,
T, ...) with `start_opl`, `bin_width_opl` (metres of optical path), `num_bins`; `phasor` (C, F, ...) with
`frequencies_per_metre` float64 (F,) and `phasor_start_opl`; `steady` (C, ...); polarized captures with the four Stokes
components before C. The scan is float64, in metres: `sensor_points`, `laser_points`, `sensor_origin`, `laser_origin`,
if they are known `sensor_normals` and `laser_normals`, and `sensor_legs`, `laser_legs`, the ways to the sensor and
from the laser, independent of `first_and_last_leg`, which says if they count. `kind`, `channels`, `metadata` and
`wall` are texts, the last three JSON; arrays in the wall stand beside it as `wall_0`, `wall_1`, .... Missing parts are
left out. Numbers and texts are attributes of the HDF5 file and zero-dimensional arrays of the `.npz`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchtransient.array_files.array_file import (
    array_of,
    check_target,
    damage_said,
    read_arrays,
    tensor_in,
    write_arrays,
)
from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.capture.capture import metadata_text
from torchtransient.files.plain_data import flag_of, names_of, notes_of, number_of, plain, restored, text_of, whole_of

FORMAT = "torchtransient capture 2"
# Those of the first version have no checksums.
FORMATS = ("torchtransient capture 1", FORMAT)
_WHAT = "capture file"
_MEASURED = ("transient", "phasor", "steady")
_ENTRIES = (
    "format", "metadata", "channels", "kind", "polarized", "first_and_last_leg", "start_opl", "bin_width_opl",
    "num_bins", "frequencies_per_metre", "phasor_start_opl", "wall",
)  # fmt: skip
POINTS = ("sensor_points", "laser_points", "sensor_origin", "laser_origin", "sensor_normals", "laser_normals")


def write_capture(path: str | Path, capture: Capture, metadata: Mapping[str, Any] | None = None) -> Path:
    """Write a capture in the library's own format; an existing file is replaced once the new one is complete.

    Args:
        path: place of the file, ending in .h5, .hdf5 or .npz.
        capture: gradients are not stored.
        metadata: plain data stored beside the capture's own, which takes precedence.

    Returns:
        The path.

    Raises:
        StorageError: for an unknown ending, a folder that is missing, a full disk, metadata or a wall that is not plain
            data.
    """
    target = check_target(path, _WHAT)
    note = metadata_text({**(metadata or {}), **capture.metadata}, _WHAT)
    scan = capture.scan
    entries: dict[str, Any] = {
        "format": FORMAT, "metadata": note, "channels": json.dumps(capture.channels), "kind": scan.kind,
        "polarized": int(capture.polarized), "first_and_last_leg": int(scan.first_and_last_leg),
    }  # fmt: skip
    given = {name: getattr(capture, name) for name in _MEASURED} | {name: getattr(scan, name) for name in POINTS}
    given |= {"sensor_legs": scan.sensor_legs, "laser_legs": scan.laser_legs}
    arrays = {name: array_of(tensor, _WHAT) for name, tensor in given.items() if tensor is not None}
    if capture.axis is not None:
        axis = capture.axis
        entries |= {"start_opl": axis.start_opl, "bin_width_opl": axis.bin_width_opl, "num_bins": axis.num_bins}
    if capture.frequencies is not None:
        arrays["frequencies_per_metre"] = capture.frequencies.per_metre.numpy()
        entries["phasor_start_opl"] = capture.frequencies.start_opl
    if scan.wall is not None:
        parts: list[NDArray[Any]] = []
        entries["wall"] = json.dumps(plain(scan.wall, parts, "wall"))
        arrays |= {f"wall_{number}": part for number, part in enumerate(parts)}
    write_arrays(target, arrays, entries, _WHAT)
    return target


def read_capture(path: str | Path) -> Capture:
    """Read a capture of :func:`write_capture`, bit by bit, as tensors on the CPU.

    Args:
        path: the file. Names that other programs put there are left alone.

    Raises:
        StorageError: for a file that is missing, damaged or no capture.
    """
    known = {*_MEASURED, *POINTS, *_ENTRIES}
    values = read_arrays(path, FORMATS, _WHAT, lambda name: name in known or name.startswith("wall_"))
    with damage_said(Path(path), _WHAT):
        return _capture(values)


def _capture(values: Mapping[str, Any]) -> Capture:
    def tensor(name: str) -> torch.Tensor | None:
        return tensor_in(values[name]) if name in values else None

    axis = frequencies = None
    if "num_bins" in values:
        start, width = number_of(values, "start_opl"), number_of(values, "bin_width_opl")
        axis = TimeAxis(start, width, whole_of(values, "num_bins"))
    if "frequencies_per_metre" in values:
        found = tuple(np.asarray(values["frequencies_per_metre"]).tolist())
        frequencies = FrequencyAxis(found, number_of(values, "phasor_start_opl"))
    wall = restored(json.loads(text_of(values, "wall")), values) if "wall" in values else None
    points = {name: tensor(name) for name in POINTS}
    legs = flag_of(values, "first_and_last_leg")
    scan = Scan(text_of(values, "kind"), **points, first_and_last_leg=legs, wall=wall)  # type: ignore[arg-type]
    return Capture(
        transient=tensor("transient"), axis=axis, scan=scan, metadata=notes_of(values, "metadata"),
        phasor=tensor("phasor"), frequencies=frequencies, steady=tensor("steady"),
        channels=names_of(values, "channels"), polarized=flag_of(values, "polarized"),
    )  # fmt: skip
