"""The index of refraction of every BSDF that next-event estimation can pass through."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from torchtransient.errors import SceneError
from torchtransient.plugins.bsdfs.refraction_table import RefractiveBSDFs, boundaries_of, index_of

VARIANT = "llvm_ad_mono"
DIFFUSE = {"type": "diffuse"}
GLASS = {"type": "roughdielectric", "int_ior": 1.5, "ext_ior": 1.0, "alpha": 0.1}
OURS = {**GLASS, "type": "diff_rough_dielectric"}


def scene_of(*bsdfs):
    return mi.load_dict({"type": "scene", **{f"s{i}": {"type": "sphere", "bsdf": b} for i, b in enumerate(bsdfs)}})


def across(table, scene, outside=True):
    """Relative index of every shape's BSDF for a connection through the surface."""
    pointers = mi.BSDFPtr([shape.bsdf() for shape in scene.shapes()])
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(pointers))
    si.wi.z = 1 if outside else -1
    return table.relative_index(pointers, si, mi.Vector3f(0, 0, -1 if outside else 1)).numpy()


def test_none_where_nothing_refracts_through_a_lobe():
    for bsdf in (
        DIFFUSE,
        {"type": "dielectric"},
        {"type": "thindielectric"},
        {"type": "diff_dielectric"},
        {"type": "hair"},
        {"type": "diff_hair", "sigma_a": 0.5},
    ):
        assert RefractiveBSDFs.from_scene(scene_of(bsdf)) is None
    assert RefractiveBSDFs.from_scene(scene_of({"type": "principled", "roughness": 0.5})) is None


@pytest.mark.parametrize(
    ("bsdf", "index"),
    [
        (GLASS, 1.5),
        (OURS, 1.5),
        ({"type": "mask", "opacity": 0.5, "b": GLASS}, 1.5),
        ({"type": "blendbsdf", "weight": 0.5, "a": DIFFUSE, "b": OURS}, 1.5),
        ({"type": "blendbsdf", "weight": 0.5, "a": GLASS, "b": OURS}, 1.5),
        ({"type": "bumpmap", "t": {"type": "checkerboard"}, "b": OURS}, 1.5),
        (
            {
                "type": "normalmap",
                "normalmap": {"type": "checkerboard"},
                "b": {"type": "mask", "opacity": 0.5, "b": GLASS},
            },
            1.5,
        ),
        ({"type": "principled", "spec_trans": 0.5, "eta": 1.3}, 1.3),
        # 0.08 * specular is the reflectance at normal incidence: ((n - 1) / (n + 1))^2 = 0.04.
        ({"type": "principled", "spec_trans": 0.5, "specular": 0.5}, 1.5),
    ],
)
def test_index(bsdf, index):
    scene = scene_of(DIFFUSE, bsdf, {"type": "dielectric", "int_ior": 2.0})
    table = RefractiveBSDFs.from_scene(scene).read()
    np.testing.assert_allclose(across(table, scene), [1, index, 1], rtol=1e-6)
    np.testing.assert_allclose(across(table, scene, outside=False), [1, 1 / index, 1], rtol=1e-6)


def test_same_side_is_the_same_medium():
    scene = scene_of(GLASS)
    table = RefractiveBSDFs.from_scene(scene).read()
    si = dr.zeros(mi.SurfaceInteraction3f, 2)
    si.wi.z = mi.Float(1, -1)
    pointers = mi.BSDFPtr([scene.shapes()[0].bsdf()] * 2)
    assert dr.all(table.relative_index(pointers, si, si.wi) == 1)


def test_shapes_of_groups_are_found():
    scene = mi.load_dict({
        "type": "scene",
        "group": {"type": "shapegroup", "s": {"type": "sphere", "bsdf": {**GLASS, "int_ior": 1.7}}},
        "instance": {"type": "instance", "ref": {"type": "ref", "id": "group"}},
    })  # fmt: skip
    si = scene.ray_intersect(mi.Ray3f([0, 0, 5], [0, 0, -1]))
    table = RefractiveBSDFs.from_scene(scene).read()
    assert table.relative_index(si.bsdf(), si, mi.Vector3f(0, 0, -1))[0] == pytest.approx(1.7)


def test_parts_with_different_indices_are_refused():
    blend = {"type": "blendbsdf", "weight": 0.5, "a": GLASS, "b": {**GLASS, "int_ior": 1.3}}
    with pytest.raises(ValueError, match=r"its parts have 1.3, 1.5"):
        RefractiveBSDFs.from_scene(scene_of(blend))


def test_parts_that_become_different_are_refused():
    scene = scene_of({"type": "blendbsdf", "weight": 0.5, "a": OURS, "b": {**OURS, "alpha": 0.2}})
    found = RefractiveBSDFs.from_scene(scene)
    found.read()
    params = mi.traverse(scene)
    params["s0.bsdf.bsdf_1.eta"] = mi.Float(1.3)
    params.update()
    with pytest.raises(ValueError, match=r"its parts have 1.3, 1.5"):
        found.read()


def test_reading_again_finds_new_values():
    scene = scene_of(OURS)
    found = RefractiveBSDFs.from_scene(scene)
    np.testing.assert_allclose(across(found.read(), scene), [1.5])
    params = mi.traverse(scene)
    params["s0.bsdf.eta"] = mi.Float(1.25)
    params.update()
    np.testing.assert_allclose(across(found.read(), scene), [1.25])


@dr.syntax
def _sum_of_slopes(table, pointers, si, wo):
    k = mi.UInt32(0) * mi.UInt32(dr.arange(mi.UInt32, dr.width(pointers)))
    total = mi.Float(0) * mi.Float(k)
    while dr.hint(k < 3):
        with dr.resume_grad():
            value = table.relative_index(pointers, si, wo)
            dr.backward_from(value)
        total += dr.detach(value)
        k += 1
    return total


@pytest.mark.parametrize("glass", [GLASS, OURS])
def test_derivative_inside_a_suspended_loop(glass):
    """As the reverse sweep uses it: read in a symbolic loop, with gradients resumed around the objective only."""
    scene = scene_of({"type": "mask", "opacity": 0.5, "b": glass})
    params = mi.traverse(scene)
    key = "s0.bsdf.nested_bsdf.eta"
    dr.enable_grad(params[key])
    params.update()
    si = dr.zeros(mi.SurfaceInteraction3f, 5)
    si.wi = mi.Vector3f(0, 0, mi.Float(1, 1, -1, -1, 1))
    wo = mi.Vector3f(0, 0, mi.Float(1, -1, 1, -1, -1))
    with dr.suspend_grad():
        table = RefractiveBSDFs.from_scene(scene).read()
        total = _sum_of_slopes(table, mi.BSDFPtr([scene.shapes()[0].bsdf()] * 5), si, wo)
    np.testing.assert_allclose(total.numpy(), [3, 4.5, 2, 3, 4.5], rtol=1e-6)
    assert dr.grad(params[key])[0] == pytest.approx(3 * (1 - 1 / 1.5**2 + 1), rel=1e-5)


@pytest.mark.parametrize("specular", [0.25, 0.5, 0.98])
def test_the_index_of_a_principled_surface_by_its_reflectance(specular):
    """8 % of `specular` at normal incidence."""
    bsdf = mi.load_dict({"type": "principled", "spec_trans": 0.5, "specular": specular})
    n = float(index_of(bsdf)[0])
    assert ((n - 1) / (n + 1)) ** 2 == pytest.approx(0.08 * specular, rel=1e-5)


def test_what_refracts_by_an_index_that_it_does_not_show():
    class Hidden(mi.BSDF):
        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.m_components = [mi.BSDFFlags.GlossyTransmission | mi.BSDFFlags.NonSymmetric | mi.BSDFFlags.FrontSide]
            self.m_flags = self.m_components[0]

    mi.register_bsdf("glass_without_index", Hidden)
    bsdf = mi.load_dict({"type": "glass_without_index", "id": "pane"})
    assert boundaries_of([bsdf])[0][1] is bsdf
    with pytest.raises(SceneError, match=r"BSDF 'pane' \(.*\) has a refractive lobe but no parameter 'eta'"):
        index_of(bsdf)
