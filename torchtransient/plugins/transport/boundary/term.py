"""The boundary term of derivatives: the light that a moving edge uncovers and hides.

A point p of an edge with tangent t is seen from x in direction d; n is normal to d and t and points out of the surface
that hides; P is the density of p by length. With the adjoint A(pixel, tau) of the film,

    dLoss += sum over sides  +-c [ sum over events e: A(pixel, tau_e) f_e ] (n . v_side)       + inner, - outer

(Li et al. 2018, with times of flight). Each side is a path of the walk, which goes on from a segment whose end is
known. Every edge between two vertices belongs to one of these passes:

    primary   x is the sensor:           c = W sin / P                     (W: importance per area across d at p)
    vertex    x is a vertex of a path:   c = beta f_s(x, d) sin / (r^2 P)
    light     x is a point of a light:   c = -Le / pdf_omega sin / P, and the path goes on behind p, to the sensor
    specular  x is the sensor, behind plane mirrors and glass (:mod:`.specular`): c as in the first pass

The speeds v are those of the edge against the samples that interior derivatives hold, see :mod:`.speeds`.

Arguments that functions of this folder share: ``context`` is the :class:`~..context.RenderContext` of the job, ``b`` an
outline or crease seen from x (:meth:`~...edges.table.EdgeTable.seen_from`), ``edges`` the
:class:`~...edges.table.EdgeTable`, ``mode`` :class:`Reverse` or :class:`Forward`, ``job`` a launch
(:class:`~...integrators.job.Pass`), ``numbers`` those that choose a point of the sensor
(:meth:`~...sensors.seen_from.SensorPlaces.numbers`), ``medium`` a MediumPtr or None, ``β`` a throughput, ``sampler``
Mitsuba's sampler of the lanes, ``active`` a mask of lanes.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.edges.table import EdgeTable
from torchtransient.plugins.edges.topology import topology_of
from torchtransient.plugins.films.block import FilmBlock
from torchtransient.plugins.integrators.job import passes_of, seed_array
from torchtransient.plugins.sensors.seen_from import SensorPlaces
from torchtransient.plugins.transport.boundary.light import LightPass
from torchtransient.plugins.transport.boundary.primary import PrimaryPass
from torchtransient.plugins.transport.boundary.sides import in_memory
from torchtransient.plugins.transport.boundary.specular import (
    RAYS,
    Chains,
    SensorThroughChain,
    SpecularPass,
    sees_chains,
)
from torchtransient.plugins.transport.boundary.vertex import VertexPass
from torchtransient.plugins.transport.carry import total_of
from torchtransient.plugins.transport.context import RenderContext
from torchtransient.plugins.transport.derivative import tangents_of
from torchtransient.plugins.transport.light_tracing import FromLight, SensorSampled, shades_by_other_normals
from torchtransient.plugins.transport.scene_contents import is_open
from torchtransient.plugins.transport.sinks import AdjointSumSink, FilmSink, Sink
from torchtransient.plugins.transport.strategy import Local, rate_of
from torchtransient.plugins.transport.walk import walk

PASSES = {"primary": PrimaryPass, "vertex": VertexPass, "light": LightPass, "specular": SpecularPass}
_SEEDS = {"primary": 0x51, "vertex": 0x52, "light": 0x53, "specular": 0x54, "chains": 0x55, "spot": 0x56}


class BoundaryTerm:
    """Boundary term of one job of derivatives.

    Args:
        integrator, context, sensor, film, seed: integrator and context of the job, its sensor, film and seed.
        samples: edge samples per pixel of each pass.
        names: passes to run, of ``kinds``.

    Attributes:
        context: context of the job.
        light_context: :class:`~..context.RenderContext` of paths that start at a light and are connected to the sensor.
        edges: :class:`~...edges.table.EdgeTable` of the scene.
        places: :class:`~...sensors.seen_from.SensorPlaces`.
        chains: :class:`.specular.Chains` that the sensor sees, None without.
        passes, jobs: passes of the job by name, and their launches.
    """

    can_be_recorded = True
    kinds = PASSES

    def __init__(self, integrator, context, sensor, film, seed, samples, names=tuple(PASSES)):
        self.integrator, self.context, self.sensor, self.film = integrator, context, sensor, film
        self._sampler = context.contents.memory.get("sampler", b"", lambda: mi.load_dict({"type": "independent"}))
        scene, wanted = context.scene, context.wanted
        views_move = wanted.sensor or wanted.light
        # A sensor at rest sees the edges of what moves alone; behind an edge at rest something else may move.
        moving = frozenset() if views_move else wanted.shapes
        # Paths through media pass open boundaries, which hide nothing.
        media = context.contents.media
        hides = None if media is None or not media.open_boundaries else lambda shape: not is_open(shape)
        topology = topology_of(scene, context.contents.memory, hides)
        self.edges = EdgeTable(topology, moving)
        self.radius = dr.opaque(mi.Float, integrator.reference(scene).radius)
        self.has_vertex_normals = shades_by_other_normals(scene)
        seeds = {name: mi.sample_tea_32(seed_array(seed), mi.UInt32(own))[0] for name, own in _SEEDS.items()}
        self.chains, self.through, self._seed_of_chains = None, None, seeds["chains"]
        with dr.suspend_grad():
            self.light_context = self._light_context()
        self.passes, self.jobs = {}, {}
        for name in names if topology.count else ():
            if self.kinds[name].exists(context, sensor):
                self.passes[name] = self.kinds[name](context)
                own = integrator.sampler_of(scene, sensor)
                self.jobs[name], _ = passes_of(own, film, seeds[name], samples, context.most_events())

    def _light_context(self):
        """Return the context of paths that start at a light and are connected to the sensor."""
        context, integrator = self.context, self.integrator
        self.places = SensorPlaces(self.sensor, self.film, self.radius)
        self.is_meter = self.places.is_meter
        if sees_chains(context, self.sensor):
            with context.contents.hidden_from_mitsuba():
                self.chains = Chains(integrator, context, self.places, self.independent(self._seed_of_chains, RAYS))
            self.through = SensorThroughChain(self.chains) if context.max_depth > 2 else None
        segment, scattering, _ = integrator.strategies(context.contents)
        if self.has_vertex_normals:
            scattering = FromLight(scattering)
        # Whether the sensor's segment counts in time is asked by its connection: here it is the last one of a path.
        settings = replace(integrator.settings(), camera_unwarp=False)
        self.to_sensor = SensorSampled(self.places, integrator.camera_unwarp)
        sensors = [self.to_sensor] if self.through is None else [self.to_sensor, self.through]
        strategies = segment, scattering, sensors
        window, velocities = context.window, context.velocities
        return RenderContext(context.scene, context.contents, settings, strategies, None, window, velocities)

    def tables(self):
        """Return the attached arrays: ends of edges, and tables of the strategies of light paths."""
        lights = self.passes["light"].lights.tables() if "light" in self.passes else []
        return [table for table in (*self.edges.ends, *lights) if dr.grad_enabled(table)]

    def backward(self, incoming):
        """Back-propagate to the parameters and the tables.

        Args:
            incoming: :class:`~...integrators.job.IncomingAdjoint` of the film.
        """
        for name, one in self.passes.items():
            for job in self.jobs[name]:
                objective = one.run(Reverse(self, incoming), job)
                with dr.resume_grad():
                    if dr.grad_enabled(objective):
                        dr.backward_from(objective)
                dr.eval()

    def forward(self):
        """Add the tangent to the film."""
        for name, one in self.passes.items():
            for job in self.jobs[name]:
                one.run(Forward(self, job), job)
                dr.eval(self.film.bands[job.band][2], self.film.steady)

    # ------------------------------------------------------------------------------------------------- the sensor

    def sampler(self, job):
        """Return a seeded sampler of independent numbers with a lane for each sample of ``job``."""
        return self.independent(job.seed, int(self.film.crop_size()[0]) * job.rows * job.spp)

    def independent(self, seed, lanes):
        """Return a seeded sampler of independent numbers with ``lanes`` lanes."""
        sampler = self._sampler.clone()
        sampler.seed(seed, lanes)
        return sampler

    def pixel(self, uv, u):
        """Choose a pixel that sees a place of the film, among those that the reconstruction filter allows.

        Args:
            uv: place, Point2f, pixels.
            u: two uniform numbers, Point2f.

        Returns:
            (row, column, UInt32; weight, Float; mask of places with a pixel).
        """
        size = mi.ScalarVector2f(self.film.crop_size())
        rfilter, weight, cell = self.film.rfilter(), mi.Float(1), dr.floor(uv)
        if not rfilter.is_box_filter():
            _, integral = self.film._offset_distribution
            n = int(2 * rfilter.radius()) + 1
            cell = dr.ceil(uv - rfilter.radius() - 0.5) + dr.minimum(dr.floor(u * n), n - 1)
            h = uv - cell - 0.5
            weight = rfilter.eval(h.x) * rfilter.eval(h.y) * (n * n / (integral * integral))
        inside = dr.all((cell >= 0) & (cell < size))
        return mi.UInt32(dr.select(inside, cell.y, 0)), mi.UInt32(dr.select(inside, cell.x, 0)), weight, inside

# ------------------------------------------------------------------------------------------- reverse and forward mode
# Events are weighed by the adjoint of the film, or put onto the film.


class Reverse:
    """Reverse mode: detached sums of events times the adjoint of the film, times attached speeds.

    Args:
        term: :class:`BoundaryTerm` of the job.
        incoming: :class:`~...integrators.job.IncomingAdjoint` of the film.
    """

    def __init__(self, term, incoming):
        self.term, self.incoming = term, incoming

    def view(self, rays):
        """Return the adjoint block of primary rays."""
        return self.block(rays, rays)

    def rows_in_band(self, row):
        """Return (mask of rows of pixels that the launch writes, weight of a sample of the whole film)."""
        return mi.Bool(True), 1

    def block(self, rays, place):
        """Return the adjoint block of pixels.

        Args:
            rays: rays whose channels count.
            place: ``row, column, laser`` of the pixels.
        """
        term = self.term
        match = term.integrator.channel_match(term.context.contents, term.film, rays)
        pixel = dr.fma(place.row, int(term.film.crop_size()[0]), place.column)
        return self.incoming.block(place, pixel, match)

    def speeds(self, attached):
        """Return speeds as :meth:`follow` takes them."""
        return attached

    def follow(self, context, sampler, path, block, factor, speed):
        """Trace paths and return the contribution of their events to the loss, Float.

        Args:
            path: :class:`~..walk.Path` at x, with its leg.
            block: result of :meth:`view`.
            factor: detached weight of each path.
            speed: not used here.
        """
        _, state = walk(context, sampler, path, AdjointSumSink(block))
        return _finite(state["sum"] * factor)

    def sink_of_pixels(self, middle, job, u, factor, speeds):
        """Return a sink of events that have a pixel each, and the factors of :meth:`sum_of_pixels`.

        Args:
            middle: primary rays of the middle of the film, whose channels count.
            u: two uniform numbers, which choose a pixel.
            factor: detached weight of each path.
            speeds: attached speeds by :data:`PixelSums.NAMES`.
        """
        return PixelSums(self, middle, u, len(speeds)), (factor, speeds)

    def sum_of_pixels(self, state, factors):
        """Return the attached objective, from the state of the sink and the factors."""
        factor, speeds = factors
        in_memory(self.term.context, None, state)
        with dr.resume_grad():
            names = PixelSums.NAMES[: len(speeds)]
            return sum(_finite(state[name] * factor) * speed for name, speed in zip(names, speeds, strict=True))


class PixelSums(Sink):
    """Sink that sums events, weighed by the adjoint of the pixel of each.

    ``direct``: of the first vertex, seen by the sensor; ``rest``: of all others; ``through``: of the first vertex, seen
    through a chain.

    Args:
        mode: :class:`Reverse`.
        middle, u: primary rays of the middle of the film, and two uniform numbers, see :meth:`Reverse.sink_of_pixels`.
        count: number of sums.
    """

    NAMES = ("direct", "rest", "through")

    def __init__(self, mode, middle, u, count):
        self.mode, self.middle, self.u, self.names = mode, middle, u, self.NAMES[:count]

    def begin(self, context):
        return {name: mi.Float(0) for name in self.names}

    def event(self, state, event):
        term = self.mode.term
        row, column, weight, inside = term.pixel(event.uv, self.u)
        active, place = event.active & inside, Local(row=row, column=column, laser=None)
        A, *_ = self.mode.block(_seen_along(self.middle, event.d), place).read(event.opl, active, **rate_of(event))
        value = dr.select(active, total_of(A, event.value) * weight, 0)
        name = self.NAMES[event.speed]
        state[name] = state[name] + dr.select(event.first, value, 0)
        state["rest"] = state["rest"] + dr.select(event.first, 0, value)


class Forward:
    """Forward mode: events written to the film, times the tangents of the speeds.

    Args:
        term: :class:`BoundaryTerm` of the job.
        job: launch, whose band of the film is written.
    """

    def __init__(self, term, job):
        self.term, self.job = term, job
        # Samples see the whole film, of which a band of storage keeps some rows.
        self.first, rows = term.film.band_layout()[job.band]
        self.stop, self.scale = self.first + rows, int(term.film.crop_size()[1]) / rows

    def view(self, rays):
        """Return (film block, map to channels, pixel) of primary rays."""
        term, film = self.term, self.term.film
        match, (base, pixel) = term.integrator.channel_match(term.context.contents, film, rays), self._indices(rays)
        if rays.strata is not None:
            return film.create_event_block(self.job, base, match, term.context.most_events()), match, pixel
        # Rays that go anywhere are not in the order of pixels, which some films count on.
        return FilmBlock(film, self.job.band, base, match), match, pixel

    def rows_in_band(self, row):
        """Return as in reverse mode, for the rows of one band of storage."""
        return (row >= self.first) & (row < self.stop), self.scale

    def _indices(self, place):
        return self.term.integrator.pixel_indices(self.term.film, self.job, place)

    def speeds(self, attached):
        """Return the tangents of speeds."""
        with dr.resume_grad():
            if not any(dr.grad_enabled(speed) for speed in attached):
                return [mi.Float(0)] * len(attached)
            return tangents_of(list(attached))

    def follow(self, context, sampler, path, view, factor, speed):
        """Trace paths and write their events to the film, times ``factor * speed``."""
        film, (block, match, pixel) = self.term.film, view
        _, state = walk(context, sampler, path, ScaledFilmSink(block, _finite(factor * speed)))
        film.add_steady(pixel, match.to_channels(state["L"]))
        block.finish()

    def sink_of_pixels(self, middle, job, u, factor, speeds):
        """Return the sink and factors, as in reverse mode."""
        return PixelFilmSink(self, middle, u, [_finite(factor * speed) for speed in self.speeds(speeds)]), None

    def sum_of_pixels(self, state, factors):
        """Return zero: all is on the film."""
        return mi.Float(0)


class ScaledFilmSink(FilmSink):
    """Sink that writes events to a film, times a number for each path."""

    def __init__(self, block, scale):
        super().__init__(block)
        self.scale = scale

    def event(self, state, event):
        event.value = event.value * self.scale
        super().event(state, event)


class PixelFilmSink(Sink):
    """Sink that writes events to the pixel of each, times one number at the first vertex and another at all others."""

    def __init__(self, mode, middle, u, scales):
        self.mode, self.middle, self.u, self.scales = mode, middle, u, scales

    def event(self, state, event):
        mode, term = self.mode, self.mode.term
        film = term.film
        row, column, weight, inside = term.pixel(event.uv, self.u)
        own, share = mode.rows_in_band(row)
        active = event.active & inside & own
        place = Local(row=dr.select(active, row, mode.first), column=column, laser=None)
        match = term.integrator.channel_match(term.context.contents, film, _seen_along(self.middle, event.d))
        base, pixel = mode._indices(place)
        scale = dr.select(event.first, self.scales[event.speed], self.scales[1]) * (weight * share)
        channels = [dr.select(active, c, 0) for c in match.to_channels(event.value * scale)]
        film.put(mode.job.band, base, event.opl, channels, active, **rate_of(event))
        if film.keeps_steady:
            for c, value in enumerate(channels):
                index = pixel * film.channel_count() + c
                dr.scatter_reduce(dr.ReduceOp.Add, film.steady, type(film.steady)(value), index, active)


def _seen_along(rays, d):
    """Return primary rays, each of which arrives against ``d``, as channels of the film take them."""
    ray = mi.Ray3f(dr.detach(rays.ray))
    ray.d = -d
    return Local(ray=ray, weight=rays.weight, scale=rays.scale, seen=rays.seen)


def _finite(value):
    """Return ``value``, zero where it is not finite."""
    return dr.select(dr.isfinite(value), value, 0)
