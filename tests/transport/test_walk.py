"""Turns of the loop by themselves: who goes on, and which events count."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from support.plain_scenes import camera, load
from torchtransient.plugins.films.window import ArrivalWindow
from torchtransient.plugins.transport.strategy import Local
from torchtransient.plugins.transport.walk import roulette, start
from torchtransient.plugins.transport.world import PathSettings, World

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
    return World(scene, contents, PathSettings(**given), integrator.strategies(contents), None, window)


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
