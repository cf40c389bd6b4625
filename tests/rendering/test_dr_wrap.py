"""What ``dr.wrap`` of the installed Dr.Jit does around a scene: the list of tests/rendering/test_wrap.py, item by item.

Each test states what happens today. One that fails after an update of Dr.Jit is good news: mend docs/mitsuba.md and the
test. What is right already stands here too, so that the list is whole.
"""

from __future__ import annotations

import threading

import drjit as dr
import mitsuba as mi
import pytest
import torch
from torch import nn
from torch.autograd import forward_ad

from support.mitsuba_room import load_room
from tools.small_room import COLOUR
from tools.small_room import VARIANT as VARIANT

START = torch.tensor([0.8, 0.5, 0.2])
NONE = torch.zeros(3)


@pytest.fixture(scope="module")
def render():
    """The sum of squares of the transient, a function of the box's colour."""
    scene, params = load_room()

    @dr.wrap(source="torch", target="drjit")
    def light(x, seed=0):
        params[COLOUR] = dr.unravel(mi.Color3f, x.array)
        params.update()
        transient = mi.render(scene, params, spp=4, seed=seed)[1]
        return dr.sum(transient * transient, axis=None)

    return light


@pytest.fixture(scope="module")
def slope(render):
    """The gradient at START, and at half of it."""
    found = []
    for factor in (1.0, 0.5):
        x = (START * factor).requires_grad_()
        render(x).backward()
        found.append(x.grad)
    return found


def identity():
    return dr.wrap(source="torch", target="drjit")(lambda x: x)


def test_second_backward_returns_the_first_gradient(render, slope):
    x = START.clone().requires_grad_()
    loss = render(x)
    torch.autograd.grad(loss, x, retain_graph=True)
    again = torch.autograd.grad(3 * loss, x)[0]
    torch.testing.assert_close(again, slope[0])  # right would be 3 * slope[0]


def test_of_several_calls_before_one_backward_the_last_alone_has_a_gradient(render, slope):
    first, last = START.clone().requires_grad_(), (START * 0.5).requires_grad_()
    (render(first) + render(last)).backward()
    torch.testing.assert_close(first.grad, NONE)  # right would be slope[0]
    torch.testing.assert_close(last.grad, slope[1])


def test_gradients_of_two_calls_with_one_tensor_do_not_add_up(render, slope):
    x = START.clone().requires_grad_()
    (render(x) + render(x)).backward()
    assert not torch.allclose(x.grad, 2 * slope[0], rtol=0.1)


def test_edits_in_place_are_not_noticed(render, slope):
    x = START.clone().requires_grad_()
    y = x * 1
    loss = render(y)
    with torch.no_grad():
        y.mul_(0.5)
    loss.backward()
    torch.testing.assert_close(x.grad, slope[0])


def test_results_share_memory_with_arguments():
    x = torch.ones(3)
    identity()(x).fill_(2.0)
    assert torch.equal(x, torch.full((3,), 2.0))


def test_a_bare_parameter_is_refused(render):
    with pytest.raises(AttributeError, match="'Parameter' object has no attribute 'array'"):
        render(nn.Parameter(START))


@pytest.mark.parametrize(
    "dtype", [torch.bfloat16, torch.uint8, torch.int8, torch.int16, torch.uint16, torch.complex64], ids=str
)
def test_dtypes_that_are_refused(dtype):
    with pytest.raises(RuntimeError, match="unsupported dtype"):
        identity()(torch.ones(3, dtype=dtype))


@pytest.mark.parametrize(
    "dtype", [torch.float16, torch.float32, torch.float64, torch.int32, torch.int64, torch.uint32, torch.bool], ids=str
)
def test_dtypes_that_pass(dtype):
    assert identity()(torch.ones(3, dtype=dtype)).dtype == dtype


def test_the_scene_is_left_with_the_values_of_the_last_call_and_a_graph():
    scene, params = load_room()

    @dr.wrap(source="torch", target="drjit")
    def colour(x):
        params[COLOUR] = dr.unravel(mi.Color3f, x.array)
        params.update()
        return mi.render(scene, params, spp=1)[1]

    colour((START * 0.5).requires_grad_())
    assert params[COLOUR].x[0] == pytest.approx(0.4)
    assert dr.grad_enabled(params[COLOUR])


@pytest.mark.parametrize("requires_grad", [False, True])
def test_forward_mode_needs_requires_grad(render, slope, requires_grad):
    tangent = torch.tensor([1.0, -0.5, 2.0])
    x = START.clone().requires_grad_(requires_grad)
    with forward_ad.dual_level():
        dual = forward_ad.make_dual(x, tangent)
        if not requires_grad:
            with pytest.raises(RuntimeError, match="does not depend on the input"):
                render(dual)
            return
        found = forward_ad.unpack_dual(render(dual)).tangent
    assert float(found) == pytest.approx(float(slope[0] @ tangent), rel=1e-3)


FUNC = {
    "vjp": lambda f: torch.func.vjp(f, START),
    "jvp": lambda f: torch.func.jvp(f, (START,), (START,)),
    "jacrev": lambda f: torch.func.jacrev(f)(START),
    "jacfwd": lambda f: torch.func.jacfwd(f)(START),
    "vmap": lambda f: torch.func.vmap(f)(torch.stack([START, START])),
}


@pytest.mark.parametrize("name", FUNC)
def test_function_transforms_are_refused(render, name):
    with pytest.raises(RuntimeError, match="must override the setup_context staticmethod"):
        FUNC[name](render)


def test_second_derivatives_are_refused(render):
    x = START.clone().requires_grad_()
    first = torch.autograd.grad(render(x).square(), x, create_graph=True)[0]
    with pytest.raises(RuntimeError, match="once_differentiable"):
        first.sum().backward()


def test_a_call_of_another_thread_takes_the_structure_of_a_result_away():
    """The structure of what a function returns is kept in a global until the result has been put together. Here the
    other thread comes between by appointment: while Dr.Jit asks the class of a leaf whether it is a structure.
    """
    asked = []

    def other_call():
        thread = threading.Thread(target=lambda: identity()(torch.ones(1)))
        thread.start()
        thread.join()

    class Leaf(type):
        def __getattr__(cls, name):
            if name == "DRJIT_STRUCT":
                asked.append(name)
                if len(asked) == 2:  # the first time the structure is being made
                    other_call()
            raise AttributeError(name)

    class Note(metaclass=Leaf):
        pass

    with pytest.raises(TypeError, match="'NoneType' object is not reversible"):
        dr.wrap(source="torch", target="drjit")(lambda x: (x, Note()))(torch.ones(1))
