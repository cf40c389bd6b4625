"""Connections to light by themselves: a laser's spot, a point of a light, and light that is run into."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from torchtransient.plugins.around_corner.geometry import WallPoints
from torchtransient.plugins.sampling.lights import DistantReference
from torchtransient.plugins.transport.emitter_connections import EmitterFound, EmitterSampled, is_light
from torchtransient.plugins.transport.laser_spot import DiffuseSpot, LaserSpot, PackedSpots
from torchtransient.plugins.transport.strategy import Local

VARIANT = "llvm_ad_rgb"


def draw(seed, *shape):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def unit(v):
    return v / np.linalg.norm(v, axis=0)


def spectrum(rows):
    return mi.UnpolarizedSpectrum(np.asarray(rows, dtype=np.float32))


# ------------------------------------------------------------------------------------------------------------ the spot


@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_rgb"])
def test_spots_in_packets(variant):
    """As they are, four numbers at a time; without a normal where the beam meets nothing."""
    with mi.variant_context(variant):
        channels = dr.size_v(mi.UnpolarizedSpectrum)
        p, n, value, leg = draw(1, 3, 5), draw(2, 3, 5), draw(3, channels, 5), draw(4, 5)
        colours = mi.UnpolarizedSpectrum(*(mi.Float(row) for row in value))
        points = WallPoints(mi.Point3f(p), mi.Normal3f(n), colours, mi.Float64(leg))
        packed = PackedSpots(points, mi.Bool([True, False, True, True, True]))
        assert (packed.channels, packed.count) == (channels, 2 if channels == 1 else 3)
        index = np.array([4, 1, 0])
        spot = packed.take(mi.UInt32(index), mi.Bool([True] * 3))
        np.testing.assert_array_equal(np.array(spot.p), p[:, index])
        np.testing.assert_array_equal(np.array(spot.n), n[:, index] * [1, 0, 1])
        np.testing.assert_array_equal(np.array(spot.value), value[:, index])
        np.testing.assert_array_equal(np.array(spot.leg), leg[index])
        assert np.array(spot.valid).tolist() == [True, False, True]
        one = PackedSpots(WallPoints(mi.Point3f(p), mi.Normal3f(0, 0, 1), 0.25), mi.Bool([True] * 5))
        assert np.array(one.take(mi.UInt32([3]), True).value).ravel().tolist() == [0.25] * channels


def test_light_of_a_diffuse_spot():
    """By the cosine, on the side of the normal alone."""
    spot = DiffuseSpot(mi.Point3f(0, 0, 0), mi.Normal3f(0, 0, 1), mi.Color3f(2, 3, 5), 0.0)
    d = mi.Vector3f(0.6, 0, mi.Float([-0.8, 0.8, -0.8]))
    found = np.array(spot.light(d, mi.Bool([True, True, False])))
    np.testing.assert_allclose(found, np.outer([1.6, 2.4, 4.0], [1, 0, 0]), rtol=1e-6)


SPOT = np.array([1.0, 2.0, 0.5])
# In view of the spot; at it; along the surface; not to be connected; too deep; out of the film's window.
PLACES = np.array([[2, 3, 4], SPOT, [1, 3, 0.5], [2, 3, 4], [2, 3, 4], [2, 3, 40.0]])
DEPTHS = [0, 0, 0, 0, 3, 0]


class Around:
    """A world of vacuum, or of a medium, and what it was asked."""

    max_depth = 4
    connections: list = []  # noqa: RUF012

    def __init__(self, media=None, distant=None):
        self.contents = Local(media=media, distant=distant, smooth_lights=None)
        self.segment, self.scattering = Local(transmittance=self.transmittance), Local(samples_all=False)
        self.tested, self.clear = None, True

    def deep_enough(self, active, depth):
        return active & (depth <= self.max_depth)

    def counted(self, active, opl):
        return active & (opl < 30)

    def transmittance(self, world, vertex, ds, u, sampler, active):
        self.tested = active
        return active & self.clear, 0.5


def vertex_of(places, n):
    connectable = np.arange(len(places)) != 3
    at = Local(p=mi.Point3f(places.T), n=mi.Normal3f(n.T), wavelengths=[])
    return Local(at=at, goes_on=mi.Bool(True), connectable=mi.Bool(connectable), β=mi.Spectrum(0.5, 0.25, 2.0),
                 η=mi.Float(1.25), scattered_τ=mi.Float64(3.0))  # fmt: skip


@pytest.mark.parametrize("media", [None, "fog"])
@pytest.mark.parametrize("confocal", [False, True])
@pytest.mark.parametrize("before", [0, 1])
def test_connections_to_a_laser_s_spot(before, confocal, media):
    """Its light over the squared distance, later by the way times the index, and by the laser's own way. In vacuum the
    second vertex of a confocal path has seen the spot before.
    """
    world = Around(media)
    wall = WallPoints(mi.Point3f(*SPOT.tolist()), mi.Normal3f(0, 0, 1), spectrum([[2], [3], [5]]), 0.75)
    connection = LaserSpot(Local(wall=None, spots=None, looks_at_points=True), confocal, True)
    assert not connection.dark_at_first and not connection.finds_light
    connection.points, connection.packed = wall, PackedSpots(wall, mi.Bool([True]))
    connection.start(world, Local(spot=mi.UInt32([0] * 6)))
    n = np.tile(unit(np.array([1.0, 2, 2])), (6, 1))
    n[2] = 1, 0, 0
    vertex, path = vertex_of(PLACES, n), Local(depth=mi.UInt32(DEPTHS) + before)
    sampler = Local(next_2d=lambda: mi.Point2f(0.25, 0.75))
    proposal = connection.propose(world, path, vertex, sampler)
    to = SPOT - PLACES
    r = np.linalg.norm(to, axis=1)
    assert np.array(proposal.active).tolist() == [True, False, False, False, False, True]
    np.testing.assert_allclose(np.array(proposal.d).T[[0, 5]], (to / np.maximum(r, 1)[:, None])[[0, 5]], rtol=1e-5)
    np.testing.assert_allclose(np.array(proposal.ds.dist)[[0, 1, 2, 5]], r[[0, 1, 2, 5]], rtol=1e-6)
    assert proposal.ds.delta[0] and proposal.ds.emitter is None
    assert np.array(proposal.u).ravel().tolist() == ([0.25, 0.75] if media else [0, 0])
    answer = Local(matrix=mi.Spectrum(0.125), eta=mi.Float(1.5))
    event = connection.connect(world, path, vertex, proposal, answer, False)
    cos = -to[0, 2] / r[0]
    expected = np.array([0.5, 0.25, 2]) * 0.125 * np.array([2, 3, 5]) * cos / r[0] ** 2 * 0.5
    np.testing.assert_allclose(np.array(event.value)[:, 0], expected, rtol=1e-5)
    assert not np.array(event.value)[:, 1:5].any()
    assert event.opl[0] == pytest.approx(3 + r[0] * 1.25 * 1.5 + 0.75, rel=1e-6)
    assert np.array(event.active).tolist() == [True] + [False] * 5
    assert np.array(event.depth).tolist() == [d + 2 + before for d in DEPTHS]
    assert np.array(world.tested).any() == (media is not None or not confocal or before == 0)
    assert connection.record(Local(event=event))["lit"] is event.active
    assert ("T" in connection.fields(world)) == (media is not None)
    world.clear = False
    hidden = connection.connect(world, path, vertex, proposal, answer, False)
    assert np.array(hidden.active).tolist() == [confocal and before == 1 and media is None] + [False] * 5


def test_spots_that_send_nothing():
    """From behind the wall there is none of their light; a derivative asks for it all the same."""
    world, wall = Around(), WallPoints(mi.Point3f(*SPOT.tolist()), mi.Normal3f(0, 0, -1), spectrum([[2], [3], [5]]))
    connection = LaserSpot(Local(wall=["wall"], spots=None, looks_at_points=True), False, True)
    assert connection.dark_at_first
    assert not LaserSpot(Local(wall=["wall"], spots=None, looks_at_points=False), False, True).dark_at_first
    connection.points, connection.packed = wall, PackedSpots(wall, mi.Bool([True]))
    connection.start(world, Local(spot=mi.UInt32([0])))
    vertex, path = vertex_of(PLACES[:1], np.array([[0, 0.6, 0.8]])), Local(depth=mi.UInt32([0]))
    proposal = connection.propose(world, path, vertex, None)
    missed = LaserSpot(Local(wall=None, spots=None, looks_at_points=True), False, True)
    missed.points, missed.packed, missed.index = wall, PackedSpots(wall, mi.Bool([False])), connection.index
    assert proposal.active[0] and not missed.propose(world, path, vertex, None).active[0]
    answer = Local(matrix=mi.Spectrum(0.125), eta=mi.Float(1.5))
    for zeros in (False, True):
        event = connection.connect(world, path, vertex, proposal, answer, zeros)
        assert event.active[0] == zeros and not np.array(event.value).any()
    green = WallPoints(mi.Point3f(*SPOT.tolist()), mi.Normal3f(0, 0, 1), spectrum([[0], [3], [0]]))
    connection.points, connection.packed = green, PackedSpots(green, mi.Bool([True]))
    proposal = connection.propose(world, path, vertex, None)
    assert connection.connect(world, path, vertex, proposal, answer, False).active[0]


@pytest.mark.parametrize("media", [None, "fog"])
def test_a_spot_s_light_with_derivatives(media):
    """Value and arrival follow the vertex; the arrival itself is a number. Idle lanes hold nothing."""
    world, legs = Around(media), mi.Float64(0.75)
    wall = WallPoints(mi.Point3f(*SPOT.tolist()), mi.Normal3f(0, 0, 1), spectrum([[2], [3], [5]]), legs)
    connection = LaserSpot(Local(wall=None, spots=None, looks_at_points=True), False, True)
    connection.points, connection.index = wall, mi.UInt32([0, 0])
    lit, x = mi.Bool([True, False]), mi.Float(0)
    dr.enable_grad(x, wall.leg)
    dr.set_grad(x, 1)
    dr.set_grad(wall.leg, 11)
    place, move, turn = np.array([2.0, 3, 4]), np.array([0.3, -0.2, 0.5]), np.array([0.1, 0.7, -0.4])
    # The idle lane lies at the spot itself.
    p = dr.select(lit, mi.Point3f(*place.tolist()), mi.Point3f(*SPOT.tolist())) + mi.Vector3f(*move.tolist()) * x
    asked = []

    def evaluate(world, vertex, d, active):
        asked.append((d, active))
        return Local(value=mi.Spectrum(0.25) * (1 + dr.dot(d, mi.Vector3f(*turn.tolist()))), wo=None, eta=mi.Float(1.5))

    def transmittance(world, vertex, end, active):
        asked.append(end)
        return 1

    world.scattering, world.segment = Local(evaluate=evaluate), Local(attached_transmittance=transmittance)
    record = {"lit": lit} | ({"T": mi.Color3f(0.5, 0.25, 0.125)} if media else {})
    v = Local(record_of=lambda name: record, η=mi.Float(1.25), arrival=lambda name: f"arrival of {name}")
    vertex = Local(scattered_si=Local(p=mi.Point3f(p), wavelengths=[]), v=v, rotation=None,
                   carry=Local(β=mi.Spectrum(0.5, 0.25, 2), η=mi.Float(1.25)), scattered_opl=mi.Float64(3),
                   scattered_slope=7 * (x - dr.detach(x)))  # fmt: skip
    for geometry in (False, True):
        (term,) = connection.attached(world, vertex, None, Local(geometry=geometry))
    value, slope = term.value * 1, term.slope * 1
    dr.enqueue(dr.ADMode.Forward, x, wall.leg)
    dr.traverse(dr.ADMode.Forward)

    def at(h):
        to = SPOT - place - h * move
        r = np.linalg.norm(to)
        T = np.array([0.5, 0.25, 0.125]) if media else 1
        return np.array([0.5, 0.25, 2]) * [2, 3, 5] * T * 0.25 * (1 + turn @ to / r) * -to[2] / r**3, r

    (one, r1), (other, r0) = at(1e-5), at(-1e-5)
    np.testing.assert_allclose(np.array(value), np.outer(at(0)[0], [1, 0]), rtol=1e-5)
    np.testing.assert_allclose(np.array(dr.grad(value)), np.outer((one - other) / 2e-5, [1, 0]), rtol=1e-3, atol=1e-6)
    longer = 1.25 * 1.5 * (r1 - r0) / 2e-5
    np.testing.assert_allclose(np.array(dr.grad(slope)), [18 + longer, 7], rtol=1e-4)
    assert term.opl[0] == pytest.approx(3 + at(0)[1] * 1.5 * 1.25 + 0.75, rel=1e-6)
    assert not dr.grad_enabled(term.opl) and not np.array(slope).any()
    assert (term.active is lit, term.arrival) == (True, "arrival of laser_spot")
    (d, active), end = asked[-2:]
    assert active is lit and dr.grad_enabled(d) and not dr.grad_enabled(end.d)
    np.testing.assert_array_equal(np.array(end.d), np.array(d))
    assert (end.ahead, bool(end.far[0])) == (False, False)


# ---------------------------------------------------------------------------------------------------- points of lights


def sampled(lanes, **changes):
    """A proposal of :class:`EmitterSampled` as it is connected."""
    ds = Local(d=mi.Vector3f(0, 0, 1), dist=mi.Float(4), pdf=mi.Float(3), delta=mi.Bool([False] * lanes), emitter=None)
    for name in ("pdf", "delta", "dist"):
        if name in changes:
            setattr(ds, name, changes[name])
    weight = changes.get("weight", mi.Color3f(7, 11, 13))
    return Local(ds=ds, active=changes.get("active", mi.Bool([True] * lanes)), weight=weight, u=None, sampler=None)


def test_connections_to_points_of_lights():
    """Weighed against the scattering that could have found them, but for lights without extent; later by the way times
    the index.
    """
    world, connection = Around(), EmitterSampled()
    world.connections, connection.spheres, connection.lights_change = [connection], None, False
    delta = mi.Bool([False, True, False, False])
    proposal = sampled(4, delta=delta, active=mi.Bool([True, True, False, True]), dist=mi.Float([4, 4, 4, 40]))
    answer = Local(value=mi.Spectrum(0.5, 0.25, 0.125), pdf=mi.Float(2.0), eta=mi.Float(1.5))
    event = connection.connect(world, Local(depth=mi.UInt32([1, 2, 3, 4])), vertex_of(PLACES[:4], PLACES[:4]), proposal,
                               answer, False)  # fmt: skip
    plain = np.array([0.5, 0.25, 2]) * [0.5, 0.25, 0.125] * np.array([7, 11, 13]) * 0.5
    np.testing.assert_allclose(np.array(event.value)[:, :2], np.outer(plain, [9 / 13, 1]), rtol=1e-5)
    np.testing.assert_allclose(np.array(event.opl), 3 + np.array([4, 4, 4, 40]) * 1.875, rtol=1e-6)
    assert np.array(event.active).tolist() == [True, True, False, False]
    assert np.array(event.depth).tolist() == [3, 4, 5, 6] and event.crowded
    assert set(connection.fields(world)) == {"u", "lit"}
    assert set(connection.fields(Around("fog"))) == {"u", "lit", "T"}


def test_which_dark_connections_may_become_light():
    """In a derivative: where the light itself may change, or is there; behind a surface there is none, whose scattering
    has a density wherever it has a value.
    """
    world, connection = Around(), EmitterSampled()
    dark = sampled(2, weight=mi.Color3f(mi.Float([0, 0]), 0, mi.Float([0, 2])))
    answer = Local(value=mi.Spectrum(0), pdf=mi.Float([1, 0]), eta=mi.Float(1))

    def may():
        return np.broadcast_to(np.array(connection._may_change(world, dark, answer)), 2).tolist()

    connection.lights_change = False
    assert may() == [False, True]
    connection.lights_change = True
    assert may() == [True, True]
    world.scattering.samples_all = True
    assert may() == [True, False]
    assert np.array(is_light(mi.Color3f(mi.Float([0, -1]), 0, 0))).tolist() == [False, True]


def test_lengths_to_lights():
    """Of points, and of what is infinitely far away by the sphere around the scene."""
    ds = Local(dist=mi.Float([4.0, 4.0]), emitter=None)
    assert EmitterSampled._length(Around(), None, ds, None) is ds.dist
    scene = mi.load_dict({"type": "scene", "lamp": {"type": "point"}, "sky": {"type": "constant"},
                          "wall": {"type": "rectangle"}})  # fmt: skip
    lamp, sky = sorted(scene.emitters(), key=lambda emitter: emitter.is_environment())
    ds.emitter = mi.EmitterPtr([lamp, sky])
    found = EmitterSampled._length(
        Around(distant=DistantReference((0.5, 0, 0), 6.0)), mi.Point3f(1, 2, 3), ds, mi.Vector3f(0, 0.6, 0.8)
    )
    np.testing.assert_allclose(np.array(found), [4, 6 - (2 * 0.6 + 3 * 0.8)], rtol=1e-6)


# --------------------------------------------------------------------------------------------- light that is run into


@pytest.fixture(scope="module")
def lit_sheet():
    """A lamp two metres away, before a sky."""
    lamp = {"type": "rectangle", "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [2, 3, 5]}}}
    return mi.load_dict({"type": "scene", "lamp": lamp, "sky": {"type": "constant", "radiance": 7.0}})


class Sharing(EmitterSampled):
    """Another connection, whose samples have a density of three."""

    def density(self, world, ref, ds, active):
        self.asked = active
        return mi.Float(3)


@pytest.mark.parametrize(("hide", "discard", "seen"), [
    (False, False, [1, 1, 1, 1, 0, 0]), (True, False, [1, 0, 1, 1, 0, 0]), (False, True, [0, 0, 1, 1, 0, 0]),
    (True, True, [0, 0, 1, 1, 0, 0]),
])  # fmt: skip
def test_light_that_a_path_runs_into(lit_sheet, hide, discard, seen):
    """At the sensor, and behind a vertex that could have been connected to it, with the weight of the power heuristic;
    hidden lights are left out where nothing else is met at once, and direct light where that is asked for.
    """
    # The lamp and the sky from the sensor; both from a vertex; too deep; a path that has ended.
    at_lamp = np.array([1, 0, 1, 0, 1, 1], dtype=bool)
    ray = mi.Ray3f(mi.Point3f(0.25, 0.5, 2), mi.Vector3f(0, 0, mi.Float(np.where(at_lamp, -1.0, 1.0))))
    si = lit_sheet.ray_intersect(ray)
    world, connection, other = Around(), EmitterFound(), Sharing()
    world.scene, world.hide_emitters, world.discard_direct_light = lit_sheet, hide, discard
    world.connections = [connection, other]
    depth = mi.UInt32([0, 0, 1, 1, 4, 1])
    vertex = Local(si=si, surface=mi.Bool(True), valid=si.is_valid(), β=mi.Spectrum(0.5, 0.25, 2), τ=mi.Float64(3.0))
    path = Local(ray=ray, depth=depth, active=mi.Bool([True] * 5 + [False]), prev_p=ray.o, prev_n=mi.Normal3f(0, 0, 1),
                 prev_pdf=mi.Float(2), prev_unconnected=depth == 0)  # fmt: skip
    event = connection.connect(world, path, vertex, None, None, False)
    assert np.array(event.active).tolist() == [bool(one) for one in seen]
    mis = np.array([1.0, 1.0, 4 / 13, 4 / 13, 0, 0]) * seen
    np.testing.assert_allclose(np.array(event.mis)[2:4], mis[2:4], rtol=1e-6)
    radiance = np.where(at_lamp, [[2], [3], [5]], 7.0)
    expected = np.array([[0.5], [0.25], [2]]) * radiance * np.array([4 / 13] * 6) * seen
    np.testing.assert_allclose(np.array(event.value)[:, 2:4], expected[:, 2:4], rtol=1e-5)
    assert np.array(event.depth).tolist() == [1, 1, 2, 2, 5, 2] and np.array(event.opl).tolist() == [3]
    assert np.array(other.asked).tolist() == [bool(one) and k > 1 for k, one in enumerate(seen)]
    assert connection.record(Local(event=event))["mis"] is event.mis


def test_lights_that_derivatives_reach_elsewhere():
    """What any other strategy claims; nobody is asked twice."""
    connection, world = EmitterFound(), Around()
    claims = [None, mi.Bool([True, False, False]), mi.Bool([False, False, True])]
    world.connections = [connection, *(Local(claims=lambda *_, own=own: own) for own in claims)]
    assert np.array(connection._claimed(world, None, None, None)).tolist() == [True, False, True]
    world.connections = world.connections[:3]
    assert np.array(connection._claimed(world, None, None, None)).tolist() == [True, False, False]
    world.connections = world.connections[:2]
    assert connection._claimed(world, None, None, None) is None


def test_lights_that_may_change():
    """Only where a derivative is asked for, and one of them is attached."""
    world, connection = Around(), EmitterSampled()
    world.contents.sphere_lights = None
    lamps = [mi.load_dict({"type": "point", "intensity": power}) for power in (1.0, 2.0)]
    world.scene = Local(emitters=lambda: lamps)
    for attached in (False, True):
        if attached:
            parameters = mi.traverse(lamps[1])
            dr.enable_grad(parameters["intensity.value"])
            parameters.update()
        for wanted in (None, Local(sky=None)):
            world.wanted = wanted
            connection.prepare(world)
            assert connection.lights_change is (attached and wanted is not None)
