"""What forward mode hands on from a vertex: numbers and their tangents, of which nothing is attached."""

from __future__ import annotations

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.surface_samples import activate
from torchtransient.plugins.transport import derivative as forward


def test_nothing_attached_outlives_a_vertex(monkeypatch):
    """It would leave an edge of the graph behind, which the next traversal runs into."""
    activate("llvm_ad_mono")
    x = mi.Float(3.0)
    dr.enable_grad(x)
    dr.set_grad(x, 5.0)

    def terms(world, v, carry, wanted):
        moving, still = (SimpleNamespace(value=y * y, slope=2 * y, opl=mi.Float64(1)) for y in (x, mi.Float(7.0)))
        return [moving, still], SimpleNamespace(), None

    monkeypatch.setattr(forward, "attached_carry", lambda *_: None)
    monkeypatch.setattr(forward, "vertex_terms", terms)
    (moving, still), _ = forward.vertex_tangents(SimpleNamespace(wanted=None, carried=()), None, None)
    assert not any(dr.grad_enabled(y) for y in (moving.value, moving.d_value, moving.d_opl))
    assert moving.slope is None and still.slope is None
    found = [float(y[0]) for term in (moving, still) for y in (term.value, term.d_value, term.d_opl)]
    assert found == pytest.approx([9, 30, 10, 49, 0, 0])


class Film:
    """A block that keeps what it is given."""

    def __init__(self):
        self.given, self.ended = [], None

    def begin(self):
        return mi.UInt32(7)

    def put_slope(self, events, *given):
        self.given.append(given)

    def end(self, events):
        self.ended = events


def test_what_a_vertex_adds_to_the_film_and_to_the_sum(monkeypatch):
    """The derivative of the value, and the value times that of the arrival; the sum, of lanes that are there."""
    activate("llvm_ad_rgb")
    asked = {}

    def end(world, v):
        asked["end"] = v
        return "where the next one lies"

    def tangents(world, v, tangent):
        asked["next"] = v.next
        active = mi.Bool([True, False])
        terms = [SimpleNamespace(value=mi.Color3f(2, 3, 5) * k, d_value=mi.Color3f(0.5, 0.25, 0.125), opl=mi.Float64(9),
                                 d_opl=mi.Float(7), active=active) for k in (1, 2)]  # fmt: skip
        return terms, tangent + 1

    monkeypatch.setattr(forward, "RecordedVertex", lambda *a: SimpleNamespace(after=lambda: "after", asked=a))
    monkeypatch.setattr(forward, "vertex_tangents", tangents)
    film, live = Film(), mi.Bool([True, False])
    world = SimpleNamespace(segment=SimpleNamespace(end=end))
    tangent, dL = forward.step_on(world, "layout", "store", film, "events", "ray", mi.UInt32(1), live, 4, mi.Color3f(1))
    assert tangent == 5 and asked == {"end": "after", "next": "where the next one lies"}
    np.testing.assert_allclose(np.array(dL).T, [[2, 1.5, 1.25], [1, 1, 1]])
    assert len(film.given) == 2
    for k, (opl, d_value, shifted, active) in enumerate(film.given):
        assert np.array(opl).tolist() == [9] and np.array(d_value).ravel().tolist() == [0.5, 0.25, 0.125]
        assert np.array(shifted).ravel().tolist() == [14 * (k + 1), 21 * (k + 1), 35 * (k + 1)]
        assert np.array(active).tolist() == [True, False]


def test_every_recorded_vertex_is_walked_once(monkeypatch):
    """Of each lane as many as its path has: number by number, from the tangent of the ray on."""
    activate("llvm_ad_mono")

    def step_on(world, layout, store, block, events, ray, k, live, tangent, dL):
        # Digits tell the order.
        return tangent + 1, dr.select(live, dL * 10 + tangent, dL)

    monkeypatch.setattr(forward, "step_on", step_on)
    film, count = Film(), mi.UInt32([0, 1, 3, 2])
    ray = SimpleNamespace(d=mi.Vector3f(0, 0, mi.Float([1.0] * 4)))
    world = SimpleNamespace(max_depth=5)
    with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, False):
        visited = []
        monkeypatch.setattr(forward, "step_on", lambda *a: (visited.append(np.array(a[7]).tolist()), step_on(*a))[1])
        dL = forward.forward(world, None, None, count, film, ray, mi.Float(2))
    assert np.array(dL).ravel().tolist() == [0, 2, 234, 23]
    assert visited == [[False, True, True, True], [False, False, True, True], [False, False, True, False]]
    assert int(film.ended[0]) == 7
