"""Points of meshes that move, from one table of their vertices."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.gradient_cases.cases_curves import file_of
from support.hidden_shapes import wall_grid
from torchtransient.errors import SceneError
from torchtransient.plugins.sampling.hidden_elements import HiddenElements
from torchtransient.plugins.transport.guides import HiddenGeometry, shape_hit
from torchtransient.plugins.transport.strategy import Guide, Local
from torchtransient.plugins.transport.surface_scattering import Surface
from torchtransient.plugins.transport.vacuum import AttachedTriangles

VARIANT = "llvm_ad_mono"
SHEETS = {
    "two": "v -1 -1 0\nv 1 -1 0.2\nv 1 1 0\nv -1 1.5 0.1\nf 1 2 3\nf 1 3 4\n",
    "one": "v 2 -1 0\nv 4.5 -1 0.5\nv 2 1.5 0.3\nf 1 2 3\n",
    "still": "v -5 -1 0\nv -3 -1 0\nv -3 1 0\nf 1 2 3\n",
    "three": "v 5 -1 0\nv 7 -1 0.1\nv 7 1 0\nv 5 1 0.2\nv 6 3 0\nf 1 2 3\nf 1 3 4\nf 4 3 5\n",
}
PLACES = [[0.4, -0.3, 9], [-0.5, 0.4, 9], [2.4, -0.5, 9], [-3.5, -0.5, 9], [6.5, -0.5, 9], [6, 2, 9], [2.4, -0.5, 9]]


def sheet(name):
    return {"type": "obj", "filename": file_of(f"sheet {name}.obj", SHEETS[name]), "face_normals": True}


def scene_with(moving):
    """(scene, unknown, rays that meet every sheet): the vertices of ``moving`` go where ``motion_of`` says."""
    scene = mi.load_dict({"type": "scene", **{name: sheet(name) for name in SHEETS}}, optimize=False)
    params, x = mi.traverse(scene), mi.Float(0)
    dr.enable_grad(x)
    for name in moving:
        key = f"{name}.vertex_positions"
        params[key] = mi.Float(params[key]) + mi.Float(motion_of(name).ravel()) * (x + 0)
    params.update()
    return scene, x, mi.Ray3f(mi.Point3f(np.array(PLACES).T), mi.Vector3f(0, 0, -1))


def motion_of(name):
    return np.random.default_rng(len(name) + ord(name[0])).normal(size=(SHEETS[name].count("v"), 3))


def triangle(name, face):
    """(vertices, motions) of a face."""
    lines = [line.split() for line in SHEETS[name].splitlines()]
    vertices = np.array([line[1:] for line in lines if line[0] == "v"], dtype=float)
    corners = np.array([line[1:] for line in lines if line[0] == "f"], dtype=int)[face] - 1
    return vertices[corners], motion_of(name)[corners]


def table_of(scene, moving):
    shapes = scene.shapes()
    return AttachedTriangles(shapes, frozenset(shape.ptr for shape in shapes if shape.id() in moving))


def test_points_and_areas_follow_their_vertices():
    moving = ("two", "one", "three")
    scene, x, ray = scene_with(moving)
    table = table_of(scene, moving)
    pi = scene.ray_intersect_preliminary(ray)
    assert table.holds_all and len(table.tables()) == 1
    assert np.array(table.lists(pi.shape)).tolist() == [True, True, True, False, True, True, True]
    active = mi.Bool([True] * 6 + [False]) & table.lists(pi.shape)
    point = table.point(pi, active)
    dr.set_grad(x, 1)
    dr.enqueue(dr.ADMode.Forward, x)
    dr.traverse(dr.ADMode.Forward)
    slopes = [np.array(dr.grad(part)) for part in (point.p, point.across)]
    p, across, uv = np.array(point.p), np.array(point.across), np.array(pi.prim_uv)
    met = {0: ("two", 0), 1: ("two", 1), 2: ("one", 0), 4: ("three", 0), 5: ("three", 2)}
    for lane, (name, face) in met.items():
        (a, b, c), (da, db, dc) = triangle(name, face)
        u, v = uv[:, lane]
        np.testing.assert_allclose(p[:, lane], (1 - u - v) * a + u * b + v * c, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(p[:2, lane], PLACES[lane][:2], rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(across[:, lane], np.cross(b - a, c - a), rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(slopes[0][:, lane], (1 - u - v) * da + u * db + v * dc, rtol=1e-4, atol=1e-5)
        expected = np.cross(db - da, c - a) + np.cross(b - a, dc - da)
        np.testing.assert_allclose(slopes[1][:, lane], expected, rtol=1e-4, atol=1e-5)
    for lane in (3, 6):
        assert across[:, lane].tolist() == [0, 0, 1]
        assert not slopes[0][:, lane].any() and not slopes[1][:, lane].any()


def test_a_table_of_one_mesh_and_of_none():
    """Its own buffer; where no listed mesh moves, nothing is looked up."""
    scene, _, ray = scene_with(("one",))
    pi = scene.ray_intersect_preliminary(ray)
    one = table_of(scene, ("one",))
    assert one.holds_all and np.array(one.lists(pi.shape)).tolist() == [k in (2, 6) for k in range(7)]
    (a, b, c), _ = triangle("one", 0)
    across = np.array(one.point(pi, one.lists(pi.shape)).across)[:, 2]
    np.testing.assert_allclose(across, np.cross(b - a, c - a), rtol=1e-5)
    # A shape whose vertices are not attached moves otherwise: the table does not hold it.
    assert not table_of(scene, ("one", "two")).holds_all
    none = table_of(scene, ())
    assert none.holds_all and none.tables() == [] and not np.array(none.lists(pi.shape)).any()
    point = none.point(pi, mi.Bool(True))
    assert (np.array(point.p).ravel().tolist(), np.array(point.across).ravel().tolist()) == ([0, 0, 0], [0, 0, 1])


# ------------------------------------------------------------------------------------------------------------ guides


class Shared(Guide):
    def __init__(self, share):
        self.share = share


@pytest.mark.parametrize("shares", [(0.5, 0.5), (1.0,), (0.3, 0.0), (-0.1,), (0.4, 0.7)])
def test_shares_of_guides_that_leave_nothing(shares):
    said = ", ".join(map(str, shares))
    with pytest.raises(SceneError, match=f"positive shares that sum to less than one, got {said}"):
        Surface([Shared(share) for share in shares])


def test_what_guides_leave_to_the_scattering():
    assert Surface([Shared(0.25), Shared(0.5)]).own_share(0) == 0.25
    assert Surface().own_share(0) == 1
    guide = HiddenGeometry(None, 0.9, 0.25)
    assert np.array(guide.share_at(mi.UInt32([0, 1, 7]))) == pytest.approx([0.9, 0.25, 0.25])
    assert guide.share == 0.25


def test_the_density_of_a_hidden_point():
    """Per solid angle; of a shape's point alone, that of the triangle that a ray to it meets first."""
    scene = mi.load_dict({"type": "scene", "sheet": sheet("two"), "other": sheet("one")})
    shape, other = sorted(scene.shapes(), key=lambda shape: shape.id() != "sheet")
    elements = HiddenElements([shape], *wall_grid(3))
    guide = HiddenGeometry(elements, 0.9, 0.25)
    q = mi.Point3f([0.4, -0.5, 0.4, 0.3], [-0.3, 0.4, -0.3, -0.2], 0.1)
    p, n = mi.Point3f([0.5, 1.0, 0.5, 9.0], [1.0, 2.0, 1.0, 1.0], [3.0, 4.0, 3.0, 0.1]), mi.Normal3f(0.6, 0.0, 0.8)
    active, pointer = mi.Bool([True, True, False, True]), mi.ShapePtr(shape)

    def next_surface(world, ray, active):
        return scene.ray_intersect_preliminary(ray, active=active)

    world = Local(segment=Local(next_surface=next_surface))
    found = np.array(guide.density(world, p, q, n, pointer, active, mi.UInt32([0, 1, 0, 0])))
    per_area = np.array(elements.per_area(pointer, mi.UInt32([0, 1, 0, 0]), q, active))
    v = np.array(q, dtype=np.float64) - np.array(p)
    cos = np.abs(np.array([0.6, 0, 0.8]) @ v) / np.linalg.norm(v, axis=0)
    expected = per_area * (v**2).sum(0) / cos * [1, 1, 0, 1]
    assert abs(per_area[0] - per_area[1]) > 1e-3 * per_area[0]
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    looked_up = np.array(guide.density(world, p, q, n, pointer, active))
    np.testing.assert_allclose(looked_up[:3], expected[:3], rtol=1e-3)
    # Of what the ray does not meet, or of another shape, the first triangle will do.
    rays = mi.Ray3f(mi.Point3f([-0.5, 50.0, -0.5, -0.5], [0.4, 50.0, 0.4, 0.4], 5), mi.Vector3f(0, 0, -1))
    answers = [np.array(shape_hit(world, rays, mi.ShapePtr(one), active)).tolist() for one in (shape, other)]
    assert answers == [[1, 0, 0, 1], [0, 0, 0, 0]]
    # Along the surface there is no solid angle.
    along = mi.Point3f(5, 0, 0), mi.Point3f(1, 0, 0), mi.Normal3f(0, 0, 1)
    assert guide.density(world, *along, pointer, mi.Bool(True), mi.UInt32(0))[0] == 0
