"""Data sets whose samples go through an :class:`Augment`: by number, and as they come."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset, IterableDataset

from torchtransient.data.augmentation.augment import Augment
from torchtransient.errors import SceneError, UnitError
from torchtransient.quantities import count, shown


class Augmented(Dataset[Any]):
    """A map-style data set, and an :class:`Augment` of each of its samples; of streams see :class:`AugmentedStream`.

    ``seed``: each sample has a generator of its own, so that it comes out the same whoever reads it; None draws from
    torch's, anew each time. :meth:`sample` tells epochs apart. Pickles; for workers that were forked or spawned.
    Raises SceneError.
    """

    def __init__(self, dataset: Any, augment: Augment, seed: int | None = None) -> None:
        if isinstance(dataset, IterableDataset):
            raise SceneError(f"Augmented: {shown(dataset)} is a stream; use AugmentedStream.")
        self.dataset, self.augment, self.seed = dataset, _checked(augment, "Augmented"), _seed(seed, "Augmented")

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, number: int) -> Any:
        return self.sample(number)

    def sample(self, number: int, epoch: int | None = None) -> Any:
        """A sample; ``epoch`` tells the maps of one epoch from those of another."""
        found = self.dataset[number]
        place = number % max(len(self.dataset), 1)
        return self.augment(found, generator=_generator(self.seed, place, *([] if epoch is None else [epoch])))


class AugmentedStream(IterableDataset[Any]):
    """The samples of a stream (``TransientStream``, ``OnlineDataset``), and an :class:`Augment` of each of them.

    ``seed``: the map depends on it, on the sample's ``index``, on the stream's ``epoch`` where it has one, and on how
    often this iterator has given the sample before; samples without an ``index`` are a SceneError then. None draws from
    torch's generator. What else the stream has (``set_epoch``, ``close``, ``made``) is found here, too.
    """

    def __init__(self, dataset: Any, augment: Augment, seed: int | None = None) -> None:
        if not isinstance(dataset, IterableDataset):
            raise SceneError(f"AugmentedStream: expected a stream, got {shown(dataset)}; use Augmented.")
        self.dataset = dataset
        self.augment, self.seed = _checked(augment, "AugmentedStream"), _seed(seed, "AugmentedStream")

    def __iter__(self) -> Iterator[Any]:
        epoch, given = int(getattr(self.dataset, "epoch", 0)), Counter[int]()
        for sample in self.dataset:
            generator = None
            if self.seed is not None:
                if not isinstance(sample, Mapping) or "index" not in sample:
                    raise SceneError("AugmentedStream: expected samples with an 'index' for seed=; leave seed out.")
                index = int(sample["index"])
                generator = _generator(self.seed, index, epoch, given[index])
                given[index] += 1
            yield self.augment(sample, generator=generator)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name == "dataset":
            raise AttributeError(name)
        return getattr(self.dataset, name)


def _checked(augment: Any, what: str) -> Augment:
    if not isinstance(augment, Augment):
        raise SceneError(f"{what}: expected an Augment, got {shown(augment)}.")
    return augment


def _seed(seed: Any, what: str) -> int | None:
    return None if seed is None else count(f"{what}: seed", seed, 0, UnitError)


def _generator(seed: int | None, *places: int) -> torch.Generator | None:
    if seed is None:
        return None
    key = np.random.SeedSequence([seed, *places])
    return torch.Generator().manual_seed(int(key.generate_state(1, np.uint64)[0] >> np.uint64(1)))
