"""What textures read, and textures in places where they cannot be read: found before anything is rendered, not inside
a kernel or never.

A bump map asks for the slope of its texture: of Mitsuba's, bitmaps have one, and what is the same everywhere. A point
that is sampled on a light knows neither its shape nor its face: attributes of shapes read as zero there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.errors import SceneError
from torchtransient.plugins.mitsuba_compat import attribute_name, is_bump_map, is_dark, normal_texture
from torchtransient.plugins.node_walk import objects_below, objects_of, shown_by


def numbers_below(node: Any, shapes: Sequence[Any]) -> Iterator[Any]:
    """The numbers of a plugin and of what it holds, attached where they are; ``shapes``: those whose attributes its
    textures read. Attributes belong to the shapes.
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
    """Raise ``SceneError`` where a built scene (``mi.traverse``) has a texture in a place where it cannot be read."""
    for node in params.hierarchy:
        if isinstance(node, mi.BSDF) and is_bump_map(node):
            _check_heights(node)
        elif isinstance(node, mi.Emitter) and not is_dark(node):
            _check_radiance(node)


def _check_heights(bump_map: Any) -> None:
    texture = dict(objects_of(bump_map))[normal_texture(bump_map)]
    reason = _lack_of_slope(texture)
    if reason:
        raise SceneError(
            f"{bump_map.id()!r}: expected a texture of heights with a slope in a bumpmap, got {_named(texture)}, of "
            f"which Mitsuba says: {reason}. Give the heights as a raw 'bitmap'."
        )


def _lack_of_slope(texture: Any) -> str:
    """Why a texture has no slope, in Mitsuba's words; empty where it has one."""
    try:
        with dr.suspend_grad():
            texture.eval_1_grad(dr.zeros(mi.SurfaceInteraction3f))
    except (RuntimeError, TypeError, AttributeError) as error:
        return str(error).strip().splitlines()[0].rstrip("!.")
    return ""


def _check_radiance(emitter: Any) -> None:
    for texture in objects_below(emitter, mi.Texture):
        name = attribute_name(texture)
        if name is not None:
            raise SceneError(
                f"{emitter.id()!r}: expected a texture that can be read where a light is sampled, got the attribute "
                f"{name!r} ({_named(texture)}), which Mitsuba takes for zero there: most of the light would be lost. "
                "Give the radiance as a 'bitmap' over texture coordinates."
            )


def _named(texture: Any) -> str:
    return f"{texture.class_name()} {texture.id()!r}" if texture.id() else str(texture.class_name())
