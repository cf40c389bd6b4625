"""Derivatives of a recorded vertex, a function ``Carry -> (EventTerms, Carry)`` of the strategies' attached forms.

The sampled path is held fixed in this sense: vertices are points of their shapes, dragged along with the vertex before
where they are near; the first vertex of a camera's path slides along its ray. Where a delta lobe determines the next
ray, that ray itself is attached.
"""

from __future__ import annotations

import warnings
from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.errors import TorchTransientWarning
from torchtransient.plugins.polarized import light_type, rotation_tangent
from torchtransient.plugins.sensors.origin import sensor_rotation
from torchtransient.plugins.transport.carry import Carry, adjoint_of, attach, choose, inner, total_of, with_fields
from torchtransient.plugins.transport.record import RecordedVertex, read_ahead
from torchtransient.plugins.transport.strategy import VertexEnd, rate_of


def attached_carry(v, names, tangents=None):
    """Return the recorded Carry that arrives at a vertex, with new leaves of the AD graph.

    Args:
        v: :class:`.record.RecordedVertex`.
        names: fields that become leaves.
        tangents: Carry with their tangents in forward mode, None in reverse mode.
    """
    # A leaf has the width of the lanes, or its gradient would be summed up over them.
    zero = dr.zeros(mi.Float, dr.width(v.ray.d))
    o, d = mi.Point3f(v.ray.o), mi.Vector3f(v.ray.d)
    # Of its ends only the derivatives are read.
    carry = Carry(
        β=mi.Spectrum(v.β), slope=zero, η=mi.Float(v.η), o=o, d=d, x=mi.Point3f(o), w=mi.Vector3f(d), p=mi.Point3f(o),
        n=mi.Normal3f(d), rate=zero,
    )  # fmt: skip
    return attach(carry, names, tangents)


# --------------------------------------------------------------------------------------------------------------------
# Reverse mode: walk the record backwards, with the adjoint of the Carry.
#
# With the adjoint ``A`` of the film at an event's arrival and its slope ``A'``, a vertex back-propagates
#
#     sum over events of (A value + A' value slope) + <adjoint of the next Carry, next Carry>
#
# and reads the gradients of its own Carry: that of the throughput is the light beyond per unit throughput, weighed by
# its adjoints; that of the slope the same light weighed by ``A'``. Nothing is divided: a zero albedo has its right
# gradient, and no Mueller matrix is inverted.

def step_back(context, layout, store, block, ray, k, live, adjoint, following):
    """Back-propagate the events of a vertex and the Carry behind it.

    Args:
        context: :class:`.context.RenderContext` of the job.
        layout, store: layout of the record, and the record.
        block: adjoint block of the film.
        ray: primary ray, Ray3f.
        k: number of the vertex, UInt32.
        live: mask of paths that have it.
        adjoint: adjoint of the Carry behind the vertex.
        following: :class:`.strategy.VertexEnd` of the next vertex.

    Returns:
        (adjoint of the Carry that arrives at the vertex, VertexEnd of the vertex).
    """
    wanted = context.wanted
    v = RecordedVertex(layout, store, k, live, ray)
    v.next = following
    with dr.resume_grad():
        carry = attached_carry(v, context.carried)
        vertex = context.segment.attached(context, v, carry, wanted)
        context.scattering.look_up_attached(context, vertex, wanted)
        step = context.scattering.attached(context, vertex, wanted)
        terms = []
        for connection in context.connections:
            terms += connection.attached(context, vertex, step, wanted)
        objective = inner(adjoint, step.carry, context.carried)
        for term in terms:
            if layout.arrivals is None or term.arrival is None:
                A, slope, *by_rate = block.read(term.opl, term.active, **rate_of(term))
            else:
                A, slope = layout.arrivals.adjoint(store, block, term.arrival, term.active)
            objective += total_of(A, term.value)
            if wanted.geometry:
                objective += total_of(slope, dr.detach(term.value)) * term.slope
            if wanted.rate:
                objective += total_of(by_rate[0], dr.detach(term.value)) * term.rate_slope
        dr.backward_from(dr.select(live, objective, 0))
        before = adjoint_of(carry, context.carried)
    return choose(live, before, adjoint, context.carried), vertex.end


@dr.syntax
def reverse(context, layout, store, count, block, ray):
    """Accumulate the gradients of recorded paths, with gradients suspended.

    Args:
        context: :class:`.context.RenderContext` of the job.
        layout, store: layout of the record, and the record.
        count: number of recorded vertices, UInt32.
        block: adjoint block of the film.
        ray: primary ray, Ray3f.

    Returns:
        Adjoint of the Carry of the primary ray.
    """
    if dr.hint(layout.arrivals is not None, mode="scalar"):
        store = read_ahead(layout.arrivals, store, block)
    i = mi.Int32(count) - 1
    live = i >= 0
    adjoint, following = Carry.zeros(), VertexEnd.nowhere()
    while dr.hint(live, max_iterations=context.max_depth, label="reverse mode"):
        adjoint, following = step_back(context, layout, store, block, ray, mi.UInt32(i), live, adjoint, following)
        i -= 1
        live = i >= 0
    return adjoint


# --------------------------------------------------------------------------------------------------------------------
# Forward mode: walk the record forwards, with the tangent of the Carry.
#
# Every event puts ``k dvalue + value k' dtau`` onto the film. A vertex is the same function as in reverse mode, so both
# agree to rounding for one seed.

def propagate_tangents(parameters, tables):
    """Propagate the tangents of the scene's parameters to the arrays that kernels read.

    Args:
        parameters: :class:`~..parameters.ParameterTracker` of the scene.
        tables: arrays that strategies computed from parameters.
    """
    attached = parameters.attached_values()
    # To the parameters, and on to arrays that plugins derive from them, such as the vertices of a rectangle, if the
    # caller has not done so. In one traversal: a plugin call that tables depend on leaves edges that a second traversal
    # does not know.
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
    """Return True for a value without a tangent; a given tangent of zero is stored as an array."""
    tangent = dr.grad(value)
    tangent = getattr(tangent, "matrix", tangent) if "Transform" in type(tangent).__name__ else tangent
    tangent = tangent.array if dr.is_tensor_v(tangent) else tangent
    tangent = dr.ravel(tangent) if dr.depth_v(tangent) > 1 else tangent
    return tangent.state == dr.VarState.Literal and not bool(dr.any(tangent != 0))


def tangents_of(values):
    """Return the tangents of values, pushed through the AD graph; zeros for detached ones.

    Args:
        values: Dr.Jit arrays, some of which may be inputs of others.
    """
    attached = [v for v in values if dr.grad_enabled(v)]
    if not attached:
        return [dr.zeros(type(v)) for v in values]
    # Some of the values are inputs of others: their tangents must survive the traversal, so vertices are not cleared.
    pushed = dr.forward_to(*attached, flags=dr.ADFlag.ClearEdges)
    pushed = list(pushed) if isinstance(pushed, (tuple, list)) and len(attached) > 1 else [pushed]
    return [pushed.pop(0) if dr.grad_enabled(v) else dr.zeros(type(v)) for v in values]


def vertex_tangents(context, v, tangent):
    """Evaluate a recorded vertex in forward mode.

    No attached variable outlives this call: it would leave an edge in Dr.Jit's graph, which breaks the next traversal.

    Args:
        context: :class:`.context.RenderContext` of the job.
        v: :class:`.record.RecordedVertex`.
        tangent: tangent of the Carry that arrives there.

    Returns:
        (detached events with ``d_value``, ``d_opl`` and, where rates change, ``d_rate``; tangent of the next Carry).
    """
    wanted = context.wanted
    with dr.resume_grad():
        carry = attached_carry(v, context.carried, tangent)
        vertex = context.segment.attached(context, v, carry, wanted)
        context.scattering.look_up_attached(context, vertex, wanted)
        step = context.scattering.attached(context, vertex, wanted)
        terms = []
        for connection in context.connections:
            terms += connection.attached(context, vertex, step, wanted)
        values = [term.value for term in terms]
        slopes = [term.slope for term in terms]
        slopes_of_rates = [term.rate_slope for term in terms] if wanted.rate else []
        carried = [getattr(step.carry, name) for name in context.carried]
        found = iter(tangents_of(values + slopes + slopes_of_rates + carried))
    for name in ("d_value", "d_opl", "d_rate")[: 2 + wanted.rate]:
        for term in terms:
            setattr(term, name, next(found))
    for term in terms:
        term.value, term.slope, term.rate_slope = dr.detach(term.value), None, None
    return terms, with_fields(Carry.zeros(), context.carried, list(found))


def step_on(context, layout, store, block, events, ray, k, live, tangent, dL):
    """Write the derivatives of the events of a vertex to the film.

    Args:
        context: :class:`.context.RenderContext` of the job.
        layout, store: layout of the record, and the record.
        block: block of the film.
        events: loop state of the film.
        ray: primary ray, Ray3f.
        k: number of the vertex, UInt32.
        live: mask of paths that have it.
        tangent: tangent of the Carry that arrives there.
        dL: derivative of the steady radiance so far, a spectrum.

    Returns:
        (tangent of the Carry behind the vertex, ``dL`` with that of its events).
    """
    v = RecordedVertex(layout, store, k, live, ray)
    v.next = context.segment.end(context, v.after())
    terms, tangent = vertex_tangents(context, v, tangent)
    for term in terms:
        dL = dL + dr.select(live, term.d_value, 0)
        rate = rate_of(term)
        if rate:
            rate["value_d_rate"] = term.value * getattr(term, "d_rate", 0)
        block.put_slope(events, term.opl, term.d_value, term.value * term.d_opl, term.active, **rate)
    return tangent, dL


@dr.syntax
def forward(context, layout, store, count, block, ray, tangent):
    """Write the derivative of the transient to a film, with gradients suspended.

    Args:
        context: :class:`.context.RenderContext` of the job.
        layout, store: layout of the record, and the record.
        count: number of recorded vertices, UInt32.
        block: block of the film.
        ray: primary ray, Ray3f.
        tangent: tangent of the Carry of the primary ray.

    Returns:
        Derivative of the steady radiance, a spectrum.
    """
    k = dr.zeros(mi.UInt32, dr.width(ray.d))
    live = k < count
    dL = light_type()(0)
    events = block.begin()
    while dr.hint(live, max_iterations=context.max_depth, label="forward mode"):
        tangent, dL = step_on(context, layout, store, block, events, ray, k, live, tangent, dL)
        k += 1
        live = k < count
    block.end(events)
    return dL


# --------------------------------------------------------------------------------------------------------------------
# Derivatives by the sensor: adjoint and tangent of the Carry of its primary rays.

def objective_of(context: Any, rays: Any, adjoint: Carry) -> Any:
    """Return ``<adjoint, Carry>`` of the primary rays (Float), attached to the sensor.

    Args:
        context: :class:`.context.RenderContext` of the job.
        rays: attached :class:`~..sensors.origin.PrimaryRays`.
        adjoint: adjoint of the Carry that leaves the sensor, by :func:`reverse`.
    """
    parts = {"η": adjoint.η}
    if not context.camera_unwarp:
        parts["slope"] = adjoint.slope
    if context.wanted.sensor:
        parts |= {"o": adjoint.o + adjoint.x, "d": adjoint.d + adjoint.w}
        if mi.is_polarized:
            parts["turn"] = dr.sum(adjoint.β[1, 2] - adjoint.β[2, 1])
    # Each entry of a pose is a sum over lanes by itself: without numbers in memory each traces the paths once more.
    dr.eval(parts)
    objective = parts["η"] * rays.η
    if "slope" in parts:
        objective += parts["slope"] * rays.length()
    if context.wanted.sensor:
        objective += dr.dot(parts["o"], rays.ray.o) + dr.dot(parts["d"], rays.ray.d)
    if "turn" in parts:
        objective += parts["turn"] * sensor_rotation(rays.seen, rays.ray).angle()
    return objective


def tangent_of(context: Any, rays: Any) -> Carry:
    """Return the tangent of the Carry at the sensor.

    Args:
        context: :class:`~.context.RenderContext` of the job.
        rays: attached primary rays, :class:`~..sensors.origin.PrimaryRays`.
    """
    tangent = Carry.zeros()
    with dr.resume_grad():
        if not (context.wanted.sensor or dr.grad_enabled(rays.η)):
            return tangent
        attached = [rays.ray.o, rays.ray.d, rays.length(), rays.η]
        if mi.is_polarized:
            attached.append(sensor_rotation(rays.seen, rays.ray).angle())
        o, d, length, η, *rotation = tangents_of(attached)
    tangent.o, tangent.x = mi.Vector3f(o), mi.Vector3f(o)
    tangent.d, tangent.w = mi.Vector3f(d), mi.Vector3f(d)
    tangent.slope = mi.Float(0) if context.camera_unwarp else mi.Float(length)
    tangent.η = mi.Float(η)
    if mi.is_polarized:
        tangent.β = rotation_tangent(rotation[0])
    return tangent
