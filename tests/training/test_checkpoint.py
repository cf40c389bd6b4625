"""Checkpoints: a run that goes on is the run that was not stopped; what is no checkpoint is refused unexecuted."""

from __future__ import annotations

import os
import random
from collections import defaultdict

import numpy as np
import pytest
import torch
from torch import nn

import torchtransient as tt
from tools.small_room import COLOUR, VARIANT, make_room
from torchtransient.errors import ArgumentError, ShapeError, StorageError, TorchTransientWarning, UnitError
from torchtransient.training import Batches, Seeds, checkpoint, load_checkpoint, save_checkpoint


@pytest.fixture(scope="module")
def scene():
    return tt.load(make_room(), variant=VARIANT)


class Run:
    """A network before the renderer and parameters in it, with whatever keeps a state."""

    def __init__(self, scene):
        torch.manual_seed(0)
        renderer = tt.TransientRenderer(scene, parameters=[COLOUR, "light.intensity.value"], spp=4)
        network = nn.Sequential(nn.Linear(6, 8), nn.BatchNorm1d(8), nn.Dropout(0.5), nn.Linear(8, 3))
        self.model = nn.ModuleDict({"network": network, "renderer": renderer})
        self.optimizer = torch.optim.AdamW(self.model.parameters(), lr=1e-2)
        self.schedule = torch.optim.lr_scheduler.OneCycleLR(self.optimizer, 1e-2, total_steps=50)
        self.scaler = torch.amp.GradScaler("cpu", init_scale=8.0, growth_interval=2)
        self.noise = torch.Generator().manual_seed(5)
        self.batches, self.seeds = Batches(12, 4), Seeds(0)
        self.parts = {
            name: getattr(self, name) for name in ("model", "optimizer", "schedule", "scaler", "noise", "batches")
        }

    def go(self, first, last):
        for step in range(first, last):
            samples = self.batches.samples(step)
            given = torch.randn(4, 6, generator=self.noise) + random.random() + np.random.rand()  # noqa: NPY002
            colour = torch.sigmoid(self.model["network"](given))
            out = self.model["renderer"]({COLOUR: colour}, seed=self.seeds(step, samples))
            self.optimizer.zero_grad()
            self.scaler.scale(out.transient.square().mean()).backward()
            self.scaler.step(self.optimizer)
            self.scaler.update()
            self.schedule.step()
            self.batches.step = step + 1


def seed_all():
    random.seed(1)
    np.random.seed(1)  # noqa: NPY002
    torch.manual_seed(1)


def assert_same(first, second):
    for one, other in zip(first.parameters(), second.parameters(), strict=True):
        assert torch.equal(one, other)
    for one, other in zip(first.buffers(), second.buffers(), strict=True):
        assert torch.equal(one, other)


def test_goes_on_to_the_bit(tmp_path, scene):
    with tt.threads(1):
        whole = Run(scene)
        seed_all()
        whole.go(0, 4)
        stopped = Run(scene)
        seed_all()
        stopped.go(0, 2)
        save_checkpoint(tmp_path / "run.pt", stopped.parts, step=2, values={"losses": [1.0, np.float64(2.0)]})
        # Elsewhere: other random numbers, and a scene of its own that has rendered nothing.
        resumed = Run(tt.load(make_room(), variant=VARIANT))
        random.seed(77)
        np.random.seed(77)  # noqa: NPY002
        torch.manual_seed(77)
        found = load_checkpoint(tmp_path / "run.pt", resumed.parts)
        assert (found.step, found.values, found.ranks) == (2, {"losses": [1.0, 2.0]}, 1)
        assert found.libraries["torch"] == torch.__version__
        resumed.go(found.step, 4)
    assert_same(whole.model, resumed.model)
    assert whole.scaler.get_scale() == resumed.scaler.get_scale() > 8
    assert whole.schedule.get_last_lr() == resumed.schedule.get_last_lr()
    # Without the random numbers it is another run, so that the test can fail.
    other = Run(scene)
    load_checkpoint(tmp_path / "run.pt", other.parts, random=False)
    other.go(2, 4)
    assert not torch.equal(other.model["network"][0].weight, whole.model["network"][0].weight)


def tiny(parameter=1.0):
    model = nn.Linear(2, 1)
    nn.init.constant_(model.weight, parameter)
    return model


def test_written_whole_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "run.pt"
    save_checkpoint(path, {"model": tiny(1.0)}, step=1)

    def interrupted(*arguments):
        raise OSError("no space left on device")

    for name in ("fsync", "replace"):
        with monkeypatch.context() as patch:
            patch.setattr(os, name, interrupted)
            with pytest.raises(StorageError, match=r"cannot be written: .*no space left"):
                save_checkpoint(path, {"model": tiny(2.0)}, step=2)
        model = tiny(0.0)
        assert load_checkpoint(path, {"model": model}).step == 1
        assert model.weight[0, 0] == 1.0
    save_checkpoint(path, {"model": tiny(2.0)}, step=2)
    assert load_checkpoint(path, {"model": tiny()}).step == 2
    with pytest.raises(StorageError, match=r"cannot be written: .*the folder '.*nowhere' does not exist"):
        save_checkpoint(tmp_path / "nowhere" / "run.pt", {}, step=0)


def test_torn_and_damaged_files(tmp_path):
    path = tmp_path / "run.pt"
    save_checkpoint(path, {"model": tiny(1.0)}, step=1)
    written = path.read_bytes()
    for size in (0, 1, len(written) // 2, len(written) - 1):
        path.write_bytes(written[:size])
        with pytest.raises(StorageError, match="torn, or no checkpoint"):
            load_checkpoint(path, {"model": tiny()})
    # One bit of a weight: the file can be opened, its sum is wrong.
    place = written.index(np.array([1.0, 1.0], dtype=np.float32).tobytes())
    path.write_bytes(written[:place] + bytes([written[place] ^ 1]) + written[place + 1 :])
    model = tiny(3.0)
    with pytest.raises(StorageError, match="is damaged: the sum of"):
        load_checkpoint(path, {"model": model})
    assert model.weight[0, 0] == 3.0
    with pytest.raises(StorageError, match="is not there"):
        load_checkpoint(tmp_path / "other.pt", {})


class _Harmful:
    """What a pickle of strangers may do."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def test_files_of_others_are_not_executed(tmp_path):
    path, victim = tmp_path / "run.pt", tmp_path / "victim"
    torch.save({"format": "torchtransient checkpoint", "version": 1, "step": _Harmful(victim)}, path)
    with pytest.raises(StorageError, match="would have to be executed"):
        load_checkpoint(path, {})
    assert not victim.exists()
    torch.save({"weights": torch.ones(2)}, path)
    with pytest.raises(StorageError, match="no checkpoint of save_checkpoint"):
        load_checkpoint(path, {})
    for content, message in (({"version": 2}, "version 2, expected 1"), ({"version": 1}, "lacks step, parts")):
        torch.save({"format": "torchtransient checkpoint", **content}, path)
        with pytest.raises(StorageError, match=message):
            load_checkpoint(path, {})


def test_of_other_numbers_of_ranks(tmp_path, monkeypatch):
    path, model, noise = tmp_path / "run.pt", tiny(3.0), torch.Generator().manual_seed(1)
    save_checkpoint(path, {"model": tiny(1.0)}, step=1)
    save_checkpoint(tmp_path / "noise.pt", {"noise": noise}, step=1)
    expected = torch.rand(1, generator=noise)
    load_checkpoint(tmp_path / "noise.pt", {"noise": noise})
    assert torch.equal(torch.rand(1, generator=noise), expected)
    monkeypatch.setattr(checkpoint, "_size", lambda: 2)
    with pytest.raises(StorageError, match="random numbers of 1 ranks, expected those of 2"):
        load_checkpoint(path, {"model": model})
    assert model.weight[0, 0] == 3.0
    assert load_checkpoint(path, {"model": model}, random=False).step == 1
    assert model.weight[0, 0] == 1.0
    with pytest.raises(StorageError, match="a generator of each of 1 ranks, expected 2"):
        load_checkpoint(tmp_path / "noise.pt", {"noise": noise}, random=False)


def test_other_libraries_are_told(tmp_path, monkeypatch):
    path = tmp_path / "run.pt"
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "_libraries", lambda: {"torch": "1.0"})
        save_checkpoint(path, {}, step=1)
    with pytest.warns(TorchTransientWarning, match=r"torch 1\.0 \(here 2.*not to the bit"):
        load_checkpoint(path, {})


class _Kept:
    """A part whose state is as given."""

    def __init__(self, state):
        self.state = state

    def state_dict(self):
        return self.state

    def load_state_dict(self, state):
        self.state = state


def test_states_are_data(tmp_path):
    path = tmp_path / "run.pt"
    state = {
        "number": np.float32(0.5), "array": np.arange(3), "several": (1, [2.0, None, "x"]), 3: {True, False},
        "of": defaultdict(int, a=1), "place": torch.device("cpu"), "parameter": nn.Parameter(torch.ones(2)),
    }  # fmt: skip
    save_checkpoint(path, {"kept": _Kept(state)}, step=0)
    kept = _Kept(None)
    load_checkpoint(path, {"kept": kept})
    assert kept.state["number"] == 0.5 and type(kept.state["number"]) is float
    assert kept.state["array"].tolist() == [0, 1, 2]
    assert (kept.state["several"], kept.state["of"], kept.state[3]) == ((1, [2.0, None, "x"]), {"a": 1}, {True, False})
    for state, place in (({"a": [1, print]}, r"kept\['a'\]\[1\] is a builtin"), ({object(): 1}, "a key of kept")):
        with pytest.raises(StorageError, match=place):
            save_checkpoint(path, {"kept": _Kept(state)}, step=0)
    with pytest.raises(ArgumentError, match="Plain data belong into values"):
        save_checkpoint(path, {"x": 3}, step=0)
    with pytest.raises(UnitError, match="step"):
        save_checkpoint(path, {}, step=-1)
    # None of these has touched the file.
    assert load_checkpoint(path, {"kept": kept}).step == 0


def test_what_one_part_refuses_changes_no_other(tmp_path):
    """Also what torch would take, and fail with at the next step; the random numbers stay, too."""
    path, donor = tmp_path / "run.pt", tiny(1.0)
    adam = torch.optim.Adam(donor.parameters(), lr=0.1)
    donor(torch.ones(1, 2)).sum().backward()
    adam.step()
    weight = float(donor.weight[0, 0].detach())
    parts = {"model": donor, "other": adam, "batches": Batches(10, 4), "noise": torch.Generator()}
    save_checkpoint(path, parts, step=1)
    model, noise = tiny(3.0), torch.Generator()
    right = {
        "model": model, "other": torch.optim.Adam(model.parameters()), "batches": Batches(10, 4), "noise": noise,
    }  # fmt: skip
    wide, split = nn.Linear(3, 1), [{"params": [model.weight]}, {"params": [model.bias]}]
    for changes, error, message in (
        ({"model": nn.Linear(2, 1, bias=False)}, StorageError, "lacks nothing and has bias beyond"),
        ({"model": nn.Sequential(model)}, StorageError, "lacks 0.bias, 0.weight and has bias, weight"),
        ({"model": wide}, ShapeError, r"expected shape \(1, 3\), the file has \(1, 2\)"),
        ({"model": noise, "noise": model}, StorageError, "no state of a generator|of another module"),
        ({"batches": Batches(10, 5)}, StorageError, "repeat some samples"),
        ({"other": torch.optim.SGD(model.parameters())}, StorageError, "kind of optimiser, .*Adam'; here is .*SGD'"),
        ({"other": torch.optim.Adam(wide.parameters())}, ShapeError, r"expected shape \(1, 3\), the file has \(1, 2\)"),
        ({"other": torch.optim.Adam(split)}, StorageError, r"groups of \[2\] parameters in the file, here of \[1, 1\]"),
    ):
        state = torch.get_rng_state()
        with pytest.raises(error, match=message):
            load_checkpoint(path, right | changes)
        assert model.weight[0, 0] == 3.0 and torch.equal(torch.get_rng_state(), state)
    with pytest.raises(StorageError, match="has the parts model, other, batches, noise, expected model"):
        load_checkpoint(path, {"model": model})
    load_checkpoint(path, right)
    assert float(model.weight[0, 0].detach()) == weight and right["other"].state_dict()["state"].keys() == {0, 1}


class Remembers(nn.Module):
    """A module with a state beside its tensors."""

    def __init__(self, said):
        super().__init__()
        self.weight, self.said = nn.Parameter(torch.ones(2)), said

    def get_extra_state(self):
        return {"said": self.said}

    def set_extra_state(self, state):
        self.said = state["said"]


class _Converted(nn.Linear):
    """Its weights of version 1 were transposed."""

    _version = 2

    def __init__(self):
        super().__init__(2, 2, bias=False)

    def _load_from_state_dict(self, state_dict, prefix, local_metadata, *others):
        if local_metadata.get("version", 1) < 2:
            state_dict[prefix + "weight"] = state_dict[prefix + "weight"].T
        super()._load_from_state_dict(state_dict, prefix, local_metadata, *others)


def test_states_beside_tensors(tmp_path):
    """Extra states, versions of modules, shapes of lazy and names of compiled ones come along."""
    path, module, other = tmp_path / "run.pt", _Converted(), _Converted()
    parts = {"converted": nn.Sequential(module), "extra": Remembers("before"), "lazy": nn.Linear(3, 2)}
    save_checkpoint(path, {**parts, "compiled": torch.compile(tiny(1.0))}, step=0)
    extra, lazy, plain = Remembers("after"), nn.LazyLinear(2), tiny(3.0)
    load_checkpoint(path, {"converted": nn.Sequential(other), "extra": extra, "lazy": lazy, "compiled": plain})
    assert torch.equal(other.weight, module.weight) and extra.said == "before"
    assert lazy.weight.shape == (2, 3) and plain.weight[0, 0] == 1.0


def test_what_cannot_be_written_or_read(tmp_path):
    path = tmp_path / "run.pt"
    with pytest.raises(StorageError, match="is a folder"):
        save_checkpoint(tmp_path, {}, step=0)
    save_checkpoint(path, {"m": tiny(1.0).double()}, step=0)
    with pytest.raises(ShapeError, match=r"expected torch\.float32, the file has torch\.float64"):
        load_checkpoint(path, {"m": tiny()})


# ---------------------------------------------------------------------------------------- states of something else


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


@pytest.mark.parametrize(
    ("there", "here"),
    [("Adam", "Adamax"), ("AdamW", "Adam")],
)
def test_states_of_other_kinds_of_optimizers(tmp_path, there, here):
    """Some have the same settings as the one here, and would go on with its moments as their own."""
    path, model = tmp_path / "run.pt", nn.Linear(2, 3)
    save_checkpoint(path, {"model": model, "one": getattr(torch.optim, there)(model.parameters())}, step=1)
    other = nn.Linear(2, 3)
    optimizer = getattr(torch.optim, here)(other.parameters(), lr=0.5)
    before, weight = optimizer.state_dict(), other.weight.detach().clone()
    words = rf"the state of 'one' is of another kind of optimiser, '[\w.]+\.{there}'; here is '[\w.]+\.{here}'"
    with pytest.raises(StorageError, match=words):
        load_checkpoint(path, {"model": other, "one": optimizer})
    assert optimizer.state_dict() == before and torch.equal(other.weight, weight)


def test_kinds_of_optimizers_with_their_modules(tmp_path):
    """Modules of torch move; a class of one's own that is called as torch's has other settings."""
    path, optimizer = tmp_path / "run.pt", torch.optim.Adam(nn.Linear(2, 3).parameters())
    save_checkpoint(path, {"one": optimizer}, step=1)
    content = torch.load(path, weights_only=True)
    for kind in ("torch.optim.adam.Adam", "torch.optim.moved.Adam", None):
        torch.save({**content, "optimizers": {"one": kind}}, path)
        assert load_checkpoint(path, {"one": optimizer}).step == 1
    for kind in ("torch.optim.sgd.SGD", "__main__.Adam", 5):
        torch.save({**content, "optimizers": {"one": kind}}, path)
        with pytest.raises(StorageError, match="another kind of optimiser"):
            load_checkpoint(path, {"one": optimizer})
