"""Boundary terms of light around a corner where hidden shapes occlude each other.

With hidden points ``y`` that follow their shapes, the light of a pixel is an integral over material area,

    I = int  f(y) V(Q, y) ...  dA(y),

and what its interior derivative leaves out is the motion of the outlines: the jumps of the visibility ``V`` from a
viewpoint ``Q``, a scanned point or a laser spot. An outline is a piece of an edge, and what it hides begins at the
point ``y`` behind a point ``p`` of it. Seen from ``Q`` the edge moves outwards against ``y`` by the angle

    outwards = n . ((dp - dQ) / |p - Q| - (dy - dQ) / |y - Q|),

with ``n`` across the edge and the line of sight, out of what hides. An angle across is an area of ``y`` times
``cos_y / |y - Q|^2``, and the length ``dl`` of the edge spans ``|d x t| / |p - Q| dl`` along, so that

    dI = - int  f(y) |y - Q|^2 / cos_y  |d x t| / |p - Q|  outwards  dl

over the outlines seen from ``Q``. Where a spot and the scanned point differ, both are viewpoints, each with the
visibility from the other one as a factor. (The boundary term of differentiable rendering, Li et al. 2018, in the
measure of the hidden area.)
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import GradientWarning
from torchtransient.plugins.around_corner.division import BOUNCES
from torchtransient.plugins.around_corner.geometry import front_normal
from torchtransient.plugins.around_corner.late_light import FIRST
from torchtransient.plugins.around_corner.outline_table import OutlineTable, Part, hiding_pairs, parts_of
from torchtransient.plugins.integrators.job import Pass, passes_of, seed_array
from torchtransient.plugins.kernel_arrays import registry_number
from torchtransient.plugins.polarized import (
    light_type,
    product,
    rotate_mueller,
    rotation_from_light,
    rotation_to_sensor,
)
from torchtransient.plugins.sampling.point_sets import plane_point
from torchtransient.plugins.transport.boundary.moving_edges import (
    Gap,
    MovingEdges,
    edges_in_mirrors,
    rims_without_edges,
)
from torchtransient.plugins.transport.boundary.sides import BoundaryPass, both_sides, past_edge
from torchtransient.plugins.transport.boundary.speeds import behind, sides_from
from torchtransient.plugins.transport.boundary.term import BoundaryTerm
from torchtransient.plugins.transport.boundary.vertex import CANDIDATES, VertexPass
from torchtransient.plugins.transport.carry import total_of
from torchtransient.plugins.transport.context import RenderContext
from torchtransient.plugins.transport.derivative import tangents_of
from torchtransient.plugins.transport.geometry_terms import displacement
from torchtransient.plugins.transport.laser_spot import LaserSpot
from torchtransient.plugins.transport.light_tracing import FromLight
from torchtransient.plugins.transport.material_points import MaterialVacuum
from torchtransient.plugins.transport.strategy import Connection, Event, Local, Proposal, rate_of
from torchtransient.plugins.transport.surface_scattering import Lambertian, Surface
from torchtransient.plugins.transport.walk import first_leg

# How far beside an edge one looks past it, and by how much what is seen may be nearer than the edge: parts of the
# distance.
BESIDE, BEFORE = 1e-4, 1e-5
# Cosines under which a surface is seen edge-on.
EDGE_ON = 1e-4


class MutualOcclusion:
    """Boundary term of a job of derivatives in light of three bounces, added by ``backward`` or ``forward``.

    Hidden surfaces scatter by their BSDF's smooth lobes. A launch is one kernel without a loop, whose memory does not
    grow with the number of lanes.

    Args:
        integrator: integrator of the job, which draws primary rays.
        context: context of the job.
        sensor, film: sensor and film of the job.
        edges: edges that can be outlines.
        spots: connection to the laser's spots.
        jobs: launches (:class:`~..integrators.job.Pass`), whose ``spp`` are edge samples of a pixel and viewpoint.
    """

    can_be_recorded = False

    def __init__(
        self, integrator: Any, context: Any, sensor: Any, film: Any, edges: OutlineTable, spots: Any, jobs: Any
    ) -> None:
        self.integrator, self.context, self.sensor, self.film = integrator, context, sensor, film
        self.edges, self.spots, self.jobs = edges, spots, jobs

    def tables(self) -> list[Any]:
        """Return the attached arrays that were computed from the scene's parameters."""
        return [end for end in self.edges.ends if dr.grad_enabled(end)]

    # ------------------------------------------------------------------------------------------ both modes

    def backward(self, incoming: Any) -> None:
        """Add gradients to the attached parameters; ``incoming``: the film's adjoint."""
        for job in self.jobs:
            rays = self._start(job)
            match = self.integrator.channel_match(self.context.contents, self.film, rays)
            _, pixel = self.integrator.pixel_indices(self.film, job, rays)
            block = incoming.block(rays, pixel, match)
            with dr.resume_grad():
                objective = mi.Float(0)
                for term in self._terms(rays, self._array(rays, pixel), job):
                    A, *_ = block.read(term.opl, term.active, **rate_of(term))
                    objective += total_of(A, term.value) * term.outwards
                if dr.grad_enabled(objective):
                    dr.backward_from(objective)
            dr.eval()

    def forward(self) -> None:
        """Add the derivative along the tangents of tables and scene to the film."""
        film = self.film
        for job in self.jobs:
            rays = self._start(job)
            match = self.integrator.channel_match(self.context.contents, film, rays)
            base, pixel = self.integrator.pixel_indices(film, job, rays)
            block = film.create_event_block(job, base, match, 2, tangents=True)
            with dr.resume_grad():
                terms = self._terms(rays, self._array(rays, pixel), job)
                tangents = tangents_of([term.outwards for term in terms])
            events, total = block.begin(), light_type()(0)
            for term, outwards in zip(terms, tangents, strict=True):
                value = term.value * outwards
                rate = rate_of(term)
                if rate:
                    rate["value_d_rate"] = light_type()(0)
                block.put_slope(events, term.opl, value, light_type()(0), term.active, **rate)
                total += value
            block.end(events)
            film.add_steady(pixel, match.to_channels(total))
            block.finish()
            dr.eval(film.bands[job.band][2], film.steady)

    def _array(self, rays: Any, pixel: Any) -> Any:
        """Return the number of each sample's array of the film: of a pixel, or of a pixel and a laser spot."""
        return pixel if rays.laser is None else pixel * self.film.laser_count() + rays.laser

    def _start(self, job: Pass) -> Any:
        context = self.context
        rays = self.integrator.start(context.scene, context.contents, self.sensor, self.film, job)
        context.start(rays)
        return rays

    # --------------------------------------------------------------------------------------------- the terms

    def _terms(self, rays: Any, pixel: Any, job: Pass) -> list[Local]:
        """Return a term for each viewpoint: ``value`` (detached), ``outwards`` (attached), ``opl`` and ``active``.

        Values are zero in lanes that are not active.
        """
        context, ray = self.context, rays.ray
        leg = rays.leg if rays.leg is not None else context.scene.ray_intersect_preliminary(ray, coherent=True)
        seen = leg.compute_surface_interaction(ray, mi.RayFlags.All)
        found = seen.is_valid()
        spot = self.spots.general_spot(ray.wavelengths, found)
        found &= spot.valid
        # Attached where the scene is; all but seen_at and lit_at is read where derivatives are suspended.
        place = Local(
            seen=seen, lit=spot.si, spot=spot, seen_at=seen.p, lit_at=spot.p, ray=ray, found=found, η=rays.η
        )  # fmt: skip
        with dr.suspend_grad():
            place.before = self.integrator.first_opl(self.film, rays)
            if not context.camera_unwarp:
                place.before += mi.Float64(dr.norm(seen.p - ray.o) * rays.η)
            place.before += mi.Float64(spot.leg)
        edge = self._edge_point(pixel, job)
        views = [self._term(place, edge, from_spot=False)]
        if not self.spots.confocal:
            views.append(self._term(place, edge, from_spot=True))
        return views

    def _edge_point(self, pixel: Any, job: Pass) -> Local:
        """Draw a point of an edge: ``p`` (attached), ``t`` (direction of the edge), ``sides`` (third corners of its
        faces), ``weight`` (one over the density by length).
        """
        lane = dr.arange(mi.UInt32, dr.width(pixel))
        number = lane - lane // dr.opaque(mi.UInt32, job.spp) * dr.opaque(mi.UInt32, job.spp)
        # Every pixel has points of its own.
        seed, _ = mi.sample_tea_32(mi.UInt32(job.seed), pixel)
        x, u = plane_point(number, job.spp, seed)
        index, per_edge = self.edges.sample(x)
        a, b = self.edges.end_points(index)
        with dr.suspend_grad():
            along = b - a
            length = dr.norm(along)
        p, sides = dr.lerp(a, b, u), self.edges.third_corners(index)
        return Local(p=p, t=along / length, sides=sides, weight=length * per_edge)

    def _term(self, place: Local, edge: Local, from_spot: bool) -> Local:
        """Return the boundary term of one viewpoint."""
        scene = self.context.scene
        viewer, Q = (place.lit, place.lit_at) if from_spot else (place.seen, place.seen_at)
        with dr.suspend_grad():
            d = edge.p - viewer.p
            distance = dr.norm(d)
            distance = dr.select(distance > 0, distance, 1)
            d /= distance
            across = dr.cross(edge.t, d)
            spans = dr.norm(across)
            # Lanes without a term must not multiply zero by what is not a number.
            n = dr.select(spans > 0, across / spans, 0)
            here, there = (dr.dot(n, side - edge.p) for side in edge.sides)
            active = place.found & (here * there > 0)
            n = dr.select(here > 0, -n, n)
            past = viewer.spawn_ray(dr.normalize(d + n * BESIDE))
            behind = scene.ray_intersect_preliminary(past, active=active)
        y = behind.compute_surface_interaction(past, mi.RayFlags.All | mi.RayFlags.FollowShape, active)
        with dr.suspend_grad():
            si = dr.detach(y)
            beyond = dr.norm(si.p - viewer.p)
            active &= si.is_valid() & (beyond > distance * (1 - BEFORE))
            beyond = dr.select(active, beyond, 1)
            value, opl, active = self._light(place, si, from_spot, active)
            rate = self._rate(place, si, active)
            weight = -edge.weight * spans / distance
            if not self.spots.confocal:
                weight *= self._seen_otherwise(
                    place.seen if from_spot else place.lit, viewer, si, d - n * BESIDE, active
                )
            value = dr.select(active, value * weight, 0)
        outwards = dr.dot(n, (edge.p - Q) / distance - (y.p - Q) / beyond)
        return Local(value=value, outwards=dr.select(active, outwards, 0), opl=opl, active=active, rate=rate)

    def _rate(self, place: Local, si: Any, active: Any) -> Any:
        """Return the rate of light by way of a hidden point (Float), None for films that measure none."""
        velocities = self.context.velocities
        if velocities is None:
            return None
        there, on = dr.normalize(si.p - place.seen.p), dr.normalize(place.lit.p - si.p)
        return dr.dot(velocities.of_surface(si, active), there - on) * place.η

    def _light(self, place: Local, si: Any, from_spot: bool, active: Any) -> tuple[Any, Any, Any]:
        """Return (light by way of a hidden point per solid angle around the viewpoint, arrival, which lanes have some).
        """
        context, seen, lit = self.context, dr.copy(place.seen), place.lit
        to_hidden, to_spot = si.p - seen.p, lit.p - si.p
        r_seen, r_spot = dr.norm(to_hidden), dr.norm(to_spot)
        d_seen, d_spot = to_hidden / r_seen, to_spot / r_spot
        cos_seen, cos_spot = dr.abs_dot(si.n, d_seen), dr.abs_dot(si.n, d_spot)
        # Of points at an end itself no cosine is a number.
        active &= (cos_seen > EDGE_ON) & (cos_spot > EDGE_ON)
        at_wall = self._scattered(seen, place.ray.d, d_seen, active)
        hidden = self._scattered(si, d_seen, d_spot, active)
        value = product(at_wall, product(hidden, place.spot.light(d_spot, active)))
        # The cosine towards the spot is in the BSDF's value.
        measure = dr.rcp(dr.square(r_spot)) if not from_spot else cos_seen / (cos_spot * dr.square(r_seen))
        opl = place.before + mi.Float64((r_seen + r_spot) * place.η)
        active = context.counted(active, opl)
        return value * measure, opl, active

    def _seen_otherwise(self, other: Any, viewer: Any, si: Any, d: Any, active: Any) -> Any:
        """Return the visibility of the hidden point ``si`` from the ``other`` viewpoint (Float).

        The mean of both sides of the outline, ``d`` pointing to the one that is hidden: where a spot, a scanned point
        and an edge lie in one plane, both viewpoints have the same outline, which counts once and not twice.
        """
        hidden = dr.copy(si)
        hidden.p = mi.Point3f(viewer.p + d * (dr.dot(si.n, si.p - viewer.p) / dr.dot(si.n, d)))
        tests = [self.context.scene.ray_test(at.spawn_ray_to(other.p), active) for at in (si, hidden)]
        return sum(dr.select(hit, mi.Float(0), 0.5) for hit in tests)

    def _scattered(self, si: Any, into: Any, out: Any, active: Any) -> Any:
        """Return the BSDF's value for a ray of direction ``into`` that goes on by ``out``, in the segments' frames."""
        si.wi = si.to_local(-into)
        wo = si.to_local(out)
        bsdf = si.bsdf()
        value = bsdf.eval(mi.BSDFContext(), si, wo, active)
        value = self.context.scattering.correct_two_sided(self.context, bsdf, si, wo, value)
        return rotate_mueller(value, rotation_to_sensor(si, into), rotation_from_light(si, wo, out))


# ----------------------------------------------------------------------------------------------------------------------
# The boundary term of captures in light of more than three bounces: outlines seen from hidden points.
# Light of the spot L, of hidden points y_n to y_1 and of the scanned point S is an integral over material areas,
#
#     I = int  f V(S, y_1) V(y_1, y_2) ... V(y_n, L)  dA(y_1) ... dA(y_n),
#
# whose interior derivative leaves out the jumps of each visibility V. Those of all but the last one are found by the
# pass of the vertices, :mod:`~..transport.boundary.vertex`: a path that begins at S goes on behind an edge. Those of
# the last one are found the other way round (:class:`SpotPass`): a path begins at L, past an edge, and is connected to
# S.


class SpotPass(BoundaryPass):
    """Boundary pass from the laser's spot: an edge point, and behind it a path that is connected to the scanned point.

    :class:`VertexPass` does the same from vertices of paths that begin at the sensor.
    """

    @staticmethod
    def exists(context: Any, sensor: Any) -> bool:
        """Return whether there is light past edges that the spot sees."""
        return bool(context.max_depth >= FIRST)

    def run(self, mode: Any, job: Any) -> Any:
        term = mode.term
        context, edges, (spots,) = term.context, term.edges, term.context.connections
        rays = term.integrator.start(context.scene, context.contents, term.sensor, term.film, job)
        context.start(rays)
        view, sampler, ray = mode.view(rays), rays.sampler, dr.detach(rays.ray)
        η = dr.detach(rays.η)
        seen = first_leg(context, sampler, ray, rays.leg).compute_surface_interaction(ray, mi.RayFlags.All)
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
        active, _ = context.segment.transmittance(context, Local(at=spot.si), end, sampler.next_2d(), sampler, active)
        # A throughput that is handed to roulette is no larger than one.
        β = dr.select(active, light * dr.select(most > 0, dr.rcp(most), 0), 0)
        factor = most * b.sin * b.inv_pdf / dr.square(b.dist)
        past = past_edge(context, b, ray, None, β, sampler, active)
        with dr.resume_grad():
            v_L = displacement(dr.gather(mi.Point3f, spots.spots.si.p, spots.index, active), active)
            speeds = sides_from(context, b, edges, v_L, behind(context, b, *past, active), mi.Float(0), active)
        τ = term.integrator.first_opl(term.film, rays) + mi.Float64(spot.leg)
        if not context.camera_unwarp:
            τ += mi.Float64(dr.norm(seen.p - ray.o) * η)
        # The spot is the vertex before the first one.
        first = {
            "ray": ray, "β": β, "η": η, "τ": τ, "prev_p": L, "prev_n": spot.n, "depth": 1, "active": active,
            "medium": None,
        }  # fmt: skip
        needed = None, mi.Bool(True)
        return both_sides(term.light_context, mode, sampler, view, b, past, first, factor, speeds, needed)


class ScanSampled(Connection):
    """Connection of a path that began at the laser's spot to the scanned point.

    Its length has the way from there to the sensor already. As in :class:`LaserSpot`, an event's depth is its number of
    bounces.
    """

    name = "scan_sampled"
    finds_light = False

    def look_at(self, seen: Any, ray: Any) -> None:
        """Set the scanned points (SurfaceInteraction3f) of a launch, and the rays of the sensor that see them."""
        self.seen, self.ray = seen, ray

    def propose(self, context: Any, path: Any, vertex: Any, sampler: Any) -> Proposal:
        active = context.deep_enough(vertex.goes_on & vertex.connectable, path.depth + 2)
        to = self.seen.p - vertex.at.p
        dist = dr.norm(to)
        active &= dist > 0
        d = to / dr.select(active, dist, 1)
        active &= dr.dot(d, vertex.at.n) != 0
        ds = Local(p=self.seen.p, n=self.seen.n, d=d, dist=dist, delta=mi.Bool(True), emitter=None)
        return Proposal(d=d, active=active, ds=ds, u=mi.Point2f(0), sampler=sampler)

    def connect(self, context: Any, path: Any, vertex: Any, proposal: Any, answer: Any, zeros: bool) -> Event:
        ds, active = proposal.ds, proposal.active
        seen = dr.copy(self.seen)
        seen.wi = seen.to_local(-self.ray.d)
        at_wall = seen.bsdf().eval(mi.BSDFContext(), seen, seen.to_local(-ds.d), active)
        value = product(vertex.β, product(answer.matrix, at_wall)) * dr.select(active, dr.rcp(dr.square(ds.dist)), 0)
        active &= dr.max(dr.abs(value)) > 0
        opl = vertex.scattered_τ + mi.Float64(ds.dist * vertex.η * answer.eta)
        active = context.counted(active, opl)
        active, _ = context.segment.transmittance(context, vertex, ds, proposal.u, proposal.sampler, active)
        return Event(value=value, opl=opl, active=active, depth=path.depth + 2)


class LateOutlines(BoundaryTerm):
    """Boundary term of a job of derivatives in light of ``FIRST`` and more bounces.

    Args:
        integrator, context, sensor, film, seed: integrator and context of the job, its sensor, film and seed.
        samples: edge samples per pixel of each pass.
    """

    can_be_recorded = False
    kinds: ClassVar[dict[str, Any]] = {"vertex": VertexPass, "spot": SpotPass}

    def __init__(self, integrator: Any, context: Any, sensor: Any, film: Any, seed: Any, samples: int) -> None:
        (spots,) = context.connections
        settings = integrator.settings()
        self.settings = replace(settings, min_depth=max(FIRST, settings.min_depth))
        _, scattering, _ = integrator.strategies(context.contents, spots.table)
        spots = LaserSpot(spots.table, spots.confocal, spots.legs)
        # Paths begin behind edges.
        spots.dark_at_first = False
        strategies = MaterialVacuum(), scattering, [spots]
        late = RenderContext(
            context.scene, context.contents, self.settings, strategies, context.wanted, context.window,
            context.velocities,
        )  # fmt: skip
        super().__init__(integrator, late, sensor, film, seed, samples, tuple(self.kinds))

    def _light_context(self) -> RenderContext:
        """Return the context of paths that start at the spot and are connected to the scanned point."""
        context = self.context
        scattering = Lambertian() if Lambertian.fits(context.contents) else Surface()
        if self.has_vertex_normals:
            scattering = FromLight(scattering)
        self.to_scan = ScanSampled()
        strategies = MaterialVacuum(), scattering, [self.to_scan]
        window, velocities = context.window, context.velocities
        return RenderContext(context.scene, context.contents, self.settings, strategies, None, window, velocities)

    def tables(self) -> list[Any]:
        return [*super().tables(), *(table for table in self.context.tables() if dr.grad_enabled(table))]


# ----------------------------------------------------------------------------------------------------------------------
# Choice of the boundary terms of a job of derivatives, and their gaps.

# Edge samples of a pixel and viewpoint, as a share of its paths.
SHARE = 4
# Viewpoints that the density of edges is made for.
MOST_REFERENCES = 25
_SEED = 0x85EBCA6B


def follows_outlines(segment: type, contents: Any) -> bool:
    """Return whether derivatives follow outlines.

    Args:
        segment: class of the job's segments; with material ones hidden points follow their shapes.
        contents: contents of the scene, in which nothing may scatter with a delay.
    """
    return issubclass(segment, MaterialVacuum) and contents.delays is None


def silhouettes(scene: Any, least: int, most: int) -> MovingEdges:
    """Return what derivatives lack where outlines are followed.

    Args:
        scene: built scene.
        least, most: numbers of bounces that are rendered.
    """
    words, always, bent = [], [], []
    if least <= BOUNCES <= most:
        alone = "" if most == BOUNCES else "in light of three bounces "
        words.append(f"{alone}behind shapes without triangles")
    if most >= BOUNCES:
        words.append("where bodies run into each other")
    if most >= FIRST:
        always, bent = rims_without_edges(scene), edges_in_mirrors(scene)
        if mi.is_polarized:
            where = "in polarized light of more than three bounces where one part hides another"
            always.append(Gap(where, "Set max_depth to 3."))
    return MovingEdges(always, bent, words=words)


class Viewpoints:
    """Viewpoints that hidden shapes are seen from: scanned points, then the laser's spots unless confocal.

    Attributes:
        p, n: places, and normals towards the viewer, (P, 3).
        references: numbers of the viewpoints that a density of edges is made for.
        shapes: registry numbers of the shapes that the viewpoints lie on.
    """

    def __init__(self, scanned: Any, spots: Any, confocal: bool) -> None:
        found = [_visible(scanned)] + ([] if confocal else [_visible(spots)])
        self.p, self.n = (np.concatenate([one[i] for one in found]) for i in range(2))
        # As many times as there are scanned points that stand for a scan, a single spot counts.
        few = [np.unique(np.linspace(0, len(one[0]) - 1, MOST_REFERENCES).astype(int)) for one in found if len(one[0])]
        picked = [np.resize(rows, MOST_REFERENCES) for rows in few]
        first = np.cumsum([0, *(len(one[0]) for one in found if len(one[0]))])
        index = np.concatenate([rows + start for rows, start in zip(picked, first, strict=False)]) if few else []
        self.references = np.asarray(index, dtype=int)
        self.shapes = set(np.unique(np.concatenate([one[2] for one in found])).tolist())


def _visible(si: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return places, normals towards the viewer and shapes of the valid interactions."""
    valid = np.array(si.is_valid())
    n = front_normal(si)
    n = dr.select(si.wi.z < 0, -n, n)
    numbers = np.array(dr.reinterpret_array(mi.UInt32, si.shape))
    return np.array(si.p, dtype=np.float64).T[valid], np.array(n, dtype=np.float64).T[valid], numbers[valid]


def mutual_occlusion(
    integrator: Any, context: Any, sensor: Any, film: Any, seed: Any, spp: int, scanned: Any
) -> MutualOcclusion | None:
    """Return the boundary term of a job of derivatives in light of three bounces, None if it is zero or not followed.

    Warns of shapes without edges that may hide another one.

    Args:
        integrator, context, sensor, film: integrator and context of the job, its sensor and film.
        seed: seed of the job.
        spp: samples per pixel of the job, 0 for the sampler's own; there is an edge sample for every ``SHARE`` of them.
        scanned: interactions of the scanned points, detached.
    """
    wanted = context.wanted
    if not (wanted.geometry and follows_outlines(type(context.segment), context.contents)):
        return None
    if not context.min_depth <= BOUNCES <= context.max_depth:
        return None
    moves_viewpoints = wanted.sensor or wanted.light
    if not (moves_viewpoints or wanted.shapes):
        return None
    (spots,) = context.connections
    viewpoints = Viewpoints(scanned, dr.detach(spots.spots.si), spots.confocal)
    shapes = list(context.scene.shapes())
    moving = {k for k, shape in enumerate(shapes) if shape.ptr in wanted.shapes}
    moves_viewpoints |= any(registry_number(shapes[k]) in viewpoints.shapes for k in moving)
    parts, triangles = parts_of(shapes)

    def is_requested(i: int, j: int) -> bool:
        return bool(moves_viewpoints or moving & parts[i].shapes or moving & parts[j].shapes)

    pairs = hiding_pairs(parts, viewpoints.p, is_requested)
    if not pairs:
        return None
    _warn_of_limbs(shapes, parts, pairs)
    hiders = sorted({i for i, _ in pairs if parts[i].edges is not None and len(parts[i].edges.ends)})
    if not hiders:
        return None
    rows = viewpoints.references
    edges = OutlineTable(triangles, [parts[i].edges for i in hiders], viewpoints.p[rows], viewpoints.n[rows])
    sampler = integrator.sampler_of(context.scene, sensor)
    count = spp or sampler.sample_count()
    own_seed, _ = mi.sample_tea_32(seed_array(seed), mi.UInt32(_SEED))
    jobs, _ = passes_of(sampler, film, own_seed, max(1, count // SHARE), 2)
    return MutualOcclusion(integrator, context, sensor, film, edges, spots, jobs)


def late_outlines(integrator: Any, context: Any, sensor: Any, film: Any, seed: Any, spp: int) -> LateOutlines | None:
    """Return the boundary term of light of more than three bounces.

    None if there is no such light, if nothing moves, or if the hidden scene is one body that cannot hide a part of
    itself.

    Args:
        integrator, context, sensor, film: integrator and context of the job, its sensor and film.
        seed: seed of the job.
        spp: samples per pixel of the job, 0 for the sampler's own, see :func:`mutual_occlusion`.
    """
    wanted = context.wanted
    if not (wanted.geometry and follows_outlines(type(context.segment), context.contents)) or mi.is_polarized:
        return None
    if context.max_depth < FIRST or not (wanted.sensor or wanted.light or wanted.shapes):
        return None
    (spots,) = context.connections
    wall = {shape.ptr for shape in spots.table.wall or ()}
    hidden = [shape for shape in context.scene.shapes() if shape.ptr not in wall]
    if wall and len(hidden) < 2:
        parts, _ = parts_of(hidden)
        if len(parts) < 2 and not any(part.hides_itself for part in parts):
            return None
    count = spp or sensor.sampler().sample_count()
    return LateOutlines(integrator, context, sensor, film, seed, max(1, count // SHARE))


def _names(shapes: list[Any], parts: list[Part], pairs: list[tuple[int, int]]) -> str:
    """Return up to three of the pairs in words."""

    def name(part: Part) -> str:
        return " and ".join(repr(shapes[k].id() or shapes[k].class_name()) for k in sorted(part.shapes))

    words = [
        f"{name(parts[i])} hides another part of itself" if name(parts[i]) == name(parts[j])
        else f"{name(parts[i])} hides {name(parts[j])}"
        for i, j in pairs
    ]  # fmt: skip
    words = list(dict.fromkeys(words))
    return ", ".join(words[:3]) + (f", and {len(words) - 3} more" if len(words) > 3 else "")


def _warn_of_limbs(shapes: list[Any], parts: list[Part], pairs: list[tuple[int, int]]) -> None:
    limbs = [(i, j) for i, j in pairs if parts[i].edges is None]
    if limbs:
        warnings.warn(
            "transient_nlos_path: outlines of shapes without triangles have no edges, and the derivative lacks what "
            f"changes behind them ({_names(shapes, parts, limbs)}). Use a mesh in place of the shape that hides.",
            GradientWarning,
            stacklevel=2,
        )
