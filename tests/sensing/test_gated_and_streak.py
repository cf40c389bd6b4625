"""Gate profiles and sweeps against closed forms, the streak camera against the moments of its draws."""

from __future__ import annotations

import math

import pytest
import torch

from torchtransient.axes import TimeAxis
from torchtransient.sensing import GatedIntegration, SweepJitter, gate_profiles
from torchtransient.units import SPEED_OF_LIGHT

RISE_PER_SIGMA = 2 * 1.2815515655446004  # from 10 % to 90 % of a normal distribution
AXIS = TimeAxis.from_seconds(1e-9, 50e-12, 200)


def test_gate_profile_is_the_mean_over_bins():
    delays, widths = torch.tensor([3e-9, 4e-9]), torch.tensor([2e-9, 0.3e-9])
    found = gate_profiles(delays, widths, AXIS, rise_s=0.4e-9, fall_s=0.9e-9, leakage=0.01)
    fine = TimeAxis.from_seconds(1e-9, 50e-12 / 400, 200 * 400)
    t = fine.centers_s
    for g in range(2):
        rise = torch.special.ndtr((t - delays[g].double()) / (0.4e-9 / RISE_PER_SIGMA))
        fall = torch.special.ndtr((t - delays[g].double() - widths[g].double()) / (0.9e-9 / RISE_PER_SIGMA))
        exact = 0.01 + 0.99 * (rise - fall).reshape(200, 400).mean(1).clamp(min=0)
        torch.testing.assert_close(found[g], exact, rtol=0, atol=1e-6)
    # From 10 % to 90 % within the time that it says.
    assert abs(float(torch.special.ndtr(torch.tensor(RISE_PER_SIGMA / 2))) - 0.9) < 1e-6


def test_shut_gates_do_not_go_below_zero():
    """Counting refuses negative light, rounding included, however far the gate is and however sharp its edges are."""
    axis = TimeAxis(0.0, 0.02, 3000)
    delays = torch.linspace(0, 190e-9, 40, dtype=torch.float64)
    for rise_s in (1e-12, 0.5e-9, 5e-9):
        profile = gate_profiles(delays, torch.full_like(delays, 4e-9), axis, rise_s=rise_s, fall_s=rise_s)
        assert float(profile.min()) >= 0.0 and float(profile.max()) <= 1 + 1e-12
        open_s = float((profile > 1e-9).double().sum(1).max()) * axis.bin_width_s
        assert open_s < 4e-9 + 8 * rise_s + 3 * axis.bin_width_s


def test_gate_times_are_learnt():
    camera = GatedIntegration([4e-9], 1e-9, AXIS, rise_s=0.3e-9, learnable=True)
    x = torch.rand(1, 200, 2, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))

    def f(delay_ps, log_width_s):
        values = {"delay_ps": delay_ps, "log_width_s": log_width_s}
        return torch.func.functional_call(camera, values, (x,))

    values = tuple(p.detach().clone().requires_grad_() for p in (camera.delay_ps, camera.log_width_s))
    assert torch.autograd.gradcheck(f, values)
    assert {n for n, _ in camera.named_parameters()} == {"delay_ps", "log_width_s"}


def test_mean_of_the_sweep_jitter_is_a_blur_of_the_stated_width():
    jitter = SweepJitter(4.0 * 2.3548200450309493e-12, bin_width_s=1e-12)
    x = torch.zeros(1, 101, 1, 1, dtype=torch.float64)
    x[0, 50] = 1.0
    y = jitter.expected(x).flatten()
    k = torch.arange(101, dtype=torch.float64) - 50
    # Linear interpolation adds f (1 - f) for a part f of a bin: 1/6 in the mean.
    assert abs(float((y * k**2).sum()) - (4.0**2 + 1 / 6)) < 1e-3
    assert abs(float(y.sum()) - 1) < 1e-9
    assert abs(float((y * k).sum())) < 1e-9


def test_a_sweep_shifts_all_pixels_alike():
    jitter = SweepJitter(10e-12, bin_width_s=1e-12, grad="straight_through")
    x = torch.zeros(3, 2, 101, 2, 2, dtype=torch.float64)
    x[:, :, 50] = 1.0
    y = jitter(x, torch.Generator().manual_seed(1))
    k = torch.arange(101, dtype=torch.float64).reshape(-1, 1, 1)
    position = (y * k).sum(-3)
    assert float((position - position[:, :1, :1, :1]).abs().max()) < 1e-9
    assert float(position[:, 0, 0, 0].std()) > 0.5
    assert int((y[0, 0, :, 0, 0] > 0).sum()) <= 2
    many = SweepJitter(10e-12, bin_width_s=1e-12, sweeps=4000, grad="gaussian")
    z = many(x[:1], torch.Generator().manual_seed(1))[0, 0, :, 0, 0]
    assert float((z - many.expected(x[:1])[0, 0, :, 0, 0]).abs().max()) < 0.02


@pytest.mark.parametrize("policy", ["gaussian", "straight_through", "score"])
def test_gradient_through_the_jitter_is_that_of_the_draw(policy):
    jitter = SweepJitter(3e-12, bin_width_s=1e-12, sweeps=2, grad=policy)
    x = torch.rand(2, 1, 20, 1, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda v: jitter(v, torch.Generator().manual_seed(3)), x, fast_mode=True)


def test_arrival_in_metres_agrees_with_gates_in_seconds():
    """A surface at 0.9 m answers after 6 ns: inside a gate of 5.9 to 6.1 ns, not before or after."""
    axis = TimeAxis(0.0, 0.005, 600)
    x = torch.zeros(1, 600, 1, 1)
    x[0, int(axis.bin_index(1.8))] = 1.0
    assert abs(1.8 / SPEED_OF_LIGHT - 6.004e-9) < 1e-12
    y = GatedIntegration([5.8e-9, 5.9e-9, 6.1e-9], [0.1e-9, 0.2e-9, 0.1e-9], axis, rise_s=1e-12).expected(x).flatten()
    assert math.isclose(float(y[1]), 1.0, abs_tol=1e-6) and float(y[0]) < 1e-6 and float(y[2]) < 1e-6
