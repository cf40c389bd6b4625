"""``torch.func`` and ``torch.autograd.functional`` on a renderer."""

from __future__ import annotations

import pytest
import torch
from torch.autograd import functional

import torchtransient as tt
from tools.small_room import COLOUR
from tools.small_room import VARIANT as VARIANT

START = torch.tensor([0.8, 0.5, 0.2])
XS = torch.stack([START, START * 0.5])
TANGENT = torch.tensor([0.3, 0.1, -1.0])


@pytest.fixture(scope="module")
def groups(room_scene):
    """A vector function of the colour: the transient's sum over six groups of bins."""
    renderer = tt.TransientRenderer(room_scene, parameters=[COLOUR], spp=4, grad_seed="same")

    def f(x, seed=0):
        return renderer({COLOUR: x}, seed=seed).transient.sum((-4, -2, -1)).reshape(6, 4).sum(1)

    return f


@pytest.fixture(scope="module")
def jacobian(groups):
    """The reference: one backward for each row."""
    x = START.clone().requires_grad_()
    out = groups(x)
    return torch.stack([torch.autograd.grad(row, x, retain_graph=True)[0] for row in out])


def close(found, expected):
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


def test_products(groups, jacobian):
    u = torch.arange(6.0)
    assert jacobian.abs().max() > 0
    out, pushed = torch.func.jvp(groups, (START,), (TANGENT,))
    assert torch.equal(out, groups(START))
    close(pushed, jacobian @ TANGENT)
    close(torch.func.vjp(groups, START)[1](u)[0], u @ jacobian)
    close(torch.func.grad(lambda x: groups(x) @ u)(START), u @ jacobian)
    close(torch.func.grad_and_value(lambda x: groups(x) @ u)(START)[0], u @ jacobian)
    close(functional.vjp(groups, START, u)[1], u @ jacobian)
    close(functional.jvp(groups, START, TANGENT)[1], jacobian @ TANGENT)


def test_jacobians(groups, jacobian):
    close(torch.func.jacrev(groups)(START), jacobian)
    close(torch.func.jacrev(groups, chunk_size=2)(START), jacobian)
    close(torch.func.jacfwd(groups)(START), jacobian)
    close(functional.jacobian(groups, START), jacobian)


LEAF = START.clone().requires_grad_()
BATCHED = {
    "jacobian": lambda f: functional.jacobian(f, START, vectorize=True),
    "jacobian, forward mode": lambda f: functional.jacobian(f, START, vectorize=True, strategy="forward-mode"),
    "hessian": lambda f: functional.hessian(lambda x: f(x).sum(), START, vectorize=True),
    "grad": lambda f: torch.autograd.grad(f(LEAF), LEAF, torch.eye(6), is_grads_batched=True),
}


@pytest.mark.parametrize("way", BATCHED)
def test_batches_of_autograd_are_refused(groups, way):
    with pytest.raises(tt.errors.GradientError, match=r"a render has no rule.*Expected torch\.func\.jacrev"):
        BATCHED[way](groups)


def test_nested_transforms(groups):
    loop = torch.stack([groups(x) for x in XS])
    each = torch.stack([torch.func.jacrev(groups)(x) for x in XS])
    vmap = torch.func.vmap
    close(vmap(groups, in_dims=1)(XS.T.contiguous()), loop)
    close(vmap(vmap(groups))(torch.stack([XS, XS.flip(0)])), torch.stack([loop, loop.flip(0)]))
    close(vmap(torch.func.jacrev(groups))(XS), each)
    close(vmap(torch.func.jacfwd(groups))(XS), each)
    blocks = torch.zeros(2, 6, 2, 3)
    blocks[0, :, 0], blocks[1, :, 1] = each
    close(torch.func.jacfwd(vmap(groups))(XS), blocks)
    close(torch.func.jacrev(vmap(groups))(XS), blocks)


def test_products_of_gauss_and_newton(groups, jacobian):
    """J^T J v, each factor a first derivative: the derivative of a tangent by the tangent, of a gradient by the
    cotangent.
    """

    def push(v):
        return torch.func.jvp(groups, (START,), (v,))[1]

    close(torch.func.vjp(push, TANGENT)[1](push(TANGENT))[0], jacobian.T @ jacobian @ TANGENT)
    pull = torch.func.vjp(groups, START)[1]
    close(torch.func.jacrev(lambda u: pull(u)[0])(torch.ones(6)), jacobian.T)
    close(torch.func.jacfwd(lambda u: pull(u)[0])(torch.ones(6)), jacobian.T)
    close(torch.func.jacfwd(push)(TANGENT), jacobian)


SECOND = {
    "hessian": lambda f: torch.func.hessian(f)(START),
    "reverse over reverse": lambda f: torch.func.jacrev(torch.func.jacrev(f))(START),
    "forward over forward": lambda f: torch.func.jacfwd(torch.func.jacfwd(f))(START),
    "hvp": lambda f: functional.hvp(f, START, TANGENT),
}


@pytest.mark.parametrize("way", SECOND)
def test_second_derivatives_are_refused(groups, way):
    with pytest.raises(tt.errors.GradientError, match="second derivatives of a render are not available"):
        SECOND[way](lambda x: groups(x).square().sum())


# ---------------------------------------------------------------------------------------------------- seeds of vmap


def test_same_randomness_is_one_seed(groups):
    twice = torch.stack([START, START])
    out = torch.func.vmap(lambda x: groups(x, seed=None), randomness="same")(twice)
    assert torch.equal(out[0], out[1])


def test_different_randomness_is_a_seed_for_each_entry(groups):
    twice = torch.stack([START, START])

    def seedless(x):
        return groups(x, seed=None)

    torch.manual_seed(5)
    out = torch.func.vmap(seedless, randomness="different")(twice)
    assert not torch.equal(out[0], out[1])
    torch.manual_seed(5)
    seeds = torch.randint(0, 2**32, (2,), dtype=torch.int64)
    close(out, torch.stack([groups(START, seed=int(seed)) for seed in seeds]))
    torch.manual_seed(5)
    slopes = torch.func.vmap(torch.func.jacrev(seedless), randomness="different")(twice)
    close(slopes, torch.stack([torch.func.jacrev(lambda x, s=int(s): groups(x, seed=s))(START) for s in seeds]))


def test_seeds_may_be_what_is_mapped(groups):
    seeds = torch.tensor([3, 8])
    out = torch.func.vmap(groups)(XS, seeds)
    close(out, torch.stack([groups(x, seed=int(seed)) for x, seed in zip(XS, seeds, strict=True)]))
    slopes = torch.func.vmap(torch.func.jacrev(groups))(XS, seeds)
    close(slopes[1], torch.func.jacrev(groups)(XS[1], 8))
