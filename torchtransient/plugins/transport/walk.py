"""The one loop: segment, vertex, connections, scattering, next segment. What becomes of it is the sink's."""

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
    """Loop state of a walk. A dataclass on purpose: Dr.Jit takes it apart, so that one name is the whole state."""

    ray: Any               # Ray3f      current ray
    leg: Any               # PyTree     how it ends, in the form of the segment strategy
    depth: Any             # UInt32     vertices so far
    β: Any                 # Spectrum   throughput before the current segment
    η: Any                 # Float      index of the medium of the current ray
    τ: Any                 # Float64    optical path length so far, minus the film's start
    prev_p: Any            # Point3f    vertex that the ray left
    prev_n: Any            # Normal3f   normal there
    prev_pdf: Any          # Float      density of the ray's direction, per solid angle
    prev_unconnected: Any  # Bool       no connection could have found what lies ahead (sensor, delta lobe)
    active: Any            # Bool


def start(world, ray, first_opl, η) -> Path:
    """A path at the sensor; ``first_opl``: optical length before the ray's origin, minus the film's start; ``η``: index
    of refraction there.
    """
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
        active=mi.Bool(world.max_depth > 0),
    )


def look_around(world, path, kept, sampler, sink, *, dark=False):
    """What a path finds at its next vertex: changes ``kept``; returns (vertex, next step, samples by strategy).
    ``dark``: no connection finds light there.
    """
    connections = [] if dark else world.connections
    # ------------------------------------------------------------------------- vertex
    vertex = world.segment.arrive(world, path)
    vertex.τ, vertex.η = path.τ + vertex.opl, path.η
    vertex.goes_on = path.active & (path.depth + 1 < world.max_depth) & vertex.valid
    vertex.goes_on = world.in_time(vertex.goes_on, vertex.τ, vertex.at.p)
    world.scattering.arrive(world, path, vertex, sampler)
    vertex.scattered_τ = vertex.delay.after(vertex.τ)

    # ------------------------------------------------------------------------- events
    proposals = [c.propose(world, path, vertex, sampler) for c in connections]
    answers, step = world.scattering.scatter(world, path, vertex, proposals, sampler)
    samples = {}
    for c, proposal, answer in zip(connections, proposals, answers, strict=True):
        event = c.connect(world, path, vertex, proposal, answer, sink.zeros)
        event.value = dr.select(event.active, event.value, 0)
        sink.event(kept, event)
        samples[c.name] = Local(proposal=proposal, event=event)
    return vertex, step, samples


def bounce(world, path, kept, sampler, sink, *, dark=False):
    """One turn of the loop: changes ``path`` (at its end) and ``kept``. ``dark``: as in :func:`look_around`.

    Plain Python, so that lists cost nothing where they are empty and Dr.Jit's rewriting of syntax sees none of it.
    """
    vertex, step, samples = look_around(world, path, kept, sampler, sink, dark=dark)
    # ------------------------------------------------------------- to the next vertex
    onward = vertex.goes_on
    if not world.finds_light:  # nothing would be looked for at the last vertex
        onward &= path.depth + 2 < world.max_depth
    ray, leg = vertex.at.spawn_ray(step.out), None
    if world.scattering.guides:  # the density of what a guide drew is known once the segment has ended
        leg = world.segment.depart_guided(world, ray, vertex, step, sampler, onward)
        world.scattering.weigh(world, path, vertex, step, ray, leg)
    β, goes_on, rr = roulette(world, path, vertex, step, sampler, onward, sink.zeros)
    samples[world.segment.name], samples[world.scattering.name] = vertex, step
    samples["walk"] = Local(β=path.β, τ=vertex.τ, η=path.η, rr=rr, goes_on=goes_on)
    sink.vertex(kept, path, samples)

    path.ray, path.depth, path.active = ray, path.depth + 1, goes_on
    path.prev_p, path.prev_n = vertex.at.p, vertex.at.n
    path.prev_pdf, path.prev_unconnected = step.pdf, step.unconnected
    path.β, path.η, path.τ = β, path.η * step.eta, vertex.scattered_τ
    path.leg = leg if leg is not None else world.segment.depart(world, ray, vertex, β, sampler, goes_on)


def roulette(world, path, vertex, step, sampler, goes_on, zeros):
    """(throughput behind the vertex, whether the path goes on, factor of the throughput)."""
    β = product(vertex.β, step.weight)
    β_max = dr.max(mi.unpolarized_spectrum(β))
    if zeros:
        # The derivative of a product with one factor of zero needs the light beyond it: go on past the first black
        # surface.
        weight_max = dr.max(mi.unpolarized_spectrum(step.weight))
        first_black = (weight_max == 0) & (dr.max(mi.unpolarized_spectrum(vertex.β)) > 0) & (step.pdf > 0)
        goes_on &= (weight_max > 0) | first_black
        β_max = dr.select(β_max == 0, 1, β_max)
    else:
        goes_on &= β_max != 0
    if not world.plays_roulette:
        return β, goes_on, mi.Float(1)
    chance = dr.minimum(β_max * dr.square(path.η * step.eta), 0.95)
    plays = path.depth >= world.rr_depth
    rr = dr.select(plays, dr.rcp(chance), 1)
    survives = sampler.next_1d() < chance
    return β * rr, goes_on & (~plays | survives), rr


def walk(world, sampler, ray, first_opl, sink, η=1, leg=None):
    """Trace the paths of one pass into ``sink``; returns (number of vertices, what the sink kept). ``η``: index of
    refraction where they start; ``leg``: PreliminaryIntersection3f at the end of their first segment, None where that
    is not known.
    """
    path = start(world, ray, first_opl, η)
    path.leg = first_leg(world, sampler, ray, leg)
    return go_on(world, sampler, path, sink)


def first_leg(world, sampler, ray, leg):
    """The leg of a primary ray; ``leg``: as of :func:`walk`."""
    return world.segment.first(world, ray, sampler) if leg is None else world.segment.known(leg, ray)


@dr.syntax
def advance(world, sampler, path, target):
    """Let paths go on to their vertex number ``target`` (UInt32), which they are then on the way to, and look for no
    light before. Those that end before are not active. Returns the path, and what its last vertex was found by: (the
    surface's PreliminaryIntersection3f, the ray).
    """
    kept, sink = {}, Sink()
    pi, ray = mi.PreliminaryIntersection3f(world.segment.surface_of(path.leg)[0]), mi.Ray3f(path.ray)
    going = path.active & (path.depth < target)
    while dr.hint(going, max_iterations=world.max_depth, label="to a vertex"):
        pi, ray = mi.PreliminaryIntersection3f(world.segment.surface_of(path.leg)[0]), mi.Ray3f(path.ray)
        bounce(world, path, kept, sampler, sink, dark=True)
        going = path.active & (path.depth < target)
    path.active &= path.depth == target
    return path, (pi, ray)


@dr.syntax
def go_on(world, sampler, path, sink):
    """Trace paths on from wherever they are; returns as :func:`walk`."""
    kept = sink.begin(world)
    # Of the last vertex nothing is asked but its connections where no light is found: it needs no turn of the loop.
    turns = world.max_depth if world.finds_light or sink.keeps_vertices else max(world.max_depth - 2, 0)
    dark = world.dark_at_first and not sink.keeps_vertices and turns > 0
    if dr.hint(dark, mode="scalar"):
        bounce(world, path, kept, sampler, sink, dark=True)
    # A loop of no turn would be compiled all the same.
    if dr.hint(turns > dark or sink.keeps_vertices, mode="scalar"):
        while dr.hint(path.active & (path.depth < turns), max_iterations=turns, label="path"):
            bounce(world, path, kept, sampler, sink)
    if dr.hint(not (world.finds_light or sink.keeps_vertices), mode="scalar"):
        look_around(world, path, kept, sampler, sink)
    sink.end(kept)
    return path.depth, kept
