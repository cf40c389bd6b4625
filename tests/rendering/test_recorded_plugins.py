"""Plugins of others under recorded calls: right whatever they keep and however they keep it, or traced."""

from __future__ import annotations

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from tools.small_room import GREY, VARIANT, WALL_POSE, make_room

KEY = "wall.bsdf.value"


class Slotted:
    __slots__ = ("gain",)

    def __init__(self, gain: float) -> None:
        self.gain = gain


# A number as a plugin may keep it: (made of it, read again).
KEPT = {
    "list": (lambda x: [x], lambda c: c[0]),
    "slots": (Slotted, lambda c: c.gain),
    "function": (lambda x: lambda: x, lambda c: c()),
    "NumPy": (lambda x: np.full(5000, x), lambda c: float(c[0])),
    "generator": (lambda x: (x for _ in range(10**6)), next),
    "array of Dr.Jit in a plain object": (lambda x: SimpleNamespace(gain=dr.opaque(mi.Float, x)), lambda c: c.gain),
}


def registered(kept, says):
    """Name of a diffuse BSDF in Python with one way of keeping, which says whether it can be recorded."""
    make, read = KEPT[kept]

    class Paint(mi.BSDF):
        can_be_recorded = says

        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.value = mi.Float(0.5)
            self.m_flags = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide
            self.m_components = [self.m_flags]
            self.parameters_changed()

        def traverse(self, cb):
            cb.put("value", self.value, +mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys=()):
            self.cache = make(float(np.array(mi.Float(dr.detach(self.value)))[0]))

        def gain(self):
            return mi.Float(read(self.cache))

        def sample(self, ctx, si, u, v, active=True):
            bs = dr.zeros(mi.BSDFSample3f)
            bs.wo = mi.warp.square_to_cosine_hemisphere(v)
            bs.pdf, bs.eta = mi.warp.square_to_cosine_hemisphere_pdf(bs.wo), mi.Float(1)
            bs.sampled_type = mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
            return bs, mi.Spectrum(self.gain()) & active

        def eval(self, ctx, si, wo, active=True):
            return mi.Spectrum(self.gain() * self.pdf(ctx, si, wo, active))

        def pdf(self, ctx, si, wo, active=True):
            return dr.select((si.wi.z > 0) & (wo.z > 0), mi.warp.square_to_cosine_hemisphere_pdf(wo), 0)

        def eval_pdf(self, ctx, si, wo, active=True):
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def to_string(self):
            return "Paint[]"

    name = f"paint_{abs(hash((kept, says)))}"
    mi.register_bsdf(name, Paint)
    return name


def painted(kept, says):
    """The same room with a wall in the paint, traced and recorded."""
    room = make_room()
    room["wall"]["bsdf"] = {"type": registered(kept, says)}
    scene = tt.load(room, variant=VARIANT)
    return [tt.TransientRenderer(scene, parameters=[KEY], spp=2, physics="ignore", freeze=f) for f in (False, True)]


def steady(renderer, value):
    with torch.no_grad():
        out = renderer({KEY: torch.full_like(renderer.values[KEY], value)}, seed=0)
    return float(out.steady.sum()), out.stats.recorded[0]


# What does not say that it can be recorded is told whatever it keeps.
SLOW = ("slots", "function", "generator")
KINDS = [("list", False), *(pytest.param(k, True, marks=pytest.mark.slow if k in SLOW else ()) for k in KEPT)]


@pytest.mark.parametrize(("kept", "says"), KINDS)
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
        assert said[2] == "launched"
        assert (said[3] == "launched") == (kept == "array of Dr.Jit in a plain object")


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
        assert out.stats.recorded == ("traced: the integrator has a render of its own",)
    assert calls == [0, 1, 2]


# -------------------------------------------------------------------------------------------- what is told apart


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
