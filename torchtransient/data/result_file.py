"""A render on disk: HDF5 (`.h5`, `.hdf5`) or NumPy's `.npz`, chosen by the file's ending.

Both hold the same names. Arrays have torch's order: `steady` float32 (..., C, H, W) and one of `transient` float32
(..., C, T, H, W), radiance integrated over each bin, with `edges_opl` float64 (T + 1,), metres; `phasor` complex64
(..., C, F, H, W) with `frequencies_per_metre` float64 (F,), cycles per metre of optical path; or `gated` float32 (...,
C, G, H, W) with `gates` (the text of scene files), where files of earlier versions say `transient`. Polarized variants
have the four Stokes components before C. The numbers of the axis (`start_opl`, and for a transient `bin_width_opl`, in
metres, `num_bins`), `channels` (JSON: the names of the C channels), `format` and `metadata` (JSON) are attributes of
the HDF5 file and zero-dimensional arrays of the `.npz`. A cube is written in parts, so that no second copy of it is
needed.
"""

from __future__ import annotations

import json
import os
import secrets
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.errors import StorageError, TorchTransientError
from torchtransient.gates import Gate
from torchtransient.render.films.choices import of_entries, of_output
from torchtransient.render.output import RenderOutput, named_fields
from torchtransient.tensor_record import TensorRecord

FORMAT = "torchtransient result 1"
_HDF5 = (".h5", ".hdf5")
_ENDINGS = (*_HDF5, ".npz")
_PART_BYTES = 2**26


@dataclass(frozen=True, repr=False)
class Result(TensorRecord):
    """What `read_result` returns: the tensors of a render, its axis, and what was noted about its making.

    `transient` with `axis`, `phasor` with `frequencies` or `gated` with `gates`; the others are None. `others`: tensors
    and settings of films that have no attribute here, by name. A batch of results (``stack``, ``cat``,
    ``torch.utils.data.default_collate``) has the metadata of each as a list under `batch`.
    """

    notes: ClassVar[tuple[str, ...]] = ("metadata",)

    transient: torch.Tensor | None
    steady: torch.Tensor
    axis: TimeAxis | None
    metadata: dict[str, Any] = field(default_factory=dict)
    phasor: torch.Tensor | None = None
    frequencies: FrequencyAxis | None = None
    channels: tuple[str, ...] = ()
    gates: tuple[Gate, ...] | None = None
    gated: torch.Tensor | None = None
    others: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def merged_notes(cls, records: Sequence[Result]) -> dict[str, Any]:
        return {"metadata": {"batch": [record.metadata for record in records]}}

    def _shown_notes(self) -> dict[str, str]:
        return {"metadata": ", ".join(self.metadata)} if self.metadata else {}


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


def write_result(path: str | Path, output: RenderOutput | Result, metadata: Mapping[str, Any] | None = None) -> Path:
    """Write a render, or a result that was read. An existing file is replaced once the new one is complete.

    `metadata`: plain data (numbers, strings, lists, dictionaries) stored beside the statistics of the render. Raises
    StorageError for an unknown ending, a folder that is missing, a full disk, or metadata that is not plain.
    """
    target = check_target(path)
    given: Any = output
    if not isinstance(given, RenderOutput | Result):
        raise StorageError(
            f"result file: expected what a render returned, a RenderOutput, got {type(given).__name__}. Tensors alone "
            "have no axis; write them with torch.save."
        )
    own = {"stats": asdict(output.stats)} if isinstance(output, RenderOutput) else output.metadata
    try:
        note = json.dumps({**(metadata or {}), **own})
    except TypeError as error:
        raise StorageError(f"result file: metadata must be plain data ({error}).") from error
    film = of_output(output)
    tensor = None if film is None else film.tensor(output)
    if film is None or tensor is None:
        raise StorageError(
            "result file: expected an output with what its film measured, transient and axis for instance, got neither."
        )
    entries: dict[str, Any] = {
        "format": FORMAT, **film.numbers(), "channels": json.dumps(output.channels), "metadata": note,
    }  # fmt: skip
    arrays = {"steady": _array(output.steady), film.measures: _array(tensor), **film.arrays()}
    with _replacing(target) as unfinished:
        if target.suffix.lower() in _HDF5:
            _write_hdf5(unfinished, arrays, entries)
        else:
            with unfinished.open("wb") as file:
                # numpy writes arrays that are not contiguous through a small buffer
                everything: dict[str, Any] = {**arrays, **{name: np.array(value) for name, value in entries.items()}}
                np.savez(file, **everything)
    return target


def _array(tensor: torch.Tensor) -> NDArray[Any]:
    array: NDArray[Any] = tensor.detach().resolve_conj().cpu().numpy()
    return array


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
        result = _result(values, source)
    except (OSError, KeyError, ValueError, TypeError, EOFError, zipfile.BadZipFile) as error:
        if isinstance(error, TorchTransientError):
            raise
        raise StorageError(
            f"result file: '{source}' is not a result of torchtransient, or is damaged: {error}."
        ) from error
    return result


def _result(values: Mapping[str, Any], source: Path) -> Result:
    metadata, steady = json.loads(str(values["metadata"])), torch.from_numpy(values["steady"])
    # Files of earlier versions have no names of channels.
    channels = tuple(json.loads(str(values.get("channels", "[]"))))
    film = of_entries(values)
    response = torch.from_numpy(film.tensor_in(values))
    if response.ndim < 4 or response.shape[-3] != film.count:
        raise StorageError(
            f"result file: '{source}' holds a {film.measures} of shape {tuple(response.shape)}; expected "
            f"(..., C, {film.letter}, H, W) with {film.letter} = {film.count}."
        )
    return Result(steady=steady, metadata=metadata, channels=channels, **named_fields(film, response))


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
