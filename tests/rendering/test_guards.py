"""Interrupts, signals and the garbage collector around calls."""

import gc
import signal

import mitsuba as mi
import pytest
import torch

import torchtransient as tt
from support.walks import before_each_turn
from tools.small_room import COLOUR, VARIANT, WALL_POSE, make_room
from torchtransient.errors import SceneError, ShapeError
from torchtransient.plugins.drjit_pool import engine_lock
from torchtransient.plugins.guards import ensure_restored, interrupts_wait, no_collection
from torchtransient.scene.variant import active_variant


def step(renderer, kind):
    """One call: a render, or a derivative in one of both modes."""
    value = renderer.values[WALL_POSE].detach()
    if kind == "forward":
        render = lambda pose: renderer({WALL_POSE: pose}, seed=1).transient  # noqa: E731
        return torch.func.jvp(render, (value,), (torch.eye(4),))[1]
    value.requires_grad_(kind == "backward")
    out = renderer({WALL_POSE: value}, seed=1).transient
    return torch.autograd.grad(out.square().sum(), value)[0] if kind == "backward" else out


@pytest.mark.parametrize("kind", ["render", "backward", "forward"])
@pytest.mark.parametrize("place", ["prepared", "start", "run"])
def test_an_interrupted_call_leaves_nothing_behind(kind, place, monkeypatch):
    """Variant, lock and collector are as before, and so are the next call and the described values."""
    mi.set_variant("llvm_ad_mono")
    renderer = tt.TransientRenderer(tt.load(make_room(), variant=VARIANT), [WALL_POSE], spp=2, physics="ignore")
    expected = step(renderer, kind)
    with active_variant(VARIANT):
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
    assert mi.variant() == "llvm_ad_mono" and gc.isenabled() and not engine_lock._is_owned()
    assert torch.equal(step(renderer, kind), expected)
    with active_variant(VARIANT):
        now = mi.traverse(renderer.scene.built(renderer._options).scene)
        assert {key: str(now[key]) for key in before} == before


def test_settings_are_put_back_when_an_interrupt_cuts_that_off():
    done, interrupts = [], [KeyboardInterrupt()]

    def put_back():
        if interrupts:
            raise interrupts.pop()
        done.append(1)

    with pytest.raises(KeyboardInterrupt):
        ensure_restored(put_back)
    assert done == [1]


def test_the_collector_waits_in_every_block():
    """A progress report of Mitsuba's own render that renders with the library: a call inside of a trace."""
    seen = []
    with no_collection():
        tt.render(make_room(), spp=1, seed=0)
        seen.append(gc.isenabled())
    assert seen == [False] and gc.isenabled()


# ---------------------------------------------------------------------------------- calls in somebody's except block


@pytest.mark.parametrize(
    "handled", [KeyboardInterrupt(), ShapeError("of another call"), ValueError("of another call")]
)
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


@pytest.mark.parametrize("handled", [KeyboardInterrupt(), ShapeError("of another call")])
def test_scenes_that_are_loaded_in_an_except_block(handled):
    try:
        raise handled
    except (KeyboardInterrupt, ValueError):
        room = make_room()
        room["wall"] = {"type": "no_such_plugin"}
        with pytest.raises(RuntimeError, match="no_such_plugin"):
            mi.load_dict(room)
        with pytest.raises(SceneError, match="no_such_plugin"):
            tt.render(room, spp=1)


# --------------------------------------------------------------------------------------------------- signals that wait

KINDS = (signal.SIGTERM, signal.SIGALRM, signal.SIGUSR1)


@pytest.fixture
def handlers():
    """Signals that raise; what they were is put back."""
    before = {number: signal.getsignal(number) for number in KINDS}
    heard = []

    def hear(number, frame):
        heard.append(number)
        raise KeyboardInterrupt(number)

    for number in KINDS:
        signal.signal(number, hear)
    yield heard, hear
    for number, handler in before.items():
        signal.signal(number, handler)


def test_every_signal_that_waits_is_handled(handlers):
    heard, hear = handlers
    block = interrupts_wait()
    block.__enter__()
    for number in (*KINDS, signal.SIGALRM):
        signal.raise_signal(number)
    assert not heard
    with pytest.raises(KeyboardInterrupt):
        block.__exit__(None, None, None)
    assert sorted(heard) == sorted(KINDS)
    assert all(signal.getsignal(number) is hear for number in KINDS)


def test_signals_while_handlers_are_put_back(handlers, monkeypatch):
    """Each of them is put back, and heard, also where one has raised in between."""
    heard, hear = handlers
    own, put_back = signal.signal, []

    def interrupted(number, handler):
        found = own(number, handler)
        if handler is hear and number not in put_back:
            put_back.append(number)
            signal.raise_signal(number)
        return found

    monkeypatch.setattr(signal, "signal", interrupted)
    with pytest.raises(KeyboardInterrupt), interrupts_wait():
        pass
    monkeypatch.undo()
    assert set(put_back) == set(KINDS) <= set(heard)
    assert all(signal.getsignal(number) is hear for number in KINDS)
