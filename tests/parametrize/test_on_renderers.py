"""Parametrizations of a renderer's values, by keys with dots, through everything that happens to a module."""

from __future__ import annotations

import pytest
import torch
from torch import nn
from torch.nn.utils import parametrize as torch_parametrize

import torchtransient as tt
from tools.small_room import COLOUR, VARIANT, WALL_POSE, make_room
from torchtransient.errors import ArgumentError, SceneError, ShapeError, UnitError, UnknownKeyError
from torchtransient.parametrize import (
    Albedo,
    AxisAnglePose,
    PrincipledRoughness,
    Roughness,
    original,
    register,
    remove,
)

KEYS = [COLOUR, WALL_POSE]


@pytest.fixture(scope="module")
def scene():
    return tt.load(make_room(), variant=VARIANT)


@pytest.fixture
def plain(scene):
    return tt.TransientRenderer(scene, KEYS, spp=4, temporal_filter="tent")


@pytest.fixture
def renderer(scene):
    made = tt.TransientRenderer(scene, KEYS, spp=4, temporal_filter="tent")
    register(made, COLOUR, Albedo())
    return register(made, WALL_POSE, AxisAnglePose(made.values[WALL_POSE]))


def light(renderer, seed=3):
    return renderer(seed=seed).transient


def test_the_same_render_and_the_chain_rule(renderer, plain):
    first, second = light(renderer), light(plain)
    assert torch.allclose(first, second, rtol=1e-4, atol=1e-7 * second.abs().max().item())
    weights = torch.rand(first.shape, generator=torch.Generator().manual_seed(1))
    (first * weights).sum().backward()
    (second * weights).sum().backward()
    for key in KEYS:
        behind = original(renderer, key)
        value = getattr(renderer, key.replace(".", "/"))
        (known,) = torch.autograd.grad(value, behind, plain.values[key].grad)
        assert behind.grad.abs().max() > 0
        assert torch.allclose(behind.grad, known, rtol=2e-3, atol=1e-4 * known.abs().max().item())


def test_names_values_and_writing(renderer):
    names = dict(renderer.named_parameters())
    assert {name: tuple(p.shape) for name, p in names.items()} == {
        f"parametrizations.{COLOUR.replace('.', '/')}.original": (3,),
        f"parametrizations.{WALL_POSE.replace('.', '/')}.original": (6,),
    }
    renderer.values[COLOUR] = [0.1, 0.2, 0.3]
    assert torch.allclose(renderer.values[COLOUR], torch.tensor([0.1, 0.2, 0.3]))
    assert torch.allclose(original(renderer, COLOUR), torch.logit(torch.tensor([0.1, 0.2, 0.3])), atol=1e-6)
    before = original(renderer, COLOUR).detach().clone()
    with pytest.raises(UnitError, match="Albedo: expected values between 0 and 1"):
        renderer.values[COLOUR] = [0.1, 0.2, 1.3]
    assert torch.equal(original(renderer, COLOUR), before)
    given = torch.tensor([0.5, 0.5, 0.5], requires_grad=True)
    renderer({COLOUR: given}, seed=1).transient.sum().backward()  # values of a call are taken as they are
    assert given.grad.abs().min() > 0 and original(renderer, COLOUR).grad is None
    x = torch.tensor([0.3, -0.2, 0.1])
    name = f"parametrizations.{COLOUR.replace('.', '/')}.original"
    out = torch.func.functional_call(renderer, {name: x}, kwargs={"seed": 3}).transient
    assert torch.allclose(out, renderer({COLOUR: torch.sigmoid(x)}, seed=3).transient, rtol=1e-4, atol=1e-9)


def test_what_is_wrong_is_said(renderer, plain):
    for call in (lambda: register(plain, "box.colour", Albedo()), lambda: original(plain, "box.colour")):
        with pytest.raises(UnknownKeyError, match=r"TransientRenderer has no parameter 'box\.colour'; there are"):
            call()
    with pytest.raises(SceneError, match="has no parametrization"):
        remove(plain, COLOUR)
    for key, kind, error, words in (
        (COLOUR, Albedo, ArgumentError, r"expected an nn\.Module"),
        (COLOUR, AxisAnglePose(), ShapeError, r"AxisAnglePose: expected transforms \(\.\.\., 4, 4\)"),
        (COLOUR, nn.Unflatten(0, (1, 3)), ShapeError, f"Unflatten does not fit '{COLOUR}'"),
        (WALL_POSE, AxisAnglePose(), UnitError, "rigid motion of the base"),
    ):  # fmt: skip
        with pytest.raises(error, match=words):
            register(plain, key, kind)
    assert type(plain) is tt.TransientRenderer
    two = nn.ModuleList([renderer, plain])
    with pytest.raises(UnknownKeyError, match="several modules"):
        register(two, COLOUR, Albedo())
    register(two, f"1.{COLOUR}", Albedo())
    assert torch_parametrize.is_parametrized(plain, COLOUR.replace(".", "/"))


@pytest.mark.slow
def test_a_principled_roughness_has_a_clamp_of_its_own():
    """Below it, renders are the same and slopes are zero; from its lower end on, they are not."""
    key = "wall.bsdf.roughness.value"
    room = make_room()
    room["wall"]["bsdf"] = {"type": "principled", "roughness": 0.3, "metallic": 1.0}
    module = tt.TransientRenderer(tt.load(room, variant=VARIANT), [key], spp=16)
    with pytest.raises(SceneError, match="PrincipledRoughness"):
        register(module, key, Roughness())

    def slope(value):
        x = torch.tensor(value, requires_grad=True)
        (found,) = torch.autograd.grad(module({key: x}, seed=0).transient.square().sum(), x)
        return float(found)

    least = float(PrincipledRoughness().low)
    assert slope(0.99 * 0.001**0.5) == 0.0 and slope(least) != 0.0
    register(module, key, PrincipledRoughness())
    assert float(module.values[key].detach()) == pytest.approx(0.3, rel=1e-5)
