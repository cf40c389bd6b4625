"""Copies of modules that say themselves what is put away, with and without parametrizations."""

from __future__ import annotations

import copy
import pickle
import threading

import pytest
import torch
from torch import nn
from torch.nn.utils import parametrize as torch_parametrize

from torchtransient.parametrize import Albedo, AxisAnglePose, Bounded, CopiesParametrized, SE3Pose, register


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
    twin = twin_of(module)
    assert twin.lock is not module.lock and twin.lock.acquire(blocking=False)
    assert torch.equal(twin.share, module.share)
    assert torch_parametrize.is_parametrized(twin) == is_parametrized
    with torch.no_grad():
        twin.share = torch.tensor(0.25) if is_parametrized else nn.Parameter(torch.tensor(0.25))
    assert module.share.item() == pytest.approx(0.5) and twin.share.item() == pytest.approx(0.25)


def test_deep_copies_keep_what_is_shared():
    module = Locked()
    pair = nn.ModuleList([module, module])
    register(module, "share", Albedo())
    twins = copy.deepcopy(pair)
    assert twins[0] is twins[1] and twins[0] is not module


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
