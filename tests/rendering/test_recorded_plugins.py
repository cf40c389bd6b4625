"""Plugins of others under recorded calls: right whatever they keep and however they keep it, or traced."""

from __future__ import annotations

import itertools

import drjit as dr
import numpy as np
import pytest
import torch

import torchtransient as tt
from support import foreign_paint
from support.marks import long_rows
from tools.small_room import GREY, VARIANT, WALL_POSE, make_room
from torchtransient.rendering.recording import LAUNCHED, OWN_ENTRY
from torchtransient.scene.variant import active_variant

KEY = "wall.bsdf.value"


@pytest.fixture(autouse=True)
def variant():
    with active_variant(VARIANT):
        yield


def painted(kept, says=True, lazy=False):
    """The same room with a wall in the paint, traced and recorded."""
    room = make_room()
    room["wall"]["bsdf"] = {"type": foreign_paint.register(kept, says, lazy)}
    scene = tt.load(room, variant=VARIANT)
    return [tt.TransientRenderer(scene, parameters=[KEY], spp=2, physics="ignore", freeze=f) for f in (False, True)]


def steady(renderer, value):
    with torch.no_grad():
        out = renderer({KEY: torch.full_like(renderer.values[KEY], value)}, seed=0)
    return float(out.steady.sum()), out.stats.recorded[0]


# One of each kind of what is walked through; what does not say that it can be recorded is told whatever it keeps.
SAYS = [(kept, True) for kept in (
    "float", "NumPy", "array of Dr.Jit in a plain object"
)] + [("float", False)]  # fmt: skip


@pytest.mark.parametrize(("kept", "says"), long_rows(itertools.product(foreign_paint.KEPT, [False, True]), SAYS))
def test_whatever_a_plugin_keeps(kept, says):
    traced, recorded = painted(kept, says)
    said = []
    for value in (0.5, 0.5, 0.5, 0.9, 0.2):
        expected, _ = steady(traced, value)
        got, words = steady(recorded, value)
        assert got == pytest.approx(expected, rel=1e-5), (value, words)
        said.append(words)
    if not says:
        assert all("Paint does not say that it can be" in words for words in said)
    elif kept == "generator":
        assert all("cannot be told of a builtins.generator" in words for words in said)
    else:
        # Of the same number the kernels are launched; arrays that are handed over need not even be that.
        assert said[2] == LAUNCHED
        assert (said[3] == LAUNCHED) == (kept == "array of Dr.Jit in a plain object")


def test_an_attribute_that_changes_its_type_is_an_error():
    traced, recorded = painted("float", lazy=True)

    def fail():
        for value in (0.5, 0.5, 0.5, 0.9):
            steady(recorded, value)

    with pytest.raises(tt.errors.SceneError, match="changed the type of an attribute"):
        fail()
    # Nothing of it is left in the scene.
    fresh = painted("float", lazy=True)[0]
    assert steady(traced, 0.9)[0] == pytest.approx(steady(fresh, 0.9)[0], rel=1e-6)


def test_a_film_with_storage_of_its_own_is_not_lent_another():
    import drjit as dr
    import mitsuba as mi

    from torchtransient.plugins.films.histogram import TransientHDRFilm

    class OwnStorage(TransientHDRFilm):
        def prepare(self, aovs=(), samples=0):
            height, width = self.cube_shape()[:2]
            self.bands = [(0, height, dr.zeros(mi.Float, height * width * self.entries_per_pixel()))]
            self.steady, self.outside = dr.zeros(mi.Float, height * width * 3), dr.zeros(mi.Float, height * width * 2)
            return 3

    built = tt.load(make_room(), variant=VARIANT)
    renderer = tt.TransientRenderer(built, parameters=[GREY], spp=2)
    film = renderer.scene.built(renderer._options).scene.sensors()[0].film()
    assert film.can_borrow(2)
    film.__class__ = OwnStorage
    assert not film.can_borrow(2)
    assert "OwnStorage does not say" in renderer(seed=0).stats.recorded[0]


def test_a_render_of_an_integrators_own_is_called():
    from torchtransient.plugins.integrators.path import TransientPath

    calls = []

    class Own(TransientPath):
        def render(self, *args, **kwargs):
            calls.append(kwargs["seed"])
            return super().render(*args, **kwargs)

    scene = tt.load(make_room(), variant=VARIANT)
    renderer = tt.TransientRenderer(scene, parameters=[GREY], spp=2)
    expected = [renderer(seed=seed).steady for seed in range(3)]
    renderer.scene.built(renderer._options).scene.integrator().__class__ = Own
    for seed in range(3):
        out = renderer(seed=seed)
        torch.testing.assert_close(out.steady, expected[seed], rtol=1e-5, atol=1e-6)
        assert out.stats.recorded == (OWN_ENTRY,)
    assert calls == [0, 1, 2]


# -------------------------------------------------------------------------------------------- what is told apart


LOOSE = {
    "diffuse": {},
    "dielectric": {},
    "mask": {"opacity": {"type": "uniform", "value": 0.3}, "inner": {"type": "diffuse"}},
    "principled": {},
    "retroreflector": {},
    "uniform": {"value": 0.3},
    "bitmap": {"data": np.full((4, 4, 1), 0.5, np.float32), "raw": True},
    "constant": {},
    "area": {},
    "homogeneous": {},
    "hg": {},
    "perspective": {},
    "sphere": {"bsdf": {"type": "diffuse"}},
    "constvolume": {"value": 0.5},
    "transient_hdr_film": {},
}


ALONE = [pytest.param([kind], id=kind, marks=pytest.mark.slow) for kind in LOOSE]


@pytest.mark.parametrize("kinds", [pytest.param(list(LOOSE), id="all", marks=pytest.mark.slow), *ALONE])
def test_plugins_of_no_scene(kinds):
    """A method call is compiled for every plugin of a kind that is alive, of a scene or not."""
    import mitsuba as mi

    def made():
        return [mi.load_dict({"type": kind, **LOOSE[kind]}) for kind in kinds]

    before = made()
    traced, recorded = (
        tt.TransientRenderer(tt.load(make_room(), variant=VARIANT), parameters=[GREY], spp=2, freeze=freeze)
        for freeze in (False, True)
    )
    after = made()
    for seed in range(6):
        out, expected = recorded(seed=seed), traced(seed=seed)
        torch.testing.assert_close(out.transient, expected.transient, rtol=1e-5, atol=0)
        (found,) = torch.autograd.grad(out.transient.sum(), recorded.values[GREY])
        (wanted,) = torch.autograd.grad(expected.transient.sum(), traced.values[GREY])
        torch.testing.assert_close(found, wanted, rtol=1e-4, atol=0)
    assert out.stats.recorded == (LAUNCHED,)
    # They may go, and others come, between two calls.
    del before
    again = made() + made()
    del after
    for seed in range(6):
        out = recorded(seed=seed)
        torch.testing.assert_close(out.transient, traced(seed=seed).transient, rtol=1e-5, atol=0)
    assert out.stats.recorded == (LAUNCHED,) and again


def test_gradients_that_an_integrator_leaves_at_parameters_arrive():
    """Mitsuba's contract: ``render_backward`` adds gradients to the scene's parameters."""
    from torchtransient.plugins.integrators.path import TransientPath

    class Own(TransientPath):
        def render_backward(self, scene, params, grad_in, sensor=0, seed=0, spp=0):
            dr.accum_grad(params[WALL_POSE].matrix, 2.0)

    renderer = tt.TransientRenderer(tt.load(make_room(), variant=VARIANT), parameters=[WALL_POSE], spp=2)
    renderer.scene.built(renderer._options).scene.integrator().__class__ = Own
    renderer(seed=0).transient.sum().backward()
    assert renderer.values[WALL_POSE].grad.max() == 2
