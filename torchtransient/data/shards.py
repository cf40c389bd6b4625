"""Shards: HDF5 files of several samples, whose bytes are a function of the samples alone. Files of unknown origin are
checked before their content is used.

``about``, JSON as bytes, has the format, the header, the encodings, texts and failures; ``index`` int64 (N,), ``seed``
uint32 (N,), ``outside`` float64 (N, 2) and ``there`` uint8 (N,) have an entry for each row; ``arrays/<name>`` (N, ...)
are the samples, without chunks for rows that failed; ``values/<key>`` (N, ...) the drawn values. Behind the end of HDF5
stand eight letters and the SHA-256 of all bytes before them. Chunks carry Fletcher's checksum besides, which every
reader of HDF5 checks. There are no times, hosts or names of users in a shard.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from torchtransient.array_files.array_file import check_folder, check_source, damage_said, path_of
from torchtransient.array_files.hdf5 import check_memory, dataset_of, hdf5_package, is_number, new_hdf5, read_dataset
from torchtransient.array_files.part_files import whole_file, writing_said
from torchtransient.checks import count, shown
from torchtransient.data.sample import Sample
from torchtransient.data.shard_format import (
    ENCODINGS,
    LIBVER,
    Compressor,
    check_chunks,
    check_compression,
    check_store,
    decoded,
    encoded,
    encoding_of,
    measured_names,
    time_axis,
)
from torchtransient.errors import StorageError

FORMAT = "torchtransient shard 1"
WHAT = "shard"
SEAL = b"ttshard1"
SEAL_BYTES = len(SEAL) + hashlib.sha256().digest_size
_HASHED_BYTES = 2**22
_TEXTS = ("format", "store", "compression")


def _opened(path: Path) -> Any:
    """Open a shard, whose writer still holds its lock for a moment when the file appears."""
    h5py = hdf5_package(WHAT)
    for wait_s in (0.01, 0.1, 1.0):
        try:
            return h5py.File(path, "r", rdcc_nbytes=0)
        except BlockingIOError:
            time.sleep(wait_s)
    return h5py.File(path, "r", rdcc_nbytes=0)


class Shard:
    """Open shard, a context manager. Handles belong to one process.

    ``header``: as it was written. ``index``: rows by the index of their sample, those that exist, in order of rows.
    ``failed``: reasons by the index of the sample. ``names``: of the arrays. ``keys``: of the values.

    Args:
        path: path of the file.

    Raises:
        StorageError: for a file that is missing, damaged or no shard; so does every method.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = check_source(path, WHAT)
        self._datasets: dict[str, Any] = {}
        self._values: dict[str, NDArray[Any]] = {}
        with damage_said(self.path, WHAT):
            self._file = _opened(self.path)
        try:
            with damage_said(self.path, WHAT):
                self._read_about()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._datasets.clear()
        self._file.close()

    def read(
        self, name: str, row: int, *, window: slice | None = None, pixels: tuple[slice, slice] | None = None,
        as_stored: bool = False,
    ) -> NDArray[Any]:  # fmt: skip
        """Read one array of a row.

        Args:
            name: name of the array.
            row: row of the sample in the shard.
            window: slice of the bins; only these are read.
            pixels: slices of rows and columns of the image.
            as_stored: keep the type of counts instead of float32.

        Returns:
            Array.
        """
        with damage_said(self.path, WHAT):
            self._check_row(row)
            dataset = self._dataset(name)
            shape = dataset.shape[1:]
            part = [slice(0, n) for n in shape]
            if window is not None:
                time = self.time_axis(name)
                if time is None:
                    raise StorageError(f"{WHAT}: '{name}' {shape} has no time axis; read all of it.")
                part[time] = part_of(window, shape[time], "window")
            if pixels is not None:
                if len(shape) < 2:
                    raise StorageError(f"{WHAT}: '{name}' {shape} has no rows and columns; read all of it.")
                part[-2:] = (part_of(one, n, "pixels") for one, n in zip(pixels, shape[-2:], strict=True))
            size = tuple(cut.stop - cut.start for cut in part)
            check_memory(math.prod(size) * dataset.dtype.itemsize, f"{WHAT}: '{name}' {size}")
            # Into memory of its own: h5py would fill what it allocates with zeros first.
            array: NDArray[Any] = np.empty(size, dataset.dtype)
            _read_into(array, dataset, (row, *(cut.start for cut in part)))
            return array if as_stored else decoded(array, self.encoding(name))

    def values(self, row: int) -> dict[str, NDArray[Any] | str]:
        """Return drawn values of a row.

        Args:
            row: row of the sample in the shard.

        Returns:
            Values by key.
        """
        with damage_said(self.path, WHAT):
            self._check_row(row)
            for key in self._about["values"]:
                if key not in self._values:
                    array = read_dataset(self._file, f"values/{member_name(key)}", WHAT)
                    if not isinstance(array, np.ndarray) or array.shape[:1] != (self.rows,):
                        raise StorageError(f"{WHAT}: '{self.path}': expected a row of '{key}' for each sample.")
                    self._values[key] = array
            found: dict[str, Any] = {key: self._values[key][row].copy() for key in self._about["values"]}
            found |= {key: self._about["texts"][key][row] for key in self._about["texts"]}
            return {key: found[key] for key in sorted(found)}

    def shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of an array of one sample.

        Args:
            name: name of the array.

        Returns:
            Shape.
        """
        with damage_said(self.path, WHAT):
            return tuple(self._dataset(name).shape[1:])

    def time_axis(self, name: str) -> int | None:
        """Return the axis of the bins of an array: for measured arrays the one that the header says; else the second,
        behind channels, or in polarized variants the third, behind the Stokes components.

        Args:
            name: name of the array.

        Returns:
            Axis, None for an array without bins.
        """
        shape = self.shape(name)
        about = self.header.get("about")
        about = about if isinstance(about, dict) else {}
        axis = about.get("axis")
        bins = axis.get("num_bins") if isinstance(axis, dict) else None
        if bins is None:
            return time_axis(shape)
        behind = about.get("behind_time")
        if isinstance(behind, int):
            place = len(shape) - 1 - behind
            measured = name in (about.get("measures"), "measurement")
            return place if measured and place >= 1 and shape[place] == bins else None
        polarized = "polarized" in str(about.get("variant", "")) or len(shape) == 5
        places = (2, 1) if polarized else (1,)
        return next((place for place in places if len(shape) > place + 1 and shape[place] == bins), None)

    def dtype(self, name: str, *, as_stored: bool = False) -> str:
        """Return the dtype of an array.

        Args:
            name: name of the array.
            as_stored: return the dtype in the file instead of the one that :meth:`read` gives.

        Returns:
            NumPy's name.
        """
        with damage_said(self.path, WHAT):
            found = self._dataset(name).dtype
            return str(found if as_stored else decoded(np.empty(0, found), self.encoding(name)).dtype)

    def encoding(self, name: str) -> str:
        """Return the encoding of an array.

        Args:
            name: name of the array.

        Returns:
            "exact", "rounded" or "counts".
        """
        return str(self._about["arrays"][name]["encoding"])

    def verify(self) -> str | None:
        """Compare all bytes with the checksum.

        Returns:
            Fault as text, None for a sound file.
        """
        size = self.path.stat().st_size - SEAL_BYTES
        with self.path.open("rb") as file:
            found = hash_of(file, size)
            stored = file.read(SEAL_BYTES)
        if stored[: len(SEAL)] != SEAL:
            return "the checksum at its end is missing: the file was cut or changed"
        return None if stored[len(SEAL) :] == found else "its bytes are not those that were written"

    # -------------------------------------------------------------------------------------------------------- reading

    def _read_about(self) -> None:
        kinds = {"about": "u1", "index": "i8", "seed": "u4", "outside": "f8", "there": "u1"}
        numbers: dict[str, NDArray[Any]] = {}
        for name, kind in kinds.items():
            array = read_dataset(self._file, name, WHAT)
            if not isinstance(array, np.ndarray) or array.dtype.str[1:] != kind:
                raise ValueError(f"'{name}' is missing or of another kind")
            numbers[name] = array
        about: dict[str, Any] = json.loads(numbers["about"].tobytes())
        if about["format"] != FORMAT:
            raise StorageError(
                f"{WHAT}: '{self.path}' is of format {shown(about['format'])}; this version reads '{FORMAT}'."
            )
        index, self.seeds, self.outside, there = (numbers[name] for name in ("index", "seed", "outside", "there"))
        self.rows = len(index)
        shapes = [array.shape for name, array in numbers.items() if name != "about"]
        if shapes != [(self.rows,), (self.rows,), (self.rows, 2), (self.rows,)]:
            raise ValueError(f"rows disagree: {shapes}")
        _check_about(about, self.rows)
        self._about, self._there = about, there.astype(bool)
        self.header: dict[str, Any] = about["header"]
        self.store, self.compression = str(about["store"]), str(about["compression"])
        self.index = {int(index[row]): row for row in np.flatnonzero(self._there).tolist()}
        self.failed = {int(number): str(reason) for _, number, reason in about["failed"]}
        if len(self.index) + len(self.failed) != self.rows or set(self.index) & set(self.failed):
            raise ValueError("samples are doubled or missing")
        self.names = tuple(about["arrays"])
        self.keys = tuple(sorted([*about["values"], *about["texts"]]))
        self.structure: list[str] = about["structure"]

    def _dataset(self, name: str) -> Any:
        if name in self._datasets:
            return self._datasets[name]
        if name not in self._about["arrays"]:
            raise StorageError(
                f"{WHAT}: '{self.path}' has no '{name}'; it has {', '.join(self.names) or 'no sample at all'}."
            )
        dataset = dataset_of(self._file, f"arrays/{name}", WHAT)
        if dataset is None or dataset.shape[:1] != (self.rows,) or not is_number(dataset.dtype):
            raise ValueError(f"'arrays/{name}' is missing or of another kind")
        check_chunks(dataset, int(self._there.sum()), f"{WHAT}: '{self.path}': '{name}' {dataset.shape}")
        self._datasets[name] = dataset
        return dataset

    def _check_row(self, row: int) -> None:
        if row not in range(self.rows):
            raise StorageError(f"{WHAT}: '{self.path}': expected a row from 0 to {self.rows - 1}, got {shown(row)}.")
        if not self._there[row]:
            reason = next((text for number, _, text in self._about["failed"] if number == row), "no reason")
            raise StorageError(f"{WHAT}: '{self.path}': the sample of row {row} could not be made: {reason}")


class ShardWriter:
    """Writer of a shard, a context manager: samples come in any order of rows, and the file takes its place when the
    block ends. Where the block raises or is killed, no file appears. Compressed samples are kept in memory until then.

    Args:
        path: path of the file.
        rows: number of samples, those that fail included.
        header: plain data that JSON can hold.
        store: "exact", "rounded" (10 bits of mantissa for measured arrays, which ``header["about"]["measures"]`` names,
            labels as they are) or "counts" (``measurement`` as whole numbers, everything else as it is).
        compression: "blosc2", "gzip" or "none".

    Raises:
        StorageError: for arguments that cannot be used, a missing folder, a full disk, samples that are unlike the
            first one, and rows that were neither put nor failed.
    """

    def __init__(
        self,
        path: str | Path,
        rows: int,
        header: Mapping[str, Any],
        *,
        store: str = "exact",
        compression: str = "blosc2",
    ) -> None:
        self.path = path_of(path, WHAT)
        check_folder(self.path, WHAT)
        self.store, self.compression = check_store(store, WHAT), check_compression(compression, WHAT)
        self.rows = count(f"{WHAT}: rows", rows, 1, StorageError)
        self._header = json.loads(_json(dict(header)))
        # Without their arrays.
        self._samples: dict[int, Sample] = {}
        self._failed: dict[int, tuple[int, str]] = {}
        self._arrays: dict[str, _Column] = {}
        self._values: dict[str, tuple[tuple[int, ...], np.dtype[Any]] | None] = {}

    def __enter__(self) -> Self:
        self._whole = whole_file(self.path, WHAT)
        self._unfinished = self._whole.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None:
                self._write()
        except BaseException as problem:
            if not self._whole.__exit__(type(problem), problem, problem.__traceback__):
                raise
        else:
            self._whole.__exit__(kind, error, trace)
        finally:
            for column in self._arrays.values():
                column.close()

    def put(self, row: int, sample: Sample) -> None:
        """Encode and compress a sample.

        Args:
            row: row of the sample in the shard.
            sample: sample of a recipe, or an object with the same attributes.
        """
        row = self._free(row)
        arrays = {name: _array(value, f"{WHAT}: '{name}'") for name, value in sorted(sample.arrays.items())}
        values = {key: _value(value, key) for key, value in sorted(sample.values.items())}
        kinds = {key: None if isinstance(v, str) else (v.shape, v.dtype) for key, v in values.items()}
        if not self._samples:
            if not arrays:
                raise StorageError(f"{WHAT}: expected a sample with arrays, got none.")
            if self.store == "counts" and "measurement" not in arrays:
                raise StorageError(
                    f"{WHAT}: store='counts' is for the measurement of a sensor, and the samples have "
                    f"{', '.join(arrays)}. Give the recipe a sensing chain, or store='rounded'."
                )
            measured = measured_names(self._header.get("about"))
            for name, array in arrays.items():
                encoding = encoding_of(name, array.dtype, self.store, measured)
                self._arrays[name] = _Column(array, name, encoding, self.compression)
            self._values = kinds
        what = f"{WHAT}: sample {sample.index}"
        for name, before, here in (("arrays", [*self._arrays], [*arrays]), ("values", self._values, kinds)):
            if before != here:
                raise StorageError(
                    f"{what}: expected {name} as those of the samples before, {before}, got {here}. All samples of a "
                    "recipe have the same."
                )
        chunks = {name: self._arrays[name].compressed(row, array, what) for name, array in arrays.items()}
        for name, column in self._arrays.items():
            column.rows[row] = chunks[name]
        self._samples[row] = Sample(
            int(sample.index), int(sample.seed), arrays={}, values=values, outside=sample.outside,
            structure=sample.structure,
        )  # fmt: skip

    def fail(self, row: int, index: int, reason: str) -> None:
        """Record a sample that could not be made.

        Args:
            row: row of the sample in the shard.
            index: number of the sample in the recipe, from 0.
            reason: reason of the failure.
        """
        self._failed[self._free(row)] = (int(index), str(reason))

    def _free(self, row: int) -> int:
        if row not in range(self.rows):
            raise StorageError(f"{WHAT}: expected a row from 0 to {self.rows - 1}, got {shown(row)}.")
        if row in self._samples or row in self._failed:
            raise StorageError(f"{WHAT}: row {row} was put before.")
        return row

    # ------------------------------------------------------------------------------------------------------- at the end

    def _write(self) -> None:
        missing = [row for row in range(self.rows) if row not in self._samples and row not in self._failed]
        if missing:
            raise StorageError(f"{WHAT}: '{self.path}': the rows {shown(missing)} were neither put nor failed.")
        index = [self._samples[r].index if r in self._samples else self._failed[r][0] for r in range(self.rows)]
        if len(set(index)) != self.rows:
            raise StorageError(f"{WHAT}: '{self.path}': expected every sample once, got the indices {shown(index)}.")
        with writing_said(self.path, WHAT):
            self._write_file(index)

    def _write_file(self, index: list[int]) -> None:
        with new_hdf5(self._unfinished, WHAT, libver=LIBVER) as file:
            columns = {name: self._arrays[name] for name in sorted(self._arrays)}
            about = np.frombuffer(self._about(columns).encode("utf-8"), np.uint8)
            file.create_dataset("about", data=about)
            file.create_dataset("index", data=np.array(index, np.int64))
            nothing = Sample(0, 0, arrays={})
            rows = [self._samples.get(row, nothing) for row in range(self.rows)]
            file.create_dataset("seed", data=np.array([row.seed for row in rows], np.uint32))
            file.create_dataset("outside", data=np.array([row.outside for row in rows], np.float64))
            file.create_dataset("there", data=np.array([row in self._samples for row in range(self.rows)], np.uint8))
            values = file.create_group("values")
            for key, kind in self._values.items():
                if kind is not None:
                    empty = np.zeros(*kind)
                    values.create_dataset(member_name(key), data=np.stack([row.values.get(key, empty) for row in rows]))
            arrays = file.create_group("arrays")
            for column in columns.values():
                column.write(arrays, self.rows)
        seal(self._unfinished)

    def _about(self, columns: Mapping[str, _Column]) -> str:
        texts = [key for key, kind in self._values.items() if kind is None]
        there = self._samples
        return _json(
            {
                "format": FORMAT, "store": self.store, "compression": self.compression, "header": self._header,
                "arrays": {name: {"dtype": c.dtype.str, "encoding": c.encoding} for name, c in columns.items()},
                "values": [key for key in self._values if key not in texts],
                "texts": {key: [there[r].values[key] if r in there else "" for r in range(self.rows)] for key in texts},
                "structure": [there[r].structure if r in there else "" for r in range(self.rows)],
                "failed": [[row, *self._failed[row]] for row in sorted(self._failed)],
            }
        )  # fmt: skip


class _Column:
    """One array of all samples, as compressed chunks by row."""

    def __init__(self, first: NDArray[Any], name: str, encoding: str, compression: str) -> None:
        self.name, self.shape, self.dtype = name, first.shape, first.dtype
        self.encoding, self.compression = encoding, compression
        self.rows: dict[int, tuple[np.dtype[Any], list[bytes]]] = {}
        self._compressors: dict[np.dtype[Any], Compressor] = {}

    def compressed(self, row: int, array: NDArray[Any], what: str) -> tuple[np.dtype[Any], list[bytes]]:
        """Encode and compress an array."""
        if (array.shape, array.dtype) != (self.shape, self.dtype):
            raise StorageError(
                f"{what}: expected '{self.name}' as in the samples before, {self.dtype} {self.shape}, got "
                f"{array.dtype} {array.shape}. All samples of a recipe have the same."
            )
        stored = encoded(array, self.encoding, f"{what}: '{self.name}'")
        return stored.dtype, self._compressor(stored.dtype).compressed(stored)

    def write(self, group: Any, rows: int) -> None:
        # The type of the largest count.
        """Write all rows."""
        dtype = max((kind for kind, _ in self.rows.values()), key=lambda kind: kind.itemsize)
        compressor = self._compressor(dtype)
        data = group.create_dataset(self.name, (rows, *self.shape), dtype, **compressor.options)
        for row in sorted(self.rows):
            kind, chunks = self.rows[row]
            if kind != dtype:
                chunks = compressor.compressed(self._compressor(kind).array(chunks))
            for (_, *place), chunk in zip(compressor.places, chunks, strict=True):
                data.id.write_direct_chunk((row, *place), chunk)

    def close(self) -> None:
        """Free the memory."""
        for compressor in self._compressors.values():
            compressor.close()

    def _compressor(self, dtype: np.dtype[Any]) -> Compressor:
        if dtype not in self._compressors:
            self._compressors[dtype] = Compressor(self.shape, dtype, self.compression, WHAT)
        return self._compressors[dtype]


def seal(path: Path) -> None:
    """Append the checksum of a file.

    Args:
        path: path of the file.
    """
    with path.open("r+b") as file:
        digest = hash_of(file, path.stat().st_size)
        file.seek(0, 2)
        file.write(SEAL + digest)


def hash_of(file: Any, size: int) -> bytes:
    """Return the SHA-256 of the beginning of a file.

    Args:
        file: open file.
        size: number of bytes.

    Returns:
        Digest.
    """
    found, buffer = hashlib.sha256(), memoryview(bytearray(_HASHED_BYTES))
    file.seek(0)
    while size > 0:
        count = file.readinto(buffer[: min(size, _HASHED_BYTES)])
        if not count:
            break
        found.update(buffer[:count])
        size -= count
    return found.digest()


def member_name(key: str) -> str:
    """Return a key as the name of a member of an HDF5 group, where slashes and single points mean something else.

    Args:
        key: key of a drawn value.

    Returns:
        Name.
    """
    return key.replace("%", "%25").replace("/", "%2F") if key != "." else "%2E"


def _array(value: Any, what: str) -> NDArray[Any]:
    array = np.asarray(value)
    if array.dtype.kind not in "biufc" or not array.size or array.dtype.itemsize > 16:
        raise StorageError(f"{what}: expected an array of numbers, got {array.dtype} {array.shape}.")
    return np.ascontiguousarray(array, array.dtype.newbyteorder("<")).reshape(array.shape)


def _value(value: Any, key: str) -> NDArray[Any] | str:
    return value if isinstance(value, str) else _array(value, f"{WHAT}: the value '{key}'")


def _json(value: Any) -> str:
    try:
        return json.dumps(value, sort_keys=True, allow_nan=False, ensure_ascii=False)
    except (TypeError, ValueError) as error:
        raise StorageError(f"{WHAT}: expected a header of plain data that JSON can hold: {error}.") from error


def stored_checksum(path: Path) -> str:
    """Return the checksum at the end of a shard, without comparing it.

    Args:
        path: path of the file.

    Returns:
        Hexadecimal digits.

    Raises:
        StorageError: for a file without one.
    """
    with damage_said(path, WHAT), path.open("rb") as file:
        file.seek(-SEAL_BYTES, 2)
        found = file.read(SEAL_BYTES)
    if found[: len(SEAL)] != SEAL or len(found) != len(SEAL) + hashlib.sha256().digest_size:
        raise StorageError(f"{WHAT}: '{path}' has no checksum at its end: it was cut or changed. Make it again.")
    return found[len(SEAL) :].hex()


def _read_into(array: NDArray[Any], dataset: Any, corner: tuple[int, ...]) -> None:
    """Read a block of one row into an array, as ``dataset.read_direct`` does, which takes longer to find the block than
    to read a small image.
    """
    import h5py

    here, there = h5py.h5s.create_simple((1, *array.shape)), dataset.id.get_space()
    there.select_hyperslab(tuple(int(n) for n in corner), (1, *array.shape))
    dataset.id.read(here, there, array)


def _check_about(about: Mapping[str, Any], rows: int) -> None:
    """Raise ValueError for an entry that :class:`ShardWriter` does not write."""
    right = isinstance(about["header"], dict) and isinstance(about["arrays"], dict)
    right &= all(isinstance(about[name], str) for name in _TEXTS)
    right &= all(entry["encoding"] in ENCODINGS for entry in about["arrays"].values())
    right &= isinstance(about["values"], list) and all(isinstance(key, str) for key in about["values"])
    lists = [about["structure"], *about["texts"].values()]
    right &= all(isinstance(one, list) and len(one) == rows for one in lists)
    right &= all(isinstance(text, str) for one in lists for text in one)
    if not right:
        raise ValueError("'about' does not describe the arrays")


def part_of(given: slice, size: int, name: str) -> slice:
    """Return a slice with its bounds.

    Args:
        given: slice.
        size: number of entries of the whole axis.
        name: name of the slice, for messages.

    Returns:
        Slice.

    Raises:
        StorageError: for slices with a step, and for empty ones.
    """
    start, stop, step = given.indices(size)
    if step != 1 or stop <= start:
        raise StorageError(f"{WHAT}: expected {name} to be some of {size} without steps, got {shown(given)}.")
    return slice(start, stop)
