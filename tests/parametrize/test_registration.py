"""What `register`, `original` and `remove` do to any module: chains, buffers, copies, and what they refuse."""

from __future__ import annotations

import copy
import pickle
import threading

import pytest
import torch
from torch import nn
from torch.nn.utils import parametrizations as torchs_own
from torch.nn.utils import parametrize as torch_parametrize

from support.sweeps import together
from torchtransient.errors import SceneError, ShapeError, TorchTransientError
from torchtransient.parametrize import (
    Albedo,
    AxisAnglePose,
    Bounded,
    CopiesParametrized,
    IndexOfRefraction,
    Positive,
    SE3Pose,
    Simplex,
    original,
    register,
    remove,
)

# Kinds, and a value that each can have alone.
KINDS = [
    (Albedo(), (0.625, 0.625)), (Bounded(-6.0, 6.0), (0.625, 0.625)), (Positive(2.0), (2.625, 3.0)),
    (IndexOfRefraction(), (1.5, 1.6)), (Simplex(), (0.25, 0.75)),
]  # fmt: skip


class Weights(nn.Module):
    def __init__(self, value=(0.25, 0.75)):
        super().__init__()
        self.w = nn.Parameter(torch.tensor(value))
        self.register_buffer("known", torch.tensor(value))


@together("first, value", KINDS, repr)
@together("second", [kind for kind, _ in KINDS], repr)
def test_a_second_one_keeps_the_value_or_is_refused(first, second, value):
    module = register(Weights(value), "w", copy.deepcopy(first))
    before, numbers = module.w.detach().clone(), original(module, "w").detach().clone()
    said = ""
    try:
        register(module, "w", copy.deepcopy(second))
    except TorchTransientError as error:
        said = str(error)
    same = type(first) is type(second)
    assert len(module.parametrizations.w) == (1 if said else 2) and bool(said) >= same
    if said:
        assert ("already, remove it first" if same else "cannot keep its value") in said
        assert type(first).__name__ in said and "remove(module, 'w')" in said
        assert torch.equal(original(module, "w"), numbers)
    assert torch.allclose(module.w, before, rtol=1e-5)


def test_some_chains_are_kept():
    """The test above would pass were all refused."""
    module = register(register(Weights(), "w", Bounded(-6.0, 6.0)), "w", Albedo())
    assert torch.allclose(module.w, torch.tensor([0.25, 0.75]))
    register(module, "w", Positive(-0.5))
    assert len(module.parametrizations.w) == 3
    assert torch.allclose(module.w, torch.tensor([0.25, 0.75]))


def test_what_cannot_put_the_value_back():
    module = register(Weights(), "w", Albedo())
    before = original(module, "w").detach().clone()

    class Twice(nn.Module):
        def forward(self, x):
            return torch.cat([x, x])

        def right_inverse(self, value):
            return value

    for second, error, words in (
        (nn.Tanh(), SceneError, r"has Albedo already.*has no right_inverse.*remove\(module, 'w'\)"),
        (Twice(), ShapeError, r"has Albedo already.*makes \(4,\)"),
    ):  # fmt: skip
        with pytest.raises(error, match=words):
            register(module, "w", second)
        assert torch.equal(original(module, "w"), before)


def test_buffers_and_what_is_frozen():
    module = register(Weights(), "known", Albedo())
    assert not isinstance(original(module, "known"), nn.Parameter)
    assert [name for name, _ in module.named_parameters()] == ["w"]
    remove(module, "known")
    assert torch.allclose(dict(module.named_buffers())["known"], torch.tensor([0.25, 0.75]))
    module.w.requires_grad_(False)
    assert not remove(register(module, "w", Albedo()), "w").w.requires_grad


def test_several_tensors_behind_a_value():
    module = torchs_own.weight_norm(nn.Linear(3, 2))
    value = module.weight.detach().clone()
    with pytest.raises(SceneError, match="several tensors behind its value: original0, original1"):
        original(module, "weight")
    register(module, "weight", Bounded(-3.0, 3.0))
    assert torch.allclose(module.weight, value, atol=1e-6)
    remove(module, "weight")
    assert isinstance(module.weight, nn.Parameter) and module.weight.requires_grad
    assert torch.allclose(module.weight, value, atol=1e-6)
    assert not torch_parametrize.is_parametrized(module)


HOW = {
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda module: pickle.loads(pickle.dumps(module)),
    "copy of a deepcopy": lambda module: copy.copy(copy.deepcopy(module)),
}


@pytest.mark.parametrize("how", HOW)
@pytest.mark.parametrize("k", [0, 1])
def test_copies_of_any_module_are_on_their_own(how, k):
    """Either one can take its parametrizations away, and the other keeps them."""
    module = register(register(Weights(), "w", Albedo()), "known", Albedo())
    both = [module, HOW[how](module)]
    assert type(both[0]) is not type(both[1])
    assert (original(both[0], "w") is original(both[1], "w")) == (how == "copy")
    remove(remove(both[k], "w"), "known")
    assert type(both[k]) is Weights
    other = both[1 - k]
    for value in (both[k].w, other.w, other.known, pickle.loads(pickle.dumps(other)).w):
        assert torch.allclose(value, torch.tensor([0.25, 0.75]))
    other.w.sum().backward()
    assert bool((original(other, "w").grad != 0).all())


def test_a_copy_is_parametrized_alone():
    module = register(Weights(), "w", Bounded(-6.0, 6.0))
    twin = copy.copy(module)
    register(twin, "w", Albedo())
    register(twin, "known", Albedo())
    assert len(module.parametrizations.w) == 1 and len(twin.parametrizations.w) == 2
    assert "known" in module._buffers and not torch_parametrize.is_parametrized(module, "known")


class Locked(CopiesParametrized):
    """Holds what cannot be pickled, and says what to do about it."""

    def __init__(self):
        super().__init__()
        self.lock = threading.Lock()
        self.share = nn.Parameter(torch.tensor(0.5))

    def __getstate__(self):
        return {name: value for name, value in self.__dict__.items() if name != "lock"}

    def __setstate__(self, state):
        super().__setstate__(state)
        self.lock = threading.Lock()


@pytest.mark.parametrize("twin_of", [copy.deepcopy, lambda module: pickle.loads(pickle.dumps(module))])
@pytest.mark.parametrize("is_parametrized", [False, True])
def test_a_class_says_what_is_put_away(twin_of, is_parametrized):
    module = Locked()
    if is_parametrized:
        register(module, "share", Albedo())
    twin, same = twin_of(nn.ModuleList([module, module]))
    assert twin is same and twin.lock is not module.lock and twin.lock.acquire(blocking=False)
    assert torch.equal(twin.share, module.share)
    assert torch_parametrize.is_parametrized(twin) == is_parametrized
    with torch.no_grad():
        twin.share = torch.tensor(0.25) if is_parametrized else nn.Parameter(torch.tensor(0.25))
    assert module.share.item() == pytest.approx(0.5) and twin.share.item() == pytest.approx(0.25)


def test_what_is_given_is_kept_without_its_derivative():
    """A setting is a number: bounds and bases that have a gradient of their own get none from here."""
    low, pose = torch.zeros(3, requires_grad=True), torch.eye(4, dtype=torch.float64, requires_grad=True)
    for made in (Bounded(low, low + 1), AxisAnglePose(pose), SE3Pose(pose * 1.0)):
        assert all(not buffer.requires_grad for buffer in made.buffers())
        value = made(torch.zeros(6 if "Pose" in type(made).__name__ else 3, requires_grad=True))
        value.sum().backward()
    assert low.grad is None and pose.grad is None
    with torch.no_grad():
        low += 5
    assert Bounded(low, low + 1).low.tolist() == [5, 5, 5]
