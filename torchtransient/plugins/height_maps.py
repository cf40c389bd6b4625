"""Whether the textures of bump maps have a slope: found before anything is rendered, not inside a kernel.

Of Mitsuba's textures, bitmaps have one, and what is the same everywhere: ``uniform``.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.errors import SceneError
from torchtransient.plugins.mitsuba_compat import is_bump_map, normal_texture
from torchtransient.plugins.node_walk import objects_of


def check_heights(params: Any) -> None:
    """Raise ``SceneError`` where a bump map of a built scene (``mi.traverse``) holds a texture without a slope."""
    for node in params.hierarchy:
        if isinstance(node, mi.BSDF) and is_bump_map(node):
            texture = dict(objects_of(node))[normal_texture(node)]
            reason = _lack_of(texture)
            if reason:
                name = f" {texture.id()!r}" if texture.id() else ""
                raise SceneError(
                    f"{node.id()!r}: expected a texture of heights with a slope in a bumpmap, got{name} "
                    f"{texture.class_name()}, of which Mitsuba says: {reason}. Give the heights as a raw 'bitmap'."
                )


def _lack_of(texture: Any) -> str:
    """Why a texture has no slope, in Mitsuba's words; empty where it has one."""
    try:
        with dr.suspend_grad():
            texture.eval_1_grad(dr.zeros(mi.SurfaceInteraction3f))
    except (RuntimeError, TypeError, AttributeError) as error:
        return str(error).strip().splitlines()[0].rstrip("!.")
    return ""
