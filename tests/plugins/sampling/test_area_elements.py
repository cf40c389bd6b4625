"""Rows of shapes that light is drawn on: where they lie, which way they face, what they weigh. In double precision."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.hidden_shapes import ball, mesh, plate
from torchtransient.plugins.sampling.area_elements import (
    CYLINDER,
    DISK,
    SPHERE,
    TRIANGLE,
    AreaElements,
    can_be_listed,
    facing_weight,
    has_shading_normals,
    local_point,
    morton_order,
)
from torchtransient.plugins.sampling.shared_samples import ScanTiles, distance_to

VARIANT = "llvm_ad_mono"
SHEET = np.array([[0.1, 0.2, 1.3], [0.9, 0.3, 1.1], [0.2, 1.4, 1.6], [2.1, 0.7, 0.8]]), np.array([[0, 2, 1], [1, 2, 3]])


def turned(*scale):
    return mi.ScalarTransform4f().translate([0.2, -0.3, 1.7]).rotate([2 / 7, 3 / 7, 6 / 7], 50).scale(list(scale))


def axes_of(*scale):
    return np.array(turned(*scale).matrix, dtype=float)[:3, :3].T


def analytic(kind, *scale, **more):
    return mi.load_dict({"type": kind, "to_world": turned(*scale), **more})


def test_weights_of_axes():
    """For a twelfth of a turn and a quarter of the other number: s = 1/2, z = 1/2."""
    kind, root = np.arange(4), math.sqrt(3) / 2
    found = np.array(local_point(kind, np.float64(1 / 12), np.float64(1 / 4), np))
    expected = [[11 / 24, 1 / 24, 0], [root / 2, 1 / 4, 0], [root * root, root / 2, 1 / 2], [root, 1 / 2, 1 / 4]]
    np.testing.assert_allclose(found.T, expected, atol=1e-15)
    only = local_point(0, 0.25, 0.64, np, (TRIANGLE,))
    np.testing.assert_allclose(only, [0.6, 0.2, 0.0])
    for one in (DISK, SPHERE, CYLINDER):
        alone = local_point(np.array(one), np.float64(1 / 12), np.float64(1 / 4), np, (one,))
        np.testing.assert_allclose(np.array(alone, dtype=float), expected[one], atol=1e-15)


def test_rows_of_triangles():
    shapes = [mesh("a", SHEET), mesh("b", plate(1, 1, (0, 0, 2)), two_sided=True)]
    found = AreaElements.from_shapes(shapes)
    v, f = SHEET
    assert len(found) == 4 and found.shape.tolist() == [0, 0, 1, 1] and found.primitive.tolist() == [0, 1, 0, 1]
    assert found.two_sided.tolist() == [False, False, True, True] and found.left_out == []
    for k in range(2):
        a, b, c = v[f[k]]
        np.testing.assert_allclose(found.axes[k], [a, b - a, c - a, [0, 0, 1]], atol=1e-6)
        n = np.cross(b - a, c - a)
        assert found.area[k] == pytest.approx(np.linalg.norm(n) / 2, rel=1e-6)
        np.testing.assert_allclose(found.normal[k], n / np.linalg.norm(n), atol=1e-6)
        np.testing.assert_allclose(found.centers()[k], (a + b + c) / 3, atol=1e-6)
    turned_over = found.take(np.array([3, 0]))
    assert turned_over.shape.tolist() == [1, 0] and turned_over.primitive.tolist() == [1, 0]


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("mirror", [1, -1])
def test_rows_of_round_shapes(flip, mirror):
    sign = -1 if flip else 1
    shapes = [
        analytic("disk", 0.5, 1.5 * mirror, 2.0, flip_normals=flip), analytic("sphere", 0.3, 0.3, 0.3 * mirror),
        analytic("cylinder", 0.4, 0.4, 3.0 * mirror, flip_normals=flip),
    ]  # fmt: skip
    found = AreaElements.from_shapes(shapes)
    assert found.kind.tolist() == [DISK, SPHERE, CYLINDER]
    np.testing.assert_allclose(found.area, np.pi * np.array([0.75, 4 * 0.09, 2 * 0.4 * 3]), rtol=1e-6)
    np.testing.assert_allclose(found.axes[:, 0], [[0.2, -0.3, 1.7]] * 3, atol=1e-6)
    np.testing.assert_allclose(found.axes[0, 1:3], axes_of(0.5, 1.5 * mirror, 2)[:2], atol=1e-6)
    np.testing.assert_allclose(found.axes[0, 3], 0)
    np.testing.assert_allclose(found.axes[1, 1:], 0.3 * np.eye(3), atol=1e-6)
    np.testing.assert_allclose(found.axes[2, 1:], axes_of(0.4, 0.4, 3 * mirror), atol=1e-6)
    # A mirror image faces as the shape did.
    np.testing.assert_allclose(found.normal[0], sign * axes_of(1, 1, 1)[2], atol=1e-6)
    np.testing.assert_allclose(found.normal[2], [sign / 0.4, 0, 0], rtol=1e-6)
    np.testing.assert_allclose(found.centers()[:2], found.axes[:2, 0])
    np.testing.assert_allclose(found.centers()[2], found.axes[2, 0] + found.axes[2, 3] / 2)
    # Sixteen places of each: four turns, four heights.
    points, normals = found.points(np.array([2, 0, 1]))
    assert points.shape == normals.shape == (3, 16, 3)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, rtol=1e-6)
    axis = found.axes[2, 3] / 3
    away = points[0] - found.axes[2, 0]
    along = away @ axis
    np.testing.assert_allclose(sorted(set(along.round(5))), [0.375, 1.125, 1.875, 2.625], rtol=1e-5)
    np.testing.assert_allclose(normals[0], sign * (away - along[:, None] * axis) / 0.4, atol=1e-6)
    np.testing.assert_allclose(normals[1], np.tile(found.normal[0], (16, 1)))
    np.testing.assert_allclose(normals[2], mirror * (points[2] - found.axes[1, 0]) / 0.3, rtol=1e-6)
    np.testing.assert_allclose(points[2].mean(0), found.axes[1, 0], atol=1e-7)


def test_points_of_elements_of_several_kinds():
    """Of a triangle beside others sixteen places, too, with its own normal."""
    elements = AreaElements.from_shapes([mesh("sheet", SHEET), analytic("sphere", 0.3, 0.3, 0.3)])
    points, normals = elements.points(np.array([2, 1]))
    np.testing.assert_allclose(normals[1], np.tile(elements.normal[1], (16, 1)))
    away = points[1] - elements.axes[1, 0]
    np.testing.assert_allclose(away @ elements.normal[1], 0, atol=1e-7)
    place = np.linalg.lstsq(elements.axes[1, 1:3].T, away.T, rcond=None)[0]
    assert place.min() > 0 and place.sum(0).max() < 1 and len(np.unique(place.round(6), axis=1).T) == 16
    np.testing.assert_allclose(np.linalg.norm(points[0] - elements.axes[2, 0], axis=1), 0.3, rtol=1e-6)


def test_spheres_that_are_turned_inside_out():
    for mirror, flip, inwards in ((1, True, True), (-1, False, False), (-1, True, True)):
        shape = analytic("sphere", *[0.3 * mirror] * 3, flip_normals=flip)
        si = mi.load_dict({"type": "scene", "s": shape}).ray_intersect(mi.Ray3f([0.2, -0.3, -5], [0, 0, 1]))
        (row,) = AreaElements.from_shapes([shape]).normal
        # That of the side that shading normals take for the front.
        assert (row[0] < 0) == bool(si.sh_frame.n.z[0] > 0), inwards
        assert abs(row[0]) == pytest.approx(1 / 0.3, rel=1e-6)


@pytest.mark.parametrize("vertex_normals", [False, True])
def test_a_flag_turns_triangles_around_and_the_order_of_corners_does_not(vertex_normals):
    """Where there are normals at the vertices, they say which side is the front."""
    v, f = plate(1, 1.5, (0, 0, 1))
    normals = {"normals": np.tile([0.0, 0.0, -1.0], (len(v), 1))} if vertex_normals else {}
    for faces, flip in ((f, False), (f[:, ::-1], False), (f, True)):
        given = {"vertices": v, "faces": faces, "flip_normals": flip, **normals}
        arrays = {name: mi.TensorXf(np.array(x, dtype=np.float32)) if isinstance(x, np.ndarray) else x
                  for name, x in given.items()}  # fmt: skip
        shape = mi.load_dict({"type": "mesh_arrays", **arrays})
        ordered = np.sign(np.cross(v[faces[0, 1]] - v[faces[0, 0]], v[faces[0, 2]] - v[faces[0, 0]])[2])
        expected = (-1 if vertex_normals else ordered) * (-1 if flip else 1)
        np.testing.assert_allclose(AreaElements.from_shapes([shape]).normal[:, 2], expected, rtol=1e-6)
        assert not has_shading_normals(shape)


def test_what_has_normals_of_its_own():
    assert has_shading_normals(mesh("ball", ball((0, 0, 1), 0.5, 1), vertex_normals=True))
    assert not has_shading_normals(mesh("flat", ball((0, 0, 1), 0.5, 1)))
    assert not has_shading_normals(analytic("sphere", 0.3, 0.3, 0.3))


def sheared(amount, row, column):
    matrix = np.eye(4)
    matrix[row, column] = amount
    return matrix


@pytest.mark.parametrize(("kind", "matrix", "listed"), [
    ("disk", sheared(2e-4, 0, 1), False), ("disk", sheared(0.5e-4, 0, 1), True), ("disk", sheared(0.3, 0, 2), True),
    ("disk", np.diag([1, 2, 1, 1.0]), True),
    ("cylinder", sheared(2e-4, 0, 1), False), ("cylinder", sheared(2e-4, 0, 2), False),
    ("cylinder", sheared(2e-4, 1, 2), False), ("cylinder", sheared(0.5e-4, 1, 2), True),
    ("cylinder", np.diag([1, 1, 5, 1.0]), True), ("cylinder", np.diag([1, 1.0002, 5, 1]), False),
    ("cylinder", np.diag([1, 1.00005, 5, 1]), True),
    ("sphere", np.diag([1, 1, 1.0002, 1]), False), ("sphere", np.diag([1, 1, 1.00005, 1]), True),
    ("sphere", np.diag([7, 7, 7, 1.0]), True),
])  # fmt: skip
def test_sheared_shapes_are_left_out(kind, matrix, listed):
    """By more than a ten thousandth, of their angles or, of round ones, of their lengths."""
    shape = mi.load_dict({"type": kind, "id": "odd", "to_world": mi.ScalarTransform4f(matrix)})
    assert can_be_listed(shape) == listed
    found = AreaElements.from_shapes([shape, analytic("disk", 1, 1, 1)])
    assert len(found) == 1 + listed and found.left_out == ([] if listed else ["odd"])
    assert found.shape.tolist()[-1] == 1
    unnamed = mi.load_dict({"type": kind, "to_world": mi.ScalarTransform4f(matrix)})
    assert AreaElements.from_shapes([unnamed]).left_out == ([] if listed else [kind.capitalize()])


def test_shapes_with_derivatives():
    """Rows are numbers, whatever is attached."""
    shapes = [analytic("disk", 0.5, 1.5, 2.0), mesh("ball", ball((0, 0, 1), 0.5, 0), vertex_normals=True)]
    before = AreaElements.from_shapes(shapes)
    for shape, keys in zip(shapes, (["to_world"], ["vertex_positions", "vertex_normals"]), strict=True):
        params = mi.traverse(shape)
        for key in keys:
            dr.enable_grad(params[key])
        params.update()
    after = AreaElements.from_shapes(shapes)
    for one, other in zip(before.columns(), after.columns(), strict=True):
        np.testing.assert_array_equal(one, other)


def test_of_nothing():
    group = {"type": "shapegroup", "inner": {"type": "sphere"}}
    copy = {"type": "instance", "ref": {"type": "ref", "id": "group"}}
    scene = mi.load_dict({"type": "scene", "group": group, "copy": copy})
    found = AreaElements.from_shapes([shape for shape in scene.shapes() if shape.id() == "copy"])
    assert len(found) == 0 and found.left_out == ["copy"] and found.axes.shape == (0, 4, 3)
    assert facing_weight(found, np.ones((2, 3)), np.ones((2, 3))).shape == (0,)


# ----------------------------------------------------------------------------------------------------------- weights


def test_what_elements_of_every_kind_weigh():
    """Point by point, with plain sums; in pieces of two triangles as in one piece."""
    shapes = [
        mesh("sheet", (SHEET[0], np.concatenate([SHEET[1], SHEET[1][:, ::-1], SHEET[1][:1]]))),
        mesh("both", plate(0.4, 0.7, (0.1, 0.2, 1.0)), two_sided=True),
        analytic("disk", 0.5, 0.3, 1.0, bsdf={"type": "twosided", "nested": {"type": "diffuse"}}),
        analytic("cylinder", 0.2, 0.2, 0.6), analytic("sphere", 0.3, 0.3, 0.3),
    ]  # fmt: skip
    elements = AreaElements.from_shapes(shapes)
    wall = np.array([[-0.3, 0.1, 0.0], [0.4, -0.5, 0.1], [0.7, 0.9, -0.2]])
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 0.6, 0.8], [0.28, 0.0, 0.96]])
    expected = []
    for k in range(len(elements)):
        points, faces = elements.points(np.array([k]))
        squares = []
        for x, n in zip(points[0], faces[0], strict=True):
            total = 0.0
            for p, m in zip(wall, normals, strict=True):
                r = math.dist(p, x)
                there, here = float(n @ (p - x)) / r, float(m @ (x - p)) / r
                there = abs(there) if elements.two_sided[k] else max(there, 0)
                total += (there**2 * max(here, 0) ** 2 / r**4) ** 2
            squares.append(total / 3)
        expected.append(elements.area[k] * math.sqrt(sum(squares) / len(squares)))
    assert sum(x > 0 for x in expected) >= 7
    for chunk in (1 << 16, 2):
        np.testing.assert_allclose(facing_weight(elements, wall, normals, chunk), expected, rtol=1e-10)


def test_a_curve_that_keeps_neighbours_together():
    """The bits of three coordinates in turn, the last one's foremost; equal ones stay in their order."""
    points = np.array([[0.0, 0, 0], [7, 1, 2], [1, 0, 0], [0, 1, 0], [0, 0, 1], [3, 5, 4], [1, 0, 0], [2, 0, 0]])

    def code(x, y, z):
        return sum((((x >> b) & 1) << 3 * b) + (((y >> b) & 1) << 3 * b + 1) + (((z >> b) & 1) << 3 * b + 2)
                   for b in range(3))  # fmt: skip

    expected = sorted(range(8), key=lambda k: code(*points[k].astype(int).tolist()))
    assert morton_order(points, 3).tolist() == expected
    assert morton_order(points + np.array([3.0, -2.0, 9.0]), 3).tolist() == expected
    assert morton_order(points[:0]).shape == (0,) and morton_order(points[:1]).tolist() == [0]
    assert morton_order(np.ones((3, 3))).tolist() == [0, 1, 2]


# ------------------------------------------------------------------------------------------------------------- tiles


def test_tiles_along_the_two_widest_directions():
    """An oblong scan, tilted: 2 m by 0.9 m before geometry at 0.4 m are three tiles by two."""
    u, v = (axis.ravel() for axis in np.meshgrid((np.arange(12) + 0.5) / 6 - 1, (np.arange(6) - 2.5) * 0.18))
    across, up = np.array([0.6, 0.0, 0.8]), np.array([0.0, 1.0, 0.0])
    points = u[:, None] * across + v[:, None] * up + [5.0, 6.0, 7.0]
    normals = np.tile(np.cross(across, up), (72, 1))
    tiles = ScanTiles(points, normals, 0.4)
    assert tiles.count == 6 and np.bincount(tiles.tile).tolist() == [12] * 6
    for t in range(6):
        own = points[tiles.tile == t]
        assert np.ptp(own @ across) == pytest.approx(0.5) and np.ptp(own @ up) == pytest.approx(0.36)
        # Twenty-five of them, from the first to the last in equal steps.
        chosen = np.linspace(0, 11, 25).round().astype(int)
        np.testing.assert_array_equal(tiles.points[t], own[chosen])
        assert tiles.normals[t].shape == (25, 3)
    assert tiles.tile_per_point().numpy().tolist() == tiles.tile.tolist()
    # Of width 11/6 m, one tile from 11/12 m on, and four at most.
    assert [ScanTiles(points, normals, d).count for d in (0.917, 0.916, 0.01)] == [1, 2, 16]


def test_the_distance_of_the_nearest_vertex():
    vertices = np.array([[3.0, 4.0, 12.0], [1.0, 2.0, 2.0], [0.5, -7.0, 1.0]])
    assert distance_to(vertices, np.array([[0.0, 0, 0], [0.0, 0.0, -5.0]])) == 3.0
    assert distance_to(vertices, np.array([[0.0, 0.0, -5.0], [3.0, 4.0, 11.5]])) == 0.5
