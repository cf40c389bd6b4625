"""Samples of a recipe by number, rendered where and when they are read."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from torchtransient.checks import a_recipe, count
from torchtransient.data.sample import (
    Epochs,
    checked_seed,
    measurement,
    outside_tensor,
    sample_generator,
    sample_number,
    value_tensors,
)
from torchtransient.errors import UnitError

_WHAT = "RecipeDataset"


class RecipeDataset(Epochs, Dataset[dict[str, Any]]):
    """Sample n of a recipe as ``dataset[n]``: a map-style data set that renders.

    A sample is a dictionary like those of :class:`~torchtransient.data.TransientDataset`: its arrays by name,
    ``values`` by key, ``outside`` and ``index`` in the recipe. It depends on recipe and number alone, and the draws of
    a ``transform`` on ``seed``, too: a run that reads it in the order of :class:`torchtransient.training.Batches` can
    be stopped and goes on to the bit, which one with :class:`OnlineDataset` cannot. Each sample is rendered every time
    that it is read; where a step waits for that, use OnlineDataset, or generate the data set.

    ``DataLoader(data, num_workers=2, multiprocessing_context="spawn", persistent_workers=True,
    worker_init_fn=torchtransient.training.worker_init)`` renders beside the training; processes that were forked raise
    VariantError. The recipe is checked first (:meth:`Recipe.check`). The data set pickles, without its scenes.

    Args:
        recipe: :class:`Recipe`, or an object with ``maker()``.
        size: number of samples.
        first: number of the first sample.
        transform: sensor, or function of the transient, without gradients; its result stands under ``measurement``.
        seed: each sample has a generator of its own for the transform (its argument ``generator``), so that it has the
            noise of a stored sample of this index in every process; :meth:`set_epoch` and :meth:`sample` distinguish
            epochs. None draws from torch's, anew each time.

    Raises:
        UnitError: for sizes, seeds and epochs.
        ArgumentError: for other recipes.
        IndexError: beyond the sizes. Errors of the renderer pass.
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
        self.transform = transform
        self.size = count(f"{_WHAT}: size", size, 1, UnitError)
        self.first = count(f"{_WHAT}: first", first, 0, UnitError)
        self.seed = checked_seed(_WHAT, seed)
        self._maker: Any = None
        if (check := getattr(recipe, "check", None)) is not None:
            self._maker = recipe.maker()
            check(self._maker)

    def __len__(self) -> int:
        return self.size

    def sample(self, number: int, epoch: int | None = None) -> dict[str, Any]:
        """Render a sample.

        Args:
            number: number of the sample in the data set, from 0; negative ones count from the end.
            epoch: number of the epoch, which distinguishes the noise of epochs; None is 0.

        Returns:
            Sample.
        """
        index = self.first + sample_number(_WHAT, number, self.size)
        generator = sample_generator(_WHAT, self.seed, index, epoch)
        if self._maker is None:
            self._maker = self.recipe.maker()
        made = self._maker.sample(index)
        found: dict[str, Any] = {name: torch.from_numpy(np.array(array)) for name, array in made.arrays.items()}
        if self.transform is not None:
            found["measurement"] = measurement(_WHAT, self.transform, found, generator)
        values, outside = value_tensors(made.values), outside_tensor(made.outside)
        return {**found, "values": values, "outside": outside, "index": made.index}

    def close(self) -> None:
        """Free the scenes, which are built again when a sample is read."""
        if self._maker is not None:
            self._maker.close()
            self._maker = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_maker": None}
