"""Loop over the vertices of light paths: segment, vertex, connections, scattering, next segment.

:func:`walk` traces paths to their ends, :func:`advance` up to a vertex. Both repeat :func:`bounce`, which asks the
strategies of a context (:mod:`.strategy`) and hands events and vertices to a sink (:mod:`.sinks`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.polarized import product
from torchtransient.plugins.transport.sinks import Sink
from torchtransient.plugins.transport.strategy import Local


@dataclass
class Path:
    """State of the loop. A dataclass, which Dr.Jit takes apart, so that one name is the whole state."""

    ray: Any               # Ray3f      ray of the current segment
    leg: Any               # PyTree     end of that segment, in the form of the segment strategy
    depth: Any             # UInt32     vertices so far
    β: Any                 # Spectrum   throughput before the current segment
    η: Any                 # Float      index of refraction along the current segment
    τ: Any                 # Float64    optical path length up to the current segment, minus the film's start, metres
    prev_p: Any            # Point3f    vertex that the ray left
    prev_n: Any            # Normal3f   normal there
    prev_pdf: Any          # Float      density of the ray's direction, per solid angle
    prev_unconnected: Any  # Bool       no connection can find what lies ahead (sensor, delta lobe)
    active: Any            # Bool       the path has a further vertex
    # Of films that measure rates, None for all others.
    rate: Any = None       # Float      derivative of τ by time, m/s
    prev_v: Any = None     # Vector3f   velocity of the vertex that the ray left


def start(context, ray, first_opl, η) -> Path:
    """Return a path at the sensor, whose first leg is not set.

    Args:
        context: :class:`.context.RenderContext` of the job.
        ray: primary ray, Ray3f.
        first_opl: optical path length before the ray's origin, minus the film's start, metres (Float64).
        η: index of refraction at the ray's origin.
    """
    velocities = context.velocities
    return Path(
        ray=mi.Ray3f(ray),
        leg=None,
        depth=mi.UInt32(0),
        β=mi.Spectrum(1),
        η=mi.Float(η),
        τ=mi.Float64(first_opl),
        prev_p=mi.Point3f(ray.o),
        prev_n=mi.Normal3f(0),
        prev_pdf=mi.Float(1),
        prev_unconnected=mi.Bool(True),
        active=mi.Bool(context.max_depth > 0),
        rate=None if velocities is None else mi.Float(0),
        prev_v=None if velocities is None else mi.Vector3f(velocities.of_sensor(ray.o)),
    )


def first_leg(context, sampler, ray, pi):
    """Return the leg of a primary ray.

    Args:
        context: :class:`.context.RenderContext` of the job.
        sampler: Mitsuba sampler of the lanes.
        ray: primary ray, Ray3f.
        pi: PreliminaryIntersection3f at the end of the leg, None if unknown.
    """
    return context.segment.first(context, ray, sampler) if pi is None else context.segment.leg_to(pi, ray)


@dr.syntax
def walk(context, sampler, path, sink):
    """Trace paths to their ends and hand their events and vertices to a sink.

    Args:
        context: :class:`.context.RenderContext` of the job.
        sampler: Mitsuba sampler of the lanes.
        path: :class:`Path` that starts at the sensor or continues from any vertex; its ``leg`` is set.
        sink: :class:`.sinks.Sink` of events and vertices.

    Returns:
        (number of vertices, UInt32; state of the sink).
    """
    state = sink.begin(context)
    # Without emission that is run into, the last vertex only connects to lights: it needs no iteration of the loop.
    turns = context.max_depth if context.finds_light or sink.keeps_vertices else max(context.max_depth - 2, 0)
    dark = context.dark_at_first and not sink.keeps_vertices and turns > 0
    if dr.hint(dark, mode="scalar"):
        bounce(context, path, state, sampler, sink, dark=True)
    # Dr.Jit compiles a loop without iterations all the same.
    if dr.hint(turns > dark or sink.keeps_vertices, mode="scalar"):
        while dr.hint(path.active & (path.depth < turns), max_iterations=turns, label="path"):
            bounce(context, path, state, sampler, sink)
    if dr.hint(not (context.finds_light or sink.keeps_vertices), mode="scalar"):
        bounce(context, path, state, sampler, sink, last=True)
    sink.end(state)
    return path.depth, state


@dr.syntax
def advance(context, sampler, path, target):
    """Trace paths on until their next vertex is number ``target``, without looking for light.

    Args:
        context: :class:`.context.RenderContext` of the job.
        sampler: Mitsuba sampler of the lanes.
        path: :class:`Path` with its ``leg``; inactive afterwards where it ends before.
        target: number of a vertex, UInt32.

    Returns:
        (path, (PreliminaryIntersection3f of the last surface that was reached, the ray that found it)).
    """
    state, sink = {}, Sink()
    pi, ray = mi.PreliminaryIntersection3f(context.segment.surface_of(path.leg)[0]), mi.Ray3f(path.ray)
    going = path.active & (path.depth < target)
    while dr.hint(going, max_iterations=context.max_depth, label="to a vertex"):
        pi, ray = mi.PreliminaryIntersection3f(context.segment.surface_of(path.leg)[0]), mi.Ray3f(path.ray)
        bounce(context, path, state, sampler, sink, dark=True)
        going = path.active & (path.depth < target)
    path.active &= path.depth == target
    return path, (pi, ray)


def bounce(context, path, state, sampler, sink, *, dark=False, last=False):
    """Follow paths over one vertex: an iteration of the loop, which changes ``path`` at its end.

    Plain Python: lists cost nothing where they are empty, and Dr.Jit does not rewrite its syntax.

    Args:
        context: :class:`.context.RenderContext` of the job.
        path: :class:`Path` before the vertex.
        state: loop state of the sink.
        sampler: Mitsuba sampler of the lanes.
        sink: :class:`.sinks.Sink` of events and vertices.
        dark: no connection has light at the vertex.
        last: the paths end at the vertex, and ``path`` stays as it is.
    """
    connections = [] if dark else context.connections
    # ------------------------------------------------------------------------- vertex
    vertex = context.segment.arrive(context, path)
    vertex.τ, vertex.η = path.τ + vertex.opl, path.η
    vertex.goes_on = path.active & (path.depth + 1 < context.max_depth) & vertex.valid
    vertex.goes_on = context.in_time(vertex.goes_on, vertex.τ, vertex.at.p)
    context.scattering.arrive(context, path, vertex, sampler)
    if (taken_over := context.taken_over(path, vertex)) is not None:
        vertex.goes_on &= ~taken_over
    vertex.scattered_τ = vertex.delay.after(vertex.τ)
    if context.velocities is not None:
        context.velocities.arrive(context, path, vertex)

    # ------------------------------------------------------------------------- events
    proposals = [c.propose(context, path, vertex, sampler) for c in connections]
    answers, step = context.scattering.scatter(context, path, vertex, proposals, sampler)
    samples = {}
    for c, proposal, answer in zip(connections, proposals, answers, strict=True):
        event = c.connect(context, path, vertex, proposal, answer, sink.zeros)
        event.value = dr.select(event.active, event.value, 0)
        if context.velocities is not None:
            event.rate = context.velocities.of_event(context, c, vertex, proposal, answer)
        sink.event(state, event)
        samples[c.name] = Local(proposal=proposal, event=event)
    if last:
        return

    # ------------------------------------------------------------------------- next direction
    onward = vertex.goes_on
    if not context.finds_light:  # the last vertex has no event
        onward &= path.depth + 2 < context.max_depth
    ray, leg = vertex.at.spawn_ray(step.out), None
    if context.scattering.guides:  # the density of a guided direction is known at the end of its segment
        leg = context.segment.depart_guided(context, ray, vertex, step, sampler, onward)
        context.scattering.weigh(context, path, vertex, step, ray, leg)

    # ------------------------------------------------------------------------- Russian roulette
    β, goes_on, rr = roulette(context, path, vertex, step, sampler, onward, sink.zeros)
    samples[context.segment.name], samples[context.scattering.name] = vertex, step
    samples["walk"] = Local(β=path.β, τ=vertex.τ, η=path.η, rr=rr, goes_on=goes_on)
    if context.velocities is not None:
        samples["walk"].rate = vertex.rate
    sink.vertex(state, path, samples)

    # ------------------------------------------------------------------------- next segment
    path.ray, path.depth, path.active = ray, path.depth + 1, goes_on
    path.prev_p, path.prev_n = vertex.at.p, vertex.at.n
    path.prev_pdf, path.prev_unconnected = step.pdf, step.unconnected
    path.β, path.η, path.τ = β, path.η * step.eta, vertex.scattered_τ
    if context.velocities is not None:
        path.rate, path.prev_v = vertex.rate, vertex.velocity
    path.leg = leg if leg is not None else context.segment.depart(context, ray, vertex, β, sampler, goes_on)


def roulette(context, path, vertex, step, sampler, goes_on, zeros):
    """Return (throughput behind the vertex, mask of paths that continue, factor of the throughput).

    Args:
        context: :class:`.context.RenderContext` of the job.
        path: :class:`Path` before the vertex.
        vertex: :class:`.strategy.Vertex`.
        step: :class:`.strategy.Step`, the sampled direction.
        sampler: Mitsuba sampler of the lanes.
        goes_on: mask of paths that have a further vertex.
        zeros: paths of throughput zero matter (:attr:`.sinks.Sink.zeros`).
    """
    β = product(vertex.β, step.weight)
    β_max = dr.max(mi.unpolarized_spectrum(β))
    if zeros:
        # The derivative of a product with one factor of zero is the product of the others: paths continue behind
        # their first black surface.
        weight_max = dr.max(mi.unpolarized_spectrum(step.weight))
        first_black = (weight_max == 0) & (dr.max(mi.unpolarized_spectrum(vertex.β)) > 0) & (step.pdf > 0)
        goes_on &= (weight_max > 0) | first_black
        β_max = dr.select(β_max == 0, 1, β_max)
    else:
        goes_on &= β_max != 0
    if not context.plays_roulette:
        return β, goes_on, mi.Float(1)
    chance = dr.minimum(β_max * dr.square(path.η * step.eta), 0.95)
    plays = path.depth >= context.rr_depth
    rr = dr.select(plays, dr.rcp(chance), 1)
    survives = sampler.next_1d() < chance
    return β * rr, goes_on & (~plays | survives), rr
