"""Strategies that the library does not have, written as an author of a new one would: one class each.

Integrators with them are registered by :mod:`.toy_integrators`.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.polarized import product, scatter_unpolarized
from torchtransient.plugins.transport.carry import slope_only
from torchtransient.plugins.transport.emitter_connections import EmitterSampled
from torchtransient.plugins.transport.geometry_terms import distance
from torchtransient.plugins.transport.strategy import Connection, Event, EventTerm, Guide, GuidedPoint, Local, Proposal


def direction_to(p, q, active, otherwise):
    """Value of ``otherwise`` with the derivative of the direction from ``p`` to ``q`` where active. Of a point light:
    points on surfaces that are near move by ``damped_motion``, and a strategy that shares their light has to follow.
    """
    v = dr.select(active, q - p, mi.Vector3f(0, 0, 1))
    return dr.replace_grad(otherwise, dr.select(active, dr.normalize(v), otherwise))


def solid_angle_over_area(p, q, n, active):
    """``|cos| / distance^2``, the solid angle at ``p`` of an area at ``q`` with normal ``n``; 1 where inactive."""
    v = dr.select(active, q - p, mi.Vector3f(0, 0, 1))
    d2 = dr.squared_norm(v)
    return dr.select(active, dr.abs_dot(n, v) * dr.rsqrt(d2) / d2, 1)


class SecondEmitterSample(EmitterSampled):
    """A second point on a light, with random numbers of its own."""

    name = "second_emitter_sample"


class ThirdEmitterSample(EmitterSampled):
    """A third one."""

    name = "third_emitter_sample"


class OwnPointLight(Connection):
    """An isotropic point light that is no part of the scene: nothing else can find it, so it needs no weights."""

    name = "own_point_light"

    def __init__(self, position, intensity):
        self.position, self.intensity = position, intensity

    def propose(self, context, path, vertex, sampler):
        p = mi.Point3f(self.position)
        to = p - vertex.at.p
        ds = Local(p=p, n=mi.Normal3f(0), d=dr.normalize(to), dist=dr.norm(to), delta=mi.Bool(True), emitter=None)
        active, u = vertex.goes_on & vertex.connectable, sampler.next_2d()
        return Proposal(d=ds.d, active=active, ds=ds, u=u, sampler=sampler)

    def connect(self, context, path, vertex, proposal, answer, zeros):
        ds = proposal.ds
        value = product(vertex.β, answer.value) * (self.intensity / dr.square(ds.dist))
        opl = vertex.scattered_τ + mi.Float64(ds.dist * vertex.η * answer.eta)
        active = context.counted(proposal.active, opl)
        active, T = context.segment.transmittance(context, vertex, ds, proposal.u, proposal.sampler, active)
        return Event(value=value * T, opl=opl, active=active, depth=path.depth + 2, T=T)

    def fields(self, context):
        return {"lit": mi.Bool} | ({"T": mi.UnpolarizedSpectrum} if context.contents.media is not None else {})

    def record(self, sample):
        return {"lit": sample.event.active, "T": sample.event.T}

    def attached(self, context, vertex, step, wanted):
        r, si, p = vertex.v.record_of(self.name), vertex.scattered_si, mi.Point3f(self.position)
        lit = r["lit"]
        fixed = dr.normalize(dr.detach(p - si.p))
        out = direction_to(si.p, p, lit, fixed)
        towards = context.scattering.evaluate(context, vertex, out, lit)
        length = distance(si.p, p, lit)
        value = scatter_unpolarized(towards.value, vertex.rotation) * r.get("T", 1)
        value *= self.intensity / dr.square(length)
        end = Local(p=p, d=fixed, far=mi.Bool(False), ahead=False)
        value *= context.segment.attached_transmittance(context, vertex, end, lit)
        slope = vertex.scattered_slope
        if wanted.geometry:
            slope = slope + slope_only(vertex.carry.η * towards.eta * length)
        opl = vertex.scattered_opl + mi.Float64(dr.detach(length * towards.eta) * vertex.v.η)
        return [EventTerm(value=product(vertex.carry.β, dr.select(lit, value, 0)), slope=slope, opl=opl, active=lit)]


class AreaOfShape(Guide):
    """Some of the next vertices are drawn uniformly over the area of the shape called ``shape_id``."""

    def __init__(self, shape_id, share, name="area_of_shape"):
        self.shape_id, self.share, self.name = shape_id, share, name

    def prepare(self, context):
        self.shape = next(shape for shape in context.scene.shapes() if shape.id() == self.shape_id)
        self.per_area = 1 / self.shape.surface_area()
        dr.eval(self.per_area)

    def draw(self, context, vertex, x, y):
        point = self.shape.sample_position(0.0, mi.Point2f(mi.Float(x), y)).p
        return GuidedPoint(point, mi.ShapePtr(self.shape))

    def density(self, context, p, q, n, shape, active, primitive=None):
        on_it = active & (shape == mi.ShapePtr(self.shape))
        per_area = solid_angle_over_area(p, q, n, on_it)
        return dr.select(on_it & (per_area > 0), self.per_area / per_area, 0)
