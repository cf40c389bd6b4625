"""Light of a whole scan from shared samples and chains: conditions on the scene, densities, and the jobs."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.interfaces import CaptureType
from torchtransient.plugins.around_corner.geometry import WallPoints, points_of
from torchtransient.plugins.around_corner.late_light import LateLight
from torchtransient.plugins.around_corner.launches import ScanJob
from torchtransient.plugins.around_corner.scan_table import ACROSS, ScanTable
from torchtransient.plugins.around_corner.shafts import saves_time, spare_rays
from torchtransient.plugins.around_corner.third_bounce import ThirdBounce, add_exhaustive
from torchtransient.plugins.around_corner.third_bounce_gradients import (
    ThirdBounceGradients,
    ends_of_points,
    ends_of_samples,
)
from torchtransient.plugins.bsdfs.lambertian import is_lambertian
from torchtransient.plugins.cache import Cache, digest
from torchtransient.plugins.kernel_arrays import host_numbers
from torchtransient.plugins.node_walk import objects_below
from torchtransient.plugins.parameter_effect import class_of
from torchtransient.plugins.sampling.area_elements import can_be_listed, has_shading_normals
from torchtransient.plugins.sampling.hidden_elements import HiddenElements
from torchtransient.plugins.sampling.shared_samples import ScanTiles, distance_to, draw_samples
from torchtransient.plugins.transport.strategy import Local

# ----------------------------------------------------------------------------------------------------------------------
# Density of the heads of chains: proportional to light of four bounces, estimated from a pilot of a few thousand.

# Points of the pilot, and how many of them a weight is the mean of.
_POINTS, _BUCKET = 2**15, 64
_SEED = 0x70696C6F
# Share of the density before: light of more bounces comes from elsewhere, too, and must not weigh much.
_BEFORE = 0.4


def late_density(
    scene: Any, elements: HiddenElements, points: np.ndarray, normals: np.ndarray, memory: Cache | None = None
) -> HiddenElements:
    """Return the elements with the density of late light: proportional to the light by way of one more hidden point.

    That light is a root mean square over wall points and directions of scattering. Creases of a body weigh more than
    free surfaces, where no light is scattered twice. Neighbours have one weight per area, the mean of some samples, and
    a share of the density stays that of ``elements``.

    Args:
        scene: built scene.
        elements: table of the hidden elements.
        points, normals: wall points and their normals, (P, 3).
        memory: cache of densities by ``elements.key``, None without one.
    """
    s = draw_samples(elements, _POINTS, _SEED)
    # The side that faces the scan: of two-sided surfaces it counts most.
    center = mi.Point3f(*np.mean(points, axis=0).tolist())
    dr.make_opaque(center)
    n = mi.Vector3f(s.geometric_n)
    n = dr.mulsign(n, dr.dot(n, center - s.p))
    lit = dr.dot(n, mi.Vector3f(s.geometric_n)) > 0
    lit = dr.select(lit, dr.max(s.front), dr.max(s.back)) > 0

    def made() -> HiddenElements:
        return _density(scene, elements, (points, normals), s, (center, n, lit))

    if memory is None or not elements.key:
        return made()
    # Of what surfaces scatter it matters whether they do.
    return memory.get("late density", elements.key + digest(np.array(lit)), made)


def _density(scene: Any, elements: HiddenElements, wall: tuple[np.ndarray, np.ndarray], s: Any, side: Any) -> Any:
    """Density of hidden points in late light.

    ``side``: the middle of the scan, normals towards it, and a mask of points that scatter there.
    """
    points, normals = wall
    center, n, lit = side
    numbers = np.random.default_rng(_SEED).random((2, _POINTS)).astype(np.float32)
    d = mi.Frame3f(mi.Normal3f(n)).to_world(mi.warp.square_to_cosine_hemisphere(mi.Point2f(numbers)))
    reach = dr.max(dr.abs(s.p)) + dr.norm(center - s.p)
    ray = mi.Ray3f(mi.Point3f(s.p + n * (mi.math.RayEpsilon * reach)), d)
    pi = scene.ray_intersect_preliminary(ray, coherent=False, active=lit)
    si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, lit)
    lit &= si.is_valid()
    there = mi.Vector3f(dr.select(dr.dot(si.n, d) < 0, si.n, -si.n))
    wall = Local(p=mi.Point3f(points.T), n=mi.Vector3f(normals.T))
    dr.make_opaque(wall.p, wall.n)
    square = mi.Float(0)
    for i in range(len(points)):
        q, m = dr.gather(mi.Point3f, wall.p, i), dr.gather(mi.Vector3f, wall.n, i)
        square += dr.square(_factor(s.p, n, q, m) * _factor(si.p, there, q, m))
    square, stands_for, element = (np.array(a) for a in (dr.select(lit, square, 0), s.weight, s.element))
    return elements.reweighted(_smoothed(elements, square.astype(np.float64), stands_for.astype(np.float64), element))


def _factor(p: Any, n: Any, q: Any, m: Any) -> Any:
    """Return cosines over the squared distance of two points with their normals."""
    d = mi.Vector3f(q - p)
    inverse = dr.rcp(dr.squared_norm(d))
    return dr.maximum(dr.dot(n, d), 0) * dr.maximum(-dr.dot(m, d), 0) * dr.square(inverse)


def _smoothed(elements: HiddenElements, square: np.ndarray, area: np.ndarray, element: np.ndarray) -> np.ndarray:
    """Return weights (1, E) of elements; ``square``, ``area``, ``element``: of samples, the area that each stands for.

    Elements next to each other in the table are neighbours in space.
    """
    size = len(elements.elements)
    drawn = np.bincount(element, minlength=size)
    bucket = (np.cumsum(drawn) - drawn) // _BUCKET
    total, covered = (np.bincount(bucket, np.bincount(element, w, size)) for w in (square * area, area))
    rms = np.sqrt(total / np.where(covered > 0, covered, 1))
    learned = rms[bucket] * elements.elements.area
    before = elements.probabilities[0]
    return (learned * ((1 - _BEFORE) / max(learned.sum(), 1e-300)) + _BEFORE * before / before.sum())[None]


# ----------------------------------------------------------------------------------------------------------------------


def why_not(table: ScanTable, contents: Any, with_wall: bool) -> str | None:
    """Return the reason why a scene cannot have shared samples, None if it can.

    Args:
        table: scanned points and laser spots.
        contents: contents of the scene.
        with_wall: points are drawn on the wall as well.
    """
    scene, sensor = table.scene, table.sensor
    if mi.is_spectral or mi.is_polarized:
        return f"the variant {mi.variant()} gives every path wavelengths or a polarization of its own"
    if sensor.film().exhaustive_scan and sensor.film().lanes_at_most(1) is not None:
        return f"the film of an exhaustive capture is a {sensor.film().plugin}, which lists events"
    if not table.looks_at_points:
        return f"the sensor ({class_of(sensor)}) is no nlos_capture_meter, whose pixels are points"
    if contents.media is not None:
        return "there are participating media"
    if contents.delays is not None or contents.mixtures is not None:
        return "some surfaces scatter late, or are mixtures"
    others = [bsdf.id() or bsdf.class_name() for bsdf in contents.bsdfs if not is_lambertian(bsdf)]
    if others:
        return f"not all surfaces are diffuse ({', '.join(others[:3])})"
    wall = sensor.get_shape()
    if wall is not None and has_shading_normals(wall):
        return f"normals are interpolated on the relay wall ({wall.id() or class_of(wall)})"
    unlisted = [shape.id() or shape.class_name() for shape in scene.shapes() if not can_be_listed(shape)]
    if unlisted:
        return f"points cannot be drawn on {', '.join(unlisted[:3])}"
    overlapping = table.overlaps(with_wall)
    if overlapping:
        return f"some surfaces lie in others, and areas would count twice ({', '.join(overlapping[:3])})"
    return None


@dataclass
class ScanLight:
    """Wall points of a capture, attached where the scene's parameters are.

    Attributes:
        sensors: the scanned points.
        spots: the laser's spots, the same object where every spot is a scanned point.
        energy: energy of the laser by colour (UnpolarizedSpectrum, J).
    """

    sensors: WallPoints
    spots: WallPoints
    energy: Any


def scan_light(table: ScanTable, capture: CaptureType, legs: bool) -> ScanLight:
    """Return the :class:`ScanLight` of the scene as it is now.

    Args:
        table: scanned points and laser spots.
        capture: type of the capture.
        legs: the ways from laser to spot and from scanned point to sensor count.
    """
    origin, spots, seen = mi.Point3f(table.sensor.origin), table.spots, table.interactions()
    looked_at = points_of(seen, dr.inv_pi, dr.norm(seen.p - origin) if legs else mi.Float(0))
    if not hasattr(spots.emitter, "energy_at"):
        return ScanLight(looked_at, spots.points(legs), mi.UnpolarizedSpectrum(1))
    energy = spots.emitter.energy_at([], True)
    same_legs = not legs or bool(dr.all(spots.origin == origin))
    if capture is CaptureType.EXHAUSTIVE and same_legs and _same(spots.lit_interactions(), seen):
        return ScanLight(looked_at, looked_at, energy)
    return ScanLight(looked_at, spots.points(legs, energy=False), energy)


def _same(spots: Any, points: Any) -> bool:
    """Return whether laser spots are the scanned points themselves, on the same side of the wall."""
    if dr.width(spots.p) != dr.width(points.p):
        return False
    near = dr.norm(spots.p - points.p) <= 1e-6 * (1 + dr.norm(points.p))
    return bool(dr.all(near & (spots.wi.z * points.wi.z > 0) & spots.is_valid() & points.is_valid()))


def _moves(context: Any, shapes: list[Any]) -> bool:
    """Return whether derivatives are requested by parameters of ``shapes``, or of plugins inside them."""
    held = {node.ptr for shape in shapes for node in [shape, *objects_below(shape, mi.Object)]}
    return bool(held & context.wanted.nodes)


def moves_scan(context: Any, hidden: list[Any]) -> bool:
    """Return whether derivatives are requested by wall, sensor or laser.

    Args:
        context: context of the job.
        hidden: shapes that do not count, with the plugins inside them.
    """
    others = [shape for shape in context.scene.shapes() if shape.ptr not in {one.ptr for one in hidden}]
    held = {node.ptr for shape in hidden for node in [shape, *objects_below(shape, mi.Object)]}
    return bool(context.wanted.nodes - held) or _moves(context, others)


def _rows(vectors: Any, width: int) -> np.ndarray:
    """Return (width, 3), detached."""
    return np.broadcast_to(host_numbers(vectors).T, (width, 3))


def add_late_light(table: ScanTable, film: Any, job: Any, bounces: range, run: Any) -> None:
    """Add late light to a film.

    Args:
        table: scanned points and laser spots.
        film: film of the capture.
        job: has ``light`` (:class:`ScanLight`), ``elements`` and ``capture``.
        bounces: numbers of bounces.
        run: has ``seed``, ``samples`` (chains of a tile) and ``progress``.
    """
    elements = late_density(table.scene, job.elements, *table.reference_points(), table.memory)
    film_job = ScanJob(table.scene, film, job.light.sensors, job.light.energy, run.progress)
    ends = bounces[0], bounces[-1]
    LateLight(film_job, elements, job.light.spots, job.capture, ends).add(run.samples, run.seed)


class SharedThirdBounce:
    """Light of three bounces of one job from shared samples: its render, or its derivatives (confocal and single).

    Args:
        context: context of the job.
        film: film of the job.
        light: wall points of the capture, attached where the scene is.
        elements: table of the hidden elements.
        capture: type of the capture.
        draw: seed and number of samples.
    """

    can_be_recorded = False

    def __init__(
        self,
        context: Any,
        film: Any,
        light: ScanLight,
        elements: HiddenElements,
        capture: CaptureType,
        draw: tuple[Any, int],
    ) -> None:
        self.context, self.film, self.light, self.capture = context, film, light, capture
        self.tile = None
        if context.wanted is None and capture is not CaptureType.EXHAUSTIVE:
            elements = self._near(elements)
        self._spare_rays(elements, draw[1] * elements.tile_count)
        self.samples = draw_samples(elements, draw[1], draw[0])
        self.gradients = None
        if context.wanted is not None:
            laser = None if capture is CaptureType.CONFOCAL else light.spots
            with dr.resume_grad():
                samples = ends_of_samples(context.scene, elements, self.samples, context.contents.meshes, laser)
                points = ends_of_points(light.sensors, light.spots, light.energy)
            # Forward mode has to pass by all that is attached, wanted or not.
            self._tables = [ends.fields[n] for ends in (samples, points) for n in ends.fields]
            self._tables += [*vars(light.sensors).values(), *vars(light.spots).values(), light.energy]
            scan = moves_scan(context, elements.shapes)
            if not scan:
                points = points.detached()
            # What a single spot lights follows the spot.
            if not (_moves(context, elements.shapes) or (scan and laser is not None)):
                samples = samples.detached()
            self.gradients = ThirdBounceGradients(context.scene, film, samples, points, self.samples.clear)

    def _near(self, elements: HiddenElements) -> HiddenElements:
        """Return elements with a density for each tile of the scan, if hidden ones are nearer than half its width."""
        p, n = (_rows(getattr(self.light.sensors, name), self.light.sensors.width) for name in "pn")
        some = np.linspace(0, len(p) - 1, min(len(p), ACROSS**2)).round().astype(int)
        tiles = ScanTiles(p, n, distance_to(elements.elements.centers(), p[some]))
        if tiles.count == 1:
            return elements
        self.tile = tiles.tile_per_point()
        memory = self.context.contents.memory
        return copy(HiddenElements.cached(memory, elements.shapes, tiles.points, tiles.normals))

    def _spare_rays(self, elements: HiddenElements, samples: int) -> None:
        """Leave out rays to elements that nothing hides, if these are found faster than rays are traced."""
        points = (
            [self.light.sensors] if self.light.spots is self.light.sensors else [self.light.sensors, self.light.spots]
        )
        if saves_time(self.context.scene, samples * sum(each.width for each in points)):
            p, n = (np.concatenate([_rows(getattr(each, name), each.width) for each in points]) for name in "pn")
            spare_rays(self.context.scene, elements, p, n)

    def add(self, progress: Any = None) -> None:
        """Add the light to the film."""
        light = self.light
        scene = self.context.scene
        third = ThirdBounce(scene, self.film, self.samples, light.sensors, light.energy, progress, self.tile)
        if self.capture is CaptureType.CONFOCAL:
            third.add_confocal(self.light.spots)
        elif self.capture is CaptureType.SINGLE:
            third.add_single(self.light.spots)
        elif self.capture is CaptureType.PAIRS:
            third.add_pairs(self.light.spots)
        else:
            add_exhaustive(third, self.light.spots)

    def tables(self) -> list[Any]:
        """Return the attached arrays that were computed from the scene's parameters."""
        with dr.resume_grad():
            return [table for table in self._tables if dr.is_array_v(table) and dr.grad_enabled(table)]

    def backward(self, incoming: Any) -> None:
        """Add gradients to the attached parameters; ``incoming``: the film's adjoint."""
        self.gradients.backward(incoming)

    def forward(self) -> None:
        """Add the derivative along the scene's tangents to the film."""
        self.gradients.forward()
