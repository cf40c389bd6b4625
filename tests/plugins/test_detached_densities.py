"""Densities and drawn directions of BSDFs carry no derivative, whatever is attached; weights do."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.surface_samples import directions, interaction, start


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


@pytest.mark.parametrize("number", [0.0, 1 - 2.0**-24])
@pytest.mark.parametrize("name", ["plastic", "retroreflector", "dielectric", "rough plastic", "rough dielectric"])
def test_a_lobe_that_is_asked_for_alone_is_drawn(name, number):
    """Whatever number decides; and the other one never is."""
    rough = {"type": "diff_" + name.replace(" ", "_"), "int_ior": 1.4, "alpha": 0.2}
    bsdf = mi.load_dict(SURFACES[name][0] if name in SURFACES else rough)
    si = interaction(mi.Vector3f(0.28, 0, 0.96))
    for component in (0, 1):
        ctx = mi.BSDFContext()
        ctx.component = component
        bs, weight = bsdf.sample(ctx, si, mi.Float(number), mi.Point2f(0.4, 0.3))
        assert list(bs.sampled_component) == [component] and weight[0][0] > 0 and bs.pdf[0] > 0
