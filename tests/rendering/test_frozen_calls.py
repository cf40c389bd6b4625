"""Recorded calls: the numbers of traced ones, whatever the scene, the order of calls and what goes wrong meanwhile."""

from __future__ import annotations

import sys
import warnings

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.marks import long
from tools.gradient_sweep.measure import Subject, quiet
from tools.gradient_sweep.settings import all_settings
from tools.small_room import COLOUR, GREY, VARIANT, WALL_POSE, make_room

# The same kernels but for the order of atomic sums: the last digits of single precision.
TOLERANCE = 2e-5
# One of each kind of thing that a scene can have, where recordings could go wrong in a way of its own.
FEW = (
    "bsdf roughdielectric in blendbsdf", "shape ply", "emitter area in sphere",
    "spectrum regular in reflectance, spectral", "phase hg in homogeneous", "bsdf conductor, mono_polarized",
)  # fmt: skip


def response(out):
    return next(t for t in (out.transient, out.phasor, out.gated, out.rates) if t is not None)


def compared(scene, key):
    """Largest difference of recorded to traced calls by scale, and the last words of renders and of derivatives."""
    subject = Subject(scene, key)
    tangent, worst = subject.tangents()[0], 0.0
    renderers = pair(scene, parameters=[key], spp=2)
    for seed, share in enumerate((0.0, 0.5, 1.0, -0.5, 0.25)):
        share = abs(share) if tangent.one_sided else share
        value, found = subject.value + share * tangent.step * tangent.direction, []
        for renderer in renderers:
            x = value.clone().requires_grad_()
            out = renderer({key: x}, seed=seed)
            weights = torch.cos(torch.arange(float(response(out).numel()))).reshape(response(out).shape)
            (gradient,) = torch.autograd.grad((response(out) * weights).sum() + out.steady.sum(), x)
            slope = torch.func.jvp(
                lambda x, renderer=renderer, seed=seed: response(renderer({key: x}, seed=seed)),
                (value,), (tangent.direction,),
            )[1]  # fmt: skip
            found.append([t.detach() for t in (out.steady, response(out), gradient, slope)])
        for expected, got in zip(*found, strict=True):
            difference = (got - expected).abs().max() / expected.abs().max().clamp_min(1e-12)
            worst = max(worst, float(difference.nan_to_num(torch.inf)))
    return worst, {out.stats.recorded[0], *out.stats.derivatives_recorded}


def check(setting, folder):
    """Return the words of the last calls of one parameter, after a comparison of their numbers."""
    with mi.variant_context(setting.variant), quiet(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = tt.load(setting.make(folder), variant=setting.variant)
        every = scene.parameters().differentiable()
        # A plugin without numbers that move (a sky by its date) is recorded as a part of what others move.
        key = ([key for key in every if setting.takes(key)] or list(every))[0]
        worst, said = compared(scene, key)
    assert worst < TOLERANCE, (key, worst, said)
    return said


def settings():
    """Every plugin alone, which is a sweep, and a few that stand for a kind of arrays each."""
    if mi.variant() is None:
        mi.set_variant(VARIANT)
    with mi.variant_context(VARIANT):
        found = all_settings()
    for one in found:
        if one.is_bare or one.name in FEW:
            yield pytest.param(one, id=one.name, marks=pytest.mark.slow if one.name in FEW else pytest.mark.soak)


@pytest.mark.parametrize("setting", list(settings()))
def test_numbers_of_traced_calls(setting, tmp_path):
    """Some plugins do not show Dr.Jit all of their arrays: their scenes are traced (docs/speed.md has a list)."""
    if setting.plugin == "timed_sunsky":
        # Not in Mitsuba's kernels either: it evaluates arrays while they are built.
        with pytest.raises(tt.errors.SceneError, match="describe a 'sunsky' at its time"):
            check(setting, tmp_path)
        return
    others = check(setting, tmp_path) - {"launched"}
    assert all(words.startswith("traced") for words in others) and not (others and setting.name in FEW)


# ------------------------------------------------------------------------------------------- films, batches, sensors

FILMS = {
    "histogram": {},
    "pulse": {"pulse": tt.Pulse.gaussian(0.3)},
    "phasors": {"frequencies": [0.0, 0.25, 0.5, 1.0]},
    "gates": {"gates": [tt.Gate.gaussian(8.0, 2.0), tt.Gate.gaussian(10.0, 2.0)]},
}


def pair(scene, **arguments):
    """The same renderer traced and recorded."""
    return [tt.TransientRenderer(scene, physics="ignore", freeze=freeze, **arguments) for freeze in (False, True)]


def step(renderer, seed, **values):
    """(render, gradients) of a squared loss."""
    renderer.zero_grad()
    out = renderer(values or None, seed=seed)
    (response(out).abs().square().sum() + out.steady.square().sum()).backward()
    return out, [parameter.grad.clone() for parameter in renderer.parameters() if parameter.grad is not None]


def same(a, b):
    scale = float(a.detach().abs().max())
    assert scale > 0
    torch.testing.assert_close(b, a, rtol=TOLERANCE, atol=TOLERANCE * scale)


@pytest.mark.parametrize("film", long(FILMS, ["histogram", "phasors", "gates"]))
def test_every_film(room_scene, film):
    traced, recorded = pair(room_scene, parameters=[COLOUR, GREY], spp=4, **FILMS[film])
    for seed in range(4):
        expected, of_traced = step(traced, seed)
        got, of_recorded = step(recorded, seed)
        same(response(expected), response(got))
        same(expected.steady, got.steady)
        for a, b in zip(of_traced, of_recorded, strict=True):
            same(a, b)
        assert got.stats.energy_after == pytest.approx(expected.stats.energy_after, rel=1e-4)
    assert got.stats.recorded == ("launched",) and got.stats.derivatives_recorded == ["launched"]
    off = "traced: freeze=False"
    assert expected.stats.recorded == (off,) and expected.stats.derivatives_recorded == [off]


def test_what_is_said():
    renderer = tt.TransientRenderer(tt.load(make_room(), variant=VARIANT), parameters=[COLOUR], spp=4)

    def kinds(*samples, **more):
        return [renderer(seed=0, spp=n, **more).stats.recorded[0].split(":")[0] for n in samples]

    assert kinds(4, 4, 4, 4) == ["traced", "recorded", "launched", "launched"]
    # Other samples are other kernels; coming back needs nothing.
    assert kinds(8, 8, 8, 4) == ["traced", "recorded", "launched", "launched"]
    assert renderer(seed=0, progress=True).stats.recorded[0] == "traced: progress is reported"
    with mi.variant_context(VARIANT), dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
        assert kinds(4, 4, 4) == ["traced"] * 3
    renderer.freeze = False
    assert kinds(4) == ["traced"]
    with (
        mi.variant_context(VARIANT),
        dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, False),
        pytest.raises(tt.errors.VariantError, match="SymbolicLoops"),
    ):
        renderer(seed=0)


@pytest.mark.slow
def test_batches_and_sensors(two_views):
    traced, recorded = pair(two_views, parameters=[COLOUR, GREY], spp=4, sensors="all")
    colours = torch.tensor([[0.9, 0.1, 0.3], [0.2, 0.8, 0.5], [0.4, 0.4, 0.4]])
    for seed in range(4):
        x, y = (colours.clone().requires_grad_() for _ in range(2))
        expected, got = traced({COLOUR: x}, seed=seed), recorded({COLOUR: y}, seed=seed)
        same(expected.transient, got.transient)
        for out in (expected, got):
            out.transient.square().sum().backward()
        same(x.grad, y.grad)
        same(traced.values[GREY].grad, recorded.values[GREY].grad)
    assert set(got.stats.recorded) == {"launched"} and len(got.stats.recorded) == 6
    assert set(got.stats.derivatives_recorded) == {"launched"}


@pytest.mark.slow
def test_forward_mode(room_scene):
    traced, recorded = pair(room_scene, parameters=[COLOUR, WALL_POSE], spp=4)
    tangent = torch.zeros(4, 4)
    tangent[2, 3] = 1.0
    for seed in range(4):
        pairs = []
        for renderer in (traced, recorded):
            values = {key: value.detach() for key, value in renderer.values.items()}

            def run(pose, renderer=renderer, values=values, seed=seed):
                return renderer({**values, WALL_POSE: pose}, seed=seed).transient

            pairs.append(torch.func.jvp(run, (values[WALL_POSE],), (tangent,)))
        same(pairs[0][0], pairs[1][0])
        same(pairs[0][1], pairs[1][1])


@pytest.fixture(scope="module")
def two_views():
    room = make_room()
    second = dict(room["sensor"])
    pose = np.array(second["to_world"]).copy()
    pose[0, 3] += 0.2
    return tt.load(room | {"sensor_b": second | {"to_world": pose}}, variant=VARIANT)


# --------------------------------------------------------------------------------------------- what is not recorded


def test_a_large_batch_is_rendered_in_place(monkeypatch, room_scene):
    # By the module: the package has a function of the name.
    for name in ("recording", "engine"):
        monkeypatch.setattr(sys.modules[f"torchtransient.rendering.{name}"], "LARGE_FILM", 1)
    colours = torch.tensor([[0.9, 0.1, 0.3], [0.2, 0.8, 0.5]])
    for film in ({}, {"gates": FILMS["gates"]["gates"]}):
        renderer = tt.TransientRenderer(room_scene, parameters=[COLOUR, GREY], spp=4, physics="ignore", **film)
        out = renderer({COLOUR: colours}, seed=5)
        for n, seed in enumerate(out.stats.seeds):
            single = renderer({COLOUR: colours[n]}, seed=seed)
            same(response(single), response(out)[n])
            same(single.steady, out.steady[n])
            assert out.stats.energy_after[n] == pytest.approx(single.stats.energy_after[0], rel=1e-4)


def test_what_dr_jit_cannot_record_is_traced(monkeypatch):
    """A plugin that reads numbers while it is traced: said once, right every time."""
    scene = tt.load(make_room(), variant=VARIANT)
    traced, recorded = pair(scene, parameters=[COLOUR, GREY], spp=4)
    with mi.variant_context(VARIANT):
        cls = type(recorded.scene.built(recorded._options).scene.integrator())
    offset = cls.offset_in_pixel

    def reading(self, film, sensor, sampler):
        found = offset(self, film, sensor, sampler)
        float(dr.opaque(mi.Float, 1.0)[0])
        return found

    monkeypatch.setattr(cls, "offset_in_pixel", reading)
    for seed in range(4):
        expected, got = step(traced, seed), step(recorded, seed)
        same(expected[0].transient, got[0].transient)
        same(expected[1][0], got[1][0])
    assert got[0].stats.recorded[0].startswith("traced: Dr.Jit cannot record it")


# ------------------------------------------------------------------------------------------------ bounds and warning


@pytest.mark.slow
def test_recordings_are_bounded_and_said(monkeypatch):
    monkeypatch.setattr(sys.modules["torchtransient.rendering.recording"], "MAX_STRUCTURES", 3)
    renderer = tt.TransientRenderer(tt.load(make_room(), variant=VARIANT), parameters=[COLOUR])

    def take_turns():
        for _ in range(5):
            for spp in range(1, 7):
                renderer(seed=0, spp=spp)

    with torch.no_grad(), pytest.warns(UserWarning, match="more than 3 kinds of calls take turns"):
        take_turns()
    kept = renderer.scene.recordings[renderer._options][(COLOUR,)]
    assert len(kept) == 3
    with warnings.catch_warnings(), torch.no_grad():  # once
        warnings.simplefilter("error")
        for spp in range(1, 10):
            renderer(seed=0, spp=spp)
