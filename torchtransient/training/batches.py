"""Which samples are learnt from at which step: a function of the step, the same for any number of ranks."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch.utils.data import Sampler

from torchtransient.errors import StorageError, UnitError
from torchtransient.quantities import count, flag

_WHAT = "Batches"


class Batches(Sampler[list[int]]):
    """Numbers of the samples of every step, without an end: ``DataLoader(data, batch_sampler=Batches(...))``.

    Samples come in an order that is shuffled anew in every epoch; a batch may begin in one epoch and end in the next,
    so that all batches have one size and no sample is left out. ``batch_size`` is that of all ranks together: at each
    step rank r of n reads the r-th n-th of it. Runs of 1 and of 2 ranks learn from the same samples at the same step.

    The order depends on ``seed``, ``size`` and the number of samples before it alone. :attr:`step` is the position:
    what the next iterator begins with. A loop that counts its steps sets it when it goes on; iterators that prefetch
    do not change it. ::

        batches = tt.training.Batches(len(data), 32, seed=0, rank=ranks.rank, world_size=ranks.size)
        batches.step = first
        for step, batch in zip(range(first, last), DataLoader(data, batch_sampler=batches, num_workers=2)):
            ...

    ``size``: samples of the data set, which is map-style. ``shuffle=False``: in their order. ``step`` may be set at any
    time before an iterator is made. Raises UnitError for numbers that cannot be used, StorageError for a state of
    another order.
    """

    def __init__(
        self, size: int, batch_size: int, *, seed: int = 0, shuffle: bool = True, rank: int = 0, world_size: int = 1,
    ) -> None:  # fmt: skip
        self.size = count(f"{_WHAT}: size", size, 1, UnitError)
        self.batch_size = count(f"{_WHAT}: batch_size", batch_size, 1, UnitError)
        self.seed, self.shuffle = count(f"{_WHAT}: seed", seed, 0, UnitError), flag(f"{_WHAT}: shuffle", shuffle)
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
        self._kept: tuple[int, NDArray[np.int64]] | None = None

    @property
    def step(self) -> int:
        """The step that the next iterator begins with."""
        return self._step

    @step.setter
    def step(self, value: int) -> None:
        self._step = count(f"{_WHAT}: step", value, 0, UnitError)

    def samples(self, step: int) -> list[int]:
        """What this rank reads at a step."""
        number, part = count(f"{_WHAT}: step", step, 0, UnitError), self.batch_size // self.world_size
        first = number * self.batch_size + self.rank * part
        return [self._sample(n) for n in range(first, first + part)]

    def epoch(self, step: int) -> float:
        """How many times the data set has been gone through when a step begins."""
        return step * self.batch_size / self.size

    def __iter__(self) -> Iterator[list[int]]:
        step = self._step
        while True:
            yield self.samples(step)
            step += 1

    def state_dict(self) -> dict[str, Any]:
        """Position and order; the number of ranks is no part of it."""
        return {"step": self._step, **self._order()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Raises StorageError where samples would come in another order than that of the state."""
        order = {name: value for name, value in state.items() if name != "step"}
        if order != self._order() or "step" not in state:
            raise StorageError(
                f"{_WHAT}: expected the order of {order}, these have {self._order()}; another one would repeat some "
                "samples and miss others."
            )
        self.step = state["step"]

    def _order(self) -> dict[str, Any]:
        return {"size": self.size, "batch_size": self.batch_size, "seed": self.seed, "shuffle": self.shuffle}

    def _sample(self, number: int) -> int:
        epoch, place = divmod(number, self.size)
        if not self.shuffle:
            return place
        if self._kept is None or self._kept[0] != epoch:
            self._kept = epoch, np.random.Generator(np.random.Philox([self.seed, epoch])).permutation(self.size)
        return int(self._kept[1][place])
