"""Contents of files of other programs: arrays and texts by name, independent of the kind of file.

HDF5, MATLAB's files of both kinds (7.3, which are HDF5, and those before), NumPy's ``.npz``, and JSON. Arrays have the
order of HDF5 throughout; that of MATLAB is the reverse, so that its ``(y, x, t)`` comes as ``(t, x, y)``.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.array_files.array_file import check_source, damage_said, npz_shapes, read_npz
from torchtransient.array_files.hdf5 import check_memory, hdf5_package, read_attributes, read_dataset
from torchtransient.array_files.plain_texts import json_data, text_of_file
from torchtransient.checks import shown
from torchtransient.errors import StorageError
from torchtransient.files.captures.matlab import HEADER_BYTES, Mat5File

WHAT = "capture file"
_BLOCK = 64
# Root attributes that layouts ask for.
_ATTRIBUTES = ("data order",)


class Contents:
    """Open file of another program.

    Attributes:
        source: path of the file.
        shapes: root arrays and structures by name, None for entries without a shape.
        attributes: root attributes of HDF5 files as texts, those of `_ATTRIBUTES` alone.
    """

    source: Path
    shapes: Mapping[str, tuple[int, ...] | None]
    attributes: Mapping[str, str] = MappingProxyType({})

    def array(self, name: str, part: tuple[Any, ...] = ()) -> NDArray[Any] | None:
        """Return numbers, None for a name that is missing or empty.

        Args:
            name: name of the array; a field of a structure is ``structure/field``.
            part: index of the part that is returned, () for all of it.

        Raises:
            StorageError: for anything but numbers.
        """
        raise NotImplementedError

    def text(self, name: str) -> str | None:
        """Return a text, None if it is missing or empty.

        Args:
            name: name of the text.

        Raises:
            StorageError: for anything else.
        """
        raise NotImplementedError

    def fields(self, name: str) -> frozenset[str]:
        """Return the names in a structure, empty for other entries.

        Args:
            name: name of the structure.
        """
        return frozenset()


@contextmanager
def opened(path: str | Path) -> Iterator[Contents]:
    """Open an HDF5, MATLAB, NumPy or JSON file.

    Args:
        path: path of the file.

    Yields:
        Its contents.

    Raises:
        StorageError: for other files, and for damage.
    """
    source = check_source(path, WHAT)
    with damage_said(source, WHAT, "a capture of the layout that was read"):
        if zipfile.is_zipfile(source):
            yield NpzContents(source)
        elif _is_json(source):
            yield JsonContents(source)
        elif _is_old_mat(source):
            yield MatContents(source)
        elif (h5py := hdf5_package(WHAT)).is_hdf5(source):
            with h5py.File(source, "r") as file:
                yield Hdf5Contents(source, file)
        else:
            raise StorageError(f"{WHAT}: '{source}' is no JSON, NumPy, MATLAB or HDF5 file, or is damaged.")


class Hdf5Contents(Contents):
    """Open HDF5 file."""

    def __init__(self, source: Path, file: Any) -> None:
        self.source, self._file = source, file
        self.shapes = {name: getattr(self._entry(name), "shape", None) for name in file if name != "#refs#"}
        said = read_attributes(file, WHAT, _ATTRIBUTES)
        self.attributes = {name: _sole(value) for name, value in said.items()}

    def _entry(self, name: str) -> Any:
        """Return a dataset or group of the file itself, None for a link to elsewhere, or to nothing."""
        import h5py

        return self._file[name] if isinstance(self._file.get(name, getlink=True), h5py.HardLink) else None

    def array(self, name: str, part: tuple[Any, ...] = ()) -> NDArray[Any] | None:
        value = read_dataset(self._file, name, WHAT, part)
        if isinstance(value, str):
            raise StorageError(f"{WHAT}: expected numbers in '{name}', got a text.")
        return None if value is None or value.size == 0 else value

    def text(self, name: str) -> str | None:
        value = read_dataset(self._file, name, WHAT)
        if value is not None and not isinstance(value, str):
            raise StorageError(f"{WHAT}: expected a text in '{name}', got numbers {value.shape}.")
        return value

    def fields(self, name: str) -> frozenset[str]:
        found = self._entry(name)
        return frozenset(found) if hasattr(found, "keys") else frozenset()


def _sole(value: Any) -> str:
    """Return a text, also of an array of one."""
    sole = np.asarray(value).reshape(-1)[0] if np.size(value) == 1 else value
    return sole.decode("utf-8", "replace") if isinstance(sole, bytes) else str(sole)


class MatContents(Contents):
    """MATLAB file of versions 5 to 7."""

    def __init__(self, source: Path) -> None:
        self.source = source
        self._file = Mat5File(source)
        self.shapes = {name: variable.shape for name, variable in self._file.variables.items()}
        self._kept: dict[str, Any] = {}

    def array(self, name: str, part: tuple[Any, ...] = ()) -> NDArray[Any] | None:
        value: Any = self._variable(name.split("/")[0])
        for field in name.split("/")[1:]:
            if not isinstance(value, dict):
                raise StorageError(f"{WHAT}: expected one structure with '{name}', got {shown(value)}.")
            value = value.get(field)
        if value is not None and not isinstance(value, np.ndarray):
            raise StorageError(f"{WHAT}: expected an array of numbers in '{name}', got {shown(value)}.")
        return None if value is None else value[part]

    def text(self, name: str) -> str | None:
        value = self._variable(name)
        if value is not None and not isinstance(value, str):
            raise StorageError(f"{WHAT}: expected a text in '{name}', got {shown(value)}.")
        return value

    def fields(self, name: str) -> frozenset[str]:
        value = self._variable(name)
        return frozenset(value) if isinstance(value, dict) else frozenset()

    def _variable(self, name: str) -> Any:
        if name not in self.shapes:
            return None
        if name not in self._kept:
            self._kept[name] = self._file.read(name, WHAT)
        return self._kept[name]


class NpzContents(Contents):
    """Arrays of NumPy in one file. Pickles are not read."""

    def __init__(self, source: Path) -> None:
        self.source = source
        self.shapes = npz_shapes(source, WHAT)

    def array(self, name: str, part: tuple[Any, ...] = ()) -> NDArray[Any] | None:
        array = read_npz(self.source, WHAT, name.__eq__).get(name)
        if array is not None and array.dtype.kind == "U":
            raise StorageError(f"{WHAT}: expected numbers in '{name}', got a text.")
        return None if array is None or array.size == 0 else array[part]

    def text(self, name: str) -> str | None:
        array = read_npz(self.source, WHAT, name.__eq__).get(name)
        return None if array is None else _sole(array)


class JsonContents(Contents):
    """JSON object, or list of objects: frames whose entries have one shape each. Arrays are (frames, ...)."""

    def __init__(self, source: Path) -> None:
        self.source = source
        # Python's objects take some 30 bytes for each letter at most.
        check_memory(32 * source.stat().st_size, f"{WHAT}: '{source}'")
        data = json_data(text_of_file(source, WHAT).removeprefix("\ufeff"), f"{WHAT}: '{source}'")
        self._frames = data if isinstance(data, list) else [data]
        if not self._frames or not all(isinstance(frame, dict) for frame in self._frames):
            raise StorageError(f"{WHAT}: '{source}': expected a JSON object or a list of objects, got something else.")
        names = set.intersection(*(set(frame) for frame in self._frames))
        self.shapes = dict.fromkeys(sorted(names))

    def array(self, name: str, part: tuple[Any, ...] = ()) -> NDArray[Any] | None:
        values = [self._entry(frame, name) for frame in self._frames]
        if all(value is None for value in values):
            return None
        try:
            array = np.array(values)
        except (ValueError, OverflowError):  # of different shapes
            array = np.empty((), object)
        if array.dtype.kind not in "biuf":
            raise StorageError(f"{WHAT}: expected numbers of one shape in '{name}' of every frame, got others.")
        return None if array.size == 0 else array[part]

    def text(self, name: str) -> str | None:
        value = self.entry(name)
        return value if isinstance(value, str) else None

    def fields(self, name: str) -> frozenset[str]:
        value = self.entry(name)
        return frozenset(value) if isinstance(value, dict) else frozenset()

    def entry(self, name: str, frame: int = 0) -> Any:
        """Return plain data of one frame, None if it has no such entry.

        Args:
            name: name of the entry.
            frame: index of the frame.
        """
        return self._entry(self._frames[frame], name)

    @staticmethod
    def _entry(frame: Any, name: str) -> Any:
        """Return an entry; ``a/b`` is the entry b of the object a, or of the one object in the list a."""
        for part in name.split("/"):
            frame = frame[0] if isinstance(frame, list) and len(frame) == 1 else frame
            frame = frame.get(part) if isinstance(frame, dict) else None
        return frame


def _is_json(source: Path) -> bool:
    """Return whether a file begins as an object or a list of JSON does."""
    with source.open("rb") as file:
        start = b""
        while not start and (block := file.read(_BLOCK)):
            start = block.lstrip(b"\xef\xbb\xbf \t\r\n")
    return start[:1] in (b"{", b"[")


def _is_old_mat(source: Path) -> bool:
    with source.open("rb") as file:
        start = file.read(HEADER_BYTES)
    # Version 0x0100, whose bytes tell their order; 7.3 has 0x0200 and is HDF5.
    return len(start) == HEADER_BYTES and start[124:] in (b"\x00\x01IM", b"\x01\x00MI")
