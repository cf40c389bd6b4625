"""Interrupts below Mitsuba and Dr.Jit arrive as `KeyboardInterrupt`, and what comes after them is right."""

from __future__ import annotations

import gc

import drjit as dr
import mitsuba as mi
import pytest
import torch

import torchtransient as tt
from support.walks import before_each_turn
from tools.small_room import COLOUR, VARIANT, WALL_POSE, make_room
from torchtransient.errors import SceneError, ShapeError


def interrupt(*args, **kwargs):
    raise KeyboardInterrupt


@pytest.fixture
def level():
    """Mitsuba's level of messages, which every test has to leave as it was."""
    mi.set_variant(VARIANT)
    before = mi.logger().log_level()
    yield before
    assert mi.logger().log_level() == before


@pytest.fixture(scope="module")
def renderer(room_scene):
    return tt.TransientRenderer(room_scene, [COLOUR], spp=2, freeze=False)


def forward(renderer):
    x = torch.ones(3)
    return torch.func.jvp(lambda x: renderer({COLOUR: x}, seed=0).transient, (x,), (x,))


CALLS = {
    "render": lambda renderer: renderer(seed=0),
    "forward": forward,
    "plan": lambda renderer: tt.plan(make_room()),
    "cost": lambda renderer: tt.cost_of_accuracy(renderer, spp=(2,)),
}


@pytest.mark.parametrize("call", CALLS)
def test_in_a_loop_that_is_traced(renderer, monkeypatch, level, call):
    expected = renderer(seed=0).transient
    with monkeypatch.context() as patched:
        before_each_turn(patched, interrupt)
        with pytest.raises(KeyboardInterrupt):
            CALLS[call](renderer)
    assert mi.variant() == VARIANT
    torch.testing.assert_close(renderer(seed=0).transient, expected)


def test_in_wrapped_functions(level):
    """Dr.Jit's own loops, and its own derivatives."""
    on = {"at": "nowhere"}

    @tt.wrap
    def doubled(x):
        count, found = mi.UInt32(0), mi.Float(x.array)

        def body(count, found):
            if on["at"] == "loop":
                raise KeyboardInterrupt
            return count + 1, found + mi.Float(x.array)

        if on["at"] == "function":
            raise KeyboardInterrupt
        return dr.while_loop((count, found), lambda count, found: count < 1, body, max_iterations=2)[1]

    x = torch.ones(2, requires_grad=True)
    for where in ("loop", "function"):
        on["at"] = where
        with pytest.raises(KeyboardInterrupt):
            doubled(x)
        on["at"] = "nowhere"
        y = doubled(x)
        assert y.tolist() == [2, 2]
        on["at"] = where
        with pytest.raises(KeyboardInterrupt):
            y.sum().backward(retain_graph=True)
        on["at"] = "nowhere"
        assert torch.autograd.grad(y.sum(), x)[0].tolist() == [2, 2]


def step(renderer, kind):
    """One call: a render, or a derivative in one of both modes."""
    value = renderer.values[WALL_POSE].detach()
    if kind == "forward":
        render = lambda pose: renderer({WALL_POSE: pose}, seed=1).transient  # noqa: E731
        return torch.func.jvp(render, (value,), (torch.eye(4),))[1]
    value.requires_grad_(kind == "backward")
    out = renderer({WALL_POSE: value}, seed=1).transient
    return torch.autograd.grad(out.square().sum(), value)[0] if kind == "backward" else out


@pytest.mark.parametrize(("kind", "place"), [
    ("render", "prepared"), ("backward", "start"), ("render", "run"), ("backward", "run"),
    pytest.param("forward", "run", marks=pytest.mark.slow),
])  # fmt: skip
def test_an_interrupted_call_leaves_nothing_behind(kind, place, monkeypatch):
    """Variant, lock and collector are as before, and so are the next call and the described values."""
    mi.set_variant("llvm_ad_mono")
    renderer = tt.TransientRenderer(tt.load(make_room(), variant=VARIANT), [WALL_POSE], spp=2, physics="ignore")
    expected = step(renderer, kind)
    with mi.variant_context(VARIANT):
        described = renderer.scene.built(renderer._options)
        integrator, at = type(described.scene.integrator()), mi.traverse(described.scene)
        before = {key: str(at[key]) for key in at.properties if "wall" in key}
        own, calls = getattr(integrator, place), []

        def interrupt(*args, **kwargs):
            calls.append(place)
            if len(calls) == (2 if kind == "backward" else 1):
                raise KeyboardInterrupt
            return own(*args, **kwargs)

        with monkeypatch.context() as patched:
            patched.setattr(integrator, place, interrupt)
            with pytest.raises(KeyboardInterrupt):
                step(renderer, kind)
    assert mi.variant() == "llvm_ad_mono" and gc.isenabled()
    assert torch.equal(step(renderer, kind), expected)
    with mi.variant_context(VARIANT):
        now = mi.traverse(renderer.scene.built(renderer._options).scene)
        assert {key: str(now[key]) for key in before} == before


@pytest.mark.parametrize("handled", [KeyboardInterrupt(), ShapeError("of another call")])
def test_calls_in_an_except_block_raise_their_own_errors(room_scene, monkeypatch, handled):
    def broken(*args, **kwargs):
        raise RuntimeError("a plain mistake")

    renderer = tt.TransientRenderer(room_scene, [COLOUR], spp=2, freeze=False)
    before_each_turn(monkeypatch, broken)
    try:
        raise handled
    except (KeyboardInterrupt, ValueError):
        with pytest.raises(SceneError, match="a plain mistake"):
            renderer(seed=0)
