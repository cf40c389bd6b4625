"""HDF5 files on disks that may be full. The HDF5 library ends the process where what it keeps back cannot be written as
a file is closed; here it writes into an object that takes everything, and remembers what the disk said.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from torchtransient.errors import MissingPackageError


@contextmanager
def new_hdf5(path: Path, what: str, **settings: Any) -> Iterator[Any]:
    """A new HDF5 file, open for writing. Raises StorageError without h5py, OSError where not all of it was written."""
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


class _Sink:
    """A file that fails no more than once: what comes after is dropped, and read as zeros."""

    def __init__(self, raw: Any) -> None:
        self._raw, self._at, self._end = raw, 0, 0
        self.error: OSError | None = None

    def seek(self, offset: int, whence: int = 0) -> int:
        """The new place."""
        self._at = offset + (0, self._at, self._end)[whence]
        return self._at

    def tell(self) -> int:
        """The place."""
        return self._at

    def write(self, data: Any) -> int:
        """All of the data, written or dropped."""
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
        """What was written, zeros for what was not."""
        view = memoryview(buffer).cast("B")
        self._raw.seek(self._at)
        found = self._raw.readinto(view) or 0
        view[found:] = bytes(len(view) - found)
        self._at += len(view)
        return len(view)

    def read(self, size: int) -> bytes:
        """As :meth:`readinto`."""
        found = bytearray(size)
        self.readinto(found)
        return bytes(found)

    def truncate(self, size: int) -> int:
        """Cut or lengthened."""
        self._end = size
        if self.error is None:
            try:
                self._raw.truncate(size)
            except OSError as error:
                self.error = error
        return size

    def flush(self) -> None:
        """Nothing is kept back."""


def hdf5_package(what: str) -> Any:
    """The module h5py. Raises MissingPackageError where it is not installed."""
    try:
        import h5py
    except ImportError as error:
        raise MissingPackageError(
            f"{what}: HDF5 needs the package h5py. Install it with pip install 'torchtransient[data]', "
            "or choose a name that ends in .npz."
        ) from error
    return h5py
