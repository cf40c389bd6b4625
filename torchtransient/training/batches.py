"""Which samples are learnt from at which step: a function of the step, the same for any number of ranks."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Dataset, IterableDataset, Sampler

from torchtransient.checks import by_number, count, flag, shown
from torchtransient.errors import StorageError, UnitError
from torchtransient.training.processes import worker_init

_WHAT = "Batches"
# What these batches say themselves to a DataLoader.
_OURS = ("batch_size", "batch_sampler", "sampler", "shuffle", "drop_last", "num_workers")


class Batches(Sampler[list[int]]):
    """Numbers of the samples of every step, without an end; :meth:`loader` reads them.

    Samples come in an order that is shuffled anew in every epoch; a batch may begin in one epoch and end in the next,
    so that all batches have one size and no sample is left out. ``batch_size`` is that of all ranks together: at each
    step rank r of n reads the r-th n-th of it. Runs of 1 and of 2 ranks learn from the same samples at the same step.

    The order depends on ``seed``, ``size`` and the number of samples before it alone. :attr:`step` is the position:
    what the next iterator begins with. A loop that counts its steps sets it when it goes on; iterators, which prefetch,
    do not change it. A second iterator, or a state, that would repeat what an iterator has given since the position was
    set is a StorageError: set it, to the same number where that is meant. ::

        batches = tt.training.Batches(len(data), 32, seed=0, rank=ranks.rank, world_size=ranks.size)
        batches.step = first
        for step, batch in zip(range(first, last), batches.loader(data)):
            ...

    ``size``: samples of the data set, which is map-style. ``shuffle=False``: in their order. ``step`` may be set at any
    time before an iterator is made. Raises UnitError for numbers that cannot be used, ArgumentError for what is no data
    set, StorageError for a state of
    another order and a position that was left behind.
    """

    def __init__(
        self, size: int, batch_size: int, *, seed: int = 0, shuffle: bool = True, rank: int = 0, world_size: int = 1,
    ) -> None:  # fmt: skip
        self.size = count(f"{_WHAT}: size", size, 1, UnitError)
        self.batch_size = count(f"{_WHAT}: batch_size", batch_size, 1, UnitError)
        self.seed, self.shuffle = count(f"{_WHAT}: seed", seed, 0, UnitError, None), flag(f"{_WHAT}: shuffle", shuffle)
        self.world_size = count(f"{_WHAT}: world_size", world_size, 1, UnitError)
        self.rank = count(f"{_WHAT}: rank", rank, 0, UnitError)
        if self.rank >= self.world_size:
            raise UnitError(f"{_WHAT}: expected rank below world_size = {self.world_size}, got {self.rank}.")
        if self.batch_size % self.world_size:
            raise UnitError(
                f"{_WHAT}: expected batch_size as a multiple of the {self.world_size} ranks that share it, got "
                f"{self.batch_size}."
            )
        self._step = 0
        # Whether an iterator has given batches since the position was set.
        self._is_left = False
        self._kept: tuple[int, NDArray[np.int64]] | None = None

    @property
    def step(self) -> int:
        """The step that the next iterator begins with."""
        return self._step

    @step.setter
    def step(self, value: int) -> None:
        self._step = count(f"{_WHAT}: step", value, 0, UnitError)
        self._is_left = False

    def places(self, step: int) -> list[int]:
        """Where this rank's samples stand in the batch of all ranks, from 0 on: for ``Seeds`` where the same number may
        come twice in a step (a batch over the end of an epoch, data sets of several folders).
        """
        count(f"{_WHAT}: step", step, 0, UnitError)
        part = self.batch_size // self.world_size
        return list(range(self.rank * part, (self.rank + 1) * part))

    def samples(self, step: int) -> list[int]:
        """What this rank reads at a step."""
        number, part = count(f"{_WHAT}: step", step, 0, UnitError), self.batch_size // self.world_size
        first = number * self.batch_size + self.rank * part
        return [self._sample(n) for n in range(first, first + part)]

    def loader(self, data: Dataset[Any], *, workers: int = 0, renders: bool = False, **options: Any) -> DataLoader[Any]:
        """A DataLoader of these batches, which takes nothing from torch's own generator: an iterator of others draws
        from it, so that a run that is resumed would have other random numbers than one that was not.

        ``workers``: processes that read. ``renders``: whether the data set renders; they are spawned then, and have one
        thread each (:func:`worker_init`). What they draw from their own generators depends on the seed of these
        batches, the rank, and the position at which the loader was made, and begins anew with each iterator: give noise
        a seed of its own, as ``TransientDataset(seed=)`` does. ``options``: others of the DataLoader. Raises UnitError.
        """
        processes = count(f"{_WHAT}: workers", workers, 0, UnitError)
        if isinstance(data, IterableDataset):
            raise UnitError(
                f"{_WHAT}: expected a map-style data set, got {shown(data)}, which has an order of its own; use "
                "DataLoader(stream, batch_size=..., generator=torch.Generator())."
            )
        if not isinstance(data, Dataset):  # one of torch's need not know its length
            by_number(_WHAT, data)
        said = [name for name in options if name in _OURS]
        if said:
            raise UnitError(f"{_WHAT}: {', '.join(said)} of a DataLoader are said by the batches; processes: workers=.")
        size = len(data) if hasattr(data, "__len__") else self.size
        if size != self.size:
            raise UnitError(f"{_WHAT}: they are of {self.size} samples, the data set has {size}.")
        own: dict[str, Any] = {"generator": self._of_workers()}
        if processes and renders:
            own |= {"multiprocessing_context": "spawn", "persistent_workers": True, "worker_init_fn": worker_init}
        return DataLoader(data, batch_sampler=self, num_workers=processes, **{**own, **options})

    def epoch(self, step: int) -> float:
        """How many times the data set has been gone through when a step begins."""
        return count(f"{_WHAT}: step", step, 0, UnitError) * self.batch_size / self.size

    def __iter__(self) -> Iterator[list[int]]:
        self._check_position("an iterator")
        step = self._step
        while True:
            self._is_left = True
            yield self.samples(step)
            step += 1

    def state_dict(self) -> dict[str, Any]:
        """Position and order; the number of ranks is no part of it."""
        self._check_position("a state")
        return {"step": self._step, **self._order()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Raises StorageError where samples would come in another order than that of the state."""
        self.check_state_dict(state)
        self.step = state["step"]

    def check_state_dict(self, state: dict[str, Any]) -> None:
        """Raise what :meth:`load_state_dict` would, and change nothing."""
        if not isinstance(state, dict):
            raise StorageError(f"{_WHAT}: expected a state as of state_dict(), got {shown(state)}.")
        order = {name: value for name, value in state.items() if name != "step"}
        if order != self._order() or "step" not in state:
            raise StorageError(
                f"{_WHAT}: expected the order of {order}, these have {self._order()}; another one would repeat some "
                "samples and miss others."
            )

    def _check_position(self, what: str) -> None:
        if self._is_left:
            raise StorageError(
                f"{_WHAT}: {what} would begin at step {self._step} again, from which an iterator has given batches. "
                "Set batches.step to the step that comes next, or to the same one to repeat it."
            )

    def _of_workers(self) -> torch.Generator:
        """Of the seeds of a loader's processes: others in each rank, and after a run has gone on."""
        key = np.random.SeedSequence([self.seed, self.rank, self._step]).generate_state(1, np.uint64)[0]
        return torch.Generator().manual_seed(int(key >> np.uint64(1)))

    def _order(self) -> dict[str, Any]:
        return {"size": self.size, "batch_size": self.batch_size, "seed": self.seed, "shuffle": self.shuffle}

    def _sample(self, number: int) -> int:
        epoch, place = divmod(number, self.size)
        if not self.shuffle:
            return place
        if self._kept is None or self._kept[0] != epoch:
            self._kept = epoch, np.random.Generator(np.random.Philox([self.seed, epoch])).permutation(self.size)
        return int(self._kept[1][place])
