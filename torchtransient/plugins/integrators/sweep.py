"""Reverse mode: walk the recorded path backwards and hand every vertex the light beyond it.

With the adjoint ``A(tau)`` of the film and its slope ``A'(tau)``, two suffixes are carried, per unit throughput at the
vertex:

    S_i = sum of A f  over the events at and beyond vertex i,      D_i = sum of A' f over the same events,

so that ``dLoss = beta_i (A df + A' f dtau + dW S + W D dtau)`` at every vertex. In polarized variants the suffixes are
matrices ``f A^T`` and the loss is the trace of them behind the throughput, see :mod:`torchtransient.plugins.polarized`.
Nothing is divided by a BSDF value: a zero albedo has its right gradient. Where a delta lobe determines the next ray,
the adjoint of that ray (origin, direction) is handed back to the vertex that sent it.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.integrators.media.leg_sweep import before_leg, sweep_legs
from torchtransient.plugins.integrators.path_record import DELTA, read_vertex
from torchtransient.plugins.integrators.vertex import Terms, attach_ray, vertex_terms
from torchtransient.plugins.polarized import matched, product, traced, traced_attached, turning, whole


def slope_only(x):
    """Zero with the derivative of ``x``."""
    return dr.replace_grad(mi.Float(0), x)


def next_vertex(store, k, p, n, d, valid, v, facts, ray0):
    """What a vertex knows of the one after it."""
    nxt = Terms()
    nxt.p, nxt.n, nxt.d, nxt.valid, nxt.vertex = p, n, d, valid, None
    # Vertices in media have no normal.
    nxt.volume = None if facts.media is None else dr.all(n == 0)
    if facts.emitter_shape_moves:
        nxt.vertex = read_vertex(store, k + 1, v.goes_on, ray0.time, ray0.wavelengths)
    return nxt


def led_to(store, k, active, facts):
    """Whether the sensor or a delta lobe led to vertex ``k``; only looked up where it matters."""
    if not (facts.emitter_shape_moves or facts.sphere_lights):
        return mi.Bool(True)
    flags = store["flags"].read(dr.maximum(k, 1) - 1, active & (k > 0))
    return (k == 0) | ((flags & DELTA) != 0)


@dr.syntax
def sweep(integrator, scene, count, store, lane, facts, ray0):
    """Accumulate gradients of the recorded paths; returns the adjoint (origin, direction, first length, twice the angle
    of the Stokes frame) of the primary ray.

    ``count`` is the number of recorded vertices and ``store`` the record. Must run with gradients suspended.
    """
    ctx = mi.BSDFContext()
    i = mi.Int32(count) - 1                                            # Current vertex
    live = i >= 0
    S, D = mi.Spectrum(0), mi.Spectrum(0)                              # Suffixes beyond the current vertex
    next_p, next_n, next_d = mi.Point3f(0), mi.Normal3f(0, 0, 1), mi.Vector3f(0, 0, 1)
    next_valid, next_η = mi.Bool(False), mi.Float(1)
    a_o, a_d, a_w = mi.Vector3f(0), mi.Vector3f(0), mi.Vector3f(0)     # Adjoint of the next ray; of its end's wi
    a_η = mi.Float(0)                                                  # Adjoint of the index along the next segment
    a_x = mi.Vector3f(0)                                               # Adjoint of the start of the next leg in media
    while dr.hint(live, max_iterations=integrator.max_depth, label="transient_path reverse sweep"):
        k = mi.UInt32(i)
        v = read_vertex(store, k, live, ray0.time, ray0.wavelengths)
        nxt = next_vertex(store, k, next_p, next_n, next_d, next_valid, v, facts, ray0)
        with dr.resume_grad():
            ray, o, d, w = attach_ray(v, facts)
            x = vertex_terms(scene, ctx, v, ray, w, nxt, facts, live, led_to(store, k, live, facts))
            f, Le, W = dr.detach(x.f), dr.detach(x.Le), dr.detach(x.W)
            τ_em = mi.Float64(dr.detach(x.length_em) * dr.detach(x.index_em) * v.η)
            if dr.hint(x.delay is not None, mode="scalar"):
                τ_em += mi.Float64(dr.detach(x.delay))
            A_e, A1_e = lane.read(v.τ, x.hit)
            A_n, A1_n = lane.read(v.τ + τ_em, v.lit)
            objective = traced_attached(v.β, A_e, x.Le, A_n, x.f, x.W, S)
            S_new = matched(A_e, Le) + matched(A_n, f) + product(W, S)
            D_new = mi.Spectrum(D)
            a_η_new = mi.Float(0)
            if dr.hint(facts.geometry, mode="scalar"):
                D_em, D_out = matched(A1_n, f), product(W, D)
                D_new = matched(A1_e, Le) + D_em + D_out
                if dr.hint(facts.emitter_shape_moves, mode="scalar"):
                    A_E, A1_E = lane.read(nxt.vertex.τ, x.lit_ahead)
                    E = dr.detach(x.E)
                    objective += traced(v.β, matched(A_E, x.E))
                    objective += traced(v.β, matched(A1_E, E)) * next_η * slope_only(x.length_E)
                    S_new += matched(A_E, E)
                    D_new += matched(A1_E, E)
                beyond = traced(v.β, D_new)
                seg = x.seg
                if dr.hint(integrator.camera_unwarp, mode="scalar"):
                    seg = dr.select(k == 0, 0, seg)
                objective += beyond * v.η * slope_only(seg)
                objective += traced(v.β, D_em) * v.η * slope_only(x.length_em * x.index_em)
                objective += traced(v.β, D_out) * next_η * slope_only(x.seg_out)
                if dr.hint(x.delay is not None, mode="scalar"):
                    objective += (beyond - traced(v.β, matched(A1_e, Le))) * slope_only(x.delay)
                objective += dr.select(x.ahead, dr.dot(a_w, x.out), 0)
                if dr.hint(facts.delta, mode="scalar"):
                    objective += dr.select(x.mirrored, dr.dot(a_o, x.p_out) + dr.dot(a_d, x.d_out), 0)
                if dr.hint(facts.index_moves, mode="scalar"):
                    objective += dr.select(v.goes_on, a_η * v.η * slope_only(x.step), 0)
                    a_η_new = beyond * dr.detach(seg) + dr.select(v.goes_on, a_η * dr.detach(x.step), 0)
                    a_η_new += traced(v.β, D_em) * dr.detach(x.length_em * x.index_em)
            if dr.hint(facts.media is not None, mode="scalar"):
                legs, a_x = sweep_legs(scene, facts, v, x, nxt, lane, matched(A_n, f), S_new, a_x)
                objective += legs
            if dr.hint(dr.grad_enabled(objective), mode="scalar"):
                dr.backward_from(dr.select(live, objective, 0))
            if dr.hint(facts.geometry, mode="scalar"):
                a_w = dr.select(live, dr.grad(w), a_w)
                if dr.hint(facts.ray_adjoint, mode="scalar"):
                    a_o = dr.select(live, mi.Vector3f(dr.grad(o)), a_o)
                    a_d = dr.select(live, dr.grad(d) + a_w, a_d)

        S = dr.select(live, before_leg(v, S_new), S)
        D = dr.select(live, before_leg(v, D_new), D)
        a_η = dr.select(live, a_η_new, a_η)
        next_p, next_n, next_d, next_valid = x.sid.p, x.sid.n, v.ray.d, x.valid
        next_η = v.η
        i -= 1
        live = i >= 0
    a_o += a_x
    return a_o, a_d, whole(D), turning(S) if mi.is_polarized else None
