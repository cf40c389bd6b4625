"""Shards as data sets of torch: samples by number, with windows of time and parts of the image, and a stream of whole
files in a shuffled order, divided among ranks and workers.
"""

from __future__ import annotations

import glob
import math
import os
import warnings
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset, IterableDataset, get_worker_info

from torchtransient.array_files.array_file import tensor_in
from torchtransient.axes import TimeAxis
from torchtransient.checks import count, path_of, shown
from torchtransient.data.manifest import named_shards, shards_of
from torchtransient.data.sample import (
    Epochs,
    checked_seed,
    measurement,
    outside_tensor,
    sample_generator,
    sample_number,
)
from torchtransient.data.shard_format import measured_names
from torchtransient.data.shards import Shard, part_of
from torchtransient.errors import (
    ArgumentError,
    StorageError,
    TorchTransientError,
    TorchTransientWarning,
    UnitError,
    level_of_user,
)

# Tolerance of window ends at the edges of bins, in bins.
_SAME_EDGE = 1e-6
WHAT = "data set"
_OPEN = 32
# Samples of a stream that are shuffled once more.
_BUFFER = 1024
_MEASURED = "measurement"
_VALUES, _INDEX, _OUTSIDE, _TRANSIENT = "values", "index", "outside", "transient"


class TransientDataset(Epochs, Dataset[dict[str, Any]]):
    """Samples of shards by number, in the order of the files and their rows, without those that failed.

    A sample is a dictionary: its arrays by name (``transient`` (C, T, H, W), ``steady`` (C, H, W) and labels),
    ``values`` (the drawn values by key), ``outside`` (the shares (2,) of its light before and after the time window
    that it was rendered with) and ``index`` (its number in the recipe). ``torch.utils.data.DataLoader`` makes batches
    of them. Files are opened when they are first read, in every process anew: the data set pickles, and workers may be
    forked or spawned.

    Args:
        where: folder, pattern of names, shard, or a list of these.
        fields: names of entries that are read, None for all.
        window: ``(start_opl, end_opl)`` in metres, or a slice of bins: only the slabs that hold them are read, of the
            transient, and of a measurement with as many bins. ``axis`` is the time axis of the result.
        pixels: slices (rows, columns) of every entry of the film's size.
        transform: sensor, or function of the transient, without gradients; its result stands under ``measurement``, in
            place of one that was stored. A sensor answers under its policy, the mean with "expected";
            ``transform=sensor.sample`` always draws.
        as_stored: keep the type of counts instead of float32.
        seed: each sample has a generator of its own for the transform (its argument ``generator``), so that it has the
            same noise in every process, in every epoch until :meth:`set_epoch`; None draws from torch's.

    Raises:
        StorageError: for files that cannot be read, or do not belong together, and windows beyond the axis.
        ArgumentError: for unknown fields.
        UnitError: for a seed or an epoch below zero.
        IndexError: beyond the samples.
    """

    def __init__(
        self, where: Any, *, fields: Sequence[str] | None = None, window: Any = None, pixels: Any = None,
        transform: Callable[..., Any] | None = None, as_stored: bool = False, seed: int | None = None,
    ) -> None:  # fmt: skip
        super().__init__()
        self._table = ShardTable(where)
        self.about: dict[str, Any] = self._table.about
        shapes = self._table.arrays
        whole = _axis_of(self.about)
        self._bins = _bins_of(window, whole)
        self.axis: TimeAxis | None = whole
        if whole is not None and self._bins is not None:
            start_opl, bins = whole.start_opl + self._bins.start * whole.bin_width_opl, self._bins
            self.axis = TimeAxis(start_opl, whole.bin_width_opl, bins.stop - bins.start)
        # Measured arrays are on the time axis of the film if they have as many bins.
        self._timed = measured_names(self.about)
        # Rows and columns of the steady image and labels, else of measured arrays.
        order = ["steady", *(name for name in shapes if name not in self._timed), *self._timed]
        self._size = next((shapes[name][-2:] for name in order if len(shapes.get(name, ())) >= 2), ())
        self._pixels = pixels
        if pixels is not None:
            self._pixels = tuple(part_of(one, size, "pixels") for one, size in zip(pixels, self._size, strict=True))
        self.transform, self.seed, self.as_stored = transform, checked_seed(WHAT, seed), as_stored
        self._fields = self._read_fields(fields, shapes)

    def __len__(self) -> int:
        return len(self._table)

    @property
    def index(self) -> Tensor:
        """(N,) int64: the number of every sample in its recipe."""
        return torch.from_numpy(self._table.index.copy())

    @property
    def outside(self) -> Tensor:
        """(N, 2) float64: shares of every sample's light before and after the time window of the render."""
        return torch.from_numpy(self._table.outside.copy())

    @property
    def failed(self) -> dict[int, str]:
        """Samples that could not be made, with their reasons."""
        return dict(self._table.failed)

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of a sample's entries, beside its index."""
        made = () if self.transform is None else (_MEASURED,)
        return tuple(dict.fromkeys((*self._fields, *made)))

    def sample(self, number: int, epoch: int | None = None) -> dict[str, Any]:
        """Read a sample.

        Args:
            number: number of the sample in the data set, from 0; negative ones count from the end.
            epoch: number of the epoch, which distinguishes the noise of epochs; None is 0.

        Returns:
            Sample.
        """
        number = sample_number(WHAT, number, len(self._table))
        epoch = 0 if epoch is None else count(f"{WHAT}: epoch", epoch, 0, UnitError)
        place, row = int(self._table.shard[number]), int(self._table.row[number])
        shard = self._table.open(place)
        found: dict[str, Any] = {name: self._read(shard, name, row) for name in self._fields if name != _VALUES}
        index = int(self._table.index[number])
        if self.transform is not None:
            given = found if _TRANSIENT in found else {_TRANSIENT: self._read(shard, _TRANSIENT, row)}
            # Samples of several folders may have one number in their recipes.
            repeat = int(self._table.repeat[number])
            generator = sample_generator(WHAT, self.seed, index, epoch, repeat)
            found[_MEASURED] = measurement(WHAT, self.transform, given, generator)
        if _VALUES in self._fields:
            values = shard.values(row)
            found[_VALUES] = {k: v if isinstance(v, str) else tensor_in(v) for k, v in values.items()}
        found |= {_OUTSIDE: outside_tensor(shard.outside[row]), _INDEX: index}
        return found

    def close(self) -> None:
        """Close the files that this process has open. They are opened again when they are read."""
        self._table.close()

    # -------------------------------------------------------------------------------------------------------- reading

    def _read_fields(self, fields: Sequence[str] | None, shapes: dict[str, Any]) -> tuple[str, ...]:
        known, made = (*shapes, _VALUES), (_INDEX,) if self.transform is None else (_INDEX, _MEASURED)
        if fields is None:
            names = known
        else:
            names = (fields,) if isinstance(fields, str) else tuple(fields)
            unknown = [name for name in names if name not in (*known, *made)]
            if unknown:
                raise ArgumentError(f"{WHAT}: expected fields among {', '.join(known)}, got {shown(unknown[0])}.")
        if self.transform is not None and _TRANSIENT not in shapes:
            raise StorageError(f"{WHAT}: transform= is for transients, and the samples have {', '.join(shapes)}.")
        return tuple(name for name in names if name not in made)

    def _read(self, shard: Shard, name: str, row: int) -> Tensor:
        shape = self._table.arrays[name]
        bins = self._bins if name in self._timed and self._table.time_axes[name] is not None else None
        pixels = self._pixels if shape[-2:] == self._size else None
        array = shard.read(name, row, window=bins, pixels=pixels, as_stored=self.as_stored)
        return torch.from_numpy(array) if array.dtype.isnative else tensor_in(array)


class TransientStream(IterableDataset[dict[str, Any]]):
    """Stream of the samples of shards, each once in an epoch, over all ranks and workers together.

    Files come in a shuffled order, and so do the samples of a file; 1024 samples that follow each other are shuffled
    once more, by their places, so that a reader goes back and forth between as many files as they span. The order
    depends on ``seed``, the epoch (:meth:`set_epoch`; without it, every epoch is the first one), and the number of
    ranks and workers. Workers of a DataLoader divide the share of their rank.

    Args:
        where: folder, pattern of names, shard, or a list of these, see :class:`TransientDataset`.
        shuffle: False for files and rows in order.
        seed: seed of the shuffled order.
        rank: number of the share of the samples that this process reads; by default the rank of torch.distributed, or
            RANK.
        world_size: number of shares, likewise. Shares differ by one sample where samples cannot be divided evenly.
        even: leave out the last samples of an epoch's order, so that no rank waits for another one.
        noise_seed: ``seed`` of :class:`TransientDataset`; every epoch has noise of its own.
        reading: other arguments of :class:`TransientDataset`.

    Raises:
        StorageError: as :class:`TransientDataset`.
    """

    def __init__(
        self, where: Any, *, shuffle: bool = True, seed: int = 0, rank: int | None = None,
        world_size: int | None = None, even: bool = False, noise_seed: int | None = None, **reading: Any,
    ) -> None:  # fmt: skip
        self.dataset = TransientDataset(where, **reading, seed=noise_seed)
        self.shuffle, self.even, self.seed = shuffle, even, count(f"{WHAT}: seed", seed, 0, most=None)
        self._rank = None if rank is None and world_size is None else _checked_rank(rank, world_size)
        # In shared memory, for workers that stay for several epochs. Epoch, batches that are left out, their size.
        self._place = torch.tensor([0, 0, 1]).share_memory_()  # type: ignore[no-untyped-call]

    @property
    def axis(self) -> TimeAxis | None:
        """Time axis of the transients that are returned."""
        return self.dataset.axis

    @property
    def about(self) -> dict[str, Any]:
        """Description of the render in the shards."""
        return self.dataset.about

    @property
    def epoch(self) -> int:
        """The epoch that is read next."""
        return int(self._place[0])

    def set_epoch(self, epoch: int, batches: int = 0, batch_size: int = 1) -> None:
        """Choose the order of the next iteration, in all workers. Call it before iterating over the loader.

        Args:
            epoch: number of the epoch, from 0.
            batches: batches of ``batch_size`` that a loader of this rank has given already, in an epoch that goes on:
                they are left out, and those that follow are the same as without a stop. With as many workers as before.
            batch_size: number of samples in a batch of the loader.
        """
        numbers = [
            count(f"{WHAT}: epoch", epoch, 0),
            count(f"{WHAT}: batches", batches, 0),
            count(f"{WHAT}: batch_size", batch_size),
        ]
        self._place.copy_(torch.tensor(numbers))

    @property
    def num_samples(self) -> int:
        """Number of samples that this rank reads in an epoch."""
        start, stop = _share(self._used(), *self._ranks())
        return stop - start

    def __iter__(self) -> Iterator[dict[str, Any]]:
        for sample, _ in self.repeated():
            yield sample

    def repeated(self) -> Iterator[tuple[dict[str, Any], int]]:
        """Yield samples, each with the number of samples of other folders before it that have its ``index``."""
        epoch, batches, size = self._place.tolist()
        repeats = self.dataset._table.repeat
        part, parts = _worker()
        given, turn = self._given(batches, size, parts)
        # Loaders begin with their first worker: it takes the share of the one whose turn it is.
        part = (part + turn) % parts
        for number in self._order(epoch, part, parts)[given[part] :]:
            yield self.dataset.sample(int(number), epoch), int(repeats[number])

    def _order(self, epoch: int, part: int, parts: int) -> NDArray[np.int64]:
        rank, ranks = self._ranks()
        start, stop = _share(self._used(), rank, ranks)
        first, last = _share(stop - start, part, parts)
        found = self._everything(epoch)[start + first : start + last]
        if not self.shuffle:
            return found
        return _buffered(found, _BUFFER, np.random.default_rng([self.seed, epoch, 1, rank, part]))

    def _given(self, batches: int, size: int, parts: int) -> tuple[list[int], int]:
        """Samples that each worker has given when its loader has given so many batches, and the worker whose turn it
        is.

        Workers take turns; the last batch of each may be smaller, and workers without samples are left out.
        """
        shares = [_share(self.num_samples, n, parts) for n in range(parts)]
        left = [-(-(last - first) // size) for first, last in shares]
        given, turn = [0] * parts, 0
        while batches and any(left):
            if left[turn]:
                left[turn], batches, given[turn] = left[turn] - 1, batches - 1, given[turn] + size
            turn = (turn + 1) % parts
        return given, turn

    def _everything(self, epoch: int) -> NDArray[np.int64]:
        """All samples, file by file: the same order in all ranks and workers."""
        files = self.dataset._table.shard
        numbers = np.arange(len(files), dtype=np.int64)
        if not self.shuffle:
            return numbers
        rng = np.random.default_rng([self.seed, epoch, 0])
        place = rng.permutation(int(files.max()) + 1)
        mixed = rng.permutation(numbers)
        return mixed[np.argsort(place[files[mixed]], kind="stable")]

    def _used(self) -> int:
        """Number of samples that all ranks read together."""
        ranks = self._ranks()[1]
        return len(self.dataset) // ranks * ranks if self.even else len(self.dataset)

    def _ranks(self) -> tuple[int, int]:
        return self._rank if self._rank is not None else _found_rank()

    def __getstate__(self) -> dict[str, Any]:
        # Spawned workers do not know torch.distributed.
        return {**self.__dict__, "_rank": self._ranks()}


def _worker() -> tuple[int, int]:
    worker = get_worker_info()
    return (0, 1) if worker is None else (worker.id, worker.num_workers)


def _share(size: int, part: int, parts: int) -> tuple[int, int]:
    return size * part // parts, size * (part + 1) // parts


def _buffered(numbers: NDArray[np.int64], size: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Sequence after a shuffle buffer: each entry is drawn from the ``size`` next ones that are left."""
    found = numbers.copy()
    held = list(numbers[:size])
    for place in range(len(numbers)):
        drawn = int(rng.integers(len(held)))
        found[place] = held[drawn]
        if place + size < len(numbers):
            held[drawn] = numbers[place + size]
        else:
            held[drawn] = held[-1]
            held.pop()
    return found


def _found_rank() -> tuple[int, int]:
    distributed = torch.distributed
    if distributed.is_available() and distributed.is_initialized():
        return distributed.get_rank(), distributed.get_world_size()
    if "RANK" in os.environ and "WORLD_SIZE" in os.environ:
        try:
            rank, size = int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])
        except ValueError:
            raise StorageError(f"{WHAT}: expected RANK and WORLD_SIZE as whole numbers, give rank= instead.") from None
        return _checked_rank(rank, size)
    return 0, 1


def _checked_rank(rank: int | None, world_size: int | None) -> tuple[int, int]:
    size = count(f"{WHAT}: world_size", world_size)
    if (place := count(f"{WHAT}: rank", rank, 0)) >= size:
        raise StorageError(f"{WHAT}: expected rank below world_size = {size}, got {rank}.")
    return place, size


# ------------------------------------------------------------------------------------------------ files


class ShardTable:
    """Samples of several shards in the order of files and rows, and the shards that are open.

    ``shard`` and ``row`` int64 (N,), ``index`` int64 (N,): number of the sample in its recipe, ``repeat`` int64 (N,):
    number of samples before it with the same one. ``about``: description of the render in all shards. Pickles without
    open files; a process that was forked opens its own.

    Args:
        where: folder, pattern of names, shard, or a list of these, see :class:`TransientDataset`.

    Raises:
        StorageError: for shards that do not belong together.
    """

    def __init__(self, where: Any) -> None:
        self.paths = _shard_paths(where)
        self._open: OrderedDict[int, Shard] = OrderedDict()
        self._process = os.getpid()
        shards, rows, index = [], [], []
        outside: list[Any] = []
        first: dict[str, Any] | None = None
        self.failed: dict[int, str] = {}
        self.arrays: dict[str, tuple[int, ...]] = {}
        self.time_axes: dict[str, int | None] = {}
        self.about: dict[str, Any] = {}
        for number, path in enumerate(self.paths):
            with Shard(path) as shard:
                shards += [number] * len(shard.index)
                rows += list(shard.index.values())
                index += list(shard.index)
                outside += [shard.outside[row] for row in shard.index.values()]
                self.failed |= shard.failed
                if not shard.index:
                    continue
                kind = _kind(shard)
                if first is None:
                    first = kind
                    self.arrays = {name: shard.shape(name) for name in shard.names}
                    self.time_axes = {name: shard.time_axis(name) for name in shard.names}
                    self.about = kind["about"]
                _check_alike(first, kind, self.paths[shards[0]], path)
        if not shards:
            raise StorageError(f"{WHAT}: expected samples, got none in {len(self.paths)} shards: all of them failed.")
        self.shard, self.row = np.array(shards, np.int64), np.array(rows, np.int64)
        self.index: NDArray[np.int64] = np.array(index, np.int64)
        self.outside: NDArray[np.float64] = np.array(outside, np.float64).reshape(-1, 2)
        self.repeat = _repeats(self.index)

    def __len__(self) -> int:
        return len(self.index)

    def open(self, number: int) -> Shard:
        """Open shard; those that were not used for long are closed.

        Args:
            number: number of the file, from 0.

        Returns:
            Shard.
        """
        if self._process != os.getpid():
            # The parent's files stay open: HDF5 shares its state with it.
            self._open, self._process = OrderedDict(), os.getpid()
        if number in self._open:
            self._open.move_to_end(number)
            return self._open[number]
        shard = self._open[number] = Shard(self.paths[number])
        while len(self._open) > _OPEN:
            self._open.popitem(last=False)[1].close()
        return shard

    def close(self) -> None:
        """Close the open files."""
        while self._process == os.getpid() and self._open:
            self._open.popitem()[1].close()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_open": OrderedDict()}


def _axis_of(about: Mapping[str, Any]) -> TimeAxis | None:
    """Time axis of a render, None for films without one."""
    given = about.get("axis")
    if not isinstance(given, Mapping) or "num_bins" not in given:
        return None
    try:
        return TimeAxis(given["start_opl"], given["bin_width_opl"], given["num_bins"])
    except (KeyError, TorchTransientError) as error:
        raise StorageError(f"{WHAT}: the time axis of the shards is none: {error}") from None


def _bins_of(window: Any, axis: TimeAxis | None) -> slice | None:
    """Bins of a window, all that it touches. Raises StorageError for one that is not all on the axis."""
    if window is None:
        return None
    if axis is None:
        raise StorageError(f"{WHAT}: window= is for transients, and these samples have no time axis.")
    if isinstance(window, slice):
        return part_of(window, axis.num_bins, "window")
    start_opl, end_opl = window
    start_opl = axis.start_opl if start_opl is None else start_opl
    end_opl = axis.end_opl if end_opl is None else end_opl
    first, last = ((float(end) - axis.start_opl) / axis.bin_width_opl for end in (start_opl, end_opl))
    if not (-_SAME_EDGE <= first < last <= axis.num_bins + _SAME_EDGE):
        raise StorageError(
            f"{WHAT}: expected window to lie between {axis.start_opl:g} m and {axis.end_opl:g} m, got "
            f"{shown(window)}. None is an end that is open."
        )
    start = min(axis.num_bins - 1, max(0, math.floor(first + _SAME_EDGE)))
    return slice(start, min(axis.num_bins, max(start + 1, math.ceil(last - _SAME_EDGE))))


def _shard_paths(where: Any) -> list[Path]:
    """Shards of a folder, a pattern, a file, or a list of them. Warns where a folder's manifest names shards that are
    missing. Raises StorageError where there is none.
    """
    if isinstance(where, list | tuple):
        paths = [path for one in where for path in _shard_paths(one)]
    else:
        path = path_of(where, WHAT)
        places = [path] if path.exists() else sorted(map(Path, glob.glob(str(path), recursive=True)))
        paths = [one.absolute() for place in places for one in (_of_folder(place) if place.is_dir() else [place])]
    if len(set(paths)) != len(paths):
        raise StorageError(f"{WHAT}: expected every shard once, got some of them twice.")
    if not paths:
        raise StorageError(
            f"{WHAT}: expected a folder with shards, a pattern of their names, or a list of them, got {shown(where)}, "
            "where there is none."
        )
    return paths


def _of_folder(folder: Path) -> list[Path]:
    """The shards of a folder, with a warning where its manifest names others."""
    found = shards_of(folder)
    gone = sorted(set(named_shards(folder)) - {path.name for path in found})
    if found and gone:
        warnings.warn(
            f"{WHAT}: '{folder}' lacks {len(gone)} of the {len(gone) + len(found)} shards of its manifest.json: "
            f"{shown(gone)}. Their samples are left out; generate makes them again.",
            TorchTransientWarning,
            level_of_user(),
        )
    return found


def _kind(shard: Shard) -> dict[str, Any]:
    """Properties that all shards of a data set share."""
    about = shard.header.get("about")
    return {
        "arrays": {name: (shard.shape(name), shard.dtype(name)) for name in shard.names},
        "values": shard.keys,
        "about": about if isinstance(about, dict) else {},
    }


def _check_alike(first: dict[str, Any], other: dict[str, Any], here: Path, there: Path) -> None:
    pairs = [(name, first[name], other[name]) for name in ("arrays", "values")]
    pairs += [(name, first["about"].get(name), other["about"].get(name)) for name in ("axis", "channels", "measures")]
    for name, a, b in pairs:
        if a != b:
            raise StorageError(
                f"{WHAT}: expected the same {name} in all shards, got {shown(a)} in '{here}' and {shown(b)} in "
                f"'{there}'. Read them as two data sets."
            )


def _repeats(index: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each entry, how many before it are equal to it."""
    order = np.argsort(index, kind="stable")
    ranked = index[order]
    starts = np.flatnonzero(np.r_[True, ranked[1:] != ranked[:-1]])
    found = np.empty(len(index), np.int64)
    found[order] = np.arange(len(index)) - np.repeat(starts, np.diff(np.r_[starts, len(index)]))
    return found
