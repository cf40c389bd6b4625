"""Recorded calls beside scenes whose calls were cut off: Dr.Jit finds the arrays of every living plugin."""

from __future__ import annotations

import sys
import threading

import drjit as dr
import mitsuba as mi
import pytest
import torch

import torchtransient as tt
from tools.small_room import COLOUR, VARIANT, make_room
from torchtransient.plugins.frozen_state import WAITS
from torchtransient.rendering.recording import LAUNCHED, RECORDED
from torchtransient.scene.variant import active_variant


@pytest.fixture
def renderers(no_leftovers):
    """Of two scenes, and a render of the second one."""
    scenes = [tt.load(make_room(), variant=VARIANT) for _ in range(2)]
    first, second = (tt.TransientRenderer(scene, parameters=[COLOUR], spp=4) for scene in scenes)
    for seed in range(3):
        second(seed=seed)
    return first, second, second(seed=5).transient.detach()


def is_launched(renderer):
    """Whether calls are: where a plugin of another scene has come or gone, the next one is recorded once more."""
    said = [renderer(seed=seed).stats.recorded for seed in (5, 6, 7)]
    assert {word for words in said for word in words} <= {RECORDED, LAUNCHED}, said
    return said[-1] == (LAUNCHED,)


def scene_of(renderer):
    with active_variant(VARIANT):
        return renderer.scene.built(renderer._options).scene


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["render", "forward"])
@pytest.mark.parametrize("place", ["walk", "add_steady"])
def test_nobody_waits_for_what_an_interrupt_has_cut_off(renderers, monkeypatch, kind, place):
    """What the film was to hold is forgotten."""
    first, second, expected = renderers

    def call(seed):
        if kind == "render":
            return first(seed=seed)
        values = {COLOUR: first.values[COLOUR].detach()}
        tangents = {COLOUR: torch.ones_like(values[COLOUR])}
        return torch.func.jvp(lambda values: first(values, seed=seed).transient, (values,), (tangents,))

    call(0)
    loop = sys.modules["torchtransient.plugins.integrators.base"]  # the module of the active variant
    owner = loop if place == "walk" else type(scene_of(first).sensors()[0].film())
    plain = getattr(owner, place)

    def interrupted(*args, **kwargs):
        plain(*args, **kwargs)
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(owner, place, interrupted)
        with pytest.raises(KeyboardInterrupt):
            call(1)
    out = second(seed=5)
    torch.testing.assert_close(out.transient, expected)
    assert out.stats.recorded in ((RECORDED,), (LAUNCHED,)) and is_launched(second)


def test_a_call_is_traced_while_an_array_of_a_plugin_waits(renderers):
    """For a thread that has ended, for instance; once it is gone, calls are launched again."""
    first, second, expected = renderers
    first(seed=0)
    film = scene_of(first).sensors()[0].film()

    def write():
        with active_variant(VARIANT):
            film.steady = dr.zeros(mi.Float, 64)
            dr.make_opaque(film.steady)
            dr.scatter_add(film.steady, mi.Float(1), mi.UInt32([1, 5]))

    thread = threading.Thread(target=write)
    thread.start()
    thread.join()
    assert film.steady.state == dr.VarState.Dirty
    out = second(seed=5)
    torch.testing.assert_close(out.transient, expected)
    assert out.stats.recorded == (f"traced: Dr.Jit cannot record it: {WAITS}",)
    film.clear()
    assert is_launched(second)
