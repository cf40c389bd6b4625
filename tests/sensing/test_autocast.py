"""Inside torch.autocast a sensor measures what it measures outside: mixed precision is for networks."""

from __future__ import annotations

import pytest
import torch

from support.sensing.all_entries import each
from support.sensing.contract import parts
from torchtransient import TimeAxis, sensing
from torchtransient.errors import GradientError


@pytest.mark.slow
@each
def test_expectation_and_derivatives_are_those_outside(entry):
    """First and second derivatives, whether the backward pass runs behind the context, as torch asks for, or in it."""
    module, x = entry.module(torch.float32), entry.x(torch.float32)

    def run(forward, backward):
        light = x.clone().requires_grad_()
        leaves = [light, *(p for p in module.parameters() if p.requires_grad)]
        with torch.autocast("cpu", torch.bfloat16, enabled=forward):
            value = parts(module.expected(light))[0]
        with torch.autocast("cpu", torch.bfloat16, enabled=backward):
            first = torch.autograd.grad(value.square().mean(), leaves, create_graph=True)
            try:
                second = torch.autograd.grad(sum(g.square().mean() for g in first), leaves, allow_unused=True)
            except GradientError:
                assert entry.name == "FreeRunningSPAD"
                second = ()
        return [value, *first, *(g for g in second if g is not None)]

    wanted = run(False, False)
    for inside in ((True, False), (True, True), (False, True)):
        for a, b in zip(run(*inside), wanted, strict=True):
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


@pytest.mark.parametrize("name", ["tap_phasor", "stokes_from", "demosaic", "correlate"])
def test_backward_of_functions_inside_is_that_outside(name):
    g = torch.Generator().manual_seed(1)
    taps, stokes = torch.rand(1, 4, 3, 4, generator=g), torch.rand(4, 1, 3, 4, 4, generator=g)
    weights = torch.rand(7, 4, generator=g)
    call, x = {
        "tap_phasor": (lambda x: sensing.tap_phasor(x, 4).abs(), taps),
        "stokes_from": (lambda x: sensing.stokes_from(x, sensing.linear_analyzers([0, 45, 90, 135])), stokes),
        "demosaic": (sensing.demosaic, stokes),
        "correlate": (lambda x: sensing.correlate(x, weights), taps),
    }[name]
    found = []
    for enabled in (False, True):
        leaf = x.clone().requires_grad_()
        with torch.autocast("cpu", torch.bfloat16, enabled=enabled):
            call(leaf).square().sum().backward()
        found.append(leaf.grad)
    assert torch.equal(*found)
