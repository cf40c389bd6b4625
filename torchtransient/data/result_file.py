"""A render on disk: HDF5 (`.h5`, `.hdf5`) or NumPy's `.npz`, chosen by the file's ending.

Both hold the same names. Arrays have torch's order: `steady` float32 (..., C, H, W) and either `transient` float32
(..., C, T, H, W), radiance integrated over each bin, with `edges_opl` float64 (T + 1,), metres; or `phasor` complex64
(..., C, F, H, W) with `frequencies_per_metre` float64 (F,), cycles per metre of optical path. A gated film's images are
a `transient` (..., C, G, H, W) with `gates` (the text of scene files) instead of an axis. Polarized variants have
the four Stokes components before C. The numbers of the axis (`start_opl`, and for a transient `bin_width_opl`, in
metres, `num_bins`), `channels` (JSON: the names of the C channels), `format` and `metadata` (JSON) are attributes of
the HDF5 file and zero-dimensional arrays of the `.npz`. A cube is written in parts, so that no second copy of it is
needed.
"""

from __future__ import annotations

import json
import os
import secrets
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.errors import StorageError, TorchTransientError
from torchtransient.gates import Gate, gates_from_text, gates_to_text
from torchtransient.render.output import RenderOutput

FORMAT = "torchtransient result 1"
_HDF5 = (".h5", ".hdf5")
_ENDINGS = (*_HDF5, ".npz")
_PART_BYTES = 2**26


@dataclass(frozen=True)
class Result:
    """What `read_result` returns: the tensors of a render, its axis, and what was noted about its making.

    Either `transient` with `axis` or `gates`, or `phasor` and `frequencies`; the others are None.
    """

    transient: torch.Tensor | None
    steady: torch.Tensor
    axis: TimeAxis | None
    metadata: dict[str, Any] = field(default_factory=dict)
    phasor: torch.Tensor | None = None
    frequencies: FrequencyAxis | None = None
    channels: tuple[str, ...] = ()
    gates: tuple[Gate, ...] | None = None


def check_target(path: str | Path) -> Path:
    """Return `path`, or raise StorageError when a result could not be written there. For before a long render."""
    target = Path(path)
    if target.suffix.lower() not in _ENDINGS:
        raise StorageError(f"result file: expected a name that ends in {', '.join(_ENDINGS)}, got '{target}'.")
    check_folder(target)
    if target.suffix.lower() in _HDF5:
        _h5py()
    return target


def check_folder(path: str | Path) -> None:
    """Raise StorageError when the folder of `path` is missing or closed to us, or `path` is a folder itself."""
    target = Path(path)
    folder = target.parent
    if not folder.is_dir():
        raise StorageError(f"result file: the folder '{folder}' does not exist. Create it first.")
    if target.is_dir() or not os.access(folder, os.W_OK):
        what = "is a folder" if target.is_dir() else f"cannot be written: no permission in '{folder}'"
        raise StorageError(f"result file: '{target}' {what}. Choose another place.")


def write_result(path: str | Path, output: RenderOutput, metadata: Mapping[str, Any] | None = None) -> Path:
    """Write a render. An existing file is replaced once the new one is complete.

    `metadata`: plain data (numbers, strings, lists, dictionaries) stored beside the statistics of the render. Raises
    StorageError for an unknown ending, a folder that is missing, a full disk, or metadata that is not plain.
    """
    target = check_target(path)
    stats = asdict(output.stats)
    try:
        note = json.dumps({**(metadata or {}), "stats": stats})
    except TypeError as error:
        raise StorageError(f"result file: metadata must be plain data ({error}).") from error
    measured, numbers = _measured(output)
    entries: dict[str, Any] = {"format": FORMAT, **numbers, "channels": json.dumps(output.channels), "metadata": note}
    arrays = {"steady": output.steady.detach().cpu().numpy(), **measured}
    with _replacing(target) as unfinished:
        if target.suffix.lower() in _HDF5:
            _write_hdf5(unfinished, arrays, entries)
        else:
            with unfinished.open("wb") as file:
                # numpy writes arrays that are not contiguous through a small buffer
                everything: dict[str, Any] = {**arrays, **{name: np.array(value) for name, value in entries.items()}}
                np.savez(file, **everything)
    return target


def _measured(output: RenderOutput) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Arrays and numbers of what the film measured beside the steady image."""
    if output.transient is not None and output.axis is not None:
        axis = output.axis
        arrays = {"transient": output.transient.detach().cpu().numpy(), "edges_opl": axis.edges_opl.numpy()}
        return arrays, {
            "start_opl": axis.start_opl,
            "bin_width_opl": axis.bin_width_opl,
            "num_bins": axis.num_bins,
        }
    if output.transient is not None and output.gates is not None:
        return {"transient": output.transient.detach().cpu().numpy()}, {"gates": gates_to_text(output.gates)}
    if output.phasor is not None and output.frequencies is not None:
        phasor = output.phasor.detach().resolve_conj().cpu().numpy()
        arrays = {"phasor": phasor, "frequencies_per_metre": output.frequencies.per_metre.numpy()}
        return arrays, {"start_opl": output.frequencies.start_opl}
    raise StorageError("result file: expected an output with a transient or a phasor, got neither.")


def read_result(path: str | Path) -> Result:
    """Read what `write_result` wrote, as tensors on the CPU.

    Raises StorageError when the file is missing, damaged or not a result.
    """
    source = Path(path)
    if source.suffix.lower() not in _ENDINGS:
        raise StorageError(f"result file: expected a name that ends in {', '.join(_ENDINGS)}, got '{source}'.")
    if not source.is_file():
        raise StorageError(f"result file: '{source}' does not exist.")
    try:
        values = _read_hdf5(source) if source.suffix.lower() in _HDF5 else _read_npz(source)
        form = str(values["format"])
        if form != FORMAT:
            raise StorageError(f"result file: '{source}' is of format '{form}'; this version reads '{FORMAT}'.")
        result = _result(values)
    except (OSError, KeyError, ValueError, TypeError, EOFError, zipfile.BadZipFile) as error:
        if isinstance(error, TorchTransientError):
            raise
        raise StorageError(
            f"result file: '{source}' is not a result of torchtransient, or is damaged: {error}."
        ) from error
    name, letter, cube = "transient", "T", result.transient
    count = 0 if result.axis is None else result.axis.num_bins
    if result.frequencies is not None:
        name, letter, cube, count = "phasor", "F", result.phasor, result.frequencies.num_frequencies
    elif result.gates is not None:
        letter, count = "G", len(result.gates)
    if cube is None or cube.ndim < 4 or cube.shape[-3] != count:
        shape = None if cube is None else tuple(cube.shape)
        raise StorageError(
            f"result file: '{source}' holds a {name} of shape {shape}; expected "
            f"(..., C, {letter}, H, W) with {letter} = {count}."
        )
    return result


def _result(values: Mapping[str, Any]) -> Result:
    metadata, steady = json.loads(str(values["metadata"])), torch.from_numpy(values["steady"])
    # Files of earlier versions have no names of channels.
    channels = tuple(json.loads(str(values.get("channels", "[]"))))
    if "gates" in values:
        transient, gates = torch.from_numpy(values["transient"]), gates_from_text(str(values["gates"]))
        return Result(transient, steady, None, metadata, channels=channels, gates=gates)
    start = float(values["start_opl"])
    if "phasor" in values:
        frequencies = FrequencyAxis(tuple(values["frequencies_per_metre"].tolist()), start)
        phasor = torch.from_numpy(values["phasor"])
        return Result(None, steady, None, metadata, phasor=phasor, frequencies=frequencies, channels=channels)
    axis = TimeAxis(start, float(values["bin_width_opl"]), int(values["num_bins"]))
    return Result(torch.from_numpy(values["transient"]), steady, axis, metadata, channels=channels)


@contextmanager
def _replacing(target: Path) -> Iterator[Path]:
    """A temporary neighbour of `target` that takes its place when the block succeeds and disappears when it fails."""
    unfinished = target.with_name(f".{target.name}.{secrets.token_hex(4)}.part")
    try:
        yield unfinished
        unfinished.replace(target)
    except OSError as error:
        raise StorageError(f"result file: '{target}' could not be written: {error}.") from error
    finally:
        unfinished.unlink(missing_ok=True)


def _write_hdf5(path: Path, arrays: Mapping[str, NDArray[Any]], entries: Mapping[str, Any]) -> None:
    with _h5py().File(path, "w") as file:
        for name, value in entries.items():
            file.attrs[name] = value
        for name, array in arrays.items():
            dataset = file.create_dataset(name, shape=array.shape, dtype=array.dtype)
            for part in _parts(array):
                dataset[part] = array[part]


def _parts(array: NDArray[Any]) -> Iterator[Any]:
    """Indices of rows of an image: the film keeps H first, so they are read in order, and only they are copied."""
    if array.ndim < 2:
        yield ...
        return
    rows = array.shape[-2]
    step = max(1, _PART_BYTES * rows // max(1, array.nbytes))
    for row in range(0, rows, step):
        yield ..., slice(row, row + step), slice(None)


def _read_hdf5(path: Path) -> dict[str, Any]:
    with _h5py().File(path, "r") as file:
        return {**{name: file[name][()] for name in file if name != "edges_opl"}, **dict(file.attrs)}


def _read_npz(path: Path) -> dict[str, Any]:
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def _h5py() -> Any:
    try:
        import h5py
    except ImportError as error:
        raise StorageError(
            "result file: HDF5 needs the package h5py. Install it with pip install 'torchtransient[data]', "
            "or choose a name that ends in .npz."
        ) from error
    return h5py
