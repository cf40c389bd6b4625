"""Reverse mode: walk the record backwards; the adjoint of the Carry goes from vertex to vertex.

With the adjoint ``A`` of the film at an event's arrival and its slope ``A'``, a vertex back-propagates

    sum over events of (A value + A' value slope) + <adjoint of the next Carry, next Carry>

and reads the gradients of its own Carry: that of the throughput is the light beyond per unit throughput, weighed by its
adjoints; that of the slope the same light weighed by ``A'``. Nothing is divided: a zero albedo has its right gradient,
and no Mueller matrix is inverted.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.transport.carry import Carry, adjoint_of, choose, inner, total_of
from torchtransient.plugins.transport.derivative.vertex import VertexEnd, attached_carry, vertex_terms
from torchtransient.plugins.transport.sinks.arrivals import read_ahead
from torchtransient.plugins.transport.sinks.record import RecordedVertex


def step_back(world, layout, store, block, ray, k, live, adjoint, following):
    """(adjoint of the Carry that arrives at vertex ``k``, where the vertex lies); parameters get their gradients."""
    wanted = world.wanted
    v = RecordedVertex(layout, store, k, live, ray)
    v.next = following
    with dr.resume_grad():
        carry = attached_carry(v, world.carried)
        terms, out, vertex = vertex_terms(world, v, carry, wanted)
        objective = inner(adjoint, out, world.carried)
        for term in terms:
            A, slope = adjoint_at(layout, store, block, term)
            objective += total_of(A, term.value)
            if wanted.geometry:
                objective += total_of(slope, dr.detach(term.value)) * term.slope
        dr.backward_from(dr.select(live, objective, 0))
        before = adjoint_of(carry, world.carried)
    return choose(live, before, adjoint, world.carried), vertex.end


def adjoint_at(layout, store, block, term):
    """The film's adjoint at the arrival of an event, and its slope."""
    if layout.arrivals is None or term.arrival is None:
        return block.read(term.opl, term.active)
    return layout.arrivals.adjoint(store, block, term.arrival, term.active)


@dr.syntax
def reverse(world, layout, store, count, block, ray):
    """Accumulate the gradients of the recorded paths; returns the adjoint of the Carry of the primary ``ray``.

    ``count``: number of recorded vertices. ``block`` reads the film's adjoint. Must run with gradients suspended.
    """
    if dr.hint(layout.arrivals is not None, mode="scalar"):
        store = read_ahead(layout.arrivals, store, block)
    i = mi.Int32(count) - 1
    live = i >= 0
    adjoint, following = Carry.zeros(), VertexEnd.nowhere()
    while dr.hint(live, max_iterations=world.max_depth, label="reverse mode"):
        adjoint, following = step_back(world, layout, store, block, ray, mi.UInt32(i), live, adjoint, following)
        i -= 1
        live = i >= 0
    return adjoint
