"""Forward mode: walk the record once more; the tangent of the Carry goes from vertex to vertex.

Every event puts ``k dvalue + value k' dtau`` onto the film. A vertex is the same function as in reverse mode, so both
agree to rounding for one seed.
"""

from __future__ import annotations

import warnings

import drjit as dr
import mitsuba as mi

from torchtransient.errors import TorchTransientWarning
from torchtransient.plugins.polarized import light_type
from torchtransient.plugins.transport.carry import Carry, with_fields
from torchtransient.plugins.transport.derivative.vertex import attached_carry, vertex_terms
from torchtransient.plugins.transport.sinks.record import RecordedVertex


def propagate_tangents(parameters, tables):
    """Bring the tangents of the scene's ``parameters`` to where the loop meets them, outside of its isolated scope;
    ``tables``: what has been computed of them.
    """
    attached = parameters.attached_values()
    # To them, and on to what plugins derive from them, such as the vertices of a rectangle; a caller may have done so
    # already. In one go: a call of a plugin that tables come from runs into edges that no traversal knows of.
    for value in attached + [table for table in tables if dr.grad_enabled(table)]:
        dr.enqueue(dr.ADMode.Backward, value)
    for value in attached:
        dr.enqueue(dr.ADMode.Forward, value)
    dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges)
    if attached and all(_is_untouched(value) for value in attached):
        warnings.warn(
            "render_forward: no tangent has come to any attached parameter, and derivatives are zero. Set one on them, "
            "or on what they come from, with dr.set_grad, and traverse with ADFlag.ClearEdges or not at all: Dr.Jit's "
            "default flags clear what lies between.",
            TorchTransientWarning,
            stacklevel=3,
        )


def _is_untouched(value):
    """Whether nobody has given a tangent: one that is zero is stored as an array."""
    tangent = dr.grad(value)
    tangent = getattr(tangent, "matrix", tangent) if "Transform" in type(tangent).__name__ else tangent
    tangent = tangent.array if dr.is_tensor_v(tangent) else tangent
    tangent = dr.ravel(tangent) if dr.depth_v(tangent) > 1 else tangent
    return tangent.state == dr.VarState.Literal and not bool(dr.any(tangent != 0))


def tangents_of(values):
    """Tangents of attached values; zero for those that carry none."""
    attached = [v for v in values if dr.grad_enabled(v)]
    if not attached:
        return [dr.zeros(type(v)) for v in values]
    # Some of the values are inputs of others: their tangents must survive the traversal, so vertices are not cleared.
    pushed = dr.forward_to(*attached, flags=dr.ADFlag.ClearEdges)
    pushed = list(pushed) if isinstance(pushed, (tuple, list)) and len(attached) > 1 else [pushed]
    return [pushed.pop(0) if dr.grad_enabled(v) else dr.zeros(type(v)) for v in values]


def vertex_tangents(world, v, tangent):
    """(events, detached, with ``d_value`` and ``d_opl``; the tangent of the next Carry).

    Everything attached dies on return: a variable that outlived this call would leave an edge of Dr.Jit's graph behind,
    which the next traversal would run into.
    """
    wanted = world.wanted
    with dr.resume_grad():
        carry = attached_carry(v, world.carried, tangent)
        terms, out, _ = vertex_terms(world, v, carry, wanted)
        values = [term.value for term in terms]
        slopes = [term.slope for term in terms]
        carried = [getattr(out, name) for name in world.carried]
        found = tangents_of(values + slopes + carried)
    n = len(terms)
    for term, d_value, d_opl in zip(terms, found[:n], found[n : 2 * n], strict=True):
        term.value, term.d_value, term.d_opl, term.slope = dr.detach(term.value), d_value, d_opl, None
    return terms, with_fields(Carry.zeros(), world.carried, found[2 * n :])


def step_on(world, layout, store, block, events, ray, k, live, tangent, dL):
    """(tangent of the Carry behind vertex ``k``, ``dL`` with the derivative of its events)."""
    v = RecordedVertex(layout, store, k, live, ray)
    v.next = world.segment.end(world, v.after())
    terms, tangent = vertex_tangents(world, v, tangent)
    for term in terms:
        dL = dL + dr.select(live, term.d_value, 0)
        block.put_slope(events, term.opl, term.d_value, term.value * term.d_opl, term.active)
    return tangent, dL


@dr.syntax
def forward(world, layout, store, count, block, ray, tangent):
    """Write the derivative of the transient to ``block``; returns that of the steady radiance.

    ``tangent``: that of the Carry of the primary ``ray``.
    """
    k = dr.zeros(mi.UInt32, dr.width(ray.d))
    live = k < count
    dL = light_type()(0)
    events = block.begin()
    while dr.hint(live, max_iterations=world.max_depth, label="forward mode"):
        tangent, dL = step_on(world, layout, store, block, events, ray, k, live, tangent, dL)
        k += 1
        live = k < count
    block.end(events)
    return dL
