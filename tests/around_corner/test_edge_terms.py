"""The boundary term of mutual occlusion at single points of edges, by hand."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.marks import long_rows
from support.nlos_scenes import transform
from torchtransient.plugins.around_corner.occlusion import MutualOcclusion
from torchtransient.plugins.transport.strategy import Local

VARIANT = "llvm_ad_mono"

SHEET = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": 0.6}}
# Edge points, the edge's direction, third corners of both faces; whether there is a term.
EDGES = {
    "an outline": ((0.1, 0.2, 1.0), (0, 1, 0), ((0.5, 0.2, 1), (0.7, 0.1, 1.2)), True),
    "of the other side": ((0.1, 0.2, 1.0), (0, 1, 0), ((-0.5, 0.2, 1), (-0.7, 0.1, 1.2)), True),
    "a slope": ((0.1, 0.2, 1.0), (0.6, 0.64, 0.48), ((-0.5, 0.2, 1), (-0.7, 0.1, 1.2)), True),
    "a crease that is crossed": ((0.1, 0.2, 1.0), (0, 1, 0), ((0.5, 0.2, 1), (-0.7, 0.1, 1.2)), False),
    "along the line of sight": ((0.0, 0.0, 0.9), (0, 0, 1), ((0.5, 0.2, 1), (0.7, 0.1, 1.2)), False),
    "at the viewer": ((0.0, 0.0, 0.0), (0, 1, 0), ((0.5, 0.2, 1), (0.7, 0.1, 1.2)), False),
    "nothing behind": ((3.0, 0.2, 1.0), (0, 1, 0), ((3.5, 0.2, 1), (3.7, 0.1, 1.2)), False),
    "hidden itself": ((0.2, 0.2, 2.5), (0, 1, 0), ((0.5, 0.2, 2.5), (0.7, 0.1, 2.7)), False),
    "on what is behind": ((0.001, 0.2, 2.0), (0, 1, 0), ((0.5, 0.2, 1.9), (0.7, 0.1, 1.8)), True),
    "unseen by the other": ((0.1, -0.6, 1.0), (0, 1, 0), ((0.5, 0.2, 1), (0.7, 0.1, 1.2)), True),
    "spot not found": ((0.1, 0.2, 1.0), (0, 1, 0), ((0.5, 0.2, 1), (0.7, 0.1, 1.2)), False),
}  # fmt: skip


@pytest.mark.parametrize(("from_spot", "x"), long_rows([(False, 0), (True, 0), (False, 8), (True, 8)], [(True, 8)]))
def test_terms_of_single_points_of_edges(from_spot, x):
    """By hand: light of the point behind, past the edge out of what hides, and how fast the outline moves; of lanes
    without a term zero, and no derivatives. (Which have one, also far from the origin, where rays that meet nothing
    seem to end.)
    """
    back = SHEET | {"to_world": transform().translate([x, 0, 2]).rotate([0, 1, 0], 180).scale(2)}
    screen = SHEET | {"to_world": transform().translate([x - 0.36, -0.04, 0.4]).scale(0.05)}
    wall = SHEET | {"to_world": transform().translate([x, 0, 0])}
    scene = mi.load_dict({"type": "scene", "wall": wall, "back": back, "screen": screen}, optimize=False)
    count = len(EDGES)
    p, t = (np.array([row[i] for row in EDGES.values()], dtype=float) for i in (0, 1))
    sides = np.array([row[2] for row in EDGES.values()], dtype=float)
    found = np.arange(count) < count - 1
    q, other = np.array([x, 0.0, 0.0]), np.array([x - 0.5, 0.25, 0.0])
    p, sides = p + np.array([x, 0, 0]), sides + np.array([x, 0, 0])

    def at(place):
        ray = mi.Ray3f(mi.Point3f(mi.Float([float(place[0])] * count), float(place[1]), 1), mi.Vector3f(0, 0, -1))
        return ray, scene.ray_intersect(ray)

    ray, seen = at(other if from_spot else q)
    lit = at(q if from_spot else other)[1]
    edge = Local(p=mi.Point3f(p.T), t=mi.Vector3f(t.T), weight=mi.Float(np.arange(2.0, 2 + count)),
                 sides=[mi.Point3f(sides[:, i].T) for i in range(2)])  # fmt: skip
    place = Local(seen=seen, lit=lit, seen_at=mi.Point3f(seen.p), lit_at=mi.Point3f(lit.p), ray=ray, η=1.5,
                  found=mi.Bool(found), before=mi.Float64(0.25),
                  spot=Local(light=lambda d, active: mi.UnpolarizedSpectrum(0.3)))  # fmt: skip
    viewer = place.lit_at if from_spot else place.seen_at
    dr.enable_grad(edge.p, viewer)
    job, looked = term_of(scene), []
    half = job._seen_otherwise
    job._seen_otherwise = lambda *given: looked.append(given) or half(*given)
    term = job._term(place, edge, from_spot)
    active = np.array([row[3] for row in EDGES.values()])
    assert np.array(term.active).tolist() == active.tolist()
    value, outwards, opl = (np.array(each, dtype=float) for each in (term.value[0], term.outwards, term.opl))
    dr.backward(dr.sum(term.outwards))
    slopes = [np.array(dr.grad(each), dtype=float).T for each in (edge.p, viewer)]
    assert not value[~active].any() and not outwards[~active].any()
    assert not any(slope[~active].any() for slope in slopes)
    for i in np.flatnonzero(active if x == 0 else active & False):
        distance = np.linalg.norm(p[i] - q)
        d = (p[i] - q) / distance
        n = np.cross(t[i], d)
        spans = np.linalg.norm(n)
        n *= -np.sign(n @ (sides[i, 0] - p[i])) / spans
        past = d + n * 1e-4
        y = q + past * 2 / past[2]
        beyond = np.linalg.norm(y - q)
        ways = [y - place for place in ((other, q) if from_spot else (q, other))]
        r = [np.linalg.norm(way) for way in ways]
        cos = [way[2] / length for way, length in zip(ways, r, strict=True)]
        # Of the sensor's point, of the hidden one towards the spot, and what the spot sends.
        light = 0.6 / np.pi * cos[0] * 0.6 / np.pi * cos[1] * 0.3
        measure = cos[0] / (cos[1] * r[0] ** 2) if from_spot else 1 / r[1] ** 2
        light *= i != list(EDGES).index("unseen by the other")
        assert value[i] == pytest.approx(-(2 + i) * spans / distance * light * measure, rel=1e-3)
        assert opl[i] == pytest.approx(0.25 + 1.5 * sum(r), rel=1e-4)
        # Of the other side of the outline half of it is seen, or not.
        np.testing.assert_allclose(np.array(looked[0][3], dtype=float)[:, i], d - n * 1e-4, atol=1e-6)
        # Rays start a ten thousandth before the wall.
        assert outwards[i] == pytest.approx(n @ (d - (y - q) / beyond), abs=3e-5)
        np.testing.assert_allclose(slopes[0][i], n / distance, atol=1e-5)
        np.testing.assert_allclose(slopes[1][i], n / beyond - n / distance, atol=1e-5)


def term_of(scene, **world):
    """Of a scene without delays or windows."""
    given = {"counted": lambda active, opl: active,
             "scattering": Local(correct_two_sided=lambda world, bsdf, si, wo, value: value)}  # fmt: skip
    return MutualOcclusion(None, Local(scene=scene, **given | world), None, None, None, Local(confocal=False), [])


@pytest.mark.parametrize("confocal", [True, False])
@pytest.mark.parametrize("unwarp", [True, False])
def test_where_terms_of_a_launch_begin(confocal, unwarp):
    """With the ways from the sensor, where it counts, and to the spot; from the scanned point, and but for confocal
    captures from the spot; where both are found.
    """
    scene = mi.load_dict({"type": "scene", "wall": SHEET})
    ray = mi.Ray3f(mi.Point3f(mi.Float([0.5, 0.5, 9]), 0.25, 3), mi.Vector3f(0, 0, -1))
    spot = Local(valid=mi.Bool([True, False, True]), si="lit", p="lit at", leg=mi.Float(0.125))
    spots = Local(confocal=confocal, general_spot=lambda wavelengths, found: spot)
    integrator = Local(first_opl=lambda film, rays: mi.Float64(10))
    job = MutualOcclusion(integrator, Local(scene=scene, camera_unwarp=unwarp), None, None, None, spots, [])
    job._edge_point, asked = lambda pixel, job: "edge", []
    job._term = lambda place, edge, from_spot: asked.append((place, edge, from_spot)) or len(asked)
    for leg in (None, scene.ray_intersect_preliminary(ray)):
        asked.clear()
        views = job._terms(Local(ray=ray, leg=leg, η=1.5), "pixel", "job")
        assert views == ([1] if confocal else [1, 2])
        assert [(edge, from_spot) for _, edge, from_spot in asked] == [("edge", k == 1) for k in range(len(views))]
        place = asked[0][0]
        assert np.array(place.found).tolist() == [True, False, False] and (place.lit, place.lit_at) == ("lit", "lit at")
        assert np.array(place.before)[0] == pytest.approx(10.125 + (0 if unwarp else 4.5), rel=1e-6)
        np.testing.assert_allclose(np.array(place.seen_at)[:, 0], [0.5, 0.25, 0], atol=1e-6)


def test_points_that_are_seen_edge_on_send_nothing():
    """From either end, nor those at an end itself, nor those that the film does not count."""
    scene = mi.load_dict({"type": "scene", "wall": SHEET}, optimize=False)

    def at(*places):
        x, y = (mi.Float([float(place[i]) for place in places]) for i in (0, 1))
        return scene.ray_intersect(mi.Ray3f(mi.Point3f(x, y, 1), mi.Vector3f(0, 0, -1)))

    count = 8
    q, s, p = np.array([0.5, 0, 0]), np.array([0, 0.5, 0]), np.array([0.25, 0.25, 1.0])
    to_q, to_s = ((end - p) / np.linalg.norm(end - p) for end in (q, s))
    seen, lit, hidden = (at(*[place] * count) for place in (q, s, p))

    def across(d, cos):
        """A normal at this cosine to a direction."""
        e = np.cross(d, [0.3, 0.5, -0.2])
        return e / np.linalg.norm(e) + cos * d

    n = [[0, 0, -1], across(to_q, 0.5e-4), across(to_q, 2e-4), across(to_s, 0.5e-4), across(to_s, 2e-4),
         [0, 0, -1], [0, 0, -1], [0, 0, -1]]  # fmt: skip
    places = [p, p, p, p, p, q, s, p]
    hidden.p, hidden.n = mi.Point3f(np.array(places).T), mi.Normal3f(np.array(n).T)
    counted = mi.Bool([True] * 7 + [False])
    place = Local(seen=seen, lit=lit, ray=mi.Ray3f(mi.Point3f(0, 0, 1), mi.Vector3f(0, 0, -1)), η=1.0,
                  before=mi.Float64(0), spot=Local(light=lambda d, active: mi.UnpolarizedSpectrum(1)))  # fmt: skip
    job = term_of(scene, counted=lambda active, opl: active & counted)
    active = job._light(place, hidden, False, mi.Bool([True] * count))[2]
    assert np.array(active).tolist() == [True, False, True, False, True, False, False, False]


def test_half_of_a_point_is_seen_where_outlines_coincide():
    """From one viewpoint along the outline that is seen from the other: of both sides one counts."""
    back = SHEET | {"to_world": transform().translate([0, 0, 2]).rotate([0, 1, 0], 180).scale(2)}
    screen = SHEET | {"to_world": transform().translate([0.5, 0, 1]).scale(0.5)}
    scene = mi.load_dict({"type": "scene", "back": back, "screen": screen}, optimize=False)
    viewer = dr.zeros(mi.SurfaceInteraction3f, 3)
    viewer.p = mi.Point3f(0, 0.1, -0.5)
    # Past the rim x = 0 of the screen, on its free side, and on either side all of the way.
    x, d = np.array([-1e-3, -0.5, 0.5]), np.array([[1e-3, 0, 1], [-0.2, 0, 1], [0.2, 0, 1.0]])
    si = dr.zeros(mi.SurfaceInteraction3f, 3)
    si.p, si.n = mi.Point3f(mi.Float(x.astype(np.float32)), 0.1, 2), mi.Normal3f(0, 0, -1)
    other = Local(p=mi.Point3f(0, -0.2, -0.5))
    found = term_of(scene)._seen_otherwise(other, viewer, si, mi.Vector3f(d.T), mi.Bool([True] * 3))
    assert np.array(found).tolist() == [0.5, 1, 0]
