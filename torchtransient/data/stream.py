"""Shards as an iterable data set: whole files in a shuffled order, divided among ranks and workers."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import IterableDataset, get_worker_info

from torchtransient.axes import TimeAxis
from torchtransient.checks import count, flag
from torchtransient.data.transient_dataset import WHAT, TransientDataset
from torchtransient.errors import ArgumentError, StorageError


class TransientStream(IterableDataset[dict[str, Any]]):
    """Stream of the samples of shards, each once in an epoch, over all ranks and workers together.

    Files come in a shuffled order, and so do the samples of a file; ``buffer`` samples that follow each other are
    shuffled once more. Only their places are kept, so that a large buffer takes no memory, and a reader goes back and
    forth between as many files as it spans. The order depends on ``seed``, the epoch (:meth:`set_epoch`; without it,
    every epoch is the first one), and the number of ranks and workers. Workers of a DataLoader divide the share of
    their rank.

    Args:
        where: as of :class:`TransientDataset`.
        shuffle: False for files and rows in order.
        seed: of the order.
        buffer: samples that are shuffled once more.
        rank: share of the samples that this process reads; by default that of torch.distributed, or of RANK.
        world_size: number of shares, likewise. Shares differ by one sample where samples cannot be divided evenly.
        even: leave out the last samples of an epoch's order, so that no rank waits for another one.
        noise_seed: ``seed`` of :class:`TransientDataset`; the noise of an epoch is its own.
        reading: other arguments of :class:`TransientDataset`.

    Raises:
        StorageError: as :class:`TransientDataset`.
        ArgumentError: for a rank without a world size.
    """

    def __init__(
        self, where: Any, *, shuffle: bool = True, seed: int = 0, buffer: int = 1024, rank: int | None = None,
        world_size: int | None = None, even: bool = False, noise_seed: int | None = None, **reading: Any,
    ) -> None:  # fmt: skip
        self.dataset = TransientDataset(where, **reading, seed=noise_seed)
        self.shuffle, self.even = flag(f"{WHAT}: shuffle", shuffle), flag(f"{WHAT}: even", even)
        self.seed, self.buffer = count(f"{WHAT}: seed", seed, 0, most=None), count(f"{WHAT}: buffer", buffer)
        if (rank is None) != (world_size is None):
            raise ArgumentError(f"{WHAT}: expected rank and world_size both or neither, got {rank} and {world_size}.")
        self._rank = None if rank is None or world_size is None else _checked_rank(rank, world_size)
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
            epoch: from 0 on.
            batches: batches of ``batch_size`` that a loader of this rank has given already, in an epoch that goes on:
                they are left out, and those that follow are the same as without a stop. With as many workers as before.
            batch_size: of the loader.
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
        repeats = self.dataset.repeats
        part, parts = _worker()
        given, turn = self._given(batches, size, parts)
        # Loaders begin with their first worker: it takes the share of the one whose turn it is.
        part = (part + turn) % parts
        for number in self._order(epoch, part, parts)[given[part] :]:
            yield self.dataset.sample(int(number), epoch), int(repeats[number])

    def order(self, epoch: int) -> NDArray[np.int64]:
        """Numbers of the samples that this process, or worker of a DataLoader, reads in an epoch.

        Args:
            epoch: from 0 on.

        Returns:
            int64 (n,).
        """
        return self._order(count(f"{WHAT}: epoch", epoch, 0), *_worker())

    def _order(self, epoch: int, part: int, parts: int) -> NDArray[np.int64]:
        rank, ranks = self._ranks()
        start, stop = _share(self._used(), rank, ranks)
        first, last = _share(stop - start, part, parts)
        found = self._everything(epoch)[start + first : start + last]
        if not self.shuffle:
            return found
        return _buffered(found, self.buffer, np.random.default_rng([self.seed, epoch, 1, rank, part]))

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
        files = self.dataset.shards.numpy()
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


def _checked_rank(rank: int, world_size: int) -> tuple[int, int]:
    size = count(f"{WHAT}: world_size", world_size)
    if count(f"{WHAT}: rank", rank, 0) >= size:
        raise StorageError(f"{WHAT}: expected rank below world_size = {size}, got {rank}.")
    return int(rank), size
