"""Points drawn on hidden geometry: where they lie, how often, and with which density."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.hidden_shapes import mannequin, mesh, plate, scene_of, wall_grid
from support.marks import long
from torchtransient.plugins.sampling.hidden_elements import HiddenElements

VARIANT = "llvm_ad_rgb"
COUNT = 1 << 14


def turned(*scale):
    return mi.ScalarTransform4f().translate([0.1, -0.2, 1.3]).rotate([1 / 3, 2 / 3, 2 / 3], 200).scale(list(scale))


# Shape, its area. Spheres and cylinders take no other transforms.
SHAPES = {
    "rectangle": ({"type": "rectangle", "to_world": (0.5, 1.5, 2.0)}, 4 * 0.75),
    "mirrored rectangle": ({"type": "rectangle", "to_world": (-0.5, 1.5, 2.0)}, 4 * 0.75),
    "disk": ({"type": "disk", "to_world": (0.5, 1.5, 2.0)}, np.pi * 0.75),
    "sphere": ({"type": "sphere", "to_world": (0.5, 0.5, 0.5)}, np.pi),
    "flipped sphere": ({"type": "sphere", "to_world": (0.5, 0.5, 0.5), "flip_normals": True}, np.pi),
    "cylinder": ({"type": "cylinder", "to_world": (0.5, 0.5, 2.0)}, 2 * np.pi),
    "mirrored cylinder": ({"type": "cylinder", "to_world": (0.5, 0.5, -2.0)}, 2 * np.pi),
    "cube": ({"type": "cube", "to_world": (0.5, 1.0, 2.0)}, 8 * (0.5 + 1 + 2)),
}  # fmt: skip


def random_points(count, seed=3):
    return mi.Point2f(np.random.default_rng(seed).random((2, count)).astype(np.float32))


def shape_of(name):
    description, area = SHAPES[name]
    return mi.load_dict(description | {"to_world": turned(*description["to_world"])}), area


@pytest.mark.parametrize("name", long(SHAPES, list(SHAPES)[::5]))
def test_draws_lie_on_the_shape_with_its_normals(name):
    shape, area = shape_of(name)
    scene = scene_of(shape)
    table = HiddenElements([shape], *wall_grid(3))
    p, n = table.draw(random_points(COUNT))
    length = 1e-2
    ray = dr.zeros(mi.Ray3f, COUNT)
    ray.o, ray.d = mi.Point3f(p + length * mi.Vector3f(n)), -mi.Vector3f(n)
    ray.maxt = mi.Float(1)
    si = scene.ray_intersect(ray)
    dr.eval(p, n, si)
    # A ray along a rim may pass by it.
    hit = np.array(si.is_valid())
    assert hit.mean() > 0.999
    assert np.abs(np.array(si.t)[hit] - length).max() < 2e-6
    # Of the side that scatters, which is not Mitsuba's geometric one under mirrored transforms.
    assert np.abs(np.array(dr.dot(si.sh_frame.n, n))[hit] - 1).max() < 1e-5
    assert np.abs(np.array(dr.norm(n)) - 1).max() < 1e-5
    density = table.per_area(si.shape, si.prim_index, si.p)
    # The mean of one over the density is the area, without noise where there is one element.
    inverse = 1 / np.array(density, dtype=float)[hit]
    assert abs(inverse.mean() - area) < 4 * inverse.std() / COUNT**0.5 + 2e-3 * area * (hit.mean() < 1) + 1e-5 * area


def scene_with_many():
    shapes = [
        mesh("body", mannequin(1)), mesh("plate", plate(0.5, 0.5, (0, 0, 2.0), 3), two_sided=True),
        mi.load_dict({"type": "sphere", "center": [0.4, 0.4, 0.7], "radius": 0.1}),
        mi.load_dict({"type": "disk", "to_world": turned(0.3, 0.2, 1)}),
    ]  # fmt: skip
    return shapes, scene_of(*shapes)


def test_frequencies_are_the_densities_and_densities_integrate_to_one():
    shapes, _ = scene_with_many()
    points, normals = wall_grid(5)
    tiles = np.stack([points, points + np.array([2.0, 0, 0])])
    table = HiddenElements(shapes, tiles, np.stack([normals] * 2))
    elements = len(table.elements)
    for tile in (0, 1):
        lane = mi.UInt32(tile)
        number = dr.arange(mi.UInt32, elements)
        shape, primitive = table.surface(number)
        middle, _ = table.point(number, mi.Float(0.5), mi.Float(0.25))
        density = np.array(table.per_area(shape, primitive, middle, True, lane), dtype=float)
        assert density == pytest.approx(np.array(table.density_of(number, True, lane)), rel=1e-4)
        p = density * table.elements.area
        assert p.sum() == pytest.approx(1, rel=1e-6)
        x = (mi.Float64(dr.arange(mi.UInt32, 1 << 18)) + 0.5) / 2**18
        found, rest = table.select_element(x, True, lane)
        count = np.bincount(np.array(found), minlength=elements)
        # Equidistant points: every interval has its share of them, to one.
        assert np.abs(count - p * 2**18).max() < 2
        assert dr.min(rest)[0] >= 0 and dr.max(rest)[0] < 1
    assert not np.allclose(table._probabilities(tiles[:1], normals[None]), p)


def test_large_triangles_are_cut():
    """A wall of a room: places, densities and barycentrics of the parts are those of the two triangles."""
    shape = mi.load_dict({"type": "rectangle", "to_world": turned(3, 2, 1)})
    scene = scene_of(shape)
    table = HiddenElements([shape], *wall_grid(3))
    assert len(table.elements) > 100
    assert table.elements.area.sum() == pytest.approx(24, rel=1e-6)
    element, a = table.select_element(mi.Float64(random_points(COUNT).x))
    y = mi.Float(random_points(COUNT, 8).x)
    p, _ = table.point(element, a, y)
    ray = dr.zeros(mi.Ray3f, COUNT)
    n = table.point(element, a, y)[1]
    ray.o, ray.d, ray.maxt = mi.Point3f(p + 0.01 * mi.Vector3f(n)), -mi.Vector3f(n), mi.Float(1)
    pi = scene.ray_intersect_preliminary(ray)
    hit = np.array(pi.is_valid())
    b = np.array(table.coordinates(element, a, y))
    # In single precision, positions of up to 4 m over a triangle of 4 m.
    assert hit.mean() > 0.999 and np.abs(np.array(pi.prim_uv) - b)[:, hit].max() < 2e-6
    found, drawn = np.array(table.per_area(pi.shape, pi.prim_index, p)), np.array(table.density_of(element))
    # Points on the rims of parts may be counted to their neighbours.
    same = np.abs(found / drawn - 1)[hit] < 1e-4
    assert same.mean() > 0.9995
    assert np.mean(1 / found[hit]) == pytest.approx(24, abs=float(4 * np.std(1 / found[hit]) / COUNT**0.5))
