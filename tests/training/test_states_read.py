"""States of checkpoints that belong to something else, and what is told before anything is changed."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from torchtransient.errors import StorageError
from torchtransient.training import load_checkpoint, save_checkpoint


def changed(path, part, state):
    content = torch.load(path, weights_only=True)
    content["parts"][part] = state
    torch.save(content, path)


@pytest.mark.parametrize(
    ("part", "states"),
    [
        ("a generator on cpu", [5, {}, {"device": "cuda", "generators": []}, {"device": "cpu"}]),
        ("an optimiser", [5, {}, {"param_groups": []}, {"param_groups": {}, "state": {}}]),
    ],
)
def test_what_is_no_state(tmp_path, part, states):
    path, noise = tmp_path / "run.pt", torch.Generator().manual_seed(1)
    one = torch.optim.Adam(nn.Linear(2, 3).parameters()) if part == "an optimiser" else noise
    save_checkpoint(path, {"one": one}, step=1)
    before = noise.get_state()
    for state in states:
        changed(path, "one", state)
        with pytest.raises(StorageError, match=f"the part 'one' is no state of {part}"):
            load_checkpoint(path, {"one": one})
    assert torch.equal(noise.get_state(), before)


class Adam(torch.optim.Adam):
    """Another one of the same name."""


@pytest.mark.parametrize(
    ("there", "here"),
    [("Adam", "Adamax"), ("AdamW", "Adam"), ("Adam", None)],
)
def test_states_of_other_kinds_of_optimizers(tmp_path, there, here):
    """Some have the same settings as the one here, and would go on with its moments as their own."""
    path, model = tmp_path / "run.pt", nn.Linear(2, 3)
    save_checkpoint(path, {"model": model, "one": getattr(torch.optim, there)(model.parameters())}, step=1)
    other = nn.Linear(2, 3)
    optimizer = (Adam if here is None else getattr(torch.optim, here))(other.parameters(), lr=0.5)
    before, weight = optimizer.state_dict(), other.weight.detach().clone()
    words = rf"the state of 'one' is of another kind of optimiser, 'torch\.optim\..*\.{there}'; here is '.*"
    with pytest.raises(StorageError, match=words):
        load_checkpoint(path, {"model": other, "one": optimizer})
    assert optimizer.state_dict() == before and torch.equal(other.weight, weight)


def test_kinds_of_optimizers_move_within_a_package(tmp_path):
    path, optimizer = tmp_path / "run.pt", torch.optim.Adam(nn.Linear(2, 3).parameters())
    save_checkpoint(path, {"one": optimizer}, step=1)
    content = torch.load(path, weights_only=True)
    for kind in ("torch.optim.moved.adam.Adam", "__main__.Adam", None):
        torch.save({**content, "optimizers": {"one": kind}}, path)
        assert load_checkpoint(path, {"one": optimizer}).step == 1
    for kind in ("others.Adam", "torch.optim.sgd.SGD", 5):
        torch.save({**content, "optimizers": {"one": kind}}, path)
        with pytest.raises(StorageError, match="another kind of optimiser"):
            load_checkpoint(path, {"one": optimizer})


def test_states_from_before_there_was_a_schedule(tmp_path):
    """What a schedule keeps in the optimiser is its own: it stays, and the schedule goes on."""
    path, model = tmp_path / "run.pt", nn.Linear(2, 3)
    save_checkpoint(path, {"one": torch.optim.Adam(model.parameters(), lr=0.25)}, step=1)
    optimizer = torch.optim.Adam(model.parameters(), lr=0.5)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, max_lr=1.0, total_steps=9)
    before = optimizer.param_groups[0]["initial_lr"]
    load_checkpoint(path, {"one": optimizer})
    assert optimizer.param_groups[0]["lr"] == 0.25 and optimizer.param_groups[0]["initial_lr"] == before
    optimizer.step()
    schedule.step()
