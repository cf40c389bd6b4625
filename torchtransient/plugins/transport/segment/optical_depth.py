"""Derivatives of the transmittance along the straight legs of a path.

A leg was weighed by some unbiased estimate of its transmittance ``T``. Since ``dT = -T dτ`` with the optical depth
``τ``, that weight times an independent estimate of ``-dτ`` is an unbiased derivative, and nothing has to be divided by
a null probability that can be zero. Each stretch between two boundaries contributes the extinction at one random point
of it times its length, both attached: to the medium's parameters and, where path lengths change, to the ends of the leg
and to the shapes that bound the stretch.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.transport.instances import distance_to
from torchtransient.plugins.transport.segment.free_flight import (
    cross_boundary,
    generator,
    medium_interaction,
    surface_beyond,
)

# Streams of random numbers, one for each kind of leg.
ARRIVING, CONNECTING, EMITTING = 0xC2B2AE35, 0x27D4EB2F, 0x165667B1


class Leg:
    """A straight leg from ``x0`` to ``x1``, or without end in direction ``d`` where ``far``, starting in ``medium``.
    Surfaces nearer to ``x0`` than ``clip`` are not there (None: all are).

    A plain object that only lives within one iteration.
    """

    def __init__(self, v, x0, x1, d, far, medium, stream, clip=None):
        self.x0, self.x1, self.far, self.medium = mi.Point3f(x0), mi.Point3f(x1), far, medium
        self.length = dr.select(far, dr.inf, dr.norm(self.x1 - self.x0))
        self.d = dr.select(far, d, dr.normalize(self.x1 - self.x0))
        self.ray = mi.Ray3f(v.ray)
        self.ray.o, self.ray.d = self.x0, self.d
        self.ray.maxt = self.length * (1 - mi.math.ShadowEpsilon)
        self.clip, self.numbers = clip, v.numbers()
        self.lanes, self.stream = dr.arange(mi.UInt32, dr.width(v.ray.d)), stream


class Stretch:
    """Part of a leg between two boundaries: behind ``entry`` (at ``t``) up to ``pi``, in ``medium``. Plain."""

    def __init__(self, entry, t, pi, medium, u):
        self.entry, self.t, self.pi, self.medium, self.u = entry, t, pi, medium, u


def optical_depth(media, leg, part, x0, x1, active):
    """Attached estimate of the optical depth of one stretch of a leg whose ends are ``x0, x1``."""
    inside = active & (part.medium != None)  # noqa: E711 (a Dr.Jit comparison)
    ray, ends = mi.Ray3f(leg.ray), part.pi.is_valid()
    begin, end = part.t, dr.select(ends, part.pi.t, leg.length)
    if media.geometry:
        span = dr.select(leg.far, leg.d, x1 - x0)
        ray.o, ray.d = x0, dr.normalize(span)
        end = dr.select(leg.far, end, dr.norm(span))
        if media.open_boundaries:
            passed = inside & part.entry.is_valid()
            begin = dr.select(passed, distance_to(media.surfaces, part.entry, ray, passed), 0)
            ends &= inside
            end = dr.select(ends, distance_to(media.surfaces, part.pi, ray, ends), end)
    if media.heterogeneous:
        hits, near, far = part.medium.intersect_aabb(ray)
        begin = dr.select(hits, dr.maximum(begin, near), begin)
        end = dr.select(hits, dr.minimum(end, far), begin)
    bounded = inside & (end > begin) & dr.isfinite(end)
    length = dr.select(bounded, end - begin, 0)
    mei = medium_interaction(ray, part.medium, dr.fma(part.u, length, dr.select(bounded, begin, 0)))
    return part.medium.get_scattering_coefficients(mei, bounded)[2] * length


def first_stretch(scene, media, leg, active):
    """(random numbers, next surface, its predecessor) at the start of a leg."""
    rng = generator(leg.numbers, leg.lanes, leg.stream)
    nothing = dr.zeros(mi.PreliminaryIntersection3f, dr.width(leg.lanes))
    nothing.t = dr.full(mi.Float, dr.inf, dr.width(leg.lanes))
    if not media.open_boundaries:
        return rng, nothing, nothing
    return rng, surface_beyond(scene, leg.ray, leg.clip, active), nothing


@dr.syntax
def leg_backward(scene, media, leg, g, active):
    """Reverse mode: propagate ``sum(g dlog T)`` to the medium's parameters and shapes; returns the adjoints of the
    leg's ends. ``g``: adjoint of the logarithm of the transmittance, per channel.
    """
    a0, a1 = mi.Vector3f(0), mi.Vector3f(0)
    if dr.hint(not media.extinction_changes, mode="scalar"):
        return a0, a1
    rng, pi, entry = first_stretch(scene, media, leg, active)
    if dr.hint(not media.open_boundaries, mode="scalar"):
        part = Stretch(entry, mi.Float(0), pi, leg.medium, rng.next_float32())
        a0, a1 = stretch_backward(media, leg, part, g, active)
    else:
        t = mi.Float(0)
        medium = mi.MediumPtr(leg.medium)
        going = mi.Bool(active)
        while dr.hint(going, label="derivative of a leg"):
            d0, d1 = stretch_backward(media, leg, Stretch(entry, t, pi, medium, rng.next_float32()), g, going)
            a0 += d0
            a1 += d1
            going &= pi.is_valid()
            t = dr.select(going, pi.t, t)
            entry = dr.select(going, pi, entry)
            pi, medium = cross_boundary(scene, leg.ray, pi, medium, going)
    return a0, a1


def stretch_backward(media, leg, part, g, active):
    """One step of :func:`leg_backward`."""
    with dr.resume_grad():
        x0, x1 = mi.Point3f(leg.x0), mi.Point3f(leg.x1)
        if media.geometry:
            dr.enable_grad(x0, x1)
        depth = optical_depth(media, leg, part, x0, x1, active)
        if dr.grad_enabled(depth):
            dr.backward_from(dr.select(active, -dr.dot(g, depth), 0))
        if not media.geometry:
            return mi.Vector3f(0), mi.Vector3f(0)
        return mi.Vector3f(dr.grad(x0)), mi.Vector3f(dr.grad(x1))


@dr.syntax
def leg_forward(scene, media, leg, t0, t1, active):
    """Forward mode: the derivative of the logarithm of the transmittance, where the leg's ends move by ``t0, t1``."""
    d_log = mi.UnpolarizedSpectrum(0)
    if dr.hint(not media.extinction_changes, mode="scalar"):
        return d_log
    rng, pi, entry = first_stretch(scene, media, leg, active)
    if dr.hint(not media.open_boundaries, mode="scalar"):
        part = Stretch(entry, mi.Float(0), pi, leg.medium, rng.next_float32())
        d_log = stretch_forward(media, leg, part, t0, t1, active)
    else:
        t = mi.Float(0)
        medium = mi.MediumPtr(leg.medium)
        going = mi.Bool(active)
        while dr.hint(going, label="derivative of a leg"):
            part = Stretch(entry, t, pi, medium, rng.next_float32())
            d_log += stretch_forward(media, leg, part, t0, t1, going)
            going &= pi.is_valid()
            t = dr.select(going, pi.t, t)
            entry = dr.select(going, pi, entry)
            pi, medium = cross_boundary(scene, leg.ray, pi, medium, going)
    return d_log


def stretch_forward(media, leg, part, t0, t1, active):
    """One step of :func:`leg_forward`. Attached values die on return."""
    with dr.resume_grad():
        x0, x1 = mi.Point3f(leg.x0), mi.Point3f(leg.x1)
        if media.geometry:
            dr.enable_grad(x0, x1)
            dr.set_grad(x0, t0)
            dr.set_grad(x1, t1)
        depth = optical_depth(media, leg, part, x0, x1, active)
        if not dr.grad_enabled(depth):
            return mi.UnpolarizedSpectrum(0)
        slope = dr.forward_to(depth, flags=dr.ADFlag.ClearEdges)
        return mi.UnpolarizedSpectrum(dr.select(active, -slope, 0))


class LogTransmittance(dr.CustomOp):
    """Zero with the derivative of the logarithm of a leg's transmittance, per channel.

    Its derivatives are loops of their own along the leg, which reach the medium's parameters by themselves. ``hook`` is
    anything attached: without an attached input Dr.Jit would leave the operation out.
    """

    def eval(self, x0, x1, hook, scene, media, leg, active):
        self.scene, self.media, self.leg, self.active = scene, media, leg, active
        return mi.UnpolarizedSpectrum(dr.zeros(mi.Float, dr.width(leg.lanes)))

    def backward(self):
        g = self.grad_out()
        with dr.suspend_grad():  # the loops attach what they need by themselves
            a0, a1 = leg_backward(self.scene, self.media, self.leg, g, mi.Bool(self.active))
        self.set_grad_in("x0", mi.Point3f(a0))
        self.set_grad_in("x1", mi.Point3f(a1))

    def forward(self):
        t0, t1 = mi.Vector3f(self.grad_in("x0")), mi.Vector3f(self.grad_in("x1"))
        with dr.suspend_grad():
            t = leg_forward(self.scene, self.media, self.leg, t0, t1, mi.Bool(self.active))
        self.set_grad_out(mi.UnpolarizedSpectrum(t))

    def name(self):
        return "log transmittance"


def with_log_slope(scene, media, leg, x0, x1, hook, active):
    """One with the derivative of the logarithm of the transmittance of ``leg``, whose attached ends are ``x0, x1``."""
    if not media.extinction_changes:
        return 1
    return 1 + dr.custom(LogTransmittance, mi.Point3f(x0), mi.Point3f(x1), hook, scene, media, leg, mi.Bool(active))
