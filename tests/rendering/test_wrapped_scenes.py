"""``tt.wrap`` puts back every scene that a function reaches, in whichever way, and replays it as it was at the call."""

from __future__ import annotations

import collections
import functools
import types

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from tools.small_room import VARIANT as VARIANT
from torchtransient.errors import GradientError

KEY = "data"


@pytest.fixture
def scene():
    """A picture is the smallest scene."""
    return mi.load_dict({"type": "bitmap", "bitmap": mi.Bitmap(np.full((2, 2, 3), 0.5, np.float32)), "raw": True})


def write(params, x):
    """The new values times the old ones: a derivative sees what the scene held at the call."""
    before = mi.TensorXf(params[KEY])
    params[KEY] = mi.TensorXf(x)
    params.update()
    return params[KEY] * before


class Holder:
    def __init__(self, params):
        self.params = params

    def __call__(self, x):
        return write(self.params, x)

    def again(self, x):
        return self(x)


class Slots:
    """An object without a dictionary, and with names that Python changes."""

    __slots__ = ("__params", "unused")

    def __init__(self, params):
        self.__params = params

    @property
    def params(self):
        return self.__params

    def __call__(self, x):
        return write(self.params, x)


def ways(scene, params):
    """Functions that reach a scene, by how they do."""
    holder, module = Holder(params), types.ModuleType("setup_of_mine")
    keeper, deep = type("Keeper", (), {"params": params}), {"a": [params]}
    module.params, place = params, types.SimpleNamespace(scene=scene)

    def helper(x):
        return write(params, x)

    def defined_inside(x):
        def inner():
            return write(module.params, x)

        return inner()

    def decorated(function):
        @functools.wraps(function)
        def other(x):
            return function(x)

        return other

    class Computed:
        @functools.cached_property
        def once(self):
            return (params,)

    computed, row = Computed(), collections.deque([params])
    return {
        "slots": Slots(params),
        "a property that is kept": lambda x: write(computed.once[0], x),
        "a deque": lambda x: write(row[0], x),
        "a function that it calls": lambda x: helper(x),
        "a method of an object": lambda x: holder.again(x),
        "an attribute of a class": lambda x: write(keeper.params, x),
        "an attribute of a module": defined_inside,
        "entries of entries": lambda x: write(deep["a"][0], x),
        "a default by name": lambda x, *, params=params: write(params, x),
        "a bound argument": functools.partial(write, params),
        "a decorated function": decorated(helper),
        "a function that it traverses": lambda x: write(mi.traverse(scene), x),
        "an object that holds a scene": lambda x: write(mi.traverse(place.scene), x),
    }


WAYS = tuple(ways(None, None))


@pytest.mark.parametrize("way", WAYS)
def test_every_way_to_a_scene(scene, way):
    params = mi.traverse(scene)
    wrapped = tt.wrap(ways(scene, params)[way])
    x = torch.full((2, 2, 3), 2.0, requires_grad=True)
    out = wrapped(x)
    assert np.all(np.array(params[KEY]) == 0.5), "left behind by the call"
    params[KEY] = mi.TensorXf(np.full((2, 2, 3), 7.0, np.float32))
    params.update()
    out.sum().backward()
    assert torch.equal(x.grad, torch.full((2, 2, 3), 0.5)), "a derivative in another scene than that of the call"
    assert np.all(np.array(params[KEY]) == 7.0) and not dr.grad_enabled(params[KEY]), "left behind by the derivative"


def held(value, levels):
    for _ in range(levels):
        value = [value]
    return value


# ----------------------------------------------------------------------------------------- gradients that would be lost


def test_gradients_that_helpers_would_swallow_are_refused():
    weight = torch.ones(2, requires_grad=True)

    def helper(x):
        return x * mi.TensorXf(weight)

    all_of_them = [helper]
    for calls in (lambda x: helper(x), lambda x: (all_of_them, helper(x))[1], functools.partial(helper)):
        with pytest.raises(GradientError, match="variable 'weight', which is no argument"):
            tt.wrap(calls)(torch.ones(2))

    def scaled(x, factor, *, by=weight):
        return x * factor

    with pytest.raises(GradientError, match="variable 'by', which is no argument"):
        tt.wrap(scaled)(torch.ones(2), 2.0)
    with pytest.raises(GradientError, match="variable 'argument 0', which is no argument"):
        tt.wrap(functools.partial(lambda factor, x: x, weight))(torch.ones(2))


def test_a_scene_that_is_attached_and_not_found_is_refused(scene):
    """A step of ``mi.ad.Adam`` attaches scenes; in a place too deep to be found the derivative would be lost."""
    params = mi.traverse(scene)
    attached = mi.TensorXf(params[KEY])
    dr.enable_grad(attached)
    params[KEY] = attached
    params.update()
    hidden = held(params, 6)

    def read(x):
        found = hidden
        while isinstance(found, list):
            found = found[0]
        return found[KEY] * x

    x = torch.ones((2, 2, 3), requires_grad=True)
    with pytest.raises(GradientError, match=r"tt\.wrap\(\.\.\., state=params\)"):
        tt.wrap(read)(x)
    tt.wrap(read, state=params)(x).sum().backward()
    assert torch.equal(x.grad, torch.full((2, 2, 3), 0.5))
