"""Derivatives of third-bounce light from shared samples, confocal and single, in both modes.

Reverse mode has a lane for each hidden sample, which loops over the scanned points and keeps the adjoint of its sample
to itself: no sum is atomic, and memory does not grow with the number of connections. What belongs to the scanned points
is found in a second pass, with a lane for each of them. The adjoints of samples and points are then handed on to the
scene once. In forward mode the tangents of samples and points are tables, and every connection puts ``k df + f k'
dtau`` onto the film.

Samples are material points: with the density held fixed per area of material, a lone body's outline needs no boundary
term. What stands in between is asked again and held fixed; bodies that hide each other need the term of their edges.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.around_corner.geometry import occluded, span
from torchtransient.plugins.around_corner.launches import launches_of
from torchtransient.plugins.films.colour import ChannelMatch
from torchtransient.plugins.sampling.hidden_elements import packed_columns
from torchtransient.plugins.sampling.shared_samples import material_samples
from torchtransient.plugins.transport.carry import slope_only, total_of
from torchtransient.plugins.transport.derivative import tangents_of
from torchtransient.plugins.transport.strategy import Local

# ----------------------------------------------------------------------------------------------------------------------
# Samples and wall points with derivatives: as functions of the scene's parameters, and as leaves of a lane.


class Ends:
    """Ends of connections, hidden samples or scanned points, attached where the scene is. A plain class.

    Args:
        count: number of samples or points.
        fields: vectors, spectra and numbers by name, of all of them or one for all.
    """

    def __init__(self, count: int, fields: dict[str, Any]) -> None:
        self.count, self.fields = count, fields
        self.size = dr.opaque(mi.UInt32, count)
        with dr.suspend_grad():
            columns = [column for value in fields.values() for column in _columns(value)]
            columns += [mi.Float(0)] * (-len(columns) % 4)
            rows = [columns[i : i + 4] for i in range(0, len(columns), 4)]
            self.rows, self.flat = len(rows), packed_columns(rows, count) if rows else None

    @property
    def attached(self) -> list[str]:
        """Names of the fields with derivatives; none where derivatives are suspended."""
        return [name for name, value in self.fields.items() if dr.grad_enabled(value)]

    def detached(self) -> Ends:
        """Return a detached copy.

        Virtual calls attach their results as soon as one of the plugins that they may go to is attached: fields may be
        attached although nothing moves them.
        """
        return Ends(self.count, {name: dr.detach(value) for name, value in self.fields.items()})

    def load(self, index: Any) -> Local:
        """Return the fields of the ends with the numbers ``index`` (UInt32), detached, four numbers at a load."""
        rows = [dr.gather(mi.Vector4f, self.flat, index * self.rows + i) for i in range(self.rows)]
        columns = [row[i] for row in rows for i in range(4)]
        found = {}
        for name, value in self.fields.items():
            size = dr.size_v(value) if dr.depth_v(value) > 1 else 1
            own, columns = columns[:size], columns[size:]
            found[name] = type(value)(*own)
        return Local(**found)

    def tangents(self) -> Ends:
        """Return the tangents of the attached fields, in forward mode."""
        return Ends(self.count, {name: dr.grad(self.fields[name]) for name in self.attached})

    def hand_on(self, adjoints: dict[str, Any]) -> None:
        """Back-propagate ``<adjoints, fields>``; ``adjoints``: by name of the field, one for each end."""
        for name, adjoint in adjoints.items():
            field = self.fields[name]
            if dr.width(field) < self.count:
                adjoint = dr.sum(adjoint) if dr.depth_v(adjoint) == 1 else type(adjoint)(*map(dr.sum, adjoint))
            dr.backward_from(total_of(adjoint, field))


def _columns(value: Any) -> list[Any]:
    return [value] if dr.depth_v(value) == 1 else [value[i] for i in range(dr.size_v(value))]


def leaves(local: Local, names: list[str], width: int, tangents: Local | None = None) -> dict[str, Any]:
    """Replace fields of an end by leaves of the graph, and return the leaves by name.

    Args:
        local: one end for each lane, which is changed.
        names: names of the fields.
        width: number of lanes.
        tangents: tangents of the fields in forward mode, else None.
    """
    found = {}
    for name in names:
        value = getattr(local, name)
        # As wide as the lanes, or gradients would be summed up over them.
        leaf = type(value)(value + dr.zeros(mi.Float, width))
        dr.enable_grad(leaf)
        if tangents is not None:
            dr.set_grad(leaf, getattr(tangents, name))
        setattr(local, name, leaf)
        found[name] = leaf
    return found


def ends_of_samples(scene: Any, elements: Any, samples: Any, meshes: Any, laser: Any = None) -> Ends:
    """Return shared samples as material points.

    Args:
        scene: built scene.
        elements: table of the hidden elements.
        samples: the samples.
        meshes: meshes of the scene.
        laser: spot that lights all samples (:class:`.geometry.WallPoints` of one point), None for confocal captures.

    Returns:
        Ends with ``p``, ``n``, and ``front`` and ``back``: albedo over pi of the sides, times the area that a sample
        stands for; with ``geometric_n`` where normals are interpolated. With ``laser``, ``n`` is that of the side that
        is lit, ``front`` the light that it scatters, and ``delay`` the length of the way to the spot (metres).
    """
    found = material_samples(elements, samples, meshes)
    fields = {"p": found.p, "n": found.n, "front": found.front}
    if laser is None:
        fields["back"] = found.back
    else:
        start, n = _line_start(found, samples.smooth), mi.Vector3f(laser.n)
        line = span(start, laser.p, n)
        arrives = dr.abs(line.cos) * line.wall_cos * line.inverse_square
        reflected = dr.select(line.cos > 0, found.front, found.back)
        with dr.suspend_grad():
            lit = arrives > 0
            lit &= ~occluded(scene, start, line, laser.p, n, lit)
        fields["n"] = dr.select(line.cos > 0, found.n, -found.n)
        fields["front"] = dr.select(lit, reflected * arrives, 0)
        fields["delay"] = dr.select(lit, line.r, 0)
    if samples.smooth:
        fields["geometric_n"] = found.geometric_n
    return Ends(samples.count, fields)


def _line_start(sample: Local, smooth: bool) -> Local:
    return Local(p=sample.p, n=sample.n, geometric_n=sample.geometric_n if smooth else sample.n)


def ends_of_points(sensors: Any, lasers: Any, energy: Any) -> Ends:
    """Return scanned points with ``p`` and ``n``, ``value`` (albedos over pi at point and spot, times the energy), and
    ``leg`` (both legs, metres).

    Args:
        sensors: the scanned points.
        lasers: the spots, one or one for each point.
        energy: energy of the laser by colour (J).
    """
    value = mi.UnpolarizedSpectrum(sensors.value * lasers.value * energy)
    leg = mi.Float(sensors.leg) + mi.Float(lasers.leg)
    return Ends(sensors.width, {"p": sensors.p, "n": mi.Vector3f(sensors.n), "value": value, "leg": leg})


# ----------------------------------------------------------------------------------------------------------------------

# Lanes that keep all cores busy.
BUSY = 2**14


class ThirdBounceGradients:
    """Derivatives of one job. A plain class.

    Args:
        scene: built scene.
        film: film of the job.
        samples, points: hidden samples and scanned points, attached where derivatives are requested.
        clear: number of samples, the first ones, that nothing can hide.
    """

    def __init__(self, scene: Any, film: Any, samples: Ends, points: Ends, clear: Any) -> None:
        self.scene, self.film, self.samples, self.points, self.clear = scene, film, samples, points, clear
        self.lit, self.smooth = "delay" in samples.fields, "geometric_n" in samples.fields
        self.match = ChannelMatch(None, mi.UnpolarizedSpectrum(1))
        self.window = film.arrivals()

    def connection(self, sample: Any, point: Any, k: Any) -> tuple[Any, Any, Any, Any]:
        """Connect samples to points.

        Args:
            sample, point: one of each for each lane, as :meth:`Ends.load` returns them.
            k: numbers of the samples (UInt32).

        Returns:
            Value, optical path length (Float, metres), the same minus the film's start (Float64, detached), and a mask
            of connections that carry light.
        """
        geometric_n = sample.geometric_n if self.smooth else sample.n
        start = Local(p=sample.p, n=sample.n, geometric_n=geometric_n)
        line = span(start, point.p, point.n)
        if self.lit:
            side, reflected, length = line.cos > 0, sample.front, line.r + sample.delay
            g = dr.abs(line.geometric_cos) * line.wall_cos * line.inverse_square
        else:
            side, length = line.cos != 0, 2 * line.r
            reflected = dr.select(line.cos > 0, sample.front, sample.back)
            g = dr.abs(line.cos * line.geometric_cos) * dr.square(line.wall_cos * line.inverse_square)
        length = length + point.leg
        active = side & (g > 0)
        with dr.suspend_grad():
            opl = mi.Float64(length) - self.film.start_opl
            if self.window is not None:
                active &= self.window.counts(opl)
            in_doubt = active & (k >= self.clear)
            active &= ~occluded(self.scene, start, line, point.p, point.n, in_doubt)
        return reflected * g * point.value, length, opl, active

    # ------------------------------------------------------------------------------------------------- reverse

    def backward(self, incoming: Any) -> None:
        """Back-propagate ``<adjoint, capture>`` to the scene; ``incoming``: the film's adjoint."""
        read = AdjointReader(self.film, self.match, incoming)
        found = []
        passes = (self.samples, self.points, _over_points), (self.points, self.samples, _over_samples)
        for own, others, over in passes:
            with dr.resume_grad():  # the question whether a field is attached is answered no while suspended
                names = own.attached
            if names:
                split = Split(own, others.count)
                adjoints = over(self, read, {name: dr.zeros(type(own.fields[name])) for name in names}, split)
                dr.eval(adjoints)
                found.append((own, {name: split.reduced(value) for name, value in adjoints.items()}))
        dr.eval([adjoints for _, adjoints in found])
        with dr.resume_grad():
            for ends, adjoints in found:
                ends.hand_on(adjoints)

    def step_back(self, read: AdjointReader, adjoints: dict[str, Any], pair: Local, by_sample: bool) -> None:
        """Add the adjoints of one connection to those of its sample, or of its point.

        Args:
            read: the film's adjoint.
            adjoints: adjoints by field, which are added to.
            pair: ``sample`` and ``point`` of the connection, with their numbers ``k`` and ``s``.
            by_sample: adjoints are those of the sample.
        """
        with dr.resume_grad():
            sample, point = _dr_copy(pair.sample), _dr_copy(pair.point)
            found = leaves(sample if by_sample else point, list(adjoints), dr.width(pair.k))
            value, length, opl, arrives = self.connection(sample, point, pair.k)
            A, slope = read.block(pair.s).read(opl, arrives)
            objective = total_of(A, value) + total_of(slope, dr.detach(value)) * slope_only(length)
            dr.backward_from(dr.select(arrives, objective, 0))
            for name, leaf in found.items():
                adjoints[name] = adjoints[name] + dr.grad(leaf)

    # ------------------------------------------------------------------------------------------------- forward

    def forward(self) -> None:
        """Add the derivative along the scene's tangents to the film."""
        with dr.resume_grad():
            tangents = self.samples.tangents(), self.points.tangents()
        for launch in launches_of(self.film, self.samples.count):
            pixel, first, last = launch.lanes()
            base = launch.base(self.film, pixel)
            block = self.film.create_event_block(launch, base, self.match, launch.most_events, tangents=True)
            lane = Local(own=pixel, first=first, last=last, fields=self.points.load(pixel))
            lane.tangent = tangents[1].load(pixel)
            dr.eval(vars(lane.fields), vars(lane.tangent), pixel, first, last)
            sums = {"dL": mi.UnpolarizedSpectrum(0), "block": block.begin()}
            sums = _tangents_over_samples(self, tangents[0], block, sums, lane)
            block.end(sums["block"])
            self.film.add_steady(pixel, self.match.to_channels(sums["dL"]))
            block.finish()
            dr.eval(self.film.bands[launch.band][2], self.film.steady)

    def step_on(self, tangents: Ends, block: Any, sums: dict[str, Any], lane: Local, k: Any) -> None:
        """Add the derivative of the connection with sample ``k`` to the film's block and to ``sums``."""
        with dr.resume_grad():
            sample, point, width = self.samples.load(k), _dr_copy(lane.fields), dr.width(lane.own)
            leaves(sample, list(tangents.fields), width, tangents.load(k))
            leaves(point, list(vars(lane.tangent)), width, lane.tangent)
            value, length, opl, arrives = self.connection(sample, point, k)
            d_value, d_opl = tangents_of([value, slope_only(length)])
        sums["dL"] = sums["dL"] + dr.select(arrives, d_value, 0)
        block.put_slope(sums["block"], opl, d_value, value * d_opl, arrives)


def _dr_copy(local: Local) -> Local:
    """Return a copy of the containers with the same fields: leaves made in the copy leave the original as it is."""
    return Local(**vars(local))


class Split:
    """Lanes of a pass over all connections: one for each end of one kind, or several if there are few. A plain class.

    Args:
        ends: the lanes' own ends.
        others: number of ends of the other kind; each lane goes through a range of them, ``first`` to ``last``
            (exclusive), neighbouring lanes through the same.
    """

    def __init__(self, ends: Ends, others: int) -> None:
        self.count, self.lanes = ends.count, max(1, min(others, -(-BUSY // ends.count)))
        size = dr.opaque(mi.UInt32, -(-others // self.lanes))
        lane = dr.arange(mi.UInt32, self.count * self.lanes)
        part = lane // ends.size
        self.own, self.first = lane - part * ends.size, part * size
        self.last = dr.minimum(self.first + size, dr.opaque(mi.UInt32, others))
        self.fields = ends.load(self.own)
        dr.eval(self.own, self.first, self.last, vars(self.fields))

    def reduced(self, value: Any) -> Any:
        """Return the sums of ``value`` over the lanes of each end."""
        if self.lanes == 1:
            return value
        own = dr.arange(mi.UInt32, self.count)
        total = dr.gather(type(value), value, own)
        for part in range(1, self.lanes):
            total += dr.gather(type(value), value, own + part * self.count)
        return total


class AdjointReader:
    """Adjoint of the film (:class:`~..integrators.job.IncomingAdjoint`) at scanned points."""

    def __init__(self, film: Any, match: Any, incoming: Any) -> None:
        self.match, self.incoming = match, incoming
        self.width = dr.opaque(mi.UInt32, int(film.crop_size()[0]))

    def block(self, s: Any) -> Any:
        """Return the :class:`~..films.block.AdjointBlock` of the points with the numbers ``s``."""
        row = s // self.width
        place = Local(row=row, column=s - row * self.width, laser=None)
        return self.incoming.block(place, s, self.match)


@dr.syntax
def _over_points(job, read, adjoints, split):
    """Return the adjoints of each lane's sample, by its range of the points."""
    s = mi.UInt32(split.first)
    while dr.hint(s < split.last, label="scanned points, reverse"):
        job.step_back(read, adjoints, Local(sample=split.fields, point=job.points.load(s), k=split.own, s=s), True)
        s += 1
    return adjoints


@dr.syntax
def _over_samples(job, read, adjoints, split):
    """Return the adjoints of each lane's point, by its range of the samples."""
    k = mi.UInt32(split.first)
    while dr.hint(k < split.last, label="hidden samples, reverse"):
        job.step_back(read, adjoints, Local(sample=job.samples.load(k), point=split.fields, k=k, s=split.own), False)
        k += 1
    return adjoints


@dr.syntax
def _tangents_over_samples(job, tangents, block, sums, lane):
    """Add the derivatives of the light from each lane's range of the samples to its point."""
    k = mi.UInt32(lane.first)
    while dr.hint(k < lane.last, label="hidden samples, forward mode"):
        job.step_on(tangents, block, sums, lane, k)
        k += 1
    return sums
