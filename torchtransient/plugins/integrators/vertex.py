"""The attached physics of one vertex, shared by reverse and forward mode.

:func:`vertex_terms` re-evaluates what happens at a recorded vertex with derivatives: emission, next-event estimation,
scattering and the lengths of the segments around it. The sampled path is held fixed in this sense: a vertex slides
along the ray that found it when its surface moves, and against the next vertex it moves as if that one were nailed
down, with the change of solid angle counted. Points on light sources whose shape moves are material points: they follow
the shape. Where a delta lobe determines the next ray, that ray itself is attached.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.integrators.media.attached import evaluate, surface_or_medium
from torchtransient.plugins.integrators.media.free_flight import closed_surface
from torchtransient.plugins.polarized import scattered, scattering, turn_in, turn_out


class Terms:
    """Attached values at one vertex; a plain object that only lives within one iteration."""


def mis_weight(pdf_a, pdf_b):
    """Power heuristic, zero where both densities are."""
    a2 = dr.square(pdf_a)
    w = a2 / dr.fma(pdf_b, pdf_b, a2)
    return dr.select(dr.isfinite(w), w, 0)


def solid_angle_over_area(p, q, n, active, volume=None):
    """``|cos| / distance^2``, the solid angle at ``p`` of an area at ``q`` with normal ``n``; 1 where inactive. Where
    ``volume``, that of an area across the direction.
    """
    # The inactive side must not see a zero vector: its derivative would be NaN and poison the sum.
    v = dr.select(active, q - p, mi.Vector3f(0, 0, 1))
    d2 = dr.squared_norm(v)
    if volume is not None:
        n = dr.select(volume, dr.normalize(v), n)
    return dr.select(active, dr.abs_dot(n, v) * dr.rsqrt(d2) / d2, 1)


def direction_to(p, q, active, otherwise):
    """Value of ``otherwise`` with the derivative of the direction from ``p`` to ``q`` where active."""
    v = dr.select(active, q - p, mi.Vector3f(0, 0, 1))
    return dr.replace_grad(otherwise, dr.select(active, dr.normalize(v), otherwise))


def length_to(facts, p, q, valid, d):
    """Length from ``p`` to the point ``q``, or to the distant light in direction ``d`` where ``q`` is not valid."""
    length = dr.norm(dr.select(valid, q - p, mi.Vector3f(0, 0, 1)))
    if facts.distant is None:
        return dr.select(valid, length, 0)
    return dr.select(valid, length, facts.distant.length(p, d))


def material_point(pi, ray, active):
    """Interaction that follows its shape, and the area element there (up to a constant)."""
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All | mi.RayFlags.FollowShape, active)
    return si, dr.norm(dr.cross(si.dp_du, si.dp_dv))


def is_sphere(emitter):
    """Whether the shape of an area emitter is a sphere."""
    return emitter.get_shape().shape_type() == int(mi.ShapeType.Sphere)


def attach_ray(v, facts, t_ray=None, t_w=None):
    """The ray that found a vertex, with the attachments that the facts call for: (ray, o, d, direction for wi)."""
    o, d, w = mi.Point3f(v.ray.o), mi.Vector3f(v.ray.d), mi.Vector3f(v.ray.d)
    if facts.geometry:
        dr.enable_grad(w)
        if t_w is not None:
            dr.set_grad(w, t_w)
        if facts.ray_adjoint:
            dr.enable_grad(o, d)
            if t_ray is not None:
                dr.set_grad(o, t_ray[0])
                dr.set_grad(d, t_ray[1])
    ray = mi.Ray3f(v.ray)
    ray.o, ray.d = o, d
    return ray, o, d, w


def emitter_terms(terms, scene, ctx, si, bsdf, turn, v, facts):
    """Next-event estimation: ``terms.f`` (per unit throughput), ``terms.length_em`` and index along the shadow ray."""
    with dr.suspend_grad():
        ds, weight = scene.sample_emitter_direction(dr.detach(si), v.u_em, False, v.lit)
        weight = mi.unpolarized_spectrum(weight)
        flags = ds.emitter.flags()
        far = v.lit & mi.has_flag(flags, mi.EmitterFlags.Infinite)
        surface = v.lit & mi.has_flag(flags, mi.EmitterFlags.Surface) & ~far
        inv_pdf = dr.select(ds.pdf > 0, dr.rcp(ds.pdf), 0)
    p, n = mi.Point3f(ds.p), mi.Normal3f(ds.n)
    area = mi.Float(1)
    if facts.light_moves:
        at_point = v.lit & mi.has_flag(flags, mi.EmitterFlags.DeltaPosition)
        moving, _ = scene.sample_emitter_direction(si, v.u_em, False, at_point)
        p = dr.replace_grad(p, dr.select(at_point, moving.p, dr.detach(moving.p)))
    cone = mi.Bool(False)
    if facts.sphere_lights:
        # The limb of a sphere turns away from the vertex: in area measure its derivative has infinite variance. A
        # sphere is sampled over the cone that it fills, which moves with it, and by this strategy alone.
        cone = surface & is_sphere(ds.emitter)
        surface &= ~cone
        ds_cone, weight_cone = scene.sample_emitter_direction(si, v.u_em, False, cone)
        p = dr.replace_grad(p, dr.select(cone, ds_cone.p, dr.detach(ds_cone.p)))
    if facts.emitter_shape_moves:
        ray_em = dr.detach(si).spawn_ray(ds.d)
        with dr.suspend_grad():
            pi_em = closed_surface(scene, facts.media, ray_em, surface)
        si_em, area = material_point(pi_em, ray_em, surface & pi_em.is_valid())
        on_light = surface & pi_em.is_valid() & (dr.detach(si_em).emitter(scene) == ds.emitter)
        p = dr.select(on_light, dr.replace_grad(p, si_em.p), p)
        n = dr.select(on_light, dr.replace_grad(n, si_em.n), n)
        area = dr.relative_grad(dr.select(on_light, area, 1))
    diff = dr.copy(ds)
    d = mi.Vector3f(ds.d)
    if facts.geometry:
        near = v.lit & ~far
        d = direction_to(si.p, p, near, d)
        diff.p, diff.n, diff.d = p, n, d
        diff.dist = dr.replace_grad(ds.dist, dr.norm(dr.select(near, p - si.p, mi.Vector3f(0, 0, 1))))
    value = mi.unpolarized_spectrum(scene.eval_emitter_direction(si, diff, v.lit)) * inv_pdf
    if facts.geometry:
        value *= dr.relative_grad(solid_angle_over_area(si.p, p, n, surface)) * area
    if facts.sphere_lights:
        value = dr.select(cone, mi.unpolarized_spectrum(weight_cone), value)
    em_weight = dr.replace_grad(weight, value)

    wo = si.to_local(d)
    val, pdf = evaluate(terms.inside, ctx, bsdf, si, wo, d, v.lit)
    val = facts.upright(bsdf, si, wo, val)
    mis = dr.select(ds.delta | cone, 1, mis_weight(ds.pdf, dr.detach(pdf)))
    terms.f = dr.select(v.lit, scattered(val, turn) * em_weight * mis, 0)
    if facts.media is not None:
        terms.f *= v.medium.T_em
        terms.p_em, terms.d_em, terms.far_em = p, mi.Vector3f(ds.d), far
    terms.length_em = length_to(facts, si.p, p, v.lit & ~far, d)
    terms.index_em = facts.index_towards(bsdf, si, wo, mi.Float(1))


def vertex_terms(scene, ctx, v, ray, w, nxt, facts, live, led_here):
    """Evaluate vertex ``v`` (see :class:`~.path_record.Vertex`) with derivatives.

    ``led_here``: the vertex was found by the sensor or by a delta lobe, so that emission there has no other strategy.

    ``nxt`` is the next vertex: ``p, n, d, valid`` detached and, where emitter shapes move, its ``vertex``. Returns
    :class:`Terms` with ``si, Le, f, length_em, index_em, W, seg, seg_out, out, step, onward, mirrored`` and, for delta
    lobes, ``p_out, d_out``.
    """
    terms = Terms()
    terms.onward = onward = v.goes_on & ~v.is_delta
    terms.mirrored = v.goes_on & v.is_delta
    si, terms.inside = surface_or_medium(v, ray, w, facts, live)
    sid = dr.detach(si)
    terms.si, terms.sid, terms.valid, terms.live = si, sid, sid.is_valid(), live
    if facts.geometry:
        si.wi = dr.select(terms.valid, si.to_local(-w), -w)
    bsdf = sid.bsdf(v.ray)

    hit = live & (v.mis > 0)
    if facts.emitter_shape_moves:
        # Emission found after a smooth bounce belongs to the vertex before, see emission_ahead().
        hit &= led_here
    elif facts.sphere_lights:
        on_surface = mi.has_flag(sid.emitter(scene).flags(), mi.EmitterFlags.Surface)
        hit &= led_here | ~on_surface | ~is_sphere(sid.emitter(scene))
    terms.hit = hit
    terms.Le = dr.select(hit, v.mis * mi.unpolarized_spectrum(sid.emitter(scene).eval(si, hit)), 0)
    turn = turn_out(si, w)
    late = facts.answer(bsdf, v.u_late, v.ray.wavelengths)
    bsdf, terms.delay = late.bsdf, late.delay
    late.move(si)
    emitter_terms(terms, scene, ctx, si, bsdf, turn, v, facts)

    terms.f = late.scaled_light(terms.f)

    ahead = onward & nxt.valid
    out, J = mi.Vector3f(nxt.d), mi.Float(1)
    if facts.geometry:
        out = direction_to(si.p, nxt.p, ahead, out)
        J = dr.relative_grad(solid_angle_over_area(si.p, nxt.p, nxt.n, ahead, nxt.volume))
    wo = si.to_local(out)
    val, pdf = evaluate(terms.inside, ctx, bsdf, si, wo, out, onward, sampled=True)
    val = facts.upright(bsdf, si, wo, val)
    inv_pdf = dr.select(onward & (dr.detach(pdf) > 0), v.rr / dr.detach(pdf), 0)
    terms.W = dr.select(onward, scattering(val, turn, turn_in(si, wo, out, nxt.d)) * (inv_pdf * J), 0)
    terms.out, terms.ahead = out, ahead
    terms.step = dr.select(onward, facts.index_towards(bsdf, si, wo, mi.Float(1)), 1)
    if facts.delta:
        bs, weight = bsdf.sample(ctx, si, v.u_lobe, v.u_dir, terms.mirrored)
        weight = facts.upright(bsdf, si, bs.wo, weight)
        terms.p_out, terms.d_out = si.p, si.to_world(bs.wo)
        weight = scattering(weight, turn, turn_in(si, bs.wo, terms.d_out, nxt.d)) * (facts.unweighted(bsdf, bs) * v.rr)
        terms.W = dr.select(terms.mirrored, weight, terms.W)
        terms.step = dr.select(terms.mirrored, bs.eta, terms.step)
    if facts.geometry:
        terms.seg = length_to(facts, ray.o, si.p, terms.valid, ray.d)
        terms.seg_out = dr.select(onward, length_to(facts, si.p, nxt.p, nxt.valid, nxt.d), 0)
    terms.W = late.scaled(terms.W)
    terms.E = None
    if facts.emitter_shape_moves:
        emission_ahead(terms, scene, ctx, si, bsdf, turn, nxt, inv_pdf, facts)
        terms.E = late.scaled_light(terms.E)
    return terms


def emission_ahead(terms, scene, ctx, si, bsdf, turn, nxt, inv_pdf, facts):
    """Emission found by BSDF sampling on a shape that moves: ``terms.E`` (per unit throughput), ``terms.length_E``.

    The light's point is a material point here, as it is for next-event estimation: both strategies must move their
    samples alike, or the weights between them would no longer sum to one under the motion.
    """
    lit = terms.ahead & (nxt.vertex.mis > 0)
    if facts.sphere_lights:
        with dr.suspend_grad():
            hit = nxt.vertex.pi.compute_surface_interaction(nxt.vertex.ray, mi.RayFlags.Minimal, lit)
            lit &= ~is_sphere(hit.emitter(scene))
    si_e, area = material_point(nxt.vertex.pi, nxt.vertex.ray, lit)
    out = direction_to(si.p, si_e.p, lit, mi.Vector3f(nxt.d))
    si_e.wi = dr.select(lit, si_e.to_local(-out), dr.detach(si_e.wi))
    J = dr.relative_grad(solid_angle_over_area(si.p, si_e.p, si_e.n, lit)) * dr.relative_grad(dr.select(lit, area, 1))
    wo = si.to_local(out)
    val = facts.upright(bsdf, si, wo, evaluate(terms.inside, ctx, bsdf, si, wo, out, lit)[0])
    Le = mi.unpolarized_spectrum(dr.detach(si_e).emitter(scene).eval(si_e, lit))
    terms.E = dr.select(lit, scattered(val, turn) * (inv_pdf * J * nxt.vertex.mis) * Le, 0)
    terms.length_E = dr.norm(dr.select(lit, si_e.p - si.p, mi.Vector3f(0, 0, 1)))
    terms.lit_ahead = lit
    if facts.media is not None:
        terms.E *= nxt.vertex.medium.walk
        terms.p_E = si_e.p
