"""Tables of edges, and which parts of a scene may hide which."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from support.hidden_shapes import ball, join, mesh, wall_grid
from torchtransient.plugins.around_corner.outline_table import Edges, OutlineTable, hiding_pairs, parts_of
from torchtransient.plugins.edges.joined import Triangles

VARIANT = "llvm_ad_mono"


def edges_of(*meshes):
    triangles = Triangles.from_meshes(list(meshes))
    return triangles, Edges.from_faces(triangles, np.arange(len(triangles.faces)))


def pairs(*shapes, points=None):
    """By number of the shape."""
    parts, _ = parts_of(list(shapes))
    points = wall_grid(5)[0] if points is None else points
    number = [next(iter(part.shapes)) for part in parts]
    return [(number[i], number[j]) for i, j in hiding_pairs(parts, points, lambda i, j: True)]


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


# ----------------------------------------------------------------------------------------------------- tables of edges


def page_at(angle, x=0.0):
    """A triangle at the line x = 0, z = 0, turned by an angle from the plane z = 0."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[x, 0, 0], [x, 1, 0], [x + c, 0.2, s]]), np.array([[0, 1, 2]])


def hinged():
    """Two meshes that share an edge, a crease, and a page beside them."""
    other = page_at(2.0)[0] * [1, 1, 0.7]
    return [
        mesh("a", join(page_at(0.3), (page_at(0.3)[0] + [1.5, 0.1, 0.4], page_at(0)[1]))),
        mesh("b", (other, page_at(0)[1])),
    ]


def table_of_edges(viewpoints, normals):
    meshes = hinged()
    triangles, edges = edges_of(*meshes)
    return meshes, triangles, edges, OutlineTable(triangles, [edges], viewpoints, normals)


def seen_from(p, viewpoints, normals):
    """Root of the sum of squares of what an edge with these ends and sides spans from points that see it."""
    a, b, *sides = p
    middle, total = (a + b) / 2, 0.0
    for q, n in zip(viewpoints, normals, strict=True):
        r = np.linalg.norm(middle - q)
        spans, cos = np.linalg.norm(np.cross(b - a, middle - q)) / r, max(n @ (middle - q) / r, 0)
        first, second = (np.cross(b - a, middle - q) @ (side - middle) for side in sides)
        total += (first * second > 0) * (spans * cos / r**2) ** 2
    return total**0.5


def test_edges_are_drawn_by_what_is_seen_of_them():
    """Nine tenths by what they span as outlines, seen from points of the wall; one tenth by length."""
    rng = np.random.default_rng(2)
    viewpoints = rng.uniform([-1, -1, -2], [1, 1, -1], (7, 3))
    normals = rng.normal(size=(7, 3)) * 0.3 + [0, 0, 1]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[3] *= -1  # from behind a wall nothing is seen
    _, triangles, edges, table = table_of_edges(viewpoints, normals)
    order = np.argsort(edges.mesh, kind="stable")
    p = triangles.vertices[np.concatenate([edges.ends, edges.sides], 1)][order]
    weight = np.array([seen_from(one, viewpoints, normals) for one in p])
    length = np.linalg.norm(p[:, 1] - p[:, 0], axis=1)
    expected = 0.9 * weight / weight.sum() + 0.1 * length / length.sum()
    assert len(p) == 9 and (edges.share == 0.5).sum() == 2 and (weight == 0).any()
    x = (np.arange(20000) + 0.5) / 20000
    index, inverse = (np.array(each) for each in table.sample(mi.Float64(x)))
    np.testing.assert_allclose(np.bincount(index, minlength=9) / 20000, expected, atol=2e-4)
    np.testing.assert_allclose(inverse, (edges.share[order] / expected)[index], rtol=1e-4)
    every = mi.UInt32(np.arange(9))
    for found, column in zip([*table.end_points(every), *table.third_corners(every)], range(4), strict=True):
        np.testing.assert_allclose(np.array(found).T, p[:, column], rtol=1e-6, atol=1e-6)
    # Seen from nowhere, by length alone.
    unseen = table_of_edges(viewpoints, -np.abs(normals) * [0, 0, 1])[3]
    inverse = np.array(unseen.sample(mi.Float64(x))[1])
    assert set(np.round(inverse * 1000)) == set(np.round(edges.share[order] * length.sum() / length * 1000))


def test_edges_follow_the_vertices_of_their_meshes():
    meshes = hinged()
    params = [mi.traverse(one) for one in meshes]
    for one in params:
        dr.enable_grad(one["vertex_positions"])
        one.update()
    triangles, edges = edges_of(*meshes)
    viewpoints, normals = wall_grid(2)
    ends = OutlineTable(triangles, [edges], viewpoints - [0, 0, 2], normals).end_points(mi.UInt32(np.arange(9)))
    number = mi.Float(np.arange(1.0, 10))
    dr.backward(dr.sum(number * ends[0].x + 100 * number * ends[1].z))
    order, expected = np.argsort(edges.mesh, kind="stable"), np.zeros((9, 3))
    for row, (a, b) in enumerate(edges.ends[order], start=1):
        expected[a, 0] += row
        expected[b, 2] += 100 * row
    found = np.concatenate([np.array(dr.grad(one["vertex_positions"])).reshape(-1, 3) for one in params])
    np.testing.assert_allclose(found, expected, rtol=1e-6)
