"""Compressed chunks of HDF5 in shards.

A chunk is a slab of bins of one sample, so that a window of time costs its own size. Chunks are compressed as samples
come and written in the order of rows, so that files do not depend on the order of samples.
"""

from __future__ import annotations

import itertools
import math
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.array_files.hdf5 import hdf5_package
from torchtransient.checks import is_one_of, shown
from torchtransient.errors import ArgumentError, MissingPackageError, StorageError

COMPRESSIONS = ("blosc2", "gzip", "none")
# Read by HDF5 1.10 and later.
LIBVER = ("v110", "v110")
_BINS = 32
_SMALL_BYTES = 2**18
_LEAST_BYTES = 2**16
_MOST_BYTES = 2**22
_HEIGHT = -2
# Numbers of HDF5's filters: deflate, shuffle, Fletcher's checksum; Blosc2.
_KNOWN_FILTERS = {1, 2, 3, 32026}
_BLOSC2 = 32026


def check_compression(compression: Any, what: str) -> str:
    """Check the name of a compression.

    Args:
        compression: "blosc2", "gzip" or "none".
        what: caller for messages.

    Returns:
        The name.

    Raises:
        ArgumentError: for other names.
        MissingPackageError: without its package.
    """
    if not is_one_of(compression, COMPRESSIONS):
        raise ArgumentError(
            f"{what}: expected compression as one of {', '.join(COMPRESSIONS)}, got {shown(compression)}."
        )
    _filters(compression, what)
    return str(compression)


def chunk_shape(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the chunk of an array by its shape alone: small arrays whole, larger ones in slabs of 32 bins or 64 KiB of
    float32, whichever is more, and slabs above 4 MiB in rows of the image.

    Args:
        shape: shape of an array of one sample.

    Returns:
        Shape of a chunk.
    """
    cut = list(shape)

    def size() -> int:
        return 4 * math.prod(cut)

    if size() <= _SMALL_BYTES or not shape:
        return tuple(cut)
    time = time_axis(shape)
    if time is not None:
        bin_bytes = size() // shape[time]
        cut[time] = min(shape[time], max(_BINS, -(-_LEAST_BYTES // bin_bytes)))
    # Rows first, then axes before the bins, from the left; bins and columns last.
    axes = [len(shape) + _HEIGHT] if len(shape) > 1 else []
    axes += [axis for axis in range(len(shape)) if axis not in axes]
    for axis in axes:
        if size() > _MOST_BYTES:
            cut[axis] = max(1, cut[axis] * _MOST_BYTES // size())
    return tuple(cut)


def time_axis(shape: tuple[int, ...]) -> int | None:
    """Return the probable axis of the bins: (C, T, H, W), (C, T, N) and (C, T, Ly, Lx, Sy, Sx) have them second,
    polarized images (4, C, T, H, W) third. Images of several components are thus cut into rows.

    Args:
        shape: shape of an array of one sample.

    Returns:
        Axis, None for fewer axes.
    """
    return None if len(shape) < 3 else 2 if len(shape) == 5 else 1


class Compressor:
    """Compressor of arrays into the chunks that HDF5 would store, without a file on a disk.

    Args:
        shape: shape of the arrays.
        dtype: dtype of the arrays.
        compression: "blosc2", "gzip" or "none".
        what: caller for messages.
    """

    def __init__(self, shape: tuple[int, ...], dtype: np.dtype[Any], compression: str, what: str) -> None:
        h5py = hdf5_package(what)
        self.dtype, self.chunks = dtype, (1, *chunk_shape(shape))
        self.options = {"chunks": self.chunks, "fletcher32": True, **_filters(compression, what)}
        # Nothing is kept in a cache: every chunk is compressed as it is written.
        name = f"chunks {secrets.token_hex(8)}"  # unique among open files
        self._file = h5py.File(name, "w", driver="core", backing_store=False, libver=LIBVER, rdcc_nbytes=0)
        self._data = self._file.create_dataset("x", (1, *shape), dtype, **self.options)
        self._all, self._type = h5py.h5s.ALL, h5py.h5t.py_create(dtype, logical=True)
        self.places = list(itertools.product(*(range(0, n, c) for n, c in zip((1, *shape), self.chunks, strict=True))))

    def compressed(self, array: NDArray[Any]) -> list[bytes]:
        """Compress an array.

        Args:
            array: array of one sample.

        Returns:
            Chunks in the order of ``places``.
        """
        # Faster than `self._data[0] = array` for small images, whose look-ups take longer than compression.
        whole = np.ascontiguousarray(array, self.dtype).reshape(self._data.shape)
        with _fixed_settings():
            self._data.id.write(self._all, self._all, whole, self._type)
        return [self._data.id.read_direct_chunk(place)[1] for place in self.places]

    def array(self, chunks: list[bytes]) -> NDArray[Any]:
        """Decompress an array.

        Args:
            chunks: compressed chunks in the order of ``places``.

        Returns:
            Array.
        """
        for place, chunk in zip(self.places, chunks, strict=True):
            self._data.id.write_direct_chunk(place, chunk)
        found: NDArray[Any] = self._data[0]
        return found

    def close(self) -> None:
        """Free the memory."""
        self._file.close()


@contextmanager
def _fixed_settings() -> Iterator[None]:
    """Fix the settings of Blosc, which would take block size, level and threads from the environment, and write other
    bytes then. Without a number of threads it starts some for every chunk, which wait for each other and for those of
    other workers.
    """
    settings = {name: os.environ.pop(name) for name in list(os.environ) if name.startswith("BLOSC_")}
    os.environ["BLOSC_NTHREADS"] = "1"
    try:
        yield
    finally:
        del os.environ["BLOSC_NTHREADS"]
        os.environ.update(settings)


def _filters(compression: str, what: str) -> dict[str, Any]:
    if compression == "gzip":
        return {"compression": "gzip", "compression_opts": 1, "shuffle": True}
    if compression == "blosc2":
        plugin = blosc2_package(what)
        return {**plugin.Blosc2(cname="zstd", clevel=1, filters=plugin.Blosc2.SHUFFLE)}
    return {}


def blosc2_package(what: str) -> Any:
    """Import hdf5plugin, which registers Blosc2 with h5py.

    Args:
        what: caller for messages.

    Returns:
        The module.

    Raises:
        MissingPackageError: where it is not installed.
    """
    hdf5_package(what)
    try:
        import hdf5plugin
    except ImportError as error:
        raise MissingPackageError(
            f"{what}: Blosc2 needs the package hdf5plugin. Install it with pip install 'torchtransient[data]', or "
            "write with compression='gzip'."
        ) from error
    return hdf5plugin


def check_chunks(dataset: Any, rows_there: int, what: str) -> None:
    """Check that a data set is stored as :class:`Compressor` does it. A file that declares more than it stores is found
    here, before there is memory for it.

    Args:
        dataset: data set of h5py.
        rows_there: rows that have chunks.
        what: name for messages.

    Raises:
        StorageError: for other chunks, filters, and rows without their chunks.
    """
    settings = dataset.id.get_create_plist()
    filters = {settings.get_filter(k)[0] for k in range(settings.get_nfilters())}
    if not filters <= _KNOWN_FILTERS:
        raise StorageError(f"{what} is packed with the filters {sorted(filters)}, which no writer of shards uses.")
    if _BLOSC2 in filters:
        blosc2_package(what)
    expected = (1, *chunk_shape(dataset.shape[1:]))
    if dataset.chunks != expected:
        raise StorageError(f"{what}: expected chunks of {expected}, got {dataset.chunks}: the file is damaged.")
    each = math.prod(-(-n // c) for n, c in zip(dataset.shape[1:], expected[1:], strict=True))
    stored = dataset.id.get_num_chunks()
    if stored != rows_there * each:
        raise StorageError(f"{what}: expected {rows_there * each} chunks, the file stores {stored}: it is damaged.")
