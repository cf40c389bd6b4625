"""Whether what happens at a surface differs from place to place: where a vertex slides, that changes too."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import mitsuba as mi

from torchtransient.plugins.mitsuba_compat import EMIT_ALIKE, SCATTER_ALIKE, is_flat_shape, varies
from torchtransient.plugins.node_walk import objects_below


def scatters_by_place(bsdf: Any) -> bool:
    """Whether a BSDF, or one that it holds, may scatter otherwise at another place of a flat surface."""
    held = [bsdf, *objects_below(bsdf, mi.BSDF)]
    return _varies_by_texture(bsdf) or not all(_is_known(one, SCATTER_ALIKE) for one in held)


def emits_by_place(emitter: Any) -> bool:
    """Whether the light that leaves a surface in a given direction may differ from place to place: a texture, or what
    counts angles from the normal of a curved shape. Mitsuba's ``area`` asks for the side alone.
    """
    if not mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface):
        return False
    declared = mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying)
    if declared or _varies_by_texture(emitter) or not _is_known(emitter, EMIT_ALIKE):
        return True
    return emitter.class_name() != "AreaLight" and not is_flat_shape(emitter.get_shape())


def _varies_by_texture(plugin: Any) -> bool:
    textures = objects_below(plugin, mi.Texture)
    return any(varies(t) or _room(t) not in ("mitsuba", "torchtransient") for t in textures)


def _is_known(plugin: Any, names: Iterable[str]) -> bool:
    """Whether a plugin is one of ours, or of these classes of Mitsuba."""
    return _room(plugin) == "torchtransient" or (_room(plugin) == "mitsuba" and plugin.class_name() in names)


def _room(plugin: Any) -> str:
    """The package that a plugin is written in."""
    return type(plugin).__module__.split(".")[0]
