"""Properties that the dielectric plugins read: the relative index, and the textures and shares of the two lobes."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.errors import SceneError
from torchtransient.plugins.node_walk import has_mean

# Each of two lobes is drawn at least this often where one of them is black, and in derivatives by their reflectances:
# the slope of a faint lobe is that of a bright one.
LEAST_SHARE = 0.25


def relative_index(props: Any, plugin: str, default: str = "bk7") -> Any:
    """Return ``int_ior / ext_ior`` of a plugin's properties as a Dr.Jit scalar.

    Names are looked up by Mitsuba itself: its own ``dielectric`` is built from the same two values and asked for its
    ``eta``, so that the table of materials and its spelling are the installed version's.

    Args:
        props: ``mi.Properties``; each index a number or a material's name.
        plugin: name of the plugin, for messages.
        default: ``int_ior`` without that property; ``ext_ior`` is air's.

    Raises:
        SceneError: for an index that is not above 0.
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
    """Return the texture of a lobe, or None (a factor of one) when the scene does not give it.

    Args:
        props: ``mi.Properties``.
        name: name of the texture.
    """
    return props.get_texture(name) if name in props else None


def specular_share(specular: Any | None, diffuse: Any, followed: bool) -> Any:
    """Return the detached share of the specular lobe among the samples, by the mean reflectances of both lobes.

    Textures that know no mean count as 0.5: any share is right.

    Args:
        specular: texture of the specular lobe, None for a factor of one.
        diffuse: texture of the diffuse lobe.
        followed: there are derivatives by one of the textures, which need samples of both lobes.
    """
    with dr.suspend_grad():
        d = mi.Float(diffuse.mean() if has_mean(diffuse) else 0.5)
        s = mi.Float(1 if specular is None else specular.mean() if has_mean(specular) else 0.5)
        share = s / dr.select(d + s > 0, d + s, 1)
        both = dr.clip(share, LEAST_SHARE, 1 - LEAST_SHARE)
        return opaque(both if followed else dr.select((d <= 0) | (s <= 0), both, share))


def opaque(value: Any) -> Any:
    """Keep a value out of the kernels' source text, so that a new value does not compile a new kernel.

    Args:
        value: Dr.Jit array, or a number, which is returned as it is.
    """
    if dr.is_jit_v(value):
        dr.make_opaque(value)
    return value


def textured(value: Any, texture: Any | None, si: Any, active: Any) -> Any:
    """Return a value times the colour of a texture, as an unpolarised spectrum.

    Args:
        value: Float.
        texture: ``mi.Texture``, None for a factor of one.
        si: SurfaceInteraction3f.
        active: mask of lanes.
    """
    if texture is None:
        return mi.UnpolarizedSpectrum(value)
    return texture.eval(si, active) * value
