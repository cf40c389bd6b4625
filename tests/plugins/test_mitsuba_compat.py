"""What Mitsuba 3.9.1 does wrong, on Mitsuba alone: a test that fails here says that Mitsuba has mended it.

Then the entry of ``plugins/mitsuba_compat.py`` and what asks for it can go. Below, what those entries answer.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from torchtransient import plugins
from torchtransient.plugins import mitsuba_compat as compat
from torchtransient.plugins import mitsuba_shapes
from torchtransient.plugins.bsdfs.mixtures import hides_lobe_probability, mirrors_matrices
from torchtransient.plugins.node_walk import objects_below, objects_of
from torchtransient.plugins.spectral_colours import keeps_coefficients

RGB, POLARIZED, SPECTRAL = "llvm_ad_rgb", "llvm_ad_mono_polarized", "llvm_ad_spectral"


def activate(variant):
    mi.set_variant(variant)
    plugins.sync()


def interaction(wi):
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi, si.sh_frame = mi.Vector3f(wi), mi.Frame3f(mi.Normal3f(0, 0, 1))
    return si


def unit(x, y, z):
    return dr.normalize(mi.Vector3f(x, y, z))


def matrix(value):
    return np.array([[float(value[i, j][0][0]) for j in range(4)] for i in range(4)])


# ------------------------------------------------------------------------------------------------- lobes and their pdf


def slopes_of_lobe(bsdf, sample1, attach):
    """Relative derivatives of (weight, density) of a sampled lobe."""
    x, wi = attach(mi.traverse(bsdf))
    dr.enable_grad(x)
    bs, weight = bsdf.sample(mi.BSDFContext(), interaction(wi(x)), mi.Float(sample1), mi.Point2f(0.3, 0.4))
    dr.set_grad(x, 1.0)
    dr.enqueue(dr.ADMode.Forward, x)
    dr.traverse(dr.ADMode.Forward)
    return float(dr.grad(weight)[0][0] / weight[0][0]), float(dr.grad(bs.pdf)[0] / bs.pdf[0])


def by_index(params):
    def wi(x):
        params["eta"] = x
        params.update()
        return unit(0.6, 0.0, 0.8)

    return mi.Float(1.5), wi


def by_direction(params):
    return mi.Float(0.8), lambda c: mi.Vector3f(dr.sqrt(1 - c * c), 0, c)


@pytest.mark.parametrize(("plugin", "attach"), [("thindielectric", by_index), ("plastic", by_direction)])
def test_delta_weights_lack_the_derivative_of_their_probability(plugin, attach):
    activate(RGB)
    bsdf = mi.load_dict({"type": plugin})
    weight, density = slopes_of_lobe(bsdf, 0.01, attach)
    # What is chosen in proportion to Fresnel's term has a weight without it: its derivative is all that is missing.
    assert abs(density) > 0.1 and abs(weight) < 0.3 * abs(density)
    assert hides_lobe_probability(bsdf)
    assert hides_lobe_probability(mi.load_dict({"type": "twosided", "bsdf": {"type": "plastic"}}))
    bumpy = {"type": "bumpmap", "texture": {"type": "bitmap", "data": mi.TensorXf(np.ones((2, 2, 1)))}}
    assert hides_lobe_probability(mi.load_dict({**bumpy, "bsdf": {"type": plugin}}))
    # Mixtures are asked part by part.
    assert not hides_lobe_probability(mi.load_dict({"type": "mask", "bsdf": {"type": plugin}}))


def test_blends_of_delta_lobes_have_wrong_values():
    activate(RGB)
    mirror = {"type": "conductor", "material": "none", "specular_reflectance": 0.9}
    paint = {"type": "diffuse", "reflectance": 0.5}
    bsdf = mi.load_dict({"type": "blendbsdf", "weight": 0.5, "a": paint, "b": mirror})
    n = 100_000
    u = mi.Float((np.arange(n) + 0.5) / n)
    si = interaction(unit(0.3, 0.0, 0.8))
    bs, weight = bsdf.sample(mi.BSDFContext(), si, u, mi.Point2f(0.3, 0.4))
    reflected = dr.mean(dr.select(mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta), weight.x, 0))
    # Half of the mirror: 0.45. What comes is divided by 1 / 2 and half of the density of the paint.
    assert abs(float(reflected[0]) - 0.45) > 0.02
    assert adds_up_wrongly(bsdf) and compat.weight_slot(bsdf) == "weight"
    assert not adds_up_wrongly(mi.load_dict({"type": "blendbsdf", "weight": 0.5, "a": paint, "b": paint}))


def adds_up_wrongly(bsdf):
    held = [part for _, part in objects_of(bsdf) if isinstance(part, mi.BSDF)]
    return compat.adds_up_wrongly(bsdf, held, objects_below(bsdf, mi.BSDF))


# -------------------------------------------------------------------------------------------------------- polarization


def slope_at_the_normal(bsdf):
    x = mi.Float(0)
    dr.enable_grad(x)
    wi = dr.normalize(mi.Vector3f(x, 0.5 * x, 1))
    _, weight = bsdf.sample(mi.BSDFContext(), interaction(wi), mi.Float(0.3), mi.Point2f(0.3, 0.4))
    total = mi.Float(0)
    for i in range(4):
        for j in range(4):
            total += (i + 4 * j + 1) * weight[i, j][0]
    if not dr.grad_enabled(total):
        return 0.0
    dr.backward_from(total)
    return float(dr.grad(x)[0])


@pytest.mark.parametrize("plugin", ["conductor", "dielectric", "polarizer", "retarder"])
def test_derivatives_at_normal_incidence_are_not_numbers(plugin):
    activate(POLARIZED)
    assert np.isnan(slope_at_the_normal(mi.load_dict({"type": plugin})))
    assert np.isfinite(slope_at_the_normal(mi.load_dict({"type": compat.POLARIZED_PLUGINS[plugin]})))


# ------------------------------------------------------------------------------------------- samples, lobes and tables


def clearcoat_slope(weight):
    """(derivative of a principled surface by its clearcoat, forward difference)."""
    bsdf = mi.load_dict({"type": "principled", "clearcoat": {"type": "uniform", "value": weight}})
    params = mi.traverse(bsdf)

    def value(x):
        params["clearcoat.value"] = x
        params.update()
        wi, wo = unit(0.3, 0.1, 0.9), unit(-0.3, -0.1, 0.9)
        return dr.sum(bsdf.eval(mi.BSDFContext(), interaction(wi), wo))

    x = mi.Float(weight)
    dr.enable_grad(x)
    dr.backward(value(x))
    return float(dr.grad(x)[0]), float(((value(mi.Float(weight + 0.1)) - value(mi.Float(weight))) / 0.1)[0])


def test_a_lobe_of_weight_zero_is_skipped():
    activate(RGB)
    at_zero, difference = clearcoat_slope(0.0)
    assert at_zero == 0 and difference > 0.1
    beside, difference = clearcoat_slope(1e-6)
    assert beside == pytest.approx(difference, rel=1e-3)
    assert 0 in compat.LOST_AT["Principled"]["clearcoat"]


@pytest.mark.parametrize("plugin", compat.METALS.values())
@pytest.mark.parametrize(("slot", "index"), [("eta", (0.0, 2.0)), ("k", (0.4, 0.0))])
def test_metals_lose_their_slopes_without_index_or_absorption(plugin, slot, index):
    activate("llvm_ad_mono")

    def reflected(x):
        numbers = {"eta": index[0], "k": index[1]}
        textures = {name: {"type": "uniform", "value": value} for name, value in numbers.items()}
        params = mi.traverse(bsdf := mi.load_dict({"type": plugin, **textures}))
        params[f"{slot}.value"] = x
        params.update()
        # Every facet that light reaches here is beyond the angle of total reflection.
        ctx, si = mi.BSDFContext(), interaction(unit(0.6, 0.0, 0.8))
        smooth = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta)
        return bsdf.sample(ctx, si, 0.5, mi.Point2f(0.5))[1] if smooth else bsdf.eval(ctx, si, unit(-0.6, 0.0, 0.8))

    x = mi.Float(0)
    dr.enable_grad(x)
    dr.backward(reflected(x)[0], flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
    change = float((reflected(mi.Float(0.01))[0] - reflected(mi.Float(0))[0])[0]) / 0.01
    assert dr.grad(x)[0] == 0 and abs(change) > 0.3
    assert compat.loses_slope_of_metal(slot, (index[0],) * 2, (index[1],) * 2)


@pytest.mark.parametrize(("cls", "black"), [(cls, n % 2) for n, cls in enumerate(compat.PLASTICS)])
def test_black_lobes_of_plastics_are_never_sampled(cls, black):
    activate(RGB)
    lobes = ("specular_reflectance", "diffuse_reflectance")
    samples = {}
    for plugin in (compat.PLASTICS[cls], compat.DIFFERENTIABLE_PLUGINS[compat.PLASTICS[cls]]):
        colours = {name: {"type": "uniform", "value": float(i != black)} for i, name in enumerate(lobes)}
        bsdf = mi.load_dict({"type": plugin, **colours})
        si = dr.zeros(mi.SurfaceInteraction3f, 1000)
        si.wi = unit(0.3, 0.1, 0.9)
        u = dr.linspace(mi.Float, 0, 1, 1000, endpoint=False)
        samples[plugin], _ = bsdf.sample(mi.BSDFContext(), si, u, mi.Point2f(0.3, 0.6))
    theirs, ours = (np.mean(np.array(bs.sampled_component) == black) for bs in samples.values())
    assert theirs == 0 and ours > 0.01
    assert compat.lost_at(mi.load_dict({"type": compat.PLASTICS[cls]}), lobes[black]) == (0,)


def test_two_sided_matrices_from_behind_are_those_of_the_front():
    activate(POLARIZED)
    metal = {"type": "roughconductor", "alpha": 0.3}
    one, both = mi.load_dict(metal), mi.load_dict({"type": "twosided", "bsdf": metal})
    wi, wo = unit(0.5, 0.2, 0.8), unit(-0.3, 0.4, 0.7)
    mirrored = [mi.Vector3f(v.x, v.y, -v.z) for v in (wi, wo)]
    front = matrix(one.eval(mi.BSDFContext(), interaction(wi), wo))
    behind = matrix(both.eval(mi.BSDFContext(), interaction(mirrored[0]), mirrored[1]))
    np.testing.assert_allclose(behind, front, rtol=1e-5)
    assert abs(front[3, 1]) > 0.1 * front[0, 0], "this pair of directions would not tell the hands apart"
    assert mirrors_matrices(both) and not mirrors_matrices(one)
    assert mirrors_matrices(mi.load_dict({"type": "mask", "bsdf": {"type": "twosided", "bsdf": metal}}))


# --------------------------------------------------------------------------------------------- indices, sides, spectra


def test_colours_are_kept_as_coefficients_in_spectral_variants():
    colour = [0.2, 0.5, 0.7]
    for variant, kept in ((RGB, False), (SPECTRAL, True)):
        activate(variant)
        texture = mi.load_dict({"type": "rgb", "value": colour})
        value = np.array(mi.traverse(texture)["value"]).ravel()
        assert np.allclose(value, colour) != kept
        assert keeps_coefficients(texture, "value") == kept
        pixels = mi.Bitmap(np.full((2, 2, 3), 0.3, dtype=np.float32))
        assert keeps_coefficients(mi.load_dict({"type": "bitmap", "bitmap": pixels, "raw": False}), "data") == kept


# ------------------------------------------------------------------------------------------------------ shapes, sensors


def test_merged_rectangles_have_no_bounds():
    activate(RGB)
    paint = {"type": "diffuse", "id": "paint"}
    parts = {
        f"part_{n}": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([0, 0, n]),
            "bsdf": {"type": "ref", "id": "paint"},
        }
        for n in range(2)
    }
    scene = mi.load_dict({"type": "scene", "paint": paint, "all": {"type": "merge", **parts}})
    (shape,) = scene.shapes()
    assert not shape.bbox().valid() and not scene.bbox().valid()
    np.testing.assert_allclose(np.array(mitsuba_shapes.bounds_of(shape).max), [1, 1, 1])
