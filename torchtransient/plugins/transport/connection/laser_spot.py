"""The spot that a laser makes on what it meets first: at every vertex one connection to it.

Nothing else finds a point without area, so no weights are needed. In a confocal scan the first hidden vertex has seen
the spot already: the path came from there.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.polarized import (
    attenuated,
    first_column,
    intensity,
    product,
    rotate_mueller,
    rotate_stokes,
    rotation_from_light,
    rotation_to_sensor,
)
from torchtransient.plugins.transport.carry import slope_only
from torchtransient.plugins.transport.strategy import Connection, Event, EventTerm, Local, Proposal


class LaserSpot(Connection):
    """Light that was scattered once by a laser spot.

    ``table``: the :class:`~torchtransient.plugins.around_corner.scan_table.ScanTable` of the job, with its spots.
    ``confocal``: each path ends at the spot that it started from. ``legs``: the way from the laser to the spot counts.
    An event's depth is its number of bounces: the laser's own way is no segment of the path.
    """

    name = "laser_spot"
    finds_light = False

    def __init__(self, table, confocal, legs):
        self.table, self.spots, self.confocal, self.legs = table, table.spots, confocal, legs
        self.index = None

    def tables(self):
        return [array for array in self.spots.arrays() if dr.grad_enabled(array)]

    def start(self, world, rays):
        self.index = rays.spot

    # ------------------------------------------------------------------------------------------------ the spot

    def spot(self, wavelengths, active):
        """SurfaceInteraction3f of the path's own spot."""
        spot = dr.gather(mi.SurfaceInteraction3f, self.spots.si, self.index, active)
        spot.wavelengths = wavelengths
        return spot

    def light(self, spot, d, active):
        """What the spot sends against the ray of direction ``d`` that finds it, times the squared distance: a spectrum,
        or a Stokes vector in the frame of that ray.
        """
        beam = dr.gather(mi.Vector3f, self.spots.ray.d, self.index, active)
        spot = dr.copy(spot)
        spot.wi = spot.to_local(-d)
        wo = spot.to_local(-beam)
        # An area is seen by its own normal, however it is shaded.
        cos_out, cos_in = dr.abs_dot(spot.n, d), dr.abs_dot(spot.n, beam)
        value = spot.bsdf().eval(mi.BSDFContext(), spot, wo, active)
        value = attenuated(value, self.spots.energy(spot.wavelengths, self.index, cos_in, active))
        light = rotate_stokes(first_column(value), rotation_to_sensor(spot, d))
        return light * cos_out

    # ------------------------------------------------------------------------------------------------- primal

    def propose(self, world, path, vertex, sampler):
        active = world.deep_enough(vertex.goes_on & vertex.connectable, path.depth + 2)
        spot = self.spot(vertex.at.wavelengths, active)
        to = spot.p - vertex.at.p
        dist = dr.norm(to)
        active &= spot.is_valid() & (dist > 0)
        d = to / dr.select(active, dist, 1)
        ds = Local(p=spot.p, n=spot.n, d=d, dist=dist, delta=mi.Bool(True), emitter=None)
        active &= dr.dot(d, vertex.at.n) != 0
        u = sampler.next_2d() if world.contents.media is not None else mi.Point2f(0)
        return Proposal(d=d, active=active, ds=ds, spot=spot, u=u, sampler=sampler)

    def connect(self, world, path, vertex, proposal, answer, zeros):
        ds, active = proposal.ds, proposal.active
        light = self.light(proposal.spot, ds.d, active) * dr.select(active, dr.rcp(dr.square(ds.dist)), 0)
        value = product(vertex.β, product(answer.matrix, light))
        if not zeros:
            active = active & (dr.max(dr.abs(intensity(value))) > 0)
        opl = vertex.scattered_τ + mi.Float64(ds.dist * (vertex.η * answer.eta)) + mi.Float64(self.leg(active))
        active = world.counted(active, opl)
        test = active
        if self.confocal and world.contents.media is None:
            test = active & (path.depth != 1)
        seen, T = world.segment.transmittance(world, vertex, ds, proposal.u, sampler=proposal.sampler, active=test)
        active = (active & ~test) | seen
        return Event(value=value * T, opl=opl, active=active, depth=path.depth + 2, T=T)

    def leg(self, active):
        """Length from the laser to the spot, where it counts."""
        return dr.gather(mi.Float, self.spots.length, self.index, active) if self.legs else mi.Float(0)

    # ------------------------------------------------------------------------------------------------- record

    def fields(self, world):
        return {"lit": mi.Bool} | ({"T": mi.UnpolarizedSpectrum} if world.contents.media is not None else {})

    def record(self, sample):
        return {"lit": sample.event.active, "T": sample.event.T}

    # ----------------------------------------------------------------------------------------------- attached

    def attached(self, world, vertex, step, wanted):
        si, r = vertex.scattered_si, vertex.v.of(self.name)
        lit = r["lit"]
        spot = self.spot(si.wavelengths, lit)
        to = dr.select(lit, spot.p - si.p, mi.Vector3f(0, 0, 1))
        length = dr.norm(to)
        d = to / length
        towards = world.scattering.evaluate(world, vertex, d, lit)
        matrix = rotate_mueller(towards.value, vertex.rotation, rotation_from_light(si, towards.wo, d, dr.detach(d)))
        light = self.light(spot, d, lit) * dr.rcp(dr.square(length)) * r.get("T", 1)
        end = Local(p=spot.p, d=dr.detach(d), far=mi.Bool(False), ahead=False)
        light *= world.segment.attached_transmittance(world, vertex, end, lit)
        value = dr.select(lit, product(matrix, light), 0)
        leg = self.leg(lit)
        opl = (
            vertex.scattered_opl + mi.Float64(dr.detach(length * towards.eta) * vertex.v.η) + mi.Float64(dr.detach(leg))
        )
        slope = vertex.scattered_slope
        if wanted.geometry:
            slope = slope + slope_only(vertex.carry.η * towards.eta * length + leg)
        return [EventTerm(value=product(vertex.carry.β, value), slope=slope, opl=opl, active=lit)]
