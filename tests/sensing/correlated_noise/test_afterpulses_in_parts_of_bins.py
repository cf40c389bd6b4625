"""Detectors that obey their afterpulses: gates, bins in parts, pixels of several levels, and transforms of them."""

from __future__ import annotations

import pytest
import torch

from support.marks import long
from torchtransient import TimeAxis, sensing

BINS, WIDTH = 5, 100e-12
AXIS = TimeAxis.from_seconds(0.0, WIDTH, BINS)
GATE = torch.tensor([0.0, 0.3, 1.0, 0.6, 0.0])


def light(high=0.4, pixels=2):
    g = torch.Generator().manual_seed(0)
    return 0.02 + high * torch.rand(1, BINS, 1, pixels, generator=g, dtype=torch.float64)


def obeyed(detector, tau_s=400e-12, dead_time_s=150e-12, axis=AXIS, probability=0.2):
    return sensing.AfterpulsingSPAD(detector, sensing.Afterpulsing(probability, tau_s, dead_time_s, axis=axis))


def spad(axis=AXIS, gate=None, cycles=100):
    return sensing.SynchronousSPAD(cycles, gate=gate, dead_time_s=150e-12, axis=axis)


def test_a_gate_that_is_open_is_none():
    x = light()
    torch.testing.assert_close(obeyed(spad(gate=torch.ones(BINS)))(x), obeyed(spad())(x), rtol=1e-10, atol=1e-12)


def test_a_gate_dims_photons_and_carriers_alike():
    """Nothing where it is shut; half open it sees half of each, as of half the light and half the carriers."""
    x = light()
    found = obeyed(spad(gate=GATE))(x)
    assert bool((found[:, GATE == 0] == 0).all()) and bool((found[:, GATE > 0] > 0).all())
    halves = obeyed(spad(gate=torch.full((BINS,), 0.5)), probability=0.2)(x)
    without = sensing.SynchronousSPAD(100, dead_time_s=150e-12, axis=AXIS)
    plain = without(0.5 * x)
    more = halves - plain
    whole = obeyed(spad(), probability=0.1)(0.5 * x) - plain
    torch.testing.assert_close(more.sum(1), whole.sum(1), rtol=0.03, atol=0)


@pytest.mark.parametrize("kind", long(["cycles", "gated", "free"], ["gated"]))
def test_bins_in_parts_are_finer_bins(kind):
    """Carriers of a part of a bin are followed in parts of bins: as where the bins are cut by hand."""
    gated, free = kind == "gated", kind == "free"
    x, parts, tau = (light(0.4, 1), 2, 60e-12) if free else (light(0.4, 1), 4, 30e-12)
    fine_axis = TimeAxis.from_seconds(0.0, WIDTH / parts, BINS * parts)
    gate = GATE if gated else None
    fine_gate = GATE.repeat_interleave(parts) if gated else None
    if free:
        detectors = [sensing.FreeRunningSPAD(100, 150e-12, axis=a) for a in (AXIS, fine_axis)]
    else:
        detectors = [spad(AXIS, gate), spad(fine_axis, fine_gate)]
    coarse, fine = (obeyed(d, tau_s=tau, axis=a) for d, a in zip(detectors, (AXIS, fine_axis), strict=True))
    assert coarse._steps() > 1
    by_hand = fine((x / parts).repeat_interleave(parts, 1)).view(1, BINS, parts, 1, 1).sum(2)
    # detections are taken to be even in their bins, which are narrower by hand
    torch.testing.assert_close(coarse(x), by_hand, rtol=6e-3, atol=1e-4)
    torch.testing.assert_close(coarse.probabilities(x) * 100, coarse(x), rtol=1e-10, atol=0)
    drawn = coarse.sample(x.expand(1, BINS, 20, 1), torch.Generator().manual_seed(0)).mean(2, keepdim=True)
    assert bool(((drawn - coarse(x)).abs() < 5 * (coarse(x) / 20).sqrt() + 0.5).all())


@pytest.mark.slow
def test_pixels_of_several_levels_are_those_of_each():
    """Dim and bright ones together, in a batch, mapped by torch.func, and their derivatives."""
    module = obeyed(spad())
    x = torch.cat([light(0.1, 1), light(6.0, 1), light(0.3, 1)], -1)
    together = module(x)
    for i in range(3):
        torch.testing.assert_close(together[..., i : i + 1], module(x[..., i : i + 1]), rtol=1e-9, atol=1e-10)
    items = x.movedim(-1, 0).unsqueeze(-1)
    mapped = torch.func.vmap(module.expected)(items)
    torch.testing.assert_close(mapped.squeeze(-1).movedim(0, -1), together, rtol=1e-9, atol=1e-10)


@pytest.mark.slow
def test_transforms_of_detectors_with_dead_time():
    """Gradients mapped over pixels, of one level and of several: those of autograd."""
    detector = spad()
    weights = torch.linspace(-1, 2, BINS, dtype=torch.float64).view(-1, 1, 1)

    def value(v):
        return (detector.expected(v) * weights).sum()

    for bright in (0.2, 9.0):
        x = torch.cat([light(0.1, 1), light(bright, 1)], -1).movedim(-1, 0).unsqueeze(-1)
        mapped = torch.func.vmap(torch.func.grad(value))(x)
        along = torch.func.vmap(lambda v: torch.func.jvp(value, (v,), (torch.ones_like(v),))[1])(x)
        for i in range(2):
            leaf = x[i].clone().requires_grad_()
            (exact,) = torch.autograd.grad(value(leaf), leaf)
            torch.testing.assert_close(mapped[i], exact, rtol=1e-9, atol=1e-11)
            torch.testing.assert_close(along[i], exact.sum(), rtol=1e-8, atol=1e-10)


def test_light_without_pixels():
    empty = torch.zeros(1, BINS, 0, 2, dtype=torch.float64)
    for module in (spad(), sensing.SynchronousSPAD(5, dead_time_s=150e-12, axis=AXIS, grad="gaussian")):
        assert module(empty).shape == module.sample(empty).shape == module.variance(empty).shape == empty.shape
