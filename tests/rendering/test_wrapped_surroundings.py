"""``tt.wrap``: what a function reaches otherwise than by its arguments, threads, graphs of torch, and odd arguments."""

from __future__ import annotations

import subprocess
import sys
import textwrap
import types

import drjit as dr
import mitsuba as mi
import pytest
import torch
from torch import nn

import torchtransient as tt
from tools.small_room import VARIANT as VARIANT
from torchtransient.errors import GradientError

squares = tt.wrap(lambda x: x * x)

# ------------------------------------------------------------------------------------------------------------ scenes

# --------------------------------------------------------------------------------------- derivatives that would be lost

HOLDERS = {
    "list": lambda x: [x],
    "dictionary": lambda x: {"x": x},
    "namespace": lambda x: types.SimpleNamespace(x=x),
    "parameters": lambda x: nn.ParameterList([x]),
}


@pytest.mark.parametrize("way", HOLDERS)
def test_containers_of_tensors_that_want_gradients(way):
    x, held = torch.ones(2, requires_grad=True), HOLDERS[way](nn.Parameter(torch.ones(2)))
    with pytest.raises(GradientError, match="the variable 'held', which is no argument, wants a gradient"):
        tt.wrap(lambda x: (x, held)[0])(x)
    wrapped = tt.wrap(lambda x, held: x)
    if way in ("list", "dictionary"):  # trees
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
    def slope(y):
        dr.enable_grad(y)
        dr.backward(y * y)
        return dr.grad(y)

    def slope_forward(y):
        dr.enable_grad(y)
        z = y * y
        dr.forward(y)
        return dr.grad(z)

    for inner in (slope, slope_forward):
        x = torch.tensor([3.0], requires_grad=True)
        out = tt.wrap(lambda x, inner=inner: inner(mi.Float(2)) * x.array)(x)
        out.backward()
        assert out == 12 and x.grad == 4
        assert torch.func.jvp(tt.wrap(lambda x, inner=inner: inner(mi.Float(2)) * x.array), (x,), (x,))[1] == 12

    def by_argument(x, constant):
        y = mi.Float(2)
        dr.enable_grad(y)
        dr.backward(y * y * (dr.detach(x) if constant else x).array)
        return dr.grad(y) * x.array

    x = torch.tensor([3.0], requires_grad=True)
    assert tt.wrap(by_argument)(x, False) == 36
    with pytest.raises(GradientError, match="differentiates by itself"):
        tt.wrap(by_argument)(x, False).backward()
    tt.wrap(by_argument)(x, True).backward()
    assert x.grad == 12


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
