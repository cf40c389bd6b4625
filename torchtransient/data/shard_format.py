"""Format of shards: encodings of numbers, and compressed chunks of HDF5.

A Monte Carlo render is known to a few per cent, and float32 stores it to 6e-8: most of the bytes of a cube are digits
of its noise. ``rounded`` keeps 10 bits of the mantissa, an error of at most 2^-11 of a number. A chunk is a slab of
bins of one sample, so that a window of time costs its own size. Chunks are compressed as samples come and written in
the order of rows, so that files do not depend on the order of samples.
"""

from __future__ import annotations

import itertools
import math
import os
import secrets
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.array_files.hdf5 import hdf5_package
from torchtransient.checks import is_one_of, shown
from torchtransient.errors import ArgumentError, MissingPackageError, StorageError

STORES = ("exact", "rounded", "counts")
# Result of sensors; it alone is stored as counts.
COUNTED = "measurement"
# Arrays of films, where a header does not name them.
_FILMS = ("transient", "phasor", "gated", "rates", "beats")
MANTISSA_BITS = 10
ENCODINGS = ("exact", "rounded", "counts")  # of an array
_UNSIGNED = (np.uint8, np.uint16, np.uint32, np.uint64)


def measured_names(about: Any) -> tuple[str, ...]:
    """Return the arrays that were measured: by the film under its own name, and by sensors. Other arrays are labels,
    and the steady image.

    Args:
        about: entry ``about`` of a header.

    Returns:
        Names.
    """
    named = about.get("measures") if isinstance(about, Mapping) else None
    return (*((named,) if isinstance(named, str) else _FILMS), COUNTED)


def check_store(store: Any, what: str) -> str:
    """Check the name of a store.

    Args:
        store: "exact", "rounded" or "counts".
        what: caller for messages.

    Returns:
        The name.

    Raises:
        ArgumentError: for other names.
    """
    if not is_one_of(store, STORES):
        raise ArgumentError(f"{what}: expected store as one of {', '.join(STORES)}, got {shown(store)}.")
    return str(store)


def rounded_mantissa(array: NDArray[Any]) -> NDArray[Any]:
    """Round the mantissa to 10 bits, half to even, of real and imaginary part apart. Infinities and signs stay, NaN
    stays NaN; numbers that round above the largest become infinite. Numbers below the smallest normal one keep the
    digits at the same places.

    Args:
        array: floating-point array of any shape.

    Returns:
        Array of the same dtype; float16 as it is.
    """
    if array.dtype == np.float16:
        return array
    kinds = {"f4": (np.uint32, 23), "f8": (np.uint64, 52), "c8": (np.uint32, 23), "c16": (np.uint64, 52)}
    whole, mantissa = kinds[array.dtype.str[1:]]
    cut = mantissa - MANTISSA_BITS
    # A copy in memory order; complex numbers are pairs.
    found = np.array(array, dtype=array.dtype.newbyteorder("="), order="C")
    parts = found.reshape(-1).view(whole)
    nan = np.isnan(parts.view(f"f{parts.dtype.itemsize}"))
    kept = parts[nan] if nan.any() else None
    # Half to even: add just less than one half, and one unit more where the last bit that stays is odd.
    odd = parts >> whole(cut)
    odd &= whole(1)
    odd += whole((1 << (cut - 1)) - 1)
    parts += odd
    parts &= whole(~((1 << cut) - 1) & ((1 << (8 * parts.dtype.itemsize)) - 1))
    if kept is not None:
        parts[nan] = kept
    return found


def counts_of(array: NDArray[Any], what: str) -> NDArray[Any]:
    """Convert whole numbers to the smallest unsigned type.

    Args:
        array: whole numbers from 0 on, of any real dtype.
        what: caller for messages.

    Returns:
        Unsigned array.

    Raises:
        StorageError: for other numbers.
    """
    # Comparisons with NaN are false.
    wrong = array[~((array.real >= 0) & (array.real < 2.0**64) & (np.floor(array.real) == array))]
    if wrong.size:
        raise StorageError(
            f"{what}: expected counts, whole numbers from 0 on, got {wrong[0]}. Store other measurements with "
            "store='rounded' or 'exact'."
        )
    largest = int(array.real.max(initial=0))
    return array.real.astype(next(kind for kind in _UNSIGNED if largest <= np.iinfo(kind).max))


def encoding_of(name: str, dtype: np.dtype[Any], store: str, measured: Sequence[str]) -> str:
    """Return the encoding of an array. Only measured arrays may lose digits.

    Args:
        name: name of the array.
        dtype: dtype of the array.
        store: "exact", "rounded" or "counts", the store of the shard.
        measured: names of measured arrays.

    Returns:
        "exact", "rounded" or "counts".
    """
    if store == "counts" and name == COUNTED:
        return "counts"
    return "rounded" if store == "rounded" and name in measured and dtype.kind in "fc" else "exact"


def encoded(array: NDArray[Any], encoding: str, what: str) -> NDArray[Any]:
    """Encode an array.

    Args:
        array: array of one sample.
        encoding: encoding of the array, "exact", "rounded" or "counts".
        what: caller for messages.

    Returns:
        Stored array.

    Raises:
        StorageError: for numbers that are no counts.
    """
    if encoding == "counts":
        return counts_of(array, what)
    return rounded_mantissa(array) if encoding == "rounded" else array


def decoded(array: NDArray[Any], encoding: str) -> NDArray[Any]:
    """Decode an array: counts as float32, everything else as it is stored.

    Args:
        array: stored array.
        encoding: encoding of the array, "exact", "rounded" or "counts".

    Returns:
        Array.
    """
    return array.astype(np.float32) if encoding == "counts" else array


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
