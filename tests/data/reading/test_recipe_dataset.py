"""``RecipeDataset``: samples of a recipe by number, the same wherever they are rendered."""

from __future__ import annotations

import itertools
import pickle

import pytest
import torch
from torch.utils.data import DataLoader

import torchtransient as tt
from torchtransient.errors import UnitError
from torchtransient.testing.small_room import COLOUR, VARIANT, make_room
from torchtransient.training import Batches, worker_init


@pytest.fixture(scope="module")
def recipe():
    return tt.data.Recipe(make_room(), {COLOUR: tt.data.Uniform([0.1] * 3, [0.9] * 3)}, spp=4, variant=VARIANT)


@pytest.fixture(scope="module")
def data(recipe):
    found = tt.data.RecipeDataset(recipe, 6, first=10, transform=lambda x: x.sum(1))
    yield found
    found.close()


def test_samples_of_the_recipe_by_number(data, recipe):
    expected = recipe.sample(12)
    for _ in range(2):
        sample = data[2]
        assert torch.equal(sample["transient"], torch.from_numpy(expected.arrays["transient"]))
        assert sample["values"][COLOUR].tolist() == expected.values[COLOUR].tolist()
        assert torch.equal(sample["measurement"], sample["transient"].sum(1))
        # Another one in between, from which it must not depend.
        assert data[-1]["index"] == 15
    assert (len(data), sample["index"]) == (6, 12)
    data.close()
    assert torch.equal(data[2]["transient"], sample["transient"])


@pytest.mark.slow
def test_rendered_by_spawned_workers_in_the_order_of_steps(recipe):
    def read(workers, first, last):
        batches = Batches(6, 2)
        batches.step = first
        data = tt.data.RecipeDataset(recipe, 6)
        more = {"multiprocessing_context": "spawn", "worker_init_fn": worker_init} if workers else {}
        loader = DataLoader(data, batch_sampler=batches, num_workers=workers, **more)
        return [(b["index"].tolist(), b["transient"]) for b in itertools.islice(loader, last - first)]

    with tt.threads(1):
        alone = read(0, 0, 5)
    spawned = read(1, 2, 5)
    for (index, cube), (other, cube_there) in zip(alone[2:], spawned, strict=True):
        assert index == other
        assert torch.equal(cube, cube_there)


def test_what_it_does_not_take(data, recipe):
    assert pickle.loads(pickle.dumps(tt.data.RecipeDataset(recipe, 3))).size == 3
    for number in (6, -7, slice(0, 2)):
        with pytest.raises(IndexError, match="from 0 to 5"):
            data[number]
    with pytest.raises(UnitError, match="size"):
        tt.data.RecipeDataset(recipe, 0)
    with pytest.raises(UnitError, match="first"):
        tt.data.RecipeDataset(recipe, 1, first=-1)
