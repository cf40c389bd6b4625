"""Lights that move, and vertices that move before them: what both strategies make of it, by differences of geometry."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.moving_points import MOVE, PLACE, attached_zero, difference, painted_lamp, slopes, unit, vector
from torchtransient.plugins.transport.emitter_connections import EmitterSampled
from torchtransient.plugins.transport.strategy import Local

VARIANT = "llvm_ad_rgb"
LAMP, DRIFT = np.array([1.2, 0.7, 2.1]), np.array([-0.5, 0.2, 0.3])
NORMAL, TURN = unit(np.array([0.2, -0.3, -1.0])), np.array([0.5, -0.7, 0.4])
AREA = 0.9


def light_of(x, kind, moves=True):
    """The attached point of a light at ``LAMP``."""
    to = LAMP - PLACE
    ds = Local(d=mi.Vector3f(*unit(to).tolist()), dist=mi.Float(float(np.linalg.norm(to))))
    surface, far = kind == "surface", kind == "far"
    n = vector(mi.Normal3f, NORMAL, TURN if moves else 0 * TURN, x)
    p = vector(mi.Point3f, LAMP, DRIFT if moves else 0 * DRIFT, x)
    area = 1 + AREA * x if moves else mi.Float(1)
    return Local(ds=ds, near=mi.Bool(not far), far=mi.Bool(far), surface=mi.Bool(surface), p=p, face_n=mi.Normal3f(n),
                 n=mi.Normal3f(n), uv=mi.Point2f(0), area=area, found=None)  # fmt: skip


def moved(kind, radius, shape=True, moves=True):
    """(the light, slopes of its direction, point, length and measure) where vertex and light move."""
    x = attached_zero()
    si = Local(p=mi.Point3f(vector(mi.Point3f, PLACE, MOVE, x)))
    light = light_of(x, kind, moves)
    vertex = Local(scattered_si=si, damping_radius=mi.Float(radius))
    world, wanted = Local(contents=Local(patterned_lights=False)), Local(emitter_shape=shape)
    d = EmitterSampled()._move(world, vertex, light, wanted)
    assert not np.array(light.longer).any() and np.array(light.J)[0] == 1
    return light, slopes(x, d, light.p, light.longer, light.J)


@pytest.mark.parametrize("kind", ["surface", "point"])
@pytest.mark.parametrize("moves", [True, False])
def test_points_of_lights_as_their_vertex_moves(kind, moves):
    """Nothing slides at a distance: direction, length and, of a surface, the solid angle are those of two points."""
    _, (turned, went, longer, J) = moved(kind, 0.5, moves=moves)
    drift, turn, area = (DRIFT, TURN, AREA) if moves else (0 * DRIFT, 0 * TURN, 0)

    def to(h):
        return LAMP + h * drift - PLACE - h * MOVE

    def angle(h):
        r = np.linalg.norm(to(h))
        return (1 + h * area) * abs((NORMAL + h * turn) @ to(h)) / r**3

    np.testing.assert_allclose(turned, difference(lambda h: unit(to(h))), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(went, drift, rtol=1e-5, atol=1e-6)
    assert longer == pytest.approx(difference(lambda h: np.linalg.norm(to(h))), rel=1e-4)
    assert J[0] == pytest.approx(difference(angle) / angle(0) if kind == "surface" else 0, rel=1e-4)


@pytest.mark.parametrize("moves", [True, False])
def test_points_of_near_lights_slide_on_their_surface(moves):
    """Along it, by as much as the ray to them is shifted; direction and length are those between where both have gone.
    The points of lights without a surface stay.
    """
    drift = DRIFT if moves else 0 * DRIFT
    radius = 3.0
    r = np.linalg.norm(LAMP - PLACE)
    share = (1 - (r / radius) ** 2) ** 2
    d = unit(LAMP - PLACE)
    δ = MOVE - drift
    drag = share * (δ - d * (d @ δ))
    slid = drag - d * (NORMAL @ drag) / (NORMAL @ d)
    assert np.linalg.norm(slid) > 0.01
    _, (turned, went, longer, _) = moved("surface", radius, moves=moves)
    np.testing.assert_allclose(went, drift + slid, rtol=1e-4, atol=1e-6)

    def to(h):
        return LAMP + h * went - PLACE - h * MOVE

    np.testing.assert_allclose(turned, difference(lambda h: unit(to(h))), rtol=1e-3, atol=1e-5)
    assert longer == pytest.approx(difference(lambda h: np.linalg.norm(to(h))), rel=1e-3)
    _, (_, went, longer, J) = moved("point", radius, moves=moves)
    np.testing.assert_allclose(went, drift, rtol=1e-5, atol=1e-7)
    assert J == 0 and longer == pytest.approx(-δ @ d, rel=1e-4)


def test_distant_light_stays_where_it_is():
    _, (turned, _, longer, J) = moved("far", 3.0, moves=False)
    assert not turned.any() and longer == 0 and J == 0


def test_lights_that_keep_their_shape():
    """Of a vertex that moves alone: what a normal and an area could say is not asked."""
    light, (_, _, _, J) = moved("surface", 0.5, shape=False, moves=False)
    to = LAMP - PLACE

    def angle(h):
        return abs(NORMAL @ (to - h * MOVE)) / np.linalg.norm(to - h * MOVE) ** 3

    assert J[0] == pytest.approx(difference(angle) / angle(0), rel=1e-4)
    x = attached_zero()
    world, wanted = Local(contents=Local(patterned_lights=False)), Local(emitter_shape=False)
    light = light_of(x, "surface")
    light.p = mi.Point3f(*LAMP.tolist())
    vertex = Local(scattered_si=Local(p=mi.Point3f(*PLACE.tolist())), damping_radius=mi.Float(0.5))
    EmitterSampled()._move(world, vertex, light, wanted)
    assert not slopes(x, light.J)[0].any()


@pytest.fixture(scope="module")
def painted():
    return painted_lamp()


def test_points_of_near_patterned_lights_slide_over_the_pattern(painted):
    """By the texture coordinates of where they slide to."""
    x, origin, d = attached_zero(), np.array([0.2, -0.1, 0.5]), unit(np.array([0.2, 0.3, 1.0]))
    ray = mi.Ray3f(mi.Point3f(*origin.tolist()), mi.Vector3f(*d.tolist()))
    pi = painted.ray_intersect_preliminary(ray)
    found = pi.compute_surface_interaction(ray)
    r = float(found.t[0])
    light = Local(ds=Local(d=ray.d, dist=mi.Float(r)), near=mi.Bool(True), surface=mi.Bool(True), p=mi.Point3f(found.p),
                  face_n=mi.Normal3f(found.n), n=mi.Normal3f(found.n), uv=mi.Point2f(found.uv), area=mi.Float(1),
                  found=(ray, pi, mi.Bool(True), found.n))  # fmt: skip
    si = Local(p=mi.Point3f(vector(mi.Point3f, origin, MOVE, x)))
    world = Local(contents=Local(patterned_lights=True))
    EmitterSampled()._move(world, Local(scattered_si=si, damping_radius=mi.Float(3)), light, Local(emitter_shape=False))
    went, over, n = slopes(x, light.p, light.uv, light.n)
    # u falls along x, since the lamp looks down; it is two metres wide, and three along v.
    np.testing.assert_allclose(over, [-went[0] / 2, went[1] / 3], rtol=1e-4)
    assert abs(over).min() > 0.01 and not n.any() and abs(went[2]) < 1e-6
    np.testing.assert_allclose(np.array(light.uv), np.array(found.uv))


def test_points_of_near_round_lights_turn_their_normal():
    """By where they slide to, over the radius: only a pattern asks for it."""
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere", "center": [0, 0, 2], "radius": 0.8}})
    ray = mi.Ray3f(mi.Point3f(0.2, -0.1, 0.5), mi.Vector3f(*unit(np.array([0.02, 0.1, 1.0])).tolist()))
    pi = scene.ray_intersect_preliminary(ray)
    found = pi.compute_surface_interaction(ray)
    for patterned in (False, True):
        x = attached_zero()
        light = Local(ds=Local(d=ray.d, dist=found.t), near=mi.Bool(True), surface=mi.Bool(True), p=mi.Point3f(found.p),
                      face_n=mi.Normal3f(found.n), n=mi.Normal3f(found.sh_frame.n), uv=mi.Point2f(found.uv),
                      area=mi.Float(1), found=(ray, pi, mi.Bool(True), found.n))  # fmt: skip
        si = Local(p=mi.Point3f(vector(mi.Point3f, np.array([0.2, -0.1, 0.5]), MOVE, x)))
        world = Local(contents=Local(patterned_lights=patterned))
        vertex = Local(scattered_si=si, damping_radius=mi.Float(3))
        EmitterSampled()._move(world, vertex, light, Local(emitter_shape=False))
        went, turned = slopes(x, light.p, light.n)
        np.testing.assert_allclose(turned, went / 0.8 * patterned, rtol=1e-3, atol=1e-5)
        assert np.linalg.norm(went) > 0.05
        np.testing.assert_allclose(np.array(light.n), np.array(found.n), atol=1e-6)


def test_points_follow_the_shape_of_their_light():
    """Place, normal, texture coordinates and area are those of the triangle as it moves, where it was found."""
    lamp = mi.Mesh("lamp", 3, 1, has_vertex_texcoords=True)
    params = mi.traverse(lamp)
    corners = np.array([[-2, -1.5, 2], [2, -1, 2], [0.5, 3, 2]])
    uv = np.array([[0.1, 0.2], [0.9, 0.3], [0.4, 0.8]])
    params["vertex_positions"], params["vertex_texcoords"] = mi.Float(corners.ravel()), mi.Float(uv.ravel())
    params["faces"] = mi.UInt32([0, 2, 1])
    params.update()
    scene = mi.load_dict({"type": "scene", "lamp": lamp})
    params, x = mi.traverse(scene), attached_zero()
    turn, drift = np.random.default_rng(4).normal(size=(2, 3, 3))
    drift = drift[:, :2]
    params["lamp.vertex_positions"] = mi.Float(corners.ravel()) + mi.Float(turn.ravel()) * x
    params["lamp.vertex_texcoords"] = mi.Float(uv.ravel()) + mi.Float(drift.ravel()) * x
    params.update()
    ray = mi.Ray3f(mi.Point3f(0.2, -0.1, 0.5), mi.Vector3f(*unit(np.array([0.02, 0.1, 1.0])).tolist()))
    with dr.suspend_grad():
        pi = scene.ray_intersect_preliminary(ray)
        found = pi.compute_surface_interaction(ray)
    assert bool(pi.is_valid()[0])
    there = mi.Bool([True, False])
    light = Local(p=mi.Point3f(1, 2, 3), n=mi.Normal3f(4, 5, 6), face_n=mi.Normal3f(7, 8, 9), uv=mi.Point2f(3, 4),
                  found=(ray, pi, there, found.n))  # fmt: skip
    meshes = Local(lists=lambda shape: mi.Bool(True))
    world = Local(contents=Local(emitting_meshes=meshes))
    EmitterSampled()._follow_shape(world, None, light)
    given = [light.p, light.n, light.face_n, light.uv, light.area]
    for value, number in zip(given, ([1, 2, 3], [4, 5, 6], [7, 8, 9], [3, 4], [1]), strict=True):
        np.testing.assert_array_equal(np.array(value).reshape(len(number), -1)[:, 0], number)
    went, turned, face, over, area = (v.reshape(-1, 2) for v in slopes(x, *given))
    b1, b2 = np.array(pi.prim_uv).ravel()
    share = np.array([1 - b1 - b2, b1, b2])[[0, 2, 1]]

    def normal(h):
        a, b, c = corners + h * turn
        return np.cross(c - a, b - a)

    np.testing.assert_allclose(went, np.outer(share @ turn, [1, 0]), rtol=1e-4, atol=1e-5)
    rotated = difference(lambda h: unit(normal(h)))
    np.testing.assert_allclose(turned, np.outer(rotated, [1, 0]), rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(face, turned, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(over, np.outer(share @ drift, [1, 0]), rtol=1e-4, atol=1e-5)
    grown = difference(lambda h: np.linalg.norm(normal(h))) / np.linalg.norm(normal(0))
    np.testing.assert_allclose(area, [[grown, 0]], rtol=1e-3)


def test_light_of_a_point_that_slides_over_a_pattern(painted):
    """Emission over density, as the pattern says where the point has gone, and the measure of solid angles."""
    x, wanted = attached_zero(), Local(geometry=True, emitter_shape=False, light=False, sphere_lights=False)
    ref = dr.zeros(mi.SurfaceInteraction3f)
    ref.p, ref.n = mi.Point3f(0.2, -0.1, 0.5), mi.Normal3f(0, 0, 1)
    ds, weight = painted.sample_emitter_direction(ref, mi.Point2f(0.3, 0.6), False)
    uv = np.array(ds.uv).ravel()
    light = Local(ds=ds, weight=weight, J=1 + 0.3 * x, longer=0.7 * x, p=mi.Point3f(ds.p), n=mi.Normal3f(ds.n),
                  uv=mi.Point2f(mi.Point2f(ds.uv) + mi.Vector2f(0.2, -0.4) * x))  # fmt: skip
    world = Local(scene=painted, contents=Local(patterned_lights=True))
    value = EmitterSampled._emission(world, ref, light, mi.Vector3f(ds.d), mi.Bool(True), wanted)
    np.testing.assert_array_equal(np.array(value), np.array(weight))
    plain = 7 * np.array([uv[0], uv[1], 1]) / float(ds.pdf[0])
    np.testing.assert_allclose(np.array(value).ravel(), plain, rtol=1e-3)
    (slope,) = slopes(x, value)
    np.testing.assert_allclose(slope, 0.3 * plain + 7 * np.array([0.2, -0.4, 0]) / float(ds.pdf[0]), rtol=2e-3)


@pytest.mark.parametrize("moves", [None, "nothing", "emitter_shape", "light", "sphere_lights", "pattern"])
def test_emission_that_changes(moves):
    """Over the density of the sample; none where that is zero. What a light that fills a cone sends is known whole, and
    has its own measure. Where its place, or a pattern, says what a light sends, it is that of the attached point.
    """
    x, asked, geometry = attached_zero(), [], moves is not None

    def emission(si, ds, active):
        asked.append(ds)
        return mi.Color3f(2, 3, 5) * (1 + 0.7 * x)

    ds = dr.zeros(mi.DirectionSample3f, 3)
    ds.pdf, ds.dist = mi.Float([4, 0, 4]), mi.Float(2)
    cone = mi.Bool([False, False, True])
    light = Local(ds=ds, weight=mi.Color3f(0.5, 0.75, 1.25), J=1 + 0.3 * x, longer=0.9 * x, cone=cone, uv=mi.Point2f(7),
                  cone_weight=mi.Color3f(1.1, 1.2, 1.3) * (1 + 0.2 * x), p=mi.Point3f(1), n=mi.Normal3f(3))  # fmt: skip
    world = Local(scene=Local(eval_emitter_direction=emission), contents=Local(patterned_lights=moves == "pattern"))
    d, kinds = (0.6, 0, 0.8), ("emitter_shape", "light", "sphere_lights")
    wanted = Local(geometry=geometry, **{kind: moves == kind for kind in kinds})
    value = EmitterSampled._emission(world, None, light, mi.Vector3f(*d), mi.Bool(True), wanted)
    np.testing.assert_array_equal(np.array(value)[:, 0], [0.5, 0.75, 1.25])
    found, longer = slopes(x, value, asked[0].dist)
    slope = np.array([0.5, 0.75, 1.25]) * (0.7 + 0.3 * geometry)
    last = np.array([1.1, 1.2, 1.3]) * 0.2 if moves == "sphere_lights" else slope
    np.testing.assert_allclose(found.reshape(3, 3).T, [slope, [0] * 3, last], rtol=1e-5)
    assert longer[0] == pytest.approx(0.9 * geometry)
    np.testing.assert_array_equal(np.array(asked[0].dist), 2)
    place = [0, 0, 0] if moves in (None, "nothing") else [1, 3, 7]
    assert [float(each.x[0]) for each in (asked[0].p, asked[0].n, asked[0].uv)] == place
    np.testing.assert_allclose(np.array(asked[0].d)[:, 0], d if geometry else 0, rtol=1e-6)
    assert not np.array(ds.uv).any(), "the sample itself stays as it was"


class Faces(EmitterSampled):
    """Faces of given normals, found or not."""

    def __init__(self, there, normal):
        self.there, self.normal = mi.Bool(there), mi.Normal3f(normal)

    def _found_by_ray(self, world, ref, ds, active):
        self.asked = np.array(active)
        return None, None, self.there & active, self.normal


def test_smooth_lights_are_sampled_by_their_faces():
    """The solid angle of a face in place of that of the interpolated normal; a face seen edge-on has none. Where the
    ray finds another surface, and of other lights, the sample stays as it is.
    """
    shaded = np.array([[0, 0, 0, 0, 1.0], [0.6] * 4 + [0], [-0.8] * 4 + [0]])
    normal = np.array([[0.6, 1, 0.8, 0.2, 0.6], [0, 0, 0, 0, 0], [-0.8, 0, -0.6, -0.4, -0.8]])
    normal[2, 0], normal[0, 0] = -0.28, 0.96
    connection = Faces([True, True, False, True, True], normal)
    ds = Local(n=mi.Normal3f(shaded), d=mi.Vector3f(0, 0, 1), pdf=mi.Float([3.0] * 5), emitter="lamp")
    lists = Local(lists=lambda emitter: mi.Bool([True, True, True, False, True]))
    world = Local(contents=Local(smooth_lights=lists))
    found, weight = connection._by_faces(world, None, ds, mi.Color3f(2, 3, 5), mi.Bool(True))
    ratio = np.array([0.28 / 0.8, 0, 1, 1, 1])
    np.testing.assert_allclose(np.array(weight), np.outer([2, 3, 5], ratio), rtol=1e-6)
    np.testing.assert_allclose(np.array(found.pdf), np.where(ratio > 0, 3 / np.maximum(ratio, 1e-9), 0), rtol=1e-6)
    assert connection.asked.tolist() == [True, True, True, False, True]
    connection._by_faces(world, None, ds, mi.Color3f(2, 3, 5), mi.Bool([False] * 5))
    assert not connection.asked.any()
