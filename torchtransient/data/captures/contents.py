"""What lies in a file of another program: arrays and texts by name, whatever kind of file it is.

HDF5, and MATLAB's files of both kinds: 7.3, which are HDF5, and those before. Arrays have the order of HDF5 throughout;
that of MATLAB is the other way round, so that its ``(y, x, t)`` comes as ``(t, x, y)``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from torchtransient.data.array_file import damage_said, hdf5_package, path_of
from torchtransient.data.hdf5_limits import check_size, read_attributes, read_dataset
from torchtransient.errors import StorageError

WHAT = "capture file"
_HEADER_BYTES = 128
_BYTES_PER_VALUE = 8


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
    source = path_of(path, WHAT)
    if not source.is_file():
        raise StorageError(f"{WHAT}: '{source}' does not exist.")
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
            name: str(value) for name, value in read_attributes(file, WHAT, ["data order"]).items()
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


class MatContents:
    """A MATLAB file of versions 5 to 7, read by scipy."""

    def __init__(self, source: Path) -> None:
        self.source = source
        self._io = _scipy_io()
        self._size = source.stat().st_size
        with _errors_said(source):
            found = self._io.whosmat(str(source))
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
            raise StorageError(f"{WHAT}: expected numbers in '{name}', got {getattr(value, 'dtype', type(value))}.")
        found: NDArray[Any] = value.T[part]
        return found

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
            declared = math.prod(self.shapes[name] or ()) * _BYTES_PER_VALUE
            check_size(declared, self._size, f"{WHAT}: '{name}' {self.shapes[name]}")
            with _errors_said(self.source):
                self._kept[name] = self._io.loadmat(str(self.source), variable_names=[name])[name]
        return self._kept[name]


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
