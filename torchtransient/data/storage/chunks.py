"""Chunks of samples in HDF5: how samples are cut, compressed apart from any file, and what a reader takes for sound.

A chunk is a slab of bins of one sample, so that a window of time costs what it holds. Chunks are compressed as samples
come and written in the order of rows, so that a file does not tell in which order they came.
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
# What HDF5 1.10 and later read.
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
    """`compression`, or StorageError for one that is unknown or lacks its package."""
    if not is_one_of(compression, COMPRESSIONS):
        raise ArgumentError(
            f"{what}: expected compression as one of {', '.join(COMPRESSIONS)}, got {shown(compression)}."
        )
    _filters(compression, what)
    return str(compression)


def chunk_shape(shape: tuple[int, ...]) -> tuple[int, ...]:
    """How an array of one sample is cut, by its shape alone: small ones not at all, larger ones into slabs of 32 bins
    or 64 KiB of float32, whichever is more, and slabs above 4 MiB into rows of the image.
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
    # Rows first, then what stands before the bins, from the left; what is left are bins and columns.
    axes = [len(shape) + _HEIGHT] if len(shape) > 1 else []
    axes += [axis for axis in range(len(shape)) if axis not in axes]
    for axis in axes:
        if size() > _MOST_BYTES:
            cut[axis] = max(1, cut[axis] * _MOST_BYTES // size())
    return tuple(cut)


def time_axis(shape: tuple[int, ...]) -> int | None:
    """Where the bins of a shape probably are: (C, T, H, W), (C, T, N) and (C, T, Ly, Lx, Sy, Sx) have them second,
    polarized images (4, C, T, H, W) third; None for what has fewer axes. Images of several components are thus cut
    into rows.
    """
    return None if len(shape) < 3 else 2 if len(shape) == 5 else 1


class Compressor:
    """Arrays of one shape and dtype as the chunks that HDF5 would store of them, without a file on a disk."""

    def __init__(self, shape: tuple[int, ...], dtype: np.dtype[Any], compression: str, what: str) -> None:
        h5py = hdf5_package(what)
        self.dtype, self.chunks = dtype, (1, *chunk_shape(shape))
        self.options = {"chunks": self.chunks, "fletcher32": True, **_filters(compression, what)}
        # Nothing is kept in a cache: every chunk is compressed as it is written.
        name = f"chunks {secrets.token_hex(8)}"  # which no other open file may have
        self._file = h5py.File(name, "w", driver="core", backing_store=False, libver=LIBVER, rdcc_nbytes=0)
        self._data = self._file.create_dataset("x", (1, *shape), dtype, **self.options)
        self._all, self._type = h5py.h5s.ALL, h5py.h5t.py_create(dtype, logical=True)
        self.places = list(itertools.product(*(range(0, n, c) for n, c in zip((1, *shape), self.chunks, strict=True))))

    def compressed(self, array: NDArray[Any]) -> list[bytes]:
        """The chunks of an array, in the order of ``places``."""
        # What h5py looks up for each `self._data[0] = array` takes longer than to compress a small image.
        whole = np.ascontiguousarray(array, self.dtype).reshape(self._data.shape)
        with _fixed_settings():
            self._data.id.write(self._all, self._all, whole, self._type)
        return [self._data.id.read_direct_chunk(place)[1] for place in self.places]

    def array(self, chunks: list[bytes]) -> NDArray[Any]:
        """The array of its chunks."""
        for place, chunk in zip(self.places, chunks, strict=True):
            self._data.id.write_direct_chunk(place, chunk)
        found: NDArray[Any] = self._data[0]
        return found

    def close(self) -> None:
        """Give the memory back."""
        self._file.close()


@contextmanager
def _fixed_settings() -> Iterator[None]:
    """Blosc takes its block size, level and threads from the environment too, and makes other bytes of them. Without a
    number it starts threads for every chunk, which wait for each other and for those of other workers.
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
    """The module hdf5plugin, which registers Blosc2 with h5py. Raises MissingPackageError where it is not installed."""
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
    """Raise StorageError where a data set is not cut and stored as :class:`Compressor` does it: other chunks or
    filters, and rows without their chunks. A file that declares what nobody stored is found here, before there is
    memory for it.
    """
    filters = {dataset.id.get_create_plist().get_filter(k)[0] for k in range(_filter_count(dataset))}
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


def _filter_count(dataset: Any) -> int:
    return int(dataset.id.get_create_plist().get_nfilters())
