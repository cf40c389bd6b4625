"""Reverse mode: walk the recorded path backwards and hand every vertex the light beyond it.

With the adjoint ``A(tau)`` of the film and its slope ``A'(tau)``, two suffixes are carried, per unit throughput at the vertex:

    S_i = sum of A f  over the events beyond vertex i,      D_i = sum of A' f over the same events,

so that ``dLoss = beta_i (A df + A' f dtau + dW S + W D dtau)`` at every vertex. Nothing is divided by a BSDF value: a zero albedo has its right
gradient. The sampled path is held fixed in this sense: a vertex slides along the ray that found it when its surface moves, and the
previous vertex moves against it as if it were nailed down, with the change of solid angle counted. Where a delta lobe determines the
next ray instead, the adjoint of that ray (origin, direction) is handed back to the vertex that sent it.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.integrators.path_record import read_vertex


def mis_weight(pdf_a, pdf_b):
    """Power heuristic, zero where both densities are."""
    a2 = dr.square(pdf_a)
    w = a2 / dr.fma(pdf_b, pdf_b, a2)
    return dr.select(dr.isfinite(w), w, 0)


def solid_angle_over_area(p, q, n, active):
    """``|cos| / distance^2``, the solid angle at ``p`` of an area at ``q`` with normal ``n``; 1 where inactive."""
    v = q - p
    d2 = dr.squared_norm(v)
    return dr.select(active, dr.abs_dot(n, v) * dr.rsqrt(d2) / d2, 1)


def slope_only(x):
    """Zero with the derivative of ``x``."""
    return dr.replace_grad(mi.Float(0), x)


def length_to(facts, p, q, valid, d):
    """Length from ``p`` to the point ``q``, or to the distant light in direction ``d`` where ``q`` is not valid."""
    # The inactive side must not see a zero vector: its derivative would be NaN and poison the sum.
    length = dr.norm(dr.select(valid, q - p, mi.Vector3f(1, 0, 0)))
    if facts.distant is None:
        return dr.select(valid, length, 0)
    return dr.select(valid, length, facts.distant.length(p, d))


def emitter_sample(scene, si, v, facts):
    """Repeat the recorded emitter sample at an attached vertex: (ds, point, direction, weight, is infinite)."""
    with dr.suspend_grad():
        ds, weight = scene.sample_emitter_direction(dr.detach(si), v.u_em, False, v.lit)
        weight = mi.unpolarized_spectrum(weight)
        flags = ds.emitter.flags()
        far = mi.has_flag(flags, mi.EmitterFlags.Infinite)
        surface = mi.has_flag(flags, mi.EmitterFlags.Surface)
        at_point = mi.has_flag(flags, mi.EmitterFlags.DeltaPosition)
        inv_pdf = dr.select(ds.pdf > 0, dr.rcp(ds.pdf), 0)
    p = mi.Point3f(ds.p)
    if facts.light_moves:
        moving, _ = scene.sample_emitter_direction(si, v.u_em, False, v.lit & at_point)
        p = dr.replace_grad(p, dr.select(v.lit & at_point, moving.p, dr.detach(moving.p)))
    diff = dr.copy(ds)
    d = mi.Vector3f(ds.d)
    if facts.geometry:
        near = v.lit & ~far
        to_light = dr.select(near, p - si.p, mi.Vector3f(1, 0, 0))
        d = dr.replace_grad(d, dr.select(near, dr.normalize(to_light), ds.d))
        diff.p, diff.d = p, d
        diff.dist = dr.replace_grad(ds.dist, dr.select(near, dr.norm(to_light), ds.dist))
    value = mi.unpolarized_spectrum(scene.eval_emitter_direction(si, diff, v.lit)) * inv_pdf
    if facts.geometry:
        value *= dr.relative_grad(solid_angle_over_area(si.p, p, ds.n, v.lit & surface & ~far))
    return ds, p, d, dr.replace_grad(weight, value), far


@dr.syntax
def sweep(integrator, scene, count, store, lane, facts, ray0):
    """Accumulate gradients of the recorded paths; returns the adjoint (origin, direction, first length) of the primary ray.

    ``count`` is the number of recorded vertices and ``store`` the record. Must run with gradients suspended.
    """
    ctx = mi.BSDFContext()
    i = mi.Int32(count) - 1
    live = i >= 0
    S, D = mi.UnpolarizedSpectrum(0), mi.UnpolarizedSpectrum(0)
    next_p, next_n, next_d = mi.Point3f(0), mi.Normal3f(0, 0, 1), mi.Vector3f(0, 0, 1)
    next_valid, next_η = mi.Bool(False), mi.Float(1)
    a_o, a_d, a_w = mi.Vector3f(0), mi.Vector3f(0), mi.Vector3f(0)     # Adjoint of the next ray and of its direction at its hit
    a_η = mi.Float(0)                                                  # Adjoint of the index along the next segment
    while dr.hint(live, max_iterations=integrator.max_depth, label="transient_path sweep"):
        k = mi.UInt32(i)
        v = read_vertex(store, k, live, ray0.time, ray0.wavelengths)
        onward = v.goes_on & ~v.is_delta
        with dr.resume_grad():
            o, d, w = mi.Point3f(v.ray.o), mi.Vector3f(v.ray.d), mi.Vector3f(v.ray.d)
            if dr.hint(facts.geometry, mode="scalar"):
                dr.enable_grad(w)
                if dr.hint(facts.ray_adjoint, mode="scalar"):
                    dr.enable_grad(o, d)
            ray = mi.Ray3f(v.ray)
            ray.o, ray.d = o, d
            si = v.pi.compute_surface_interaction(ray, mi.RayFlags.All, live)
            sid = dr.detach(si)
            valid = sid.is_valid()
            if dr.hint(facts.geometry, mode="scalar"):
                si.wi = dr.select(valid, si.to_local(-w), -w)
            bsdf = sid.bsdf(v.ray)

            # ------------------------------------------------- events: emission, next-event estimation
            hit = live & (v.mis > 0)
            Le = dr.select(hit, v.mis * mi.unpolarized_spectrum(sid.emitter(scene).eval(si, hit)), 0)
            A_e, A1_e = lane.read(v.τ, hit)
            ds, p_em, d_em, em_weight, far = emitter_sample(scene, si, v, facts)
            wo_em = si.to_local(d_em)
            val, pdf = bsdf.eval_pdf(ctx, si, wo_em, v.lit)
            mis_em = dr.select(ds.delta, 1, mis_weight(ds.pdf, dr.detach(pdf)))
            f = dr.select(v.lit, mi.unpolarized_spectrum(val) * em_weight * mis_em, 0)
            length_em = length_to(facts, si.p, p_em, v.lit & ~far, d_em)
            η_em = facts.index_towards(bsdf, si, wo_em, v.η)
            A_n, A1_n = lane.read(v.τ + mi.Float64(dr.detach(length_em) * dr.detach(η_em)), v.lit)

            # ------------------------------------------------------------ scattering towards the next vertex
            out = mi.Vector3f(next_d)
            J = mi.Float(1)
            if dr.hint(facts.geometry, mode="scalar"):
                to_next = dr.select(onward & next_valid, next_p - si.p, mi.Vector3f(1, 0, 0))
                out = dr.replace_grad(out, dr.select(onward & next_valid, dr.normalize(to_next), next_d))
                J = dr.relative_grad(solid_angle_over_area(si.p, next_p, next_n, onward & next_valid))
            wo = si.to_local(out)
            val, pdf = bsdf.eval_pdf(ctx, si, wo, onward)
            inv_pdf = dr.select(onward & (dr.detach(pdf) > 0), v.rr / dr.detach(pdf), 0)
            W = dr.select(onward, mi.unpolarized_spectrum(val) * (inv_pdf * J), 0)
            if dr.hint(facts.delta, mode="scalar"):
                mirrored = v.goes_on & v.is_delta
                bs, weight = bsdf.sample(ctx, si, v.u_lobe, v.u_dir, mirrored)
                weight = mi.unpolarized_spectrum(weight) * (dr.relative_grad(bs.pdf) * v.rr)
                W = dr.select(mirrored, weight, W)

            # ------------------------------------------------------------------------------- objective
            f0, Le0, W0 = dr.detach(f), dr.detach(Le), dr.detach(W)
            objective = dr.sum(v.β * (A_e * Le + A_n * f + W * S))
            S_new = A_e * Le0 + A_n * f0 + W0 * S
            D_new = D
            a_η_new = mi.Float(0)
            if dr.hint(facts.geometry, mode="scalar"):
                D_em, D_out = A1_n * f0, W0 * D
                D_new = A1_e * Le0 + D_em + D_out
                beyond = dr.sum(v.β * D_new)
                counted = mi.Float(1)
                if dr.hint(integrator.camera_unwarp, mode="scalar"):
                    counted = dr.select(k == 0, 0, counted)
                seg = length_to(facts, o, si.p, valid, d) * counted
                objective += beyond * v.η * slope_only(seg)
                objective += dr.sum(v.β * D_em) * slope_only(length_em * η_em)
                seg_out = length_to(facts, si.p, next_p, next_valid, next_d)
                objective += dr.select(onward, dr.sum(v.β * D_out) * next_η * slope_only(seg_out), 0)
                objective += dr.select(onward & next_valid, dr.dot(a_w, out), 0)
                step = dr.select(onward, facts.index_towards(bsdf, si, wo, mi.Float(1)), 1)
                if dr.hint(facts.delta, mode="scalar"):
                    handed = dr.dot(a_o, si.p) + dr.dot(a_d, si.to_world(bs.wo))
                    objective += dr.select(mirrored, handed, 0)
                    step = dr.select(mirrored, bs.eta, step)
                if dr.hint(facts.index_moves, mode="scalar"):
                    objective += dr.select(v.goes_on, a_η * v.η * slope_only(step), 0)
                    a_η_new = beyond * dr.detach(seg) + dr.select(v.goes_on, a_η * dr.detach(step), 0)
                    a_η_new += dr.sum(v.β * D_em) * dr.detach(length_em * η_em) / v.η
            dr.backward_from(dr.select(live, objective, 0))
            if dr.hint(facts.geometry, mode="scalar"):
                a_w = dr.select(live, dr.grad(w), a_w)
                if dr.hint(facts.ray_adjoint, mode="scalar"):
                    a_o = dr.select(live, mi.Vector3f(dr.grad(o)), a_o)
                    a_d = dr.select(live, dr.grad(d) + a_w, a_d)

        S = dr.select(live, S_new, S)
        D = dr.select(live, D_new, D)
        a_η = dr.select(live, a_η_new, a_η)
        next_p, next_n, next_d, next_valid = sid.p, sid.n, v.ray.d, valid
        next_η = v.η
        i -= 1
        live = i >= 0
    first = dr.sum(D)
    return a_o, a_d, first
