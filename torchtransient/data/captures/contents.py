"""What lies in a file of another program: arrays and texts by name, whatever kind of file it is.

HDF5, and MATLAB's files of both kinds: 7.3, which are HDF5, and those before. Arrays have the order of HDF5 throughout;
that of MATLAB is the other way round, so that its ``(y, x, t)`` comes as ``(t, x, y)``.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from torchtransient.data.array_file import check_source, damage_said
from torchtransient.data.hdf5_limits import check_memory, check_size, read_attributes, read_dataset
from torchtransient.data.hdf5_writing import hdf5_package
from torchtransient.errors import StorageError

WHAT = "capture file"
_HEADER_BYTES = 128
# Bytes of a value, by what scipy calls its class; others are no arrays of numbers.
_BYTES = {
    "double": 8, "single": 4, "int8": 1, "uint8": 1, "int16": 2, "uint16": 2, "int32": 4, "uint32": 4, "int64": 8,
    "uint64": 8, "logical": 1,
}  # fmt: skip
_COMPRESSED = 15


class Contents(Protocol):
    """``shapes``: root arrays and structures by name, None for what has no shape; ``source``: the file.

    ``array(name)``: numbers, None where the name is missing or empty; names of a structure's fields are
    ``structure/field``. ``text(name)`` likewise.
    """

    source: Path
    shapes: Mapping[str, tuple[int, ...] | None]
    attributes: Mapping[str, str]

    def array(self, name: str, part: tuple[Any, ...] = ()) -> NDArray[Any] | None: ...
    def text(self, name: str) -> str | None: ...
    def fields(self, name: str) -> frozenset[str]: ...


@contextmanager
def opened(path: str | Path) -> Iterator[Contents]:
    """The contents of an HDF5 or MATLAB file. Raises StorageError for others, and for what is damaged."""
    source = check_source(path, WHAT)
    with damage_said(source, WHAT, "a capture of the layout that was read"):
        if _is_old_mat(source):
            yield MatContents(source)
            return
        with hdf5_package(WHAT).File(source, "r") as file:
            yield Hdf5Contents(source, file)


class Hdf5Contents:
    """An open HDF5 file."""

    def __init__(self, source: Path, file: Any) -> None:
        self.source, self._file = source, file
        self.shapes: Mapping[str, tuple[int, ...] | None] = {
            name: self._shape(name) for name in file if name != "#refs#"
        }
        self.attributes: Mapping[str, str] = {
            name: _sole(value) for name, value in read_attributes(file, WHAT, ["data order"]).items()
        }

    def _shape(self, name: str) -> tuple[int, ...] | None:
        import h5py

        if not isinstance(self._file.get(name, getlink=True), h5py.HardLink):
            return None
        found = self._file[name]
        return found.shape if isinstance(found, h5py.Dataset) else None

    def array(self, name: str, part: tuple[Any, ...] = ()) -> NDArray[Any] | None:
        value = self._read(name, part)
        if isinstance(value, str):
            raise StorageError(f"{WHAT}: expected numbers in '{name}', got a text.")
        return None if value is None or value.size == 0 else value

    def text(self, name: str) -> str | None:
        value = self._read(name)
        if value is not None and not isinstance(value, str):
            raise StorageError(f"{WHAT}: expected a text in '{name}', got numbers {value.shape}.")
        return value

    def fields(self, name: str) -> frozenset[str]:
        """The names in a structure; empty for what is none."""
        import h5py

        if not isinstance(self._file.get(name, getlink=True), h5py.HardLink):
            return frozenset()
        found = self._file[name]
        return frozenset(found) if isinstance(found, h5py.Group) else frozenset()

    def _read(self, name: str, part: tuple[Any, ...] = ()) -> NDArray[Any] | str | None:
        return read_dataset(self._file, name, WHAT, part)


def _sole(value: Any) -> str:
    """A text, also one in an array of one."""
    sole = np.asarray(value).reshape(-1)[0] if np.size(value) == 1 else value
    return sole.decode("utf-8", "replace") if isinstance(sole, bytes) else str(sole)


class MatContents:
    """A MATLAB file of versions 5 to 7, read by scipy."""

    def __init__(self, source: Path) -> None:
        self.source = source
        self._io = _scipy_io()
        with _errors_said(source):
            found = self._io.whosmat(str(source))
        parts = _parts(source)
        if len(parts) != len(found):
            raise StorageError(f"{WHAT}: '{source}' has {len(parts)} parts and {len(found)} variables: it is damaged.")
        self._parts = {name: (kind, *part) for (name, _, kind), part in zip(found, parts, strict=True)}
        shapes = {name: None if kind == "struct" else tuple(reversed(shape)) for name, shape, kind in found}
        self.shapes: Mapping[str, tuple[int, ...] | None] = shapes
        self._kept: dict[str, Any] = {}
        self.attributes: Mapping[str, str] = {}

    def array(self, name: str, part: tuple[Any, ...] = ()) -> NDArray[Any] | None:
        value: Any = self._variable(name.split("/")[0])
        for field in name.split("/")[1:]:
            if not isinstance(value, np.ndarray) or value.dtype.names is None or value.size != 1:
                raise StorageError(f"{WHAT}: expected one structure with '{name}', got {type(value).__name__}.")
            if field not in value.dtype.names:
                return None
            value = value.reshape(-1)[0][field]
        if value is None or (isinstance(value, np.ndarray) and value.size == 0):
            return None
        if not isinstance(value, np.ndarray) or value.dtype.kind not in "biufc":
            found = f"an array of {value.dtype}" if isinstance(value, np.ndarray) else f"a {type(value).__name__}"
            raise StorageError(f"{WHAT}: expected an array of numbers in '{name}', got {found}.")
        turned: NDArray[Any] = value.T[part]
        return turned

    def text(self, name: str) -> str | None:
        value = self._variable(name)
        return None if value is None else str(np.asarray(value).reshape(-1)[0])

    def fields(self, name: str) -> frozenset[str]:
        value = self._variable(name)
        return frozenset(getattr(getattr(value, "dtype", None), "names", None) or ())

    def _variable(self, name: str) -> Any:
        if name not in self.shapes:
            return None
        if name not in self._kept:
            self._check(name, math.prod(self.shapes[name] or ()))
            with _errors_said(self.source):
                self._kept[name] = self._io.loadmat(str(self.source), variable_names=[name])[name]
        return self._kept[name]

    def _check(self, name: str, values: int) -> None:
        """Compare what is declared with what is stored before memory is asked for. MATLAB stores values in as few bytes
        as hold them, at least one for each.
        """
        kind, unpacked, stored = self._parts[name]
        what = f"{WHAT}: '{name}' {self.shapes[name] or kind}"
        check_size(unpacked, stored, what)
        if kind in _BYTES:
            check_size(values, unpacked, what)
            check_memory(values * _BYTES[kind], what)


def _parts(source: Path) -> list[tuple[int, int]]:
    """How many bytes each variable has unpacked, as its tag says, and as it is stored."""
    found: list[tuple[int, int]] = []
    with source.open("rb") as file:
        order = "<" if file.read(_HEADER_BYTES).endswith(b"IM") else ">"
        while len(tag := file.read(8)) == 8:
            kind, size = struct.unpack(f"{order}II", tag)
            place, unpacked = file.tell(), size
            if kind == _COMPRESSED:
                inner = zlib.decompressobj().decompress(file.read(min(size, 4096)), 8)
                unpacked = struct.unpack(f"{order}II", inner)[1]
            found.append((unpacked, size))
            file.seek(place + size)
    return found


def _is_old_mat(source: Path) -> bool:
    with source.open("rb") as file:
        start = file.read(_HEADER_BYTES)
    # Version 0x0100, whose bytes tell their order; 7.3 has 0x0200 and is HDF5.
    return len(start) == _HEADER_BYTES and start[124:] in (b"\x00\x01IM", b"\x01\x00MI")


@contextmanager
def _errors_said(source: Path) -> Iterator[None]:
    """What scipy has errors of its own for, as StorageError."""
    from scipy.io.matlab import MatReadError

    try:
        yield
    except MatReadError as error:
        raise StorageError(f"{WHAT}: '{source}' is no MATLAB file, or is damaged: {error}.") from None


def _scipy_io() -> Any:
    try:
        import scipy.io
    except ImportError as error:
        raise StorageError(
            f"{WHAT}: MATLAB's files before version 7.3 need scipy. Install it with pip install "
            "'torchtransient[data]', or save the file with MATLAB's option -v7.3."
        ) from error
    return scipy.io
