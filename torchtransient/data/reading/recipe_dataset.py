"""Samples of a recipe by number, rendered where and when they are read: nothing is stored, and nothing is lost."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from torchtransient.checks import a_recipe, count, shown
from torchtransient.data.reading.sample_draws import (
    Epochs,
    checked_seed,
    checked_transform,
    outside_tensor,
    sample_generator,
    sample_number,
    takes_generator,
    transformed,
)
from torchtransient.errors import ArgumentError, ShapeError, UnitError

_WHAT = "RecipeDataset"


class RecipeDataset(Epochs, Dataset[dict[str, Any]]):
    """Sample n of a recipe as ``dataset[n]``: a map-style data set that renders, of ``size`` samples from ``first`` on.

    A sample is a dictionary as of :class:`~torchtransient.data.reading.transient_dataset.TransientDataset`: its
    arrays by name, ``values`` by key, ``outside`` and ``index`` in the recipe. It depends on recipe and number alone,
    and what a ``transform`` draws on ``seed``, too: a run that reads it in the order of
    :class:`torchtransient.training.Batches` can be stopped and goes on to the bit, which one with
    :class:`OnlineDataset`, whose order depends on how fast samples are made, cannot. Each sample is rendered every
    time that it is read; where that is what a step waits for, use OnlineDataset, or generate the data set.

    ``DataLoader(data, num_workers=2, multiprocessing_context="spawn", persistent_workers=True,
    worker_init_fn=torchtransient.training.worker_init)`` renders beside the training; processes that were forked raise
    VariantError. ``transform``: a sensor, or any function of the transient, without gradients; its result stands under
    ``measurement``. ``seed``: each sample has a generator of its own for the transform (its argument ``generator``), so
    that it has the same noise whoever reads it, that of a stored sample of this index; :meth:`set_epoch` and
    :meth:`sample` tell epochs apart. None draws from torch's, anew each time.

    The recipe is checked first (:meth:`Recipe.check`), unless it was before. It pickles, without what it has built.
    ``close()`` lets go of that; it is built again when a sample is read. Raises UnitError for sizes, seeds and epochs,
    ArgumentError for what is no recipe, no function, and a seed that the transform cannot take, IndexError beyond the
    sizes, and what the render of a sample raises.
    """

    def __init__(
        self,
        recipe: Any,
        size: int,
        *,
        first: int = 0,
        transform: Callable[..., Any] | None = None,
        seed: int | None = None,
    ) -> None:
        super().__init__()
        self.recipe = a_recipe(_WHAT, recipe, "maker")
        self.transform = checked_transform(_WHAT, transform)
        self.size = count(f"{_WHAT}: size", size, 1, UnitError)
        self.first = count(f"{_WHAT}: first", first, 0, UnitError)
        self.seed = checked_seed(_WHAT, seed)
        if seed is not None and not takes_generator(transform):
            raise ArgumentError(
                f"{_WHAT}: seed= is for a transform that takes generator=, as sensors do, got {shown(transform)}."
            )
        self._maker: Any = None
        if (check := getattr(recipe, "check", None)) is not None:
            self._maker = recipe.maker()
            check(self._maker)

    def __len__(self) -> int:
        return self.size

    def __getitem__(self, number: int) -> dict[str, Any]:
        return self.sample(number, self.epoch)

    def sample(self, number: int, epoch: int | None = None) -> dict[str, Any]:
        """A sample; ``epoch`` tells the noise of ``seed`` of one epoch from that of another; None is 0."""
        index = self.first + sample_number(_WHAT, number, self.size)
        generator = sample_generator(_WHAT, self.seed, index, epoch)
        if self._maker is None:
            self._maker = self.recipe.maker()
        made = self._maker.sample(index)
        found: dict[str, Any] = {name: torch.from_numpy(np.array(array)) for name, array in made.arrays.items()}
        if self.transform is not None:
            if "transient" not in found:
                raise ShapeError(f"{_WHAT}: transform= is for transients, and samples have {', '.join(found)}.")
            found["measurement"] = transformed(self.transform, found["transient"], generator)
        values = made.values.items()
        found["values"] = {key: v if isinstance(v, str) else torch.from_numpy(np.array(v)) for key, v in values}
        found |= {"outside": outside_tensor(made.outside), "index": made.index}
        return found

    def close(self) -> None:
        """Let go of the scenes that were built."""
        if self._maker is not None:
            self._maker.close()
            self._maker = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_maker": None}
