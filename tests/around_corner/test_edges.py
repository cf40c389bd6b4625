"""Tables of edges, and which parts of a scene may hide which."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from support.hidden_shapes import ball, join, mannequin, mesh, plate, wall_grid
from torchtransient.plugins.around_corner.edges import Edges, Triangles
from torchtransient.plugins.around_corner.hiding import hiding_pairs, parts_of

VARIANT = "llvm_ad_mono"


def edges_of(*meshes):
    triangles = Triangles.of(list(meshes))
    return triangles, Edges.of(triangles, np.arange(len(triangles.faces)))


def test_a_plate_has_its_rim_alone():
    triangles, edges = edges_of(mesh("plate", plate(1, 1, (0, 0, 1), cells=3)))
    p = triangles.vertices[edges.ends]
    assert len(edges.ends) == 12 and not edges.closed
    assert np.isclose(np.linalg.norm(p[:, 0] - p[:, 1], axis=1).sum(), 4)
    assert np.array_equal(edges.sides[:, 0], edges.sides[:, 1])


def test_a_cube_has_twelve():
    """Its vertices are split; diagonals of its sides are flat."""
    _, edges = edges_of(mi.load_dict({"type": "cube"}))
    assert len(edges.ends) == 12 and edges.closed
    assert np.all(edges.sides[:, 0] != edges.sides[:, 1])


def test_three_pages_of_a_book():
    """Of three faces at an edge those on both sides of the widest gap count; none where no gap is wider than half a
    turn.
    """

    def page(angle):
        c, s = np.cos(angle), np.sin(angle)
        return np.array([[0, 0, 0], [0, 1, 0], [c, 0, s]]), np.array([[0, 1, 2]])

    triangles, edges = edges_of(mesh("book", join(page(0), page(0.4), page(1.0))))
    spine = np.flatnonzero(np.all(triangles.vertices[edges.ends][:, :, 0] == 0, axis=1))
    assert len(spine) == 1
    found = triangles.vertices[edges.sides[spine[0]]]
    assert {tuple(p.round(3)) for p in found} == {(1.0, 0.0, 0.0), (0.54, 0.0, 0.841)}
    triangles, edges = edges_of(mesh("star", join(page(0), page(2.1), page(4.2))))
    assert not np.any(np.all(triangles.vertices[edges.ends][:, :, 0] == 0, axis=1))


def test_rims_of_two_meshes_are_one_edge():
    """Each mesh has a share of it, also where it is off by a rounding."""
    flat, upright = plate(1, 1, (0, 0, 1)), plate(1, 1, (0, 0, 0))
    v = upright[0][:, [2, 1, 0]] + [0.5, 0, 1.5]
    triangles, edges = edges_of(mesh("flat", flat), mesh("upright", (v + 3e-7, upright[1])))
    assert len(edges.ends) == 8 and np.isclose(edges.share.sum(), 7)
    shared = edges.share == 0.5
    assert set(edges.mesh[shared]) == {0, 1} and shared.sum() == 2
    assert np.allclose(triangles.vertices[edges.ends[shared]][..., 0], 0.5)
    assert len(np.unique(triangles.parts())) == 1


def test_parts():
    """Connected pieces are told apart, over the borders of meshes."""
    triangles = Triangles.of([mesh("body", mannequin(1)), mesh("plate", plate(1, 1, (0, 0, 2)))])
    label = triangles.parts()
    assert len(np.unique(label)) == 7
    assert [len(np.unique(label[triangles.mesh == m])) for m in (0, 1)] == [6, 1]


def pairs(*shapes, points=None):
    """By number of the shape."""
    parts, _ = parts_of(list(shapes))
    points = wall_grid(5)[0] if points is None else points
    number = [next(iter(part.shapes)) for part in parts]
    return [(number[i], number[j]) for i, j in hiding_pairs(parts, points, lambda i, j: True)]


CASES = {
    "before": (plate(0.2, 0.2, (0.1, 0, 0.9)), [(0, 1)]),
    "beside, in one plane": (plate(0.2, 0.2, (1, 0, 1.2)), []),
    "beside": (plate(0.2, 0.2, (2.5, 0, 0.9)), []),
    "a ball before": (ball([0, 0, 0.6], [0.1, 0.1, 0.1], 1), [(0, 1)]),
}


@pytest.mark.parametrize("name", CASES)
def test_who_hides_whom(name):
    front, expected = CASES[name]
    assert pairs(mesh("front", front), mesh("back", plate(1, 1, (0, 0, 1.2)))) == expected


def test_a_body_hides_itself():
    """Unless it is flat, or convex and closed."""
    assert pairs(mesh("ball", ball([0, 0, 1], [0.2, 0.1, 0.1]))) == []
    v, f = ball([0, 0, 1], [0.2, 0.1, 0.1])
    assert pairs(mesh("open", (v, f[1:]))) == [(0, 0)]
    v[0, 0] -= 0.3
    assert pairs(mesh("dented", (v, f))) == [(0, 0)]


def test_no_hiding_is_missed():
    """Against rays from wall points through random pairs of bodies: where one is met behind the other, it is said."""
    rng = np.random.default_rng(1)
    points, _ = wall_grid(3)
    seen = 0
    for _ in range(30):
        bodies = [ball(rng.uniform([-1, -1, 0.4], [1, 1, 1.4]), rng.uniform(0.05, 0.5, 3), 1) for _ in range(2)]
        said = pairs(*(mesh(f"b{i}", b) for i, b in enumerate(bodies)), points=points)
        scenes = [mi.load_dict({"type": "scene", "b": mesh("b", b)}) for b in bodies]
        target = np.float32(np.concatenate([v for v, _ in bodies]))
        for q in points:
            ray = mi.Ray3f(mi.Point3f(q), mi.Vector3f((target - np.float32(q)).T))
            t = np.array([np.array(s.ray_intersect(ray).t) for s in scenes])
            both = np.isfinite(t).all(0)
            for i in range(2):
                hides = bool(np.any(both & (t[i] < t[1 - i])))
                seen += hides
                assert not hides or (i, 1 - i) in said
    assert seen > 10
