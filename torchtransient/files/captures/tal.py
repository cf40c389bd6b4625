"""Captures of y-tal 0.20 and 0.21 (Royo et al., "TAL", HDF5): read, and written so that y-tal reads them.

``H`` is (T, Sx, Sy), (T, Lx, Ly, Sx, Sy), (T, Si) or (T, Li, Si), in the frequency domain with F in place of T;
polarized ones have four Stokes components behind. Grids are (X, Y, 3), with x first: here rows run along y, so that all
of these axes change places, as views. ``delta_t`` and ``t_start`` are metres of optical path, ``scene_info`` is YAML,
which y-tal executes and this reader does not. What is missing is HDF5's empty dataset.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchtransient.array_files.array_file import HDF5, array_of, replacing
from torchtransient.array_files.hdf5 import hdf5_package, new_hdf5, write_parts
from torchtransient.array_files.plain_texts import read_plain_yaml, write_plain_yaml
from torchtransient.axes import FrequencyAxis
from torchtransient.capture import Capture, Scan
from torchtransient.errors import StorageError
from torchtransient.files.captures.contents import WHAT, Contents
from torchtransient.files.captures.reading import (
    Reading,
    frequency_axis,
    optional_number,
    real_in,
    same_points,
    scan_of,
    tensor_of,
    time_axis,
)
from torchtransient.files.captures.writing import assumed_in, cannot, one_channel
from torchtransient.files.plain_data import flag_of, plain, restored, whole_of
from torchtransient.plugins.films.transform_bins import transform_bins

Kind = TypeVar("Kind", int, bool)

NAME = "tal"
ENDINGS = HDF5
_STOKES = 4
_LEGS = "t_accounts_first_and_last_bounces"
# Numbers whose kinds a file that is written of a capture has again.
_NUMBERS_OF_FILES = {f"{who}_{what}" for who in ("sensor", "laser") for what in ("xyz", "grid_xyz", "grid_normals")} | {
    "t_start",
    "delta_t",
}
_FORMATS_OF_FILES = ("H_format", "sensor_grid_format", "laser_grid_format", "volume_format")
_KNOWN = {*_NUMBERS_OF_FILES, *_FORMATS_OF_FILES, "H", _LEGS, "scene_info"}
_GRIDS = {"UNKNOWN": 0, "N_3": 1, "X_Y_3": 2}
_VOLUMES = {"UNKNOWN": 0, "N_3": 1, "X_Y_Z_3": 2, "X_Y_3": 3}
# Our part of the information: a JSON text, in which numbers keep every digit.
_OWN = "torchtransient"
# What metadata hold after reading; other entries were added since.
_READ = {"format", "assumed", "scene_info", "tal", "not_read"}
# Kinds of numbers as NumPy writes them.
_DTYPE = re.compile(r"\|b1|[<>|=]([iu][1248]|f(2|4|8|16)|c(8|16))")


# Numbers of the formats of ``H``. A name has a part for each dimension: times or frequencies, then x and y of grids or
# i of lists, those of the laser before those of the sensor.
_NUMBERS = {
    "UNKNOWN": 0, "T_Sx_Sy": 1, "T_Lx_Ly_Sx_Sy": 2, "T_Si": 3, "T_Li_Si": 4,
    "F_Sx_Sy": 10, "F_Lx_Ly_Sx_Sy": 11, "F_Si": 12, "F_Li_Si": 13,
}  # fmt: skip


def recognises(contents: Contents) -> bool:
    """Return True for a file of y-tal.

    Args:
        contents: the file.
    """
    return {"H", "H_format", "sensor_grid_xyz"} <= set(contents.shapes)


# ------------------------------------------------------------------------------------------------------------- reading


def read(contents: Contents, reading: Reading) -> Capture:
    """Return the capture of a file of y-tal.

    Args:
        contents: the file.
        reading: arguments of the reader. Missing origins are assumed if their distance does not count.

    Returns:
        The capture; ``metadata`` holds ``scene_info`` as plain data, and under ``tal`` the settings with which a file
        that is written from it is the same again. Laser points of ``T_Si`` and ``T_Sx_Sy`` are one (single), those of
        the sensor (confocal), or as many elsewhere (pairs).

    Raises:
        StorageError: for other files, wrong entries and missing arguments.
    """
    number = _one(contents, "H_format", whole_of)
    form = next((name for name, known in _NUMBERS.items() if known == number), "UNKNOWN")
    if form == "UNKNOWN":
        raise reading.error(f"expected H_format to be one of the numbers {list(_NUMBERS.values())[1:]}, got {number}.")
    measured = _measured(contents, reading, form)
    kept: dict[str, Any] = {"dtypes": {"H": measured.dtype.str}}
    for name in _NUMBERS_OF_FILES:
        if (array := contents.array(name)) is not None:
            kept["dtypes"][name] = array.dtype.str
    text = contents.text("scene_info")
    info = None if text is None else _scene_info(text)
    own = _own_part(info)
    legs = reading.fill(_LEGS, _one(contents, _LEGS, flag_of), False)
    scan = _scan(contents, reading, form, legs)
    polarized = measured.ndim > _dims(form)
    start, width = optional_number(contents, "t_start", reading), optional_number(contents, "delta_t", reading)
    settings: dict[str, Any] = {"scan": scan, "polarized": polarized}
    tensor = _swapped(tensor_of(measured), form)
    tensor = tensor.movedim(-1, 0).unsqueeze(1) if polarized else tensor.unsqueeze(0)
    if form.startswith("F"):
        found = _frequencies(info, own, len(measured), start)
        axis = frequency_axis(reading, found)
        if start is not None and axis.start_opl != start:
            raise reading.error(
                f"t_start says that phases count from {start!r} m, the frequencies from {axis.start_opl!r} m. Give "
                f"frequencies=FrequencyAxis(..., start_opl={start!r})."
            )
        settings |= {"transient": None, "axis": None, "phasor": tensor, "frequencies": axis}
        kept |= {"delta_t": width}
    else:
        settings |= {"transient": tensor, "axis": time_axis(reading, start, width, len(measured))}
    left = sorted(set(contents.shapes) - _KNOWN)
    if own is not None:
        return Capture(**(settings | _of_ours(own, scan, reading.assumed, left)))
    kept |= {"scene_info_text": text, "volume_format": _one(contents, "volume_format", whole_of)}
    return Capture(**settings, metadata=reading.metadata(scene_info=info, tal=kept, not_read=left or None))


def _of_ours(own: Mapping[str, Any], scan: Scan, assumed: Mapping[str, Any], left: list[str]) -> dict[str, Any]:
    """Return parts of a capture that this library has written into ``scene_info``.

    ``assumed`` and ``left`` name what another program has taken out, or put in, since.
    """
    metadata, steady = dict(own.get("metadata") or {}), own["steady"]
    if steady is not None and np.shape(steady)[-len(scan.shape) :] != scan.shape:
        # Another program has cut or thinned the points out since.
        left, steady = [*left, "steady"], None
    if assumed:
        metadata["assumed"] = {**(metadata.get("assumed") or {}), **assumed}
    if left:
        metadata["not_read"] = left
    return {
        "scan": replace(scan, wall=own["wall"]), "metadata": metadata, "steady": steady,
        "channels": tuple(own.get("channels") or ()),
    }  # fmt: skip


def _measured(contents: Contents, reading: Reading, form: str) -> NDArray[Any]:
    array = contents.array("H")
    if array is None:
        raise reading.error("H is missing or empty.")
    if array.ndim != _dims(form) and not (array.ndim == _dims(form) + 1 and array.shape[-1] == _STOKES):
        raise reading.error(f"expected H with {_dims(form)} dimensions as H_format says, got {array.shape}.")
    if (array.dtype.kind == "c") != form.startswith("F"):
        raise reading.error(
            f"expected {'complex' if form.startswith('F') else 'real'} numbers in H, got {array.dtype}."
        )
    return array


def _dims(form: str) -> int:
    return form.count("_") + 1


def _swapped(tensor: Tensor, form: str) -> Tensor:
    """Exchange x and y of each grid, which is its own inverse."""
    if "x" not in form:
        return tensor
    return tensor.transpose(1, 2).transpose(3, 4) if "L" in form else tensor.transpose(1, 2)


def _scan(contents: Contents, reading: Reading, form: str, legs: bool) -> Scan:
    points = {who: _points(contents, reading, f"{who}_grid_xyz") for who in ("sensor", "laser")}
    normals = {who: _normals(contents, reading, who, points[who]) for who in ("sensor", "laser")}
    for who in points:
        # UNKNOWN, 0, is what y-tal makes of a format that is missing.
        said = _one(contents, f"{who}_grid_format", whole_of)
        if said not in (None, 0, points[who].ndim - 1):
            raise reading.error(f"{who}_grid_format says {said}, the points are {points[who].shape}.")
    kind = _kind(points["sensor"], points["laser"], form, reading)
    if kind == "single":
        points["laser"] = points["laser"].reshape(3)
        normals["laser"] = None if normals["laser"] is None else normals["laser"].reshape(3)
    elif kind == "confocal":
        points["laser"] = points["sensor"]
    origins = {
        who: reading.origin(f"{who}_origin", real_in(contents, f"{who}_xyz", reading), points[who], normals[who], legs)
        for who in points
    }
    return scan_of(kind, *points.values(), *origins.values(), *normals.values(), legs=legs)


def _kind(sensor: NDArray[Any], laser: NDArray[Any], form: str, reading: Reading) -> str:
    if "L" in form:
        return "exhaustive"
    if sensor.shape == laser.shape:
        # Not what y-tal takes for confocal, which depends on where the origin of coordinates is.
        if same_points(sensor, laser):
            if not np.array_equal(sensor, laser):
                reading.assumed["laser_grid_xyz"] = "that of the sensor"
            return "confocal"
        if laser.size != 3:
            return "pairs"
    if laser.size != 3:
        raise reading.error(
            f"expected one laser point, or those of the sensor {sensor.shape}, as H has no laser dimensions, got "
            f"{laser.shape}."
        )
    return "single"


def _points(contents: Contents, reading: Reading, name: str) -> NDArray[np.float64]:
    array = real_in(contents, name, reading)
    if array is None or array.ndim not in (2, 3) or array.shape[-1] != 3:
        raise reading.error(f"expected {name} (X, Y, 3) or (N, 3), got {None if array is None else array.shape}.")
    return np.ascontiguousarray(array.swapaxes(0, 1) if array.ndim == 3 else array, np.float64)


def _normals(contents: Contents, reading: Reading, who: str, points: NDArray[Any]) -> NDArray[np.float64] | None:
    name = f"{who}_grid_normals"
    if contents.array(name) is None:
        return None
    found = _points(contents, reading, name)
    if found.shape != points.shape:
        raise reading.error(f"expected {name} in the shape of the points, {points.shape}, got {found.shape}.")
    return found


def _one(contents: Contents, name: str, kind: Callable[[Mapping[str, Any], str], Kind]) -> Kind | None:
    array = contents.array(name)
    return None if array is None else kind({name: array}, name)


# ------------------------------------------------------------------------------------------------------------- writing


def write(target: Path, capture: Capture) -> None:
    """Write a capture so that y-tal reads it. A phasor is written if there is no transient.

    Args:
        target: checked path.
        capture: names of channels, metadata, the wall and the steady image go into ``scene_info``, unless the capture
            was read from such a file and has none of them: then ``scene_info`` is written as it was.

    Raises:
        StorageError: for a batch, several channels, and a transient beside a phasor.
    """
    form, h = _h(capture)
    kept = _kept(capture)
    arrays = _arrays(capture, kept, form)
    text = _scene_info_text(capture, kept)
    formats = {"H_format": (_NUMBERS, _NUMBERS[form])}
    for who in ("sensor", "laser"):
        formats[f"{who}_grid_format"] = (_GRIDS, arrays[f"{who}_grid_xyz"].ndim - 1)
    if kept.get("volume_format") in _VOLUMES.values():
        formats["volume_format"] = (_VOLUMES, kept["volume_format"])
    h5py = hdf5_package(WHAT)
    with replacing(target, WHAT) as unfinished, new_hdf5(unfinished, WHAT) as file:
        dtype = np.dtype(kept["dtypes"].get("H", h.dtype))
        write_parts(file.create_dataset("H", h.shape, dtype if _holds(h, dtype) else h.dtype), h)
        for name, (numbers, number) in formats.items():
            file.create_dataset(name, data=np.array([number]), dtype=h5py.enum_dtype(numbers, basetype="i"))
        for name in sorted(_KNOWN - {"H", "scene_info", *formats}):
            value = arrays.get(name)
            file[name] = h5py.Empty(float) if value is None else value
        file["scene_info"] = h5py.Empty(float) if text is None else text


def _h(capture: Capture) -> tuple[str, NDArray[Any]]:
    """Return the name of H's format, and H as a view if the tensor lies on the CPU."""
    if capture.transient is not None and capture.phasor is not None:
        raise cannot(NAME, "a transient or a phasor", "both; write dataclasses.replace(capture, phasor=None, ...)")
    scan = capture.scan
    tensor = capture.transient if capture.transient is not None else capture.phasor
    assert tensor is not None  # a capture has one
    one_channel(capture, tensor, NAME, 1 if capture.polarized else 0)
    if scan.kind == "exhaustive" and len(scan.laser_shape) != len(scan.sensor_shape):
        raise cannot(NAME, "grids or lists", f"spots {scan.laser_shape} and sensor points {scan.sensor_shape}")
    sensor, laser = (array_of(points, WHAT).reshape(-1, 3) for points in (scan.sensor_points, scan.laser_points))
    if scan.kind == "single" and same_points(sensor, laser):
        raise cannot(NAME, "scans of one point that lights itself as confocal ones", "a single one; say so")
    if scan.kind == "pairs" and (same_points(sensor, laser) or len(sensor) == 1):
        kind = "single" if len(sensor) == 1 else "confocal"
        raise cannot(NAME, f"such pairs as {kind} scans", f"ones of kind='pairs'; make the scan a {kind} one")
    dims = {1: "Si", 2: "Sx_Sy"}[len(scan.sensor_shape)]
    lasers = {"Si": "Li_", "Sx_Sy": "Lx_Ly_"}[dims] if scan.kind == "exhaustive" else ""
    name = f"{'F' if tensor.is_complex() else 'T'}_{lasers}{dims}"
    tensor = tensor.squeeze(1).movedim(0, -1) if capture.polarized else tensor.squeeze(0)
    return name, array_of(_swapped(tensor, name), WHAT)


def _arrays(capture: Capture, kept: Mapping[str, Any], form: str) -> dict[str, NDArray[Any]]:
    scan, dtypes = capture.scan, kept["dtypes"]
    legs = scan.first_and_last_leg
    arrays: dict[str, Any] = {} if assumed_in(capture, _LEGS, legs) else {_LEGS: np.bool_(legs)}
    axis = capture.axis
    start, width = (None, None) if axis is None else (axis.start_opl, axis.bin_width_opl)
    if form.startswith("F") and capture.axis is None:
        frequencies = capture.frequencies
        assert frequencies is not None  # a phasor has them
        start, width = frequencies.start_opl, kept.get("delta_t")
        if dtypes and "t_start" not in dtypes and start == 0:
            start = None  # as it was read
    if not assumed_in(capture, "start_s", start):
        arrays["t_start"] = start
    arrays["delta_t"] = width
    for who in ("sensor", "laser"):
        if legs or not assumed_in(capture, f"{who}_origin", getattr(scan, f"{who}_origin")):
            arrays[f"{who}_xyz"] = getattr(scan, f"{who}_origin")
        for ours, theirs in (("points", "grid_xyz"), ("normals", "grid_normals")):
            points = getattr(scan, f"{who}_{ours}")
            if points is not None:
                spot = points if points.ndim > 1 else points.reshape(*(1,) * len(scan.sensor_shape), 3)
                arrays[f"{who}_{theirs}"] = spot.transpose(0, 1) if spot.ndim == 3 else spot
    return {name: _as_stored(name, value, dtypes.get(name)) for name, value in arrays.items() if value is not None}


def _as_stored(name: str, value: Any, dtype: str | None) -> NDArray[Any]:
    """Return an array in the dtype of the file that it was read from, else points in single precision if that is
    exact.
    """
    array = np.ascontiguousarray(array_of(value, WHAT)) if isinstance(value, Tensor) else np.asarray(value)
    if dtype is not None and (
        _holds(array, np.dtype(dtype)) or (name.endswith("normals") and np.dtype(dtype).kind == "f")
    ):
        return array.astype(dtype)
    return array.astype(np.float32) if array.ndim and _holds(array, np.dtype(np.float32)) else array


def _holds(array: NDArray[Any], dtype: np.dtype[Any]) -> bool:
    """Return True if numbers are the same in another dtype."""
    if array.dtype == dtype:
        return True
    if dtype.kind not in "iufc" or (dtype.kind != "c" and array.dtype.kind == "c"):
        return False
    with np.errstate(all="ignore"):
        return math.prod(array.shape) == 0 or bool(np.array_equal(array.astype(dtype).astype(array.dtype), array))


# ----------------------------------------------------------------------------------------------------------- scene_info


def _scene_info(text: str) -> Any:
    """Return ``scene_info`` as plain data. Raises StorageError."""
    return _as_json(read_plain_yaml(text, WHAT))


def _own_part(info: Any) -> dict[str, Any] | None:
    """Return the part of ``scene_info`` that this library writes, None in files of other programs.

    ``channels``, ``metadata``, ``wall``, ``steady``, ``frequencies_per_metre``, ``phasor_start_opl``. Raises
    StorageError for damage.
    """
    text = info.get(_OWN) if isinstance(info, Mapping) else None
    if not isinstance(text, str):
        return None
    try:
        own = json.loads(text)
        return dict(own) | {name: restored(own[name], {}) for name in ("wall", "steady")}
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise StorageError(f"capture file: scene_info.{_OWN} is damaged: {error}.") from None


def _frequencies(info: Any, own: Mapping[str, Any] | None, count: int, start_opl: float | None) -> FrequencyAxis | None:
    """Return the frequencies of ``count`` phasors: as this library wrote them, or those that a render of y-tal with
    these settings keeps; None without either.
    """
    if own is not None and own.get("frequencies_per_metre") is not None:
        return FrequencyAxis(tuple(own["frequencies_per_metre"]), own["phasor_start_opl"])
    config = info.get("config") if isinstance(info, Mapping) else None
    if not isinstance(config, Mapping) or config.get("histogram_mode") != "frequency":
        return None
    numbers = [config.get(name) for name in ("wl_mean", "wl_sigma", "num_bins", "bin_width_opl")]
    if any(isinstance(n, bool) or not isinstance(n, int | float) for n in numbers):
        return None
    mean, sigma, bins, width = (float(n) for n in numbers if n is not None)
    # A spectrum has as many lines as H has rows, whatever a damaged text says of bins.
    if not (0 < bins <= 2**31 and bins * width / max(sigma, 1e-300) < 1e3 * (count + 10)):
        return None
    found = transform_bins(mean, sigma, int(bins), width)
    return FrequencyAxis(tuple(found.tolist()), start_opl or 0.0) if len(found) == count else None


def _kept(capture: Capture) -> dict[str, Any]:
    """Return settings of a file that was read, from a capture's metadata: ``dtypes`` by name, and if they are there
    ``scene_info_text``, ``volume_format``, ``delta_t``. Other entries are left out: metadata may be anything.
    """
    given = capture.metadata.get("tal")
    given = given if isinstance(given, Mapping) else {}
    dtypes = given.get("dtypes")
    names = dtypes.items() if isinstance(dtypes, Mapping) else ()
    kept: dict[str, Any] = {"dtypes": {name: kind for name, kind in names if _DTYPE.fullmatch(str(kind))}}
    kinds = {"scene_info_text": str | None, "volume_format": int, "delta_t": float}
    return kept | {name: given[name] for name, kind in kinds.items() if name in given and isinstance(given[name], kind)}


def _scene_info_text(capture: Capture, kept: Mapping[str, Any]) -> str | None:
    """Return the text for a capture: as it was read if nothing about it has changed, None if there was none."""
    added = capture.channels or set(capture.metadata) - _READ or capture.scan.wall is not None
    if "scene_info_text" in kept and not added and capture.steady is None:
        text: str | None = kept["scene_info_text"]
        before, axis = None if text is None else _scene_info(text), capture.frequencies
        if axis is not None:
            axis = _frequencies(before, _own_part(before), axis.num_frequencies, axis.start_opl)
        if capture.frequencies == axis and capture.metadata.get("scene_info") == before:
            return text
    info: dict[str, Any] = {"original_format": str(capture.metadata.get("format", _OWN))}
    given = capture.metadata.get("scene_info")
    own = {
        "channels": capture.channels, "metadata": dict(capture.metadata),
        "wall": plain(capture.scan.wall, None, "wall"), "steady": plain(capture.steady, None, "steady"),
    }  # fmt: skip
    if capture.frequencies is not None:
        own |= {
            "frequencies_per_metre": capture.frequencies.frequencies, "phasor_start_opl": capture.frequencies.start_opl,
        }  # fmt: skip
    if capture.polarized:
        # Not the variant, which 0.21 looks at: its `read_capture` raises for polarized ones.
        info["is_polarized"] = True
    info |= given if isinstance(given, Mapping) else {}
    return write_plain_yaml(_as_json(info) | {_OWN: json.dumps(own)}, WHAT)


def _as_json(data: Any) -> Any:
    """Return plain data as JSON has it: names are texts, sequences lists."""
    if isinstance(data, Mapping):
        return {name if isinstance(name, str) else json.dumps(_as_json(name)): _as_json(v) for name, v in data.items()}
    if isinstance(data, list | tuple | set | frozenset):
        return [_as_json(value) for value in data]
    if isinstance(data, bytes):
        return data.hex()
    return data if data is None or isinstance(data, bool | int | float | str) else str(data)
