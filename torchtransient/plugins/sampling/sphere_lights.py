"""Sampling of spherical lights over the cone that they fill, for spheres of any size.

Seen under the angle theta from outside, a sphere fills the solid angle 2 pi (1 - cos theta). Mitsuba takes the
difference in single precision: a sphere of 1 mm at 3 m is 11 % too bright, one of 0.3 mm is black. Here it is
``sin^2 / (1 + cos)``, and the sampled direction and distance are built from it without a difference of nearly equal
numbers. Inside of a sphere its surface is sampled uniformly.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.mitsuba_compat import is_sphere, samples_its_shape
from torchtransient.plugins.node_walk import objects_below, shown_by
from torchtransient.plugins.pointer_table import PointerTable

# Numbers kept of a sphere: center, radius, sign of the outward normal, probability of choosing it; then its matrix.
_PLAIN, _WITH_MATRIX = 6, 15


class SphereLights:
    """The spherical lights of one scene. ``all``: there are no others. ``textured``: one of them has a texture."""

    def __init__(self, emitters: list[Any], numbers: list[int], count: int) -> None:
        self._emitters, self._numbers, self.all = emitters, numbers, len(numbers) == count
        self._shapes = [emitter.get_shape() for emitter in emitters]
        self._to_world = [next(v for v in shown_by(shape)[0] if v.key == "to_world") for shape in self._shapes]
        self.textured = any(t.is_spatially_varying() for e in emitters for t in objects_below(e, mi.Texture))

    @staticmethod
    def of(scene: Any) -> SphereLights | None:
        """Those of ``scene``, None when it has none."""
        lights = scene.emitters()
        numbers = [n for n, emitter in enumerate(lights) if _is_sphere_light(emitter)]
        return SphereLights([lights[n] for n in numbers], numbers, len(lights)) if numbers else None

    def read(self, scene: Any) -> SphereLightTable:
        """Where they are now, attached where their shapes are; to be called outside of loops, once a job."""
        with dr.resume_grad():
            return SphereLightTable(self, [self._numbers_of(scene, n) for n in range(len(self._shapes))])

    def _numbers_of(self, scene: Any, n: int) -> list[Any]:
        shape = self._shapes[n]
        matrix = self._to_world[n].read(shape).matrix
        outward = -1.0 if shape.has_flipped_normals() else 1.0
        pmf = scene.pdf_emitter(mi.UInt32(self._numbers[n]))
        radius = dr.norm(mi.Vector3f(matrix[0, 0], matrix[1, 0], matrix[2, 0]))
        numbers = [matrix[0, 3], matrix[1, 3], matrix[2, 3], radius, outward, pmf]
        if self.textured:
            numbers += [matrix[row, column] for row in range(3) for column in range(3)]
        return [mi.Float(number) for number in numbers]

    def marks(self) -> PointerTable:
        """One plus the place of each light in the table, zero for all others."""
        return PointerTable(self._emitters, [1 + n for n in range(len(self._emitters))])


def _is_sphere_light(emitter: Any) -> bool:
    shape = emitter.get_shape()
    return shape is not None and is_sphere(shape) and samples_its_shape(emitter)


class SphereLightTable:
    """Spherical lights as kernels read them. Not a dataclass on purpose: Dr.Jit loops would take it apart."""

    def __init__(self, lights: SphereLights, rows: list[list[Any]]) -> None:
        self.all, self.textured, self._marks = lights.all, lights.textured, lights.marks()
        self._width = _WITH_MATRIX if lights.textured else _PLAIN
        self.values = dr.zeros(mi.Float, self._width * len(rows))
        for n, row in enumerate(rows):
            for k, number in enumerate(row):
                dr.scatter(self.values, number, mi.UInt32(self._width * n + k))

    def lists(self, emitter: Any, active: Any = True) -> Any:
        """Which of an array of emitter pointers are spherical lights."""
        return self._marks.look_up(emitter, active) > 0

    def sample(self, scene: Any, ref: Any, u: Any, active: Any) -> tuple[Any, Any]:
        """(direction sample, emission over density) towards an emitter of the scene, as
        ``scene.sample_emitter_direction(ref, u, False, active)``. Attached where ``ref`` and the shapes are.
        """
        number, choice, x = scene.sample_emitter(u.x, active)
        emitter = dr.gather(mi.EmitterPtr, scene.emitters_dr(), number, active)
        spherical = active if self.all else self.lists(emitter, active)
        sphere = _Sphere(self, emitter, ref.p, spherical)
        ds = sphere.sampled(mi.Point2f(x, u.y), ref)
        ds.emitter = emitter
        value = emitter.eval_direction(ref, ds, spherical)
        weight = value * (dr.select(ds.pdf > 0, dr.rcp(ds.pdf), 0) * choice)
        ds.pdf *= sphere.pmf
        if self.all:
            return ds, weight
        other, other_weight = emitter.sample_direction(ref, mi.Point2f(x, u.y), active & ~spherical)
        other.pdf *= scene.pdf_emitter(number, active)
        return dr.select(spherical, ds, other), dr.select(spherical, weight, other_weight * choice)

    def pdf(self, scene: Any, ref: Any, ds: Any, active: Any) -> Any:
        """Density of :meth:`sample` per solid angle, as ``scene.pdf_emitter_direction(ref, ds, active)``."""
        spherical = active & self.lists(ds.emitter, active)
        sphere = _Sphere(self, ds.emitter, ref.p, spherical)
        cos = -dr.dot(ds.d, ds.n)
        over_area = dr.square(ds.dist) / (4 * dr.pi * dr.square(sphere.radius) * cos)
        pdf = dr.select(sphere.outside, dr.rcp(sphere.solid_angle), over_area)
        pdf = dr.select(spherical & (cos > 0) & (ds.dist > 0), pdf * sphere.pmf, 0)
        if self.all:
            return pdf
        return dr.select(spherical, pdf, scene.pdf_emitter_direction(ref, ds, active & ~spherical))

    def numbers(self, emitter: Any, active: Any) -> list[Any]:
        """The numbers of the lights that an array of pointers points to."""
        slot = self._marks.look_up(emitter, active)
        known = slot > 0
        first = dr.select(known, slot - 1, 0) * self._width
        return [dr.gather(mi.Float, self.values, first + k, known) for k in range(self._width)]


class _Sphere:
    """One light per lane, seen from ``p``: ``outside`` (where ``p`` is), ``solid_angle`` of the cone, ``pmf``."""

    def __init__(self, table: SphereLightTable, emitter: Any, p: Any, active: Any) -> None:
        x, y, z, r, self.outward, self.pmf, *self.matrix = table.numbers(emitter, active)
        self.center = mi.Point3f(x, y, z)
        # Idle lanes look at a unit sphere from outside: what they hold must not have an infinite derivative.
        self.radius = dr.select(active, r, 1)
        self.to_center = dr.select(active, self.center - p, mi.Vector3f(0, 0, 2))
        # Points on the surface itself see it from the side that shines.
        edge = dr.detach(self.radius) * (1 - self.outward * mi.math.RayEpsilon)
        d2 = dr.squared_norm(self.to_center)
        self.outside = dr.detach(d2) > dr.square(edge)
        self.distance = dr.sqrt(dr.select(self.outside, d2, dr.square(2 * self.radius)))
        self.sin_max = dr.minimum(self.radius / self.distance, 1)
        self.cos_max = dr.sqrt(dr.maximum((1 - self.sin_max) * (1 + self.sin_max), 1e-12))
        self.solid_angle = 2 * dr.pi * dr.square(self.sin_max) / (1 + self.cos_max)

    def sampled(self, u: Any, ref: Any) -> Any:
        """The DirectionSample3f of two random numbers, without an emitter."""
        direction, d_outside, distance = self._on_the_cone(u)
        normal = dr.select(self.outside, direction, mi.warp.square_to_uniform_sphere(u))
        # From the center, since that of the sum below is lost where the sphere is far away and small.
        away = self.radius * normal + self.to_center
        inside_distance = dr.norm(dr.select(self.outside, mi.Vector3f(0, 0, 1), away))
        ds = dr.zeros(mi.DirectionSample3f)
        ds.p = dr.fma(normal, self.radius, self.center)
        ds.n = normal * self.outward
        ds.dist = dr.select(self.outside, distance, inside_distance)
        ds.d = dr.select(self.outside, d_outside, away / inside_distance)
        ds.time = ref.time
        cos = dr.abs_dot(ds.d, ds.n)
        over_area = dr.square(ds.dist) / (4 * dr.pi * dr.square(self.radius) * dr.select(cos > 0, cos, 1))
        pdf = dr.select(self.outside, dr.rcp(self.solid_angle), dr.select(cos > 0, over_area, 0))
        ds.pdf = dr.select(ds.dist > 0, pdf, 0)
        if self.matrix:
            ds.uv = self._uv(normal)
        return ds

    def _on_the_cone(self, u: Any) -> tuple[Any, Any, Any]:
        """(outward normal of the point, direction to it, distance) of a direction uniform in the cone.

        With ``1 - cos = u (1 - cos_max)`` the sine is ``a sin_max``; the law of sines gives the distance and the angle
        at the center. The root of ``u`` stands alone: that of a product would have an infinite derivative at zero.
        """
        s, two = self.sin_max, 1 + self.cos_max
        versine = u.x * dr.square(s) / two
        a = dr.sqrt(u.x) * dr.sqrt((2 - versine) / two)
        sin, cos = a * s, 1 - versine
        q = dr.sqrt(dr.maximum(1 - u.x * (2 - versine) / two, 1e-12))
        near = cos - s * q
        sin_center, cos_center = a * near, a * sin + cos * q
        sin_phi, cos_phi = dr.sincos(u.y * (2 * dr.pi))
        axis = self.to_center / self.distance
        frame = mi.Frame3f(dr.select(self.outside, axis, mi.Vector3f(0, 0, 1)))
        across = frame.s * cos_phi + frame.t * sin_phi
        return across * sin_center - frame.n * cos_center, across * sin + frame.n * cos, self.distance * near

    def _uv(self, normal: Any) -> Any:
        """Texture coordinates of the point with an outward normal: ``to_world`` is a similarity."""
        m = self.matrix
        x, y, z = (dr.dot(mi.Vector3f(m[k], m[3 + k], m[6 + k]), normal) for k in range(3))
        phi = dr.atan2(y, x)
        phi = dr.select(phi < 0, phi + 2 * dr.pi, phi)
        across = dr.sqrt(dr.maximum(dr.square(x) + dr.square(y), 1e-30))
        return mi.Point2f(phi / (2 * dr.pi), dr.atan2(across, z) / dr.pi)
