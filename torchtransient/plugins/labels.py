"""Labels of the pixels of a sensor: one ray through each pixel's centre, and properties of the surface that it meets.

A :class:`LabelJob` has what :class:`~torchtransient.rendering.recording.Recordings` asks of a job, so that it is
recorded as renders are. Nothing here has derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import SceneError
from torchtransient.plugins.films.colour import StandardObserver
from torchtransient.plugins.frozen_state import says_it_can_be_recorded, state_below
from torchtransient.plugins.guards import no_collection
from torchtransient.plugins.kernel_arrays import PointerTable
from torchtransient.plugins.mitsuba_compat import is_distant, near_clip
from torchtransient.plugins.mitsuba_shapes import has_surface, is_instance
from torchtransient.plugins.node_walk import shapes_of_scene
from torchtransient.plugins.parameter_effect import class_of
from torchtransient.plugins.sensors.origin import length_to_sensor_origin, sensors_of, views
from torchtransient.plugins.transport.scene_contents import SceneCache
from torchtransient.plugins.transport.velocities import Movers, Velocities

# Numbers by pixel of each label; None: the channels of the film.
COMPONENTS = {
    "depth": 1, "z_depth": 1, "position": 3, "normals": 3, "uv": 2, "albedo": None,
    "velocity": 3, "radial_velocity": 1, "shape": 1, "primitive": 1, "material": 1,
}  # fmt: skip
_VELOCITIES = ("velocity", "radial_velocity")
# Names of things, of which there is no mean.
NUMBERED = ("shape", "primitive", "material")
# Surfaces that a ray passes at most: panes of leaves behind one another, and boundaries of media.
MOST_PASSED = 64
# A surface that lets more of the light pass unbent is not what a pixel looks at.
LETS_PASS = 0.5
# Reflectances by channel in variants with wavelengths: so many groups of wavelengths over the visible ones.
_GROUPS, _FIRST, _LAST = 16, 360.0, 830.0


class LabelTables:
    """Lookup tables of a built scene: names of its shapes and materials in the order of the description, their numbers
    by pointer, and its plugins written in Python.
    """

    def __init__(self, scene: Any, integrator: Any) -> None:
        shapes = [shape for shape in scene.shapes() if has_surface(shape) or is_instance(shape)]
        self.shape_names = tuple(shape.id() for shape in shapes)
        self._shapes = PointerTable(shapes, list(range(1, len(shapes) + 1)))
        surfaces = [(shape.id(), shape.bsdf()) for shape in shapes_of_scene(scene) if has_surface(shape)]
        named = {bsdf.ptr: (name, bsdf) for name, bsdf in reversed(surfaces) if bsdf is not None}
        # In the order of the first shape that has each.
        found = [named.pop(bsdf.ptr) for _, bsdf in surfaces if bsdf is not None and bsdf.ptr in named]
        self._bsdfs = [bsdf for _, bsdf in found]
        # Mitsuba numbers what has no name, and counts all that it has ever made.
        self.material_names = tuple(f"{name}.bsdf" if "#" in bsdf.id() else bsdf.id() for name, bsdf in found)
        self._materials = PointerTable(self._bsdfs, list(range(1, len(self._bsdfs) + 1)))
        self.observer = StandardObserver.of_variant()
        self.daylight = _daylight() if mi.is_spectral else []
        self.seen = SceneCache(scene, integrator)
        self._movers: Movers | None = None

    def velocities(self, scene: Any, sensor: Any) -> Velocities:
        """Return the velocities that the scene's bodies have now."""
        if self._movers is None:
            self._movers = Movers(scene)
        return Velocities(self._movers, sensor)

    def lets_light_through(self) -> bool:
        """Return True if any surface may let light pass unbent: parameters may add a lobe."""
        return any(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) for bsdf in self._bsdfs)

    def tables(self) -> list[Any]:
        """Return the arrays that kernels read."""
        return [self._shapes, self._materials, self.observer]

    def shape(self, si: Any, hit: Any) -> Any:
        """Return the numbers of the shapes that are met, of the instance where it is one; -1 for none.

        Args:
            si: SurfaceInteraction3f.
            hit: mask of lanes that met something.
        """
        copied = hit & (dr.reinterpret_array(mi.UInt32, si.instance) != 0)
        number = dr.select(copied, self._shapes.look_up(si.instance, copied), self._shapes.look_up(si.shape, hit))
        return mi.Int32(number) - 1

    def material(self, si: Any, hit: Any) -> Any:
        """Return the numbers of the materials of the surfaces that are met; -1 for none.

        Args:
            si: SurfaceInteraction3f.
            hit: mask of lanes that met something.
        """
        return mi.Int32(self._materials.look_up(si.bsdf(), hit)) - 1


def _check_sensor(sensor: Any, names: tuple[str, ...]) -> None:
    """Raise ``SceneError`` where a pixel of a sensor is no direction, or there is no axis to measure along."""
    for one in sensors_of(sensor):
        if is_distant(one) or class_of(one) == "IrradianceMeter":
            raise SceneError(
                f"labels: each sample of the sensor {one.id()!r} ({class_of(one)}) looks along a line of its own: "
                "its pixels look at nothing in particular. Use a perspective, thinlens, orthographic, radiancemeter or "
                "nlos_capture_meter sensor, or a batch of such."
            )
        if "z_depth" in names and not _has_axis(one):
            raise SceneError(
                f"z_depth: the sensor {one.id()!r} ({class_of(one)}) has no optical axis; ask for 'depth', the "
                "distance from its origin."
            )


def _has_axis(sensor: Any) -> bool:
    return near_clip(sensor) is not None or bool(sensor.class_name() == "RadianceMeter")


class LabelResults:
    """Results of a recorded call, handed over as by a film."""

    def __init__(self) -> None:
        self._arrays: list[Any] = []

    def put(self, arrays: list[Any]) -> None:
        """Hold what has been computed."""
        self._arrays = arrays

    def release_storage(self) -> list[Any]:
        """Return the results and release them."""
        found, self._arrays = self._arrays, []
        return found

    def clear(self) -> None:
        """Hold nothing."""
        self._arrays = []


@dataclass
class LabelJob:
    """Labels ``names`` of one ``sensor``, the mean of ``samples`` places in each pixel, or at its centre for 0.
    Results (:meth:`LabelResults.release_storage`) come in the order of the names, one array for each component.
    """

    scene: Any
    sensor: Any
    names: tuple[str, ...]
    tables: LabelTables
    samples: int
    kind: str = "labels"
    launches: list[Any] = field(default_factory=list)
    film: LabelResults = field(default_factory=LabelResults)
    refusal: str | None = None
    plugins: list[Any] = field(default_factory=list)

    @no_collection()
    def prepare(self) -> LabelJob:
        """Look up all data that is not part of the recorded code."""
        _check_sensor(self.sensor, self.names)
        self.tables.seen.follow_derivatives(self.scene, False)
        self.plugins = self.tables.seen.python_plugins(self.scene)
        for plugin in self.plugins:
            if not says_it_can_be_recorded(plugin):
                self.refusal = f"the plugin {type(plugin).__name__} does not say that it can be (can_be_recorded)"
        film = self.sensor.film()
        self._size = tuple(int(n) for n in film.crop_size())
        self._curves = film.curves if "albedo" in self.names else None
        self._passes = self.tables.lets_light_through()
        self._hides_emitters = bool(getattr(self.scene.integrator(), "hide_emitters", False))
        asked = any(name in _VELOCITIES for name in self.names)
        self._velocities = self.tables.velocities(self.scene, self.sensor) if asked else None
        self._spots = None
        if self.samples:
            self._spots = mi.Float(_places(self.samples).ravel())
            dr.make_opaque(self._spots)
        return self

    @property
    def size(self) -> tuple[int, int]:
        """Return width and height."""
        return self._size

    def components(self, name: str) -> int:
        """Numbers by pixel of a label."""
        return COMPONENTS[name] or self._channels()

    def _channels(self) -> int:
        if not mi.is_spectral:
            return len(mi.UnpolarizedSpectrum(0))
        return 3 if self._curves is None else len(self._curves.names)

    @property
    def integrator(self) -> LabelJob:
        """Integrator that executes the job."""
        return self

    @staticmethod
    def state_of(jobs: list[LabelJob]) -> tuple[tuple[Any, ...], list[Any]]:
        """Return (structure, arrays), see :func:`torchtransient.plugins.integrators.job.state_of`."""
        held: list[Any] = []
        for job in jobs:
            held += [job.kind, job.names, job.samples, job._size, job._passes, job._hides_emitters, job.sensor]
            held += [job._spots, job._curves, job.tables.tables(), job._velocities]
        return state_below([held, [vars(plugin) for plugin in jobs[0].plugins]])

    def run(self, job: LabelJob) -> None:
        """Execute a job that is prepared."""
        with dr.suspend_grad():
            job.film.put(job._computed())

    # --------------------------------------------------------------------------------------------------- the rays

    def _computed(self) -> list[Any]:
        position, aperture = self._positions()
        ray, _ = self.sensor.sample_ray(self.sensor.shutter_open(), 0.5, position, aperture)
        seen = views(self.sensor, position, lambda: None)
        ray = mi.Ray3f(ray)
        origin = mi.Point3f(ray.o)
        before = length_to_sensor_origin(seen, ray)
        si = _first_surface(self.scene, ray, self._passes, self._hides_emitters)
        hit = si.is_valid()
        found = []
        for name in self.names:
            if name == "depth":
                values = [before + dr.norm(si.p - origin)]
            elif name == "z_depth":
                values = [_along_axis(seen, si.p)]
            elif name in NUMBERED:
                values = [mi.Int32(si.prim_index) if name == "primitive" else getattr(self.tables, name)(si, hit)]
            elif name in _VELOCITIES:
                v = self._velocities.of_surface(si, hit)  # type: ignore[union-attr]
                away = dr.dot(v - self._velocities.of_sensor(origin), ray.d)  # type: ignore[union-attr]
                values = [away] if name == "radial_velocity" else [v[k] for k in range(3)]
            elif name == "albedo":
                values = self._albedo(si, hit)
            else:
                vector = {"position": si.p, "normals": si.sh_frame.n, "uv": si.uv}[name]
                values = [vector[k] for k in range(COMPONENTS[name] or 0)]
            none = -1 if name in NUMBERED else dr.nan
            one = self._spots is None
            found += [dr.select(hit, value, none) if one else self._mean(value, hit) for value in values]
        return found

    def _positions(self) -> tuple[Any, Any]:
        """Positions of the rays on the film, in [0, 1]^2 of its crop window, and on the aperture."""
        width, height = self._size
        if self._spots is None:
            pixel, offset, aperture = dr.arange(mi.UInt32, width * height), mi.Point2f(0.5), mi.Point2f(0.5)
        else:
            lane = dr.arange(mi.UInt32, width * height * self.samples)
            pixel = lane // self.samples
            number = 4 * (lane - pixel * self.samples)
            offset, aperture = (
                mi.Point2f(*[dr.gather(mi.Float, self._spots, number + first + k) for k in (0, 1)]) for first in (0, 2)
            )
        row = pixel // width
        corner = mi.Point2f(mi.Float(pixel - row * width), mi.Float(row))
        return (corner + offset) / mi.ScalarVector2f(width, height), aperture

    def _mean(self, value: Any, hit: Any) -> Any:
        """Over the places of each pixel that meet something; NaN where none does."""
        total = dr.block_sum(dr.select(hit, value, 0), self.samples)
        return total / dr.block_sum(dr.select(hit, mi.Float(1), 0), self.samples)

    # -------------------------------------------------------------------------------------------------- the albedo

    def _albedo(self, si: Any, hit: Any) -> list[Any]:
        bsdf = si.bsdf()
        hit = hit & mi.has_flag(bsdf.flags(), mi.BSDFFlags.DiffuseReflection)
        if not mi.is_spectral:
            value = mi.unpolarized_spectrum(bsdf.eval_diffuse_reflectance(si, hit))
            return [dr.select(hit, value[k], 0) for k in range(len(value))]
        # In daylight, in which white is white, unless the film has channels of its own.
        response = self.tables.observer if self._curves is None else self._curves
        total = [mi.Float(0) for _ in range(self._channels())]
        white = [mi.Float(0) for _ in range(self._channels())]
        for group, wavelengths in enumerate(_wavelengths(self._curves)):
            si.wavelengths = wavelengths
            value = mi.unpolarized_spectrum(bsdf.eval_diffuse_reflectance(si, hit))
            for k, row in enumerate(response.matrix(wavelengths)):
                light = self.tables.daylight[group][k] if self._curves is None else 1.0
                total = [t + value[k] * share * light for t, share in zip(total, row, strict=True)]
                white = [w + share * light for w, share in zip(white, row, strict=True)]
        return [dr.select(hit, t / w, 0) for t, w in zip(total, white, strict=True)]


@dr.syntax
def _first_surface(scene: Any, ray: Any, passes: bool, hides_emitters: bool) -> Any:
    """Find the first surface along each ray that does not let most of the light pass unbent. ``passes``: the scene may
    have surfaces that do; ``hides_emitters``: emitting surfaces are skipped, as by an integrator's ``hide_emitters``.
    """
    si = scene.ray_intersect(ray)
    if dr.hint(passes or hides_emitters, mode="scalar"):
        turns = mi.UInt32(0)
        active = si.is_valid() & _lets_pass(si, passes, hides_emitters)
        while dr.hint(active & (turns < MOST_PASSED), max_iterations=MOST_PASSED, label="labels"):
            left = ray.maxt - si.t
            ray = si.spawn_ray(ray.d)
            ray.maxt = left
            si = scene.ray_intersect(ray, active)
            active = active & si.is_valid() & _lets_pass(si, passes, hides_emitters)
            turns += 1
    return si


def _lets_pass(si: Any, passes: bool, hides_emitters: bool) -> Any:
    """Return a mask of surface interactions that a pixel looks through."""
    through = mi.Mask(False)
    if passes:
        clear = mi.unpolarized_spectrum(si.bsdf().eval_null_transmission(si, si.is_valid()))
        through |= (dr.mean(clear) > LETS_PASS) & ~si.shape.is_emitter()
    if hides_emitters:
        through |= si.shape.is_emitter()
    return through


def _along_axis(seen: list[Any], p: Any) -> Any:
    """Distance from the sensor's origin to a point along the optical axis."""
    found = None
    for view in seen:
        transform = view.sensor.world_transform()
        axis = dr.normalize(transform @ mi.Vector3f(0, 0, 1))
        along = dr.dot(p - transform @ mi.Point3f(0), axis)
        found = along if found is None else dr.select(view.active, along, found)
    return found


def _places(count: int) -> np.ndarray:
    """Return evenly spread places (count, 4) in a pixel and in the aperture: the additive recurrence of Roberts, by
    the powers of the root of x^5 = x + 1.
    """
    root = 1.1673039782614187
    steps = root ** -np.arange(1.0, 5.0)
    places: np.ndarray = (0.5 + np.arange(1, count + 1)[:, None] * steps) % 1
    return places


def _wavelengths(curves: Any) -> list[Any]:
    """Wavelengths (nanometres) of the middle of equal intervals, in groups of those of a spectrum."""
    first, last = (_FIRST, _LAST) if curves is None else curves.range
    size = len(mi.UnpolarizedSpectrum(0))
    middles = first + (last - first) * (np.arange(_GROUPS * size) + 0.5) / (_GROUPS * size)
    return [mi.UnpolarizedSpectrum(*[float(middle) for middle in group]) for group in middles.reshape(_GROUPS, size)]


def _daylight() -> list[list[float]]:
    """CIE standard illuminant D65 at the wavelengths of :func:`_wavelengths`, group by group."""
    light = mi.load_dict({"type": "d65"})
    si = dr.zeros(mi.SurfaceInteraction3f)
    found = []
    for si.wavelengths in _wavelengths(None):
        value = mi.unpolarized_spectrum(light.eval(si))
        found.append([float(value[k][0]) for k in range(len(value))])
    return found
