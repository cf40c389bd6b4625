"""Data sets whose samples go through an :class:`Augment`: by number, and as they come."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

from torch.utils.data import Dataset, IterableDataset

from torchtransient.checks import by_number, count, shown
from torchtransient.data.augmentation.augment import Augment
from torchtransient.data.reading.recipe_dataset import RecipeDataset
from torchtransient.data.reading.sample_draws import Epochs, checked_seed, sample_generator, sample_number
from torchtransient.data.reading.stream import TransientStream
from torchtransient.data.reading.transient_dataset import TransientDataset
from torchtransient.errors import ArgumentError, SceneError


class Augmented(Epochs, Dataset[Any]):
    """A map-style data set, and an :class:`Augment` of each of its samples; of streams see :class:`AugmentedStream`.

    ``seed``: each sample has a generator of its own, so that it comes out the same whoever reads it, in every epoch
    until :meth:`set_epoch`; None draws from torch's, anew each time. Pickles; for workers that were forked or spawned.
    Raises ArgumentError, UnitError for a seed or an epoch below zero, IndexError beyond the samples.
    """

    def __init__(self, dataset: Any, augment: Augment, seed: int | None = None) -> None:
        super().__init__()
        if isinstance(dataset, IterableDataset):
            raise ArgumentError(f"Augmented: {shown(dataset)} is a stream; use AugmentedStream.")
        self.dataset, self.augment = by_number("Augmented", dataset), _checked(augment, "Augmented")
        self.seed = checked_seed("Augmented", seed)

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, number: int) -> Any:
        return self.sample(number, self.epoch)

    def sample(self, number: int, epoch: int | None = None) -> Any:
        """A sample; ``epoch`` tells the maps of one epoch from those of another, and the noise of a data set of this
        library that has a seed of its own; None is 0.
        """
        place = sample_number("Augmented", number, len(self.dataset))
        generator = sample_generator("Augmented", self.seed, place, epoch)
        has_epochs = isinstance(self.dataset, (Augmented, RecipeDataset, TransientDataset))
        found = self.dataset.sample(place, epoch) if has_epochs else self.dataset[place]
        return self.augment(found, generator=generator)


class AugmentedStream(IterableDataset[Any]):
    """The samples of a stream (``TransientStream``, ``OnlineDataset``), and an :class:`Augment` of each of them.

    ``seed``: the map depends on it, on the sample's ``index``, on the stream's ``epoch`` where it has one, and on how
    often the sample came before: among the samples of a TransientStream, or from this iterator; samples without an
    ``index`` are a SceneError then. None draws from torch's generator. What else the stream has (``set_epoch``,
    ``close``, ``made``) is found here, too; a ``with`` block closes it. Raises ArgumentError, UnitError for a seed
    below zero.
    """

    def __init__(self, dataset: Any, augment: Augment, seed: int | None = None) -> None:
        if not isinstance(dataset, IterableDataset):
            raise ArgumentError(f"AugmentedStream: expected a stream, got {shown(dataset)}; use Augmented.")
        self.dataset = dataset
        self.augment, self.seed = _checked(augment, "AugmentedStream"), checked_seed("AugmentedStream", seed)

    def __iter__(self) -> Iterator[Any]:
        epoch = int(getattr(self.dataset, "epoch", 0))
        for sample, repeat in self._repeated():
            generator = None
            if self.seed is not None:
                index = count("AugmentedStream: index", sample["index"], 0)
                generator = sample_generator("AugmentedStream", self.seed, index, epoch, repeat)
            yield self.augment(sample, generator=generator)

    def _repeated(self) -> Iterator[tuple[Any, int]]:
        """Samples, and how often each came before."""
        if isinstance(self.dataset, TransientStream):
            yield from self.dataset.repeated()
            return
        given = Counter[Any]()
        for sample in self.dataset:
            if self.seed is not None and (not isinstance(sample, Mapping) or "index" not in sample):
                raise SceneError("AugmentedStream: expected samples with an 'index' for seed=; leave seed out.")
            index = sample["index"] if self.seed is not None else None
            yield sample, given[index]
            given[index] += 1

    def __enter__(self) -> AugmentedStream:
        return self

    def __exit__(self, *raised: object) -> None:
        """Close the stream, if it can be closed."""
        close = getattr(self.dataset, "close", None)
        if close is not None:
            close()

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name == "dataset":
            raise AttributeError(name)
        return getattr(self.dataset, name)


def _checked(augment: Any, what: str) -> Augment:
    if not isinstance(augment, Augment):
        raise ArgumentError(f"{what}: expected an Augment, got {shown(augment)}.")
    return augment
