r"""The boundary term of captures in light of more than three bounces: outlines seen from hidden points, too.

Light of the spot L, of hidden points y_n to y_1 and of the scanned point S is an integral over material areas,

    I = int  f V(S, y_1) V(y_1, y_2) ... V(y_n, L)  dA(y_1) ... dA(y_n),

whose interior derivative leaves out the jumps of each visibility V. Those of all but the last one are found by the pass
of the vertices, :mod:`~..transport.boundary.vertex`: a path that begins at S goes on behind an edge. Those of the last
one are found the other way round (:class:`SpotPass`): a path begins at L, past an edge, and is connected to S.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.polarized import product
from torchtransient.plugins.transport.boundary.sides import BoundaryPass, both_sides, past_edge
from torchtransient.plugins.transport.boundary.speeds import behind, sides_from
from torchtransient.plugins.transport.boundary.term import BoundaryTerm
from torchtransient.plugins.transport.boundary.vertex import CANDIDATES, VertexPass
from torchtransient.plugins.transport.context import RenderContext
from torchtransient.plugins.transport.geometry_terms import displacement
from torchtransient.plugins.transport.laser_spot import LaserSpot
from torchtransient.plugins.transport.light_tracing import FromLight
from torchtransient.plugins.transport.material_points import MaterialVacuum
from torchtransient.plugins.transport.strategy import Connection, Event, Local, Proposal
from torchtransient.plugins.transport.surface_scattering import Lambertian, Surface
from torchtransient.plugins.transport.walk import first_leg

# The fewest bounces of late light.
FIRST = 4


class SpotPass(BoundaryPass):
    """An edge point seen from the laser's spot is drawn as :class:`VertexPass` does, and a path goes on behind it, to
    the scanned point.
    """

    @staticmethod
    def exists(world: Any, sensor: Any) -> bool:
        """Return whether there is light past edges that the spot sees."""
        return bool(world.max_depth >= FIRST)

    def run(self, mode: Any, job: Any) -> Any:
        term = mode.term
        world, edges, (spots,) = term.world, term.edges, term.world.connections
        rays = term.integrator.start(world.scene, world.contents, term.sensor, term.film, job)
        world.start(rays)
        view, sampler, ray = mode.view(rays), rays.sampler, dr.detach(rays.ray)
        η = dr.detach(rays.η)
        seen = first_leg(world, sampler, ray, rays.leg).compute_surface_interaction(ray, mi.RayFlags.All)
        spot = spots.general_spot(ray.wavelengths, seen.is_valid())
        L, active = spot.p, seen.is_valid() & spot.valid
        term.to_scan.look_at(seen, ray)

        def worth(d, dist, crease):
            return dr.select(crease, 0, dr.abs_dot(spot.n, d) / dr.maximum(dr.square(dist), 1e-12))

        nowhere = dr.zeros(mi.PreliminaryIntersection3f, dr.width(ray)), mi.Bool(False)
        k = edges.choose(edges.by_length, sampler, L, nowhere, active, CANDIDATES, worth)
        b = edges.seen_from(k, L, active)
        b.valid &= ~b.crease
        light = dr.select(b.valid, spot.light(-b.d, b.valid), 0)
        most = dr.max(dr.abs(light))
        way = b.beside - L
        end = Local(p=b.beside, d=dr.normalize(way), dist=dr.norm(way))
        active = b.valid & (most > 0) & dr.isfinite(most)
        active, _ = world.segment.transmittance(world, Local(at=spot.si), end, sampler.next_2d(), sampler, active)
        # A throughput that is handed to roulette is no larger than one.
        β = dr.select(active, light * dr.select(most > 0, dr.rcp(most), 0), 0)
        factor = most * b.sin * b.inv_pdf / dr.square(b.dist)
        past = past_edge(world, b, ray, None, β, sampler, active)
        with dr.resume_grad():
            v_L = displacement(dr.gather(mi.Point3f, spots.spots.si.p, spots.index, active), active)
            speeds = sides_from(world, b, edges, v_L, behind(world, b, *past, active), mi.Float(0), active)
        τ = term.integrator.first_opl(term.film, rays) + mi.Float64(spot.leg)
        if not world.camera_unwarp:
            τ += mi.Float64(dr.norm(seen.p - ray.o) * η)
        # The spot is the vertex before the first one.
        first = {
            "ray": ray, "β": β, "η": η, "τ": τ, "prev_p": L, "prev_n": spot.n, "depth": 1, "active": active,
            "medium": None,
        }  # fmt: skip
        needed = None, mi.Bool(True)
        return both_sides(term.light_world, mode, sampler, view, b, past, first, factor, speeds, needed)


class ScanSampled(Connection):
    """The scanned point as what a path from the laser's spot is connected to; the way from there to the sensor has been
    counted. As in :class:`LaserSpot`, an event's depth is its number of bounces.
    """

    name = "scan_sampled"
    finds_light = False

    def look_at(self, seen: Any, ray: Any) -> None:
        """Set the scanned points (SurfaceInteraction3f) of a launch, and the rays of the sensor that see them."""
        self.seen, self.ray = seen, ray

    def propose(self, world: Any, path: Any, vertex: Any, sampler: Any) -> Proposal:
        active = world.deep_enough(vertex.goes_on & vertex.connectable, path.depth + 2)
        to = self.seen.p - vertex.at.p
        dist = dr.norm(to)
        active &= dist > 0
        d = to / dr.select(active, dist, 1)
        active &= dr.dot(d, vertex.at.n) != 0
        ds = Local(p=self.seen.p, n=self.seen.n, d=d, dist=dist, delta=mi.Bool(True), emitter=None)
        return Proposal(d=d, active=active, ds=ds, u=mi.Point2f(0), sampler=sampler)

    def connect(self, world: Any, path: Any, vertex: Any, proposal: Any, answer: Any, zeros: bool) -> Event:
        ds, active = proposal.ds, proposal.active
        seen = dr.copy(self.seen)
        seen.wi = seen.to_local(-self.ray.d)
        at_wall = seen.bsdf().eval(mi.BSDFContext(), seen, seen.to_local(-ds.d), active)
        value = product(vertex.β, product(answer.matrix, at_wall)) * dr.select(active, dr.rcp(dr.square(ds.dist)), 0)
        active &= dr.max(dr.abs(value)) > 0
        opl = vertex.scattered_τ + mi.Float64(ds.dist * vertex.η * answer.eta)
        active = world.counted(active, opl)
        active, _ = world.segment.transmittance(world, vertex, ds, proposal.u, proposal.sampler, active)
        return Event(value=value, opl=opl, active=active, depth=path.depth + 2)


class LateOutlines(BoundaryTerm):
    """The boundary term of one job in light of ``FIRST`` and more bounces.

    Args:
        integrator, world, sensor, film, seed, samples: as of :class:`BoundaryTerm`; ``world`` is that of the job.
    """

    can_be_recorded = False
    kinds: ClassVar[dict[str, Any]] = {"vertex": VertexPass, "spot": SpotPass}

    def __init__(self, integrator: Any, world: Any, sensor: Any, film: Any, seed: Any, samples: int) -> None:
        (spots,) = world.connections
        settings = integrator.settings()
        self.settings = replace(settings, min_depth=max(FIRST, settings.min_depth))
        _, scattering, _ = integrator.strategies(world.contents, spots.table)
        spots = LaserSpot(spots.table, spots.confocal, spots.legs)
        # Paths begin behind edges.
        spots.dark_at_first = False
        strategies = MaterialVacuum(), scattering, [spots]
        late = RenderContext(world.scene, world.contents, self.settings, strategies, world.wanted, world.window)
        super().__init__(integrator, late, sensor, film, seed, samples, tuple(self.kinds))

    def _light_world(self) -> RenderContext:
        """The world of paths that start at the spot and are connected to the scanned point."""
        world = self.world
        scattering = Lambertian() if Lambertian.fits(world.contents) else Surface()
        if self.has_vertex_normals:
            scattering = FromLight(scattering)
        self.to_scan = ScanSampled()
        strategies = MaterialVacuum(), scattering, [self.to_scan]
        return RenderContext(world.scene, world.contents, self.settings, strategies, None, world.window)

    def tables(self) -> list[Any]:
        return [*super().tables(), *(table for table in self.world.tables() if dr.grad_enabled(table))]
