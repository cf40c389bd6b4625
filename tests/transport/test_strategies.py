"""What strategies owe the loop, and how connections share the weight of a light's point."""

from __future__ import annotations

import inspect

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from torchtransient.plugins.films.block import AdjointBlock
from torchtransient.plugins.transport.sinks import Sink
from torchtransient.plugins.transport.strategy import (
    Connection,
    Guide,
    Local,
    Scattering,
    Segment,
    Strategy,
    mis_weight,
)

VARIANT = "llvm_ad_mono"

OWED = {
    Strategy: set(),
    Segment: {
        "first", "depart", "arrive", "surface_of", "interaction_of", "transmittance", "restore", "next_surface", "end",
        "attached", "motion",
    },
    Connection: {"connect", "attached"},
    Guide: {"draw", "density"},
    Scattering: {"arrive", "scatter", "look_up_attached", "evaluate", "attached"},
}  # fmt: skip


def called(method):
    """A method called with nothing but what it needs."""
    parameters = inspect.signature(method).parameters.values()
    return method(*(None for p in parameters if p.default is inspect.Parameter.empty))


@pytest.mark.parametrize("kind", list(OWED), ids=lambda kind: kind.__name__)
def test_what_a_strategy_leaves_out_is_an_error_at_the_call(kind):
    """Silence would be a picture without that light."""
    for name in OWED[kind]:
        with pytest.raises(NotImplementedError):
            called(getattr(kind(), name))


def test_what_a_strategy_may_leave_out_has_an_answer():
    leg = object()
    assert Segment().leg_to(leg, None) is leg
    assert (Segment().weight(None), Segment().attached_transmittance(None, None, None, None)) == (1, 1)
    assert Segment().has_no_normal(None) is None
    assert Connection().events(None) == 1
    assert (Connection().propose(None, None, None, None), Connection().numbers({})) == (None, None)
    assert (Connection().density(None, None, None, None), Connection().claims(None, None, None, None)) == (None, None)
    assert Guide().share_at(3) == 0.5
    assert (Strategy().fields(None), Strategy().record(None), Strategy().tables()) == ({}, {}, [])
    assert Sink().zeros is False and Sink().keeps_vertices is True


def test_a_segment_that_knows_no_guides_departs_as_always():
    """The throughput is the vertex's."""

    class Straight(Segment):
        def depart(self, *arguments):
            return arguments

    vertex = Local(β="β")
    assert Straight().depart_guided("world", "ray", vertex, "step", "sampler", "active") == (
        "world", "ray", vertex, "β", "sampler", "active",
    )  # fmt: skip


def test_adjoints_of_films_that_read_one_by_one():
    block = AdjointBlock(None, None, None, None, None)
    assert block.together(7, True) == 0
    with pytest.raises(NotImplementedError):
        block.read_together([], True, True)


def test_power_heuristic():
    a, b = mi.Float([2, 3, 0, 5, 0, 2]), mi.Float([3, 2, 4, 0, 0, dr.inf])
    np.testing.assert_allclose(np.array(mis_weight(a, b)), [4 / 13, 9 / 13, 0, 1, 0, 0], rtol=1e-6)


class Sampled(Connection):
    """One whose density is given, or None."""

    def __init__(self, name, density=None):
        self.name, self.given = name, density

    def density(self, world, ref, ds, active):
        return None if self.given is None else mi.Float(self.given)


def test_connections_share_their_weight_by_their_densities():
    """``b_i / B * B^2 / (A^2 + B^2)``, with the sum ``B`` of what all connections have, and nothing over nothing."""
    one, two, three, none = Sampled("1", [2, 0, 0]), Sampled("2", [3, 5, 0]), Sampled("3", [7, 2, 0]), Sampled("4")
    pdf = mi.Float([4, 4, 4])
    world = Local(connections=[one, none, two, three])
    weights = [np.array(c.weight(world, None, None, mi.Float(c.given), pdf, True)) for c in (one, two, three)]
    B = np.array([12.0, 7.0, 0.0])
    expected = [np.array(c.given) * B / (16 + B**2) for c in (one, two, three)]
    np.testing.assert_allclose(weights, expected, rtol=1e-6, atol=0)
    alone = Local(connections=[two, none])
    found = np.array(two.weight(alone, None, None, mi.Float([3, 5, 0]), pdf, True))
    np.testing.assert_allclose(found, [9 / 25, 25 / 41, 0], rtol=1e-6)
