"""Which gates an arrival meets, and what they are given: tables of gates by themselves, against the gates."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from torchtransient import plugins
from torchtransient.gates import Gate
from torchtransient.plugins.films.block import BinLayout


def gated():
    """The plugin module, as it was executed for the active variant."""
    from torchtransient.plugins.films import gated as module

    return module


@pytest.fixture(autouse=True)
def _variant():
    mi.set_variant("llvm_ad_rgb")
    plugins.sync()


def candidates(table, opl):
    low, high = table.candidates(mi.Float64(opl), mi.Bool(True))
    return np.array(low), np.array(high)


def test_every_open_gate_is_a_candidate():
    """Of many gates, at their edges and next to them; and the first and last of them are within a cell."""
    rng = np.random.default_rng(8)
    starts, lengths = rng.uniform(3, 90, 40), rng.uniform(1e-4, 5, 40)
    gates = [Gate.rectangular(a, a + w) for a, w in zip(starts, lengths, strict=True)]
    table = gated().GateTable(gates, 1.25)
    edges = np.array([(gate.start_opl, gate.end_opl) for gate in gates]) - 1.25
    opl = np.concatenate([edges.ravel(), np.nextafter(edges, 0).ravel(), rng.uniform(1, 95, 2000)])
    low, high = candidates(table, opl)
    cell = (table.last - table.first) / gated().CELLS
    for k, (a, b) in enumerate(edges):
        listed = (low <= k) & (k < high)
        assert listed[(opl >= a) & (opl < b)].all()
    near = (opl[:, None] > edges[:, 0] - 1.001 * cell) & (opl[:, None] < edges[:, 1] + 1.001 * cell)
    some = high > low
    assert near[some].any(1).all() and some.sum() > 1000
    assert (low[some] >= near[some].argmax(1)).all() and (high[some] <= 40 - near[some, ::-1].argmax(1)).all()


def test_the_last_gate_is_met_until_before_its_end():
    """Also where the place of an arrival, in cells, is rounded up to their number."""
    rounded = 0
    for last in np.linspace(0.11, 3.7, 60):
        opl = np.nextafter(last, 0)
        rounded += opl * (gated().CELLS / last) >= gated().CELLS
        gates = [Gate.rectangular(0, last / 2), Gate.rectangular(last / 2, last)]
        low, high = candidates(gated().GateTable(gates, 0.0), [opl])
        assert (low[0], high[0]) == (1, 2)
    assert rounded > 3


def test_cells_of_gates_are_those_that_they_reach_into():
    table = gated().GateTable([Gate.rectangular(2.0, 2.125), Gate.rectangular(2.5, 3.0)], 2.0)
    # cells of 1 / 4096: the first 512, and one that begins at the end of the gate
    assert np.flatnonzero(table.open_cells).tolist() == [*range(513), *range(2048, 4096)]


class Between:
    """Three gates that are open to everything, of which an arrival is said to meet the second alone, or none."""

    def __init__(self, end=2):
        self.end = end

    def candidates(self, opl, active):
        return mi.UInt32(1), mi.UInt32(self.end)

    def value(self, gate, opl, active):
        return mi.Float(gate + 2) * mi.Float(opl), mi.Float(5)


def layout_of(flat, exclusive=False):
    return BinLayout(mi.Float(flat), mi.UInt32([0, 6]), 2, 1, 3, 2, exclusive)


def test_candidates_alone_are_asked():
    """None before them and none behind, of no lane without an event; a value times weight and one times slope."""
    opl, active = mi.Float64([0.5, 0.25]), mi.Bool([True, False])
    for slope_value, share in ((None, 0), ([mi.Float(11), mi.Float(13)], 5)):
        layout = layout_of(np.zeros(12))
        gated().put_gates(layout, Between(), opl, [mi.Float(3), mi.Float(7)], slope_value, active)
        expected = np.zeros((2, 3, 2))
        expected[0, 1] = 3 * 0.5 * 3 + share * 11, 3 * 0.5 * 7 + share * 13
        assert np.array(layout.flat).tolist() == expected.ravel().tolist()
    numbers = np.arange(1.0, 13.0) ** 2
    for steady, more in ((None, 0), ([mi.Float(100), mi.Float(200)], 100)):
        A, slope = gated().read_gates(layout_of(numbers), Between(), opl, steady, active)
        for c in range(2):
            value = numbers[2 + c] + more * (c + 1)
            assert list(A[c]) == [value * 1.5, 0] and list(slope[c]) == [value * 5, 0]
    layout = layout_of(np.zeros(12))
    gated().put_gates(layout, Between(1), opl, [mi.Float(3)] * 2, [mi.Float(3)] * 2, active)
    A, slope = gated().read_gates(layout_of(numbers), Between(1), opl, None, active)
    assert not np.array(layout.flat).any() and not np.any([np.array(part) for part in A + slope])


def test_a_gate_that_begins_to_open_has_a_slope_and_no_weight():
    table = gated().GateTable([Gate.tabulated([2.0, 4.0, 5.0], [0.0, 3.0, 0.0])], 0.0)
    layout = BinLayout(dr.zeros(mi.Float, 2), mi.UInt32(0), 2, 1, 1, 2)
    gated().put_gates(layout, table, mi.Float64(2.0), [mi.Float(1)] * 2, [mi.Float(4), mi.Float(6)], mi.Bool(True))
    assert np.array(layout.flat).tolist() == [6, 9]


@pytest.mark.parametrize("gates", ["rectangular 1 2", "tabulated 1:0 2:1 3:0"])
def test_what_a_response_without_a_slope_is_called(gates):
    film = mi.load_dict({"type": "gated_hdr_film", "gates": gates})
    assert film.has_slope == (film.response_name == "gate") == ("tabulated" in gates)
    assert "rectangular" in film.response_name or film.has_slope


def test_gates_are_seen_through_both_pulses():
    """The time that an arrival counts grows by the support of each."""
    width = {"pulse": "rectangular", "pulse_width_opl": 0.5, "irf": "rectangular", "irf_width_opl": 0.25}
    film = mi.load_dict({"type": "gated_hdr_film", "gates": "rectangular 6 7", "start_opl": 2.0, **width})
    alone = mi.load_dict({"type": "gated_hdr_film", "gates": "rectangular 6 7", "start_opl": 2.0})
    assert (alone.table.first, alone.table.last) == (4, 5)
    assert (film.table.first, film.table.last) == pytest.approx((4 - 0.375, 5 + 0.375))
    assert (film.arrivals().first, film.arrivals().last) == (film.table.first, film.table.last)
