"""Surfaces are what they are, whichever key a derivative is asked for: twins of Mitsuba's BSDFs against the originals,
at the ends of the ranges of their parameters, and where the originals lose light there against what is beside the end.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.gradient_cases.scenes import room
from support.marks import long, long_rows
from support.surface_samples import start
from torchtransient.plugins.mitsuba_compat import COMPLETED_PLUGINS, DIFFERENTIABLE_PLUGINS

COUNT = 200_000
BLACK, WATER_AROUND = {"specular_reflectance": 0.0}, {"int_ior": 1.0, "ext_ior": 1.33}
ROUGH = [{"alpha": alpha, "distribution": kind} for alpha in (1e-3, 1.0) for kind in ("ggx", "beckmann")]
METALS = [{"eta": eta, "k": k} for eta in (0.0, 1e-4, 2.0) for k in (0.0, 1e-4, 5.0)]
PLASTICS = [
    {"int_ior": 3.0}, WATER_AROUND, {"diffuse_reflectance": 0.0}, {"diffuse_reflectance": 1.0}, BLACK,
    {"diffuse_reflectance": 1.0, **BLACK},
]  # fmt: skip
WEIGHTS = ("roughness", "sheen", "spec_tint", "sheen_tint", "flatness", "anisotropic", "base_color", "spec_trans")
ENDS = {
    "dielectric": [{"int_ior": 1.0, "ext_ior": 1.0}, {"int_ior": 1.000001, "ext_ior": 1.0}, WATER_AROUND, BLACK,
                   {"specular_transmittance": 0.0}],
    "roughdielectric": [*ROUGH, {"int_ior": 1.001, "ext_ior": 1.0}, WATER_AROUND, BLACK,
                        {"specular_transmittance": 0.0}],
    # Beyond an index of 2 Mitsuba's fit of the light inside gives more light than comes, and the twin does not.
    "plastic": [{"int_ior": 2.0}, *PLASTICS[1:], {"int_ior": 1.0, "ext_ior": 1.0},
                {"diffuse_reflectance": 1.0, "nonlinear": True}],
    "roughplastic": [*PLASTICS, *ROUGH, {"alpha": 0.0}, {"int_ior": 1.001, "ext_ior": 1.0},
                     {"diffuse_reflectance": 1.0, "nonlinear": True}],
    "pplastic": [*PLASTICS, {"alpha": 1e-3}, {"alpha": 1.0}, {"int_ior": 1.001, "ext_ior": 1.0}],
    "conductor": [{"material": "none"}, *METALS, BLACK],
    "roughconductor": [{"material": "none"}, *METALS, BLACK, {"alpha": 0.0}, {"alpha": 1.0}],
    "principled": [
        {"metallic": metallic, **end} for metallic in (0.0, 0.5, 1.0) for end in (
            {"specular": 1e-9}, {"specular": 1.0}, {"eta": 1.00001}, {"clearcoat": 1.0, "clearcoat_gloss": 1.0},
            *({name: end} for name in WEIGHTS for end in (0.0, 1.0)),
        )
    ],
    "principledthin": [{"eta": 1.0}, {"eta": 1.0, "spec_trans": 1.0}, {"diff_trans": 1.0}, {"diff_trans": 2.0},
                       *({name: end} for name in WEIGHTS for end in (0.0, 1.0))],
}  # fmt: skip


@pytest.fixture(autouse=True)
def _variant(request):
    start(request, "llvm_ad_mono")


def test_all_twins_are_compared():
    assert {*ENDS, *COMPLETED_PLUGINS} >= set(DIFFERENTIABLE_PLUGINS)


def scattered(bsdf):
    """Values between pairs of directions, mean weight of samples and its error."""
    rng, si = mi.PCG32(COUNT), dr.zeros(mi.SurfaceInteraction3f, COUNT)

    def plane():
        return mi.Point2f(rng.next_float32(), rng.next_float32())

    si.wi, wo = (mi.warp.square_to_uniform_sphere(plane()) for _ in range(2))
    with dr.suspend_grad():
        values = np.array(bsdf.eval(mi.BSDFContext(), si, wo), dtype=float)
        weights = np.array(bsdf.sample(mi.BSDFContext(), si, rng.next_float32(), plane())[1], dtype=float)
    return values, weights.mean(), weights.std() / np.sqrt(COUNT)


def asked_for_all(plugin, settings):
    """The twin in a job of derivatives by everything."""
    bsdf = mi.load_dict({"type": plugin, **settings})
    params = mi.traverse(bsdf)
    for key, value in list(params):
        if dr.is_array_v(value):
            attached = type(value)(value)
            dr.enable_grad(attached)
            params[key] = attached
    params.update()
    return bsdf


def check_alike(one, other, settings):
    (values, mean, error), (others, other_mean, other_error) = one, other
    assert np.abs(values - others).mean() <= 2e-4 * np.abs(others).mean() + 1e-9, settings
    assert abs(mean - other_mean) <= 4.5 * np.hypot(error, other_error) + 1e-4, settings


@pytest.mark.parametrize("plugin", long(ENDS, ["dielectric"]))
def test_a_twin_is_its_original_at_the_ends(plugin):
    """Seen by itself, and where derivatives by all of its parameters are asked for: then its samples are others."""
    twin = DIFFERENTIABLE_PLUGINS[plugin]
    for settings in ENDS[plugin]:
        original = scattered(mi.load_dict({"type": plugin, **settings}))
        check_alike(scattered(mi.load_dict({"type": twin, **settings})), original, settings)
        check_alike(scattered(asked_for_all(twin, settings)), original, settings)


@pytest.mark.parametrize(("end", "beside"), [({"specular": 0.0}, {"specular": 1e-7}), ({"eta": 1.0}, {"eta": 1.00001})])
def test_principled_surfaces_without_an_index_are_the_limit(end, beside):
    """Mitsuba loses all that is mirrored there, that of the metal too."""
    for more in ({"metallic": 0.5}, {"metallic": 1.0, "clearcoat": 1.0}, {"spec_tint": 1.0}):
        limit = scattered(mi.load_dict({"type": "principled", **beside, **more}))
        check_alike(scattered(mi.load_dict({"type": "diff_principled", **end, **more})), limit, more)
        check_alike(scattered(asked_for_all("diff_principled", {**end, **more})), limit, more)
    metal = mi.load_dict({"type": "principled", **end, "metallic": 1.0})
    assert scattered(metal)[1] == 0, "mended by Mitsuba: nothing needs to be exchanged"


METAL = {"type": "principled", "metallic": 0.5, "specular": 0.0}
HAIR = {"type": "hair", "sigma_a": 0.5, "longitudinal_roughness": 0.0}
ASKED = [(METAL, "metallic.value"), (METAL, "specular"), (HAIR, "longitudinal_roughness")]


@pytest.mark.parametrize(("bsdf", "key"), long_rows(ASKED, ASKED[:1]))
def test_pictures_do_not_depend_on_what_is_asked_for(bsdf, key):
    scene = tt.load(room(bsdf=bsdf, depth=3), variant="llvm_ad_mono")
    picture = tt.render(scene, spp=64, seed=2).steady
    value = torch.as_tensor(np.array(scene.parameters()[f"wall.bsdf.{key}"].value, dtype=np.float32))
    asked = tt.render(scene, {f"wall.bsdf.{key}": value}, spp=64, seed=2).steady
    assert picture.sum() > 0
    torch.testing.assert_close(asked, picture, rtol=1e-3, atol=1e-4 * float(picture.max()))
