"""The legs through media that meet at a vertex, as the reverse sweep and the forward push see them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.integrators.media.leg_gradient import (
    ARRIVING,
    CONNECTING,
    EMITTING,
    Leg,
    leg_backward,
    leg_forward,
)
from torchtransient.plugins.integrators.media.medium_vertex import medium_behind
from torchtransient.plugins.polarized import faded, matched, traced, traced_colours


def before_leg(v, suffix):
    """A suffix per unit throughput at the start of the leg that led to the vertex."""
    return suffix if v.medium is None else faded(suffix, v.medium.walk)


def legs_at(v, x, facts):
    """The leg that led to the vertex, and the one to its emitter sample."""
    lanes = dr.arange(mi.UInt32, dr.width(v.ray.d))
    end = dr.detach(x.si.p)
    arriving = Leg(v, v.ray.o, end, v.ray.d, ~x.valid, v.medium.begin, lanes, ARRIVING)
    medium = medium_behind(x.sid, x.d_em, v.medium.end, ~v.scatter)
    connecting = Leg(v, end, dr.detach(x.p_em), x.d_em, x.far_em, medium, lanes, CONNECTING)
    return arriving, connecting


def emitting_leg(v, x, nxt):
    """The leg to a light that moves and was found by the next vertex."""
    lanes = dr.arange(mi.UInt32, dr.width(v.ray.d))
    x0, x1 = dr.detach(x.si.p), dr.detach(x.p_E)
    return Leg(v, x0, x1, v.ray.d, mi.Bool(False), nxt.vertex.medium.begin, lanes, EMITTING)


def slope_along(a, p, active):
    """Objective with the derivative ``a`` with respect to the attached point ``p``."""
    return dr.select(active, dr.dot(a, p), 0)


def sweep_legs(scene, facts, v, x, nxt, lane, f_em, S, a_x):
    """Reverse mode at a vertex: (objective to be propagated, adjoint of the start of the arriving leg).

    ``f_em``: the emitter sample matched with its adjoint, ``S``: the suffix, both per unit throughput at the vertex.
    ``a_x``: adjoint of the start of the next leg.
    """
    arriving, connecting = legs_at(v, x, facts)
    objective = mi.Float(0)
    with dr.suspend_grad():  # the loops along the legs attach what they need by themselves
        before, here = leg_backward(scene, facts, arriving, traced_colours(v.β, S), mi.Bool(x.live))
        em_here, em_there = leg_backward(scene, facts, connecting, traced_colours(v.β, f_em), v.lit)
    if not facts.geometry:
        return objective, a_x
    objective += slope_along(here, x.si.p, x.valid) + slope_along(em_here, x.si.p, v.lit)
    objective += slope_along(em_there, x.p_em, v.lit) + slope_along(a_x, x.si.p, v.goes_on)
    stretch = dr.replace_grad(mi.Float(0), dr.log(dr.select(v.scatter, x.inside.stretch, 1)))
    objective += dr.select(v.scatter, traced(v.β, S) * stretch, 0)
    if facts.emitter_shape_moves:
        leg, (A_E, _) = emitting_leg(v, x, nxt), lane.read(nxt.vertex.τ, x.lit_ahead)
        g_E = traced_colours(v.β, matched(A_E, dr.detach(x.E)))
        with dr.suspend_grad():
            e_here, e_there = leg_backward(scene, facts, leg, g_E, x.lit_ahead)
        objective += slope_along(e_here, x.si.p, x.lit_ahead) + slope_along(e_there, x.p_E, x.lit_ahead)
    return objective, dr.select(x.live, before, a_x)


def vertex_after(follow, facts, active):
    """Point, normal and validity of the vertex after the current one, without derivatives."""
    surface = active & ~follow.scatter
    si = follow.pi.compute_surface_interaction(follow.ray, mi.RayFlags.Minimal, surface)
    if facts.media is None:
        return si.p, si.n, si.is_valid() & active
    p = dr.select(follow.scatter, follow.ray(follow.medium.t), si.p)
    n = dr.select(follow.scatter, mi.Normal3f(0), si.n)
    return p, n, active & (si.is_valid() | follow.scatter)


def moving_points(x, facts):
    """The attached values of a vertex that its legs depend on; none where they do not move."""
    if facts.media is None or not facts.geometry:
        return []
    points = [x.si.p, x.p_em, dr.log(dr.select(x.inside.scatter, x.inside.stretch, 1))]
    return points + ([x.p_E] if facts.emitter_shape_moves else [])


class LegTangents:
    """Forward mode at a vertex: derivatives of the logarithms of the weights of its legs, and the tangent of the
    vertex's position. A plain object that only lives within one iteration.
    """

    def __init__(self, arriving, connecting, emitting, t_x):
        self.arriving, self.connecting, self.emitting, self.t_x = arriving, connecting, emitting, t_x


def push_legs(scene, facts, v, x, nxt, t_points, t_x):
    """The :class:`LegTangents` of a vertex. ``t_points``: tangents of :func:`moving_points`, ``t_x``: tangent of the
    start of the arriving leg.
    """
    zero = mi.UnpolarizedSpectrum(0)
    if facts.media is None:
        return LegTangents(zero, zero, zero, t_x)
    none = mi.Vector3f(0)
    t_p, t_em, t_stretch, *t_E = t_points or (none, none, mi.Float(0))
    arriving, connecting = legs_at(v, x, facts)
    t_p, t_em = mi.Vector3f(t_p), mi.Vector3f(t_em)
    d_in = leg_forward(scene, facts, arriving, t_x, dr.select(x.valid, t_p, 0), mi.Bool(x.live))
    d_in += dr.select(v.scatter, t_stretch, 0)
    d_em = leg_forward(scene, facts, connecting, t_p, t_em, v.lit)
    d_E = zero
    if t_E:
        leg = emitting_leg(v, x, nxt)
        d_E = leg_forward(scene, facts, leg, t_p, mi.Vector3f(t_E[0]), x.lit_ahead)
    return LegTangents(d_in, d_em, d_E, dr.select(v.goes_on, t_p, 0))


def after_leg(v, dβ, legs):
    """The tangent of the throughput behind the leg that led to the vertex."""
    if v.medium is None:
        return dβ
    return faded(dβ, v.medium.walk) + faded(v.β, legs.arriving)
