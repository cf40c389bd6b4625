"""Shards: HDF5 files of several samples, whose bytes are a function of the samples alone.

``about``, JSON as bytes, tells the format, the header, what is stored how, texts and failures; ``index`` int64 (N,),
``seed`` uint32 (N,), ``outside`` float64 (N, 2) and ``there`` uint8 (N,) have an entry for each row; ``arrays/<name>``
(N, ...) are the samples, rows that failed without chunks; ``values/<key>`` (N, ...) what was drawn. Behind the end of
HDF5 stand eight letters and the SHA-256 of all bytes before them. Chunks carry Fletcher's checksum besides, which every
reader of HDF5 checks. There are no times, hosts or names of users in a shard.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from torchtransient.array_files.array_file import check_folder, path_of
from torchtransient.array_files.hdf5 import new_hdf5
from torchtransient.array_files.part_files import whole_file, writing_said
from torchtransient.checks import count, mapping, shown
from torchtransient.data.storage.chunks import LIBVER, Compressor, check_compression
from torchtransient.data.storage.encodings import check_store, encoded, encoding_of, measured_names
from torchtransient.errors import StorageError

FORMAT = "torchtransient shard 1"
WHAT = "shard"
SEAL = b"ttshard1"
SEAL_BYTES = len(SEAL) + hashlib.sha256().digest_size
_HASHED_BYTES = 2**22


class StoredSample(Protocol):
    """What a shard takes: a sample as makers of recipes return it."""

    @property
    def index(self) -> int: ...
    @property
    def seed(self) -> int: ...
    @property
    def arrays(self) -> Mapping[str, NDArray[Any]]: ...
    @property
    def values(self) -> Mapping[str, NDArray[Any] | str]: ...
    @property
    def outside(self) -> tuple[float, float]: ...
    @property
    def structure(self) -> str: ...


class ShardWriter:
    """A shard that is written as its samples come, in any order of rows, and takes its place when the block ends.

    ``rows``: how many samples it has, those that fail included. ``header``: plain data, JSON. ``store``: "exact",
    "rounded" (10 bits of mantissa for what was measured, which ``header["about"]["measures"]`` names, labels as they
    are) or "counts" (``measurement`` as whole numbers, everything else as it is). ``compression``: "blosc2", "gzip" or
    "none".

    Compressed samples are kept in memory until the block ends. Where the block raises, or was killed, nothing appears.
    Raises StorageError for arguments that cannot be used, a folder that is missing, a full disk, samples that are
    unlike the first one, and rows that were neither put nor failed.
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
        plain = dict(mapping(f"{WHAT}: header", header, "of plain data", StorageError))
        self._header = json.loads(_json(plain, "header"))
        self._samples: dict[int, _Row] = {}
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

    def put(self, row: int, sample: StoredSample) -> None:
        """Take a sample: it is encoded and compressed now."""
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
        _check_same("arrays", list(self._arrays), list(arrays), what)
        if self._values != kinds:
            raise StorageError(
                f"{what}: expected values as those of the samples before, {_kinds_text(self._values)}, got "
                f"{_kinds_text(kinds)}. All samples of a recipe have the same."
            )
        chunks = {name: self._arrays[name].compressed(row, array, what) for name, array in arrays.items()}
        before, after = sample.outside
        entry = _Row(int(sample.index), int(sample.seed), (float(before), float(after)), sample.structure, values)
        for name, column in self._arrays.items():
            column.rows[row] = chunks[name]
        self._samples[row] = entry

    def fail(self, row: int, index: int, reason: str) -> None:
        """Note a sample that could not be made, and why."""
        self._failed[self._free(row)] = (int(index), str(reason))

    def _free(self, row: int) -> int:
        row = count(f"{WHAT}: row", row, 0, StorageError)
        if row >= self.rows:
            raise StorageError(f"{WHAT}: expected a row below {self.rows}, got {row}.")
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
            nothing = _Row(0, 0, (0.0, 0.0), "", {})
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
            },
            "header",
        )  # fmt: skip


class _Row:
    """What is kept of a sample beside its arrays."""

    def __init__(
        self, index: int, seed: int, outside: tuple[float, float], structure: str, values: dict[str, Any]
    ) -> None:
        self.index, self.seed, self.outside, self.structure, self.values = index, seed, outside, structure, values


class _Column:
    """One array of all samples, as compressed chunks by row."""

    def __init__(self, first: NDArray[Any], name: str, encoding: str, compression: str) -> None:
        self.name, self.shape, self.dtype = name, first.shape, first.dtype
        self.encoding, self.compression = encoding, compression
        self.rows: dict[int, tuple[np.dtype[Any], list[bytes]]] = {}
        self._compressors: dict[np.dtype[Any], Compressor] = {}

    def compressed(self, row: int, array: NDArray[Any], what: str) -> tuple[np.dtype[Any], list[bytes]]:
        if (array.shape, array.dtype) != (self.shape, self.dtype):
            raise StorageError(
                f"{what}: expected '{self.name}' as in the samples before, {self.dtype} {self.shape}, got "
                f"{array.dtype} {array.shape}. All samples of a recipe have the same."
            )
        stored = encoded(array, self.encoding, f"{what}: '{self.name}'")
        return stored.dtype, self._compressor(stored.dtype).compressed(stored)

    def write(self, group: Any, rows: int) -> None:
        # Counts: the type that holds the largest of all.
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
        for compressor in self._compressors.values():
            compressor.close()

    def _compressor(self, dtype: np.dtype[Any]) -> Compressor:
        if dtype not in self._compressors:
            self._compressors[dtype] = Compressor(self.shape, dtype, self.compression, WHAT)
        return self._compressors[dtype]


def seal(path: Path) -> None:
    """Append the checksum of a file to it."""
    with path.open("r+b") as file:
        digest = hash_of(file, path.stat().st_size)
        file.seek(0, 2)
        file.write(SEAL + digest)


def hash_of(file: Any, size: int) -> bytes:
    """SHA-256 of the first ``size`` bytes of an open file."""
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
    """A key as the name of a member of an HDF5 group, where slashes and single points mean something else."""
    return key.replace("%", "%25").replace("/", "%2F") if key != "." else "%2E"


def _array(value: Any, what: str) -> NDArray[Any]:
    array = np.asarray(value)
    if array.dtype.kind not in "biufc" or not array.size or array.dtype.itemsize > 16:
        raise StorageError(f"{what}: expected an array of numbers, got {array.dtype} {array.shape}.")
    return np.ascontiguousarray(array, array.dtype.newbyteorder("<")).reshape(array.shape)


def _value(value: Any, key: str) -> NDArray[Any] | str:
    return value if isinstance(value, str) else _array(value, f"{WHAT}: the value '{key}'")


def _check_same(what: str, expected: list[str], found: list[str], where: str) -> None:
    if expected != found:
        raise StorageError(
            f"{where}: expected the {what} {', '.join(expected)}, as the samples before have them, got "
            f"{', '.join(found)}. All samples of a recipe have the same."
        )


def _kinds_text(kinds: Mapping[str, Any]) -> str:
    each = (f"{key} {'text' if kind is None else f'{kind[1]} {kind[0]}'}" for key, kind in kinds.items())
    return ", ".join(each) or "none"


def _json(value: Any, what: str) -> str:
    try:
        return json.dumps(value, sort_keys=True, allow_nan=False, ensure_ascii=False)
    except (TypeError, ValueError) as error:
        raise StorageError(f"{WHAT}: expected {what} as plain data that JSON can hold: {error}.") from error
