"""Derivatives of light from spheres that are never drawn, or hardly ever: the paths that hit them have to do."""

from __future__ import annotations

import pytest
import torch

import torchtransient as tt
from torchtransient.testing.small_room import GREY, WALL_POSE, make_room

VARIANT = "llvm_ad_mono"


def renderer(weight, keys, spp=2048):
    room = make_room()
    del room["box"]
    room["integrator"]["max_depth"] = 2
    lamp = {"type": "area", "radiance": 5.0, "sampling_weight": weight}
    room["light"] = {"type": "sphere", "center": [-1.0, 0.5, 3.0], "radius": 0.6, "emitter": lamp}
    room["two"] = {"type": "point", "position": [0.5, 0.5, 4.0], "intensity": 1.0}
    return tt.TransientRenderer(tt.load(room, variant=VARIANT), keys, spp=spp)


def gradients(lit):
    lit(seed=0).steady.sum().backward()
    return {key: value.grad for key, value in lit.values.items()}


@pytest.mark.parametrize("weight", [0.0, 1e-6])
def test_a_length_beside_it_changes_no_derivative_by_an_albedo(weight):
    """With the same random numbers; in both modes. The light was gone from the one, or 20 times too bright."""
    beside = renderer(weight, [GREY, WALL_POSE])
    expected = gradients(renderer(weight, [GREY]))[GREY]
    torch.testing.assert_close(gradients(beside)[GREY], expected, rtol=0.01, atol=0)

    values = {key: value.detach().clone() for key, value in beside.values.items()}
    towards = {GREY: torch.ones_like(values[GREY]), WALL_POSE: torch.zeros(4, 4)}
    _, slope = torch.func.jvp(lambda values: beside(values, seed=0).steady.sum(), (values,), (towards,))
    torch.testing.assert_close(slope, expected.sum(), rtol=0.01, atol=0)


def test_a_length_is_that_of_a_light_that_is_drawn():
    drawn, hit = (gradients(renderer(weight, [WALL_POSE]))[WALL_POSE][2, 3] for weight in (1.0, 0.0))
    assert float(hit) == pytest.approx(float(drawn), rel=0.1)  # of area measure, which is noisy at the limb: 2 to 5 %
