"""``transient_nlos_path``: light around the corner, from a laser spot on a relay wall back to points of the wall."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.errors import SceneError
from torchtransient.interfaces import CaptureType
from torchtransient.plugins._registry import register
from torchtransient.plugins.around_corner.division import BOUNCES, Division
from torchtransient.plugins.around_corner.late_light import FIRST, MOST
from torchtransient.plugins.around_corner.occlusion import (
    follows_outlines,
    late_outlines,
    mutual_occlusion,
    silhouettes,
)
from torchtransient.plugins.around_corner.scan_table import ScanTable, capture_type, laser_of, scan_rays
from torchtransient.plugins.around_corner.shared_light import (
    SharedThirdBounce,
    add_late_light,
    scan_light,
    why_not,
)
from torchtransient.plugins.integrators import base
from torchtransient.plugins.integrators.base import UNLIMITED
from torchtransient.plugins.properties import number, truth, whole_number
from torchtransient.plugins.sampling.hidden_elements import HiddenElements
from torchtransient.plugins.transport.boundary.moving_edges import MovingEdges, missing, switched_off
from torchtransient.plugins.transport.context import PathSettings, RenderContext
from torchtransient.plugins.transport.emitter_connections import EmitterFound, EmitterSampled
from torchtransient.plugins.transport.laser_spot import LaserSpot
from torchtransient.plugins.transport.material_points import FoundVacuum, MaterialVacuum
from torchtransient.plugins.transport.media import Media
from torchtransient.plugins.transport.medium_scattering import SurfaceOrMedium
from torchtransient.plugins.transport.strategy import Guide, GuidedPoint, Local
from torchtransient.plugins.transport.surface_scattering import Lambertian, Surface
from torchtransient.plugins.transport.vacuum import Vacuum

# Share of the samples drawn over the hidden area: at the relay wall, and beyond it.
AT_WALL, BEYOND = 0.9, 0.25
_EVERY_PAIR = (CaptureType.EXHAUSTIVE, CaptureType.PAIRS)
NOT_FLAT = (
    "the wall is not flat, or scanned points and laser spots lie off it, and points of walls that see each other from "
    "nearby weigh without bound"
)


class HiddenGeometry(Guide):
    """Guide that draws points on hidden surfaces, more of them where the relay wall sees most of the light.

    Hidden surfaces light each other best as their BSDFs say, so ``beyond`` is small, and less than one since a body
    close to another one would have no bounded variance.

    Args:
        elements: :class:`~torchtransient.plugins.sampling.hidden_elements.HiddenElements` of the job.
        at_wall: share of the samples that leave the first vertex.
        beyond: share of the others.
    """

    name = "hidden_geometry"

    def __init__(self, elements, at_wall, beyond):
        self.elements, self.at_wall, self.share = elements, at_wall, beyond

    def share_at(self, depth):
        return dr.select(depth == 0, mi.Float(self.at_wall), mi.Float(self.share))

    def draw(self, context, vertex, x, y):
        p, n, uv, shape, primitive = self.elements.draw_with_surface(x, y, vertex.goes_on)
        return GuidedPoint(p, shape, primitive, n, uv)

    def density(self, context, p, q, n, shape, active, primitive=None):
        v = dr.select(active, q - p, mi.Vector3f(0, 0, 1))
        if primitive is None:  # a light was asked for a point of its shape, and does not say of which triangle
            ray = mi.Ray3f(mi.Point3f(p), dr.normalize(v))
            with dr.suspend_grad():
                found = context.segment.next_surface(context, ray, active)
            # Of what is hidden from there, any triangle will do.
            primitive = dr.select(active & (found.shape == shape), found.prim_index, 0)
        per_area = self.elements.per_area(shape, primitive, q, active)
        d2 = dr.squared_norm(v)
        cos = dr.abs_dot(n, v) * dr.rsqrt(d2)
        return dr.select(active & (cos > 0), per_area * d2 / cos, 0)


class TransientNLOSPath(base.TransientIntegrator):
    r"""Time-resolved path tracer for non-line-of-sight scenes (:monosp:`transient_nlos_path`).

    Parameters beside those of :class:`TransientIntegrator`:

    ``capture_type`` (``single`` | ``confocal`` | ``exhaustive`` | ``pairs``, or 1 to 4; single)
        One laser spot for all scanned points; the spot follows the scanned point; every laser position for every
        scanned point (the film needs ``exhaustive_scan``); one of ``laser_points`` for each scanned point.
    ``account_first_and_last_bounces`` (bool, false)
        Whether the way from the laser to its spot and from the scanned point to the sensor counts in time.
    ``filter_bounces`` (int, -1)
        Keep only light of so many bounces: 1 is what the laser lights, 2 goes from wall to wall, 3 is light around one
        corner. -1 keeps all. (In mitransient 1.x, ``filter_bounces = b`` keeps paths of ``b + 1`` bounces.)
    ``min_bounces`` (int, 0): leave out light of fewer bounces.
    ``filter_depth`` (int, -1)
        Keep only light of the depth that ``max_depth`` counts: with ``nlos_laser_sampling`` a depth is a number of
        bounces, as in mitransient; without it, as for Mitsuba's other integrators, one more.
    ``discard_direct_paths`` (bool, false): leave out light of one bounce.
    ``nlos_laser_sampling`` (bool, false)
        Connect every vertex to the laser's spot. Without it lights are sampled as in ``transient_path``, and a laser's
        spot is found by paths that hit it.
    ``nlos_hidden_geometry_sampling`` (bool, false)
        Draw next vertices over the area of the hidden surfaces, weighed against the BSDF's own samples by their
        densities; points that something hides do not count.
    ``nlos_hidden_geometry_sampling_do_rroulette`` (bool, false)
        Share the samples equally between the two everywhere, instead of mostly hidden area at the wall.
    ``nlos_hidden_geometry_sampling_includes_relay_wall`` (bool, false): draw points of the relay wall, too.
    ``third_bounce`` (``auto`` | ``shared`` | ``paths``; auto)
        Light of three bounces from hidden samples that all scanned points share (:mod:`..around_corner.third_bounce`),
        which costs less, or from paths like all other light. ``auto`` shares where ``nlos_laser_sampling`` and
        ``nlos_hidden_geometry_sampling`` are on and the scene allows it: everything diffuse, no media, points that can
        be drawn on every hidden shape, no surface in another, an ``nlos_capture_meter``, one flat wall that scan and
        laser meet, and a variant without wavelengths and polarization. Both have the same mean. Where a wall lights
        itself, points of it next to a scanned one weigh without bound, and ``auto`` takes paths. So do derivatives of
        exhaustive captures and of pairs.
    ``late_light`` (``auto`` | ``chains`` | ``paths``; auto)
        Light of four to seven bounces from chains that scanned points far from each other share
        (:mod:`..around_corner.late_light`), or from paths, as light of more bounces is. ``auto`` chooses as for
        ``third_bounce``; both have the same mean, and derivatives come from paths. So does late light of pairs.
    ``boundary`` (bool, true)
        False leaves the boundary term of hidden shapes that hide one another out of derivatives. Samples of edges are a
        quarter of the paths, for light of three bounces and twice for that of more.
    ``force_equal_illumination_scanning`` (bool, true), ``illumination_scan_fov`` (degrees, 20)
        Whether the laser positions of an exhaustive capture are the scanned points; if not, they lie on a grid of this
        horizontal field of view around the laser's axis.

    ``max_depth`` is the largest number of bounces with ``nlos_laser_sampling``: 3 for light around one corner, as in
    mitransient. Without it the light's own way is a segment more, as in ``transient_path``.

    Sensors: ``nlos_capture_meter``, whose samples of a pixel look all at one point, and any other (single captures, and
    confocal ones, whose spots lie at pixel centres).

    Gradients in both modes as in :class:`TransientIntegrator`.

    Not supported: light that comes from the spot through smooth glass or by way of a mirror, which no connection finds
    (as that of point lights elsewhere).
    """

    walks_through_media = True
    # All points of a wall share what is sampled of the hidden scene.
    pixels_are_independent = False
    scans_exhaustively = True

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        if self.camera_unwarp:
            raise SceneError(
                "transient_nlos_path: camera_unwarp is account_first_and_last_bounces here; set that to false instead."
            )
        self.capture = capture_type(props.get("capture_type", "single"))
        self.legs = truth(props, "account_first_and_last_bounces", default=False)
        self.camera_unwarp = not self.legs
        self.laser_sampling = truth(props, "nlos_laser_sampling", default=False)
        self.hidden_sampling = truth(props, "nlos_hidden_geometry_sampling", default=False)
        self.equal_shares = truth(props, "nlos_hidden_geometry_sampling_do_rroulette", default=False)
        self.samples_wall = truth(props, "nlos_hidden_geometry_sampling_includes_relay_wall", default=False)
        self.equal_grids = truth(props, "force_equal_illumination_scanning", default=True)
        self.laser_fov = number(props, "illumination_scan_fov", 20.0)
        self.discard_direct_paths = truth(props, "discard_direct_paths", default=False)
        self.third_bounce = _choice(props, "third_bounce", "shared")
        self.late_light = _choice(props, "late_light", "chains")
        self.boundary = truth(props, "boundary", default=True)
        props.get("block_size", 0)
        self.min_bounces = whole_number(props, "min_bounces", 0, least=0)
        self.only_bounces = self._bounces_of(props)
        settings = self.settings()
        if self.only_bounces is not None and self.only_bounces < self._fewest():
            raise SceneError(
                f"transient_nlos_path: filter_bounces chooses light of {self.only_bounces} bounces, which min_bounces "
                "or discard_direct_paths leaves out: the picture would be black."
            )
        if settings.min_depth > settings.max_depth:
            raise SceneError(
                f"transient_nlos_path: min_bounces {self._fewest()} needs max_depth {settings.min_depth} at least, "
                f"got {self.max_depth}: the picture would be black."
            )

    def _fewest(self) -> int:
        return max(2 if self.discard_direct_paths else 0, self.min_bounces)

    def _bounces_of(self, props: Any) -> int | None:
        depth, bounces = whole_number(props, "filter_depth", -1), whole_number(props, "filter_bounces", -1)
        if depth != -1 and bounces != -1:
            raise SceneError("transient_nlos_path: filter_depth and filter_bounces choose the same: give one of them.")
        if depth != -1:
            bounces = depth if self.laser_sampling else depth - 1
        if bounces == -1 and depth == -1:
            return None
        if bounces < 1:
            raise SceneError(
                "transient_nlos_path: filter_bounces, filter_depth: expected -1, or a number that leaves light of at "
                f"least one bounce, got {bounces} bounces."
            )
        depth = bounces if self.laser_sampling else bounces + 1
        if depth > self.max_depth:
            raise SceneError(
                f"transient_nlos_path: light of {bounces} bounces has depth {depth}, which max_depth {self.max_depth} "
                f"leaves out: the picture would be black. Set max_depth to at least {depth}."
            )
        return bounces

    # ----------------------------------------------------------------------------------- preparation

    def resolve(self, scene: Any, sensor: Any) -> Any:
        sensor, film = super().resolve(scene, sensor)
        exhaustive = self.capture is CaptureType.EXHAUSTIVE
        if exhaustive != film.exhaustive_scan:
            raise SceneError(
                f"transient_nlos_path: expected a film with exhaustive_scan = {str(exhaustive).lower()} for capture "
                f"type {self.capture.name.lower()}, got {str(film.exhaustive_scan).lower()}."
            )
        if self.capture in _EVERY_PAIR and not self.laser_sampling:
            kind = self.capture.name.lower()
            raise SceneError(f"transient_nlos_path: {kind} captures need nlos_laser_sampling; set it to true.")
        if self.capture is CaptureType.PAIRS and self.late_light == "chains":
            raise SceneError("transient_nlos_path: late_light is 'chains', which pairs do not share; set it to 'auto'.")
        if self.laser_sampling:
            laser_of(scene)
        return sensor, film

    @property
    def aims_lasers(self) -> bool:
        """True if beams without width are seen."""
        return self.laser_sampling

    def settings(self) -> PathSettings:
        first, last = self._fewest(), None
        if self.only_bounces is not None:
            first = last = self.only_bounces
        most = self.max_depth if last is None else last + self._light_segments
        least = first + self._light_segments if first else 0
        return PathSettings(
            most, self.rr_depth, bool(self.hide_emitters), bool(self.discard_direct_light), not self.legs, least
        )

    @property
    def _light_segments(self) -> int:
        """By how much depths exceed numbers of bounces: where lights are sampled, their own way is a segment."""
        return 0 if self.laser_sampling else 1

    def asked_bounces(self) -> tuple[int, int | None]:
        """Return the smallest and the largest number of bounces whose light is wanted, the latter None without a limit.
        """
        settings, light = self.settings(), self._light_segments
        most = None if settings.max_depth == UNLIMITED else settings.max_depth - light
        return max(settings.min_depth - light, 0), most

    def scan_table(self, scene: Any, contents: Any) -> ScanTable:
        """Return the scanned points and laser spots of a job."""
        fov = None if self.equal_grids or self.capture is not CaptureType.EXHAUSTIVE else self.laser_fov
        with dr.resume_grad():
            return ScanTable(scene, contents, self.capture, fov, self.laser_sampling)

    def division(self, scene: Any, contents: Any, wanted: Any = None, table: Any = None) -> Division:
        """Return the division of light among estimators.

        Args:
            scene: Mitsuba scene.
            contents: contents of the scene.
            wanted: derivatives of the job, None in a render.
            table: :class:`ScanTable` of the job, where it is known.

        Raises:
            SceneError: where light has to come from shared samples and cannot.
        """
        settings = self.settings()
        asked = {"third_bounce": (self.third_bounce, BOUNCES, BOUNCES), "late_light": (self.late_light, FIRST, MOST)}
        if wanted is not None or self.capture is CaptureType.PAIRS:  # chains have no derivatives, and no spot a point
            del asked["late_light"]
        if wanted is not None and self.capture in _EVERY_PAIR:  # nor have shared samples
            asked = {}
        ranges = {
            name: (choice, range(max(first, settings.min_depth), min(last, settings.max_depth) + 1))
            for name, (choice, first, last) in asked.items()
            if choice != "paths"
        }
        ranges = {name: found for name, found in ranges.items() if found[1]}
        from_paths = Division(range(0), settings.max_depth)
        if not ranges:
            return from_paths
        if self.laser_sampling and self.hidden_sampling and not self.equal_shares:
            table = table or self.scan_table(scene, contents)
            reason = why_not(table, contents, self.samples_wall)
        else:
            reason = "nlos_laser_sampling and nlos_hidden_geometry_sampling are not on alone"
        for name, (choice, _) in ranges.items():
            if reason and choice != "auto":
                raise SceneError(f"transient_nlos_path: {name} is {choice!r}, but {reason}. Set it to 'auto'.")
        if reason:
            return replace(from_paths, why_not=reason)
        wall = table.wall
        shared = [found for choice, found in ranges.values() if wall is not None or choice != "auto"]
        if not shared:
            return replace(from_paths, why_not=NOT_FLAT)
        bounces = range(shared[0].start, shared[-1].stop)
        division = Division.of(bounces, settings.min_depth, settings.max_depth, wall is None)
        return division if wall is not None else replace(division, why_not=NOT_FLAT)

    def render_context(
        self, scene: Any, contents: Any, wanted: Any = None, window: Any = None, settings: Any = None,
        velocities: Any = None,
    ) -> Any:
        table = self.scan_table(scene, contents)
        if settings is None:
            settings = self.settings()
            if velocities is None:
                division = self.division(scene, contents, wanted, table)
            else:  # what a scan shares knows no rates
                division = Division(range(0), settings.max_depth)
                _check_rest(scene, velocities, contents.sensor, table)
            # Paths that have nothing to find beyond end before.
            most = settings.max_depth if wanted is not None else max(division.longest, 1)
            settings = replace(settings, division=division, max_depth=most)
        return RenderContext(scene, contents, settings, self.strategies(contents, table), wanted, window, velocities)

    def shared_light(self, context: Any, film: Any) -> Any:
        division, parts = context.division, []
        if division.third_bounce:
            parts.append(lambda job: self._shared(context, film, job.seed, job.samples).add(job.progress))
        if division.chained:
            table = self._table(context)
            scan = Local(light=self._light(table), elements=self._elements(context), capture=self.capture)
            parts.append(lambda job: add_late_light(table, film, scan, division.chained, job))
        return parts

    def refusal_of(self, job: Any) -> str | None:
        if job.context.wanted is None and (job.context.division.third_bounce or job.context.division.chained):
            return "samples that a scan shares are drawn by reading numbers of the scene"
        return super().refusal_of(job)

    def strategies(self, contents: Any, table: ScanTable) -> Any:
        guides = self._guides(contents, table)
        in_media = contents.media is not None
        surface = Lambertian if Lambertian.fits(contents) else Surface
        scattering = SurfaceOrMedium(guides) if in_media else surface(guides)
        segment = self._segment(contents)
        if segment is not FoundVacuum:
            return segment(), scattering, self._connections(table)
        overlaps = table.overlaps(self.samples_wall)
        return FoundVacuum(bool(overlaps)), scattering, self._connections(table)

    def _segment(self, contents: Any) -> type:
        if contents.media is not None:
            return Media
        # Instances, and what Mitsuba leaves detached, are attached along rays alone.
        along_rays = contents.instances is not None or contents.detached_hits is not None
        if along_rays or not self.laser_sampling:
            return Vacuum
        return FoundVacuum if self.hidden_sampling else MaterialVacuum

    def _connections(self, table: ScanTable) -> list[Any]:
        if not self.laser_sampling:
            return [EmitterFound(), EmitterSampled()]
        return [LaserSpot(table, self.capture is CaptureType.CONFOCAL, self.legs)]

    def _guides(self, contents: Any, table: ScanTable) -> list[HiddenGeometry]:
        if not self.hidden_sampling:
            return []
        wall = contents.sensor.get_shape()
        without = [] if self.samples_wall or wall is None else [wall]
        shares = (0.5, 0.5) if self.equal_shares or contents.media is not None else (AT_WALL, BEYOND)
        return [HiddenGeometry(table.elements(without), *shares)]

    # ----------------------------------------------------------------------------------- primary rays

    def offset_in_pixel(self, film: Any, sensor: Any, sampler: Any) -> Any:
        if hasattr(sensor, "scanned"):  # a scan looks at points
            return mi.Point2f(0), None
        return super().offset_in_pixel(film, sensor, sampler)

    def start(self, scene: Any, contents: Any, sensor: Any, film: Any, job: Any) -> Any:
        rays = super().start(scene, contents, sensor, film, job)
        # A pilot run has a smaller film than the sensor, and one laser position a path.
        width, height = (int(n) for n in sensor.film().crop_size())
        columns, rows = (int(n) for n in film.crop_size())
        row, column = rays.row, rays.column
        if (columns, rows) != (width, height):
            row, column = (2 * row + 1) * height // (2 * rows), (2 * column + 1) * width // (2 * columns)
        pixel = row * width + column
        if hasattr(sensor, "scanned") and contents.media is None:
            rays.leg = dr.gather(mi.PreliminaryIntersection3f, _scanned(scene, sensor), pixel)
        laser = rays.laser
        if self.capture is CaptureType.EXHAUSTIVE and laser is None:
            count = sensor.film().laser_count()
            laser = dr.minimum(mi.UInt32(rays.sampler.next_1d() * count), count - 1)
        rays.spot = {CaptureType.SINGLE: mi.UInt32(0), CaptureType.EXHAUSTIVE: laser}.get(self.capture, pixel)
        return rays

    # ----------------------------------------------------------------------------------- derivatives

    def silhouettes(self, scene: Any, sensors: Any = None) -> MovingEdges:
        if not self.boundary:
            return switched_off()
        sensors = scene.sensors() if sensors is None else sensors
        contents = self.contents(scene, sensors[0]) if sensors else None
        if contents is None or not follows_outlines(self._segment(contents), contents):
            return missing(
                "transient_nlos_path follows them with nlos_laser_sampling, in scenes without media, instances, "
                "ellipsoids, linear curves and surfaces that scatter late",
                "Use a mesh, or leave out what is named.",
            )
        settings = self.settings()
        return silhouettes(scene, settings.min_depth, settings.max_depth)

    def beside(self, context: Any, sensor: Any, film: Any, seed: Any, samples: int) -> list[Any]:
        if not self.laser_sampling:
            return []
        shared = [self._shared(context, film, seed, samples)] if context.division.third_bounce else []
        if not self.boundary:
            return shared
        scanned = dr.detach(self._table(context).interactions())
        edges = mutual_occlusion(self, context, sensor, film, seed, samples, scanned)
        late = late_outlines(self, context, sensor, film, seed, samples)
        return shared + [term for term in (edges, late) if term is not None]

    @staticmethod
    def _table(context: Any) -> ScanTable:
        return next(c.table for c in context.connections if isinstance(c, LaserSpot))

    def _light(self, table: ScanTable) -> Any:
        with dr.resume_grad():
            return scan_light(table, self.capture, self.legs)

    def _elements(self, context: Any) -> HiddenElements:
        """Hidden points as shared samples draw them: on the wall, too, where it lights itself."""
        table = self._table(context)
        # A copy, of which elements may be put in another order.
        return copy(table.elements([] if self.samples_wall or table.wall is None else table.wall))

    def _shared(self, context: Any, film: Any, seed: Any, samples: int) -> SharedThirdBounce:
        light, elements = self._light(self._table(context)), self._elements(context)
        return SharedThirdBounce(context, film, light, elements, self.capture, (seed, samples))


def _choice(props: Any, name: str, shared: str) -> str:
    value = str(props.get(name, "auto"))
    if value not in ("auto", shared, "paths"):
        raise SceneError(f"transient_nlos_path: {name}: expected auto, {shared} or paths, got {value!r}.")
    return value


def _check_rest(scene: Any, velocities: Any, sensor: Any, table: ScanTable) -> None:
    """Raise SceneError for a wall, a sensor or a laser with a velocity: spots would slide over the wall."""
    wall, lit = sensor.get_shape(), [] if table.spots is None else [table.spots.shape]
    moves = velocities.sensor_moves or any(getattr(light, "needs_aim", False) for light in velocities.lights)
    for shape in filter(velocities.moves, scene.shapes()):
        moves |= wall is not None and shape.ptr == wall.ptr
        moves |= any(bool(dr.any(spots == mi.ShapePtr(shape))) for spots in lit)
    if moves:
        raise SceneError(
            "transient_nlos_path: expected velocities of hidden things; the wall, its sensor and the laser rest."
        )


def _scanned(scene: Any, sensor: Any) -> Any:
    """Return the intersections of the rays of a scan, one for each pixel: all samples of a pixel look at one point."""
    found = scene.ray_intersect_preliminary(scan_rays(sensor), coherent=True)
    dr.eval(found)
    return found


register("integrator", "transient_nlos_path", TransientNLOSPath)
