"""Derivatives of light from spheres and suns that are hardly ever drawn, or never: paths that hit them have to do."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchtransient as tt
from tools.small_room import GREY, WALL_POSE, make_room

VARIANT = "llvm_ad_mono"
SUN, SUN_VARIANT = "light.sun_direction", "llvm_ad_rgb"


def lit_by(light, two):
    room = make_room()
    del room["box"]
    room["integrator"]["max_depth"] = 2
    return room | {"light": light, "two": two}


def under_a_sphere(weight, keys, spp=2048):
    lamp = {"type": "area", "radiance": 5.0, "sampling_weight": weight}
    ball = {"type": "sphere", "center": [-1.0, 0.5, 3.0], "radius": 0.6, "emitter": lamp}
    room = lit_by(ball, {"type": "point", "position": [0.5, 0.5, 4.0], "intensity": 1.0})
    return tt.TransientRenderer(tt.load(room, variant=VARIANT), keys, spp=spp)


def wide_sun(weight):
    """So large that paths find it."""
    return {
        "type": "sunsky", "sun_direction": [0.3, 0.4, 0.7], "sun_aperture": 40.0, "sampling_weight": weight,
    }  # fmt: skip


def under_a_sun(weight, keys, spp=64):
    room = lit_by(wide_sun(weight), {"type": "point", "position": [0.5, 0.5, 4.0], "intensity": 1.0})
    return tt.TransientRenderer(tt.load(room, variant=SUN_VARIANT), keys, spp=spp)


def gradients(lit):
    lit(seed=0).steady.sum().backward()
    return {key: value.grad for key, value in lit.values.items()}


@pytest.mark.parametrize(
    ("lit", "other", "weight"),
    [
        pytest.param(under_a_sphere, WALL_POSE, 1e-6, marks=pytest.mark.slow),
        pytest.param(under_a_sun, SUN, 0.0, marks=pytest.mark.soak),
    ],
)
def test_a_length_beside_it_changes_no_derivative_by_an_albedo(lit, other, weight):
    """With the same random numbers; in both modes. The light was gone from the one, or 20 times too bright."""
    beside = lit(weight, [GREY, other])
    expected = gradients(lit(weight, [GREY]))[GREY]
    torch.testing.assert_close(gradients(beside)[GREY], expected, rtol=0.01, atol=0)

    values = {key: value.detach().clone() for key, value in beside.values.items()}
    towards = {GREY: torch.ones_like(values[GREY]), other: torch.zeros_like(values[other])}
    _, slope = torch.func.jvp(lambda values: beside(values, seed=0).steady.sum(), (values,), (towards,))
    torch.testing.assert_close(slope, expected.sum(), rtol=0.01, atol=0)


@pytest.mark.slow
def test_a_length_is_that_of_a_light_that_is_drawn():
    drawn, hit = (gradients(under_a_sphere(weight, [WALL_POSE]))[WALL_POSE][2, 3] for weight in (1.0, 0.0))
    assert float(hit) == pytest.approx(float(drawn), rel=0.1)  # of area measure, which is noisy at the limb: 2 to 5 %


@pytest.mark.slow
def test_the_direction_of_a_sun_is_that_of_one_that_is_drawn():
    """Its disk turns with it along the paths that hit it; at fixed directions hardly anything changed."""
    drawn, hit = (gradients(under_a_sun(weight, [SUN], spp=16384))[SUN].numpy() for weight in (1.0, 0.0))
    np.testing.assert_allclose(hit, drawn, atol=0.08 * np.abs(drawn).max())  # of one, 1.2 %; lost, a twentieth was left
