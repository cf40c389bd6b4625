"""Mitsuba scenes that users and renderers share: edits count from the next call on, derivatives are of the call."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from tools.small_room import COLOUR, GREY, make_room
from tools.small_room import VARIANT as VARIANT

RED = torch.tensor([0.9, 0.1, 0.2])


@pytest.fixture
def shared():
    """A scene of Mitsuba's, its parameters, and two keys."""
    scene = mi.load_dict(make_room(), optimize=False)
    return tt.load(scene), mi.traverse(scene), COLOUR, GREY


def renderer(scene, *keys, **options):
    return tt.TransientRenderer(scene, list(keys), spp=4, physics="ignore", **options)


def test_edits_of_a_parameter_that_was_rendered_with_values_stay(shared):
    scene, params, key, _ = shared
    with_values, plain = renderer(scene, key), renderer(scene)
    for colour in (0.1, 0.6):
        with_values({key: RED}, seed=0)
        params[key] = mi.Color3f(colour)
        params.update()
        edited = plain(seed=0).transient
        with_values({key: RED}, seed=0)
        np.testing.assert_allclose(np.array(params[key]).ravel(), colour, rtol=1e-6)
        assert torch.equal(plain(seed=0).transient, edited)
        torch.testing.assert_close(with_values({key: torch.full((3,), colour)}, seed=0).transient, edited)
        assert np.allclose(scene.parameters()[key].value, colour)
        assert torch.allclose(renderer(scene, key).values[key], torch.full((3,), colour))


def test_derivatives_are_of_the_scene_at_the_call(shared):
    scene, params, key, other = shared
    render, slopes = renderer(scene, key, grad_seed=1), []
    held = float(np.ravel(params[other])[0])
    for changed in (held, 0.0):
        x = RED.clone().requires_grad_()
        out = render({key: x}, seed=0).transient.sum()
        params[other] = mi.Float(changed)
        params.update()
        out.backward()
        slopes.append(x.grad)
        assert float(np.ravel(params[other])[0]) == changed
    assert slopes[0].abs().sum() > 0
    torch.testing.assert_close(slopes[1], slopes[0])


def test_graphs_of_others_are_left_alone(shared):
    scene, params, key, other = shared
    render = renderer(scene, key)
    for attached in (key, other):
        dr.enable_grad(params[attached])
        params.update()
        x = RED.clone().requires_grad_()
        render({key: x}, seed=0).transient.sum().backward()
        assert x.grad.abs().sum() > 0
        assert dr.grad_enabled(params[attached]) and dr.all(dr.grad(params[attached]) == 0, axis=None)
