"""Densities and drawn directions of BSDFs carry no derivative, whatever is attached; weights do."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.surface_samples import directions, interaction, start
from torchtransient.plugins.bsdfs.mixtures import _random
from torchtransient.plugins.bsdfs.rough_coating import external_transmittance, internal_reflectance
from torchtransient.plugins.mitsuba_compat import DIFFERENTIABLE_PLUGINS


def uniform(value):
    return {"type": "uniform", "value": value}


# (description, what is attached)
SURFACES = {
    "plastic": ({"type": "diff_plastic", "int_ior": 1.4, "diffuse_reflectance": uniform(0.6)}, ["eta"]),
    "retroreflector": ({"type": "retroreflector", "share": 0.4, "alpha": 0.3}, ["share", "alpha", "reflectance.value"]),
    "hair": (
        {"type": "diff_hair", "longitudinal_roughness": 0.4, "azimuthal_roughness": 0.5, "sigma_a": uniform(0.3)},
        ["sigma_a.value", "longitudinal_roughness", "azimuthal_roughness", "eta"],
    ),
    "dielectric": ({"type": "diff_dielectric", "int_ior": 1.4}, ["eta"]),
    "principled": (
        {"type": "diff_principled", "clearcoat": uniform(0.5), "sheen": uniform(0.2), "metallic": uniform(0.3),
         "spec_trans": uniform(0.4), "eta": 1.4},
        ["clearcoat.value", "sheen.value", "metallic.value", "spec_trans.value", "base_color.value"],
    ),
    "thin principled": (
        {"type": "diff_principled_thin", "diff_trans": uniform(0.5), "spec_trans": uniform(0.4), "eta": 1.4},
        ["diff_trans.value", "spec_trans.value"],
    ),
}  # fmt: skip


@pytest.fixture(autouse=True)
def mono(request):
    start(request, "llvm_ad_mono")


def attached(name):
    """One of these surfaces, seen from several sides, with its parameters attached."""
    description, keys = SURFACES[name]
    bsdf = mi.load_dict(description)
    params = mi.traverse(bsdf)
    for key in keys:
        value = type(params[key])(params[key])
        dr.enable_grad(value)
        params[key] = value
    params.update()
    return bsdf


@pytest.mark.parametrize("name", SURFACES)
def test_densities(name):
    bsdf, ctx = attached(name), mi.BSDFContext()
    si, wo = interaction(directions(3, 50, 0.1)), directions(4, 50, 0.1)
    if "principled" not in name:  # whose density Mitsuba computes
        dr.enable_grad(wo)
    u = mi.Point2f(*np.random.default_rng(5).random((2, 50)).astype(np.float32))
    bs, weight = bsdf.sample(ctx, si, u.x, mi.Point2f(u.y, u.x))
    value, pdf = bsdf.eval_pdf(ctx, si, wo)
    refracts = name == "dielectric"  # what is refracted turns with the index
    assert not (dr.grad_enabled(bs.pdf) or dr.grad_enabled(pdf)) and dr.grad_enabled(bs.wo) == refracts
    assert not dr.grad_enabled(bsdf.pdf(ctx, si, wo))
    assert dr.grad_enabled(weight) and dr.grad_enabled(value) != refracts


@pytest.mark.parametrize("name", ["plastic", "retroreflector", "hair", "principled", "thin principled"])
def test_drawn_directions_do_not_turn_with_the_ray(name):
    bsdf = mi.load_dict(SURFACES[name][0])
    si = interaction(directions(3, 50, 0.1))
    dr.enable_grad(si.wi)
    u = mi.Point2f(*np.random.default_rng(5).random((2, 50)).astype(np.float32))
    bs, weight = bsdf.sample(mi.BSDFContext(), si, u.x, mi.Point2f(u.y, u.x))
    mirrored = name == "plastic"  # a mirror turns with what it mirrors
    assert dr.grad_enabled(weight) and dr.grad_enabled(bs.wo) == mirrored and not dr.grad_enabled(bs.pdf)


@pytest.mark.parametrize("table", [external_transmittance, internal_reflectance])
@pytest.mark.parametrize("attach", [(True, False), (False, True)])
def test_tables_are_the_same_with_derivatives(table, attach):
    """To the last bit, and with one entry of slope for each of their own."""
    alpha, eta = mi.Float(0.3), mi.Float(1.4)
    plain = np.array(table(alpha, eta, True))
    for value, wanted in zip((alpha, eta), attach, strict=True):
        if wanted:
            dr.enable_grad(value)
    found = table(alpha, eta, True)
    assert dr.grad_enabled(found) and np.array_equal(np.array(dr.detach(found)), plain)


@pytest.mark.parametrize("variant", ["llvm_ad_rgb"])
def test_what_stands_for_a_texture_varies_as_it(variant):
    from torchtransient.plugins.bsdfs.polarized_plastic import Reflectance  # a variant's classes
    from torchtransient.plugins.bsdfs.principled import Colour, Reading, Weight

    stripes = mi.load_dict({"type": "bitmap", "raw": True, "data": mi.TensorXf(np.float32([[[0.2], [0.7]]]))})
    plain = mi.load_dict({"type": "rgb", "value": [0.2, 0.3, 0.4]})
    for make in (Reflectance, lambda t: Weight("sheen", t, (0.0,), Reading()), lambda t: Colour(t, Reading())):
        assert make(stripes).is_spatially_varying() and not make(plain).is_spatially_varying()
    assert not Reflectance(None).is_spatially_varying()


TWINS = {"plastic": {}, "roughplastic": {"alpha": 0.2}, "pplastic": {"alpha": 0.2}, "conductor": {},
         "roughconductor": {}, "dielectric": {}, "roughdielectric": {}, "principled": {"spec_trans": 0.5, "sheen": 0.1},
         "principledthin": {"diff_trans": 0.5, "spec_trans": 0.5}}  # fmt: skip


@pytest.mark.parametrize("kind", TWINS)
def test_twins_have_the_lobes_of_mitsubas(kind):
    ours, theirs = (mi.load_dict({"type": name, **TWINS[kind]}) for name in (DIFFERENTIABLE_PLUGINS[kind], kind))
    lobes = [[bsdf.flags(i) for i in range(bsdf.component_count())] for bsdf in (ours, theirs)]
    assert len(lobes[0]) == len(lobes[1]) >= 1
    for one, other in zip(*lobes, strict=True):
        for flag in (mi.BSDFFlags.Reflection, mi.BSDFFlags.Transmission, mi.BSDFFlags.Delta, mi.BSDFFlags.Glossy,
                     mi.BSDFFlags.Diffuse, mi.BSDFFlags.FrontSide, mi.BSDFFlags.BackSide):  # fmt: skip
            assert mi.has_flag(one, flag) == mi.has_flag(other, flag)
            assert mi.has_flag(ours.flags(), flag) == mi.has_flag(theirs.flags(), flag)



@pytest.mark.parametrize("kind", ["diff_plastic", "diff_rough_plastic", "retroreflector", "diff_hair", "delayed"])
def test_values_and_densities_alone_are_those_of_both(kind):
    late = {"lifetime": 0.5, "quantum_yield": 0.3, "nested": {"type": "diffuse", "reflectance": 0.4}}
    settings = {"delayed": late, "diff_hair": {"sigma_a": uniform(0.3)}}.get(kind, {})
    bsdf, ctx = mi.load_dict({"type": kind, **settings}), mi.BSDFContext()
    si, wo = interaction(directions(3, 50, 0.1)), directions(4, 50, 0.1)
    value, pdf = (np.array(x) for x in bsdf.eval_pdf(ctx, si, wo))
    assert np.array_equal(np.array(bsdf.eval(ctx, si, wo)), value)
    assert np.array_equal(np.array(bsdf.pdf(ctx, si, wo)), pdf)
    assert value.max() > 0 and pdf.max() > 0 and not np.array_equal(value.ravel(), pdf)


@pytest.mark.parametrize("kind", ["plastic", "roughplastic", "pplastic", "dielectric", "roughdielectric"])
@pytest.mark.parametrize("given", [{}, {"specular_reflectance": 0.4}])
def test_twins_show_the_parameters_of_mitsubas(kind, given):
    ours, theirs = (
        {key.removesuffix(".value") for key in mi.traverse(mi.load_dict({"type": name, **given})).properties}
        for name in (DIFFERENTIABLE_PLUGINS[kind], kind)
    )
    assert ("specular_reflectance" in ours) == bool(given)
    assert theirs - {"specular_reflectance", "specular_transmittance"} <= ours


def test_whole_numbers_are_drawn_in_their_range():
    drawn = np.array(_random(mi.TensorXu8(np.zeros((40, 50, 3), dtype=np.uint8)), np.random.default_rng(2)))
    assert drawn.dtype == np.uint8 and drawn.shape == (40, 50, 3)
    assert 153 <= drawn.min() < 155 and 253 <= drawn.max() <= 255
    share = np.array(_random(mi.Float([0.0, 7.0, -3.0]), np.random.default_rng(2)))
    assert share.shape == (3,) and share.min() >= 0.6 and share.max() <= 1 and len(set(share)) == 3
