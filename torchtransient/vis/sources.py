"""Sources of pictures: tensors, arrays, results of a render, captures, or files that hold one."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchtransient.array_files.array_file import ENDINGS, read_npy, read_some
from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.capture.capture import computed
from torchtransient.checks import Numbers
from torchtransient.errors import ArgumentError, ShapeError

Source = Any  # Tensor | NDArray | RenderOutput | Result | str | Path, told apart by what they offer
# Readers of the library's own files, which stand in rooms above this one.
_READERS = {
    "torchtransient capture": ("torchtransient.files.captures.own", "read_capture"),
    "torchtransient volume": ("torchtransient.files.volume_file", "read_volume"),
    "": ("torchtransient.files.result_file", "read_result"),
}
_TENSORS = ("transient", "steady", "phasor", "gated", "rates", "beats")
# Dimensions of what one render has, without Stokes components.
_DIMENSIONS = {"transient": 4, "gated": 4, "rates": 5, "beats": 5}
# What may stand in the place of a transient.
_OTHERS = {
    "gated": "images of time gates, which are no bins; frames, frame_grid and histogram draw them",
    "beats": "spectra of beats, whose places are no times of arrival; tt.sensing.range_and_speed reads them",
}


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
    if loaded.transient is None:
        held = next((said for name, said in _OTHERS.items() if getattr(loaded, name) is not None), "none")
        raise ShapeError(f"{who}: expected a transient (C, T, H, W), and the source holds {held}.")
    return _checked_cube(loaded.transient, loaded.axis if axis is None else axis, who, any_channels)


def images_of(
    source: Source, axis: TimeAxis | None = None, who: str = "picture", any_channels: bool = False
) -> tuple[Tensor, TimeAxis | None, str]:
    """Return the intensity over time, or images of time gates (C, G, H, W), its axis, and "bin" or "gate".

    Args:
        source, axis, who, any_channels: the source and how it is read, see :func:`transient_of`.

    Raises:
        ShapeError: as for ``transient_of``, and for gates with an axis.
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
    if axis is not None and axis.num_bins != cube.shape[1]:
        raise ShapeError(f"{who}: the axis has {axis.num_bins} bins, the transient {cube.shape[1]}.")
    return cube, axis


def stokes_of(source: Source, frame: int | None = None, who: str = "picture") -> Tensor:
    """Return Stokes vectors (4, C, H, W).

    Args:
        source: a polarized transient (4, C, T, H, W), image (4, C, H, W), or a result or file with one.
        frame: index of the bin; None for the light of all times, the ``steady`` of a result or the sum over time.
        who: beginning of messages.

    Raises:
        ShapeError: for sources without polarization.
        IndexError: for bins outside.
    """
    loaded = _load(source, "")
    cube, image = loaded.gated if loaded.transient is None else loaded.transient, loaded.steady
    if image is not None and (cube is None or frame is None) and image.ndim == 4 and image.shape[0] == 4:
        return image
    if cube is not None and cube.ndim == 5 and cube.shape[0] == 4:
        return cube.sum(2) if frame is None else cube[:, :, frame]
    found = cube if cube is not None else image
    raise ShapeError(
        f"{who}: expected Stokes vectors (4, C, T, H, W) or (4, C, H, W), got "
        f"{'neither' if found is None else tuple(found.shape)}; polarized variants render them."
    )


def pixel_of(pixel: Sequence[int], size: tuple[int, int], who: str) -> tuple[int, int]:
    """Return (row, column) of a pixel.

    Args:
        pixel: two whole numbers.
        size: height and width of the image.
        who: beginning of messages.

    Raises:
        ShapeError: for a pixel outside.
    """
    row, column = pixel
    if not (0 <= row < size[0] and 0 <= column < size[1]):
        raise ShapeError(f"{who}: pixel ({row}, {column}) lies outside of an image of {size[0]} x {size[1]}.")
    return row, column


def phasor_of(source: Source, who: str = "picture") -> tuple[Tensor, tuple[float, ...] | None]:
    """Return phasor images and their frequencies in cycles per metre, if the source knows them.

    Args:
        source: phasors, complex (C, F, H, W), polarized (4, C, F, H, W) of which the first component is taken, or a
            result with such a ``phasor``.
        who: beginning of messages.

    Raises:
        ShapeError: for another shape or a real dtype.
    """
    loaded = _load(source, "phasor")
    phasor = loaded.phasor
    if phasor is None:
        raise ShapeError(f"{who}: the source holds no phasor, complex (C, F, H, W).")
    if phasor.ndim == 5 and phasor.shape[0] == 4:
        phasor = phasor[0]
    if phasor.ndim != 4 or not phasor.is_complex():
        raise ShapeError(
            f"{who}: expected complex phasors (C, F, H, W), got {phasor.dtype} of shape {tuple(phasor.shape)}."
        )
    return phasor, loaded.frequencies


def as_tensor(value: Any, who: str) -> Tensor:
    """Return numbers on the CPU without gradients; whole numbers and 16 bits become float32.

    Args:
        value: tensor or array.
        who: beginning of messages.

    Raises:
        ArgumentError: for anything else.
    """
    if isinstance(value, np.ndarray):
        value = torch.from_numpy(np.ascontiguousarray(value))
    if not isinstance(value, Tensor):
        raise ArgumentError(
            f"{who}: expected a tensor, an array, a RenderOutput or the path of a result, got {type(value).__name__}."
        )
    tensor = value.detach().cpu()
    if tensor.is_complex() or tensor.dtype in (torch.float32, torch.float64):
        return tensor
    return tensor.to(torch.float32)


def _refuse_batch(source: Any) -> None:
    """Refuse four entries of a batch as components of polarized light, where the source can tell."""
    name, cube = next(((n, c) for n in _DIMENSIONS if (c := getattr(source, n, None)) is not None), ("", None))
    polarized = getattr(source, "polarized", None)
    if polarized is None:
        variant = getattr(source, "metadata", {}).get("stats", {}).get("variant")
        polarized = None if variant is None else "polarized" in variant
    if polarized is False and cube is not None and cube.ndim > _DIMENSIONS[name]:
        raise ShapeError(
            f"picture: expected one transient (C, T, H, W), got a batch or several sensors, {tuple(cube.shape)}; "
            "choose one entry."
        )


def frequencies_of(given: FrequencyAxis | Numbers | None) -> tuple[float, ...] | None:
    """Return cycles per metre.

    Args:
        given: a FrequencyAxis, a row of numbers, or None, which stays None.
    """
    if given is None:
        return None
    return given.frequencies if isinstance(given, FrequencyAxis) else tuple(float(nu) for nu in given)


def _load(source: Source, name: str) -> Loaded:
    """Return the tensors of a source.

    A bare tensor is taken for ``name``; without one, 5 dimensions or 4 that do not begin with four components are a
    transient, and the rest a steady image.
    """
    if isinstance(source, str | Path):
        source = read_any(Path(source))
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
        known = frequencies_of(getattr(source, "frequencies", None))
        held = {key: as_tensor(value, key) for key in _TENSORS if (value := getattr(source, key, None)) is not None}
        if "rates" in held:
            held["transient"] = held.pop("rates").sum(-4)
        return Loaded(**held, axis=getattr(source, "axis", None), frequencies=known)
    tensor = as_tensor(source, "picture")
    if name == "phasor":
        return Loaded(phasor=tensor)
    if name == "transient" or tensor.ndim == 5 or (tensor.ndim == 4 and tensor.shape[0] != 4):
        return Loaded(transient=tensor)
    return Loaded(steady=tensor)


def of_one_spot(capture: Capture, laser: int | tuple[int, ...] | None, who: str) -> tuple[Tensor, TimeAxis, Scan]:
    """Return the light of a capture under one laser spot.

    Args:
        capture: one with a transient; of polarized ones S0 is taken.
        laser: spot of an exhaustive capture; None for the middle one.
        who: beginning of messages.

    Returns:
        Light (C, T, rows, columns) of a grid or (C, T, N) of a list on the CPU, C = 1 or 3, its axis and its scan.

    Raises:
        ShapeError: for phasors alone, a batch, other numbers of channels, and a spot that there is none of.
    """
    if capture.scan.kind == "exhaustive":
        capture = capture.single(middle_spot(capture.scan) if laser is None else laser)
    elif laser is not None:
        raise ShapeError(f"{who}: laser= chooses a spot of an exhaustive capture, got a {capture.scan.kind} one.")
    if capture.transient is None or capture.axis is None:
        raise ShapeError(f"{who}: expected a capture with a transient, got phasors alone.")
    cube = computed(capture.transient.detach().cpu())
    rank = len(capture.scan.shape) + 2
    if capture.polarized:
        cube = cube.select(cube.ndim - rank - 1, 0)
    if cube.ndim != rank or cube.shape[0] not in (1, 3):
        raise ShapeError(
            f"{who}: expected one capture of one channel or three, got {tuple(cube.shape)}; choose one of a batch."
        )
    return cube, capture.axis, capture.scan


def middle_spot(scan: Scan) -> tuple[int, ...]:
    """Return the index of the laser spot in the middle of a scan.

    Args:
        scan: an exhaustive one.
    """
    return tuple(n // 2 for n in scan.laser_shape)


def read_any(path: Path) -> Any:
    """Return the content of a file: a result, a capture or a volume, or the one array of a ``.npy``.

    Args:
        path: the file.

    Raises:
        StorageError: for a missing, damaged or unknown file.
    """
    if path.suffix.lower() == ".npy":
        return read_npy(path, "picture")
    arrays = path.suffix.lower() in ENDINGS
    form = str(read_some(path, "picture", "format".__eq__).get("format", "")) if arrays else ""
    module, name = next(reader for kind, reader in _READERS.items() if form.startswith(kind))
    return getattr(importlib.import_module(module), name)(path)
