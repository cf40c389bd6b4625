"""Sampling of spherical lights over the cone that they fill, for spheres of any size.

Seen under the angle theta from outside, a sphere fills the solid angle 2 pi (1 - cos theta). Mitsuba takes the
difference in single precision: a sphere of 1 mm at 3 m is 11 % too bright, one of 0.3 mm is black. Here it is
``sin^2 / (1 + cos)``, and the sampled direction and distance are built from it without a difference of nearly equal
numbers. Inside of a sphere its surface is sampled uniformly.
"""

from __future__ import annotations

import copy
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.plugins.cache import Cache
from torchtransient.plugins.kernel_arrays import PointerTable
from torchtransient.plugins.mitsuba_compat import samples_its_shape
from torchtransient.plugins.mitsuba_shapes import is_sphere
from torchtransient.plugins.node_walk import objects_below, objects_of, shown_by
from torchtransient.plugins.sampling.lights import least_probability

# ----------------------------------------------------------------------------------------------------------------------
# Area lights whose samples Mitsuba's own would not cover, sampled over their shapes.
# Of a light with a texture, Mitsuba draws a place of the texture in [0, 1]^2 and asks the shape for the point there
# (``eval_parameterization``). That point is one of several where parts of a mesh share a piece of the texture, none
# where texture coordinates lie outside, another one for a cylinder that is turned or scaled, and seen from behind for a
# rectangle with flipped normals. What is never drawn has a density nevertheless: the light is too dark. So the shape
# draws a point of all of its area. Rectangles with a bitmap over all of them are left to Mitsuba, which draws bright
# texels more often. A mirrored cylinder has other normals where it is sampled than where rays meet it.


class ShapeLights:
    """Lights of a scene that are sampled over their shapes; all others are left to Mitsuba.

    Spheres are sampled over their cones (:class:`SphereLights`). Nothing here is attached.
    """

    def __init__(self, scene: Any) -> None:
        numbers = [n for n, emitter in enumerate(scene.emitters()) if _is_listed(emitter)]
        lights = [scene.emitters()[n] for n in numbers]
        self._shapes = [(shape, _is_inside_out(shape)) for shape in (light.get_shape() for light in lights)]
        self._all = len(lights) == len(scene.emitters())
        if lights:
            # One plus the place in this list, zero for all others.
            self._marks = PointerTable(lights, [1 + n for n in range(len(lights))])
            self._numbers = mi.UInt32(numbers)

    def sample(self, scene: Any, ref: Any, u: Any, active: Any) -> tuple[Any, Any]:
        """Sample a point on an emitter, as ``scene.sample_emitter_direction(ref, u, False, active)``.

        Args:
            ref: Interaction3f that the light is seen from.
            u: two uniform numbers, Point2f.

        Returns:
            (DirectionSample3f, emission over density).
        """
        if not self._shapes:
            return scene.sample_emitter_direction(ref, u, False, active)
        number, choice, x = scene.sample_emitter(u.x, active)
        emitter = dr.gather(mi.EmitterPtr, scene.emitters_dr(), number, active)
        ds, weight = self.sample_direction(emitter, ref, mi.Point2f(x, u.y), active)
        ds.pdf *= scene.pdf_emitter(number, active)
        return ds, weight * choice

    def sample_direction(self, emitter: Any, ref: Any, u: Any, active: Any) -> tuple[Any, Any]:
        """Sample a point on given emitters, as ``emitter.sample_direction(ref, u, active)``.

        Args:
            emitter: EmitterPtr.
            ref: Interaction3f that the light is seen from.
            u: two uniform numbers, Point2f.

        Returns:
            (DirectionSample3f, emission over density).
        """
        if not self._shapes:
            return emitter.sample_direction(ref, u, active)
        slot = self._marks.look_up(emitter, active)
        listed = slot > 0
        with dr.suspend_grad():
            ds = _call_each([_sampler_of(*shape) for shape in self._shapes], slot, listed, ref, u)
        ds.emitter = emitter
        ds.pdf = dr.select(dr.dot(ds.d, ds.n) < 0, ds.pdf, 0)
        weight = emitter.eval_direction(ref, ds, listed) * dr.select(ds.pdf > 0, dr.rcp(ds.pdf), 0)
        if self._all:
            return ds, weight
        other, other_weight = emitter.sample_direction(ref, u, active & ~listed)
        return dr.select(listed, ds, other), dr.select(listed, weight, other_weight)

    def pdf(self, scene: Any, ref: Any, ds: Any, active: Any) -> Any:
        """Return the density of :meth:`sample` per solid angle, as ``scene.pdf_emitter_direction(ref, ds, active)``."""
        if not self._shapes:
            return scene.pdf_emitter_direction(ref, ds, active)
        slot = self._marks.look_up(ds.emitter, active)
        listed = slot > 0
        lit = listed & (dr.dot(ds.d, ds.n) < 0)
        with dr.suspend_grad():
            pdf = _call_each([shape.pdf_direction for shape, _ in self._shapes], slot, lit, ref, ds)
        pdf *= scene.pdf_emitter(dr.gather(mi.UInt32, self._numbers, slot - 1, listed), listed)
        if self._all:
            return pdf
        return dr.select(listed, pdf, scene.pdf_emitter_direction(ref, ds, active & ~listed))


def _call_each(methods: list[Any], slot: Any, active: Any, ref: Any, *arguments: Any) -> Any:
    """Call a method of the listed lights' shapes.

    Not by shape pointers: Dr.Jit would trace it for all shapes, some of which cannot be sampled.
    """
    place = mi.Interaction3f(0.0, ref.time, ref.wavelengths, ref.p, ref.n)
    return dr.switch(dr.select(active, slot - 1, 0), methods, place, *arguments, active)


def _sampler_of(shape: Any, inside_out: bool) -> Any:
    """Return the method of a shape that samples directions, with the normals that rays find."""
    if not inside_out:
        return shape.sample_direction

    def sample(ref: Any, u: Any, active: Any) -> Any:
        ds = shape.sample_direction(ref, u, active)
        ds.n = -ds.n
        return ds

    return sample


def _is_listed(emitter: Any) -> bool:
    shape = emitter.get_shape()
    if shape is None or is_sphere(shape) or not samples_its_shape(emitter):
        return False
    textured = mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying)
    if not textured or emitter.class_name() != "AreaLight":
        return _is_inside_out(shape)
    (radiance,) = (texture for name, texture in objects_of(emitter) if name == "radiance")
    return not (_fills_the_unit_square(shape) and _is_plain_bitmap(radiance))


def _fills_the_unit_square(shape: Any) -> bool:
    """Return True if texture coordinates lie on a shape as Mitsuba's sampling of textures assumes."""
    return bool(shape.class_name() == "Rectangle" and not shape.has_flipped_normals())


def _is_plain_bitmap(texture: Any) -> bool:
    """Return True if a texture is a bitmap without a transform, which Mitsuba 3.9 ignores where it draws texels."""
    if not texture.class_name().startswith("BitmapTextureImpl"):
        return False
    return np.array_equal(_matrix(texture, "to_uv"), np.eye(3).ravel())


def _is_inside_out(shape: Any) -> bool:
    """Return True if rays find the opposite of the normals that a shape is sampled with."""
    if shape.class_name() != "Cylinder":
        return False
    return bool(np.linalg.det(_matrix(shape, "to_world").reshape(4, 4)) < 0)


def _matrix(node: Any, key: str) -> np.ndarray:
    (transform,) = (shown.read(node) for shown in shown_by(node)[0] if shown.key == key)
    return np.array(transform.matrix, dtype=float).ravel()


# ----------------------------------------------------------------------------------------------------------------------

# How many numbers of a light kernels load at once.
_PACKET = 4


class SphereLights:
    """Spherical lights of a scene.

    Args:
        scene: scene of the lights.
        numbers: their numbers among its emitters.

    Attributes:
        all: there are no other lights.
        others: :class:`ShapeLights`, which samples these.
        textured: one of the spheres has a texture.
        marks: table of emitters: one plus the place of each sphere in the table, zero for other lights.
        least_pmf: probability below which a light is rarely drawn (:func:`.lights.least_probability`).
    """

    def __init__(self, scene: Any, numbers: list[int]) -> None:
        lights = scene.emitters()
        emitters = [lights[n] for n in numbers]
        self.others = ShapeLights(scene)
        self._numbers, self.all = numbers, len(numbers) == len(lights)
        self.least_pmf = least_probability(len(lights))
        self._shapes = [emitter.get_shape() for emitter in emitters]
        self._to_world = [next(v for v in shown_by(shape)[0] if v.key == "to_world") for shape in self._shapes]
        self.textured = any(t.is_spatially_varying() for e in emitters for t in objects_below(e, mi.Texture))
        self.marks = PointerTable(emitters, [1 + n for n in range(len(emitters))])
        self._cache = Cache([*self._shapes, *lights])

    @staticmethod
    def from_scene(scene: Any) -> SphereLights | None:
        """Return the spherical lights of ``scene``, None when it has none."""
        numbers = [n for n, emitter in enumerate(scene.emitters()) if _is_sphere_light(emitter)]
        return SphereLights(scene, numbers) if numbers else None

    def read(self, scene: Any) -> SphereLightTable:
        """Return the table of the lights with their current numbers, attached where their shapes are.

        Called outside of loops, once a job.
        """
        table = self._cache.get("cones", None, lambda: self._detached(scene))
        with dr.resume_grad():
            attached = [n for n in range(len(self._shapes)) if dr.grad_enabled(self._matrix(n))]
            return table.attached({n: self._numbers_of(scene, n) for n in attached}) if attached else table

    def _detached(self, scene: Any) -> SphereLightTable:
        with dr.suspend_grad():
            rows = [self._numbers_of(scene, n) for n in range(len(self._shapes))]
            for row in rows:  # by one kernel after the other, all alike: one of all rows takes minutes to compile
                dr.make_opaque(row)
            return SphereLightTable(self, rows)

    def _matrix(self, n: int) -> Any:
        return self._to_world[n].read(self._shapes[n]).matrix

    def _numbers_of(self, scene: Any, n: int) -> list[Any]:
        """Return the row of a light in the table.

        Centre, radius, its square, squared distance up to which a point is inside, sign of the outward normal,
        probability of choosing the light; where there are textures the matrix.
        """
        matrix = self._matrix(n)
        outward = -1.0 if self._shapes[n].has_flipped_normals() else 1.0
        pmf = scene.pdf_emitter(dr.opaque(mi.UInt32, self._numbers[n]))
        r = dr.norm(mi.Vector3f(matrix[0, 0], matrix[1, 0], matrix[2, 0]))
        # Points on the surface itself see it from the side that shines.
        edge = dr.detach(r) * (1 - outward * mi.math.RayEpsilon)
        numbers = [matrix[0, 3], matrix[1, 3], matrix[2, 3], r, dr.square(r), dr.square(edge), outward, pmf]
        if self.textured:
            numbers += [matrix[row, column] for row in range(3) for column in range(3)]
            numbers += [0.0] * (-len(numbers) % _PACKET)
        return [mi.Float(number) for number in numbers]


def _is_sphere_light(emitter: Any) -> bool:
    shape = emitter.get_shape()
    return shape is not None and is_sphere(shape) and samples_its_shape(emitter)


class SphereLightTable:
    """Spherical lights as kernels read them. Not a dataclass: Dr.Jit loops would take it apart.

    Args:
        lights: the lights.
        rows: numbers of each, by :meth:`SphereLights.read`.
    """

    def __init__(self, lights: SphereLights, rows: list[list[Any]]) -> None:
        self._marks, self.all, self._least_pmf = lights.marks, lights.all, lights.least_pmf
        self._others = lights.others
        self._rows, self._width = rows, len(rows[0])
        # Where there is only one, kernels read its numbers as they are instead of looking them up.
        self._only = rows[0] if len(rows) == 1 else None
        self._values = None if self._only else self._laid_out(rows)

    def _laid_out(self, rows: list[list[Any]]) -> Any:
        if not dr.flag(dr.JitFlag.FreezingScope):
            return mi.Float(np.array(rows, dtype=np.float32).reshape(-1))
        values = dr.zeros(mi.Float, self._width * len(rows))
        self._write(values, dict(enumerate(rows)))
        return values

    def _write(self, values: Any, rows: dict[int, list[Any]]) -> None:
        for n, row in rows.items():
            for k, number in enumerate(row):
                dr.scatter(values, number, mi.UInt32(self._width * n + k))

    def attached(self, rows: dict[int, list[Any]]) -> SphereLightTable:
        """Return a table with attached rows at some places, gathered from one array, at which gradients arrive.

        Args:
            rows: attached numbers by place.
        """
        table = copy.copy(self)
        table._only, table._values = None, mi.Float(self._laid_out(self._rows))
        table._write(table._values, rows)
        return table

    def tables(self) -> list[Any]:
        """Return the arrays that are attached where parameters are."""
        return [] if self._values is None else [self._values]

    def kept_in_cone(self, emitter: Any, x: Any, y: Any, ref: Any, active: Any) -> Any:
        """Return the point of a sphere that keeps its place in the cone while the viewer moves.

        Args:
            emitter: EmitterPtr of the sphere.
            x: viewer without derivatives, Point3f.
            y: point of the sphere seen from ``x``, Point3f.
            ref: Interaction3f of the viewer, attached.

        Returns:
            DirectionSample3f seen from ``ref``, attached.
        """
        with dr.suspend_grad():
            sphere = _Sphere(self, emitter, x, active)
            center, d = dr.normalize(sphere.to_center), dr.normalize(y - x)
            local = mi.Frame3f(center).to_local(d)
            φ = dr.atan2(local.y, local.x) / dr.two_pi
            u = mi.Point2f(dr.clip((1 - dr.dot(center, d)) / sphere.versine_max, 0, 1), φ - dr.floor(φ))
        return _Sphere(self, emitter, ref.p, active).sampled(u, ref)

    def lists(self, emitter: Any, active: Any = True) -> Any:
        """Return a mask of emitters (EmitterPtr) that are spherical lights."""
        return self._marks.look_up(emitter, active) > 0

    def draws(self, emitter: Any) -> Any:
        """Return a mask of emitters (EmitterPtr) that are spherical lights and not rarely drawn."""
        listed = self.lists(emitter)
        return listed & (self.numbers(emitter, listed)[7] >= self._least_pmf)

    def sample(self, scene: Any, ref: Any, u: Any, active: Any) -> tuple[Any, Any]:
        """Sample a point on an emitter of the scene, as ``scene.sample_emitter_direction(ref, u, False, active)``.

        Args:
            ref: Interaction3f that the light is seen from.
            u: two uniform numbers, Point2f.

        Returns:
            (DirectionSample3f, emission over density), attached where ``ref`` and the spheres are.
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
        other, other_weight = self._others.sample_direction(emitter, ref, mi.Point2f(x, u.y), active & ~spherical)
        other.pdf *= scene.pdf_emitter(number, active)
        return dr.select(spherical, ds, other), dr.select(spherical, weight, other_weight * choice)

    def pdf(self, scene: Any, ref: Any, ds: Any, active: Any) -> Any:
        """Return the density of :meth:`sample` per solid angle, as ``scene.pdf_emitter_direction(ref, ds, active)``."""
        spherical = active if self.all else active & self.lists(ds.emitter, active)
        sphere = _Sphere(self, ds.emitter, ref.p, spherical)
        pdf = dr.select(spherical, sphere.density(ds, -dr.dot(ds.d, ds.n)) * sphere.pmf, 0)
        if self.all:
            return pdf
        return dr.select(spherical, pdf, self._others.pdf(scene, ref, ds, active & ~spherical))

    def numbers(self, emitter: Any, active: Any) -> list[Any]:
        """Return the rows of the lights that ``emitter`` (EmitterPtr) points to, a list of Float."""
        if self._only is not None:
            return self._only
        slot = self._marks.look_up(emitter, active)
        known = slot > 0
        packets = self._width // _PACKET
        first = dr.select(known, slot - 1, 0) * packets
        return [x for k in range(packets) for x in dr.gather(mi.Vector4f, self._values, first + k, known)]


class _Sphere:
    """Spherical light per lane, seen from ``p``: ``outside`` (where ``p`` is), ``solid_angle`` of the cone, ``pmf``."""

    def __init__(self, table: SphereLightTable, emitter: Any, p: Any, active: Any) -> None:
        x, y, z, self.radius, r2, edge2, self.outward, self.pmf, *self.matrix = table.numbers(emitter, active)
        self.center = mi.Point3f(x, y, z)
        # Idle lanes look at a unit sphere from outside: what they hold must not have an infinite derivative.
        self.square = dr.select(active, r2, 1)
        self.to_center = dr.select(active, self.center - p, mi.Vector3f(0, 0, 2))
        d2 = dr.squared_norm(self.to_center)
        self.outside = d2 > dr.select(active, edge2, 1)
        self.distance2 = dr.select(self.outside, d2, 4 * self.square)
        self.sin2_max = dr.minimum(self.square / self.distance2, 1)
        # (1 - cos_max) / sin_max^2
        self.versine_over_square = dr.rcp(1 + dr.sqrt(dr.maximum(1 - self.sin2_max, 1e-12)))
        self.versine_max = self.sin2_max * self.versine_over_square
        self.solid_angle = 2 * dr.pi * self.versine_max

    def density(self, ds: Any, cos: Any) -> Any:
        """Return the density per solid angle of a point, zero on its dark side (``cos`` of its normal below 0)."""
        lit = (cos > 0) & (ds.dist > 0)
        from_inside = 4 * dr.pi * self.square * dr.select(lit, cos, 1)
        pdf = dr.select(self.outside, 1, dr.square(ds.dist)) / dr.select(self.outside, self.solid_angle, from_inside)
        return dr.select(lit, pdf, 0)

    def sampled(self, u: Any, ref: Any) -> Any:
        """Return the DirectionSample3f of two uniform numbers, without an emitter.

        Outside, the direction is uniform in the cone: with ``1 - cos = u (1 - cos_max)`` the sine is ``a sin_max``; the
        law of sines gives the distance and the angle at the center. The root of ``u`` stands alone: that of a product
        would have an infinite derivative at zero. Inside, the point is uniform on the sphere.
        """
        outside, s, distance = self.outside, dr.sqrt(self.sin2_max), dr.sqrt(self.distance2)
        versine = u.x * self.versine_max
        share = (2 - versine) * self.versine_over_square
        root = dr.sqrt(u.x)
        a = root * dr.sqrt(share)
        sin, cos = a * s, 1 - versine
        q = dr.sqrt(dr.maximum(1 - u.x * share, 1e-12))
        near = cos - s * q
        sin_center = dr.select(outside, a * near, 2 * root * dr.safe_sqrt(1 - u.x))
        cos_center = dr.select(outside, dr.fma(a, sin, cos * q), 1 - 2 * u.x)

        sin_phi, cos_phi = dr.sincos(u.y * (2 * dr.pi))
        frame = mi.Frame3f(dr.select(outside, self.to_center / distance, mi.Vector3f(0, 0, 1)))
        across = dr.fma(frame.s, cos_phi, frame.t * sin_phi)
        normal = across * sin_center - frame.n * cos_center
        # From the center, since that of the sum below is lost where the sphere is far away and small.
        away = dr.select(outside, mi.Vector3f(0, 0, 1), dr.fma(normal, self.radius, self.to_center))
        inside_distance = dr.norm(away)
        ds = dr.zeros(mi.DirectionSample3f)
        ds.p = dr.fma(normal, self.radius, self.center)
        ds.n = normal * self.outward
        ds.dist = dr.select(outside, distance * near, inside_distance)
        ds.d = dr.select(outside, dr.fma(across, sin, frame.n * cos), away / inside_distance)
        ds.time = ref.time
        ds.pdf = self.density(ds, dr.abs_dot(ds.d, ds.n))
        if self.matrix:
            ds.uv = self._uv(normal)
        return ds

    def _uv(self, normal: Any) -> Any:
        """Return the texture coordinates of the point with an outward normal: ``to_world`` is a similarity."""
        m = self.matrix
        x, y, z = (dr.dot(mi.Vector3f(m[k], m[3 + k], m[6 + k]), normal) for k in range(3))
        phi = dr.atan2(y, x)
        phi = dr.select(phi < 0, phi + 2 * dr.pi, phi)
        across = dr.sqrt(dr.maximum(dr.square(x) + dr.square(y), 1e-30))
        return mi.Point2f(phi / (2 * dr.pi), dr.atan2(across, z) / dr.pi)
