"""Gates: profiles, slopes, pulses, notation."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from torchtransient.gates import Gate, gates_from_text, gates_to_text
from torchtransient.pulses import Pulse
from torchtransient.units import SPEED_OF_LIGHT

RAGGED = Gate.tabulated([6.0, 6.1, 6.5], [0.0, 0.8, 0.0])
GATES = [Gate.rectangular(6, 6.5), Gate.gaussian(7.0, 0.2), RAGGED, Gate.tabulated([1, 2], [1, 3])]


def test_profiles():
    np.testing.assert_array_equal(GATES[0].value([5.999, 6.0, 6.4999, 6.5]), [0, 1, 1, 0])
    np.testing.assert_allclose(GATES[1].value([6.9, 7.0, 7.1]), [0.5, 1, 0.5], atol=2e-4)
    assert GATES[1].value(GATES[1].start_opl) == 0
    np.testing.assert_allclose(RAGGED.value([5.9, 6.05, 6.3, 6.6]), [0, 0.4, 0.4, 0])
    # A table that does not end at zero ends with a jump.
    np.testing.assert_allclose(GATES[3].value([0.999, 1.0, 1.5, 1.999, 2.0]), [0, 1, 2, 2.998, 0])
    assert [gate.is_continuous for gate in GATES] == [False, True, True, False]


def test_nodes_end_where_a_table_ends():
    nodes = Gate.tabulated([1.0, 1.2, 2.0], [1.0, 4.0, 3.0]).nodes()
    assert (nodes[0], nodes[-1]) == (1.0, 3.0) and Gate.gaussian(7.0, 0.2).nodes()[-1] == 0


@pytest.mark.parametrize("gate", GATES, ids=str)
def test_nodes_follow_the_profile(gate):
    nodes = gate.nodes()
    x = np.random.default_rng(0).uniform(gate.start_opl, gate.end_opl, 500)
    at = np.interp(x, np.linspace(gate.start_opl, gate.end_opl, nodes.size), nodes)
    # a kink between two of 2049 points, or the curvature of a Gaussian
    slope = np.abs(np.diff(nodes)).max() if nodes.size > 2 else 0
    np.testing.assert_allclose(at, gate.value(x), atol=max(slope, 1e-12))
    assert np.abs(at - gate.value(x)).mean() < 1e-5


@pytest.mark.parametrize("gate", GATES, ids=str)
def test_notation_and_pickles(gate):
    again = gates_from_text(gates_to_text([gate, gate.shifted(0.25)]))
    for a, b in zip(again, (gate, gate.shifted(0.25)), strict=True):
        assert a.kind == b.kind
        np.testing.assert_allclose([a.start_opl, a.end_opl], [b.start_opl, b.end_opl], rtol=1e-12)
        assert a.values == b.values
    assert pickle.loads(pickle.dumps(gate)) == gate and hash(gate) == hash(pickle.loads(pickle.dumps(gate)))


def test_gates_before_the_start():
    gate = Gate.rectangular(-2.0, -1.0)
    np.testing.assert_array_equal(gate.value([-2.5, -1.5, -0.5]), [0, 1, 0])


def test_sequence_and_seconds():
    first, second, third = Gate.rectangular(1, 1.5).sequence(0.25, 3)
    assert (first.start_opl, second.start_opl, third.end_opl) == (1, 1.25, 2.0)
    assert Gate.rectangular_s(1e-9, 2e-9).end_opl == pytest.approx(2e-9 * SPEED_OF_LIGHT)
    assert Gate.gaussian_s(2e-8, 1e-9) == Gate.gaussian(2e-8 * SPEED_OF_LIGHT, 1e-9 * SPEED_OF_LIGHT)


# A pulse that is the same both ways round would not notice one that is mirrored.
PULSES = [Pulse.gaussian(0.1), Pulse.rectangular(0.3, 0.2), Pulse.tabulated([-0.05, 0.02, 0.3], [0.2, 1.0, 0.0])]


@pytest.mark.parametrize("pulse, gate", list(zip(PULSES, GATES, strict=False)), ids=lambda one: one.kind)
def test_spread_by_a_pulse(gate, pulse):
    seen = gate.spread(pulse)
    assert seen.is_continuous
    x = np.linspace(seen.start_opl, seen.end_opl, 60)
    delays = np.linspace(*pulse.support_opl, 40001)
    shares, middle = np.diff(pulse.cumulative(delays)), 0.5 * (delays[1:] + delays[:-1])
    expected = [gate.value(t + middle) @ shares for t in x]
    np.testing.assert_allclose(seen.value(x), expected, atol=2e-3)
