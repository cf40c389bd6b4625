"""The index of refraction of every BSDF that next-event estimation can pass through."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from torchtransient.plugins.bsdfs.refraction_table import RefractiveBSDFs

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
