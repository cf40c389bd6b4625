"""Turns of the loop by themselves: who goes on, and which events count."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.plain_scenes import camera, load
from support.walks import trace
from torchtransient.plugins.films.block import ArrivalWindow
from torchtransient.plugins.transport.context import PathSettings, RenderContext
from torchtransient.plugins.transport.sinks import Sink
from torchtransient.plugins.transport.strategy import Connection, Event, Local, Step, Vertex
from torchtransient.plugins.transport.walk import roulette, start

VARIANT = "llvm_ad_rgb"


def colour(*lanes):
    """A spectrum of some lanes of three channels each."""
    return mi.Spectrum(*(mi.Float(list(channel)) for channel in zip(*lanes, strict=True)))


def played(u, zeros=False, plays=True, **changes):
    """(throughput, whether the path goes on, factor) of five lanes behind their vertices."""
    world = Local(plays_roulette=plays, rr_depth=3)
    path = Local(depth=mi.UInt32(changes.get("depth", [3, 3, 3, 2, 7])), η=mi.Float([1, 1, 1.5, 1, 2]))
    β = changes.get("β", colour([0.2, 0.4, 0.1], [0.8, 0.9, 2.0], [0.1, 0.2, 0.3], [0.1, 0.1, 0.1], [0.1, 0.2, 0.1]))
    weight = changes.get("weight", colour(*[[0.5, 0.5, 0.25]] * 5))
    step = Local(weight=weight, eta=mi.Float([1, 1, 1, 1, 0.5]), pdf=mi.Float(changes.get("pdf", [1.0] * 5)))
    sampler = Local(next_1d=lambda: mi.Float(u))
    return roulette(world, path, Local(β=β), step, sampler, mi.Bool([True] * 5), zeros)


def test_paths_go_on_by_chance():
    """With the largest of their channels, times the square of the index where they run, at most 0.95; from ``rr_depth``
    on. Those that do stand for the others.
    """
    chance = np.array([0.2, 0.5, 0.1 * 2.25, np.nan, 0.1])
    β, goes_on, rr = played([0.199, 0.499, 0.224, 0.99, 0.0999])
    assert np.array(goes_on).all()
    _, stops, _ = played([0.2001, 0.5001, 0.2251, 0.99, 0.1001])
    assert np.array(stops).tolist() == [False, False, False, True, False]
    factor = np.where(np.isnan(chance), 1, 1 / chance)
    np.testing.assert_allclose(np.array(rr), factor, rtol=1e-6)
    np.testing.assert_allclose(np.array(β)[:, 2], np.array([0.05, 0.1, 0.075]) * factor[2], rtol=1e-5)
    assert not np.array(played([0.0, 0.5, 0.0, 0.0, 0.0])[1])[1]  # a number of the chance itself ends a path
    bright = colour(*[[9.0, 1.0, 1.0]] * 5)
    _, goes_on, rr = played([0.949, 0.951, 0.949, 0.951, 0.949], β=bright)
    assert np.array(goes_on).tolist() == [True, False, True, True, True]
    np.testing.assert_allclose(np.array(rr), np.where([1, 1, 1, 0, 1], 1 / 0.95, 1), rtol=1e-6)


def test_nothing_is_drawn_where_no_roulette_is_played():
    β, goes_on, rr = played(None, plays=False)
    assert np.array(goes_on).all() and rr[0] == 1
    np.testing.assert_allclose(np.array(β)[:, 0], [0.1, 0.2, 0.025], rtol=1e-6)


def test_black_paths():
    """They end in a render. Of a derivative they go on behind the first black surface, where something was drawn."""
    half, black = [0.5, 0.5, 0.5], [0.0, 0.0, 0.0]
    β = colour(half, half, black, half, black)
    weight = colour(half, black, half, black, black)
    changes = {"β": β, "weight": weight, "pdf": [1.0, 1.0, 1.0, 0.0, 1.0], "depth": [5] * 5}
    for plays in (True, False):
        _, goes_on, _ = played(0.0, plays=plays, **changes)
        assert np.array(goes_on).tolist() == [True, False, False, False, False]
        _, goes_on, rr = played(0.0, zeros=True, plays=plays, **changes)
        assert np.array(goes_on).tolist() == [True, True, True, False, False]
    # Of a throughput of zero no share is known: it goes on as one of one.
    _, _, rr = played(0.0, zeros=True, **changes)
    np.testing.assert_allclose(np.array(rr)[:2], [4, 1 / 0.95], rtol=1e-6)


def test_where_paths_start():
    ray = mi.Ray3f(mi.Point3f(1, 2, 3), mi.Vector3f(0, 0, 1))
    path = start(Local(max_depth=2), ray, mi.Float64(1.25), 1.5)
    assert (path.depth[0], path.η[0], path.τ[0], path.prev_pdf[0]) == (0, 1.5, 1.25, 1)
    assert (path.active[0], path.prev_unconnected[0]) == (True, True)
    assert np.array(path.prev_p).ravel().tolist() == [1, 2, 3] and not np.array(path.prev_n).any()
    assert not start(Local(max_depth=0), ray, 0.0, 1).active[0]


# --------------------------------------------------------------------------------------------------------- the world


@pytest.fixture(scope="module")
def scene():
    lamp = {"type": "point", "intensity": 1.0, "position": [0.5, 0.25, 2.0]}
    return load(camera(2, 2, bins=3), {"lamp": lamp, "wall": {"type": "rectangle"}})


def world_of(scene, window=None, **settings):
    """The world of the path tracer with some settings of a walk."""
    integrator = scene.integrator()
    contents = integrator.contents(scene, scene.sensors()[0])
    given = {"max_depth": 6, "rr_depth": 3, "hide_emitters": False, "discard_direct_light": False,
             "camera_unwarp": False} | settings  # fmt: skip
    return RenderContext(scene, contents, PathSettings(**given), integrator.strategies(contents), None, window)


def test_events_that_are_deep_enough(scene):
    """From the least depth on, and without those that shared samples find."""
    depth, active = mi.UInt32(np.arange(7)), mi.Bool([True] * 6 + [False])

    def counted(**settings):
        return np.flatnonzero(np.array(world_of(scene, **settings).deep_enough(active, depth))).tolist()

    assert counted() == [0, 1, 2, 3, 4, 5]
    assert counted(min_depth=2) == [2, 3, 4, 5]
    assert counted(division=Local(shared=range(2, 4), walks=True)) == [0, 1, 4, 5]
    assert counted(division=Local(shared=range(0), walks=True), min_depth=5) == [5]


def test_paths_that_can_still_arrive(scene):
    """Those that are not over once they have gone to the nearest light."""
    active, p = mi.Bool([True, True, True, False]), mi.Point3f([0.5, 0.5, 9.5, 0.5], 0.25, 0.0)
    τ = mi.Float64([2.9, 3.1, 0.0, 0.0])
    free, bounded = world_of(scene), world_of(scene, window=ArrivalWindow(1.0, 5.0))
    assert np.array(free.in_time(active, τ, p)).tolist() == [True, True, True, False]
    # The lamp is 2 m above the first two points, 9 m and more from the third one.
    assert np.array(bounded.in_time(active, τ, p)).tolist() == [True, False, False, False]
    assert np.array(free.counted(active, τ)).tolist() == [True, True, True, False]
    assert np.array(bounded.counted(active, τ)).tolist() == [True, True, False, False]


def test_what_a_world_knows_of_its_walk(scene):
    world = world_of(scene)
    assert world.finds_light and world.plays_roulette and not world.dark_at_first and world.walks
    assert world.most_events() == 6 * sum(c.events(None) for c in world.connections)
    assert [strategy.name for strategy in world.strategies()] == [
        world.segment.name, *(c.name for c in world.connections), world.scattering.name
    ]  # fmt: skip
    assert not world_of(scene, division=Local(walks=False, shared=range(0))).walks
    assert world.tables() == [] and world.carried == () and world.record_room is None
    assert not world.index_changes


# ------------------------------------------------------------------------------------------------------ the whole loop


class Line:
    """Vertices a metre apart, of which lane ``k`` misses number ``ends[k]``."""

    name, ends = "segment", (9, 2, 9, 0)

    def first(self, world, ray, sampler):
        return mi.Float(1)

    def leg_to(self, leg, ray):
        return 7 * leg

    def depart(self, world, ray, vertex, β, sampler, active):
        return mi.Float(1)

    def arrive(self, world, path):
        p = mi.Point3f(path.ray.o + path.ray.d * path.leg)
        at = Local(p=p, n=mi.Normal3f(0, 0.6, 0.8), spawn_ray=lambda d: mi.Ray3f(p, d))
        return Vertex(at=at, valid=path.depth < mi.UInt32(self.ends), opl=mi.Float64(path.leg), β=path.β)


class Turning:
    """Every vertex takes a quarter of a metre, half of the light, and brings light into a medium of three halves."""

    name, guides = "scattering", ()

    def arrive(self, world, path, vertex, sampler):
        vertex.delay = Local(after=lambda τ: τ + 0.25)

    def scatter(self, world, path, vertex, proposals, sampler):
        step = Step(out=mi.Vector3f(0, 1, 0), weight=mi.Spectrum(0.5), pdf=mi.Float(0.7), eta=mi.Float(1.5),
                    unconnected=mi.Bool(False))  # fmt: skip
        return [None] * len(proposals), step


class Found(Connection):
    """Something at every vertex that a path reaches."""

    name = "found"

    def connect(self, world, path, vertex, proposal, answer, zeros):
        return Event(value=mi.Spectrum(2), opl=vertex.τ, active=path.active, depth=path.depth + 1)


class Connected(Connection):
    """Something that vertices are connected to, the first one where ``first`` says so."""

    name, finds_light = "connected", False

    def __init__(self, first=True):
        self.first, self.dark_at_first = first, not first

    def connect(self, world, path, vertex, proposal, answer, zeros):
        active = vertex.goes_on & (mi.Bool(self.first) | (path.depth > 0))
        return Event(value=mi.Spectrum(3), opl=vertex.scattered_τ, active=active, depth=path.depth + 2)


class Numbers(Sink):
    """Events by depth, four bits each, their light and lengths; with ``vertices`` what paths are there."""

    def __init__(self, vertices):
        self.keeps_vertices = vertices

    def begin(self, world):
        kept = {"events": mi.UInt32(0), "light": mi.Spectrum(0), "opl": mi.Float64(0)}
        return kept | {name: mi.Float(0) for name in ("τ", "β", "η", "pdf", "off", "n", "goes_on", "unconnected")}

    def event(self, kept, event):
        kept["events"] += dr.select(event.active, mi.UInt32(1) << (4 * event.depth), 0)
        kept["light"] += event.value
        kept["opl"] += dr.select(event.active, event.opl, 0)

    def vertex(self, kept, path, samples):
        walk = samples["walk"]
        seen = {"τ": walk.τ, "β": walk.β[0], "η": walk.η, "pdf": path.prev_pdf, "n": path.prev_n.z}
        seen |= {"off": dr.norm(path.prev_p), "goes_on": dr.select(walk.goes_on, 1.0, 0.0)}
        seen |= {"unconnected": dr.select(path.prev_unconnected, 1.0, 0.0)}
        for name, value in seen.items():
            kept[name] += dr.select(path.active, mi.Float(value), 0) * dr.power(10.0, mi.Float(path.depth))


def walked(connection, most, vertices=False, leg=None, window=lambda active, τ, p: active):
    """(number of vertices, what is kept) of four lanes."""
    world = Local(segment=Line(), scattering=Turning(), connections=[connection], max_depth=most, in_time=window,
                  finds_light=connection.finds_light, dark_at_first=connection.dark_at_first,
                  plays_roulette=False)  # fmt: skip
    ray = mi.Ray3f(mi.Point3f(0, 0, mi.Float([0] * 4)), mi.Vector3f(0, 0, 1))
    sink = Numbers(vertices)
    count, kept = trace(world, None, ray, mi.Float64(0.125), sink, 1.25, leg)
    dr.eval(count, kept)
    return np.broadcast_to(np.array(count), 4), kept


def depths(kept):
    events = np.broadcast_to(np.array(kept["events"]), 4)
    return [[d for d in range(8) for _ in range(int(word) >> 4 * d & 15)] for word in events]


@pytest.mark.parametrize("vertices", [False, True])
@pytest.mark.parametrize("most", [0, 1, 2, 3, 5])
def test_events_of_a_walk(most, vertices):
    """One of every depth: what is found at the vertices, up to the last; what is connected to from all but the last,
    and not where something was missed. The first vertex is dark where connections say so.
    """
    count, kept = walked(Found(), most, vertices)
    assert depths(kept) == [list(range(1, min(most, end + 1) + 1)) for end in Line.ends]
    assert list(count) == [min(most, end + 1) for end in Line.ends]
    for first in (True, False) if most != 5 or not vertices else (True,):
        count, kept = walked(Connected(first), most, vertices)
        expected = [[d for d in range(2 if first else 3, most + 1) if d - 2 < end] for end in Line.ends]
        assert depths(kept) == expected
        np.testing.assert_array_equal(np.array(kept["light"])[1], [3 * len(lane) for lane in expected])
        if vertices:
            assert list(count) == [min(end + 1, max(most - 1, min(most, 1))) for end in Line.ends]
        elif not first and most == 2:
            assert list(count) == [0] * 4  # nothing is to be found: no turn is taken


def digits(values):
    """What a number of every vertex was: the last vertex comes first."""
    return {name: np.array(values[name])[0] for name in values if name not in ("events", "light", "opl")}


def test_what_a_path_hands_on_from_vertex_to_vertex():
    """Length, light and index behind each vertex; place, normal and density of the one before."""
    _, kept = walked(Found(), 3, vertices=True)
    found = digits(kept)
    expected = {
        # 1 m and a quarter of a metre each, after an eighth.
        "τ": 1.125 + 23.75 + 362.5, "β": 1 + 5 + 25, "η": 1.25 + 18.75 + 281.25, "pdf": 1 + 7 + 70,
        "off": 0 + 10 + 100 * 2**0.5, "n": 0 + 8 + 80, "goes_on": 1 + 10 + 0, "unconnected": 1,
    }  # fmt: skip
    assert found == pytest.approx(expected, rel=1e-5)
    assert kept["opl"][0] == pytest.approx(1.125 + 2.375 + 3.625)
    # No light is looked for at the last vertex, so that nothing goes there.
    assert digits(walked(Connected(), 4, vertices=True)[1])["goes_on"] == pytest.approx(1 + 10)
    # What connections find leaves the vertex after its delay.
    assert walked(Connected(), 3)[1]["opl"][0] == pytest.approx(1.375 + 2.625)


def test_walks_whose_first_segment_is_known():
    """Seven metres for each of it."""
    assert walked(Found(), 2, leg=mi.Float([1, 1, 2, 1]))[1]["opl"][2] == pytest.approx(14.125 + 14.375 + 1)


def test_paths_end_where_nothing_can_be_in_time():
    """By the length up to a vertex, and its place."""
    asked = []

    def window(active, τ, p):
        asked.append(mi.Point3f(p))
        return active & (τ < 2.4) & (p.y < 3)

    _, kept = walked(Found(), 5, window=window)
    assert depths(kept)[0] == [1, 2, 3] and asked
