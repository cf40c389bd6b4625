"""``retroreflector``: its density, energy and reciprocity, a plate seen from the lamp, and its derivatives."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from tools.small_room import make_room, pose

VARIANT = "llvm_ad_mono"


def surface(**settings):
    return mi.load_dict({"type": "retroreflector", **settings})


def seen_at(angle, count):
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.wi = mi.Vector3f(math.sin(angle) * 0.8, math.sin(angle) * 0.6, math.cos(angle))
    return si


@pytest.mark.parametrize(
    ("alpha", "share"), [(0.3, 0.6), pytest.param(0.15, 1.0, marks=pytest.mark.slow)]
)
def test_samples_have_the_density(alpha, share):
    from mitsuba.python.chi2 import BSDFAdapter, ChiSquareTest, SphericalDomain

    angle = 0.6
    wi = [math.sin(angle) * 0.8, math.sin(angle) * 0.6, math.cos(angle)]
    settings = f'<float name="alpha" value="{alpha}"/><float name="share" value="{share}"/>'
    sample, pdf = BSDFAdapter("retroreflector", settings, wi=wi)
    test = ChiSquareTest(SphericalDomain(), sample, pdf, sample_dim=3, sample_count=200_000, res=41, ires=8)
    assert test.run(), test.messages


@pytest.mark.parametrize(("angle", "alpha", "share"), [(0.0, 0.02, 1.0), (0.7, 0.3, 0.5), (1.4, 1.0, 1.0)])
def test_energy_and_weights(angle, alpha, share):
    """No more comes back than the reflectance says, and of narrow lobes all of it; value is weight times density."""
    bsdf, count = surface(alpha=alpha, share=share, reflectance=0.9), 1 << 16
    si, rng = seen_at(angle, count), mi.PCG32(count)
    ctx = mi.BSDFContext()
    bs, weight = bsdf.sample(ctx, si, rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32()))
    weight = np.array(weight[0])
    assert np.isfinite(weight).all() and weight.min() >= 0
    error = 4 * weight.std() / math.sqrt(count)
    assert weight.mean() <= 0.9 + error
    if alpha == 0.02 and angle < 1:
        assert weight.mean() == pytest.approx(0.9, abs=0.005)
    value, pdf = bsdf.eval_pdf(ctx, si, bs.wo)
    np.testing.assert_allclose(np.array(value[0]), weight * np.array(pdf), rtol=1e-3, atol=1e-6)
    assert np.allclose(np.array(pdf), np.array(bs.pdf), rtol=1e-5)


def test_reciprocity():
    count = 10_000
    rng, bsdf, ctx = mi.PCG32(count), surface(alpha=0.4, share=0.7), mi.BSDFContext()
    a, b = (mi.warp.square_to_cosine_hemisphere(mi.Point2f(rng.next_float32(), rng.next_float32())) for _ in range(2))
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.wi = a
    there = np.array(bsdf.eval(ctx, si, b)[0] / b.z)
    si.wi = b
    back = np.array(bsdf.eval(ctx, si, a)[0] / a.z)
    np.testing.assert_allclose(there, back, rtol=2e-4, atol=1e-6)
    si.wi = mi.Vector3f(0, 0, -1)
    assert not np.array(bsdf.eval(ctx, si, a)[0]).any()


def test_the_lobe_points_back():
    si = seen_at(0.8, 1)
    values = [float(surface(alpha=0.05).eval(mi.BSDFContext(), si, w)[0][0]) for w in (si.wi, mi.Vector3f(0, 0, 1))]
    mirrored = mi.Vector3f(-si.wi.x, -si.wi.y, si.wi.z)
    assert values[0] > 1e3 * max(values[1], float(surface(alpha=0.05).eval(mi.BSDFContext(), si, mirrored)[0][0]))


def plate(tilt, **surface_settings):
    """A plate, 3 m from a camera with a lamp in it."""
    room = make_room()
    del room["box"]
    turn = np.eye(4)
    turn[:3, :3] = [[math.cos(tilt), 0, math.sin(tilt)], [0, 1, 0], [-math.sin(tilt), 0, math.cos(tilt)]]
    room["wall"] |= {"to_world": pose(0, 0, 1.0) @ turn, "bsdf": surface_settings}
    room["light"]["position"] = [0.0, 0.0, 4.0]
    room["sensor"]["fov"] = 0.2
    room["integrator"]["max_depth"] = 2
    return room


@pytest.mark.parametrize("tilt", [0.0, 0.6])
def test_a_plate_seen_from_the_lamp_is_as_bright_as_the_closed_form(tilt):
    """Radiance I f cos / d^2, with f of the back vector along the normal: the share of GGX facets there."""
    alpha, reflectance, intensity, distance = 0.1, 0.8, 10.0, 3.0

    def brightness(**settings):
        scene = tt.load(plate(tilt, reflectance=reflectance, **settings), variant=VARIANT)
        return float(tt.render(scene, {}, spp=64, seed=0).steady.mean())

    seen = brightness(type="retroreflector", alpha=alpha)
    cosine = math.cos(tilt)
    masked = 2 / (1 + math.sqrt(1 + (alpha * math.tan(tilt)) ** 2))
    f = reflectance * masked**2 / (math.pi * alpha**2) / (4 * cosine**2)
    expected = intensity / distance**2 * f * cosine
    assert seen == pytest.approx(expected, rel=2e-3)
    assert seen / brightness(type="diffuse") == pytest.approx(masked**2 / (4 * alpha**2 * cosine**2), rel=2e-3)


@pytest.mark.parametrize(("key", "value"), [("share", 1.0), pytest.param("alpha", 0.2, marks=pytest.mark.slow)])
def test_derivatives_against_finite_differences(key, value):
    """With several bounces between the plate and the wall behind it."""
    room = make_room()
    room["box"]["bsdf"] = {"type": "retroreflector", "alpha": 0.2, "share": 0.5} | {key: value}
    room["wall"]["bsdf"] = {"type": "retroreflector", "alpha": 0.4, "share": 0.3}
    name = f"box.bsdf.{key}"
    scene = tt.load(room, variant=VARIANT)
    assert scene.parameters()[name].differentiable
    renderer = tt.TransientRenderer(scene, parameters=[name], spp=512, grad_seed="same", physics="ignore")
    out = renderer(seed=0).transient.sum()
    out.backward()
    found = float(renderer.values[name].grad)
    step = 0.01
    ends = [max(0.0, value - step), min(1.0, value + step)]
    with torch.no_grad():
        low, high = (float(renderer({name: torch.tensor(end)}, seed=0).transient.sum()) for end in ends)
    assert found == pytest.approx((high - low) / (ends[1] - ends[0]), rel=0.04) and abs(found) > 1e-3


@pytest.mark.parametrize("wrong", [{"share": 1.2}, {"alpha": 0.0}])
def test_wrong_numbers_are_refused(wrong):
    room = make_room()
    room["wall"]["bsdf"] = {"type": "retroreflector", **wrong}
    with pytest.raises(tt.errors.SceneError, match=f"retroreflector: expected an? '{next(iter(wrong))}'"):
        tt.TransientRenderer(tt.load(room, variant=VARIANT))


@pytest.mark.slow
def test_it_depolarizes():
    room = make_room()
    room["wall"]["bsdf"] = {"type": "retroreflector", "alpha": 0.3}
    stokes = tt.render(tt.load(room, variant="llvm_ad_mono_polarized"), {}, spp=8, seed=0).steady
    assert stokes[0].sum() > 0 and stokes[1:].abs().max() == 0


def test_its_diffuse_reflectance_is_that_of_the_rest():
    share = 0.7
    bsdf, count = surface(share=share, reflectance=0.8), 1 << 12
    ctx, rng = mi.BSDFContext(mi.TransportMode.Radiance, int(mi.BSDFFlags.Diffuse), 1), mi.PCG32(count)
    si = seen_at(0.5, count)
    sample = mi.Point2f(rng.next_float32(), rng.next_float32())
    weight = np.array(bsdf.sample(ctx, si, rng.next_float32(), sample)[1][0])
    assert np.array(bsdf.eval_diffuse_reflectance(si)[0])[0] == pytest.approx(weight.mean(), abs=1e-5)
    assert weight.mean() == pytest.approx(0.8 * (1 - share), abs=1e-5)
