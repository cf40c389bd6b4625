"""Interrupts below Mitsuba and Dr.Jit arrive as `KeyboardInterrupt`, and what comes after them is right."""

from __future__ import annotations

import random
import signal
import time

import drjit as dr
import mitsuba as mi
import pytest
import torch

import torchtransient as tt
from support.walks import before_each_turn
from tools.small_room import COLOUR, VARIANT, WALL_POSE, make_room
from torchtransient.plugins import _registry
from torchtransient.scene.variant import active_variant


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


def test_in_a_backward_pass(renderer, monkeypatch, level):
    out = renderer(seed=0).transient
    with monkeypatch.context() as patched:
        before_each_turn(patched, interrupt)
        with pytest.raises(KeyboardInterrupt):
            out.sum().backward(retain_graph=True)
    renderer.zero_grad()
    out.sum().backward()
    assert renderer.values[COLOUR].grad.abs().sum() > 0


def test_in_the_constructor_of_a_plugin(monkeypatch, level):
    scene = tt.load(make_room(), variant=VARIANT)
    with monkeypatch.context() as patched:
        patched.setattr("torchtransient.plugins.films.histogram.TransientHDRFilm._check", interrupt)
        with pytest.raises(KeyboardInterrupt):
            tt.render(scene, spp=1, seed=0)
    assert tt.render(scene, spp=1, seed=0).transient.sum() > 0


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


def test_errors_that_are_no_interrupts_stay_what_they_are(renderer, monkeypatch):
    def broken(*args, **kwargs):
        raise ValueError("a plain mistake")

    before_each_turn(monkeypatch, broken)
    with pytest.raises(tt.errors.SceneError, match="a plain mistake"):
        renderer(seed=0)


@pytest.mark.slow
def test_at_random_moments(level):
    """A timer in place of a user who presses control and C."""
    renderer = tt.TransientRenderer(make_room(), [COLOUR, WALL_POSE], spp=2, temporal_filter="tent")
    scene = mi.load_dict(make_room())
    params = mi.traverse(scene)
    image = tt.wrap(lambda params, seed: mi.render(scene, params, spp=2, seed=seed)[0], params)

    def backward():
        renderer(seed=0).transient.mean().backward()

    def traced():
        twin = tt.TransientRenderer(make_room(), [COLOUR, WALL_POSE], spp=2, temporal_filter="tent", freeze=False)
        twin(seed=0).transient.mean().backward()

    def wrapped():
        image({COLOUR: torch.full((3,), 0.5, requires_grad=True)}, seed=0).mean().backward()

    jobs = [backward, traced, wrapped, lambda: forward(renderer), lambda: tt.plan(make_room())]
    took = []
    for job in jobs:
        job()
        started = time.perf_counter()
        job()
        took.append(time.perf_counter() - started)
    expected, moments, interrupted = renderer(seed=0).transient.detach(), random.Random(0), 0
    previous = signal.signal(signal.SIGALRM, interrupt)
    try:
        for _ in range(100):
            n = moments.randrange(len(jobs))
            try:
                try:
                    signal.setitimer(signal.ITIMER_REAL, max(1e-4, moments.random() * took[n]))
                    jobs[n]()
                finally:
                    signal.setitimer(signal.ITIMER_REAL, 0)
            except KeyboardInterrupt:
                interrupted += 1
            assert mi.logger().log_level() == level and mi.variant() == VARIANT
            torch.testing.assert_close(renderer(seed=0).transient.detach(), expected)
    finally:
        signal.signal(signal.SIGALRM, previous)
    assert interrupted > 50


def test_in_dictionaries_that_mitsuba_loads(monkeypatch, level):
    """Also where the interrupt comes before the constructor's first line."""
    for place in ("torchtransient.plugins.films.histogram.TransientHDRFilm._check", "traceback.clear_frames"):
        with monkeypatch.context() as patched:
            patched.setattr(place, interrupt)
            room = make_room()
            if place.startswith("traceback"):
                room["sensor"]["film"]["temporal_bins"] = 0  # an error, and an interrupt on its way
            with pytest.raises(KeyboardInterrupt):
                mi.load_dict(room)
    assert mi.load_dict(make_room()) is not None


# --------------------------------------------------------------------------------------- interrupted changes of variant


def test_an_interrupted_change_of_the_variant_leaves_all_plugins_whole(monkeypatch):
    """Mitsuba calls nobody after a callback that raises, its own plugins among them."""
    mi.set_variant(VARIANT)
    plugins_of_all = _registry._load_all

    def once(variant):
        monkeypatch.setattr(_registry, "_load_all", plugins_of_all)
        _registry._state.variant = None
        raise KeyboardInterrupt

    monkeypatch.setattr(_registry, "_load_all", once)
    with pytest.raises(KeyboardInterrupt), active_variant("llvm_ad_mono"):
        raise AssertionError("never reached")
    assert mi.variant() == VARIANT
    assert tt.render(make_room(), spp=1, seed=0).transient.sum() > 0
    monkeypatch.setattr(_registry, "_load_all", once)
    with pytest.raises(KeyboardInterrupt):
        mi.set_variant("llvm_ad_mono")
    scene = tt.load(make_room(), variant="llvm_ad_mono")
    assert tt.render(scene, spp=1, seed=0).transient.sum() > 0
    for plugin in ("prb", "transient_path"):
        assert mi.load_dict({"type": plugin}).variant_name() == "llvm_ad_mono"


@pytest.fixture
def _interrupts_raise():
    """As from the keyboard: a process that a shell has started in the background ignores them."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("_interrupts_raise")
def test_an_interrupt_waits_for_a_change_of_the_variant(monkeypatch):
    mi.set_variant(VARIANT)
    done, before, change = [], signal.getsignal(signal.SIGINT), mi.set_variant

    def interrupted(variant):
        signal.raise_signal(signal.SIGINT)
        change(variant)
        done.append(variant)

    monkeypatch.setattr(mi, "set_variant", interrupted)
    with pytest.raises(KeyboardInterrupt), active_variant("llvm_ad_mono"):
        raise AssertionError("never reached")
    assert done == ["llvm_ad_mono", VARIANT] and mi.variant() == VARIANT
    assert signal.getsignal(signal.SIGINT) is before
