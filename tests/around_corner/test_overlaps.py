"""Where lines start and end, exactly, and which drawn points lie in something else."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.hidden_shapes import mesh, plate, wall_grid
from torchtransient.plugins.around_corner import geometry
from torchtransient.plugins.around_corner import scan_table as overlaps
from torchtransient.plugins.sampling.area_elements import TRIANGLE
from torchtransient.plugins.sampling.hidden_elements import HiddenElements
from torchtransient.plugins.transport.strategy import Local

VARIANT = "llvm_ad_mono"
# Planes at a coordinate of zero, where offsets are exact.
ENDS = np.array([[0, 3, -5], [0, -0.25, 0.5], [0, 0.1, 7.0]])
STARTS = np.array([[0, 1, 2], [0, 4, -3], [0, -2, 0.5]])


def test_rays_start_and_end_off_their_surfaces():
    """By 2^-20 of the largest coordinate at the wall and of the distance; the length ends as much before."""
    asked = []
    scene = Local(ray_test=lambda ray, coherent, active: asked.append((ray, active)) or mi.Bool([True, False, True]))
    start = Local(p=mi.Point3f(STARTS.T), geometric_n=mi.Vector3f(1, 0, 0))
    r = np.linalg.norm(ENDS - STARTS, axis=1)
    line = Local(geometric_cos=mi.Float([1, -1, 0.5]), r=mi.Float(r.astype(np.float32)))
    n = mi.Vector3f(-1, 0, 0)
    met = geometry.occluded(scene, start, line, mi.Point3f(ENDS.T), n, mi.Bool([True, True, False]))
    (ray, active), offset = asked[0], 2.0**-20 * (np.abs(ENDS).max(1) + r)
    assert (np.array(met).tolist(), np.array(active).tolist()) == ([True, False, True], [True, True, False])
    o, d = np.array(ray.o, dtype=float).T, np.array(ray.d, dtype=float).T
    np.testing.assert_allclose(o[:, 0], offset * [1, -1, 1], rtol=1e-5)
    np.testing.assert_allclose(o[:, 1:], STARTS[:, 1:])
    np.testing.assert_allclose(d[:, 0], -offset - o[:, 0], rtol=1e-4, atol=1e-11)
    np.testing.assert_allclose(d[:, 1:], (ENDS - STARTS)[:, 1:], rtol=1e-6)
    assert ray.maxt[0] == 1 - 2.0**-20


def test_points_of_one_plane_do_not_see_each_other():
    """Nor what is nearer to it than lines start off it, at either end."""
    scene = Local(ray_test=lambda ray, coherent, active: mi.Bool(False))
    along, across = np.array([0, 0.6, 0.8]), np.array([0, 0.8, -0.6])
    end = 5 * along + [0.25, 0, 0]
    least = 2.0**-20 * (end.max() + 5)
    for height, seen in ((0.9 * least, False), (1.1 * least, True)):
        grazing = across + along * height / 5
        for n, m in ((grazing, -along), (-grazing, -along), (along, across - along * height / 5)):
            start = Local(p=mi.Point3f(0.25, 0, 0), geometric_n=mi.Vector3f(*n.tolist()))
            found = geometry.sees(scene, start, mi.Point3f(*end.tolist()), mi.Vector3f(*m.tolist()), mi.Bool(True))
            assert bool(found[0]) is seen, (height, n, m)
    # What is exactly so near is not seen, either.
    tie = 9 * 2.0**-22
    for n, m in (((0, 0, tie), (0, -1, 0)), ((0, 1, 0), (0, 0, -tie))):
        for factor in (1, 1.25):
            start = Local(p=mi.Point3f(0, 0, 0), geometric_n=mi.Vector3f(*n) * factor)
            found = geometry.sees(scene, start, mi.Point3f(0, 3, 4), mi.Vector3f(*m) * factor, mi.Bool(True))
            assert bool(found[0]) is (factor > 1)


@pytest.mark.parametrize("side", [1, -1])
def test_drawn_points_that_lie_in_something_else(monkeypatch, side):
    """What is seen there is another triangle or shape, no farther off the plane than four offsets, off the edges."""
    count = 16
    rng = np.random.default_rng(3)
    x, y = rng.uniform(0.1, 0.9, (2, count))
    case = np.arange(count) % 8
    monkeypatch.setattr(overlaps, "POINTS", count)
    monkeypatch.setattr(overlaps, "plane_points", lambda n, seed: (mi.Float64(x), mi.Float(y.astype(np.float32))))
    monkeypatch.setattr(overlaps, "_is_inside", lambda elements, element, a, y: mi.Bool(case != 6))
    monkeypatch.setattr(overlaps, "sees", lambda scene, viewer, p, n, active: active & mi.Bool(case != 4))
    sheet, other = (mesh(name, plate(0.4, 0.6, (0.5 * side, 0.1, 1))) for name in "ab")
    elements = HiddenElements([sheet], *wall_grid(2))
    rays, height = [], np.array([3.0, 5, 0, 0, 0, -3, 0, 0])[case]
    viewer = Local(p=mi.Point3f(0, mi.Float(np.linspace(-1, 1, count)), 0), geometric_n=mi.Vector3f(1, 0, 0))
    primitives = []
    surface = elements.surface
    monkeypatch.setattr(elements, "surface", lambda element: primitives.append(surface(element)) or primitives[-1])

    def met(ray, coherent, active):
        rays.append((np.array(ray.o, dtype=float), np.array(ray.d, dtype=float), np.array(active)))
        shape, primitive = primitives[-1]
        shape = dr.select(mi.Bool(case == 7), mi.ShapePtr(other), shape)
        primitive = dr.select(mi.Bool((case == 2) | (case == 7)), primitive, primitive + 1)
        t = (1 + mi.Float(height.astype(np.float32)) * dr.abs(ray.o.x) - ray.o.z) / ray.d.z
        return Local(t=t, is_valid=lambda: mi.Bool(case != 3), shape=shape, prim_index=primitive)

    target, seen, contested = overlaps._look(
        Local(ray_intersect_preliminary=met), elements, viewer, mi.UInt32(1), mi.Bool([True] * count)
    )
    p, v = (np.array(each, dtype=float).T + np.zeros((count, 3)) for each in (target.p, viewer.p))
    o, d, active = rays[0]
    offset = 2.0**-20 * (np.abs(p).max(1) + np.linalg.norm(p - v, axis=1))
    np.testing.assert_allclose(o[0], side * offset, rtol=1e-4)
    np.testing.assert_allclose(o[1:], v.T[1:], atol=1e-6)
    np.testing.assert_allclose(d.T, (p - o.T) / np.linalg.norm(p - o.T, axis=1, keepdims=True), atol=1e-6)
    np.testing.assert_allclose(np.array(target.geometric_n).T, np.tile([0, 0, -1], (count, 1)), atol=1e-6)
    np.testing.assert_array_equal(active, case != 4)
    np.testing.assert_array_equal(np.array(seen), case != 4)
    assert np.array(contested).tolist() == [k in (0, 5, 7) for k in case]
    assert len({tuple(row) for row in p}) == count


def test_points_at_edges_of_triangles():
    """Nearer than a hundredth in barycentric coordinates; other shapes have none."""
    uv = mi.Point2f([0.3, 0.005, 0.3, 0.495, 0.01, 0.005], [0.4, 0.5, 0.005, 0.5, 0.5, 0.5])
    kind = mi.UInt32([TRIANGLE] * 5 + [TRIANGLE + 1])
    elements = Local(coordinates=lambda element, a, y: uv, kind=lambda element: kind)
    assert np.array(overlaps._is_inside(elements, None, None, None)).tolist() == [True] + [False] * 4 + [True]


@pytest.mark.parametrize("places", [[2, 0], [2, 1], [0, 3]])
def test_three_points_make_an_overlap(monkeypatch, places):
    """Seen from the wall, or from what that sees; named by their shapes."""
    sheets = [mesh(name, plate(0.4, 0.6, (x, 0.1, 1))) for name, x in (("a", 0.5), ("b", -0.5))]
    for sheet, name in zip(sheets, "ab", strict=True):
        sheet.set_id(name)
    elements = HiddenElements(sheets, *wall_grid(2))
    given = iter(places)
    viewers = []

    def look(scene, elements, viewer, seed, active):
        viewers.append((viewer, np.array(active)))
        lane = dr.arange(mi.UInt32, 8)
        target = Local(p=mi.Point3f(mi.Float(lane), 0, 0), geometric_n=mi.Vector3f(0, 0, 1), shape=dr.gather(
            mi.ShapePtr, mi.ShapePtr(sheets[1]), dr.zeros(mi.UInt32, 8)))  # fmt: skip
        return target, lane < 5, lane < next(given)

    monkeypatch.setattr(overlaps, "_look", look)
    points = np.arange(9.0).reshape(3, 3)
    found = overlaps.overlaps(None, elements, points, points + 0.5)
    assert found == (["b"] if sum(places) >= 3 else [])
    first, second = viewers
    np.testing.assert_allclose(np.array(first[0].p).T[:7], points[np.arange(7) % 3])
    np.testing.assert_allclose(np.array(first[0].geometric_n).T[:7], points[np.arange(7) % 3] + 0.5)
    assert dr.width(first[0].p) == overlaps.POINTS and first[1].all()
    assert np.array(second[0].p.x).tolist() == list(range(8)) and second[1].sum() == 5
