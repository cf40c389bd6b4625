"""MATLAB files: a reader of versions 5 to 7 ("MAT-File Format", The MathWorks, level 5) and a writer of version 7.3.

Numbers, texts and structures of them are read, and sizes compared with the file's. Other readers trust the types that
a damaged file names, and may end the process. Version 7.3 is HDF5 with a header in front and the class of each array
beside it.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.array_files.array_file import replacing
from torchtransient.array_files.hdf5 import check_memory, check_size, new_hdf5, write_parts

# Version 7.3 is HDF5 behind a header.
_HEADER = b"MATLAB 7.3 MAT-file, Platform: torchtransient, HDF5 schema 1.00 ."
_USER_BLOCK = 512
_WHAT = "capture file"
_CLASSES = {"float64": "double", "float32": "single", "bool": "logical"}

HEADER_BYTES = 128
# How numbers are stored, by the types of elements; texts have their letters in some of these.
_STORED = {
    1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8", 16: "u1", 17: "u2",
    18: "u4",
}  # fmt: skip
_MATRIX, _COMPRESSED = 14, 15
_INT32, _UINT32, _UTF8 = 5, 6, 16
# What they are, by the classes of arrays. Logical ones are bytes, as in version 7.3.
_NUMBERS = {
    6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8",
}  # fmt: skip
_OTHERS = {1: "a cell array", 2: "an array of structures", 3: "an object", 4: "a text", 5: "a sparse matrix"}
_STRUCTURE, _TEXT = 2, 4
_COMPLEX = 0x0800
# Of the start of a variable: its class, dimensions and name.
_START_BYTES = 4096
_LEVELS = 10

Value = NDArray[Any] | str | dict[str, Any] | None


@dataclass(frozen=True)
class Other:
    """Value other than numbers, a text or one structure; ``kind`` in words."""

    kind: str


@dataclass(frozen=True)
class Variable:
    """Variable whose values have not been read.

    Attributes:
        name: name of the variable.
        shape: shape in the order of HDF5, the reverse of MATLAB's; None for structures.
        place: offset in the file.
        stored: number of bytes in the file.
        unpacked: number of bytes of the values.
        compressed: whether the values are packed by zlib.
    """

    name: str
    shape: tuple[int, ...] | None
    place: int
    stored: int
    unpacked: int
    compressed: bool


# ------------------------------------------------------------------------------------------------------ versions 5 to 7


class Mat5File:
    """File of version 5 to 7. Raises ValueError, StorageError and zlib.error for damage."""

    def __init__(self, source: Path) -> None:
        self._source = source
        with source.open("rb") as file:
            self._order = "<" if file.read(HEADER_BYTES).endswith(b"IM") else ">"
            self.variables = {variable.name: variable for variable in self._listed(file)}

    def read(self, name: str, what: str) -> Value | Other:
        """Return numbers in the order of HDF5, a text, a structure by its fields; None for an empty value.

        Args:
            name: name of a variable.
            what: subject of messages.
        """
        variable = self.variables[name]
        what = f"{what}: '{name}' {variable.shape or ''}".rstrip()
        check_size(variable.unpacked, variable.stored, what)
        with self._source.open("rb") as file:
            file.seek(variable.place)
            data: bytes | bytearray = bytearray(variable.stored)
            file.readinto(data)
        if not variable.compressed:
            return _value(memoryview(data), self._order, what, 0)
        data = zlib.decompressobj().decompress(data, variable.unpacked + 8)
        return _value(memoryview(data)[8:], self._order, what, 0)

    def _listed(self, file: Any) -> Iterator[Variable]:
        size = self._source.stat().st_size
        while len(tag := file.read(8)) == 8:
            kind, stored = struct.unpack(f"{self._order}II", tag)
            place, unpacked = file.tell(), stored
            if place + stored > size:
                raise ValueError(f"a variable of {stored} bytes does not end in a file of {size}")
            start = file.read(min(stored, _START_BYTES))
            if kind == _COMPRESSED:
                start = zlib.decompressobj().decompress(start, _START_BYTES)
                inner, unpacked = struct.unpack(f"{self._order}II", start[:8])
                start = start[8:]
            if (inner if kind == _COMPRESSED else kind) != _MATRIX:
                raise ValueError(f"expected a variable at byte {place - 8}, got an element of type {kind}")
            flags, dims, name = _head(_Elements(memoryview(start), self._order))
            if name:  # else functions' own
                shape = None if flags & 0xFF == _STRUCTURE else dims
                yield Variable(name, shape, place, stored, unpacked, kind == _COMPRESSED)
            file.seek(place + stored)


class _Elements:
    """Elements of a matrix, one behind another."""

    def __init__(self, data: memoryview, order: str) -> None:
        self._data, self.order, self._at = data, order, 0

    def next(self) -> tuple[int, memoryview]:
        """Return type and bytes of the next element. Raises ValueError for one that does not end."""
        if len(self._data) < self._at + 8:
            raise ValueError("a variable ends too early")
        kind, size = struct.unpack_from(f"{self.order}II", self._data, self._at)
        small = kind >> 16
        first = self._at + (4 if small else 8)
        kind, size = (kind & 0xFFFF, small) if small else (kind, size)
        if (small > 4) or first + size > len(self._data):
            raise ValueError(f"an element of {size} bytes does not end where its variable does")
        self._at = self._at + 8 if small else first + -(-size // 8) * 8
        return kind, self._data[first : first + size]

    def numbers(self, *kinds: int) -> NDArray[Any]:
        """Return the next element as numbers, of one of the given types, or any."""
        kind, data = self.next()
        if kind not in (kinds or _STORED):
            raise ValueError(f"expected numbers, got an element of type {kind}")
        return np.frombuffer(data, np.dtype(self.order + _STORED[kind]))


def _head(elements: _Elements) -> tuple[int, tuple[int, ...], str]:
    """Return flags, dimensions in the order of HDF5, and name of a matrix."""
    flags, dims = elements.numbers(_UINT32), elements.numbers(_INT32)
    if len(flags) < 1 or len(dims) < 2 or bool((dims < 0).any()):
        raise ValueError(f"expected two dimensions or more, got {dims[:8].tolist()}")
    name = bytes(elements.next()[1]).split(b"\0")[0].decode("latin-1")
    return int(flags[0]), tuple(reversed(dims.tolist())), name


def _value(data: memoryview, order: str, what: str, level: int) -> Value | Other:
    if not len(data):
        return None
    if level > _LEVELS:
        raise ValueError(f"structures in structures, more than {_LEVELS} deep")
    elements = _Elements(data, order)
    flags, shape, _ = _head(elements)
    kind, count = flags & 0xFF, math.prod(shape)
    if count == 0 and kind in (*_NUMBERS, _TEXT):
        return None
    if kind in _NUMBERS:
        check_memory(count * np.dtype(_NUMBERS[kind]).itemsize, what)
        real = _numbers(elements, kind, shape)
        return real + 1j * _numbers(elements, kind, shape) if flags & _COMPLEX else real
    if kind == _TEXT:
        stored, letters = elements.next()
        if stored == _UTF8:
            return bytes(letters).decode("utf-8")
        codes = np.frombuffer(letters, np.dtype(order + _STORED[stored]))
        return "".join(map(chr, codes.tolist()))
    if kind == _STRUCTURE and count == 1:
        length = int(elements.numbers(_INT32)[0])
        names = bytes(elements.next()[1])
        if length < 1:
            raise ValueError(f"expected names of a letter or more, got {length}")
        found: dict[str, Any] = {}
        for first in range(0, len(names), length):
            stored, field = elements.next()
            if stored != _MATRIX:
                raise ValueError(f"expected an array in a structure, got an element of type {stored}")
            name = names[first : first + length].split(b"\0")[0].decode("latin-1")
            found[name] = _value(field, order, what, level + 1)
        return found
    return Other(_OTHERS.get(kind, f"of class {kind}"))


def _numbers(elements: _Elements, kind: int, shape: tuple[int, ...]) -> NDArray[Any]:
    stored = elements.numbers()
    if len(stored) != math.prod(shape):
        raise ValueError(f"expected {math.prod(shape)} numbers {shape}, got {len(stored)}")
    with np.errstate(all="ignore"):  # a damaged file may store what its class does not hold
        return np.require(stored.astype(_NUMBERS[kind], copy=False), requirements="W").reshape(shape)


# ---------------------------------------------------------------------------------------------------------- version 7.3


def write_mat(target: Path, variables: Mapping[str, Any]) -> None:
    """Write arrays and structures by name, as MATLAB 7.3.

    Args:
        target: checked path.
        variables: arrays, and mappings of arrays, in the order of HDF5, the reverse of MATLAB's.

    Raises:
        StorageError: for a full disk.
    """
    with replacing(target, _WHAT) as unfinished:
        with new_hdf5(unfinished, _WHAT, userblock_size=_USER_BLOCK) as file:
            for name, value in variables.items():
                if isinstance(value, Mapping):
                    group = file.create_group(name)
                    group.attrs["MATLAB_class"] = np.bytes_("struct")
                    for field, array in value.items():
                        _write(group, field, np.asarray(array))
                else:
                    _write(file, name, np.asarray(value))
        with unfinished.open("r+b") as raw:
            raw.write(_HEADER.ljust(116) + bytes(8) + b"\x00\x02IM")


def _write(group: Any, name: str, array: NDArray[Any]) -> None:
    # MATLAB has no arrays of fewer than two dimensions.
    array = array.reshape(*(1,) * (2 - array.ndim), *array.shape)
    kind = _CLASSES.get(array.dtype.name, array.dtype.name)
    dataset = group.create_dataset(name, shape=array.shape, dtype=np.uint8 if kind == "logical" else array.dtype)
    dataset.attrs["MATLAB_class"] = np.bytes_(kind)
    write_parts(dataset, array)
