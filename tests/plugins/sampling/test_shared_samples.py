"""Shared samples: what Mitsuba says of the points, the albedo of both sides, sums that are areas."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.hidden_shapes import ball, mannequin, mesh, plate, scene_of, wall_grid
from torchtransient.errors import SceneError, UnitError, VariantError
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


def test_weights_sum_to_the_area():
    shapes = [mesh("body", mannequin(2)), mi.load_dict({"type": "sphere", "center": [1, 0, 1], "radius": 0.2})]
    table = HiddenElements(shapes, *wall_grid(3))
    total = [dr.sum(draw_samples(table, 1 << 12, seed).weight)[0] for seed in range(16)]
    area, error = table.elements.area.sum(), np.std(total, ddof=1) / 4
    # One over the density varies from element to element: the strata leave little of that.
    assert error < 5e-3 * area and abs(np.mean(total) - area) < 4 * error


def test_both_sides_and_both_albedos():
    sides = {name: {"type": "diffuse", "reflectance": albedo} for name, albedo in (("a", 0.2), ("b", 0.6))}
    shape = mi.load_dict({"type": "rectangle", "bsdf": {"type": "twosided", **sides}})
    samples = draw_samples(HiddenElements([shape], *wall_grid(3)), 8, 0)
    assert np.allclose(samples.front, 0.2 / np.pi) and np.allclose(samples.back, 0.6 / np.pi)


def test_interpolated_normals():
    shape = mesh("ball", ball((0, 0, 1), 0.5, 3), vertex_normals=True)
    samples = draw_samples(HiddenElements([shape], *wall_grid(3)), 512, 0)
    assert samples.smooth
    cos = np.array(dr.dot(samples.n, dr.normalize(samples.p - mi.Point3f(0, 0, 1))))
    flat = np.array(dr.dot(samples.geometric_n, dr.normalize(samples.p - mi.Point3f(0, 0, 1))))
    assert cos.min() > 0.9998 > 0.999 > flat.min()


def test_a_seed_in_memory_and_as_a_number_are_the_same():
    table = HiddenElements([mesh("body", mannequin(0))], *wall_grid(3))
    a, b = draw_samples(table, 64, 9), draw_samples(table, 64, dr.opaque(mi.UInt32, 9))
    assert dr.all(a.p == b.p, axis=None) and not dr.all(a.p == draw_samples(table, 64, 10).p, axis=None)


@pytest.mark.parametrize(
    "bsdf",
    [
        {"type": "roughconductor"},
        {"type": "mask", "nested": {"type": "diffuse"}, "opacity": 0.5},
        {"type": "twosided", "nested": {"type": "plastic"}},
        {"type": "bumpmap", "nested_texture": {"type": "checkerboard"}, "nested_bsdf": {"type": "diffuse"}},
    ],
    ids=lambda b: b["type"],
)
def test_other_surfaces_are_refused(bsdf):
    table = HiddenElements([mi.load_dict({"type": "rectangle", "id": "shiny", "bsdf": bsdf})], *wall_grid(3))
    with pytest.raises(SceneError, match="shiny"):
        draw_samples(table, 8, 0)


def test_arguments_are_checked():
    table = HiddenElements([mesh("m", plate(1, 1, (0, 0, 1)))], *wall_grid(2))
    with pytest.raises(UnitError, match="samples"):
        draw_samples(table, 0, 0)


def test_spectral_variants_are_refused():
    with mi.variant_context("llvm_ad_spectral"):
        table = HiddenElements([mi.load_dict({"type": "rectangle"})], *wall_grid(2))
        with pytest.raises(VariantError, match="spectral"):
            draw_samples(table, 8, 0)
