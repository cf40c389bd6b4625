"""What stages remember follows every number they have, however it is changed, and no derivative is lost."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch

from torchtransient import sensing

WIDTH = 50e-12


def by_data(response):
    response.log_fwhm_s.data += 0.5


def in_place(response):
    with torch.no_grad():
        response.log_fwhm_s.add_(0.5)


def by_state(response):
    state = {k: v + 0.5 for k, v in response.state_dict().items()}
    response.load_state_dict(state)


def by_another(response):
    response.log_fwhm_s = response.log_fwhm_s + 0.5


@pytest.mark.parametrize("change", [by_data, in_place, by_state, by_another])
def test_what_is_remembered_follows_the_numbers(change):
    response = sensing.GaussianResponse(200e-12)
    stage, impulse = sensing.ImpulseResponse(response, bin_width_s=WIDTH), torch.zeros(1, 64, 1, 1, dtype=torch.float64)
    impulse[:, 32] = 1.0
    before = stage.expected(impulse)
    assert torch.equal(stage.expected(impulse), before)
    change(response)
    assert float((stage.expected(impulse) - before).abs().max()) > 0.01
    first, kernel = response.kernel(WIDTH)
    after = stage.expected(impulse)[0, 32 + first :, 0, 0][: kernel.numel()]
    torch.testing.assert_close(after, kernel.detach(), rtol=1e-12, atol=1e-15)


def test_copies_and_pickles_know_nothing_of_it():
    sensor = sensing.Afterpulsing(0.05, 30e-9, 75e-9, bin_width_s=WIDTH, period_s=100e-9, background=1.0)
    x = torch.rand(1, 400, 2, 2)
    found = sensor.expected(x)
    for other in (copy.deepcopy(sensor), pickle.loads(pickle.dumps(sensor))):
        torch.testing.assert_close(other.expected(x), found, rtol=0, atol=0)
    changed = copy.deepcopy(sensor)
    changed.logit_probability += 0.5
    assert float((changed.expected(x) - x).sum()) > 1.2 * float((found - x).sum())
    changed.dead_time_s = 10e-9
    moved = sensing.Afterpulsing(
        float(changed.probability), 30e-9, 10e-9, bin_width_s=WIDTH, period_s=100e-9, background=1.0
    )
    torch.testing.assert_close(changed.expected(x), moved.expected(x))
    torch.testing.assert_close(sensor.expected(x), found, rtol=0, atol=0)


LIGHT = torch.linspace(0.1, 1, 32).view(1, -1, 1, 1)
STAGES = {
    "response": lambda: sensing.ImpulseResponse(sensing.GaussianResponse(200e-12), bin_width_s=WIDTH),
    "afterpulses": lambda: sensing.Afterpulsing(0.1, 1e-9, 0, bin_width_s=WIDTH, period_s=100 * WIDTH, background=3.0),
}
TRANSFORMS = {
    "grad": lambda f: torch.func.grad(lambda v: f(v).sum())(LIGHT),
    "jvp": lambda f: torch.func.jvp(f, (LIGHT,), (LIGHT,)),
    "hessian": lambda f: torch.func.hessian(lambda v: f(v).square().sum())(LIGHT),
    "functionalize": lambda f: torch.func.functionalize(f)(LIGHT),
    "vmap": lambda f: torch.func.vmap(f)(LIGHT[None]),
}  # fmt: skip


@pytest.mark.parametrize("stage", STAGES)
@pytest.mark.parametrize("transform", TRANSFORMS)
def test_nothing_of_a_transform_is_remembered(stage, transform):
    module = STAGES[stage]()
    TRANSFORMS[transform](module.expected)
    expected = module.expected(LIGHT)
    TRANSFORMS[transform](module.expected)
    assert torch.equal(module.expected(LIGHT), expected) and torch.equal(STAGES[stage]().expected(LIGHT), expected)
