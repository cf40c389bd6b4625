"""``RecipeDataset``: samples of a recipe by number, the same wherever they are rendered."""

from __future__ import annotations

import itertools
import pickle

import numpy as np
import pytest
import torch

import torchtransient as tt
from tools.small_room import COLOUR, VARIANT, make_room
from torchtransient.errors import ShapeError
from torchtransient.training import Batches


def noisy(light, generator=None):
    return light + torch.randn(light.shape, generator=generator)


class Stored:
    """A recipe whose samples are all alike."""

    def __init__(self, arrays):
        self.arrays = arrays

    def maker(self):
        return self

    def sample(self, index):
        return tt.data.Sample(index, 0, arrays=self.arrays)


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


def test_noise_belongs_to_seed_number_and_epoch():
    alike = Stored({"transient": np.zeros((1, 4, 2, 2), np.float32)})

    def read(seed, epoch=None, first=0):
        data = tt.data.RecipeDataset(alike, 3, first=first, transform=noisy, seed=seed)
        return torch.stack([data.sample(k, epoch)["measurement"] for k in range(3)])

    first = read(4)
    others = [read(5), read(4, 1), read(4, 2), read(None), read(4, first=3)]
    # Without an epoch it is the first; the number is that in the recipe.
    assert torch.equal(first, read(4)) and torch.equal(first, read(4, 0)) and torch.equal(read(4, 2), others[2])
    assert torch.equal(read(4, first=1)[0], first[1])
    drawn = torch.cat([first, *others])
    assert len(drawn[:, 0, 0, 0, 0].unique()) == len(drawn)
    data = tt.data.RecipeDataset(alike, 3, transform=noisy, seed=4)
    state = torch.get_rng_state()
    assert torch.equal(pickle.loads(pickle.dumps(data))[2]["measurement"], first[2])
    assert torch.equal(torch.get_rng_state(), state)


def test_what_it_builds_is_let_go_of():
    """Once, and built again when a sample is read."""
    alike, closed = Stored({"transient": np.zeros((1, 4, 2, 2), np.float32)}), []
    alike.close = lambda: closed.append("closed")
    data = tt.data.RecipeDataset(alike, 3)
    data.close()
    assert closed == [] and data[0]["index"] == 0 and closed == []
    data.close()
    data.close()
    assert closed == ["closed"] and data[2]["index"] == 2


@pytest.mark.slow
def test_rendered_by_spawned_workers_in_the_order_of_steps(recipe):
    def read(workers, first, last):
        batches = Batches(6, 2)
        batches.step = first
        loader = batches.loader(tt.data.RecipeDataset(recipe, 6), workers=workers, renders=True)
        return [(b["index"].tolist(), b["transient"]) for b in itertools.islice(loader, last - first)]

    with tt.threads(1):
        alone = read(0, 0, 5)
    for (index, cube), (other, cube_there) in zip(alone[2:], read(1, 2, 5), strict=True):
        assert index == other and torch.equal(cube, cube_there)


def test_what_it_does_not_take(data, recipe):
    for number in (6, -7, slice(0, 2), 1.7, "1", True):
        with pytest.raises(IndexError, match="from 0 to 5"):
            data[number]
    assert data[np.int64(2)]["index"] == data[torch.tensor(2)]["index"] == 12
    with pytest.raises(ShapeError, match="transform= is for transients"):
        tt.data.RecipeDataset(Stored({"steady": np.zeros((1, 2, 2))}), 1, transform=noisy)[0]
