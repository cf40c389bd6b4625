"""Arrays and entries by name in one file: HDF5 (`.h5`, `.hdf5`) or NumPy's `.npz`, chosen by the file's ending.

Entries are attributes of an HDF5 file and zero-dimensional arrays of an `.npz`. Large arrays are written in parts, so
that no second copy of them is needed, and a file takes its place once it is whole.
"""

from __future__ import annotations

import os
import secrets
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchtransient.data.hdf5_limits import read_attributes, read_dataset
from torchtransient.errors import StorageError
from torchtransient.quantities import shown

HDF5 = (".h5", ".hdf5")
ENDINGS = (*HDF5, ".npz")
_PART_BYTES = 2**26
# What the readers of NumPy and h5py raise for files that are damaged or something else.
_DAMAGED = (
    OSError, KeyError, ValueError, TypeError, EOFError, zipfile.BadZipFile, RuntimeError, AttributeError, IndexError,
    ArithmeticError, zlib.error, struct.error, tokenize.TokenError, SyntaxError,
)  # fmt: skip


def path_of(path: Any, what: str) -> Path:
    """`path` as a Path. Raises StorageError for what is no name of a file."""
    try:
        return Path(path)
    except TypeError:
        raise StorageError(f"{what}: expected the name of a file, got {shown(path)}.") from None


def check_target(path: str | Path, what: str) -> Path:
    """Return `path`, or raise StorageError when a file could not be written there. For before long computations.

    `what`: what the file is, for messages.
    """
    target = path_of(path, what)
    if target.suffix.lower() not in ENDINGS:
        raise StorageError(f"{what}: expected a name that ends in {', '.join(ENDINGS)}, got '{target}'.")
    check_folder(target, what)
    if target.suffix.lower() in HDF5:
        hdf5_package(what)
    return target


def check_folder(path: str | Path, what: str) -> None:
    """Raise StorageError when the folder of `path` is missing or closed to us, or `path` is a folder itself."""
    target = path_of(path, what)
    folder = target.parent
    if not folder.is_dir():
        raise StorageError(f"{what}: the folder '{folder}' does not exist. Create it first.")
    if target.is_dir() or not os.access(folder, os.W_OK):
        problem = "is a folder" if target.is_dir() else f"cannot be written: no permission in '{folder}'"
        raise StorageError(f"{what}: '{target}' {problem}. Choose another place.")


def write_arrays(target: Path, arrays: Mapping[str, NDArray[Any]], entries: Mapping[str, Any], what: str) -> None:
    """Write a file that was checked. One that is there is replaced once the new one is complete. Raises StorageError
    for a full disk.
    """
    with replacing(target, what) as unfinished:
        if target.suffix.lower() in HDF5:
            _write_hdf5(unfinished, arrays, entries, what)
            return
        with unfinished.open("wb") as file:
            # numpy writes arrays that are not contiguous through a small buffer
            everything: dict[str, Any] = {**arrays, **{name: np.array(value) for name, value in entries.items()}}
            np.savez(file, **everything)


def read_arrays(path: str | Path, form: str, what: str) -> dict[str, Any]:
    """Everything by name, arrays and entries, of a file whose entry `format` is `form`.

    Raises StorageError for a file that is missing, of another format, or damaged.
    """
    source = path_of(path, what)
    if source.suffix.lower() not in ENDINGS:
        raise StorageError(f"{what}: expected a name that ends in {', '.join(ENDINGS)}, got '{source}'.")
    if not source.is_file():
        raise StorageError(f"{what}: '{source}' does not exist.")
    with damage_said(source, what):
        values = _read_hdf5(source, what) if source.suffix.lower() in HDF5 else _read_npz(source)
        found = str(values["format"])
        if found != form:
            raise StorageError(f"{what}: '{source}' is of format '{found}'; this version reads '{form}'.")
        return values


@contextmanager
def damage_said(source: Path, what: str, kind: str = "") -> Iterator[None]:
    """Errors of readers, and of what is made of what they read, as StorageError. ``kind``: what was expected."""
    try:
        yield
    except MemoryError as error:
        raise StorageError(f"{what}: '{source}' does not fit into memory, or is damaged.") from error
    except _DAMAGED as error:
        if isinstance(error, StorageError):
            raise
        kind = kind or f"a {what.removesuffix(' file')} of torchtransient"
        raise StorageError(f"{what}: '{source}' is not {kind}, or is damaged: {error}.") from error


def array_of(tensor: torch.Tensor, what: str) -> NDArray[Any]:
    """A tensor as an array on the CPU. Raises StorageError for dtypes that NumPy does not have."""
    plain = tensor.detach().resolve_conj().resolve_neg().cpu()
    try:
        array: NDArray[Any] = plain.numpy()
    except TypeError as error:
        raise StorageError(f"{what}: {tensor.dtype} cannot be stored; use tensor.float() instead.") from error
    return array


@contextmanager
def replacing(target: Path, what: str) -> Iterator[Path]:
    """A temporary neighbour of `target` that takes its place when the block succeeds and disappears when it fails."""
    unfinished = target.with_name(f".{target.name}.{secrets.token_hex(4)}.part")
    try:
        yield unfinished
        unfinished.replace(target)
    except OSError as error:
        raise StorageError(f"{what}: '{target}' could not be written: {error}.") from error
    finally:
        unfinished.unlink(missing_ok=True)


def _write_hdf5(path: Path, arrays: Mapping[str, NDArray[Any]], entries: Mapping[str, Any], what: str) -> None:
    with hdf5_package(what).File(path, "w") as file:
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


def _read_hdf5(path: Path, what: str) -> dict[str, Any]:
    with hdf5_package(what).File(path, "r") as file:
        return {**{name: read_dataset(file, name, what) for name in file}, **read_attributes(file, what)}


def _read_npz(path: Path) -> dict[str, Any]:
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def hdf5_package(what: str) -> Any:
    """The module h5py. Raises StorageError where it is missing."""
    try:
        import h5py
    except ImportError as error:
        raise StorageError(
            f"{what}: HDF5 needs the package h5py. Install it with pip install 'torchtransient[data]', "
            "or choose a name that ends in .npz."
        ) from error
    return h5py
