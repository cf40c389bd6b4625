"""``tt.wrap`` puts back every scene that a function reaches, in whichever way, and replays it as it was at the call."""

from __future__ import annotations

import collections
import contextvars
import functools
import threading
import types
import weakref
from typing import ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from tools.small_room import VARIANT as VARIANT
from torchtransient.errors import GradientError
from torchtransient.rendering.reached import Reached

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


class Weak:
    """An object that another one knows without keeping it."""

    kept: ClassVar = []

    def __init__(self, params):
        self.params = params
        self.kept.append(self)


def ways(scene, params):
    """Functions that reach a scene, by how they do."""
    holder, module = Holder(params), types.ModuleType("setup_of_mine")
    nested, keeper, deep = types.SimpleNamespace(inside=holder), type("Keeper", (), {"params": params}), {"a": [params]}
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

    given = params

    class Computed:
        shared = given

        @property
        def params(self):
            return params

        @functools.cached_property
        def once(self):
            return (params,)

        @staticmethod
        def alone(x):
            return write(params, x)

        @classmethod
        def of_class(cls, x):
            return write(cls.shared, x)

    computed, weak, local = Computed(), weakref.ref(Weak(params)), threading.local()
    local.params, context = params, contextvars.ContextVar("params")
    context.set(params)
    row, view = collections.deque([params]), types.MappingProxyType({"params": params})
    return {
        "slots": Slots(params),
        "a property": lambda x: write(computed.params, x),
        "a property that is kept": lambda x: write(computed.once[0], x),
        "an attribute of the object's class": lambda x: write(computed.shared, x),
        "a static method": lambda x: computed.alone(x),
        "a method of the class": lambda x: computed.of_class(x),
        "a weak reference": lambda x: write(weak().params, x),
        "what is the thread's own": lambda x: write(local.params, x),
        "what is the context's own": lambda x: write(context.get(), x),
        "a deque": lambda x: write(row[0], x),
        "a view of a dictionary": lambda x: write(view["params"], x),
        "a function that it calls": lambda x: helper(x),
        "a function that a function calls": lambda x: (lambda y: helper(y))(x),
        "an object that is called": holder,
        "an object that it calls": lambda x: holder(x),
        "a method of an object": lambda x: holder.again(x),
        "an object of an object": lambda x: nested.inside(x),
        "an attribute of a class": lambda x: write(keeper.params, x),
        "an attribute of a module": defined_inside,
        "entries of entries": lambda x: write(deep["a"][0], x),
        "a default": lambda x, params=params: write(params, x),
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


def test_parameters_are_not_looked_for_twice(scene, monkeypatch):
    """Where a function names parameters of a scene beside it, the scene is not traversed."""
    params = mi.traverse(scene)
    params.keep([KEY])
    reached = Reached(lambda: (scene, params, [params]))
    assert reached.parameters == [params] and reached.objects == [scene]
    wrapped, alone = tt.wrap(lambda x: x * len((scene, params))), tt.wrap(lambda x: x * len((scene,)))
    traversed = []
    monkeypatch.setattr(mi, "traverse", lambda node, traverse=mi.traverse: traversed.append(node) or traverse(node))
    assert torch.equal(wrapped(torch.ones(2)), torch.full((2,), 2.0)) and not traversed
    for _ in range(2):
        assert torch.equal(alone(torch.ones(2)), torch.ones(2))
    assert traversed == [scene], "once for all calls"


def test_what_is_not_followed():
    """Code of libraries, entries of long lists that are no objects of Mitsuba, and scenes of this library."""
    own = tt.load({"type": "scene"})
    long = [[mi.Float(1)] for _ in range(2000)]
    reached = Reached(lambda: (np.mean, torch.relu, mi.render, dr.sum, own, long))
    assert not reached.parameters and not reached.objects
    assert {name for name, _ in reached.named} == {"np", "torch", "mi", "dr", "own", "long"}


def test_circles_end():
    a, b, module = [], [], types.ModuleType("ring")
    a.append(b), b.append(a)
    module.itself = module

    def f():
        return a, b, module.itself, f

    assert ("module.itself", module) not in Reached(f).named and ("ring.itself", module) in Reached(f).named


def test_gradients_that_helpers_would_swallow_are_refused():
    weight = torch.ones(2, requires_grad=True)

    def helper(x):
        return x * mi.TensorXf(weight)

    with pytest.raises(GradientError, match="variable 'weight', which is no argument"):
        tt.wrap(lambda x: helper(x))(torch.ones(2))

    @dr.freeze
    def frozen(x):
        return x * x

    def calls_it(x):
        return frozen(x)

    with pytest.raises(GradientError, match="variable 'frozen' is frozen"):
        tt.wrap(lambda x: calls_it(x))(torch.ones(2, requires_grad=True)).sum().backward()
