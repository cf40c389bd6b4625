"""What the participating media of a scene are like, looked up before tracing."""

from __future__ import annotations

import copy
from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.errors import GradientError


class MediaFacts:
    """Static choices for the walks through media.

    ``at_sensor``: the medium that the sensor stands in, or None. ``homogeneous``, ``heterogeneous``: whether there are
    media of that kind. ``open_boundaries``: some surface lets light through unbent (BSDF ``null``), so that straight
    lines go through several media. ``emitter_sampling``: every medium allows connections to emitters.

    For derivatives: ``recorded`` (the path is kept), ``legs_change`` (a transmittance can change), ``keeps_entry`` (the
    boundary before a vertex is kept, since the vertex may move with it).

    ``rate_floor`` (1 / m, None when no extinction is differentiated) is the smallest rate at which collisions are
    sampled: where the density is zero, its derivative is not, and is found by collisions alone.

    A plain class on purpose: Dr.Jit loops would take a dataclass apart as loop state.
    """

    def __init__(self, media: list[Any], at_sensor: Any, open_boundaries: bool, extent: float):
        self.media = media
        self.at_sensor = at_sensor
        self.homogeneous = any(m.is_homogeneous() for m in media)
        self.heterogeneous = any(not m.is_homogeneous() for m in media)
        self.emitter_sampling = all(m.use_emitter_sampling() for m in media)
        self.open_boundaries = open_boundaries
        self.extent = extent
        self.rate_floor = None
        self.recorded = False
        self.legs_change = False
        self.keeps_entry = False
        self.hide_emitters = False

    def with_gradients(self, geometry: bool) -> MediaFacts:
        """The same facts with the gradients that the media's attached parameters ask for; ``geometry``: path lengths
        change.
        """
        media = copy.copy(self)
        density = any(_density_attached(medium) for medium in self.media)
        media.recorded = True
        media.legs_change = geometry or density
        media.keeps_entry = geometry and self.open_boundaries
        if density:
            # Opaque: as a literal, every change of the scene's size would compile another kernel.
            media.rate_floor = dr.opaque(mi.Float, 0.5 / self.extent)
        return media

    def check_spheres(self, sphere_lights: bool) -> None:
        """Where path lengths change, spherical lights (``sphere_lights``) are sampled by connections alone, which every
        medium has to allow. Raises ``GradientError`` otherwise.
        """
        if sphere_lights and not self.emitter_sampling:
            raise GradientError(
                "transient_prbvolpath: derivatives of path lengths reach spherical lights through connections only, "
                "and a medium has sample_emitters = false. Set it to true, or use lights of another shape."
            )

    @property
    def one_stretch(self) -> bool:
        """Whether a straight line needs no loop: one medium up to the next surface, with one analytic step."""
        return not (self.heterogeneous or self.open_boundaries)


def media_facts(scene: Any, sensor: Any) -> MediaFacts | None:
    """The facts of a scene's media, None when it has none."""
    shapes = shapes_of_scene(scene)
    found = [sensor.get_medium() if sensor is not None else None]
    for shape in shapes:
        if shape.is_medium_transition():
            found += [shape.interior_medium(), shape.exterior_medium()]
    media = {medium.ptr: medium for medium in found if medium is not None}
    if not media:
        return None
    box = scene.bbox()
    extent = float(dr.norm(box.extents())) if box.valid() else 1.0
    return MediaFacts(list(media.values()), found[0], any(is_open(shape) for shape in shapes), max(extent, 1e-6))


def _density_attached(medium: Any) -> bool:
    """Whether a parameter that changes the extinction carries gradients: all but those of albedo and phase function."""
    others = ("albedo", "phase_function")
    return any(key.split(".")[0] not in others and dr.grad_enabled(value) for key, value in mi.traverse(medium))


def shapes_of_scene(scene: Any) -> list[Any]:
    """All shapes, those of shape groups included."""
    shapes = list(scene.shapes())
    if not any(shape.class_name() == "Instance" for shape in shapes):
        return shapes
    found: dict[int, Any] = {}
    visited: set[int] = set()

    class Callback(mi.TraversalCallback):
        def put(self, name: str, value: Any, flags: int, cpptype: Any = None) -> None:
            if not isinstance(value, mi.Object) or value.ptr in visited:
                return
            visited.add(value.ptr)
            if isinstance(value, mi.Shape):
                found[value.ptr] = value
            value.traverse(Callback())  # a callback cannot be entered twice

        put_object = put
        put_value = put

    scene.traverse(Callback())
    return list(found.values())


def is_open(shape: Any) -> bool:
    """Whether light passes ``shape`` unbent and unweakened, so that nothing happens there: a BSDF ``null``, no emitter.

    Works on one shape and on arrays of shape pointers.
    """
    sides = int(mi.BSDFFlags.FrontSide) | int(mi.BSDFFlags.BackSide)
    bsdf = shape.bsdf()
    if isinstance(shape, mi.Shape):
        return bsdf is not None and (int(bsdf.flags()) & ~sides) == int(mi.BSDFFlags.Null) and not shape.is_emitter()
    return ((bsdf.flags() & ~mi.UInt32(sides)) == int(mi.BSDFFlags.Null)) & ~shape.is_emitter()
