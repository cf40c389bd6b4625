"""Bounding sphere of a scene before any value was installed in it: the time reference of distant light.

A Mitsuba scene has no place for it, and its own environment emitters follow the shapes that move. The scene's Python
plugins keep it: its integrator, the films of its sensors, and whatever integrator renders it. They record it

- when ``mi.traverse`` walks the scene, the one way by which values come in (:func:`note_scene`);
- when the scene is rendered and none has recorded it before: then nothing was installed yet.

So it does not depend on what is rendered first. Where the values came in otherwise, for instance by ``mi.traverse`` of
a single shape, or where neither the scene's integrator nor a film of its sensors is one of this library, it is that of
the first render.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from torchtransient.errors import SceneError
from torchtransient.interfaces import IntegratorInterface, is_time_resolved
from torchtransient.plugins.mitsuba_compat import (
    VERTEX_COLUMNS,
    attribute_name,
    attribute_sizes,
    has_texcoords,
    is_bump_map,
    is_dark,
    normal_texture,
    read_as,
    scene_parameters,
)
from torchtransient.plugins.mitsuba_shapes import has_surface
from torchtransient.plugins.node_walk import objects_below, objects_of, shown_by
from torchtransient.plugins.parameter_effect import class_of
from torchtransient.plugins.properties import check_parameters
from torchtransient.plugins.sampling.lights import distant_reference

# ----------------------------------------------------------------------------------------------------------------------
# What textures read, and textures in places where they cannot be read: found before anything is rendered, not inside
# a kernel or never.
#
# A bump map asks for the slope of its texture: of Mitsuba's, bitmaps have one, and what is the same everywhere.
# Attributes that a shape does not have, or of another number of values than a surface asks for, read as zero; so do all
# of them where a point is sampled on a light, which knows neither its shape nor its face.


def numbers_below(node: Any, shapes: Sequence[Any]) -> Iterator[Any]:
    """Yield the numbers of a plugin and of all that it holds, attached where they are.

    Attributes of meshes belong to the shapes: those that textures below ``node`` read are among the numbers.

    Args:
        node: Mitsuba object.
        shapes: shapes whose attributes the textures of ``node`` may read.
    """
    below = (node, *objects_below(node, mi.Object))
    for part in below:
        yield from (shown.read(part) for shown in shown_by(part)[0])
    names = {attribute_name(part) for part in below if isinstance(part, mi.Texture)} - {None}
    for shape in shapes if names else ():
        values, objects = shown_by(shape)
        yield from (shown.read(shape) for shown in values if shown.key in names)
        for name, texture, _ in objects:
            if name in names:
                yield from numbers_below(texture, ())


def check_textures(params: Any) -> None:
    """Check that each texture of a built scene is in a place where it can be read.

    Args:
        params: ``mi.traverse`` of the scene.

    Raises:
        SceneError: for textures whose channels, slopes, attributes or texture coordinates are not those that the plugin
            or shape around them reads.
    """
    somewhere = dr.zeros(mi.SurfaceInteraction3f)
    for node in params.hierarchy:
        if isinstance(node, mi.BSDF) and is_bump_map(node):
            _check_heights(node, somewhere)
        elif isinstance(node, mi.Emitter) and not is_dark(node):
            _check_radiance(node)
        if isinstance(node, mi.BSDF | mi.Emitter):
            _check_channels(node, somewhere)
    shown = {node.ptr for node in params.hierarchy}
    has_readers = any(isinstance(node, mi.Texture) and attribute_name(node) is not None for node in params.hierarchy)
    read: dict[int, list[Read]] = {}
    for node in params.hierarchy:
        surface = node.bsdf() if isinstance(node, mi.Shape) and has_surface(node) else None
        # Some shapes (ellipsoids) do not show their surface.
        if surface is not None and (has_readers or surface.ptr not in shown):
            _check_attributes(node, surface, read)


def _check_channels(node: Any, somewhere: Any) -> None:
    """Raise for a texture that cannot be read: it would end the kernels of all living scenes."""
    for slot, texture in objects_of(node):
        how = read_as(node, slot) if isinstance(texture, mi.Texture) else ""
        reason = _refusal(texture, how, somewhere) if how else ""
        if reason:
            raise SceneError(
                f"{node.id()!r}: expected a texture for {slot!r} that can be read as "
                f"{_READ[how]}, got {_named(texture)}, of which Mitsuba says: {reason}. Give one with that many "
                "channels, colours in spectral variants without raw=True."
            )


_READ = {"eval_1": "one number", "eval_3": "three numbers", "eval": "a colour"}


def _refusal(texture: Any, how: str, somewhere: Any) -> str:
    """Why a method of a texture fails, in Mitsuba's words without its pictures of objects; empty where it does not."""
    try:
        with dr.suspend_grad():
            getattr(texture, how)(somewhere)
    except (RuntimeError, TypeError, AttributeError) as error:
        words = re.sub(r"\w+\[\n.*\n\]", "", str(error), flags=re.DOTALL)
        return " ".join(words.split()).rstrip("!.")
    return ""


class Read(NamedTuple):
    """An attribute that a surface reads: its name, the texture, the slot that this is for, numbers it may have."""

    name: str
    texture: Any
    slot: str
    sizes: tuple[int, ...]


def _check_attributes(shape: Any, surface: Any, known: dict[int, list[Read]]) -> None:
    """Check the attributes that a surface reads. ``known``: attributes read by the surfaces checked before, by address.
    """
    if surface.ptr not in known:
        known[surface.ptr] = list(_attributes_of(surface))
    for read in known[surface.ptr]:
        sizes = _sizes_of_attributes(shape)
        message = f"{shape.id()!r}: expected an attribute {read.name!r} for {read.slot!r} of its surface"
        if read.name not in sizes:
            has = ", ".join(map(repr, sizes)) or "none"
            raise SceneError(
                f"{message} ({_named(read.texture)}), got a shape that has {has}; Mitsuba would take it for zero. Give "
                "the shape the attribute, or the surface another texture."
            )
        size = sizes[read.name]
        if size is not None and size not in read.sizes:
            raise SceneError(
                f"{message} of size {' or '.join(map(str, read.sizes))} at each place, got one of size {size:g}, which "
                "Mitsuba would take for zero. Add an attribute of that size (mesh.add_attribute) or give a 'bitmap'."
            )


def _attributes_of(surface: Any) -> Iterator[Read]:
    for bsdf in (surface, *objects_below(surface, mi.BSDF)):
        for slot, texture in objects_of(bsdf):
            for part in (texture, *objects_below(texture, mi.Texture)) if isinstance(texture, mi.Texture) else ():
                name = attribute_name(part)
                if name is not None:
                    yield Read(name, part, slot, attribute_sizes(bsdf, slot))


def _sizes_of_attributes(shape: Any) -> dict[str, float | None]:
    """The attributes of a shape, by name: how many numbers they have at each place, None where a texture says so."""
    values, objects = shown_by(shape)
    found: dict[str, float | None] = {name: None for name, part, _ in objects if isinstance(part, mi.Texture)}
    for shown in values if isinstance(shape, mi.Mesh) else ():
        count = {"vertex": shape.vertex_count, "face": shape.face_count}.get(shown.key.partition("_")[0])
        if count is not None and shown.key not in VERTEX_COLUMNS and dr.is_array_v(shown.read(shape)):
            found[shown.key] = dr.width(shown.read(shape)) / max(count(), 1)
    return found


def _check_heights(bump_map: Any, somewhere: Any) -> None:
    texture = dict(objects_of(bump_map))[normal_texture(bump_map)]
    reason = _refusal(texture, "eval_1_grad", somewhere)
    if reason:
        raise SceneError(
            f"{bump_map.id()!r}: expected a texture of heights with a slope in a bumpmap, got {_named(texture)}, of "
            f"which Mitsuba says: {reason}. Give the heights as a raw 'bitmap'."
        )


def _check_radiance(emitter: Any) -> None:
    for texture in objects_below(emitter, mi.Texture):
        name = attribute_name(texture)
        if name is not None:
            raise SceneError(
                f"{emitter.id()!r}: expected a texture that can be read where a light is sampled, got the attribute "
                f"{name!r} ({_named(texture)}), which Mitsuba takes for zero there: most of the light would be lost. "
                "Give the radiance as a 'bitmap' over texture coordinates."
            )
    shape = emitter.get_shape()
    textured = mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying)
    if textured and isinstance(shape, mi.Mesh) and not has_texcoords(shape):
        # Mitsuba's sampling of textures raises while kernels are traced, those of other scenes too.
        raise SceneError(
            f"{shape.id()!r}: expected texture coordinates of a mesh that shines with a texture, got a mesh without. "
            "Give it some, or a radiance that is the same everywhere."
        )


def _named(texture: Any) -> str:
    return f"{class_of(texture)} {texture.id()!r}" if texture.id() else class_of(texture)


# ----------------------------------------------------------------------------------------------------------------------


class DescribedScene:
    """State of a scene as described.

    The scene is identified by its address and those of its shapes. One shape is kept, so that no later scene gets the
    same addresses: one without a sensor, whose film may keep this object, as a cycle would never be freed.

    Args:
        scene: Mitsuba scene.

    Attributes:
        reference: the sphere around it.
        is_checked: its numbers and textures were checked.
    """

    def __init__(self, scene: Any) -> None:
        self.reference = distant_reference(scene)
        self._key = _key_of(scene)
        self._kept = [shape for shape in scene.shapes() if not shape.is_sensor()][:1]
        self.is_checked = False

    def is_of(self, scene: Any) -> bool:
        """Return True if ``scene`` is the scene of this state."""
        return self._key == _key_of(scene)


def described(scene: Any, *plugins: Any) -> DescribedScene:
    """Return the state of a scene as described, which is recorded once.

    Args:
        scene: Mitsuba scene.
        plugins: further plugins that keep the state, beside those of the scene.
    """
    keepers = [*plugins, *_keepers_of(scene)]
    known = (getattr(keeper, "described", None) for keeper in keepers)
    found = next((state for state in known if state is not None and state.is_of(scene)), None)
    if found is None:
        found = DescribedScene(scene)
    for keeper in keepers:
        keeper.described = found
    return found


def note_scene(plugin: Any, callback: Any) -> None:
    """Record the scene that ``mi.traverse`` walks; for the ``traverse`` of a plugin that keeps a described scene.

    Such a scene is as described, or was recorded before.

    Args:
        plugin: plugin that is walked through.
        callback: ``mi.TraversalCallback`` of the walk.
    """
    # Mitsuba's own callback knows the way down to each plugin; others do not install values.
    hierarchy = getattr(callback, "hierarchy", {})
    above = plugin
    while above is not None and not isinstance(above, mi.Scene):
        above = hierarchy.get(above, (None, 0))[0]
    if above is not None:
        described(above)


def check_scene(scene: Any, params: Any = None, known: DescribedScene | None = None) -> None:
    """Check the numbers and textures of a scene, once.

    Args:
        scene: Mitsuba scene.
        params: the scene's parameters by users' keys, if the caller has them.
        known: the scene's :class:`DescribedScene`, if the caller has it.

    Raises:
        SceneError: if a number is NaN or infinite, or a texture stands where it cannot be read.
    """
    known = known or described(scene)
    if known.is_checked or dr.flag(dr.JitFlag.FreezingScope):  # a recording has no values
        return
    params = scene_parameters(scene) if params is None else params
    check_parameters(params)
    check_textures(params)
    known.is_checked = True


def _keepers_of(scene: Any) -> list[Any]:
    films = (sensor.film() for sensor in scene.sensors())
    integrator = scene.integrator()
    own = [integrator] if isinstance(integrator, IntegratorInterface) else []
    return [*own, *(film for film in films if is_time_resolved(film))]


def _key_of(scene: Any) -> tuple[int, ...]:
    return (scene.ptr, *(shape.ptr for shape in scene.shapes()))
