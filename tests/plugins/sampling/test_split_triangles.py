"""Triangles that are cut into equal ones: where the parts lie, and how a point finds its own."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.gradient_cases.cases_curves import file_of
from torchtransient.plugins.sampling.area_elements import AreaElements
from torchtransient.plugins.sampling.hidden_elements import PrimitiveDensity, cut, cuts_of

VARIANT = "llvm_ad_mono"
# Three triangles of a kind each: wide, slender, small.
SHEET = """v 0 0 2
v 3 0.5 2.2
v 0.4 2 2
v 6 0 4
v 10 0 4
v 6 1 4.5
v 20 0 9
v 20.1 0 9
v 20 0.1 9
f 1 2 3
f 4 5 6
f 7 8 9
"""
WALL = np.array([[0.0, 0, 0], [0.5, 0.2, 0.1]])


def elements():
    sheet = {"type": "obj", "filename": file_of("cut sheet.obj", SHEET), "face_normals": True}
    shapes = [mi.load_dict(node) for node in (sheet, {"type": "sphere", "center": [0, 0, 9.0]})]
    return shapes, AreaElements.from_shapes(shapes)


def test_parts_are_small_beside_their_distance():
    """By a power of two that is just enough; spheres are never cut."""
    _, found = elements()
    cuts = cuts_of(found, WALL)
    corners = np.array([line.split()[1:] for line in SHEET.splitlines() if line[0] == "v"], dtype=float)
    for number, vertices in enumerate(corners.reshape(3, 3, 3)):
        longest = max(np.linalg.norm(vertices[i] - vertices[j]) for i, j in ((0, 1), (0, 2), (1, 2)))
        places = np.concatenate([vertices, vertices.mean(0)[None]])
        nearest = min(np.linalg.norm(place - p) for place in places for p in WALL)
        expected = 2 ** max(0, int(np.ceil(np.log2(longest / (0.5 * nearest)))))
        assert cuts[number] == expected
    assert cuts.tolist() == [4, 2, 1, 1]
    # Nearer points cut more, 32 times at most.
    near, touching = (cuts_of(found, WALL + np.array([0, 0, z])) for z in (1.9, 2.0))
    assert near[0] > 4 and touching[0] == 32


def test_the_middle_may_be_nearest():
    """Of a triangle with edges of 5, 3 and 4 m, 0.4 m below its middle and farther from all corners: 32 parts."""
    sheet = "v 0 0 2\nv 3 0 2\nv 0 4 2\nf 1 2 3\n"
    shape = mi.load_dict({"type": "obj", "filename": file_of("right sheet.obj", sheet), "face_normals": True})
    found = AreaElements.from_shapes([shape])
    assert [int(cuts_of(found, np.array([[1.0, 4 / 3, 2 - z]]))[0]) for z in (0.4, 0.63, 1.3, 5.0)] == [32, 16, 8, 2]


def test_what_is_round_or_has_no_area_is_not_cut():
    sliver = "v 0 0 0.1\nv 1 0 0.1\nv 2 0 0.1\nf 1 2 3\n"
    flat = mi.load_dict({"type": "obj", "filename": file_of("sliver.obj", sliver), "face_normals": True})
    around = AreaElements.from_shapes([flat, mi.load_dict({"type": "sphere"}), mi.load_dict({"type": "disk"})])
    assert cuts_of(around, WALL).tolist() == [1, 1, 1]
    assert around.area[0] == 0 and around.normal[0].tolist() == [0, 0, 0]


@pytest.mark.parametrize(("count", "cuts"), [(128, 32), (129, 16)])
def test_many_large_triangles_are_cut_less(count, cuts):
    """Into a thousand parts each, as long as there are no more than 2^17 in all."""
    _, found = elements()
    many = found.take(np.zeros(count, dtype=int))
    assert cuts_of(many, WALL + np.array([0, 0, 2.0])).tolist() == [cuts] * count


def test_points_beyond_a_rim_are_those_of_the_parts_at_it():
    """By rounding; here by more, counted along both edges of a triangle that is cut in four by four."""
    shapes, whole = elements()
    cuts = np.array([4, 1, 1, 1])
    _, number, cell = cut(whole, cuts)
    density = np.arange(1.0, len(number) + 1, dtype=np.float32)[None]
    table = PrimitiveDensity(shapes, whole, cuts, number, cell, density)
    o, e1, e2 = whole.axes[0, :3]
    for u, v, i, j, upper in ((3.2, 1.2, 3, 0, 0), (-0.3, 2.2, 0, 2, 0), (1.2, -0.1, 1, 0, 0), (0.6, 3.7, 0, 3, 0),
                              (2.7, 1.6, 2, 1, 0), (1.7, 0.8, 1, 0, 1), (4.5, -0.2, 3, 0, 0)):  # fmt: skip
        p = mi.Point3f(*(o + u / 4 * e1 + v / 4 * e2).tolist())
        found = table.look_up(mi.ShapePtr(shapes[0]), mi.UInt32(0), p, mi.Bool(True), None)
        own = (number == 0) & (cell == 2 * (4 * j + i) + upper)
        assert float(found[0]) == density[0, own]


def test_parts_cover_their_triangle_once():
    shapes, whole = elements()
    cuts = np.array([4, 2, 1, 1])
    parts, number, cell = cut(whole, cuts)
    assert np.bincount(number).tolist() == [16, 4, 1, 1]
    assert len(set(zip(number.tolist(), cell.tolist(), strict=True))) == 22
    assert np.all(cell < np.where(cuts > 1, 2 * cuts**2, 1)[number])
    density = np.random.default_rng(1).uniform(1, 2, (2, 22)).astype(np.float32)
    table = PrimitiveDensity(shapes, whole, cuts, number, cell, density)
    for k in range(2):
        own = number == k
        origin, first, second = (parts.axes[own, i] for i in range(3))
        area = np.linalg.norm(np.cross(first, second), axis=1) / 2
        np.testing.assert_allclose(area, whole.area[k] / cuts[k] ** 2, rtol=1e-6)
        np.testing.assert_allclose(parts.area[own], area, rtol=1e-6)
        # Their middles are those of a finer grid: all different, inside, and together the middle of the whole.
        o, e1, e2 = whole.axes[k, :3]
        middle = origin + (first + second) / 3
        edges = np.stack([e1, e2], axis=1)
        place = np.linalg.lstsq(edges, (middle - o).T, rcond=None)[0] * cuts[k]
        np.testing.assert_allclose(edges @ (place / cuts[k]), (middle - o).T, atol=1e-6)
        thirds = {tuple(np.round(3 * column).astype(int)) for column in place.T}
        assert thirds == {
            (3 * i + 1 + u, 3 * j + 1 + u)
            for i in range(cuts[k]) for j in range(cuts[k]) for u in (0, 1) if i + j + u < cuts[k]
        }  # fmt: skip
        # A point finds the density of the part that it lies in, in either tile.
        lanes = int(own.sum())
        rng = np.random.default_rng(k)
        u, v = rng.uniform(0.02, 0.48, (2, lanes))
        points = mi.Point3f((origin + first * u[:, None] + second * v[:, None]).T)
        for tile in (None, mi.UInt32(1)):
            looked_up = table.look_up(mi.ShapePtr(shapes[0]), mi.UInt32(k), points, mi.Bool(True), tile)
            np.testing.assert_allclose(np.array(looked_up), density[0 if tile is None else 1, own], rtol=1e-6)


def test_what_is_not_cut_has_one_density():
    shapes, whole = elements()
    cuts = np.array([4, 2, 1, 1])
    _, number, cell = cut(whole, cuts)
    density = np.arange(1.0, 23.0, dtype=np.float32)[None]
    table = PrimitiveDensity(shapes, whole, cuts, number, cell, density)
    p, active = mi.Point3f(20.02, 0.02, 9), mi.Bool([True, False])
    small = table.look_up(mi.ShapePtr(shapes[0]), mi.UInt32(2), p, active, None)
    ball = table.look_up(mi.ShapePtr(shapes[1]), mi.UInt32(0), p, active, None)
    other = mi.load_dict({"type": "scene", "far": {"type": "rectangle"}})
    unknown = table.look_up(mi.ShapePtr(other.shapes()[0]), mi.UInt32(0), p, active, None)
    expected = [float(density[0, number == k][0]) for k in (2, 3)]
    assert [list(np.array(one)) for one in (small, ball)] == [[value, 0] for value in expected]
    assert not np.array(unknown).any()
    uncut = PrimitiveDensity(shapes, whole, np.ones(4, dtype=int), np.arange(4), np.zeros(4, dtype=int), density[:, :4])
    found = uncut.look_up(mi.ShapePtr(shapes[0]), mi.UInt32([0, 1, 2]), dr.zeros(mi.Point3f), mi.Bool(True), None)
    assert list(np.array(found)) == [1, 2, 3]
