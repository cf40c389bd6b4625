"""Properties that the dielectric plugins read: the relative index and the textures of the two lobes."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.errors import SceneError


def relative_index(props: Any, plugin: str, default: str = "bk7") -> Any:
    """``int_ior / ext_ior`` as a Dr.Jit scalar; each a number or a material name, by ``default`` in ``air``.

    Names are looked up by Mitsuba itself: its own ``dielectric`` is built from the same two values and asked for its
    ``eta``, so that the table of materials and its spelling are the installed version's.
    """
    sides = {"int_ior": default} | {name: props[name] for name in ("int_ior", "ext_ior") if name in props}
    sides = {name: value if isinstance(value, str) else float(value) for name, value in sides.items()}
    for name, value in sides.items():
        if not isinstance(value, str) and not value > 0:
            raise SceneError(
                f"{plugin}: '{name}' must be an index of refraction above 0 or a material's name, got {value}."
            )
    twin = mi.load_dict({"type": "dielectric", **sides})
    return opaque(mi.Float(mi.traverse(twin)["eta"]))


def optional_texture(props: Any, name: str) -> Any | None:
    """The texture of a lobe, or None (a factor of one) when the scene does not give it."""
    return props.get_texture(name) if name in props else None


def opaque(value: Any) -> Any:
    """Keep ``value`` out of the kernels' source text, so that a new value does not compile a new kernel."""
    if dr.is_jit_v(value):
        dr.make_opaque(value)
    return value


def textured(value: Any, texture: Any | None, si: Any, active: Any) -> Any:
    """``value`` times the texture's colour at ``si``, as an unpolarised spectrum; a factor of one without a texture."""
    if texture is None:
        return mi.UnpolarizedSpectrum(value)
    return texture.eval(si, active) * value
