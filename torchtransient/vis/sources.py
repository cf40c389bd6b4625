"""Sources of pictures: tensors, arrays, results of a render, captures, or files that hold one."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchtransient.array_files.array_file import damage_said, read_npy, read_some
from torchtransient.array_files.plain_texts import json_data
from torchtransient.axes import FrequencyAxis, RateAxis, TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.capture.capture import computed
from torchtransient.checks import as_whole, of_class, real_array, shown
from torchtransient.errors import ArgumentError, ShapeError, StorageError, UnitError

Source = Any  # Tensor | NDArray | RenderOutput | Result | str | Path, told apart by what they offer
_HDF5 = (".h5", ".hdf5")
# Readers of the library's own files, which stand in rooms above this one.
_READERS = {
    "torchtransient result": ("torchtransient.files.result_file", "read_result"),
    "torchtransient capture": ("torchtransient.files.capture_file", "read_capture"),
    "torchtransient volume": ("torchtransient.files.volume_file", "read_volume"),
}
_TENSORS = ("transient", "steady", "phasor", "gated", "rates", "beats")
# Dimensions of what one render has, without Stokes components.
_DIMENSIONS = {"transient": 4, "gated": 4, "rates": 5, "beats": 5}
_KNOWN = {
    *_TENSORS, "start_opl", "bin_width_opl", "num_bins", "gates", "metadata", "frequencies_per_metre",
}  # fmt: skip


@dataclass(frozen=True)
class Loaded:
    """Tensors of a source with their axes; None for those that it lacks."""

    transient: Tensor | None = None
    steady: Tensor | None = None
    phasor: Tensor | None = None
    axis: TimeAxis | None = None
    frequencies: tuple[float, ...] | None = None
    gated: Tensor | None = None
    beats: Tensor | None = None


def transient_of(
    source: Source, axis: TimeAxis | None = None, who: str = "picture", any_channels: bool = False
) -> tuple[Tensor, TimeAxis | None]:
    """Return the intensity over time of a source.

    Args:
        source: a tensor or array (C, T, H, W), or polarized (4, C, T, H, W) of which the first component is taken; an
            object with ``transient`` (and ``axis``), such as a RenderOutput; a Capture; or a file, ``.h5``, ``.npz`` or
            ``.npy``. Light by rates is added up over these.
        axis: time axis in place of the source's.
        who: beginning of messages.
        any_channels: take other numbers of channels than 1 and 3.

    Returns:
        (C, T, H, W) on the CPU without gradients, and its axis if it is known.

    Raises:
        ShapeError: for another shape, an empty cube, or an axis of another number of bins.
        StorageError: for a file that cannot be read.
    """
    loaded = _load(source, "transient")
    if loaded.transient is None and loaded.gated is not None:
        raise ShapeError(
            f"{who}: expected a transient (C, T, H, W), and the source holds {loaded.gated.shape[-3]} images of time "
            "gates, which are no bins. Draw them with frames, frame_grid or histogram, or render with time_axis=..."
        )
    if loaded.transient is None and loaded.beats is not None:
        raise ShapeError(
            f"{who}: expected a transient (C, T, H, W), and the source holds spectra of beats, whose places are no "
            "times of arrival. tt.sensing.range_and_speed reads distances and speeds off them."
        )
    cube = _only(loaded.transient, "transient", "(C, T, H, W)", who)
    return _checked_cube(cube, loaded.axis if axis is None else axis, who, any_channels)


def images_of(
    source: Source, axis: TimeAxis | None = None, who: str = "picture", any_channels: bool = False
) -> tuple[Tensor, TimeAxis | None, str]:
    """Return the intensity over time, or images of time gates (C, G, H, W), its axis, and "bin" or "gate".

    Args:
        source, axis, who, any_channels: as of :func:`transient_of`.

    Raises:
        ShapeError: as of ``transient_of``, and for gates with an axis.
    """
    loaded = _load(source, "transient")
    if loaded.transient is not None or loaded.gated is None:
        return *transient_of(loaded, axis, who, any_channels), "bin"
    if axis is not None:
        raise ShapeError(f"{who}: images of time gates have no time axis, got {axis}; leave it out.")
    return *_checked_cube(loaded.gated, None, who, any_channels), "gate"


def _checked_cube(cube: Tensor, axis: TimeAxis | None, who: str, any_channels: bool) -> tuple[Tensor, TimeAxis | None]:
    if cube.ndim == 5 and cube.shape[0] == 4:
        cube = cube[0]
    if cube.ndim != 4 or cube.numel() == 0 or not (any_channels or cube.shape[0] in (1, 3)):
        raise ShapeError(
            f"{who}: expected a transient (C, T, H, W) or (4, C, T, H, W) with C = 1 or 3, got {tuple(cube.shape)}; of "
            "a batch, choose one, and of many channels, choose one or three."
        )
    if axis is not None and of_class(f"{who}: axis", axis, TimeAxis).num_bins != cube.shape[1]:
        raise ShapeError(f"{who}: the axis has {axis.num_bins} bins, the transient {cube.shape[1]}.")
    return cube, axis


def steady_of(source: Source, who: str = "picture") -> Tensor:
    """Return an intensity (C, H, W), C = 1 or 3.

    Args:
        source: a tensor (C, H, W) or (4, C, H, W), the ``steady`` of a result or file, or a transient, which is added
            up over time.
        who: beginning of messages.

    Raises:
        ShapeError, StorageError: as of :func:`transient_of`.
    """
    loaded = _load(source, "")
    image = loaded.steady
    if image is None:
        image = images_of(loaded, None, who)[0].sum(1)
    if image.ndim == 4 and image.shape[0] == 4:
        image = image[0]
    if image.ndim != 3 or image.shape[0] not in (1, 3) or image.numel() == 0:
        raise ShapeError(f"{who}: expected an image (C, H, W) with C = 1 or 3, got {tuple(image.shape)}.")
    return image


def stokes_of(source: Source, frame: int | None = None, who: str = "picture") -> Tensor:
    """Return Stokes vectors (4, C, H, W).

    Args:
        source: a polarized transient (4, C, T, H, W), image (4, C, H, W), or a result or file with one.
        frame: bin; None for the light of all times, the ``steady`` of a result or the sum over time.
        who: beginning of messages.

    Raises:
        ShapeError: for sources without polarization, and bins outside.
    """
    loaded = _load(source, "")
    cube, image = loaded.gated if loaded.transient is None else loaded.transient, loaded.steady
    if image is not None and (cube is None or frame is None) and image.ndim == 4 and image.shape[0] == 4:
        result = image
    elif cube is not None and cube.ndim == 5 and cube.shape[0] == 4:
        place = as_whole(frame)
        if frame is not None and (place is None or not -cube.shape[2] <= place < cube.shape[2]):
            raise ShapeError(f"{who}: bin {shown(frame)} of {cube.shape[2]} does not exist.")
        result = cube.sum(2) if place is None else cube[:, :, place]
    else:
        found = cube if cube is not None else image
        shape = "neither" if found is None else tuple(found.shape)
        raise ShapeError(
            f"{who}: expected Stokes vectors (4, C, T, H, W) or (4, C, H, W), got {shape}; polarized variants such as "
            "llvm_ad_mono_polarized render them."
        )
    if result.numel() == 0:
        raise ShapeError(f"{who}: expected Stokes vectors of some pixels, got {tuple(result.shape)}.")
    return result


def pixel_of(pixel: Any, size: tuple[int, int], who: str) -> tuple[int, int]:
    """Return (row, column) of a pixel.

    Args:
        pixel: two whole numbers.
        size: height and width of the image.
        who: beginning of messages.

    Raises:
        ShapeError: for a pixel outside, and for anything else.
    """
    several = isinstance(pixel, Sequence) or getattr(pixel, "ndim", 0) == 1
    row, column = [as_whole(n) for n in pixel] if several and len(pixel) == 2 else (None, None)
    if row is None or column is None:
        raise ShapeError(f"{who}: expected a pixel (row, column), got {shown(pixel)}.")
    if not (0 <= row < size[0] and 0 <= column < size[1]):
        raise ShapeError(f"{who}: pixel ({row}, {column}) lies outside of an image of {size[0]} x {size[1]}.")
    return row, column


def phasor_of(source: Source, who: str = "picture") -> tuple[Tensor, tuple[float, ...] | None]:
    """Return phasor images and their frequencies in cycles per metre, if the source knows them.

    Args:
        source: complex (C, F, H, W), polarized (4, C, F, H, W) of which the first component is taken, or a result with
            such a ``phasor``.
        who: beginning of messages.

    Raises:
        ShapeError: for another shape or a real dtype.
    """
    loaded = _load(source, "phasor")
    phasor = _only(loaded.phasor, "phasor", "complex (C, F, H, W)", who)
    if phasor.ndim == 5 and phasor.shape[0] == 4:
        phasor = phasor[0]
    if phasor.ndim != 4 or phasor.numel() == 0 or not phasor.is_complex():
        raise ShapeError(
            f"{who}: expected complex phasors (C, F, H, W), got {phasor.dtype} of shape {tuple(phasor.shape)}."
        )
    return phasor, loaded.frequencies


def given_tensor(value: Any, who: str, expected: str = "a tensor or an array") -> Tensor:
    """Return a tensor as it is, and one of the numbers of an array.

    Args:
        value: tensor or array.
        who: beginning of messages.
        expected: description of what is expected.

    Raises:
        ArgumentError: for anything else.
        ShapeError: for arrays of other things than numbers.
    """
    if isinstance(value, Tensor):
        return value
    if not isinstance(value, np.ndarray):
        raise ArgumentError(f"{who}: expected {expected}, got {type(value).__name__}.")
    try:
        return torch.from_numpy(np.ascontiguousarray(value))
    except TypeError:
        raise ShapeError(f"{who}: expected numbers, got an array of {value.dtype}.") from None


def real_tensor(value: Any, who: str) -> Tensor:
    """Return a tensor as :func:`given_tensor`.

    Args:
        value: tensor or array.
        who: beginning of messages.

    Raises:
        ArgumentError: for anything else.
        ShapeError: for arrays of other things than numbers, and for complex numbers.
    """
    tensor = given_tensor(value, who)
    if tensor.is_complex():
        raise ShapeError(f"{who}: expected real numbers, got {tensor.dtype}.")
    return tensor


def as_tensor(value: Any, who: str) -> Tensor:
    """Return numbers on the CPU without gradients; whole numbers and 16 bits become float32.

    Args:
        value: tensor or array.
        who: beginning of messages.

    Raises:
        ArgumentError, ShapeError: as :func:`given_tensor`.
    """
    tensor = given_tensor(value, who, "a tensor, an array, a RenderOutput or the path of a result").detach().cpu()
    if tensor.is_complex() or tensor.dtype in (torch.float32, torch.float64):
        return tensor
    return tensor.to(torch.float32)


def _refuse_batch(source: Any) -> None:
    """Refuse four entries of a batch as components of polarized light, where the source can tell."""
    given = {name: getattr(source, name, None) for name in _DIMENSIONS}
    name, cube = next(((n, c) for n, c in given.items() if c is not None), ("", None))
    polarized = getattr(source, "polarized", None)
    if polarized is None and isinstance(getattr(source, "metadata", None), dict):
        polarized = _variant_is_polarized(source.metadata)
    if polarized is False and cube is not None and cube.ndim > _DIMENSIONS[name]:
        raise ShapeError(
            f"picture: expected one transient (C, T, H, W), got a batch or several sensors, {tuple(cube.shape)}; "
            "choose one entry."
        )


def _variant_is_polarized(metadata: dict[str, Any]) -> bool | None:
    variant = (metadata.get("stats") or {}).get("variant")
    return None if variant is None else "polarized" in variant


def frequencies_of(given: Any) -> tuple[float, ...] | None:
    """Return cycles per metre.

    Args:
        given: a FrequencyAxis, a row of numbers, or None, which stays None.

    Raises:
        UnitError: for anything else.
    """
    if given is None:
        return None
    if isinstance(given, FrequencyAxis):
        return given.frequencies
    row = real_array(given)
    if row is None:
        raise UnitError(f"picture: expected frequencies in cycles per metre, got {shown(given)}.")
    return tuple(row.ravel().tolist())


def _only(value: Tensor | None, name: str, shape: str, who: str) -> Tensor:
    if value is None:
        raise ShapeError(f"{who}: the source holds no {name} {shape}.")
    return value


def _load(source: Source, name: str) -> Loaded:
    """Return the tensors of a source.

    A bare tensor is taken for ``name``; without one, 5 dimensions or 4 that do not begin with four components are a
    transient, and the rest a steady image.
    """
    if isinstance(source, str | Path):
        source = read_file(Path(source))
    if isinstance(source, Loaded):
        return source
    if isinstance(source, Capture) and source.transient is not None and name != "phasor":
        cube, axis, scan = of_one_spot(source, None, "picture")
        if cube.ndim != 4:
            raise ShapeError(
                f"picture: expected a capture of a grid of sensor points, got a list of {scan.pairs}; "
                "transients_grid(style='image') draws lists, and tt.vis.view shows them."
            )
        # The wall's rows run upwards, those of pictures downwards.
        return Loaded(transient=cube.flip(2), axis=axis)
    if any(hasattr(source, name) for name in _TENSORS if name != "steady"):
        _refuse_batch(source)
        given = {key: getattr(source, key, None) for key in _TENSORS}
        known = frequencies_of(getattr(source, "frequencies", None))
        tensors = {key: as_tensor(value, key) for key, value in given.items() if value is not None}
        return Loaded(**_summed(tensors), axis=getattr(source, "axis", None), frequencies=known)
    tensor = as_tensor(source, "picture")
    if name == "phasor":
        return Loaded(phasor=tensor)
    if name == "transient" or tensor.ndim == 5 or (tensor.ndim == 4 and tensor.shape[0] != 4):
        return Loaded(transient=tensor)
    return Loaded(steady=tensor)


def of_one_spot(
    capture: Capture, laser: int | tuple[int, ...] | None, who: str
) -> tuple[Tensor, TimeAxis, Scan]:
    """Return the light of a capture under one laser spot.

    Args:
        capture: one with a transient; of polarized ones S0 is taken.
        laser: spot of an exhaustive capture; None for the middle one.
        who: beginning of messages.

    Returns:
        Light (C, T, rows, columns) of a grid or (C, T, N) of a list on the CPU, C = 1 or 3, its axis and its scan.

    Raises:
        ArgumentError: for another object.
        ShapeError: for phasors alone, a batch, other numbers of channels, and a spot that there is none of.
    """
    _light_of(capture, who)  # before a part is taken
    if capture.scan.kind == "exhaustive":
        capture = capture.single(middle_spot(capture.scan) if laser is None else laser)
    elif laser is not None:
        raise ShapeError(f"{who}: laser= chooses a spot of an exhaustive capture, got a {capture.scan.kind} one.")
    cube, axis = _light_of(capture, who)
    if cube.shape[0] not in (1, 3):
        raise ShapeError(f"{who}: expected one channel or three, got {cube.shape[0]}; choose some.")
    return cube, axis, capture.scan


def _light_of(capture: Any, who: str) -> tuple[Tensor, TimeAxis]:
    if not isinstance(capture, Capture):
        raise ArgumentError(f"{who}: expected a Capture, which knows its scan and axis, got {type(capture).__name__}.")
    if capture.transient is None or capture.axis is None:
        raise ShapeError(f"{who}: expected a capture with a transient, got phasors alone.")
    cube = computed(capture.transient.detach().cpu())
    rank = len(capture.scan.shape) + 2
    if capture.polarized:
        cube = cube.select(cube.ndim - rank - 1, 0)
    if cube.ndim != rank:
        raise ShapeError(f"{who}: expected one capture, got a batch {tuple(cube.shape)}; choose one of it.")
    return cube, capture.axis


def middle_spot(scan: Scan) -> tuple[int, ...]:
    """Return the index of the laser spot in the middle of a scan.

    Args:
        scan: an exhaustive one.
    """
    return tuple(n // 2 for n in scan.laser_shape)


def read_any(path: Path) -> Any:
    """Return the content of a file: a result, a capture or a volume; of other files as :func:`read_file`.

    Args:
        path: the file.

    Raises:
        StorageError: for a missing, damaged or unknown file.
    """
    if path.suffix.lower() in (*_HDF5, ".npz"):
        form = str(read_some(path, "view", "format".__eq__).get("format", ""))
        for kind, (module, name) in _READERS.items():
            if form.startswith(kind):
                return getattr(importlib.import_module(module), name)(path)
    return read_file(path)


def _axis_in(values: Mapping[str, Any]) -> TimeAxis | None:
    if "num_bins" not in values:
        return None
    return TimeAxis(float(values["start_opl"]), float(values["bin_width_opl"]), int(values["num_bins"]))


def read_rates(path: Path) -> Any:
    """Return light by rates of a file: an object with `rates`, `axis` and `rate_axis`.

    Args:
        path: a result, .h5 or .npz.

    Raises:
        StorageError: as :func:`read_file`, and for files of other films.
    """
    if path.suffix.lower() not in (*_HDF5, ".npz"):
        raise StorageError(f"picture: expected a result, .h5 or .npz, got '{path}'.")
    names = ("rates_start", "rates_bin_width", "rates_num_bins")
    values = read_some(path, "picture", {*names, *_KNOWN}.__contains__)
    if "rates" not in values:
        raise StorageError(f"picture: '{path}' holds no light by rates; render it with rates=tt.RateAxis(...).")
    with damage_said(path, "picture", "a result"):
        start, width, bins = (values[name] for name in names)
        rate_axis = RateAxis(float(start), float(width), int(bins))
        return SimpleNamespace(rates=as_tensor(values["rates"], "rates"), axis=_axis_in(values), rate_axis=rate_axis)


def _summed(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return tensors with the sum over rates in place of light by rates."""
    rates = tensors.pop("rates", None)
    return tensors if rates is None else {**tensors, "transient": rates.sum(-4)}


def read_file(path: Path) -> Any:
    """Return a file as a source: a result (``.h5``, ``.hdf5``, ``.npz``) with its axis, or the one array of a ``.npy``.

    Tensors and numbers of the axis are read, each if it is there, and compared with their checksums.

    Args:
        path: the file.

    Raises:
        StorageError: for a missing, damaged or unknown file.
    """
    if path.suffix.lower() not in (*_HDF5, ".npz", ".npy"):
        raise StorageError(f"picture: expected a result, .h5, .npz or .npy, got '{path}'.")
    if path.suffix.lower() == ".npy":
        return read_npy(path, "picture")
    values = read_some(path, "picture", _KNOWN.__contains__)
    with damage_said(path, "picture", "a result"):
        axis = _axis_in(values)
        if "gates" in values and "gated" not in values:
            values["gated"] = values.pop("transient")  # as files of earlier versions call it
        arrays = {key: as_tensor(values[key], key) for key in _TENSORS if key in values}
    if any(arrays[key].ndim > n for key, n in _DIMENSIONS.items() if key in arrays) and "metadata" in values:
        _refuse_batch(SimpleNamespace(**arrays, metadata=json_data(str(values["metadata"]), f"picture: '{path}'")))
    if not arrays:
        raise StorageError(f"picture: '{path}' holds none of {', '.join(_TENSORS[:-1])} and {_TENSORS[-1]}.")
    return Loaded(**_summed(arrays), axis=axis, frequencies=frequencies_of(values.get("frequencies_per_metre")))

