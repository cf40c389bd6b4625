"""A sun that moves and that paths run into, by differences of geometry."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.moving_points import MOVE, PLACE, attached_zero, difference, slopes, unit, vector
from torchtransient.plugins.sampling.lights import DistantReference
from torchtransient.plugins.transport.emitter_connections import EmitterFound
from torchtransient.plugins.transport.strategy import Local

VARIANT = "llvm_ad_rgb"


def vertex_before(x, following, radius=0.5):
    """A vertex at ``PLACE`` that moves, with a throughput, a slope and an index that change."""
    si = Local(p=mi.Point3f(vector(mi.Point3f, PLACE, MOVE, x)))
    carry = Local(β=mi.Spectrum(0.5, 0.25, 2) * (1 + 0.11 * x), η=mi.Float(1.25) + 0.3 * x)
    return Local(scattered_si=si, v=Local(after=lambda: following), carry=carry, rotation=None,
                 scattered_slope=7 * (x - dr.detach(x)), damping_radius=dr.opaque(mi.Float, radius))  # fmt: skip


def following_at(ray, pi, mis):
    return Local(record_of=lambda name: {"mis": mi.Float(mis)}, pi=pi, ray=ray, τ=mi.Float64(11),
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
        shines=lambda emitter, direction: mi.Bool([True] * 4 + [False]) & (direction.x > 0.2), attach_direction=followed
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
