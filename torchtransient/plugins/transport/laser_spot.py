"""Connection to the spot that a laser makes on the first surface in its way.

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
from torchtransient.plugins.sampling.hidden_elements import packed_columns
from torchtransient.plugins.transport.carry import slope_only
from torchtransient.plugins.transport.emitter_connections import set_rate
from torchtransient.plugins.transport.strategy import Connection, Event, EventTerm, Local, Proposal


class LaserSpot(Connection):
    """Connection to light that was scattered once by a laser spot.

    An event's depth is its number of bounces: the laser's own way is no segment of the path.

    Args:
        table: :class:`~torchtransient.plugins.around_corner.scan_table.ScanTable` of the job, with its spots.
        confocal: each path ends at the spot that it started from.
        legs: the way from the laser to the spot counts in time.
    """

    name = "laser_spot"
    finds_light = False

    def __init__(self, table, confocal, legs):
        self.table, self.spots, self.confocal, self.legs = table, table.spots, confocal, legs
        self.points, self.packed, self.index = None, None, None
        # No point of a flat wall sees another; pixels of cameras may look past the wall.
        self.dark_at_first = table.wall is not None and table.looks_at_points

    def prepare(self, context):
        if not context.scattering.turns_freely:
            return
        # Where everything is diffuse, a few numbers say all of a spot.
        self.points = self.table.lambertian_spots(self.legs)
        if self.points is not None:
            with dr.suspend_grad():
                self.packed = PackedSpots(self.points, self.spots.si.is_valid())

    def tables(self):
        arrays = self.spots.arrays()
        if self.points is not None:
            arrays += [self.points.p, self.points.n, self.points.value, self.points.leg]
        return [array for array in arrays if dr.grad_enabled(array)]

    def start(self, context, rays):
        self.index = rays.spot

    # ------------------------------------------------------------------------------------------------ the spot

    def spot(self, wavelengths, active, *, attached=False):
        """Return the path's own spot: :class:`DiffuseSpot`, or :class:`GeneralSpot` with its derivatives."""
        if self.points is None:
            return self.general_spot(wavelengths, active)
        if not attached:
            return self.packed.take(self.index, active)
        return DiffuseSpot(*self.points.take(self.index, active))

    def general_spot(self, wavelengths, active):
        """Return the path's own spot as a :class:`GeneralSpot`, from whose interaction rays can start."""
        return GeneralSpot(self.spots, self.index, wavelengths, self.legs, active)

    # ------------------------------------------------------------------------------------------------- primal

    def propose(self, context, path, vertex, sampler):
        active = context.deep_enough(vertex.goes_on & vertex.connectable, path.depth + 2)
        spot = self.spot(vertex.at.wavelengths, active)
        to = spot.p - vertex.at.p
        dist = dr.norm(to)
        active &= spot.valid & (dist > 0)
        d = to / dr.select(active, dist, 1)
        ds = Local(p=spot.p, n=spot.n, d=d, dist=dist, delta=mi.Bool(True), emitter=None)
        active &= dr.dot(d, vertex.at.n) != 0
        u = sampler.next_2d() if context.contents.media is not None else mi.Point2f(0)
        return Proposal(d=d, active=active, ds=ds, spot=spot, u=u, sampler=sampler)

    def connect(self, context, path, vertex, proposal, answer, zeros):
        ds, active = proposal.ds, proposal.active
        light = proposal.spot.light(ds.d, active) * dr.select(active, dr.rcp(dr.square(ds.dist)), 0)
        value = product(vertex.β, product(answer.matrix, light))
        if not zeros:
            active = active & (dr.max(dr.abs(intensity(value))) > 0)
        opl = vertex.scattered_τ + mi.Float64(ds.dist * (vertex.η * answer.eta)) + mi.Float64(proposal.spot.leg)
        active = context.counted(active, opl)
        test = active
        if self.confocal and context.contents.media is None:
            test = active & (path.depth != 1)
        seen, T = context.segment.transmittance(context, vertex, ds, proposal.u, sampler=proposal.sampler, active=test)
        active = (active & ~test) | seen
        return Event(value=value * T, opl=opl, active=active, depth=path.depth + 2, T=T)

    # ------------------------------------------------------------------------------------------------- record

    def fields(self, context):
        return {"lit": mi.Bool} | ({"T": mi.UnpolarizedSpectrum} if context.contents.media is not None else {})

    def record(self, sample):
        return {"lit": sample.event.active, "T": sample.event.T}

    # ----------------------------------------------------------------------------------------------- attached

    def attached(self, context, vertex, step, wanted):
        si, r = vertex.scattered_si, vertex.v.record_of(self.name)
        lit = r["lit"]
        spot = self.spot(si.wavelengths, lit, attached=True)
        to = dr.select(lit, spot.p - si.p, mi.Vector3f(0, 0, 1))
        length = dr.norm(to)
        d = to / length
        towards = context.scattering.evaluate(context, vertex, d, lit)
        matrix = rotate_mueller(towards.value, vertex.rotation, rotation_from_light(si, towards.wo, d))
        light = spot.light(d, lit) * dr.rcp(dr.square(length)) * r.get("T", 1)
        end = Local(p=spot.p, d=dr.detach(d), far=mi.Bool(False), ahead=False)
        light *= context.segment.attached_transmittance(context, vertex, end, lit)
        value = dr.select(lit, product(matrix, light), 0)
        leg = mi.Float(spot.leg)
        opl = (
            vertex.scattered_opl + mi.Float64(dr.detach(length * towards.eta) * vertex.v.η) + mi.Float64(dr.detach(leg))
        )
        slope = vertex.scattered_slope
        if wanted.geometry:
            slope = slope + slope_only(vertex.carry.η * towards.eta * length + leg)
        value = product(vertex.carry.β, value)
        term = EventTerm(value=value, slope=slope, opl=opl, active=lit, arrival=vertex.v.arrival(self.name))
        if context.velocities is not None:  # the spot rests where the beam meets the wall
            set_rate(vertex, term, mi.Vector3f(0), d, vertex.carry.η * towards.eta, wanted)
        return [term]


class GeneralSpot:
    """A laser's spot on any surface: ``p``, ``n``, ``valid``, ``leg`` (the way to it, where that counts), and the
    interaction ``si``.
    """

    def __init__(self, spots, index, wavelengths, legs, active):
        self.spots, self.index = spots, index
        self.si = dr.gather(mi.SurfaceInteraction3f, spots.si, index, active)
        self.si.wavelengths = wavelengths
        self.p, self.n, self.valid = self.si.p, self.si.n, self.si.is_valid()
        self.leg = dr.gather(mi.Float, spots.length, index, active) if legs else mi.Float(0)


    def light(self, d, active):
        """Return the light that the spot sends against the ray of direction ``d`` that finds it, times the squared
        distance: a spectrum, or a Stokes vector in the frame of that ray.
        """
        beam = dr.gather(mi.Vector3f, self.spots.ray.d, self.index, active)
        spot = dr.copy(self.si)
        spot.wi = spot.to_local(-d)
        wo = spot.to_local(-beam)
        # An area is seen by its own normal, however it is shaded.
        cos_out, cos_in = dr.abs_dot(spot.n, d), dr.abs_dot(spot.n, beam)
        value = spot.bsdf().eval(mi.BSDFContext(), spot, wo, active)
        value = attenuated(value, self.spots.energy(spot.wavelengths, self.index, cos_in, active))
        light = rotate_stokes(first_column(value), rotation_to_sensor(spot, d))
        return light * cos_out


class DiffuseSpot:
    """The same on a flat diffuse wall: ``n`` points to the side that is lit, and is zero where the beam meets nothing,
    ``value`` is the light that leaves along it.
    """

    def __init__(self, p, n, value, leg):
        self.p, self.n, self.value, self.leg = p, mi.Normal3f(n), value, leg
        self.valid = dr.any(self.n != 0)

    def light(self, d, active):
        """Return the light of the spot, see :meth:`GeneralSpot.light`."""
        cos = -dr.dot(self.n, d)
        return dr.select(active & (cos > 0), mi.Spectrum(self.value) * cos, 0)


class PackedSpots:
    """The fields of diffuse spots, which a lane reads four numbers at a time. A plain object, which Dr.Jit loops leave
    alone.
    """

    def __init__(self, points, valid):
        p, n, value, leg = points.take(dr.arange(mi.UInt32, points.width))
        n = dr.select(valid, n, 0)
        columns = [*p, *n, mi.Float(leg), *value]
        columns += [mi.Float(0)] * (-len(columns) % 4)
        self.channels, self.count = dr.size_v(value), len(columns) // 4
        self.flat = packed_columns([columns[i : i + 4] for i in range(0, len(columns), 4)], points.width)

    def take(self, index, active):
        """Return the :class:`DiffuseSpot` of each lane."""
        rows = [dr.gather(mi.Vector4f, self.flat, index * self.count + i, active) for i in range(self.count)]
        x = [row[i] for row in rows for i in range(4)]
        value = mi.UnpolarizedSpectrum(x[7 : 7 + self.channels])
        return DiffuseSpot(mi.Point3f(x[:3]), mi.Normal3f(x[3:6]), value, x[6])
