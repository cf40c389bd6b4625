"""Arrays and entries by name in one file: HDF5 (`.h5`, `.hdf5`) or NumPy's `.npz`, chosen by the file's ending.

Entries are attributes of an HDF5 file and zero-dimensional arrays of an `.npz`. Large arrays are written in parts, so
that no second copy of them is needed, and a file takes its place once it is whole.

Every file has a checksum of all that it holds, as one text, JSON: ``{"entries": {name: digest}, "arrays": {name:
[rows, digest]}}``, digests in hexadecimal. A digest is the SHA-256 of the value's dtype, little-endian, and its shape
(of texts the text alone), then of its bytes in order; arrays of two and more dimensions are taken ``rows`` of their
last but one axis at a time, so that large ones are hashed as they are written. Files of the first version have none
and are read without a warning.
"""

from __future__ import annotations

import hashlib
import json
import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchtransient.array_files.hdf5 import check_size, hdf5_package, new_hdf5, read_attributes, read_dataset
from torchtransient.array_files.part_files import replacing as replacing
from torchtransient.checks import check_folder as check_folder
from torchtransient.checks import check_source as check_source
from torchtransient.checks import path_of as path_of
from torchtransient.checks import short_message, shown
from torchtransient.errors import StorageError, TorchTransientError

CHECKSUMS = "checksums"
HDF5 = (".h5", ".hdf5")
ENDINGS = (*HDF5, ".npz")
# What reads the library's kinds of files.
_READERS = {
    "torchtransient result": "torchtransient.files.read_result",
    "torchtransient capture": "tt.nlos.Capture.read",
    "torchtransient volume": "tt.nlos.read_volume",
}
_FOREIGN = " Of a capture of another program tt.nlos.Capture.read(path).write('scan.h5') makes a file of this library."
_PART_BYTES = 2**26
# What the readers of NumPy and h5py raise for files that are damaged or something else.
_DAMAGED = (
    OSError, KeyError, ValueError, TypeError, EOFError, zipfile.BadZipFile, RuntimeError, AttributeError, IndexError,
    ArithmeticError, zlib.error, struct.error, tokenize.TokenError, SyntaxError,
)  # fmt: skip


def check_target(path: str | Path, what: str) -> Path:
    """Return the path of a new file after checking that it can be written, for before long computations.

    Args:
        path: place of the file, ending in .h5, .hdf5 or .npz.
        what: subject of messages.

    Raises:
        StorageError: for another ending, and a folder that is missing or closed.
        MissingPackageError: for HDF5 without h5py.
    """
    target = _path_with_ending(path, what)
    check_folder(target, what)
    if target.suffix.lower() in HDF5:
        hdf5_package(what)
    return target


def write_arrays(target: Path, arrays: Mapping[str, NDArray[Any]], entries: Mapping[str, Any], what: str) -> None:
    """Write arrays and entries; a file that is there is replaced once the new one is complete.

    Args:
        target: checked path.
        arrays: arrays by name.
        entries: numbers and texts by name.
        what: subject of messages.

    Raises:
        StorageError: for a full disk.
    """
    with replacing(target, what) as unfinished:
        if target.suffix.lower() in HDF5:
            _write_hdf5(unfinished, arrays, entries, what)
            return
        digests = {name: (_rows(array), array_digest(array, _rows(array))) for name, array in arrays.items()}
        said = {**entries, CHECKSUMS: checksums_text(entries, digests)}
        with unfinished.open("wb") as file:
            # numpy writes arrays that are not contiguous through a small buffer
            everything: dict[str, Any] = {**arrays, **{name: np.array(value) for name, value in said.items()}}
            np.savez(file, **everything)


def read_arrays(path: str | Path, forms: Sequence[str], what: str, known: Callable[[str], bool]) -> dict[str, Any]:
    """Read a file of this library and compare it with its checksums.

    Args:
        path: the file.
        forms: formats that are read, values of its entry `format`, the current one last.
        what: subject of messages.
        known: predicate of names that are read; others are left alone.

    Returns:
        Arrays and entries by name.

    Raises:
        StorageError: for a file that is missing, of another format, or damaged.
    """
    source = check_source(_path_with_ending(path, what, _FOREIGN), what)
    with damage_said(source, what):
        found = _format_of(source, what)
        if not found:
            raise StorageError(f"{what}: '{source}' names no format, expected {forms[-1]!r}.{_FOREIGN}")
        if found not in forms:
            kind = found.rpartition(" ")[0]
            hint = f" {_READERS[kind]} reads it." if kind in _READERS and not forms[-1].startswith(kind) else ""
            raise StorageError(f"{what}: '{source}' is of format {shown(found)}, not {forms[-1]!r}.{hint}")
        return _values(source, what, known, found)


def _path_with_ending(path: str | Path, what: str, hint: str = "") -> Path:
    found = path_of(path, what)
    if found.suffix.lower() not in ENDINGS:
        raise StorageError(f"{what}: expected a name that ends in {', '.join(ENDINGS)}, got '{found}'.{hint}")
    return found


def read_some(path: Path, what: str, known: Callable[[str], bool], kind: str = "a file of arrays") -> dict[str, Any]:
    """Read arrays and entries of a file of any program.

    Args:
        path: the file.
        what: subject of messages.
        known: predicate of names that are read.
        kind: expected kind of file, for messages.

    Returns:
        Arrays and entries by name, compared with checksums where the file has them.

    Raises:
        StorageError: for a file that is missing, damaged or too large.
    """
    check_source(path, what)
    with damage_said(path, what, kind):
        return _values(path, what, known, _format_of(path, what))


def read_npy(path: Path, what: str) -> NDArray[Any]:
    """Read the array of a `.npy`.

    Args:
        path: the file.
        what: subject of messages.

    Raises:
        StorageError: for other files, objects, and arrays larger than the file.
    """
    check_source(path, what)
    with damage_said(path, what, "an array of NumPy"), path.open("rb") as stream:
        _check_array(stream, path.stat().st_size, f"{what}: '{path}'", packed=False)
        stream.seek(0)
        array: NDArray[Any] = np.lib.format.read_array(stream, allow_pickle=False)
        return array


def _format_of(source: Path, what: str) -> str:
    """Return the entry `format` of a file, "" without one."""
    found = _read(source, what, "format".__eq__).get("format", "")
    return str(np.asarray(found).reshape(-1)[0]) if np.size(found) else ""


def _values(source: Path, what: str, known: Callable[[str], bool], form: str) -> dict[str, Any]:
    values = _read(source, what, lambda name: name == CHECKSUMS or known(name))
    checksums = values.pop(CHECKSUMS, None)
    if checksums is not None:
        check(values, checksums, f"{what}: '{source}'", known)
    elif form.startswith("torchtransient ") and not form.endswith(" 1"):
        raise StorageError(f"{what}: '{source}' has lost its checksums: it is damaged. Take a copy.")
    return values


def _read(source: Path, what: str, known: Callable[[str], bool]) -> dict[str, Any]:
    return (_read_hdf5 if source.suffix.lower() in HDF5 else read_npz)(source, what, known)


@contextmanager
def damage_said(source: Path, what: str, kind: str = "") -> Iterator[None]:
    """Turn errors of readers, and of records made from what they read, into StorageError.

    Args:
        source: the file.
        what: subject of messages.
        kind: expected kind of a file of another program, "" for files of this library. With it, typed errors keep
            their message, since arguments may have been wrong.

    Raises:
        StorageError: for damage and for too little memory.
    """
    try:
        yield
    except MemoryError as error:
        raise StorageError(f"{what}: '{source}' does not fit into memory, or is damaged.") from error
    except _DAMAGED as error:
        if isinstance(error, StorageError):
            raise
        if isinstance(error, TorchTransientError) and kind:
            raise StorageError(f"{what}: '{source}': {error}") from error
        kind = kind or f"a {what.removesuffix(' file')} of torchtransient"
        raise StorageError(f"{what}: '{source}' is not {kind}, or is damaged: {short_message(error)}.") from error


def array_of(tensor: torch.Tensor, what: str) -> NDArray[Any]:
    """Return a tensor as an array on the CPU, on its memory where it lies there.

    Args:
        tensor: tensor on any device, with or without gradient.
        what: subject of messages.

    Raises:
        StorageError: for dtypes that NumPy does not have, and for sparse and meta tensors.
    """
    if tensor.layout != torch.strided or tensor.device.type == "meta":
        lacking = "on the device meta" if tensor.device.type == "meta" else f"of layout {tensor.layout}"
        raise StorageError(
            f"{what}: expected a tensor with all its numbers, got one {lacking}. Use tensor.to_dense(), or compute it "
            "on a device."
        )
    plain = tensor.detach().resolve_conj().resolve_neg().cpu()
    try:
        array: NDArray[Any] = plain.numpy()
    except TypeError as error:
        raise StorageError(f"{what}: {tensor.dtype} cannot be stored; use tensor.float() instead.") from error
    return array


def tensor_in(array: Any) -> torch.Tensor:
    """Return an array of a file as a tensor, on its memory if its bytes have this machine's order.

    Args:
        array: array of numbers.
    """
    found = np.asarray(array)
    return torch.from_numpy(found.astype(found.dtype.newbyteorder("="), copy=False))


def _write_hdf5(path: Path, arrays: Mapping[str, NDArray[Any]], entries: Mapping[str, Any], what: str) -> None:
    digests: dict[str, tuple[int, str]] = {}
    with new_hdf5(path, what) as file:
        for name, value in entries.items():
            file.attrs[name] = value
        for name, array in arrays.items():
            dataset = file.create_dataset(name, shape=array.shape, dtype=array.dtype)
            digest, rows = Digest(array.dtype, array.shape), _rows(array)
            for part in parts_of(array.shape, rows):
                # One copy for both.
                block = np.ascontiguousarray(array[part])
                dataset[part] = block.reshape(array[part].shape)
                digest.add(block)
            digests[name] = (rows, digest.text())
        file.attrs[CHECKSUMS] = checksums_text(entries, digests)


def _rows(array: NDArray[Any]) -> int:
    """Return the number of rows of an image that are written at a time."""
    return max(1, _PART_BYTES * array.shape[-2] // max(1, array.nbytes)) if array.ndim >= 2 else 1


def _read_hdf5(path: Path, what: str, known: Callable[[str], bool]) -> dict[str, Any]:
    with hdf5_package(what).File(path, "r") as file:
        arrays = {name: read_dataset(file, name, what) for name in file if known(name)}
        return {**arrays, **read_attributes(file, what, [name for name in file.attrs if known(name)])}


def read_npz(path: Path, what: str, known: Callable[[str], bool]) -> dict[str, Any]:
    """Read arrays of an `.npz`.

    Args:
        path: the file.
        what: subject of messages.
        known: predicate of names that are read.

    Returns:
        Arrays by name.

    Raises:
        StorageError: for pickles, names that stand twice, and more numbers than the file can hold. Other damage raises
            the errors of zipfile and NumPy.
    """
    found: dict[str, Any] = {}
    with zipfile.ZipFile(path) as file:
        for entry in file.infolist():
            name = entry.filename.removesuffix(".npy")
            if known(name):
                if name in found:
                    raise StorageError(f"{what}: '{name}' stands twice in '{path}': the file is damaged.")
                _check_member(file, entry, f"{what}: '{name}'", path.stat().st_size)
                with file.open(entry) as stream:
                    found[name] = np.lib.format.read_array(stream, allow_pickle=False)
    return found


def npz_shapes(path: Path, what: str) -> dict[str, tuple[int, ...] | None]:
    """Return the shape of each array of an `.npz` by its name, None for other members.

    Args:
        path: the file.
        what: subject of messages.

    Raises:
        StorageError: for arrays of versions that NumPy does not write for numbers. Other damage raises the errors of
            zipfile and NumPy.

    Pickles have a shape too; of names that stand twice the last one's is returned.
    """
    found: dict[str, tuple[int, ...] | None] = {}
    with zipfile.ZipFile(path) as file:
        for entry in file.infolist():
            name = entry.filename.removesuffix(".npy")
            found[name] = None
            if name != entry.filename and entry.compress_type in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                with file.open(entry) as stream:
                    found[name] = _head(stream, f"{what}: '{name}'")[0]
    return found


def _check_member(file: zipfile.ZipFile, entry: zipfile.ZipInfo, what: str, size: int) -> None:
    """Compare the shape that an array declares with its stored bytes, before there is memory for it."""
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise StorageError(f"{what} is packed as NumPy packs nothing (method {entry.compress_type}). Use np.savez.")
    # What it says of its size, but no more than there is.
    with file.open(entry) as stream:
        _check_array(stream, min(entry.compress_size, size), what)


def _head(stream: Any, what: str) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Return shape and dtype of the array that begins here."""
    read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    version = np.lib.format.read_magic(stream)
    if version not in read_header:
        raise StorageError(f"{what} is an array of version {version}, which NumPy writes for none of numbers.")
    shape, _, dtype = read_header[version](stream)
    return shape, dtype


def _check_array(stream: Any, stored: int, what: str, *, packed: bool = True) -> None:
    """Compare the head of an array with the bytes that are ``stored`` of it."""
    shape, dtype = _head(stream, what)
    if dtype.kind not in "biufcU":
        raise StorageError(f"{what} holds {str(dtype)[:60]}; expected numbers or a text. No pickle is read.")
    declared = math.prod(shape) * dtype.itemsize
    if not packed and declared > stored:
        raise StorageError(f"{what} declares {declared:,} bytes of numbers and stores {stored:,}: it is damaged.")
    check_size(declared, stored, f"{what} {shape}")


# ------------------------------------------------------------------------------------------------------------ checksums


class Digest:
    """Checksum of an array that comes in parts."""

    def __init__(self, dtype: np.dtype[Any], shape: tuple[int, ...]) -> None:
        self._found = hashlib.sha256(f"{dtype.newbyteorder('<').str}{tuple(shape)}".encode())

    def add(self, part: NDArray[Any]) -> None:
        """Add a part.

        Args:
            part: next numbers in order, of the digest's dtype.
        """
        little = np.ascontiguousarray(part, part.dtype.newbyteorder("<"))
        self._found.update(little.reshape(-1).view(np.uint8).data)

    def text(self) -> str:
        """Return the digest of all parts, hexadecimal."""
        return self._found.hexdigest()


def parts_of(shape: tuple[int, ...], rows: int) -> Iterator[Any]:
    """Yield indices of some rows of an image at a time.

    Films keep H first in memory, so parts are read in order, and they alone are copied.

    Args:
        shape: shape of the array, (..., H, W).
        rows: number of rows of a part.
    """
    if len(shape) < 2:
        yield ...
        return
    for row in range(0, shape[-2], rows):
        yield ..., slice(row, row + rows), slice(None)


def array_digest(array: NDArray[Any], rows: int) -> str:
    """Return the digest of an array.

    Args:
        array: array of numbers.
        rows: rows that are hashed at a time.
    """
    found = Digest(array.dtype, array.shape)
    for part in parts_of(array.shape, rows):
        found.add(array[part])
    return found.text()


def entry_digest(value: Any) -> str:
    """Return the digest of a number or a text.

    Args:
        value: number, text, or array of one.
    """
    array = np.asarray(value)
    if array.dtype.kind in "UO":
        return hashlib.sha256(b"text" + str(array.reshape(-1)[0]).encode("utf-8", "surrogatepass")).hexdigest()
    return array_digest(array, max(1, array.size))


def checksums_text(entries: Mapping[str, Any], arrays: Mapping[str, tuple[int, str]]) -> str:
    """Return the text of checksums that stands in a file.

    Args:
        entries: numbers and texts by name.
        arrays: rows and digests by name.
    """
    digests = {name: entry_digest(value) for name, value in entries.items()}
    return json.dumps({"entries": digests, "arrays": {name: list(found) for name, found in arrays.items()}})


def check(values: Mapping[str, Any], text: Any, what: str, known: Callable[[str], bool]) -> None:
    """Compare arrays and entries with the checksums of their file.

    Args:
        values: arrays and entries that were read, by name.
        text: checksums of the file.
        what: subject of messages.
        known: predicate of names that were read.

    Raises:
        StorageError: for a value that differs, is missing or was added.
    """
    try:
        stored = json.loads(str(np.asarray(text).reshape(-1)[0]))
        entries, arrays = dict(stored["entries"]), {name: (int(n), str(d)) for name, (n, d) in stored["arrays"].items()}
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError, IndexError):
        raise StorageError(f"{what}: the checksums cannot be read: the file is damaged. Take a copy of it.") from None
    for name in sorted({name for name in (*entries, *arrays) if known(name)} ^ set(values)):
        lacking = "is missing" if name not in values else "was put there later: it has no checksum"
        raise StorageError(f"{what}: '{name[:40]}' {lacking}. The file is damaged, or another program has changed it.")
    for name, value in values.items():
        if name in arrays:
            rows, expected = arrays[name]
            found = array_digest(np.asarray(value), rows) if rows >= 1 else ""
        else:
            expected, found = entries[name], entry_digest(value)
        if found != expected:
            raise StorageError(
                f"{what}: '{name}' is not what was written (its SHA-256 differs): the file is damaged, or another "
                "program has changed it. Take a copy, or read what is left with h5py or numpy."
            )
