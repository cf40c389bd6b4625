"""Reading shards: files that anyone may have written, of which nothing is believed before it is checked."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from torchtransient.array_files.array_file import check_source, damage_said
from torchtransient.array_files.hdf5 import check_memory, dataset_of, hdf5_package, is_number, read_dataset
from torchtransient.checks import as_whole, shown
from torchtransient.data.storage.chunks import check_chunks, time_axis
from torchtransient.data.storage.encodings import ENCODINGS, decoded
from torchtransient.data.storage.shard_writing import (
    FORMAT,
    SEAL,
    SEAL_BYTES,
    WHAT,
    hash_of,
    member_name,
)
from torchtransient.data.storage.shard_writing import ShardWriter as ShardWriter
from torchtransient.errors import StorageError

_TEXTS = ("format", "store", "compression")


class Shard:
    """An open shard. ``header``: as it was written. ``index``: rows by the index of their sample, those that exist, in
    order of rows. ``failed``: reasons by the index of the sample. ``names``: of the arrays. ``keys``: of the values.

    Use it as a context, or close it. Handles belong to one process. Raises StorageError for a file that is missing,
    damaged or no shard; so does every method.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = check_source(path, WHAT)
        self._datasets: dict[str, Any] = {}
        self._values: dict[str, NDArray[Any]] = {}
        with damage_said(self.path, WHAT):
            self._file = hdf5_package(WHAT).File(self.path, "r", rdcc_nbytes=0)
        try:
            with damage_said(self.path, WHAT):
                self._read_about()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._datasets.clear()
        self._file.close()

    def read(
        self, name: str, row: int, *, window: slice | None = None, pixels: tuple[slice, slice] | None = None,
        as_stored: bool = False,
    ) -> NDArray[Any]:  # fmt: skip
        """One array of a row. ``window``: a slice of the bins, of which alone what is asked for is read. ``pixels``:
        slices of rows and columns of the image. Counts are float32, unless ``as_stored``.
        """
        with damage_said(self.path, WHAT):
            return self._read(name, row, window, pixels, as_stored)

    def values(self, row: int) -> dict[str, NDArray[Any] | str]:
        """What was drawn for a row, by key."""
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
        """The shape of an array of one sample."""
        with damage_said(self.path, WHAT):
            return tuple(self._dataset(name).shape[1:])

    def time_axis(self, name: str) -> int | None:
        """Which axis of an array the bins are, None where it has none."""
        with damage_said(self.path, WHAT):
            return self._time_axis(name)

    def _time_axis(self, name: str) -> int | None:
        """As it is said of what was measured; else second, behind channels, or third, behind the Stokes components, in
        polarized variants.
        """
        shape = tuple(self._dataset(name).shape[1:])
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
        """The dtype that an array is read as, NumPy's name; ``as_stored``: that in the file."""
        with damage_said(self.path, WHAT):
            found = self._dataset(name).dtype
            return str(found if as_stored else decoded(np.empty(0, found), self.encoding(name)).dtype)

    def encoding(self, name: str) -> str:
        """How an array is stored: "exact", "rounded" or "counts"."""
        return str(self._about["arrays"][name]["encoding"])

    def verify(self) -> str | None:
        """What is wrong with the file, None where all of its bytes are those that were written."""
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

    def _read(self, name: str, row: int, window: Any, pixels: Any, as_stored: bool) -> NDArray[Any]:
        self._check_row(row)
        dataset = self._dataset(name)
        shape = dataset.shape[1:]
        part = [slice(0, n) for n in shape]
        if window is not None:
            time = self._time_axis(name)
            if time is None:
                raise StorageError(f"{WHAT}: '{name}' {shape} has no time axis; read all of it.")
            part[time] = _slice(window, shape[time], "window")
        if pixels is not None:
            if len(shape) < 2:
                raise StorageError(f"{WHAT}: '{name}' {shape} has no rows and columns; read all of it.")
            rows, columns = pixels
            part[-2], part[-1] = _slice(rows, shape[-2], "pixels"), _slice(columns, shape[-1], "pixels")
        size = tuple(cut.stop - cut.start for cut in part)
        check_memory(math.prod(size) * dataset.dtype.itemsize, f"{WHAT}: '{name}' {size}")
        # Into memory of its own: h5py would fill what it allocates with zeros first.
        array: NDArray[Any] = np.empty(size, dataset.dtype)
        _read_into(array, dataset, (row, *(cut.start for cut in part)))
        return array if as_stored else decoded(array, self.encoding(name))

    def _check_row(self, row: int) -> None:
        if (number := as_whole(row)) is None or not 0 <= number < self.rows:
            raise StorageError(f"{WHAT}: '{self.path}': expected a row from 0 to {self.rows - 1}, got {shown(row)}.")
        if not self._there[row]:
            reason = next((text for number, _, text in self._about["failed"] if number == row), "no reason")
            raise StorageError(f"{WHAT}: '{self.path}': the sample of row {row} could not be made: {reason}")


def stored_checksum(path: Path) -> str:
    """The checksum at the end of a shard, as hexadecimal digits, without comparing it. Raises StorageError."""
    with damage_said(path, WHAT), path.open("rb") as file:
        file.seek(-SEAL_BYTES, 2)
        found = file.read(SEAL_BYTES)
    if found[: len(SEAL)] != SEAL or len(found) != len(SEAL) + hashlib.sha256().digest_size:
        raise StorageError(f"{WHAT}: '{path}' has no checksum at its end: it was cut or changed. Make it again.")
    return found[len(SEAL) :].hex()


def _read_into(array: NDArray[Any], dataset: Any, corner: tuple[int, ...]) -> None:
    """A block of one row, into all of an array: what `dataset.read_direct` does, which takes longer to find the block
    than to read a small image.
    """
    import h5py

    here, there = h5py.h5s.create_simple((1, *array.shape)), dataset.id.get_space()
    there.select_hyperslab(tuple(int(n) for n in corner), (1, *array.shape))
    dataset.id.read(here, there, array)


def _check_about(about: Mapping[str, Any], rows: int) -> None:
    """Raise ValueError for what is not as :class:`ShardWriter` writes it."""
    right = isinstance(about["header"], dict) and isinstance(about["arrays"], dict)
    right &= all(isinstance(about[name], str) for name in _TEXTS)
    right &= all(entry["encoding"] in ENCODINGS for entry in about["arrays"].values())
    right &= isinstance(about["values"], list) and all(isinstance(key, str) for key in about["values"])
    lists = [about["structure"], *about["texts"].values()]
    right &= all(isinstance(one, list) and len(one) == rows for one in lists)
    right &= all(isinstance(text, str) for one in lists for text in one)
    if not right:
        raise ValueError("'about' does not tell what is stored")


def _slice(given: Any, size: int, name: str) -> slice:
    """A slice with its bounds. Raises StorageError for steps, and for nothing."""
    if not isinstance(given, slice):
        raise StorageError(f"{WHAT}: expected {name} as slices, got {shown(given)}.")
    try:
        start, stop, step = given.indices(size)
    except (TypeError, ValueError):
        raise StorageError(f"{WHAT}: expected {name} as slices of whole numbers, got {shown(given)}.") from None
    if step != 1 or stop <= start:
        raise StorageError(f"{WHAT}: expected {name} to be some of {size} without steps, got {shown(given)}.")
    return slice(start, stop)
