"""``tt.wrap``: the bridge's promises for functions of a user's own, and what ``dr.wrap`` does instead."""

from __future__ import annotations

import threading

import drjit as dr
import mitsuba as mi
import pytest
import torch
from torch import nn
from torch.autograd import forward_ad

import torchtransient as tt
from support.mitsuba_room import load_room
from support.sweeps import together
from tools.small_room import COLOUR
from tools.small_room import VARIANT as VARIANT
from torchtransient.errors import GradientError

START = torch.tensor([0.8, 0.5, 0.2])
TANGENT = torch.tensor([1.0, -0.5, 2.0])


def room_function():
    """(SceneParameters, the sum of squares of the transient as a function of the box's colour), as with ``dr.wrap``."""
    scene, params = load_room()

    def light(x, seed=0):
        params[COLOUR] = dr.unravel(mi.Color3f, x.array)
        params.update()
        transient = mi.render(scene, params, spp=4, seed=seed)[1]
        return dr.sum(transient * transient, axis=None)

    return params, light


@pytest.fixture(scope="module")
def room():
    params, light = room_function()
    return params, tt.wrap(light)


@pytest.fixture(scope="module")
def render(room):
    return room[1]


@pytest.fixture(scope="module")
def slope(render):
    """The gradient at START, and at half of it."""
    found = []
    for factor in (1.0, 0.5):
        x = (START * factor).requires_grad_()
        render(x).backward()
        found.append(x.grad)
    return found


@tt.wrap
def moments(x):
    """A vector function that costs nothing: three of three."""
    return x * x, dr.sum(x * x * x)


def test_gradients_are_those_of_dr_wrap_and_of_finite_differences(slope):
    scene, params = load_room()

    def light(x, seed=0):
        params[COLOUR] = dr.unravel(mi.Color3f, x.array)
        params.update()
        return dr.sum(mi.render(scene, params, spp=1024, seed=seed)[1] * 0.01, axis=None)

    x = START.clone().requires_grad_()
    dr.wrap(source="torch", target="drjit")(light)(x).backward()
    mi.traverse(scene)[COLOUR] = mi.Color3f(0.5)
    params[COLOUR] = dr.detach(params[COLOUR])
    params.update()
    y, wrapped = START.clone().requires_grad_(), tt.wrap(light)
    wrapped(y).backward()
    torch.testing.assert_close(y.grad, x.grad, rtol=1e-4, atol=1e-6)
    # Of the same samples; the light is a parabola of the colour, so that only the noise of the adjoint is left.
    step = 0.1 * TANGENT
    across = (wrapped(START + step) - wrapped(START - step)) / 2
    assert float(y.grad @ step) == pytest.approx(float(across), rel=0.01)


def test_second_backward_follows_its_own_cotangent(render, slope):
    x = START.clone().requires_grad_()
    loss = render(x)
    torch.autograd.grad(loss, x, retain_graph=True)
    again = torch.autograd.grad(3 * loss, x)[0]
    torch.testing.assert_close(again, 3 * slope[0], rtol=1e-4, atol=1e-6)


def test_several_calls_before_one_backward(render, slope):
    """Of a parameter and a tensor, one of them twice."""
    first, last = nn.Parameter(START), (START * 0.5).requires_grad_()
    (render(first) + render(last) + render(first)).backward()
    torch.testing.assert_close(first.grad, 2 * slope[0], rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(last.grad, slope[1], rtol=1e-4, atol=1e-6)


def test_edits_in_place_are_noticed(render):
    x = START.clone().requires_grad_()
    y = x * 1
    loss = render(y)
    with torch.no_grad():
        y.mul_(0.5)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def test_results_have_memory_of_their_own():
    for size in (3, 1000):
        x = torch.ones(size)
        first, second = tt.wrap(lambda x: (x, x))(x)
        first.fill_(2.0)
        assert torch.equal(x, torch.ones(size)) and torch.equal(second, x)


def test_results_that_are_one_array_or_made_of_one_another():
    def f(x):
        y = x * x
        return x, y, y, y * x

    x, cotangents = START.clone().requires_grad_(), torch.rand(4, 3)
    out = tt.wrap(f)(x)
    grad = torch.autograd.grad(out, x, list(cotangents))[0]
    d = x.detach()
    slopes = torch.stack([torch.ones(3), 2 * d, 2 * d, 3 * d * d])
    torch.testing.assert_close(grad, (slopes * cotangents).sum(0))
    along = torch.func.jvp(tt.wrap(f), (d,), (TANGENT,))[1]
    torch.testing.assert_close(torch.stack(along), slopes * TANGENT)
    first, second = torch.autograd.grad(tt.wrap(lambda x, y: x + y)(x, y := x.detach().requires_grad_()).sum(), (x, y))
    first.zero_()
    assert torch.equal(second, torch.ones(3))


COMPUTED_IN = {
    torch.float16: torch.float32, torch.bfloat16: torch.float32, torch.float32: torch.float32,
    torch.float64: torch.float64, torch.uint8: torch.int32, torch.int8: torch.int32, torch.int16: torch.int32,
    torch.uint16: torch.int32, torch.int32: torch.int32, torch.int64: torch.int64, torch.uint32: torch.uint32,
    torch.uint64: torch.uint64, torch.bool: torch.bool,
}  # fmt: skip


@together("size", [3, 100])
@together("dtype", COMPUTED_IN)
def test_dtypes(dtype, size):
    x = torch.arange(size).to(dtype)
    weights, y = tt.wrap(lambda x, y: (x, y * mi.TensorXf(x))), torch.ones(size, requires_grad=True)
    out, weighed = weights(x, y)
    assert out.dtype == COMPUTED_IN[dtype] and torch.equal(out, x.to(out.dtype))
    assert out.requires_grad == x.is_floating_point()  # as of every function of torch that has been given a leaf
    weighed.sum().backward()
    torch.testing.assert_close(y.grad, x.float())
    if x.is_floating_point():
        x.requires_grad_()
        squares = moments(x)[0]
        squares.sum().backward()
        assert x.grad.dtype == dtype
        torch.testing.assert_close(x.grad, 2 * x.detach())


def test_the_scene_is_as_it_was_and_no_graph_is_left(room):
    params, render = room
    before = mi.Color3f(params[COLOUR])
    x = (START * 0.5).requires_grad_()
    render(x).backward()
    assert dr.all(params[COLOUR] == before, axis=None) and not dr.grad_enabled(params[COLOUR])


def test_forward_mode(render, slope):
    for x in (START.clone(), START.clone().requires_grad_()):
        with forward_ad.dual_level():
            found = forward_ad.unpack_dual(render(forward_ad.make_dual(x, TANGENT))).tangent.detach()
        assert float(found) == pytest.approx(float(slope[0] @ TANGENT), rel=1e-3)


def test_function_transforms(render, slope):
    u = torch.tensor(2.0)
    torch.testing.assert_close(torch.func.vjp(render, START)[1](u)[0], 2 * slope[0], rtol=1e-4, atol=1e-6)
    each = torch.func.vmap(torch.func.grad(render))(torch.stack([START, START * 0.5]))
    torch.testing.assert_close(each, torch.stack(slope), rtol=1e-4, atol=1e-6)


def test_jacobians():
    def f(x):
        squares, cubes = moments(x)
        return torch.cat([squares, cubes.reshape(1)])

    expected = torch.cat([torch.diag(2 * START), 3 * START.square()[None]])
    torch.testing.assert_close(torch.func.jacrev(f)(START), expected)
    torch.testing.assert_close(torch.func.jacfwd(f)(START), expected)
    functional = torch.autograd.functional
    torch.testing.assert_close(functional.jacobian(f, START), expected)
    with pytest.raises(GradientError, match=r"moments has no rule.*vectorize=True.*Expected torch\.func\.jacrev"):
        functional.jacobian(f, START, vectorize=True)
    torch.testing.assert_close(functional.jvp(f, START, TANGENT)[1], expected @ TANGENT)
    xs = torch.stack([START, START * 0.5])
    torch.testing.assert_close(torch.func.vmap(f)(xs), torch.stack([f(x) for x in xs]))
    torch.testing.assert_close(torch.func.vmap(torch.func.jacrev(f))(xs)[0], expected)
    # J^T J v: each factor a first derivative.
    pull = torch.func.vjp(f, START)[1]
    torch.testing.assert_close(pull(torch.func.jvp(f, (START,), (TANGENT,))[1])[0], expected.T @ expected @ TANGENT)


def test_second_derivatives_are_refused():
    for way in (
        torch.func.hessian,
        lambda f: torch.func.jacrev(torch.func.jacrev(f)),
        lambda f: torch.func.jacfwd(torch.func.jacfwd(f)),
        lambda f: lambda x: torch.autograd.functional.hessian(f, x),
    ):
        with pytest.raises(GradientError, match="second derivatives of the wrapped function moments are not available"):
            way(lambda x: moments(x)[1].sum())(START)


def test_threads(render, slope):
    """Two with one scene and one with its own, calls of the others in between, and a backward in yet another thread."""
    wrapped, halved = [render, render, tt.wrap(room_function()[1])], [0, 1, 0]
    found = {}

    def work(n):
        x = (START * (1.0, 0.5)[halved[n]]).requires_grad_()
        loss = sum(wrapped[n](x) for _ in range(2))
        thread = threading.Thread(target=loss.backward)
        thread.start()
        thread.join()
        found[n] = x.grad / 2

    threads = [threading.Thread(target=work, args=(n,)) for n in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for n in range(3):
        torch.testing.assert_close(found[n], slope[halved[n]], rtol=1e-4, atol=1e-6)


def test_a_call_of_another_thread_takes_nothing_away():
    def f(x):
        thread = threading.Thread(target=lambda: None)
        thread.start()
        thread.join()
        return {"x": x, "note": "kept"}

    found = []
    threads = [threading.Thread(target=lambda: found.append(tt.wrap(f)(torch.ones(1)))) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [out["note"] for out in found] == ["kept"] * 8


def test_gradients_of_dr_wrap_are_of_its_last_call(slope):
    """A test that fails after an update of Dr.Jit is good news: mend docs/mitsuba.md."""
    render = dr.wrap(source="torch", target="drjit")(room_function()[1])
    x = START.clone().requires_grad_()
    loss = render(x)
    torch.autograd.grad(loss, x, retain_graph=True)
    torch.testing.assert_close(torch.autograd.grad(3 * loss, x)[0], slope[0], rtol=1e-4, atol=1e-6)  # not 3 times that
    first, last = START.clone().requires_grad_(), (START * 0.5).requires_grad_()
    (render(first) + render(last)).backward()
    torch.testing.assert_close(first.grad, torch.zeros(3))
    torch.testing.assert_close(last.grad, slope[1], rtol=1e-4, atol=1e-6)
    with pytest.raises(RuntimeError, match="must override the setup_context staticmethod"):
        torch.func.jacrev(render)(START)
