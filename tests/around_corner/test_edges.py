"""Tables of edges, and which parts of a scene may hide which."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scipy.optimize

from support.hidden_shapes import ball, join, mannequin, mesh, plate, wall_grid
from torchtransient.plugins.around_corner import outline_table as edges_module
from torchtransient.plugins.around_corner import outline_table as hiding
from torchtransient.plugins.around_corner.outline_table import Edges, OutlineTable, hiding_pairs, parts_of
from torchtransient.plugins.edges.joined import APART, Triangles

VARIANT = "llvm_ad_mono"


def edges_of(*meshes):
    triangles = Triangles.from_meshes(list(meshes))
    return triangles, Edges.from_faces(triangles, np.arange(len(triangles.faces)))


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
    triangles = Triangles.from_meshes([mesh("body", mannequin(1)), mesh("plate", plate(1, 1, (0, 0, 2)))])
    label = triangles.parts()
    assert len(np.unique(label)) == 7
    assert [len(np.unique(label[triangles.mesh == m])) for m in (0, 1)] == [6, 1]


def test_closed_bodies_that_touch_in_one_place_are_one_part():
    """Its coordinates may be zeros of either sign."""
    corners = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1.0]])
    faces = [[x, y, z] if (x + y + z) % 2 else [y, x, z] for x in (0, 1) for y in (2, 3) for z in (4, 5)]
    aside = np.array([1, 0, 0])
    one, other = corners + aside, corners - aside
    other[0] = [-0.0, -0.0, 0.0]
    assert len(parts_of([mesh("both", join((one, np.array(faces)), (other, np.array(faces))))])[0]) == 1


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


# ----------------------------------------------------------------------------------------------------- tables of edges


def page_at(angle, x=0.0):
    """A triangle at the line x = 0, z = 0, turned by an angle from the plane z = 0."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[x, 0, 0], [x, 1, 0], [x + c, 0.2, s]]), np.array([[0, 1, 2]])


@pytest.mark.parametrize(("angle", "edge"), [(1.2e-3, False), (1.7e-3, True), (0.5, True)])
def test_creases_that_are_almost_flat_are_none(angle, edge):
    """Of less than 1.4e-3 radians."""
    triangles, edges = edges_of(mesh("roof", join(page_at(0), page_at(np.pi - angle))))
    spine = np.all(triangles.vertices[edges.ends][:, :, 0] == 0, axis=1)
    assert (len(edges.ends), spine.sum()) == (4 + edge, int(edge))


@pytest.mark.parametrize(("apart", "rims"), [(3e-7, 4), (3e-5, 6)])
def test_rims_that_are_apart(apart, rims):
    """By more than a hundred thousandth of their length they are two."""
    _, edges = edges_of(mesh("one", page_at(0)), mesh("other", page_at(np.pi, apart)))
    assert edges.share.sum() == pytest.approx(rims)


def test_rims_that_are_near_are_one_wherever_they_lie():
    """Nearer than half of that, or of their distance from the origin, along every axis."""
    rng = np.random.default_rng(6)
    place = rng.uniform(-0.4, 0.4, (60, 1, 3)) + np.linspace(0, 99, 60)[:, None, None] * [1, 0, 0]
    rim, third = place + rng.normal(size=(60, 2, 3)) * 0.2, rng.normal(size=(60, 1, 3)) * 0.2
    v = np.concatenate([rim, place + third], 1)
    cell = APART * np.abs(rim).max(2).min(1)[:, None, None]
    w = np.concatenate([rim + 0.38 * cell * rng.choice([-1, 1], (60, 1, 3)), place - third], 1)
    faces = np.arange(180).reshape(60, 3)
    _, edges = edges_of(mesh("one", (v.reshape(-1, 3), faces)), mesh("other", (w.reshape(-1, 3), faces)))
    assert edges.share.sum() == pytest.approx(300)


def test_faces_without_area_are_left_out():
    v, f = page_at(0.4, 0.5)
    none = [[0, 1, 1], [1, 2, 2], [1, 1, 2], [2, 0, 2]]
    triangles, edges = edges_of(mesh("page", (v, np.concatenate([none[:2], f, none[2:]]))))
    assert triangles.faces.tolist() == [[0, 1, 2]] and len(edges.ends) == 3 and triangles.mesh.tolist() == [0]


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


def test_faces_seen_edge_on_have_no_outline():
    """From the very plane of a face: a viewpoint at one side of it sees one."""
    edge = np.array([[[0, -1, 3], [0, 1, 3], [0, 0, 5], [0, 0, 5.0]]])
    up = np.array([[0, 0, 1.0]])
    assert edges_module._weights_of_some(edge, np.zeros((1, 3)), up).tolist() == [0]
    beside = np.array([[4.0, 0, 0]])
    assert edges_module._weights_of_some(edge, beside, up)[0] == pytest.approx(2 / 25 * 0.6)
    # One face on each side of the line of sight: a crease that is crossed.
    edge[0, 3] = [-9, 0, 3]
    assert edges_module._weights_of_some(edge, beside, up).tolist() == [0]


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


# ----------------------------------------------------------------------------------------------------------- who hides


def test_planes_through_viewpoints_are_found_where_there_are_some():
    """By linear programs: a plane with all of one body above it and all of the other below."""
    rng, seen = np.random.default_rng(3), [0, 0]
    for _ in range(60):
        a, b = (rng.normal(size=(4, 3)) * 0.8 + rng.normal(size=3) * 0.7 + [0, 0, 3] for _ in range(2))
        q = rng.normal(size=3) * 0.5
        # A plane through a viewpoint parts near points from far ones as well.
        a, b = (q + (each - q) * 10 ** rng.uniform(0, 3, (4, 1)) for each in (a, b))
        u = np.concatenate([a - q, q - b])
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        # Largest t with n . u >= t in a box of normals.
        bounds = [(-1, 1)] * 3 + [(0, 1)]
        plan = scipy.optimize.linprog([0, 0, 0, -1], np.c_[-u, np.ones(8)], np.zeros(8), bounds=bounds)
        apart = bool(hiding._cones_apart(a, b, q[None])[0])
        if -plan.fun > 0.1:
            seen[1] += 1
            assert apart
        elif -plan.fun < 1e-9:
            seen[0] += 1
            assert not apart
    assert min(seen) > 10


def test_planes_that_were_found_stay():
    """While others are still looked for: three directions around an axis, which a step to one of them would leave."""
    angle = np.arange(3) * 2 * np.pi / 3
    u = np.stack([np.cos(angle), np.sin(angle), [0.05] * 3], 1)
    a, b = u[:2], -u[2:]
    behind = b[0] + 2 * (b[0] - a[0])
    assert hiding._cones_apart(a, b, np.array([[0, 0, 0], behind])).tolist() == [True, False]


def test_planes_through_very_many_viewpoints():
    """Each has its own answer, in whichever block it is."""
    a, b = np.array([[1.0, 0, 2], [1, 1, 3]]), np.array([[-1.0, 0, 2], [-2, 1, 4]])
    # Between the two there is a plane; from beside them one lies behind the other.
    beside = a[0] + 2 * (a[0] - b[0])
    viewpoints = np.tile([0.1, 0.2, -1.0], (8200, 1))
    hidden = [0, 4095, 4097, 8193, 8199]
    viewpoints[hidden] = beside
    assert np.flatnonzero(~hiding._cones_apart(a, b, viewpoints)).tolist() == hidden


def test_what_lies_beyond_hides_nothing():
    """Behind what may be hidden and all viewpoints; in one plane it does not, either."""
    points, _ = wall_grid(3)
    (near, far), _ = parts_of([mesh("near", plate(1, 1, (0, 0, 0.8))), mesh("far", plate(3, 1, (0, 0, 1.2)))])
    assert hiding._is_beyond(far, near, points) and not hiding._is_beyond(near, far, points)
    (left, right), _ = parts_of([mesh("left", plate(1, 1, (-1, 0, 1))), mesh("right", plate(1, 1, (1, 0, 1)))])
    assert hiding._is_beyond(left, right, points) and hiding._is_beyond(right, left, points)
    # To rounding of their size, wherever they are.
    for nearer, beyond in ((0.8, True), (1.3, False)):
        z = 101 - nearer * hiding.ROUNDING * 5
        left.corners[:, 2], right.corners[:, 2] = z, 101
        far_off = wall_grid(3, 3.75)[0] + [0, 0, 100]
        assert hiding._is_beyond(left, right, far_off) is beyond


def test_shapes_without_triangles():
    """Tubes show their inside; spheres and disks hide nothing of themselves."""
    kinds = [mi.load_dict({"type": kind}) for kind in ("sphere", "disk", "cylinder")]
    parts, _ = parts_of(kinds)
    assert [(part.hides_itself, part.edges, set(part.shapes)) for part in parts] == [
        (False, None, {0}), (False, None, {1}), (True, None, {2}),
    ]  # fmt: skip
    assert sorted(map(tuple, parts[0].corners.round(5))) == [
        (x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)
    ]


def test_scenes_of_very_many_parts(monkeypatch):
    """Each may hide another one; connected pieces of a mesh count as one part."""
    shapes = [mesh("pair", join(plate(1, 1, (-2, 0, 1)), plate(1, 1, (2, 0, 1)))), mesh("one", plate(1, 1, (0, 0, 1)))]
    assert len(parts_of(shapes)[0]) == 3
    monkeypatch.setattr(hiding, "MOST_PARTS", 2)
    parts, _ = parts_of(shapes)
    assert [set(part.shapes) for part in parts] == [{0}, {1}]
    points, _ = wall_grid(2)
    beside = [parts_of([one])[0][0] for one in (shapes[1], mesh("far", plate(1, 1, (9, 0, 1))),
                                                mesh("farther", plate(1, 1, (-9, 0, 1))))]  # fmt: skip
    assert hiding_pairs(beside[:2], points, lambda i, j: True) == []
    assert hiding_pairs(beside, points, lambda i, j: True) == [(0, 1), (1, 0), (2, 0)]
    assert hiding_pairs(beside, points, lambda i, j: (i, j) != (0, 1) and i != 1) == [(0, 2), (2, 0)]


def test_bodies_of_many_corners_are_in_a_box(monkeypatch):
    v, f = ball([0.3, 0.2, 1.0], [0.3, 0.1, 0.2], 1)
    c, s = np.cos(0.5), np.sin(0.5)
    body = mesh("ball", (v @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]), f))
    (every,), triangles = parts_of([body])
    monkeypatch.setattr(hiding, "MOST_CORNERS", 8)
    (boxed,), _ = parts_of([body])
    assert (len(every.corners), len(boxed.corners)) == (len(v), 8)
    np.testing.assert_allclose(boxed.planes @ boxed.planes.T, np.eye(3), atol=1e-6)
    for end in ("min", "max"):
        of_box, of_body = (getattr(each @ boxed.planes.T, end)(0) for each in (boxed.corners, triangles.vertices))
        np.testing.assert_allclose(of_box, of_body, atol=1e-6)
    for most, unknown in ((len(v) * len(f), False), (len(v) * len(f) - 1, True)):
        monkeypatch.setattr(hiding, "MOST_PRODUCTS", most)
        assert parts_of([body])[0][0].hides_itself is unknown
