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
:class:`~...edges.table.EdgeTable`, ``mode`` :class:`.weigh.Reverse` or :class:`.weigh.Forward`, ``job`` a launch
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
from torchtransient.plugins.integrators.job import passes_of, seed_array
from torchtransient.plugins.sensors.seen_from import SensorPlaces
from torchtransient.plugins.transport.boundary.light import LightPass
from torchtransient.plugins.transport.boundary.primary import PrimaryPass
from torchtransient.plugins.transport.boundary.specular import (
    RAYS,
    Chains,
    SensorThroughChain,
    SpecularPass,
    sees_chains,
)
from torchtransient.plugins.transport.boundary.vertex import VertexPass
from torchtransient.plugins.transport.boundary.weigh import Forward, Reverse
from torchtransient.plugins.transport.context import RenderContext
from torchtransient.plugins.transport.light_tracing import FromLight, SensorSampled, shades_by_other_normals
from torchtransient.plugins.transport.scene_contents import is_open

PASSES = {"primary": PrimaryPass, "vertex": VertexPass, "light": LightPass, "specular": SpecularPass}
_SEEDS = {"primary": 0x51, "vertex": 0x52, "light": 0x53, "specular": 0x54, "chains": 0x55, "spot": 0x56}


class BoundaryTerm:
    """Boundary term of one job of derivatives.

    Args:
        integrator, context, sensor, film, seed: of the job.
        samples: edge samples per pixel of each pass.
        names: passes to run, of ``kinds``.

    Attributes:
        context: ``context``.
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
