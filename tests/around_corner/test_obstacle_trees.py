"""Trees of what may be in the way of shafts, and planes that are touched exactly."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.hidden_shapes import mesh, plate
from support.third_bounce_runs import table_of
from torchtransient.plugins.around_corner import shafts
from torchtransient.plugins.around_corner.shafts import ScanRegion, clear_elements
from torchtransient.plugins.transport.strategy import Local

VARIANT = "llvm_ad_mono"


@pytest.mark.parametrize(("obstacles", "leaves"), [(0, 2), (1, 2), (2, 2), (3, 4), (4, 4), (5, 8), (8, 8), (9, 16)])
def test_trees_have_no_more_leaves_than_they_need(obstacles, leaves):
    """The next power of two, and both ends of the root."""
    region = ScanRegion([[0, 0, 0], [0.3, 0.2, 0.1]], [[0.2, -0.3, 0.9]] * 2)
    balls = [mi.load_dict({"type": "sphere", "center": [0, 0, k]}) for k in range(obstacles)]
    tree = shafts.ObstacleTree(balls, region, np.ones((1, 3, 3)), 1e-9)
    assert (tree.leaves[0], dr.width(tree.low), dr.width(tree.corners[0])) == (leaves, 2 * leaves, leaves)


def test_leaves_next_to_each_other_are_neighbours_by_their_middles():
    """Whatever their sizes; a box holds both below it."""
    region = ScanRegion([[0, 0, 0], [0.3, 0.2, 0]], [[0, 0, 1.0]] * 2)
    place, radius = np.array([5, 2, 7, 0, 3, 6, 1]), np.array([0.1, 3, 0.2, 0.1, 2.5, 0.3, 0.2])
    centers = (place[:, None] * region.frame[0] + 9 * region.frame[2]).tolist()
    balls = [mi.load_dict({"type": "sphere", "center": c, "radius": r}) for c, r in zip(centers, radius, strict=True)]
    tree = shafts.ObstacleTree(balls, region, np.ones((1, 3, 3)), 1e-9)
    low, high = np.array(tree.low).T, np.array(tree.high).T
    np.testing.assert_allclose((low[8:15, 0] + high[8:15, 0]) / 2, np.sort(place), atol=1e-5)
    np.testing.assert_allclose((high[8:15, 0] - low[8:15, 0]) / 2, radius[np.argsort(place)], rtol=1e-5)
    for node in range(1, 8):
        np.testing.assert_array_equal(low[node], low[2 * node : 2 * node + 2].min(0))
        np.testing.assert_array_equal(high[node], high[2 * node : 2 * node + 2].max(0))


def test_leaves_that_are_empty_are_met_by_no_shaft():
    """Of one that widens to all sides, too."""
    region = ScanRegion([[0, 0, 0], [0.3, 0.2, 0]], [[0, 0, 1.0]] * 2)
    element = np.array([[[-4, -4, 1], [6, -4, 1], [0, 6, 1.0]]])
    planes = shafts._shafts(element, np.zeros((1, 3)), np.zeros(1, dtype=bool), region)
    assert (planes[0, :8, 2] < 0).all()
    for z, met in ((3.0, False), (0.5, True)):
        balls = [mi.load_dict({"type": "sphere", "center": [0, 0, h], "radius": 0.125}) for h in (3.5, 4.0, z)]
        tree = shafts.ObstacleTree(balls, region, element, 1e-9)
        assert tree.leaves[0] == 4 and shafts._met(tree, planes, element).tolist() == [met]


def test_shafts_at_a_bound(monkeypatch):
    """Planes that touch the region have it before them or behind, those of triangles have it on one side; elements
    that touch it are in doubt.
    """
    region = ScanRegion([[0, 0, 0], [0.5, 0.25, 0]], [[0, 0, 1.0]] * 2)
    x, _, z = region.high
    up = np.array([[0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0, 0.0]])
    p = np.abs(up) * [x, 0, z]
    turned, before = shafts._turned_to(region, p, up, np.array([True, False, True, False]))
    assert turned[:2].tolist() == [[0, 0, -1], [0, 0, -1]] and turned[2:, 0].tolist() == [-1, -1]
    assert before.all()
    flat = np.array([[-3, -3, 0], [3, -3, 0], [0, 4, 0.0]])
    hidden = np.array([[[0.1, 0.2, 1], [0.4, 0.2, 1], [0.1, 0.5, 2.0]]])
    for sign in (1, -1):
        both = np.stack([flat, flat[::-1]]) * [1, 1, sign]
        assert shafts._harmless(both, region, hidden * [1, 1, sign], 0.0).all()
    monkeypatch.setattr(shafts, "ROUNDING", 0.0)
    elements = table_of([mesh("a", plate(0.25, 0.25, (0.25, 0.125, 0)))]).elements
    assert not clear_elements([], elements, region).any()
    tie = ScanRegion([[0, 0, 0], [0.5, 0.25, 0]], [[1e-6, 0, 0]] * 2)
    np.testing.assert_array_equal(tie.frame[2], [0, 0, 1])


def test_planes_that_cross_a_scan_are_in_doubt_where_normals_are_interpolated():
    """Points there are seen from behind, too."""
    region = ScanRegion([[0, 0, 0], [0.5, 0.25, 0]], [[0, 0, 1.0]] * 2)
    v, f = plate(0.25, 0.25, (0, 0, 0))
    upright = np.stack([0 * v[:, 0] + 0.25, v[:, 1], v[:, 0] + 1], 1), f
    for arrays, across in ((upright, True), ((v + np.array([0, 0, 1]), f), False)):
        elements = table_of([mesh("a", arrays)]).elements
        assert clear_elements([], elements, region).all()
        assert set(clear_elements([], elements, region, smooth=True).tolist()) == {not across}


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_what_touches_a_shaft_is_outside_of_it(axis):
    """Beyond a plane, or where its own plane has region and element on one side; along each axis."""

    def at(*place):
        return mi.Vector3d(*np.roll(place, axis).tolist())

    plane, level = mi.Vector4d(*np.roll([1, 0, 0], axis).tolist(), 0.5), mi.Float64(0)
    for least, outside in ((0.5, True), (0.4375, False)):
        tree = Local(low=mi.Point3d(at(least, 0, 0)), high=mi.Point3d(at(least, 1, 1)), slack=level)
        assert bool(shafts._box_outside(tree, [plane], mi.UInt32(0))[0]) is outside
        # Its own plane has the element on both sides.
        tree.corners = [mi.Point3d(at(least, *rest)) for rest in ((0, 0), (0, 1), (1, 0))]
        tree.region, own = (at(-1, -1, -1), at(1, 1, 1)), [at(k, 0, 0) for k in (-1, 0, 1)]
        assert bool(shafts._triangle_outside(tree, [plane], own, mi.UInt32(0), mi.Bool(True))[0]) is outside
    for top, outside in ((0.5, True), (0.5625, False)):
        for side in (1, -1):
            tree.corners = [mi.Point3d(at(0.5 * side, *rest)) for rest in ((0, 0), (0, 1), (1, 0))]
            ends = sorted((-side, top * side))
            tree.region = at(ends[0], 0, 0), at(ends[1], 1, 1)
            own = [at(0.25 * side, 0, k) for k in range(3)]
            assert bool(shafts._triangle_outside(tree, [], own, mi.UInt32(0), mi.Bool(True))[0]) is outside


def test_elements_that_are_seen_from_one_side_alone(monkeypatch):
    """Those that scatter on one, and those of two that have all of the scan before or behind them."""
    asked = []
    monkeypatch.setattr(shafts, "_shafts", lambda corners, normal, front, region: asked.append(front) or np.zeros((
        len(front), 1, 4)))  # fmt: skip
    region = ScanRegion([[0, 0, 0], [0.5, 0.25, 0]], [[0, 0, 1.0]] * 2)
    v, f = plate(0.25, 0.25, (0, 0, 0))
    upright, level = np.stack([0 * v[:, 0] + 0.25, v[:, 1], v[:, 0] + 1], 1), v + np.array([0, 0, 1])
    for place, faces, two_sided, one in ((upright, f, False, True), (upright, f, True, False), (level, f, True, True),
                                         (level, f[:, ::-1], True, True)):  # fmt: skip
        clear_elements([], table_of([mesh("a", (place, faces), two_sided=two_sided)]).elements, region)
        assert set(asked[-1].tolist()) == {one}
