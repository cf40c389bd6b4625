"""``diff_rough_conductor`` against Mitsuba's ``roughconductor``, and the slopes that Mitsuba's metals lose."""

from __future__ import annotations

import itertools
import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import torchtransient as tt
from support.gradient_cases.cases_metals import slanted
from support.gradient_cases.scenes import mirror_room, room
from support.surface_samples import activate, directions, interaction
from torchtransient.errors import GradientError

MONO, POLARIZED = "llvm_ad_mono", "llvm_ad_mono_polarized"
LANES = 1000


def number(value):
    return {"type": "uniform", "value": value}


def entries(value):
    """The numbers of a BSDF value, the lane last."""
    dr.eval(value)  # in one kernel
    values = [value[i, j] for i in range(4) for j in range(4)] if mi.is_polarized else [value]
    return np.concatenate([np.broadcast_to(np.array(x), (len(x), LANES)) for x in values]).astype(float)


GGX, ALL_NORMALS = {"distribution": "ggx"}, {"sample_visible": False}
COLOURED = {"material": "Al", "specular_reflectance": 0.5}
ROUGH_METALS = [
    {"material": "Au", "alpha": 0.5},
    {**COLOURED, **GGX, "alpha_u": 0.1, "alpha_v": 0.4},
    {**COLOURED, **ALL_NORMALS, "alpha_u": 0.4, "alpha_v": 0.2},
    {"eta": number(0.5), "k": number(0.0), **GGX, **ALL_NORMALS, "alpha": 0.3},
    {"eta": number(0.2), "k": number(3.0), "alpha": 0.0},
    {},
]


# Of Mueller matrices, which take long to compile, one metal alone is in the default set.
CHOICES = [(MONO, slice(6)), (POLARIZED, slice(1, 2))]
LONG = [("llvm_ad_spectral_polarized", slice(1, 4))]


@pytest.mark.parametrize(("variant", "chosen"), CHOICES + [pytest.param(*c, marks=pytest.mark.slow) for c in LONG])
def test_rough_metal_equals_mitsubas(variant, chosen):
    activate(variant)
    si, wo = interaction(directions(1, LANES, -0.2)), directions(2, LANES, -0.2)
    u = mi.Point2f(*np.random.default_rng(3).random((2, LANES)).astype(np.float32))
    for metal in ROUGH_METALS[chosen]:
        ours, theirs = (mi.load_dict({"type": name, **metal}) for name in ("diff_rough_conductor", "roughconductor"))
        assert list(mi.traverse(ours).keys()) == list(mi.traverse(theirs).keys())
        assert (ours.flags(), ours.component_count()) == (theirs.flags(), theirs.component_count())
        for mode in (mi.TransportMode.Radiance, mi.TransportMode.Importance)[: 1 + mi.is_polarized]:
            ctx = mi.BSDFContext(mode)
            asked = [(b.eval(ctx, si, wo), b.pdf(ctx, si, wo), *b.eval_pdf(ctx, si, wo)) for b in (ours, theirs)]
            dr.eval(asked)  # in one kernel
            (got, density, *both), (expected, their_density, *_) = asked
            # Phases of a total reflection have a few digits less in Mitsuba's matrices.
            close = {"rtol": 2e-5, "atol": 1e-4 if mi.is_polarized else 1e-6}
            for value in (got, both[0]):
                np.testing.assert_allclose(entries(value), entries(expected), **close)
            for value in (density, both[1]):
                np.testing.assert_allclose(np.array(value), np.array(their_density), rtol=2e-5, atol=1e-6)
            (bs, got), (their_bs, expected) = (bsdf.sample(ctx, si, 0.3, u) for bsdf in (ours, theirs))
            dr.eval(bs, got, their_bs, expected)
            got, expected = entries(got), entries(expected)
            drawn = np.abs(expected).max(axis=0) > 0
            assert 0.5 < drawn.mean() < 1
            np.testing.assert_allclose(np.array(bs.wo)[:, drawn], np.array(their_bs.wo)[:, drawn], atol=1e-6)
            # Where all normals are drawn, one in the surface's plane has few digits left.
            np.testing.assert_allclose(got, expected, rtol=5e-4, atol=1e-4)
            np.testing.assert_allclose(np.array(bs.pdf)[drawn], np.array(their_bs.pdf)[drawn], rtol=5e-4, atol=1e-6)


# -------------------------------------------------------------------------------------------------------------- slopes


def reflectance(cosine, eta, k):
    """Of a metal to unpolarized light, in double precision; ``k`` from above."""
    root = np.sqrt(complex(eta, -k) ** 2 - (1 - cosine**2))
    root = -root if root.imag > 0 or root.real < 0 else root
    across = (cosine - root) / (cosine + root)
    along = (complex(eta, -k) ** 2 * cosine - root) / (complex(eta, -k) ** 2 * cosine + root)
    return (abs(across) ** 2 + abs(along) ** 2) / 2


def slope_of(plugin, slot, eta, k, cosine=0.7):
    """Derivative of the reflectance of one facet by ``slot``."""
    bsdf = mi.load_dict({"type": plugin, "eta": number(eta), "k": number(k)})
    params, x = mi.traverse(bsdf), mi.Float(eta if slot == "eta" else k)
    dr.enable_grad(x)
    params[f"{slot}.value"] = x
    params.update()
    sine = math.sqrt(1 - cosine**2)
    si, ctx = interaction(mi.Vector3f(sine, 0, cosine)), mi.BSDFContext()
    if plugin.endswith("rough_conductor") or plugin == "roughconductor":
        value = mi.unpolarized_spectrum(bsdf.eval(ctx, si, mi.Vector3f(-sine, 0, cosine)))[0]
        mirror = mi.load_dict({"type": "roughconductor"}).eval(ctx, si, mi.Vector3f(-sine, 0, cosine))
        value = value / dr.detach(mi.unpolarized_spectrum(mirror)[0])
    else:
        value = mi.unpolarized_spectrum(bsdf.sample(ctx, si, 0.5, mi.Point2f(0.5))[1])[0]
    dr.backward(value, flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
    return float(dr.grad(x)[0])


def true_slope(slot, eta, k, cosine=0.7):
    h = 1e-7
    step = (h, 0) if slot == "eta" else (0, h)
    near, far = (reflectance(cosine, eta + n * step[0], k + n * step[1]) for n in (1, 2))
    return (4 * near - 3 * reflectance(cosine, eta, k) - far) / (2 * h)


AT = [(0.0, 2.0), (1e-4, 2.0), (2e-3, 2.0), (0.4, 0.0), (0.4, 1e-4), (0.4, 1e-3), (0.2, 3.0), (1.5, 0.0), (1.5, 0.5)]


@pytest.mark.parametrize("variant", [MONO, POLARIZED])
@pytest.mark.parametrize("plugin", ["diff_conductor", "diff_rough_conductor"])
def test_slopes_of_metals(variant, plugin):
    activate(variant)
    for (eta, k), slot in itertools.product(AT, ("eta", "k")):
        right = true_slope(slot, eta, k)
        assert slope_of(plugin, slot, eta, k) == pytest.approx(right, rel=2e-4, abs=2e-5), (eta, k, slot)


OF_SLOTS = {"eta": (0.0, 2.0), "k": (0.4, 0.0)}


@pytest.mark.slow
@pytest.mark.parametrize(("plugin", "slot"), [("conductor", "eta"), ("roughconductor", "k")])
def test_a_described_metal_is_built_anew(plugin, slot):
    index = OF_SLOTS[slot]
    bsdf = {"type": plugin, "eta": number(index[0]), "k": number(index[1])}
    activate(MONO)
    scene = tt.load(slanted(bsdf) if slot == "k" else mirror_room(bsdf), variant=MONO)
    key = f"wall.bsdf.{slot}.value"
    info = scene.parameters()[key]
    assert info.differentiable and not info.biased and "diff_" in info.reason
    renderer = tt.TransientRenderer(scene, parameters=[key], spp=256)
    renderer(seed=0).steady.sum().backward()
    assert float(renderer.values[key].grad) < -1e-3


@pytest.mark.parametrize("plugin", ["conductor", "roughconductor"])
def test_mitsubas_own_is_refused_where_it_has_no_slope(plugin):
    activate(MONO)
    for index, slot in (((0.0, 2.0), "eta"), ((0.4, 0.0), "k")):
        scene = mi.load_dict(room({"type": plugin, "eta": number(index[0]), "k": number(index[1])}), optimize=False)
        params, x = mi.traverse(scene), mi.Float(index[slot == "k"])
        dr.enable_grad(x)
        params[f"wall.bsdf.{slot}.value"] = x
        params.update()
        film = scene.sensors()[0].film()
        adjoint = mi.TensorXf(np.ones(film.cube_shape(), dtype=np.float32))
        with pytest.raises(GradientError, match="diff_"):
            scene.integrator().render_backward(scene, params, (None, adjoint), seed=0, spp=4)
        params[f"wall.bsdf.{slot}.value"] = dr.detach(x)
        params.update()
