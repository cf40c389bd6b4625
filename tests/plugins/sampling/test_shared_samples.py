"""Shared samples: what Mitsuba says of the points, the albedo of both sides, sums that are areas."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.hidden_shapes import scene_of, wall_grid
from torchtransient.plugins.sampling.hidden_elements import HiddenElements
from torchtransient.plugins.sampling.shared_samples import draw_samples

VARIANT = "llvm_ad_rgb"
CHECKS = {
    "type": "checkerboard",
    "color0": {"type": "rgb", "value": [0.1, 0.2, 0.3]},
    "color1": {"type": "rgb", "value": 0.8},
}
TEXTURED = {"type": "diffuse", "reflectance": CHECKS}


def textured_shapes():
    to_world = mi.ScalarTransform4f().translate([0.1, 0, 1.2]).rotate([0, 1, 0], 160).scale([0.4, 0.4, 0.4])
    turned = {"to_world": to_world, "bsdf": TEXTURED}
    return [mi.load_dict({"type": kind, **turned}) for kind in ("disk", "sphere", "cube")]


@pytest.mark.slow
def test_samples_are_mitsubas_surface_points():
    """Texture and normals are those that a ray finds there."""
    for shape in textured_shapes():
        samples = draw_samples(HiddenElements([shape], *wall_grid(3)), 1024, 5)
        ray = dr.zeros(mi.Ray3f, 1024)
        ray.o = mi.Point3f(samples.p + 1e-2 * mi.Vector3f(samples.geometric_n))
        ray.d, ray.maxt = -mi.Vector3f(samples.geometric_n), mi.Float(1)
        si = scene_of(shape).ray_intersect(ray)
        si.wi = mi.Vector3f(0, 0, 1)
        found = np.array(si.bsdf().eval(mi.BSDFContext(), si, si.wi))
        same = np.all(np.abs(found - np.array(samples.front)) < 1e-6, axis=0)
        # On the rims of checks and shapes the two may differ.
        assert same.mean() > 0.99, shape.class_name()
        hit = np.array(si.is_valid())
        assert np.abs(np.array(dr.dot(si.sh_frame.n, samples.n))[hit] - 1).max() < 1e-5
        assert not np.any(np.array(samples.back)) and np.unique(samples.front[0].numpy()) == pytest.approx(
            [0.1 / np.pi, 0.8 / np.pi]
        )
        assert np.all(np.array(samples.shape == mi.ShapePtr(shape))) and not samples.smooth


def test_both_sides_and_both_albedos():
    sides = {name: {"type": "diffuse", "reflectance": albedo} for name, albedo in (("a", 0.2), ("b", 0.6))}
    shape = mi.load_dict({"type": "rectangle", "bsdf": {"type": "twosided", **sides}})
    samples = draw_samples(HiddenElements([shape], *wall_grid(3)), 8, 0)
    assert np.allclose(samples.front, 0.2 / np.pi) and np.allclose(samples.back, 0.6 / np.pi)


