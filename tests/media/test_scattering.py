"""Scattering by phase functions: values and densities in closed form, colours, blends, and what is left to surfaces."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.marks import long
from support.media_scenes import rgb
from torchtransient.plugins.bsdfs.mixtures import mixtures_of
from torchtransient.plugins.kernel_arrays import registry_number
from torchtransient.plugins.transport import medium_scattering as scattering
from torchtransient.plugins.transport.strategy import Local
from torchtransient.plugins.transport.surface_scattering import Surface

VARIANT = "llvm_ad_rgb"
RATES = np.array([0.5, 1.25, 2.0])
ALBEDO = np.array([0.9, 0.4, 0.7])
# Three directions, and where light comes from: along -z, so that wi is (0, 0, 1).
OUT = np.array([[0.6, 0.0, -0.48], [0.0, 0.28, 0.6], [0.8, -0.96, 0.64]])


def henyey_greenstein(g):
    return lambda cos: (1 - g * g) / (4 * np.pi * (1 + g * g + 2 * g * cos) ** 1.5)


PHASES = {
    "backward": ({"type": "hg", "g": -0.35}, henyey_greenstein(-0.35)),
    "rayleigh": ({"type": "rayleigh"}, lambda cos: 3 / (16 * np.pi) * (1 + cos * cos)),
    "blend": (
        {"type": "blendphase", "weight": 0.3, "a": {"type": "hg", "g": 0.6}, "b": {"type": "rayleigh"}},
        lambda cos: 0.7 * henyey_greenstein(0.6)(cos) + 0.3 * PHASES["rayleigh"][1](cos),
    ),
}  # fmt: skip


def fog(phase, connected=True):
    return mi.load_dict(
        {"type": "homogeneous", "sigma_t": rgb(*(RATES / 4)), "albedo": rgb(*ALBEDO), "scale": 4.0, "phase": phase,
         "sample_emitters": connected}
    )  # fmt: skip


def in_medium(medium, lanes=3):
    mei = dr.zeros(mi.MediumInteraction3f, lanes)
    mei.medium, mei.wi = mi.MediumPtr(medium), mi.Vector3f(0, 0, 1)
    mei.sh_frame = mi.Frame3f(mi.Vector3f(0, 0, 1))
    mei.t = mi.Float(1)
    return mei


def asked(lanes=3):
    """(proposals, answers, step) as the surface leaves them."""
    proposal = Local(d=mi.Vector3f(OUT[:, np.arange(lanes) % 3]), active=mi.Bool([True] * lanes))
    answer = Local(value=mi.Color3f(7, 11, 13), pdf=mi.Float(17))
    step = Local(weight=mi.Color3f(0.2, 0.3, 0.4), out=mi.Vector3f(1, 2, 3), pdf=mi.Float(5), eta=mi.Float(1.5),
                 u_lobe=mi.Float(0.4), u_dir=mi.Point2f(0.3, 0.6),
                 delta=mi.Bool([True] * lanes))  # fmt: skip
    return [proposal, None], [answer, None], step


@pytest.mark.parametrize("name", long(PHASES, list(PHASES)[-1:]))
def test_scattering_in_a_medium(name, monkeypatch):
    """By the phase function times the scattering coefficient, colour by colour; elsewhere the surface's answers stay.
    What is drawn weighs the coefficient alone.
    """
    node, phase = PHASES[name]
    medium, coefficients = fog(node), RATES * ALBEDO
    world = Local(contents=Local(media=Local(emitter_sampling=True)))
    inside = mi.Bool([True, True, False])
    vertex = Local(mei=in_medium(medium), scatter=inside, goes_on=mi.Bool(True), u_phase=None)
    one = scattering.SurfaceOrMedium()
    one.blends = None
    proposals, answers, step = asked()
    one.scatter_in_volume(world, vertex, proposals, answers, step)
    there = np.array(inside)
    value = phase(OUT[2])
    expected = np.where(there, np.outer(coefficients, value), [[7], [11], [13]])
    np.testing.assert_allclose(np.array(answers[0].value), expected, rtol=1e-5)
    np.testing.assert_allclose(np.array(answers[0].pdf), np.where(there, value, 17), rtol=1e-5)
    assert answers[1] is None
    expected = np.where(there, coefficients[:, None], [[0.2], [0.3], [0.4]])
    np.testing.assert_allclose(np.array(step.weight), expected, rtol=1e-4)
    out, pdf = np.array(step.out, dtype=np.float64), np.array(step.pdf)
    np.testing.assert_allclose(pdf, np.where(there, phase(np.where(there, out[2], 0)), 5), rtol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(out[:, :2], axis=0), 1, rtol=1e-5)
    assert out[:, 2].tolist() == [1, 2, 3]
    assert np.array(step.eta).tolist() == [1, 1, 1.5]
    for mask in (step.delta, step.unconnected):
        assert np.array(mask).tolist() == [False, False, True]
    # Towards any direction, and with derivatives, it is the same.
    monkeypatch.setattr(Surface, "value_towards", lambda *a: (mi.Color3f(7, 11, 13), mi.Float(17)))
    monkeypatch.setattr(Surface, "eval_pdf", lambda *a: (mi.Color3f(7, 11, 13), mi.Float(17)))
    monkeypatch.setattr(Surface, "look_up_attached", lambda *a: None)
    vertex.v = Local(record_of=lambda name: {}, active=mi.Bool(True))
    one.look_up_attached(world, vertex, None)
    again = [one.value_towards(world, None, vertex, proposals[0].d, mi.Bool(True))]
    again += [one.eval_pdf(vertex, None, proposals[0].d, mi.Bool(True), sampled) for sampled in (False, True)]
    for value, pdf in again:
        np.testing.assert_allclose(np.array(value), np.array(answers[0].value), rtol=1e-6)
        np.testing.assert_allclose(np.array(pdf), np.array(answers[0].pdf), rtol=1e-6)


@pytest.mark.parametrize("all_do", [True, False])
def test_media_that_no_light_is_connected_to(all_do):
    """Their vertices are found by chance alone; those of other media, and surfaces, by both ways."""
    media = [fog({"type": "isotropic"}), fog({"type": "isotropic"}, connected=all_do)]
    mei = in_medium(media[0], 4)
    mei.medium = mi.MediumPtr([media[0], media[1], media[1], media[0]])
    world = Local(contents=Local(media=Local(emitter_sampling=all_do)))
    bsdf = Local(flags=lambda: mi.UInt32([0, 0, 0, int(mi.BSDFFlags.Smooth)]))
    vertex = Local(mei=mei, scatter=mi.Bool([True, True, False, False]), goes_on=mi.Bool(True), u_phase=None,
                   medium=mei.medium, bsdf=bsdf)  # fmt: skip
    one = scattering.SurfaceOrMedium()
    one.blends = None
    step = asked(3)[2]
    step.delta = mi.Bool([False, False, False, True])
    one.scatter_in_volume(world, vertex, [], [], step)
    assert np.array(step.unconnected).tolist() == [False, not all_do, False, True]
    assert np.array(one.connectable(world, vertex)).tolist() == [True, all_do, False, True]


class Given(scattering.SurfaceOrMedium):
    """A phase function that says what it is told."""

    def __init__(self, value, pdf):
        super().__init__()
        value, pdf, self.asked, self.numbers = mi.Color3f(mi.Float(value)), mi.Float(pdf), [], []

        def eval_pdf(ctx, mei, d, active):
            self.asked.append(np.array(active).tolist())
            return value, pdf

        def sample(ctx, mei, u, v, active):
            self.asked.append(np.array(active).tolist())
            return mi.Vector3f(0, 0, 1), value, pdf

        self.phase = Local(eval_pdf=eval_pdf, sample=sample)

    def _phase_and_scattering(self, mei, u, active):
        self.asked.append(np.array(active).tolist())
        self.numbers.append(u)
        return self.phase, mi.Color3f(*RATES.tolist())


def test_phase_functions_without_a_value(monkeypatch):
    """Too narrow for single precision, they have no light towards a given point; their own samples keep their ratio."""
    # A plain one; no value or density; no density; a value alone.
    one = Given([0.5, np.inf, 0.5, np.inf, np.nan], [2, np.inf, 0, 3, np.nan])
    world = Local(contents=Local(media=Local(emitter_sampling=True)))
    lanes = mi.Bool([True] * 5)
    vertex = Local(mei=None, scatter=lanes, goes_on=lanes, u_phase=None)
    proposals = [Local(d=mi.Vector3f(0, 0, 1), active=lanes)]
    answers, step = [Local(value=mi.Color3f(7), pdf=mi.Float(7))], asked()[2]
    step.delta = lanes
    one.scatter_in_volume(world, vertex, proposals, answers, step)
    np.testing.assert_allclose(np.array(answers[0].value), np.outer(RATES, [0.5, 0, 0.5, 0, 0]))
    assert np.array(answers[0].pdf).tolist() == [2, 0, 0, 3, 0]
    np.testing.assert_allclose(np.array(step.weight), np.outer(RATES, [0.5, 0, 0, 0, 0]))
    np.testing.assert_allclose(np.array(step.pdf), [2, 1e15, 0, 3, 1e15])
    monkeypatch.setattr(Surface, "value_towards", lambda *a: (mi.Color3f(7), mi.Float(7)))
    value, pdf = one.value_towards(world, None, vertex, mi.Vector3f(0, 0, 1), lanes)
    np.testing.assert_array_equal(np.array(value), np.array(answers[0].value))
    np.testing.assert_array_equal(np.array(pdf), np.array(answers[0].pdf))
    monkeypatch.setattr(Surface, "eval_pdf", lambda *a: (mi.Color3f(7), mi.Float(7)))
    vertex.phase, vertex.σ_s = Given([0.5, 2, 0.5, np.inf], [2, np.inf, 0, np.nan]).phase, mi.Color3f(*RATES.tolist())
    vertex.scatter = mi.Bool([True] * 4)
    for sampled in (False, True):
        value, pdf = one.eval_pdf(vertex, None, None, mi.Bool(True), sampled)
        np.testing.assert_allclose(np.array(value), np.outer(RATES, [0.5, *[1.0 * sampled] * 3]))
        assert np.array(pdf).tolist() == [2, *[1.0 * sampled] * 3]


def test_phase_functions_are_asked_where_light_scatters(monkeypatch):
    """Of lanes in a medium that go on, and whose connection does."""
    one = Given([0.5], [2])
    world = Local(contents=Local(media=Local(emitter_sampling=True)))
    vertex = Local(mei=None, scatter=mi.Bool([True, True, False, True]), goes_on=mi.Bool([True, True, True, False]),
                   u_phase="number")  # fmt: skip
    step = asked(4)[2]
    answers = [Local(value=mi.Color3f(7), pdf=mi.Float(7))]
    proposals = [Local(d=mi.Vector3f(0, 0, 1), active=mi.Bool([True, False, True, False]))]
    one.scatter_in_volume(world, vertex, proposals, answers, step)
    assert one.asked == [[True, True, False, False], [True, False, False, False], [True, True, False, False]]
    assert step.u_phase == "number"
    monkeypatch.setattr(Surface, "value_towards", lambda *a: (mi.Color3f(7), mi.Float(7)))
    monkeypatch.setattr(Surface, "eval_pdf", lambda *a: (mi.Color3f(7), mi.Float(7)))
    monkeypatch.setattr(Surface, "look_up_attached", lambda *a: None)
    active, both = mi.Bool([True, False, True, False]), [True, False, False, False]
    one.asked.clear()
    one.value_towards(world, None, vertex, mi.Vector3f(0, 0, 1), active)
    assert one.asked == [both, both]
    vertex.v = Local(record_of=lambda name: {"u_phase": "number"}, active=active)
    one.look_up_attached(world, vertex, None)
    one.eval_pdf(vertex, None, mi.Vector3f(0, 0, 1), active, False)
    assert one.asked[2:] == [both, both] and one.numbers == ["number"] * 3


@pytest.mark.parametrize("there", [False, True])
def test_blends_draw_a_number(there, monkeypatch):
    """At each vertex, and keep it; where there are no blends nothing is drawn."""
    for name in ("prepare", "arrive"):
        monkeypatch.setattr(Surface, name, lambda *a: None)
    monkeypatch.setattr(Surface, "fields", lambda *a: {"own": mi.Float})
    one, vertex = scattering.SurfaceOrMedium(), Local()
    blends = Local(read=lambda wanted: f"blends for {wanted}") if there else None
    one.prepare(Local(contents=Local(media=Local(phase_mixtures=blends)), wanted="slopes"))
    assert one.blends == ("blends for slopes" if there else None)
    one.arrive(None, None, vertex, Local(next_1d=lambda: 0.25))
    assert vertex.u_phase == (0.25 if there else None)
    assert set(one.fields(None)) == ({"own", "u_phase"} if there else {"own"})


COUNT = 800


@pytest.mark.parametrize("weight", [0.0, 0.02, 0.3, 1.0])
def test_blends_of_phase_functions(weight):
    """Where the weight has a derivative and is at an end, or about it, one part is drawn; on average value and slope
    are those of the blend. Between, and without a derivative, the blend is left whole.
    """
    node = {"type": "blendphase", "weight": weight, "a": {"type": "hg", "g": 0.6}, "b": {"type": "hg", "g": -0.35}}
    medium = fog(node)
    params = mi.traverse(medium)
    (key,) = (key for key in params.properties if "weight" in key)
    phase = medium.phase_function()
    for attached in (False, True):
        if attached:
            dr.enable_grad(params[key])
            params.update()
        met, mixtures = mixtures_of([phase], mi.PhaseFunction)
        assert met[0] is phase and len(met) == 3
        one = scattering.SurfaceOrMedium()
        one.blends = mixtures.read(Local(geometry=False))
        assert mixtures.read(None) is None and (one.blends is not None) == attached
    u = (dr.arange(mi.Float, COUNT) + 0.5) / COUNT
    mei = in_medium(medium, COUNT)
    part, σ_s = one._phase_and_scattering(mei, u, mi.Bool(True))
    out = mi.Vector3f(*OUT[:, 0].tolist())
    value, _ = part.eval_pdf(mi.PhaseFunctionContext(None), mei, out, mi.Bool(True))
    total = dr.sum(value * σ_s, axis=1) / COUNT
    a, b = (henyey_greenstein(g)(OUT[2, 0]) for g in (0.6, -0.35))
    np.testing.assert_allclose(np.array(total).ravel(), RATES * ALBEDO * ((1 - weight) * a + weight * b), rtol=2e-3)
    dr.backward(total[1])
    slope = np.array(dr.grad(params[key])).sum()
    assert slope == pytest.approx(RATES[1] * ALBEDO[1] * (b - a), rel=2e-3)
    numbers = np.array(dr.reinterpret_array(mi.UInt32, part))
    drawn = [(numbers == registry_number(node)).mean() for node in (phase, *met[1:])]
    share = np.clip(weight, 0.25, 0.75)
    np.testing.assert_allclose(drawn, [1, 0, 0] if weight == 0.3 else [0, 1 - share, share], atol=2e-3)
