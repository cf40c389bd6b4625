"""Gradients with an error: calibrated, and without one where the tail is heavy."""

import math

import pytest
import torch

import torchtransient as tt
from tools.small_room import COLOUR, VARIANT, WALL_POSE, make_room
from torchtransient.accuracy import gradient_errors


def late(out):
    t = torch.arange(out.transient.shape[-3])
    return (out.transient * torch.cos(t / 7.0)[:, None, None]).sum()


def renderer(keys=(COLOUR,), **settings):
    return tt.TransientRenderer(tt.load(make_room(), variant=VARIANT), list(keys), **{"spp": 16} | settings)


def test_errors_hold():
    """Squared distances from a long mean over squared errors, 16 measurements of 8 passes, three colours: the ratio
    deviates by some .35."""
    own = renderer()
    with torch.enable_grad():
        long = gradient_errors(own, late, spp=1024, passes=16, seed=99, tails=False, progress=False)[COLOUR].value
    residual = estimate = 0.0
    for seed in range(16):
        found = gradient_errors(own, late, seed=seed, tails=False, progress=False)[COLOUR]
        assert found.passes == 8 and found.spp == 16 and found.value.shape == long.shape
        residual += float((found.value - long).square().sum())
        estimate += float(found.standard_error.square().sum())
    assert 0.3 < residual / estimate < 2.5


def test_the_mean_is_a_gradient():
    """Of a loss that is quadratic in the colour, at the colour given, by key."""
    own = renderer([COLOUR, WALL_POSE])
    value = 0.5 * own.values[COLOUR].detach()
    found = gradient_errors(own, late, [COLOUR], values={COLOUR: value}, tails=False, progress=False)
    assert list(found) == [COLOUR]
    step = 1e-2

    def mean(colour):
        with torch.no_grad():
            return torch.stack([late(own({COLOUR: colour}, seed=seed, spp=64)) for seed in range(4)]).mean()

    slope = (mean(value + step) - mean(value - step)) / (2 * step)
    total = found[COLOUR].value.sum()
    assert float(total) == pytest.approx(float(slope), rel=0.1)
    assert " +- " in str(found[COLOUR])


def test_a_heavy_tail_has_no_error(monkeypatch):
    """The derivative of a root near zero has no variance: one run in many decides."""
    own = renderer(spp=4)

    def rare(out):
        x = out.transient.sum() / 1e3
        draw = torch.rand((), generator=torch.Generator().manual_seed(int(out.stats.seeds[0]) % 2**31))
        return x / draw.clamp(min=1e-9) ** 1.2

    found = gradient_errors(own, rare, passes=2, progress=False)[COLOUR]
    assert found.tail.heavy and math.isnan(float(found.standard_error.sum()))
    assert "heavy tailed: no error" in str(found)
