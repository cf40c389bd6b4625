"""Light of a whole scan from shared samples and chains: what it needs of a scene, and when it is possible."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.interfaces import CaptureType
from torchtransient.plugins.around_corner.attached import ends_of_points, ends_of_samples
from torchtransient.plugins.around_corner.exhaustive import add_exhaustive
from torchtransient.plugins.around_corner.late_density import late_density
from torchtransient.plugins.around_corner.late_light import LateLight
from torchtransient.plugins.around_corner.scan_job import ScanJob
from torchtransient.plugins.around_corner.scan_table import ACROSS, ScanTable
from torchtransient.plugins.around_corner.shafts import pays, spare_rays
from torchtransient.plugins.around_corner.third_bounce import ThirdBounce
from torchtransient.plugins.around_corner.third_bounce_gradients import ThirdBounceGradients
from torchtransient.plugins.around_corner.wall_points import WallPoints, points_of
from torchtransient.plugins.bsdfs.lambertian import is_lambertian
from torchtransient.plugins.host_numbers import host_numbers
from torchtransient.plugins.node_walk import objects_below
from torchtransient.plugins.parameter_effect import class_of
from torchtransient.plugins.sampling.area_elements import can_be_listed, has_shading_normals
from torchtransient.plugins.sampling.hidden_elements import HiddenElements
from torchtransient.plugins.sampling.scan_tiles import ScanTiles, distance_to
from torchtransient.plugins.sampling.shared_samples import draw_samples


def why_not(table: ScanTable, contents: Any, with_wall: bool) -> str | None:
    """What stands against shared samples in a scene, None for nothing. ``with_wall``: points are drawn on it, too."""
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
    """What shared samples need of a capture: scanned points and laser spots, each with what they scatter, and the
    laser's energy by colour. Attached where the scene's parameters are. Where every spot is a scanned point, both are
    one object.
    """

    sensors: WallPoints
    spots: WallPoints
    energy: Any


def scan_light(table: ScanTable, capture: CaptureType, legs: bool) -> ScanLight:
    """Of the scene as it is now."""
    origin, spots, seen = mi.Point3f(table.sensor.origin), table.spots, table.seen()
    looked_at = points_of(seen, dr.inv_pi, dr.norm(seen.p - origin) if legs else mi.Float(0))
    if not hasattr(spots.emitter, "energy_at"):
        return ScanLight(looked_at, spots.points(legs), mi.UnpolarizedSpectrum(1))
    energy = spots.emitter.energy_at([], True)
    same_legs = not legs or bool(dr.all(spots.origin == origin))
    if capture is CaptureType.EXHAUSTIVE and same_legs and _same(spots.lit(), seen):
        return ScanLight(looked_at, looked_at, energy)
    return ScanLight(looked_at, spots.points(legs, energy=False), energy)


def _same(spots: Any, points: Any) -> bool:
    """Whether laser spots are the scanned points themselves, on the same side of the wall."""
    if dr.width(spots.p) != dr.width(points.p):
        return False
    near = dr.norm(spots.p - points.p) <= 1e-6 * (1 + dr.norm(points.p))
    return bool(dr.all(near & (spots.wi.z * points.wi.z > 0) & spots.is_valid() & points.is_valid()))


def moves(world: Any, shapes: list[Any]) -> bool:
    """Whether derivatives are asked for of what some of these shapes are or hold."""
    held = {node.ptr for shape in shapes for node in [shape, *objects_below(shape, mi.Object)]}
    return bool(held & world.wanted.nodes)


def moves_scan(world: Any, hidden: list[Any]) -> bool:
    """Whether derivatives are asked for of anything that is no part of the hidden shapes alone: wall, sensor, laser."""
    others = [shape for shape in world.scene.shapes() if shape.ptr not in {one.ptr for one in hidden}]
    held = {node.ptr for shape in hidden for node in [shape, *objects_below(shape, mi.Object)]}
    return bool(world.wanted.nodes - held) or moves(world, others)


def _rows(vectors: Any, width: int) -> np.ndarray:
    """(width, 3), detached."""
    return np.broadcast_to(host_numbers(vectors).T, (width, 3))


def add_late_light(table: ScanTable, film: Any, job: Any, bounces: range, run: Any) -> None:
    """Add the light of these numbers of bounces to a film; ``job``: ``light`` (:class:`ScanLight`), ``elements`` and
    ``capture``, ``run``: ``seed``, ``samples`` and ``progress``.
    """
    elements = late_density(table.scene, job.elements, *table.reference_points(), table.memory)
    film_job = ScanJob(table.scene, film, job.light.sensors, job.light.energy, run.progress)
    ends = bounces[0], bounces[-1]
    LateLight(film_job, elements, job.light.spots, job.capture, ends).add(run.samples, run.seed)


class SharedThirdBounce:
    """Light of three bounces of one job: its render, and its derivatives beside those of paths (confocal and single).

    ``light``: attached where the scene is; ``draw``: (seed, number of samples).
    """

    can_be_recorded = False

    def __init__(
        self,
        world: Any,
        film: Any,
        light: ScanLight,
        elements: HiddenElements,
        capture: CaptureType,
        draw: tuple[Any, int],
    ) -> None:
        self.world, self.film, self.light, self.capture = world, film, light, capture
        self.tile = None
        if world.wanted is None and capture is not CaptureType.EXHAUSTIVE:
            elements = self._near(elements)
        self._spare_rays(elements, draw[1] * elements.tile_count)
        self.samples = draw_samples(elements, draw[1], draw[0])
        self.gradients = None
        if world.wanted is not None:
            laser = None if capture is CaptureType.CONFOCAL else light.spots
            with dr.resume_grad():
                samples = ends_of_samples(world.scene, elements, self.samples, world.contents.meshes, laser)
                points = ends_of_points(light.sensors, light.spots, light.energy)
            # Forward mode has to pass by all that is attached, wanted or not.
            self._tables = [ends.fields[n] for ends in (samples, points) for n in ends.fields]
            self._tables += [*vars(light.sensors).values(), *vars(light.spots).values(), light.energy]
            scan = moves_scan(world, elements.shapes)
            if not scan:
                points = points.detached()
            # What a single spot lights follows the spot.
            if not (moves(world, elements.shapes) or (scan and laser is not None)):
                samples = samples.detached()
            self.gradients = ThirdBounceGradients(world.scene, film, samples, points, self.samples.clear)

    def _near(self, elements: HiddenElements) -> HiddenElements:
        """With a density for each tile of the scan, where something hidden is nearer than half the scan's width."""
        p, n = (_rows(getattr(self.light.sensors, name), self.light.sensors.width) for name in "pn")
        some = np.linspace(0, len(p) - 1, min(len(p), ACROSS**2)).round().astype(int)
        tiles = ScanTiles(p, n, distance_to(elements.elements.centers(), p[some]))
        if tiles.count == 1:
            return elements
        self.tile = tiles.of_points()
        memory = self.world.contents.memory
        return copy(HiddenElements.remembered(memory, elements.shapes, tiles.points, tiles.normals))

    def _spare_rays(self, elements: HiddenElements, samples: int) -> None:
        """Leave out rays to what nothing hides, where that is found faster than they are traced."""
        points = (
            [self.light.sensors] if self.light.spots is self.light.sensors else [self.light.sensors, self.light.spots]
        )
        if pays(self.world.scene, samples * sum(each.width for each in points)):
            p, n = (np.concatenate([_rows(getattr(each, name), each.width) for each in points]) for name in "pn")
            spare_rays(self.world.scene, elements, p, n)

    def add(self, progress: Any = None) -> None:
        """Add the light to the film."""
        light = self.light
        third = ThirdBounce(self.world.scene, self.film, self.samples, light.sensors, light.energy, progress, self.tile)
        if self.capture is CaptureType.CONFOCAL:
            third.add_confocal(self.light.spots)
        elif self.capture is CaptureType.SINGLE:
            third.add_single(self.light.spots)
        elif self.capture is CaptureType.PAIRS:
            third.add_pairs(self.light.spots)
        else:
            add_exhaustive(third, self.light.spots)

    def tables(self) -> list[Any]:
        """What has been computed of the scene's parameters."""
        with dr.resume_grad():
            return [table for table in self._tables if dr.is_array_v(table) and dr.grad_enabled(table)]

    def backward(self, incoming: Any) -> None:
        """Accumulate into the attached parameters; ``incoming``: the film's adjoint."""
        self.gradients.backward(incoming)

    def forward(self) -> None:
        """Add to the film, along the tangents of the scene."""
        self.gradients.forward()
