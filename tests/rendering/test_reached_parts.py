"""How far a function's variables are followed, what they are called, and what is not followed, piece by piece."""

from __future__ import annotations

import collections
import contextlib
import functools
import importlib.machinery
import sys
import types
import weakref

import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from tools.small_room import VARIANT as VARIANT
from torchtransient.errors import GradientError
from torchtransient.rendering.reached import Reached, _is_of_library, _is_private, _parts_of


@pytest.fixture
def scene():
    """A picture is the smallest scene."""
    return mi.load_dict({"type": "bitmap", "bitmap": mi.Bitmap(np.full((2, 2, 3), 0.5, np.float32)), "raw": True})


class _Own:
    """A class of this file."""


def held(value, levels):
    for _ in range(levels):
        value = [value]
    return value


@pytest.mark.parametrize(("levels", "found"), [(0, True), (1, True), (4, True), (5, False)])
def test_entries_of_entries_are_followed_four_deep(scene, levels, found):
    value = held(scene, levels)
    assert Reached(lambda: value).objects == [scene] * found
    # Arguments count as entries of one list.
    assert Reached(lambda: 0, [held(scene, levels - 1) if levels else scene]).objects == [scene] * found


def test_what_is_met_again_nearer_is_followed_further(scene):
    """It was not, where its name came later in the alphabet than that of what holds it."""
    near = held(scene, 4)
    a_way = held(near, 3)
    assert Reached(lambda: (a_way, near)).objects == [scene]
    weight = torch.ones(2, requires_grad=True)

    def helper(x):
        return x * mi.TensorXf(weight)

    all_of_them = [helper]
    assert ("weight", weight) not in Reached(lambda: all_of_them).named
    with pytest.raises(GradientError, match="variable 'weight', which is no argument"):
        tt.wrap(lambda x: (all_of_them, helper(x))[1])(torch.ones(2))


@pytest.mark.parametrize(("count", "found"), [(1000, True), (1001, False)])
def test_many_entries_are_data(scene, count, found):
    """More than a thousand are looked at for themselves alone."""
    inside = [[0]] * (count - 1) + [[scene]]
    assert Reached(lambda: inside).objects == [scene] * found
    itself = [[0]] * (count - 1) + [scene]
    assert Reached(lambda: itself).objects == [scene]


def test_names_of_variables():
    """Those of the function, of bound arguments by number or name, of defaults, and of functions that it calls."""
    one, two, three, four = ([n] for n in range(4))

    def helper(x):
        return x, three

    def function(a, b, x, c=four, *, d=five):
        return helper(x), one, later  # noqa: F821  not assigned yet

    bound = functools.partial(functools.partial(function, one), two, c=three)
    named = [(name, value) for name, value in Reached(bound).named if value is not helper]
    found = {(name, id(value)) for name, value in named}
    assert found == {
        ("argument 0", id(one)), ("argument 1", id(two)), ("c", id(three)), ("c", id(four)), ("d", id(five)),
        ("one", id(one)), ("three", id(three)),
    }  # fmt: skip


five = [5]


def test_methods_that_may_be_others_name_nothing():
    """Code that has the name of an attribute may be of another object: what it reaches is put back, and not named."""
    inside = [1]

    class Kind:
        def go(self):
            return inside

    one = Kind()
    reached = Reached(lambda: one.go())
    assert [name for name, _ in reached.named] == ["one"]
    assert [name for name, _ in Reached(one.go).named] == ["inside"]


def test_objects_are_listed_once(scene):
    params, other = mi.traverse(scene), mi.load_dict({"type": "diffuse"})

    def function():
        return scene.x, params.y, [other, scene, params]

    def again():
        return function(), scene, params, other

    reached = Reached(again, [other, params])
    assert reached.objects == [other, scene] and reached.parameters == [params]


def test_parts_of_modules_of_torch(scene):
    """Modules inside and attributes of one's own, not its hooks and tensors."""
    outer, inner = torch.nn.Module(), torch.nn.Module()
    outer.add_module("inner", inner)
    outer.first = inner.scene = scene
    outer.register_forward_hook(lambda *_: 0)
    outer.register_parameter("p", torch.nn.Parameter(torch.zeros(2)))
    modules, first = _parts_of(outer)
    assert modules == {"inner": inner} and first is scene
    del outer.first
    assert Reached(lambda: outer).objects == [scene]


def test_parts_of_objects():
    class Base:
        __slots__ = ("__hidden", "open")

        def __init__(self):
            self.__hidden, self.open = 1, 2

    class _Derived(Base):
        __slots__ = "single"

    class Also(_Derived):
        def __init__(self):
            super().__init__()
            self.free = 3

    one = Also()
    assert sorted(_parts_of(one)) == [1, 2, 3]
    one.single = 4
    assert sorted(_parts_of(one)) == [1, 2, 3, 4]
    assert _parts_of({"a": 5, "b": 6}) == (5, 6) and _parts_of({}) == () and _parts_of([7, 8]) == (7, 8)
    assert _parts_of(types.MappingProxyType({"a": 5})) == (5,) and _parts_of(collections.deque([9])) == (9,)
    assert _parts_of(weakref.ref(Base)) == (Base,)

    for given in ([1, 2], {"a": 1, "b": 2}):
        kind = type("WithAttributes", (type(given),), {})
        one = kind(given)
        assert _parts_of(one) == (1, 2)
        one.note = 3
        assert _parts_of(one) == (3, 1, 2)


def test_what_others_call_a_sequence_is_not_read():
    class File(collections.abc.Sequence):
        def __getitem__(self, n):
            raise AssertionError("a file was read")

        def __len__(self):
            return 3

    file = File()
    file.name = "a"
    assert _parts_of(file) == ("a",)


def test_names_that_python_changes():
    assert [_is_private(name) for name in ("__a", "_a", "a", "__a__", "__a_")] == [True, False, False, False, True]


def test_what_belongs_to_libraries(tmp_path):
    by_hand, written = types.ModuleType("by_hand"), types.ModuleType("written")
    written.__file__ = str(tmp_path / "written.py")
    for library in (np, torch, mi, functools, sys, torch.nn.functional.relu, torch.nn.Module, dict, tt.load, Reached):
        assert _is_of_library(library), library
    # as `python -m` has it
    started = types.ModuleType("__main__")
    started.__spec__ = importlib.machinery.ModuleSpec("started", None)
    for own in (by_hand, written, started, sys.modules[__name__], held, _Own, held.__get__(1)):
        assert not _is_of_library(own), own
    assert not _is_of_library(3) and not _is_of_library(type("Nowhere", (), {"__module__": "nowhere"}))


def test_what_is_around_a_function_that_is_wrapped(scene):
    """Variables of the wrapper, not the functions that it calls by other names, and nothing of libraries' wrappers."""
    extra = [scene]

    def decorated(function):
        @functools.wraps(function)
        def other(x):
            return function(x) * len(extra)

        return other

    inside = [1]

    @decorated
    @decorated
    def function(x):
        return x, inside

    reached = Reached(function)
    assert {name for name, _ in reached.named} == {"extra", "inside"} and reached.objects == [scene]

    @contextlib.contextmanager
    def managed():
        yield inside

    @torch.no_grad()
    def without():
        return inside

    for one in (managed, without):
        assert {name for name, _ in Reached(one).named} == {"inside"}
    # What is kept by an object is found, and not named.
    kept = functools.lru_cache(function)
    reached = Reached(lambda: kept(1))
    assert {name for name, _ in reached.named} == {"kept"} and reached.objects == [scene]
