"""The index of refraction of the medium that a sensor stands in.

Surfaces tell the ratio of the indices on their two sides, so the medium at the sensor is found by following straight
lines outwards, through everything, until nothing is hit: leaving a body multiplies by its index, a body that is entered
and left cancels, and one that is entered and never left (an open surface such as that of a lake) was not around the
sensor. Entered in all directions, it is a body that is turned inside out. Each material is decided on by itself, by
lines along the sensor's rays and in all directions, so that neither a leak of a mesh nor a direction in which an open
surface is missed decides.

One index per sensor: of an orthographic camera, a lens or a meter that stands on both sides of a boundary, that of most
of its rays. Of a blend of smooth glasses with different indices the first counts, a ``mask`` as what it masks.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.plugins.bsdfs.refraction_table import boundaries_of, index_of
from torchtransient.plugins.cache import Cache
from torchtransient.plugins.kernel_arrays import PointerTable
from torchtransient.plugins.mitsuba_compat import is_distant
from torchtransient.plugins.mitsuba_shapes import has_surface, is_instance
from torchtransient.plugins.node_walk import shapes_of_scene
from torchtransient.plugins.sensors.origin import sensors_of

# Lines per sensor: half of them along its rays.
LINES = 64
# The share of the lines that has to leave a body for the sensor to be inside: more than leaks do, less than an open
# surface that is in view.
SHARE = 1 / 16
# The share of the lines in all directions that enter what surrounds the sensor; a flat surface is met by half of them.
ENCLOSED = 0.9
# Bodies of one material around each other that are distinguished, and surfaces along one line.
_NESTED, _SURFACES = 4, 1000
# Stands for no body: nothing has to be asked of its material.
OUTSIDE = None


class Surroundings:
    """Refractive BSDFs that may surround the sensors behind ``sensor``.

    Sensors at infinity stand in nothing. The lines are followed when a sensor or a body of these BSDFs has moved, and
    not for every render; a sensor in air then leaves nothing of the question in a kernel.
    """

    def __init__(self, sensor: Any, boundaries: list[tuple[Any, Any]], shapes: list[Any]) -> None:
        self._sensors = sensors_of(sensor)
        self._leaves = [leaf for _, leaf in boundaries]
        bsdfs = [bsdf for bsdf, _ in boundaries]
        # Smooth glass often shares its BSDF, and parts may share a leaf: one slot for each leaf.
        known = {leaf.ptr: leaf for leaf in self._leaves}
        slots = {ptr: 1 + n for n, ptr in enumerate(known)}
        self._slots = PointerTable(bsdfs, [slots[leaf.ptr] for leaf in self._leaves])
        self._leaves = list(known.values())
        rng = np.random.default_rng(0)
        # One component at a time, it needs no kernel of its own.
        self._film, self._aperture = (mi.Point2f(*map(mi.Float, rng.random((2, LINES)))) for _ in range(2))
        around = rng.normal(size=(3, LINES))
        self._around = mi.Vector3f(*map(mi.Float, around / np.linalg.norm(around, axis=0)))
        self._cache = Cache(_bodies(shapes, bsdfs) + _with_shapes(self._sensors))

    @staticmethod
    def from_scene(scene: Any, sensor: Any, bsdfs: list[Any]) -> Surroundings | None:
        """Return what surrounds a sensor, None if nothing in the scene refracts.

        Args:
            scene: Mitsuba scene.
            sensor: sensor of the job.
            bsdfs: outermost BSDFs of the scene.
        """
        boundaries = boundaries_of(bsdfs)
        return Surroundings(sensor, boundaries, shapes_of_scene(scene)) if boundaries else None

    def indices(self, scene: Any) -> list[Any]:
        """Return the current index of refraction at each sensor, attached where the indices of the surfaces are. Call
        outside of loops, with gradients enabled.
        """
        count = len(self._leaves)
        levels = self._cache.get("levels", self._crops(), lambda: self._levels(scene))
        found = []
        for number in range(len(self._sensors)):
            pairs = zip(self._leaves, levels[number * count : (number + 1) * count], strict=True)
            around = [_index_inside(level, index_of(leaf)) for leaf, level in pairs if level is not OUTSIDE]
            index = mi.Float(1)
            for factor in around:
                index = index * factor
            if around:  # or else it stays a number in the kernels
                dr.make_opaque(index)
            found.append(index)
        return found

    def _crops(self) -> tuple[tuple[int, ...], ...]:
        """Return the part of its film that each sensor looks through."""
        films = (sensor.film() for sensor in self._sensors)
        return tuple((*film.size(), *film.crop_size(), *film.crop_offset()) for film in films)

    def _levels(self, scene: Any) -> list[Any]:
        """Return for each sensor and material the number of bodies around each other that the sensor is in, -1 for
        outside of one that is turned inside out, ``OUTSIDE`` for none: whole numbers, or arrays where a call is
        recorded, which has no numbers yet.
        """
        levels = self._counted(scene)
        if dr.flag(dr.JitFlag.FreezingScope):
            return [dr.gather(mi.Float, levels, mi.UInt32(n)) for n in range(dr.width(levels))]
        return [int(level) or OUTSIDE for level in np.array(levels)]

    def _counted(self, scene: Any) -> Any:
        """Return :meth:`_levels` in one array."""
        count = len(self._leaves)
        with dr.suspend_grad():
            left, levels, entered = (dr.zeros(mi.Float, len(self._sensors) * count) for _ in range(3))
            for number, sensor in enumerate(self._sensors):
                if not is_distant(sensor):
                    ray = self._lines(sensor)
                    first = dr.opaque(mi.UInt32, number * count)
                    _count_crossings(scene, self._slots, count, ray, first, left, levels, entered)
            levels = dr.select(left > SHARE * LINES, dr.round(levels / dr.maximum(left, 1)), 0)
            levels = dr.select((levels == 0) & (entered > ENCLOSED * LINES / 2), -1, levels)
            dr.eval(levels)
        return levels

    def _lines(self, sensor: Any) -> Any:
        """Sample lines from the origins of the sensor's rays, half of them along the rays."""
        ray, _ = sensor.sample_ray_differential(sensor.shutter_open(), 0.5, self._film, self._aperture)
        return mi.Ray3f(dr.detach(ray.o), dr.select(_all_directions(), self._around, dr.detach(ray.d)))


def _bodies(shapes: list[Any], bsdfs: list[Any]) -> list[Any]:
    """Return the shapes with one of these BSDFs, and the instances that may move them."""
    known = {bsdf.ptr for bsdf in bsdfs}
    surfaces = ((shape, shape.bsdf()) for shape in shapes if has_surface(shape))
    bodies = [shape for shape, bsdf in surfaces if bsdf is not None and bsdf.ptr in known]
    return bodies + [shape for shape in shapes if is_instance(shape)]


def _with_shapes(sensors: list[Any]) -> list[Any]:
    """Sensors, and the shapes that they sit on."""
    return [*sensors, *(shape for shape in (one.get_shape() for one in sensors) if shape is not None)]


def _index_inside(level: Any, eta: Any) -> Any:
    """Index of refraction in ``level`` bodies of relative index ``eta`` around each other."""
    index = mi.Float(1)
    for depth in range(_NESTED):
        index = index * dr.select(level > depth, eta, 1)
    return index * dr.select(level < 0, dr.rcp(eta), 1)


def _all_directions():
    """Return a mask of the lines that do not follow a ray of the sensor."""
    return (dr.arange(mi.UInt32, LINES) & 1) == 1


@dr.syntax
def _count_crossings(scene, slots, count, ray, first, left, levels, entered):
    """Count for each material the lines that leave bodies of it that they have not entered (``left``; ``levels`` counts
    the bodies), and those of them in all directions that enter one that they never leave.
    """
    # Slot 0 is that of everything else.
    now, most = (dr.alloc_local(mi.Int32, count + 1, value=mi.Int32(0)) for _ in range(2))
    active, n = dr.full(mi.Bool, True, LINES), dr.zeros(mi.UInt32, LINES)
    while dr.hint(active, label="surroundings of a sensor"):
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        slot = slots.look_up(si.bsdf(), active)
        after = now.read(slot, active) + dr.select(si.wi.z < 0, mi.Int32(1), mi.Int32(-1))
        now.write(after, slot, active)
        most.write(dr.maximum(most.read(slot, active), after), slot, active)
        ray = si.spawn_ray(ray.d)
        n += 1
        active &= n < _SURFACES
    k = dr.zeros(mi.UInt32, LINES)
    while dr.hint(k < count, label="materials around a sensor"):
        bodies = most.read(k + 1)
        dr.scatter_add(left, 1.0, k + first, bodies > 0)
        dr.scatter_add(levels, mi.Float(bodies), k + first, bodies > 0)
        dr.scatter_add(entered, 1.0, k + first, _all_directions() & (now.read(k + 1) < bodies))
        k += 1
