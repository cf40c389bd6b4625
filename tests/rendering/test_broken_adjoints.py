"""NaN and infinity in adjoints and tangents arrive at the gradients, in every mode and in wrapped functions.

Dr.Jit takes a sum of nothing but NaN for zero, so that a `GradScaler` saw nothing.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import pytest
import torch

import torchtransient as tt
from tools.small_room import COLOUR

START = torch.tensor([0.8, 0.5, 0.2])
NAN, INF = math.nan, math.inf


@pytest.fixture(scope="module")
def renderer(room_scene):
    return tt.TransientRenderer(room_scene, [COLOUR], spp=4)


def render(renderer, x):
    return renderer({COLOUR: x}, seed=0).transient


@pytest.mark.parametrize(("number", "everywhere"), [(NAN, True), (INF, False)])
def test_adjoint_that_is_not_finite_makes_all_gradients_nan(renderer, number, everywhere):
    x = START.clone().requires_grad_()
    out = render(renderer, x)
    adjoint = torch.full_like(out, number) if everywhere else torch.ones_like(out)
    adjoint[0, -1, 0, 0] = number  # a bin without light: which bins have some differs from seed to seed
    assert torch.autograd.grad(out, x, adjoint)[0].isnan().all()


def test_entries_of_a_batch_are_told_apart(renderer):
    x = START.expand(3, 3).clone().requires_grad_()
    out = render(renderer, x)
    adjoint = torch.ones_like(out)
    adjoint[1, 0, 0, 0, 0] = NAN
    found = torch.autograd.grad(out, x, adjoint)[0]
    assert found[1].isnan().all()
    expected = torch.autograd.grad(render(renderer, x).sum(), x)[0]
    torch.testing.assert_close(found[[0, 2]], expected[[0, 2]])


@pytest.mark.parametrize("number", [NAN, INF])
def test_tangent_that_is_not_finite_makes_the_film_nan(renderer, number):
    tangent = torch.tensor([0.0, number, 0.0])
    found = torch.func.jvp(lambda x: renderer({COLOUR: x}, seed=0).transient, (START,), (tangent,))[1]
    assert found.isnan().all()


def test_recorded_derivatives_do_the_same(renderer):
    for _ in range(4):  # the third call is launched without tracing
        x = START.clone().requires_grad_()
        out = renderer({COLOUR: x}, seed=0)
        out.transient.sum().backward()
    assert out.stats.derivatives_recorded == ["launched"] and x.grad.isfinite().all()
    found = torch.autograd.grad((out_again := render(renderer, x)), x, torch.full_like(out_again, NAN))[0]
    assert found.isnan().all()
    assert torch.autograd.grad(render(renderer, x).sum(), x)[0].isfinite().all()  # nothing of it stays behind


def test_grad_scaler_skips_the_step(renderer):
    renderer.zero_grad()
    optimizer = torch.optim.SGD(renderer.parameters(), lr=1.0)
    scaler = torch.amp.GradScaler("cpu", init_scale=4.0)
    before = renderer.values[COLOUR].detach().clone()
    scaler.scale(renderer(seed=0).transient.sum() * INF).backward()
    scaler.step(optimizer)
    scaler.update()
    assert torch.equal(renderer.values[COLOUR].detach(), before) and scaler.get_scale() == 2.0


# ------------------------------------------------------------------------------------------------ wrapped functions


@pytest.fixture(scope="module")
def gathered(renderer):
    return tt.wrap(lambda x: dr.gather(mi.Float, x.array, mi.UInt32([0, 1, 1, 2])))


def test_wrapped_function_is_nan_where_the_adjoint_touches_it(gathered):
    x = torch.arange(1.0, 5.0).requires_grad_()
    found = torch.autograd.grad(gathered(x), x, torch.tensor([NAN, 1.0, 1.0, INF]))[0]
    assert found[[0, 2]].isnan().all() and found[[1, 3]].tolist() == [2, 0]
