"""Area lights whose samples Mitsuba's own would not cover, sampled over their shapes.

Of a light with a texture, Mitsuba draws a place of the texture in [0, 1]^2 and asks the shape for the point there
(``eval_parameterization``). That point is one of several where parts of a mesh share a piece of the texture, none where
texture coordinates lie outside, another one for a cylinder that is turned or scaled, and seen from behind for a
rectangle with flipped normals. What is never drawn has a density nevertheless: the light is too dark. So the shape
draws a point of all of its area. Rectangles with a bitmap over all of them are left to Mitsuba, which draws bright
texels more often. A mirrored cylinder has other normals where it is sampled than where rays meet it.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.plugins.mitsuba_compat import is_sphere, samples_its_shape
from torchtransient.plugins.node_walk import objects_of, shown_by
from torchtransient.plugins.pointer_table import PointerTable


class ShapeLights:
    """The lights of a scene that are sampled over their shapes; all others are left to Mitsuba.

    Spheres are sampled over their cones (:mod:`.sphere_lights`). Nothing here is attached.
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
        """(direction sample, emission over density), as ``scene.sample_emitter_direction(ref, u, False, active)``."""
        if not self._shapes:
            return scene.sample_emitter_direction(ref, u, False, active)
        number, choice, x = scene.sample_emitter(u.x, active)
        emitter = dr.gather(mi.EmitterPtr, scene.emitters_dr(), number, active)
        ds, weight = self.sample_direction(emitter, ref, mi.Point2f(x, u.y), active)
        ds.pdf *= scene.pdf_emitter(number, active)
        return ds, weight * choice

    def sample_direction(self, emitter: Any, ref: Any, u: Any, active: Any) -> tuple[Any, Any]:
        """As ``emitter.sample_direction(ref, u, active)`` of an array of emitter pointers."""
        if not self._shapes:
            return emitter.sample_direction(ref, u, active)
        slot = self._marks.look_up(emitter, active)
        listed = slot > 0
        with dr.suspend_grad():
            ds = _asked([_sampler_of(*shape) for shape in self._shapes], slot, listed, ref, u)
        ds.emitter = emitter
        ds.pdf = dr.select(dr.dot(ds.d, ds.n) < 0, ds.pdf, 0)
        weight = emitter.eval_direction(ref, ds, listed) * dr.select(ds.pdf > 0, dr.rcp(ds.pdf), 0)
        if self._all:
            return ds, weight
        other, other_weight = emitter.sample_direction(ref, u, active & ~listed)
        return dr.select(listed, ds, other), dr.select(listed, weight, other_weight)

    def pdf(self, scene: Any, ref: Any, ds: Any, active: Any) -> Any:
        """Density of :meth:`sample` per solid angle, as ``scene.pdf_emitter_direction(ref, ds, active)``."""
        if not self._shapes:
            return scene.pdf_emitter_direction(ref, ds, active)
        slot = self._marks.look_up(ds.emitter, active)
        listed = slot > 0
        lit = listed & (dr.dot(ds.d, ds.n) < 0)
        with dr.suspend_grad():
            pdf = _asked([shape.pdf_direction for shape, _ in self._shapes], slot, lit, ref, ds)
        pdf *= scene.pdf_emitter(dr.gather(mi.UInt32, self._numbers, slot - 1, listed), listed)
        if self._all:
            return pdf
        return dr.select(listed, pdf, scene.pdf_emitter_direction(ref, ds, active & ~listed))


def _asked(methods: list[Any], slot: Any, active: Any, ref: Any, *arguments: Any) -> Any:
    """A method of the listed lights' shapes. Not a call of shape pointers: Dr.Jit would trace it for all shapes, some
    of which cannot be sampled.
    """
    place = mi.Interaction3f(0.0, ref.time, ref.wavelengths, ref.p, ref.n)
    return dr.switch(dr.select(active, slot - 1, 0), methods, place, *arguments, active)


def _sampler_of(shape: Any, inside_out: bool) -> Any:
    """The method of a shape that draws directions, with the normals that rays find."""
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
    """Return whether texture coordinates lie on a shape as Mitsuba's sampling of textures takes them to."""
    return bool(shape.class_name() == "Rectangle" and not shape.has_flipped_normals())


def _is_plain_bitmap(texture: Any) -> bool:
    """Return whether a texture is a bitmap without a transform, which Mitsuba 3.9 ignores where it draws texels."""
    if not texture.class_name().startswith("BitmapTextureImpl"):
        return False
    return np.array_equal(_matrix(texture, "to_uv"), np.eye(3).ravel())


def _is_inside_out(shape: Any) -> bool:
    """Return whether rays find the opposite of the normals that a shape is sampled with."""
    if shape.class_name() != "Cylinder":
        return False
    return bool(np.linalg.det(_matrix(shape, "to_world").reshape(4, 4)) < 0)


def _matrix(node: Any, key: str) -> np.ndarray:
    (transform,) = (shown.read(node) for shown in shown_by(node)[0] if shown.key == key)
    return np.array(transform.matrix, dtype=float).ravel()
