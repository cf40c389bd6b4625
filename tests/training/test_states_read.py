"""States of checkpoints that belong to something else, and what is told before anything is changed."""

from __future__ import annotations

import random

import numpy as np
import pytest
import torch
from torch import nn

import torchtransient as tt
from torchtransient.errors import ArgumentError, GradientError, StorageError, UnitError
from torchtransient.training import checkpoint, load_checkpoint, save_checkpoint
from torchtransient.training.random_states import check_random_state, random_state, set_random_state


def changed(path, part, state):
    content = torch.load(path, weights_only=True)
    content["parts"][part] = state
    torch.save(content, path)


@pytest.mark.parametrize("state", [5, {}, {"device": "cuda", "generators": []}, {"device": "cpu"}])
def test_what_is_no_state_of_a_generator(tmp_path, state):
    path, noise = tmp_path / "run.pt", torch.Generator().manual_seed(1)
    save_checkpoint(path, {"noise": noise}, step=1)
    changed(path, "noise", state)
    before = noise.get_state()
    with pytest.raises(StorageError, match="the part 'noise' is no state of a generator on cpu"):
        load_checkpoint(path, {"noise": noise})
    assert torch.equal(noise.get_state(), before)


@pytest.mark.parametrize("state", [5, {}, {"param_groups": []}, {"param_groups": {}, "state": {}}])
def test_what_is_no_state_of_an_optimizer(tmp_path, state):
    path, model = tmp_path / "run.pt", nn.Linear(2, 3)
    optimizer = torch.optim.Adam(model.parameters())
    save_checkpoint(path, {"adam": optimizer}, step=1)
    changed(path, "adam", state)
    with pytest.raises(StorageError, match="the part 'adam' is no state of an optimiser"):
        load_checkpoint(path, {"adam": optimizer})


def test_random_numbers_are_all_there_or_none_is_put_back():
    random.seed(3)
    np.random.seed(4)  # noqa: NPY002
    torch.manual_seed(5)
    kept = random_state()
    drawn = random.random(), np.random.rand(), torch.rand(2).tolist()  # noqa: NPY002
    set_random_state(kept)
    assert (random.random(), np.random.rand(), torch.rand(2).tolist()) == drawn  # noqa: NPY002
    for wrong in (None, [], {}, {"python": 1, "torch": 2}):
        with pytest.raises(StorageError, match=r"its random numbers lack those of .*numpy"):
            check_random_state(wrong)
    for name, broken in (("python", {"words": 5}), ("numpy", {"key": 3}), ("torch", torch.zeros(3))):
        with pytest.raises(StorageError, match="its random numbers cannot be used: "):
            set_random_state({**kept, name: broken})


def test_what_goes_wrong_in_another_rank_is_told(tmp_path, monkeypatch):
    """Its parts are no state: no file is written, and the rank is named."""
    other = {"random": random_state(), "generators": {}, "failure": "no state"}
    monkeypatch.setattr(checkpoint, "_of_all_ranks", lambda own: [own, other])
    with pytest.raises(StorageError, match=r"run\.pt was not written\. rank 1: no state$"):
        save_checkpoint(tmp_path / "run.pt", {"model": nn.Linear(2, 3)}, step=1)
    assert not list(tmp_path.iterdir())


def test_the_first_rank_tells_the_others(monkeypatch):
    told = []
    monkeypatch.setattr(checkpoint, "_in_group", lambda: True)

    def broadcast(said, src):
        told.append((list(said), src))
        said[0] = "of the first"

    monkeypatch.setattr(checkpoint.dist, "broadcast_object_list", broadcast)
    assert checkpoint._told_by_first(None) == "of the first" and told == [([None], 0)]


def test_parts_that_are_none():
    one = torch.ones((), requires_grad=True)
    for wrong in (5, None, torch.tensor(3.0)):
        with pytest.raises(ArgumentError, match="accumulate: expected parts as a list or any iterable"):
            tt.training.accumulate(lambda part: one, wrong)
    with pytest.raises(ArgumentError, match="accumulate: expected loss_of as a function of a part, got 5"):
        tt.training.accumulate(5, range(2))
    for scaler in (5, object()):
        with pytest.raises(ArgumentError, match=r"accumulate: expected scaler as a torch\.amp\.GradScaler"):
            tt.training.accumulate(lambda part: one, range(2), scaler=scaler)
    with pytest.raises(GradientError, match="depends on nothing"):
        tt.training.accumulate(lambda part: torch.ones(()), range(2))


def test_a_loader_is_of_as_many_samples():
    with pytest.raises(UnitError, match="they are of 3 samples, the data set has 2"):
        tt.training.Batches(3, 1).loader([1.0, 2.0])
    with pytest.raises(ArgumentError, match="expected a data set of samples by number, got 5"):
        tt.training.Batches(3, 1).loader(5)


def test_a_generator_is_of_a_device_that_there_is():
    seeds = tt.training.Seeds(0)
    assert seeds.generator(2, 3, "cpu").initial_seed() == seeds.generator(2, 3, torch.device("cpu")).initial_seed()
    for wrong in ("nowhere", 5.5, [], None.__class__):
        with pytest.raises(tt.errors.DeviceError, match="Seeds: expected a device that torch has here"):
            seeds.generator(2, 3, wrong)
