"""``tt.wrap`` puts back every scene that a function reaches, and replays it as it was at the call; no gradient is lost,
and threads do not wait for one another.
"""

from __future__ import annotations

import functools
import subprocess
import sys
import textwrap
import types

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch
from torch import nn

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

    computed = Computed()
    return {
        "slots": Slots(params),
        "a property that is kept": lambda x: write(computed.once[0], x),
        "a function that it calls": lambda x: holder(x),
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


# ----------------------------------------------------------------------------------------- gradients that would be lost


def test_gradients_that_helpers_would_swallow_are_refused():
    weight = torch.ones(2, requires_grad=True)

    def helper(x):
        return x * mi.TensorXf(weight)

    def scaled(x, *, by=weight):
        return x

    for function, name in (
        (lambda x: helper(x), "weight"), (functools.partial(helper), "weight"), (scaled, "by"),
        (functools.partial(lambda factor, x: x, weight), "argument 0"),
    ):  # fmt: skip
        with pytest.raises(GradientError, match=f"variable '{name}', which is no argument"):
            tt.wrap(function)(torch.ones(2))


def test_a_scene_that_is_attached_and_not_found_is_refused(scene):
    """A step of ``mi.ad.Adam`` attaches scenes; in a place too deep to be found the derivative would be lost."""
    params = mi.traverse(scene)
    attached = mi.TensorXf(params[KEY])
    dr.enable_grad(attached)
    params[KEY] = attached
    params.update()
    hidden = [[[[[[params]]]]]]

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


HOLDERS = {
    "list": lambda x: [x],
    "namespace": lambda x: types.SimpleNamespace(x=x),
    "parameters": lambda x: nn.ParameterList([x]),
}


@pytest.mark.parametrize("way", HOLDERS)
def test_containers_of_tensors_that_want_gradients(way):
    x, held = torch.ones(2, requires_grad=True), HOLDERS[way](nn.Parameter(torch.ones(2)))
    with pytest.raises(GradientError, match="the variable 'held', which is no argument, wants a gradient"):
        tt.wrap(lambda x: (x, held)[0])(x)
    wrapped = tt.wrap(lambda x, held: x)
    if way == "list":  # a tree
        assert torch.equal(wrapped(x, held), x)
        return
    with pytest.raises(GradientError, match="an argument wants a gradient"):
        wrapped(x, held)
    with torch.no_grad():
        assert torch.equal(wrapped(x, held), x)


TRANSFORMS = {
    "grad": lambda f: torch.func.grad(f),
    "vmap": lambda f: torch.func.vmap(f),
    "jvp": lambda f: lambda x: torch.func.jvp(f, (x,), (x,)),
}


@pytest.mark.parametrize("way", TRANSFORMS)
def test_transforms_reach_arguments_alone(way):
    def f(a):
        return tt.wrap(lambda x: dr.sum(x * mi.TensorXf(a), axis=None))(torch.ones(3))

    with pytest.raises(GradientError, match="the variable 'a', which is no argument, wants a gradient"):
        TRANSFORMS[way](f)(torch.ones(2, 3) if way == "vmap" else torch.ones(3))


def test_functions_that_differentiate_by_themselves():
    def f(x, constant):
        y = mi.Float(2)
        dr.enable_grad(y)
        dr.backward(y * y * (dr.detach(x) if constant else x).array)
        return dr.grad(y) * x.array

    x = torch.tensor([3.0], requires_grad=True)
    assert tt.wrap(f)(x, False) == 36
    with pytest.raises(GradientError, match="differentiates by itself"):
        tt.wrap(f)(x, False).backward()
    tt.wrap(f)(x, True).backward()
    assert x.grad == 12
    assert torch.func.jvp(lambda x: tt.wrap(f)(x, True), (x.detach(),), (x.detach(),))[1] == 36


# ----------------------------------------------------------------------------------------------- arguments and results


def test_structures_of_mitsuba_are_arguments():
    ray = mi.Ray3f(mi.Point3f(1, 2, 3), mi.Vector3f(0, 0, 1))

    def f(x, ray, pose):
        ray.o *= 2  # of a copy
        return (pose @ ray.o).z * x.array

    x = torch.tensor([1.0], requires_grad=True)
    out = tt.wrap(f)(x, ray, mi.Transform4f().translate(mi.Vector3f(0, 0, 1)))
    out.backward()
    assert out == 7 and x.grad == 7 and ray.o.z == 3
    dr.enable_grad(ray.o)
    with pytest.raises(GradientError, match=r"depends on arrays of Dr\.Jit that want a gradient"):
        tt.wrap(f)(x, ray, mi.Transform4f())


# ------------------------------------------------------------------------------------------------------------- threads


@pytest.mark.slow
def test_threads_do_not_wait_for_one_another():
    """Graphs that are freed in one thread while another computes: a lock of Dr.Jit's and Python's own."""
    script = """
        import faulthandler, threading
        faulthandler.dump_traceback_later(60, exit=True)
        import torchtransient as tt
        import mitsuba as mi
        import torch
        mi.set_variant("llvm_ad_rgb")
        squares = tt.wrap(lambda x: x * x)
        def work(size):
            for _ in range(60):
                x = torch.ones(size, requires_grad=True)
                squares(x).sum().backward()
                assert torch.equal(x.grad, torch.full((size,), 2.0))
        threads = [threading.Thread(target=work, args=(size,)) for size in (3, 100)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        print("done")
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script)], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.stdout.split() == ["done"], done.stderr[-2000:]
