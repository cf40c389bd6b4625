"""Light that moves and that paths run into: what is attached at the vertex before, by differences of geometry."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.moving_points import MOVE, PLACE, attached_zero, difference, painted_lamp, slopes, unit, vector
from torchtransient.plugins.sampling.distant import DistantReference
from torchtransient.plugins.transport.connection.emitter_found import EmitterFound
from torchtransient.plugins.transport.strategy import Local

VARIANT = "llvm_ad_rgb"


@pytest.fixture(scope="module")
def painted():
    """Which shines by the angle, too."""
    return painted_lamp(type="angulararea", cutoff_angle=90.0, beam_width=0.0)


def vertex_before(x, following, radius=0.5):
    """A vertex at ``PLACE`` that moves, with a throughput, a slope and an index that change."""
    si = Local(p=mi.Point3f(vector(mi.Point3f, PLACE, MOVE, x)))
    carry = Local(β=mi.Spectrum(0.5, 0.25, 2) * (1 + 0.11 * x), η=mi.Float(1.25) + 0.3 * x)
    return Local(scattered_si=si, v=Local(after=lambda: following), carry=carry, rotation=None,
                 scattered_slope=7 * (x - dr.detach(x)), damping_radius=dr.opaque(mi.Float, radius))  # fmt: skip


def following_at(ray, pi, mis):
    return Local(of=lambda name: {"mis": mi.Float(mis)}, pi=pi, ray=ray, τ=mi.Float64(11),
                 arrival=lambda name: f"arrival of {name}")  # fmt: skip


def evaluate(asked):
    """Scattering of ``2 + d.b``, and what it was asked for. Idle lanes hold no number."""

    def value(world, vertex, out, active):
        asked.append((out, active))
        share = dr.select(active, 2 + dr.dot(out, mi.Vector3f(0.1, 0.7, -0.4)), dr.nan)
        return Local(value=mi.Spectrum(0.3, 0.4, 0.6) * share)

    return value


def scattered(d):
    return np.array([0.3, 0.4, 0.6]) * (2 + d @ [0.1, 0.7, -0.4])


def test_the_sun_that_a_path_escapes_into():
    """Throughput, scattering and emission over the density of the direction, and the arrival, follow a direction that
    turns with the sun.
    """
    x, asked = attached_zero(), []
    d, turn, lanes = unit(np.array([0.3, 0.2, 0.9])), np.array([0.4, -0.7, 0.5]), 5
    ray = mi.Ray3f(mi.Point3f(0, 0, mi.Float([0.0] * lanes)), mi.Vector3f(*d.tolist()))

    class Sky:
        def emitter(self, scene):
            return self

        def eval(self, si, active):
            return mi.Color3f(2, 3, 5) * (1 + dr.dot(si.wi, mi.Vector3f(0.2, -0.3, 0.15)))

    def followed(given, active):
        asked.append(active)
        return dr.select(active, dr.normalize(given + mi.Vector3f(*turn.tolist()) * x), given)

    connection = EmitterFound()
    connection.sun = Local(
        shines=lambda emitter, direction: mi.Bool([True] * 4 + [False]) & (direction.x > 0.2), followed=followed
    )
    pi = Local(compute_surface_interaction=lambda *a: Sky())
    vertex = vertex_before(x, following_at(ray, pi, [0.8, 0.8, 0.8, 0, 0.8]))
    world = Local(scene=None, scattering=Local(evaluate=evaluate(asked)),
                  contents=Local(distant=DistantReference((0.5, 0.25, 0.0), 4.0)))  # fmt: skip
    # Lit; nothing was drawn; something is met; no weight; beside the sun.
    ahead = mi.Bool([False, False, True, False, False])
    step = Local(inv_pdf=mi.Float([3, 0, 3, 3, 3]), ahead=ahead, carry=vertex.carry)
    term = connection._sun_ahead(world, vertex, step)
    lit = [True] + [False] * 4
    assert np.array(term.active).tolist() == lit and term.arrival == "arrival of emitter_found"
    assert all(np.array(each[1] if isinstance(each, tuple) else each).tolist() == lit for each in asked)
    assert np.array(term.opl).tolist() == [11] and not np.array(term.slope).any()

    def value(h):
        out = unit(d + h * turn)
        Le = np.array([2, 3, 5]) * (1 - out @ [0.2, -0.3, 0.15])
        return np.array([0.5, 0.25, 2]) * (1 + 0.11 * h) * scattered(out) * 3 * 0.8 * Le

    def length(h):
        return 4 - (PLACE + h * MOVE - [0.5, 0.25, 0]) @ unit(d + h * turn)

    np.testing.assert_allclose(np.array(term.value), np.outer(value(0), lit), rtol=1e-5)
    grown, slope = slopes(x, term.value, term.slope)
    np.testing.assert_allclose(grown.reshape(3, -1), np.outer(difference(value), lit), rtol=1e-4, atol=1e-6)
    assert slope[0] == pytest.approx(7 + difference(lambda h: (1.25 + 0.3 * h) * length(h)), rel=1e-4)


def test_lights_that_any_connection_claims():
    """Of several that claim some, those of any; nothing where none does."""
    connection, some, others = EmitterFound(), mi.Bool([True, False, False]), mi.Bool([False, True, False])
    cases = ([None], None), ([some], [1, 0, 0]), ([None, others], [0, 1, 0]), ([some, others], [1, 1, 0])
    for claims, expected in cases:
        given = [Local(claims=lambda *a, claim=claim: claim) for claim in claims]
        found = connection._claimed(Local(connections=[connection, *given]), None, None, None)
        assert (found is None) if expected is None else np.array(found).tolist() == expected


@pytest.mark.parametrize("claims", [None, False, True])
@pytest.mark.parametrize("radius", [0.5, 4.0])
def test_light_of_a_moving_shape_that_a_path_finds(painted, claims, radius):
    """As points that are sampled: the value follows scattering, pattern and solid angle, the arrival the distance. Near
    by, the point slides. What connections claim alone is left to them.
    """
    asked, x = [], attached_zero()
    d = unit(np.array([0.1, 0.2, 1.0]))
    ray = mi.Ray3f(mi.Point3f(*PLACE.tolist()), mi.Vector3f(*d.tolist()) + mi.Vector3f(mi.Float([0, 0, 0])))
    plain = painted.ray_intersect_preliminary(ray)
    hit = plain.compute_surface_interaction(ray)
    p0, n0, uv0, r = (np.array(v, dtype=np.float64)[..., 0] for v in (hit.p, hit.n, hit.uv, hit.t))
    params = mi.traverse(painted)
    key = "lamp.to_world"
    pose = mi.AffineTransform4f(params[key])
    shift = np.array([-0.2, 0.5, 0.35])
    grown = np.array([[0.4, -0.1, 0.3], [0.2, 0.5, -0.2], [-0.3, 0.1, 0.6]])
    matrix = np.eye(4) * 0
    matrix[:3, :3], matrix[:3, 3] = grown, shift
    motion = mi.Matrix4f(np.eye(4).tolist()) + mi.Matrix4f(matrix.tolist()) * x
    params[key] = mi.AffineTransform4f(motion) @ pose
    params.update()
    try:
        with dr.suspend_grad():
            pi = painted.ray_intersect_preliminary(ray)
        following = following_at(ray, pi, [0.8, 0.8, 0])
        vertex = vertex_before(x, following, radius)
        other = Local(claims=lambda world, emitter, direction, wanted: None if claims is None else mi.Bool(claims))
        connection, ends = EmitterFound(), []

        def attached_transmittance(world, vertex, end, active):
            ends.append((end, active))
            return 1 + 0.13 * x

        world = Local(scene=painted, connections=[connection, other], scattering=Local(evaluate=evaluate(asked)),
                      segment=Local(weight=lambda v: 0.9, attached_transmittance=attached_transmittance),
                      contents=Local(emitting_meshes=None, patterned_lights=True))  # fmt: skip
        step = Local(inv_pdf=mi.Float(3), ahead=mi.Bool([True, False, True]), carry=vertex.carry)
        term = connection._ahead(world, vertex, step, Local(geometry=True))
        lit = [claims is not True, False, False]
        assert np.array(term.active).tolist() == lit and term.arrival == "arrival of emitter_found"
        assert asked[0][1] is term.active and ends[0][1] is term.active and ends[0][0].ahead and not ends[0][0].far[0]
        brighter, slope, went = slopes(x, term.value, term.slope, ends[0][0].p)
    finally:
        params[key] = dr.detach(pose)
        params.update()
    share = 0 if r > radius else (1 - (r / radius) ** 2) ** 2
    moved = shift + grown @ p0
    δ = MOVE - moved
    drag = share * (δ - d * (d @ δ))
    slid = drag - d * (n0 @ drag) / (n0 @ d)
    assert (np.linalg.norm(slid) > 0.1) == (radius > r)

    def to(h):
        return p0 + h * (moved + slid) - PLACE - h * MOVE

    def normal(h):
        """Times the element of area."""
        linear = np.eye(3) + h * grown
        return np.linalg.det(linear) * np.linalg.inv(linear).T @ n0

    def value(h):
        uv = uv0 + h * np.array([-slid[0] / 2, slid[1] / 3])
        Le = 7 * np.array([*uv, 1]) * (1 - np.arccos(-unit(normal(h)) @ unit(to(h))) / (np.pi / 2))
        return np.array([0.5, 0.25, 2]) * scattered(unit(to(h))) * (1 + (0.11 + 0.13) * h) * 3 * 0.8 * 0.9 * Le

    np.testing.assert_allclose(np.array(term.value), np.outer(value(0), lit), rtol=1e-3)
    if claims is True:
        assert not brighter.any()
        return
    np.testing.assert_allclose(went.reshape(3, -1)[:, 0], moved + slid, rtol=1e-3, atol=1e-5)
    assert slope[0] == pytest.approx(7 + difference(lambda h: (1.25 + 0.3 * h) * np.linalg.norm(to(h))), rel=1e-3)
    # The solid angle: of a point that stays, by area and normal; of one that slides, by how far others slide beside it.
    across = difference(lambda h: turning(r + h, radius)) * r
    angle = across * (n0 @ δ / (n0 @ d) - d @ δ) + 2 * turning(r, radius) * (d @ δ)
    angle += (1 - share) * difference(lambda h: normal(h) @ d) / (n0 @ d)
    expected = difference(value) + value(0) * angle
    np.testing.assert_allclose(brighter.reshape(3, -1), np.outer(expected, lit), rtol=3e-3, atol=1e-4)


def turning(r, radius):
    """How far a direction turns as its vertex moves by one, across."""
    a = 0 if r > radius else (1 - (r / radius) ** 2) ** 2
    return (1 - a) / r


@pytest.mark.slow
def test_round_patterned_lights_that_a_path_finds():
    """Near by, where a point slides to its normal is another one, and the light that leaves it, too."""
    x, radius, d = attached_zero(), 4.0, unit(np.array([0.02, 0.1, 1.0]))
    lamp = {"type": "angulararea", "cutoff_angle": 90.0, "beam_width": 0.0, "radiance": 5.0}
    ball = {"type": "sphere", "center": [0.3, 0, 2.5], "radius": 0.8, "emitter": lamp}
    scene = mi.load_dict({"type": "scene", "ball": ball})
    ray = mi.Ray3f(mi.Point3f(*PLACE.tolist()), mi.Vector3f(*d.tolist()))
    pi = scene.ray_intersect_preliminary(ray)
    hit = pi.compute_surface_interaction(ray)
    p0, n0, r = (np.array(v, dtype=np.float64)[..., 0] for v in (hit.p, hit.n, hit.t))
    share = 1 - turning(r, radius) * r
    drag = share * (MOVE - d * (d @ MOVE))
    slid = drag - d * (n0 @ drag) / (n0 @ d)
    vertex = vertex_before(x, following_at(ray, pi, [0.8]), radius)
    connection = EmitterFound()
    segment = Local(weight=lambda v: 0.9, attached_transmittance=lambda *a: 1)
    step = Local(inv_pdf=mi.Float(3), ahead=mi.Bool(True), carry=vertex.carry)
    found = []
    for patterned in (True, False):
        contents = Local(emitting_meshes=None, patterned_lights=patterned)
        world = Local(scene=scene, connections=[connection], scattering=Local(evaluate=evaluate([])), segment=segment,
                      contents=contents)  # fmt: skip
        found.append(connection._ahead(world, vertex, step, Local(geometry=True)))
    np.testing.assert_array_equal(np.array(found[0].value), np.array(found[1].value))
    one, other = slopes(x, *(term.value for term in found))

    def emitted(h, turns):
        n = unit(n0 + turns * h * slid / 0.8)
        return 1 - np.arccos(-n @ unit(p0 + h * slid - PLACE - h * MOVE)) / (np.pi / 2)

    expected = np.array(found[0].value)[:, 0] * difference(lambda h: emitted(h, 1) - emitted(h, 0)) / emitted(0, 0)
    assert abs(expected).min() > 0.01
    np.testing.assert_allclose(one - other, expected, rtol=5e-3)
