"""Directions, areas and slides between points that move, by geometry in double precision."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.gradient_cases.cases_curves import file_of
from torchtransient.plugins.kernel_arrays import PointerTable
from torchtransient.plugins.transport import geometry_terms as terms

VARIANT = "llvm_ad_mono"
RADIUS = 0.4
# Distances within and beyond the radius, a touch, and lanes that do not count.
R = np.array([0.07, 0.3, 0.55, 2.0, 0.0, 0.3, 0.9])
ACTIVE = np.array([1, 1, 1, 1, 1, 0, 0], dtype=bool)


def unit(v):
    return v / np.linalg.norm(v, axis=0)


def draw(seed, count=R.size):
    return np.random.default_rng(seed).normal(size=(3, count))


D, N, MOVED = unit(draw(1)), unit(draw(2)), draw(3)


def motion_of(**unbound):
    vectors = (mi.Vector3f(MOVED), mi.Vector3f(D), mi.Float(R), mi.Normal3f(N))
    return terms.damped_motion(*vectors, mi.Bool(ACTIVE), mi.Float(RADIUS), **unbound)


def share(r, nailed):
    """How much of the vertex's motion a point at distance ``r`` makes, too."""
    return np.zeros_like(r) if nailed else (1 - np.minimum(r / RADIUS, 1) ** 2) ** 2


@pytest.mark.parametrize("unbound", [None, "nailed", "volume"])
def test_the_direction_to_a_point_that_moves_with_its_vertex(unbound):
    """Of surfaces, points of lights and points in volumes: ``-W`` times what the vertex moves across, and its
    divergence.
    """
    motion = motion_of(**({unbound: mi.Bool(True)} if unbound else {}))
    nailed = unbound == "nailed"
    r = np.where(R > 0, R, 1.0)
    weight = np.where((R > 0) & ACTIVE, (1 - share(r, nailed)) / r, 0)
    step = 1e-6
    slope = ((1 - share(r + step, nailed)) / (r + step) - (1 - share(r - step, nailed)) / (r - step)) / (2 * step)
    slope = np.where((R > 0) & ACTIVE, r * slope, 0)
    along, cos = (D * MOVED).sum(0), (D * N).sum(0)
    across = MOVED - D * along
    divergence = 2 * weight * along
    if unbound is None:
        divergence += slope * ((N * MOVED).sum(0) / cos - along)
    np.testing.assert_allclose(np.array(motion.d), D - weight * across, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(np.array(motion.J), 1 + divergence, rtol=1e-4, atol=1e-4)
    drag = np.where(ACTIVE, (1 - weight * R) * across, 0)
    np.testing.assert_allclose(np.array(motion.drag), drag, rtol=1e-4, atol=1e-5)


def test_points_slide_on_their_surfaces():
    """Across the normal, and seen along the ray where it was dragged to; the length changes by what both ends move."""
    motion, n = motion_of(), mi.Normal3f(N)
    slid = np.array(motion.slide(n), dtype=np.float64)[:, ACTIVE]
    drag, d, normal = (v[:, ACTIVE] for v in (np.array(motion.drag, dtype=np.float64), D, N))
    np.testing.assert_allclose((slid * normal).sum(0), 0, atol=1e-5)
    np.testing.assert_allclose(np.cross(slid - drag, d, axis=0), 0, atol=1e-5)
    np.testing.assert_allclose(np.array(motion.longer()), -(MOVED * D).sum(0), rtol=1e-5, atol=1e-6)
    longer = ((slid - MOVED[:, ACTIVE]) * d).sum(0)
    np.testing.assert_allclose(np.array(motion.longer(n))[ACTIVE], longer, rtol=1e-4, atol=1e-4)


def test_material_points_count_as_far_as_they_do_not_slide():
    """The solid angle grows as the element of area and as the cosine of the normal that turns."""
    motion, x = motion_of(), mi.Float(0)
    dr.enable_grad(x)
    dr.set_grad(x, 1)
    turned, grown = draw(5), np.arange(1.0, 8.0)
    J = motion.of_material(mi.Normal3f(N) + mi.Vector3f(turned) * x, 1 + mi.Float(grown) * x)
    dr.enqueue(dr.ADMode.Forward, x)
    dr.traverse(dr.ADMode.Forward)
    np.testing.assert_array_equal(np.array(J), 1)
    stays = np.where(R > 0, 1 - share(R, False), 0)
    expected = stays * (grown + (turned * D).sum(0) / (N * D).sum(0))
    np.testing.assert_allclose(np.array(dr.grad(J))[ACTIVE], expected[ACTIVE], rtol=1e-4, atol=1e-4)


def test_grazing_points_do_not_move():
    """Nothing is divided by a cosine of zero."""
    d, n, δ = mi.Vector3f(0, 0, 1), mi.Normal3f(1, 0, 0), mi.Vector3f(0.3, 0.2, 0.5)
    motion = terms.damped_motion(δ, d, mi.Float(0.2), n, mi.Bool(True), mi.Float(RADIUS))
    np.testing.assert_array_equal(np.array(motion.slide(n)), np.array(motion.drag))
    np.testing.assert_array_equal(np.array(terms.slide(δ, d, n, mi.Bool(True))), np.array(δ))
    a = (1 - 0.5**2) ** 2
    slope = (4 * 0.5**2 * (1 - 0.5**2) - (1 - a)) / 0.2
    assert motion.J[0] == pytest.approx(1 + (2 * (1 - a) / 0.2 - slope) * 0.5, rel=1e-5)


def test_where_a_ray_that_is_shifted_meets_a_plane():
    drag, d, n = draw(6), draw(7), draw(8)
    found = np.array(terms.slide(mi.Vector3f(drag), mi.Vector3f(d), mi.Normal3f(n), mi.Bool(ACTIVE)), dtype=np.float64)
    expected = drag - d * (drag * n).sum(0) / (d * n).sum(0)
    np.testing.assert_allclose(found, np.where(ACTIVE, expected, drag), rtol=1e-4, atol=1e-5)


def test_distances_and_displacements_of_idle_lanes():
    p, q, active = mi.Point3f(1, 2, 3), mi.Point3f([3, 1], [5, 2], [9, 3]), mi.Bool([True, False])
    np.testing.assert_array_equal(np.array(terms.distance(p, q, active)), [7, 1])
    x = mi.Float(0)
    dr.enable_grad(x)
    dr.set_grad(x, 1)
    points = (mi.Point3f(1, 2, 3) + mi.Vector3f(5, 7, 11) * x, mi.Point2f(1, 2) + mi.Vector2f(3, 4) * x)
    found = [terms.displacement(point, active) for point in points]
    dr.enqueue(dr.ADMode.Forward, x)
    dr.traverse(dr.ADMode.Forward)
    for one, rate in zip(found, ([5, 7, 11], [3, 4]), strict=True):
        assert not np.array(one).any()
        np.testing.assert_array_equal(np.array(dr.grad(one)), np.outer(rate, [1, 0]))


TRIANGLE = "v -1 -1 0\nv 2 -1 0\nv -1 2 0\nvt 0 0\nvt 1 0.2\nvt 0.1 0.7\nf 1/1 2/2 3/3\n"


def test_the_area_of_a_triangle_is_that_of_its_vertices():
    """Not that of its texture coordinates, nor made up where there are none."""
    mesh = {"type": "obj", "filename": file_of("one triangle.obj", TRIANGLE)}
    plain = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([9, 0, 0]).scale([2, 3, 1])}
    scene = mi.load_dict({"type": "scene", "mesh": mesh, "plain": plain})
    params, x = mi.traverse(scene), mi.Float(0)
    dr.enable_grad(x)
    dr.set_grad(x, 1)
    start, move = mi.Float(params["mesh.vertex_positions"]), mi.Float([0.3, 0, 0.2, 0.5, 0.1, 0, 0, 0.7, -0.4])
    params["mesh.vertex_positions"] = start + move * x
    params.update()
    ray = mi.Ray3f(mi.Point3f([-0.2, 8.5, 0], [-0.3, 0.4, 0], 2), mi.Vector3f(0, 0, -1))
    pi = scene.ray_intersect_preliminary(ray)
    meshes = PointerTable.marking([shape for shape in scene.shapes() if shape.id() == "mesh"])
    active = mi.Bool([True, True, False])
    si, area = terms.material_point(pi, ray, active, meshes)
    _, plain = terms.material_point(pi, ray, active)
    dr.enqueue(dr.ADMode.Forward, x)
    dr.traverse(dr.ADMode.Forward)
    corners, rates = (np.array(v, dtype=np.float64).reshape(3, 3) for v in (start, move))

    def twice(x):
        a, b, c = corners + x * rates
        return np.linalg.norm(np.cross(b - a, c - a))

    np.testing.assert_allclose(np.array(area), [9, 24, 1], rtol=1e-5)
    slope = (twice(1e-5) - twice(-1e-5)) / 2e-5
    np.testing.assert_allclose(np.array(dr.grad(area)), [slope, 0, 0], rtol=1e-4, atol=1e-5)
    assert np.array(plain)[0] == pytest.approx(9 / abs(1 * 0.7 - 0.1 * 0.2), rel=1e-5)
    # The point of the first lane is a third of the way to the others' corners, and moves with all three.
    b, c = 0.8 / 3, 0.7 / 3
    moved = (1 - b - c) * rates[0] + b * rates[1] + c * rates[2]
    np.testing.assert_allclose(np.array(dr.grad(si.p))[:, 0], moved, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("own", [0.0, 0.6])
def test_what_changes_where_a_point_slides_on_a_sphere(own):
    """Of the drag alone, though the ray may have a motion of its ``own``."""
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere", "center": [0.2, -0.1, 0.3], "radius": 1.5}})
    d = dr.normalize(mi.Vector3f([0.1, -0.2, 0.05], [0.2, 0.1, -0.1], -1))
    start, drag = mi.Point3f([0.3, 0.1, 0.2], [0.2, 0.4, -0.5], 5), mi.Vector3f([0.3, 0.5, 0.2], [0.7, -0.2, 0.3], 0.1)
    active, step = mi.Bool([True, True, False]), 1e-3

    def hit(x):
        si = scene.ray_intersect(mi.Ray3f(start + drag * x, d))
        return [np.array(v) for v in (si.uv, si.n, si.sh_frame.n)]

    expected = [(a - b) / (2 * step) * [1, 1, 0] for a, b in zip(hit(step), hit(-step), strict=True)]
    x = mi.Float(0)
    dr.enable_grad(x)
    dr.set_grad(x, 1)
    ray = mi.Ray3f(start + mi.Vector3f(own, -own, 0) * x, d)
    moved = terms.slide_on_shape(scene.ray_intersect_preliminary(dr.detach(ray)), ray, drag * x, active)
    dr.enqueue(dr.ADMode.Forward, x)
    dr.traverse(dr.ADMode.Forward)
    for one, other in zip((moved.uv, moved.n, moved.sh_n), expected, strict=True):
        assert not np.array(one).any()
        np.testing.assert_allclose(np.array(dr.grad(one)), other, rtol=2e-3, atol=2e-3)
