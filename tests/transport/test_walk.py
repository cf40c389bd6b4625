"""The loop by itself: which events it asks for, and what a path hands on from vertex to vertex."""

from __future__ import annotations

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.walks import Connection, Event, Sink, Step, Vertex, trace

VARIANT = "llvm_ad_rgb"


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
        at = SimpleNamespace(p=p, n=mi.Normal3f(0, 0.6, 0.8), spawn_ray=lambda d: mi.Ray3f(p, d))
        return Vertex(at=at, valid=path.depth < mi.UInt32(self.ends), opl=mi.Float64(path.leg), β=path.β)


class Turning:
    """Every vertex takes a quarter of a metre, half of the light, and brings light into a medium of three halves."""

    name, guides = "scattering", ()

    def arrive(self, world, path, vertex, sampler):
        vertex.delay = SimpleNamespace(after=lambda τ: τ + 0.25)

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
    world = SimpleNamespace(
        velocities=None,
        segment=Line(), scattering=Turning(), connections=[connection], max_depth=most, in_time=window,
        finds_light=connection.finds_light, dark_at_first=connection.dark_at_first, plays_roulette=False,
        taken_over=lambda path, vertex: None,
    )  # fmt: skip
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
