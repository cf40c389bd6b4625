"""Straight lines through several media, value and derivatives in both modes, by closed forms without noise."""

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.media_scenes import rgb
from support.runs import T

VARIANT = "llvm_ad_rgb"
RATES = {"a": np.array([0.5, 1.25, 2.0]), "b": np.array([0.7, 0.3, 1.1])}
ALBEDO, INTENSITY, LAMP = 0.6, 30.0, 5.25


def blocks():
    """A point of a wall, seen from the side; a block of fog above it, and one that the lamp stands in the middle of."""
    shapes = {
        name: {
            "type": "cube", "to_world": T().translate([0, 0, z]).scale(size), "bsdf": {"type": "null"},
            "interior": {"type": "homogeneous", "sigma_t": rgb(*RATES[name] / 4), "scale": 4.0, "albedo": 0.0},
        }
        for name, z, size in (("a", 3.0, 0.5), ("b", LAMP, 0.25))
    }  # fmt: skip
    film = {"type": "transient_hdr_film", "width": 1, "height": 1, "rfilter": {"type": "box"}, "temporal_bins": 40,
            "bin_width_opl": 0.25, "start_opl": 0.0, "temporal_filter": "tent"}  # fmt: skip
    sensor = {"type": "radiancemeter", "origin": [-1, 0, 1], "direction": [1, 0, -1], "film": film}
    wall = {"type": "rectangle", "to_world": T().scale(3), "bsdf": {"type": "diffuse", "reflectance": ALBEDO}}
    lamp = {"type": "point", "position": [0, 0, LAMP], "intensity": INTENSITY}
    integrator = {"type": "transient_prbvolpath", "max_depth": 2}
    scene = {"type": "scene", "integrator": integrator, "sensor": sensor, "wall": wall, "lamp": lamp, **shapes}
    return tt.load(scene, variant=VARIANT)


def radiance(a=RATES["a"], b=RATES["b"], z=LAMP):
    """Of a lamp at the height ``z`` in the upper block, which begins at 5; the lower one is a metre thick."""
    return ALBEDO / np.pi * INTENSITY / z**2 * np.exp(-a - b * (z - 5))


def test_light_through_two_blocks():
    """By what lies between both ends: all of the one block, and half of the other."""
    out = tt.TransientRenderer(blocks(), parameters=[], spp=4)(seed=0)
    np.testing.assert_allclose(out.steady.ravel(), radiance(), rtol=1e-4)
    arrival = out.transient.sum((0, 2, 3)).numpy()
    centers = (np.arange(40) + 0.5) * 0.25
    assert (arrival * centers).sum() / arrival.sum() == pytest.approx(2**0.5 + LAMP, rel=1e-3)


@pytest.mark.parametrize("name", RATES)
@pytest.mark.parametrize("forward", [False, True])
def test_derivatives_by_the_rates_of_two_blocks(name, forward):
    """Minus the length in the block, colour by colour."""
    key = f"{name}.interior_medium.sigma_t.value.value"
    renderer = tt.TransientRenderer(blocks(), parameters=[key], spp=4)
    length, weights = {"a": 1.0, "b": 0.25}[name], torch.tensor([2.0, 3.0, 5.0])
    rates = renderer.values[key].detach().clone()
    assert rates.shape == (3,)
    if forward:
        _, found = torch.func.jvp(lambda x: renderer({key: x}, seed=0).steady, (rates,), (weights,))
    else:
        (renderer(seed=0).steady.ravel() * weights).sum().backward()
        found = renderer.values[key].grad
    # The key is the rate before its scale of four.
    np.testing.assert_allclose(found.ravel(), -4 * length * radiance() * weights.numpy(), rtol=1e-3)


@pytest.mark.filterwarnings("ignore:the derivative by")  # of edges of shadows, which this line does not meet
@pytest.mark.parametrize("forward", [False, True])
def test_derivatives_by_the_place_of_a_lamp_in_a_block(forward):
    """Of the squared distance, and of the way in the block that it stands in; the other one changes nothing."""
    renderer = tt.TransientRenderer(blocks(), parameters=["lamp.position"], spp=4)
    place, up = renderer.values["lamp.position"].detach().clone(), torch.tensor([0.0, 0.0, 1.0])
    expected = (radiance(z=LAMP + 1e-6) - radiance(z=LAMP - 1e-6)) / 2e-6
    if forward:
        _, found = torch.func.jvp(lambda x: renderer({"lamp.position": x}, seed=0).steady, (place,), (up,))
        np.testing.assert_allclose(found.ravel(), expected, rtol=1e-3)
        return
    weights = torch.tensor([2.0, 3.0, 5.0])
    (renderer(seed=0).steady.ravel() * weights).sum().backward()
    found = renderer.values["lamp.position"].grad.ravel()
    assert found[2] == pytest.approx((expected * weights.numpy()).sum(), rel=1e-3)
    assert abs(found[:2]).max() < 1e-3 * abs(found[2])
