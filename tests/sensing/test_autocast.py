"""Inside torch.autocast a sensor measures what it measures outside: mixed precision is for networks."""

from __future__ import annotations

import pytest
import torch

from support.sensing.all_entries import each
from support.sensing.contract import parts
from torchtransient import TimeAxis, sensing


@each
def test_expectation_and_gradient_are_those_outside(entry):
    """The backward pass runs behind the context, as torch asks for."""
    module, x = entry.module(torch.float32), entry.x(torch.float32)

    def run(enabled):
        light = x.clone().requires_grad_()
        with torch.autocast("cpu", torch.bfloat16, enabled=enabled):
            value = parts(module.expected(light))[0]
        (gradient,) = torch.autograd.grad(value.square().mean(), light)
        return value.detach(), gradient

    for a, b in zip(run(True), run(False), strict=True):
        assert a.dtype == b.dtype
        assert torch.equal(a, b)


@pytest.mark.parametrize("code", [None, sensing.hamiltonian_code(3)], ids=["fourier", "by shape"])
def test_phases_are_those_outside(code):
    axis = TimeAxis.from_seconds(0.0, 100e-12, 50)
    light = torch.rand(1, 50, 3, 4, generator=torch.Generator().manual_seed(0))
    camera = sensing.ItofCorrelation(code or sensing.sine_code(3), (40e6,), axis)
    wanted = sensing.read_itof(camera(light), (40e6,), 3, code=code)
    with torch.autocast("cpu", torch.bfloat16):
        found = sensing.read_itof(camera(light), (40e6,), 3, code=code)
    assert found.depth_m.dtype == torch.float32
    assert torch.equal(found.depth_m, wanted.depth_m)


def test_taps_in_half_precision_have_phases():
    """bfloat16 keeps 8 bits of a tap: phases within 2 / 256 of those in double."""
    turns = torch.linspace(0, 0.9, 10, dtype=torch.float64)
    taps = (1 + sensing.sine_code(4).evaluate(turns)).reshape(4, 1, 10)[None]
    exact = sensing.read_itof(taps, (40e6,), 4)
    for dtype in (torch.bfloat16, torch.float16):
        found = sensing.read_itof(taps.to(dtype), (40e6,), 4)
        assert found.phase.dtype == torch.float32
        assert float(sensing.wrapped_difference(found.phase.double(), exact.phase).abs().max()) < 2 / 256


def test_pulses_are_those_outside():
    from torchtransient.pulses import Pulse

    axis = TimeAxis(0.0, 0.01, 40)
    light = torch.rand(1, 40, 2, 3, generator=torch.Generator().manual_seed(0))
    wanted = sensing.apply_pulse(light, axis, Pulse.gaussian(0.03))
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(sensing.apply_pulse(light, axis, Pulse.gaussian(0.03)), wanted)
