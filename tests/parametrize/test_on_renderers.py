"""Parametrizations of a renderer's values, by keys with dots, through everything that happens to a module."""

from __future__ import annotations

import copy
import io

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


def parametrized(scene):
    made = tt.TransientRenderer(scene, KEYS, spp=4, temporal_filter="tent")
    register(made, COLOUR, Albedo())
    return register(made, WALL_POSE, AxisAnglePose(made.values[WALL_POSE]))


@pytest.fixture
def renderer(scene):
    return parametrized(scene)


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


def copies():
    def saved(module):
        file = io.BytesIO()
        torch.save(module, file)
        file.seek(0)
        return torch.load(file, weights_only=False)

    return {
        "deepcopy": copy.deepcopy,
        "copy": copy.copy,
        "torch.save": saved,
        "variation": lambda module: module.variation(temporal_filter="tent"),
    }


@pytest.mark.slow
@pytest.mark.parametrize("how", copies())
def test_copies_are_renderers_of_their_own(renderer, how):
    with torch.no_grad():
        original(renderer, COLOUR).add_(0.3)
    twin = copies()[how](renderer)
    assert isinstance(twin, tt.TransientRenderer) and repr(twin) == repr(renderer)
    assert [n for n, _ in twin.named_parameters()] == [n for n, _ in renderer.named_parameters()]
    assert torch.equal(light(twin), light(renderer))
    before = light(renderer).detach()
    shared = original(twin, COLOUR) is original(renderer, COLOUR)
    assert shared == (how == "copy")  # which shares its tensors, as copies of modules do
    with torch.no_grad():
        original(twin, COLOUR).add_(0.0 if shared else 1.0)
    remove(twin, COLOUR)
    remove(twin, WALL_POSE)
    assert type(twin) is tt.TransientRenderer
    assert torch.allclose(light(twin), before, rtol=1e-3) == shared
    assert torch.equal(light(renderer), before)
    light(renderer).sum().backward()
    assert original(renderer, WALL_POSE).grad.abs().max() > 0


def test_state_dict_and_optimiser_go_on(renderer, scene):
    def step(module, optimizer, seed):
        optimizer.zero_grad()
        light(module, seed).square().mean().backward()
        optimizer.step()

    optimizer = torch.optim.Adam(renderer.parameters(), lr=0.05)
    step(renderer, optimizer, 1)
    saved = copy.deepcopy((renderer.state_dict(), optimizer.state_dict()))
    step(renderer, optimizer, 2)
    other = parametrized(scene)
    again = torch.optim.Adam(other.parameters(), lr=0.05)
    other.load_state_dict(saved[0])
    again.load_state_dict(saved[1])
    step(other, again, 2)
    for key in KEYS:
        assert torch.allclose(original(other, key), original(renderer, key), rtol=1e-4, atol=1e-6)


def test_inside_of_another_module_and_twice(scene):
    holder = nn.ModuleDict({"scene": tt.TransientRenderer(scene, [COLOUR], spp=4), "net": nn.Linear(2, 2)})
    before = holder["scene"].values[COLOUR].detach().clone()
    register(holder, COLOUR, tt.parametrize.Bounded(-8.0, 8.0))
    register(holder, "net.weight", tt.parametrize.Bounded(-1.0, 1.0))
    register(holder, COLOUR, Albedo(margin=1e-3))  # of what the first one makes
    assert torch.allclose(holder["scene"].values[COLOUR], before, rtol=1e-5)
    assert len(holder["scene"].parametrizations[COLOUR.replace(".", "/")]) == 2
    assert bool((holder["net"].weight.abs() < 1).all())
    twin = copy.deepcopy(holder)
    assert torch.equal(light(twin["scene"]), light(holder["scene"]))


def test_what_is_wrong_is_said(renderer, plain):
    for call in (lambda: register(plain, "box.colour", Albedo()), lambda: original(plain, "box.colour")):
        with pytest.raises(UnknownKeyError, match=r"TransientRenderer has no parameter 'box\.colour'; there are"):
            call()
    with pytest.raises(SceneError, match="has no parametrization"):
        remove(plain, COLOUR)
    for key, kind, error, words in (
        (COLOUR, Albedo, ArgumentError, r"an nn\.Module, got type"),
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
