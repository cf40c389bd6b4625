"""HDF5 of any origin: datasets and attributes read within bounds, and files written to disks that may be full.

A file may declare terabytes that nothing stores, point to other files of the machine, or be damaged where the HDF5
library does not look. Declared sizes are compared with stored ones before memory is asked for. When a file is closed
and cannot be written to the end, the library ends the process; here it writes into an object that accepts everything
and keeps the disk's error.
"""

from __future__ import annotations

import math
import mmap
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.array_files.free_memory import available_memory, size_in_words
from torchtransient.errors import MissingPackageError, StorageError

# Deflate, the filter that all of these files use, makes at most 1032 bytes of one.
MOST_BYTES_OF_ONE = 1032
# Gzip, shuffle, Fletcher's checksum, szip, n-bit and scale-offset are HDF5's own, and LZF is that of h5py.
_FILTERS = {1, 2, 3, 4, 5, 6, 32000}
# Never written, and small enough to be made of fill values.
_FREE_BYTES = 2**20
# Below, memory is not asked about: files are read in a moment.
_LARGE_BYTES = 2**26
# Of an array that is written in parts.
_PART_BYTES = 2**26
# Chunks hold a header, and their last ones more than the array.
_SLACK = 2
# What HDF5 writes of a text before the type of its letters: of the encoding, of the text, and the letters' version.
_KIND_HEAD = 2 + 8 + 1
_HEAP_HEADER = 16
# An attribute's parts may be filled up to eight bytes; then a shape of version 1 or 2, and the length.
_NO_SHAPE_AND_LENGTH = re.compile(rb"\x00{0,7}(?:\x01\x00{7}|\x02\x00{3})(.{16})", re.DOTALL)


def hdf5_package(what: str) -> Any:
    """Return the module h5py.

    Args:
        what: subject of messages.

    Raises:
        MissingPackageError: if it is not installed.
    """
    try:
        import h5py
    except ImportError as error:
        raise MissingPackageError(
            f"{what}: HDF5 needs the package h5py. Install it with pip install 'torchtransient[data]', "
            "or choose a name that ends in .npz."
        ) from error
    return h5py


# -------------------------------------------------------------------------------------------------------------- reading


def read_dataset(parent: Any, name: str, what: str, part: tuple[Any, ...] = ()) -> NDArray[Any] | str | None:
    """Read a dataset of an open file or group.

    Args:
        parent: file or group of h5py.
        name: path of the dataset.
        what: subject of messages.
        part: index of the part that is read, () for all of it.

    Returns:
        Numbers, or a text as `str`; None for a dataset that is missing or empty.

    Raises:
        StorageError: for links to other files, objects and records, filters that are no part of HDF5, and more numbers
            than the file or the free memory can hold.
    """
    dataset = dataset_of(parent, name, what)
    # MATLAB writes the size of an empty array in its place.
    if dataset is None or dataset.shape is None or "MATLAB_empty" in dataset.attrs:
        return None
    _check_filters(dataset, name, what)
    import h5py

    if h5py.check_string_dtype(dataset.dtype) is not None and math.prod(dataset.shape) == 1:
        return _text(dataset, what)
    if not is_number(dataset.dtype):
        raise StorageError(f"{what}: '{name}' holds {str(dataset.dtype)[:60]}; expected numbers of up to 64 bits.")
    left = [n for axis, n in enumerate(dataset.shape) if axis >= len(part) or not isinstance(part[axis], int)]
    wanted = math.prod(left) * dataset.dtype.itemsize
    check_size(wanted, dataset.id.get_storage_size(), f"{what}: '{name}' {dataset.shape}")
    if part == () and dataset.shape:
        # Into memory of its own: h5py would fill what it allocates with zeros first.
        array: NDArray[Any] = np.empty(dataset.shape, dataset.dtype)
        if array.size:
            dataset.read_direct(array)
        return array
    return np.asarray(dataset[part])


def dataset_of(parent: Any, name: str, what: str) -> Any:
    """Return the dataset at a path of the file itself, None if there is nothing.

    Args:
        parent: file or group of h5py.
        name: path of the dataset.
        what: subject of messages.

    Raises:
        StorageError: for groups, and for links to elsewhere, which are not followed.
    """
    import h5py

    found = parent
    for step in name.split("/"):
        link = found.get(step, getlink=True) if isinstance(found, h5py.Group) else None
        if link is None:
            return None
        if not isinstance(link, h5py.HardLink):
            raise StorageError(f"{what}: '{name}' is a link to elsewhere, which is not followed.")
        found = found[step]
    if not isinstance(found, h5py.Dataset):
        raise StorageError(f"{what}: expected '{name}' to be a dataset, got a {type(found).__name__.lower()}.")
    if found.is_virtual or found.external:
        raise StorageError(f"{what}: '{name}' lies in other files, which are not read.")
    return found


def _check_filters(dataset: Any, name: str, what: str) -> None:
    """Refuse filters that are no part of HDF5, which would be loaded as code from where HDF5_PLUGIN_PATH leads."""
    settings = dataset.id.get_create_plist()
    for number in range(settings.get_nfilters()):
        code = settings.get_filter(number)[0]
        if code not in _FILTERS:
            raise StorageError(
                f"{what}: '{name}' is packed by the filter {code}, which is no part of HDF5 and is not loaded. Write "
                "the file with gzip or without compression."
            )


def is_number(dtype: np.dtype[Any]) -> bool:
    """Return True for dtypes that tensors can have, complex ones of two such numbers.

    Args:
        dtype: dtype of an array.
    """
    return dtype.kind in "biufc" and dtype.itemsize <= (16 if dtype.kind == "c" else 8)


def check_size(declared: int, stored: int, what: str) -> None:
    """Check that an array can come from the bytes that are stored of it, and fits into memory.

    Args:
        declared: bytes of the array.
        stored: bytes in the file.
        what: subject of messages.

    Raises:
        StorageError: if it does not.
    """
    if declared > max(_FREE_BYTES, _SLACK * MOST_BYTES_OF_ONE * stored):
        raise StorageError(f"{what} declares {declared:,} bytes of numbers and stores {stored:,}: the file is damaged.")
    check_memory(declared, what)


def check_memory(declared: int, what: str) -> None:
    """Check that an array fits into memory.

    Args:
        declared: bytes of the array.
        what: subject of messages.

    Raises:
        StorageError: if it does not.
    """
    if declared < _LARGE_BYTES:
        return
    available = available_memory()
    if available is not None and declared > available:
        raise StorageError(
            f"{what} takes {size_in_words(declared)}, and {size_in_words(available)} of memory are left. Free some "
            "memory, or cut the file into parts with h5py."
        )


def _text(dataset: Any, what: str) -> str:
    import h5py

    if h5py.check_string_dtype(dataset.dtype).length is None:
        _check_length(dataset, what)
    else:
        check_size(dataset.nbytes, dataset.id.get_storage_size(), f"{what}: the text '{dataset.name}'")
    try:
        value = dataset.asstr("utf-8")[()]  # whatever the file says of its letters
    except UnicodeDecodeError as error:
        raise StorageError(f"{what}: '{dataset.name}' is no text of UTF-8: {error}.") from None
    return str(value.reshape(-1)[0] if isinstance(value, np.ndarray) else value)


def read_attributes(file: Any, what: str, names: Iterable[str] | None = None) -> dict[str, Any]:
    """Read attributes of an open file.

    Args:
        file: file of h5py.
        what: subject of messages.
        names: names that are read if they are there, None for all.

    Returns:
        Numbers, and texts as `str`, by name.

    Raises:
        StorageError: for other kinds, and texts that claim to be longer than the file.
    """
    import h5py

    found: dict[str, Any] = {}
    for name in file.attrs if names is None else [name for name in names if name in file.attrs]:
        attribute = h5py.h5a.open(file.id, name.encode("utf-8"))
        text = h5py.check_string_dtype(attribute.dtype)
        if text is not None and text.length is None:
            _check_attribute(attribute, file.filename, f"{what}: the attribute '{name}'")
        elif attribute.dtype.kind not in "biufcS":
            raise StorageError(f"{what}: the attribute '{name}' holds {attribute.dtype}; expected numbers or a text.")
        value = file.attrs[name]
        found[name] = value.decode("utf-8", "replace") if isinstance(value, bytes) else value
    return found


def _check_attribute(attribute: Any, path: str, what: str) -> None:
    """Check the lengths of an attribute's texts, found in the raw file behind their type and an empty shape."""
    # The letters' type behind its version, as HDF5 writes it in all of them: one byte, 8 bits.
    letters = attribute.get_type().encode()[_KIND_HEAD:]
    found = False
    if attribute.shape == () and letters:
        with open(path, "rb") as raw, mmap.mmap(raw.fileno(), 0, access=mmap.ACCESS_READ) as data:
            place = data.find(letters)
            while place >= 0:
                match = _NO_SHAPE_AND_LENGTH.match(data[place + len(letters) : place + len(letters) + 40])
                if match:
                    found = True
                    _check_heap(data, match[1], what)
                place = data.find(letters, place + 1)
    if not found:
        raise StorageError(f"{what} is a text that is stored in an unknown way.")


def _check_length(dataset: Any, what: str) -> None:
    """Check the length of a dataset's text, whose place the dataset knows."""
    offset = dataset.id.get_offset()
    if offset is None or dataset.file.userblock_size:
        raise StorageError(
            f"{what}: expected the text '{dataset.name}' in one piece, got one that is stored otherwise."
        )
    with open(dataset.file.filename, "rb") as raw, mmap.mmap(raw.fileno(), 0, access=mmap.ACCESS_READ) as data:
        _check_heap(data, data[offset : offset + 16], f"{what}: the text '{dataset.name}'")


def _check_heap(data: mmap.mmap, reference: bytes, what: str) -> None:
    """Walk through the heap that a text refers to by its length, the heap's place and its number there.

    HDF5 fills as much memory as a text says it is long, up to 4 GB, before it looks for it, and does not come to an end
    in some damaged heaps.
    """
    length, place = int.from_bytes(reference[:4], "little"), int.from_bytes(reference[4:12], "little")
    if length == 0:
        return
    end = place + int.from_bytes(data[place + 8 : place + 16], "little")
    if length > len(data) or data[place : place + 5] != b"GCOL\x01" or end > len(data):
        raise StorageError(f"{what} says it has {length:,} bytes, the file {len(data):,}, or its place is damaged.")
    place += 16
    while end - place >= _HEAP_HEADER:
        number, size = int.from_bytes(data[place : place + 2], "little"), data[place + 8 : place + 16]
        count = int.from_bytes(size, "little")
        # What is free counts with its header, the others without, filled up to eight bytes.
        step = count if number == 0 else _HEAP_HEADER + -(-count // 8) * 8
        if step < _HEAP_HEADER or place + step > end:
            raise StorageError(f"{what} lies in a heap that is damaged.")
        place += step


# -------------------------------------------------------------------------------------------------------------- writing


@contextmanager
def new_hdf5(path: Path, what: str, **settings: Any) -> Iterator[Any]:
    """Open a new HDF5 file for writing.

    Args:
        path: place of the file.
        what: subject of messages.
        settings: other arguments of ``h5py.File``.

    Raises:
        MissingPackageError: without h5py.
        OSError: if not all of it could be written.
    """
    h5py = hdf5_package(what)
    with path.open("w+b", buffering=0) as raw:
        sink = _Sink(raw)
        try:
            with h5py.File(sink, "w", **settings) as file:
                yield file
        finally:
            # What HDF5 says of bytes that it does not find again tells less.
            if sink.error is not None:
                raise sink.error


def write_parts(dataset: Any, array: NDArray[Any]) -> None:
    """Fill a dataset some first indices at a time, so that an array whose axes were moved is not copied as a whole.

    Args:
        dataset: object with ``__setitem__`` by slices of the first axis.
        array: numbers in the dataset's shape.
    """
    if array.ndim == 0 or array.size == 0:
        dataset[...] = array
        return
    step = max(1, _PART_BYTES * len(array) // max(1, array.nbytes))
    for first in range(0, len(array), step):
        dataset[first : first + step] = array[first : first + step]


class _Sink:
    """File that fails at most once: later writes are dropped, and read as zeros."""

    def __init__(self, raw: Any) -> None:
        self._raw, self._at, self._end = raw, 0, 0
        self.error: OSError | None = None

    def seek(self, offset: int, whence: int = 0) -> int:
        """Move, and return the new place."""
        self._at = offset + (0, self._at, self._end)[whence]
        return self._at

    def tell(self) -> int:
        """Return the place."""
        return self._at

    def write(self, data: Any) -> int:
        """Write or drop all of the data, and return its size."""
        left = memoryview(data).cast("B")
        size = len(left)
        if self.error is None:
            try:
                self._raw.seek(self._at)
                while left:
                    left = left[self._raw.write(left) :]
            except OSError as error:
                self.error = error
        self._at += size
        self._end = max(self._end, self._at)
        return size

    def readinto(self, buffer: Any) -> int:
        """Read into a buffer, zeros for what was dropped."""
        view = memoryview(buffer).cast("B")
        self._raw.seek(self._at)
        found = self._raw.readinto(view) or 0
        view[found:] = bytes(len(view) - found)
        self._at += len(view)
        return len(view)

    def read(self, size: int) -> bytes:
        """Read ``size`` bytes, as :meth:`readinto`."""
        found = bytearray(size)
        self.readinto(found)
        return bytes(found)

    def truncate(self, size: int) -> int:
        """Cut or lengthen the file."""
        self._end = size
        if self.error is None:
            try:
                self._raw.truncate(size)
            except OSError as error:
                self.error = error
        return size

    def flush(self) -> None:
        """Do nothing: nothing is buffered."""
