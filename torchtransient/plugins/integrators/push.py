"""Forward mode: walk the recorded path once more and carry its tangents along.

``d_beta`` and ``d_tau`` are the derivatives of throughput and optical path length before the current vertex; every
event splats
``k df + f k' dtau``. The rules at a vertex are those of the reverse sweep, so both modes agree to rounding for one
seed.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.integrators.media.leg_sweep import after_leg, moving_points, push_legs, vertex_after
from torchtransient.plugins.integrators.path_record import read_vertex
from torchtransient.plugins.integrators.sweep import led_to, next_vertex
from torchtransient.plugins.integrators.vertex import attach_ray, vertex_terms
from torchtransient.plugins.polarized import column, light_type, product, turning_throughput


def tangents(values):
    """Tangents of attached values; zero for those that carry none."""
    attached = [v for v in values if dr.grad_enabled(v)]
    if not attached:
        return [dr.zeros(type(v)) for v in values]
    # Some of the values are inputs of others: their tangents must survive the traversal, so vertices are not cleared.
    pushed = dr.forward_to(*attached, flags=dr.ADFlag.ClearEdges)
    pushed = list(pushed) if isinstance(pushed, (tuple, list)) and len(attached) > 1 else [pushed]
    return [pushed.pop(0) if dr.grad_enabled(v) else dr.zeros(type(v)) for v in values]


def vertex_tangents(scene, ctx, v, nxt, facts, live, led_here, t_ray, t_w):
    """The terms of a vertex, detached, and their tangents in the order of ``values``.

    Everything attached dies on return: a variable that outlived this call would leave an edge of Dr.Jit's graph behind,
    which the next traversal would run into.
    """
    with dr.resume_grad():
        ray, _, _, w = attach_ray(v, facts, t_ray, t_w)
        x = vertex_terms(scene, ctx, v, ray, w, nxt, facts, live, led_here)
        values = [x.Le, x.f, x.W]
        if facts.geometry:
            values += [x.seg, x.length_em * x.index_em, x.seg_out, x.out, x.step]
            if facts.delta:
                values += [x.p_out, x.d_out]
            if x.delay is not None:
                values += [x.delay]
            if facts.emitter_shape_moves:
                values += [x.E, x.length_E]
        points = moving_points(x, facts)
        t = tangents(values + points)
        x.t_points = t[len(values) :]
        t = t[: len(values)]
        x.inside = None
    for name, value in vars(x).items():
        if value is not None and name != "t_points":
            setattr(x, name, dr.detach(value))
    return x, t


def settle_tangents(scene, facts):
    """Bring the tangents of the scene's parameters to where the loop meets them, outside of its isolated scope."""
    attached = [value for _, value in mi.traverse(scene) if dr.grad_enabled(value)]
    if facts.refracts and dr.grad_enabled(facts.refraction.table):
        attached.append(facts.refraction.table)
    if facts.delays is not None:
        attached += facts.delays.attached()
    if not attached:
        return
    dr.forward_to(*attached, flags=dr.ADFlag.ClearEdges)
    # On to what plugins derive from them, such as the vertices of a rectangle; a caller may have done so already.
    for value in attached:
        dr.enqueue(dr.ADMode.Forward, value)
    dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges)


@dr.syntax
def push(integrator, scene, count, store, lane, facts, ray0, t_o, t_d, d_first, t_turn=None):
    """Write the derivative of the transient to ``lane`` and return that of the steady radiance.

    ``t_o, t_d, d_first, t_turn`` are the tangents of the primary ray, of the length before it, and of twice the angle
    of its Stokes frame.
    """
    ctx = mi.BSDFContext()
    delay_index = 10 if facts.delta else 8
    k = mi.UInt32(0)
    live = k < count
    dL = light_type()(0)
    dβ = turning_throughput(t_turn)
    dτ = mi.Float(d_first)
    dη = mi.Float(0)
    t_o, t_d, t_w, t_x = mi.Vector3f(t_o), mi.Vector3f(t_d), mi.Vector3f(t_d), mi.Vector3f(t_o)
    events = lane.begin()
    while dr.hint(live, max_iterations=integrator.max_depth, label="transient_path forward mode"):
        v = read_vertex(store, k, live, ray0.time, ray0.wavelengths)
        follow = read_vertex(store, k + 1, v.goes_on, ray0.time, ray0.wavelengths)
        p_next, n_next, valid_next = vertex_after(follow, facts, v.goes_on)
        nxt = next_vertex(store, k, p_next, n_next, follow.ray.d, valid_next, v, facts, ray0)
        led_here = led_to(store, k, live, facts)
        x, t = vertex_tangents(scene, ctx, v, nxt, facts, live, led_here, (t_o, t_d), t_w)
        Le, f, W = x.Le, x.f, x.W
        legs = push_legs(scene, facts, v, x, nxt, x.t_points, t_x)
        dβ = after_leg(v, dβ, legs)
        dτ_v, dτ_em, length_em = mi.Float(dτ), mi.Float(0), x.length_em * x.index_em
        τ_em, d_delay = v.τ + mi.Float64(length_em * v.η), mi.Float(0)
        if dr.hint(x.delay is not None, mode="scalar"):
            τ_em += mi.Float64(x.delay)
            if dr.hint(facts.geometry, mode="scalar"):
                d_delay = mi.Float(t[delay_index])
        if dr.hint(facts.geometry, mode="scalar"):
            counted = mi.Float(1)
            if dr.hint(integrator.camera_unwarp, mode="scalar"):
                counted = dr.select(k == 0, 0, counted)
            dτ_v += counted * (v.η * t[3] + dη * x.seg)
            dτ_em = dτ_v + v.η * t[4] + dη * length_em + d_delay
        d_Le = column(dβ) * Le + column(v.β) * t[0]
        d_f = product(dβ, f) + product(v.β, t[1] + f * legs.connecting)
        dL += dr.select(live, d_Le + d_f, 0)
        lane.put_slope(events, v.τ, d_Le, column(v.β) * Le * dτ_v, x.hit)
        lane.put_slope(events, τ_em, d_f, product(v.β, f) * dτ_em, v.lit)
        if dr.hint(facts.emitter_shape_moves, mode="scalar"):
            E = x.E
            d_E = product(dβ, E) + product(v.β, t[-2] + E * legs.emitting)
            dL += dr.select(live, d_E, 0)
            dτ_E = dτ_v + d_delay + dη * x.step * x.length_E + follow.η * t[-1]
            lane.put_slope(events, follow.τ, d_E, product(v.β, E) * dτ_E, x.lit_ahead)

        # ------------------------------------------------------------------- to the next vertex
        dβ = product(dβ, W) + product(v.β, t[2])
        dτ = dτ_v + d_delay
        t_x = mi.Vector3f(legs.t_x)
        if dr.hint(facts.geometry, mode="scalar"):
            dτ += follow.η * t[5]
            dη = dη * x.step + v.η * t[7]
            t_o, t_d = mi.Vector3f(0), mi.Vector3f(0)
            t_w = dr.select(x.ahead, t[6], 0)
            if dr.hint(facts.delta, mode="scalar"):
                t_o = dr.select(x.mirrored, mi.Vector3f(t[8]), 0)
                t_d = dr.select(x.mirrored, mi.Vector3f(t[9]), 0)
                t_w = dr.select(x.mirrored, t_d, t_w)
        k += 1
        live = k < count
    lane.end(events)
    return dL
