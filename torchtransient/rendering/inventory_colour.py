"""Whether a node's spectra are grey, a colour that three numbers carry, or data over wavelength that they do not.

Grey means the same in monochromatic, RGB and spectral variants. Measured data keep their meaning in spectral variants
only: others reduce them to three numbers before light is reflected twice.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchtransient.plugins._registry import OWN_BSDFS
from torchtransient.plugins.drjit_pool import threads_for_files
from torchtransient.rendering.nodes import is_integrator

COLOUR, MEASURED = "colour", "measured"
# Wavelengths (nm) that a constant table has to cover to be grey.
_VISIBLE = (380.0, 780.0)
# Properties that Mitsuba reads as one number whatever the colour of their texture.
_NOT_COLOURS = (
    "alpha", "alpha_u", "alpha_v", "opacity", "weight", "roughness", "metallic", "anisotropic", "spec_tint",
    "sheen_tint", "clearcoat", "clearcoat_gloss", "flatness", "diff_trans", "rough", "thickness", "theta",
)  # fmt: skip
# Pictures above this many bytes are taken as coloured if they have three channels, without a look at their pixels.
_PIXELS_WORTH_READING = 1 << 18

# Plugins of Mitsuba 3.9 and of this library whose spectra are all among their properties, or that have none.
_TRANSPARENT = frozenset((
    "scene", "area", "angulararea", "directionalarea", "point", "spot", "directional", "constant", "projector",
    "diffuse", "dielectric", "thindielectric", "roughdielectric", "diff_dielectric", "diff_rough_dielectric",
    "diff_plastic", "diff_rough_plastic", "diff_conductor", "diff_polarizer", "diff_retarder", "diff_circular",
    "conductor", "roughconductor", "plastic", "roughplastic", "diff_rough_conductor", "diff_pplastic",
    "pplastic", "principled", "principledthin", "diff_principled", "diff_principled_thin",
    "blendbsdf", "mask", "twosided", "bumpmap",
    "normalmap", "null", "polarizer", "retarder", "circular", "delayed", "retroreflector", "homogeneous",
    "heterogeneous",
    "isotropic", "hg", "rayleigh", "tabphase", "blendphase", "sggx", "constvolume", "checkerboard", "srgb",
    "uniform", "rawconstant", "d65", "volume", "cube", "sphere", "rectangle", "disk", "cylinder", "obj", "ply",
    "serialized", "mesh_arrays", "merge", "shapegroup", "instance", "bsplinecurve", "linearcurve", "sdfgrid",
    "ellipsoids", "ellipsoidsmesh", "blender", "perspective", "orthographic", "thinlens", "radiancemeter",
    "irradiancemeter",
    "nlos_capture_meter", "laser_beam", "distant", "batch", "hdrfilm", "specfilm",
    "independent", "stratified", "multijitter", "orthogonal", "ldsampler", "box", "tent",
    "gaussian", "mitchell", "catmullrom", "lanczos",
))  # fmt: skip
_MEASURED_PLUGINS = {
    "regular": "spectrum given over wavelength",
    "irregular": "spectrum given over wavelength",
    "blackbody": "black body spectrum",
    "measured": "measured material",
    "measured_polarized": "measured material",
}
_COLOURED_PLUGINS = {
    "sunsky": "coloured sky",
    "timed_sunsky": "coloured sky",
    **dict.fromkeys(("hair", "diff_hair"), "coloured absorption of hair"),
    "mesh_attribute": "attribute of a mesh, which may be coloured",
}


@dataclass(frozen=True)
class Verdict:
    """``kind``: COLOUR or MEASURED. ``why``: what was found."""

    kind: str
    why: str


def colour_of_value(node: Any, key: str, value: Any) -> Verdict | None:
    """What one property says; None for grey and for what is no spectrum."""
    import mitsuba as mi

    kind = node.props.type(key)
    if key in _NOT_COLOURS:
        return None
    if kind == mi.Properties.Type.Color:
        three = [float(value[c]) for c in range(3)]
        return None if three[0] == three[1] == three[2] else Verdict(COLOUR, f"coloured {key}")
    if kind == mi.Properties.Type.Spectrum and not _constant(value):
        return Verdict(MEASURED, f"{key} given over wavelength")
    return None


def _constant(spectrum: Any) -> bool:
    """Constant over what is visible: a table of equal values may still end inside it."""
    if spectrum.is_uniform():
        return True
    values, wavelengths = list(spectrum.values), list(spectrum.wavelengths)
    covers = bool(wavelengths) and wavelengths[0] <= _VISIBLE[0] and wavelengths[-1] >= _VISIBLE[1]
    return covers and min(values) == max(values)


def colour_of_node(node: Any, lookup: Callable[[str], Path]) -> Verdict | None:
    """What the plugin itself says: tables of materials, pictures, grids, plugins with colours of their own."""
    import mitsuba as mi

    props, plugin = node.props, node.props.plugin_name()
    if plugin in _MEASURED_PLUGINS:
        return Verdict(MEASURED, _MEASURED_PLUGINS[plugin])
    if plugin in _COLOURED_PLUGINS:
        return Verdict(COLOUR, _COLOURED_PLUGINS[plugin])
    if plugin in ("conductor", "roughconductor", "diff_conductor", "diff_rough_conductor"):
        material = str(props.get("material", "none"))
        return None if material.lower() == "none" else Verdict(MEASURED, f"indices of {material!r} over wavelength")
    if plugin == "delayed" and any(key in props for key in ("emission", "excitation")):
        return Verdict(MEASURED, "re-emission at other wavelengths")
    if plugin in ("bitmap", "envmap"):
        return _picture(props, lookup)
    if plugin == "gridvolume":
        return _grid(props, lookup)
    if plugin in (*_TRANSPARENT, *OWN_BSDFS) or node.type in (mi.ObjectType.Integrator, mi.ObjectType.Sampler):
        return None
    return None if is_integrator(node) else Verdict(COLOUR, f"{plugin!r}, whose colours are not known here")


def _picture(props: Any, lookup: Callable[[str], Path]) -> Verdict | None:
    import mitsuba as mi

    for key in ("bitmap", "data"):
        if key in props:
            return None if _grey(np.array(props[key])) else Verdict(COLOUR, "coloured picture")
    name = str(props.get("filename", ""))
    path = lookup(name)
    if not path.is_file():
        return Verdict(COLOUR, f"picture {name!r}, which was not found")
    if path.stat().st_size > _PIXELS_WORTH_READING:
        return Verdict(COLOUR, f"picture {name!r}, taken as coloured without a look at its pixels")
    try:
        with threads_for_files():
            pixels = np.array(mi.Bitmap(str(path)))
    except (RuntimeError, ValueError):
        return Verdict(COLOUR, f"picture {name!r}, which cannot be read")
    return None if _grey(pixels) else Verdict(COLOUR, f"coloured picture {name!r}")


def _grid(props: Any, lookup: Callable[[str], Path]) -> Verdict | None:
    for key in ("grid", "data"):
        if key in props:
            values = np.array(props[key])
            return None if values.ndim < 4 or _grey(values) else Verdict(COLOUR, "coloured grid")
    name = str(props.get("filename", ""))
    path = lookup(name)
    channels = 3
    if path.is_file():
        # "VOL", version, encoding, three sizes, channels: little-endian 32-bit integers after the first four bytes.
        head = path.open("rb").read(24)
        channels = struct.unpack("<i", head[20:24])[0] if head[:3] == b"VOL" and len(head) == 24 else 3
    return None if channels == 1 else Verdict(COLOUR, f"grid {name!r} with {channels} channels")


def _grey(pixels: np.ndarray) -> bool:
    """Whether the colour channels of (..., C) agree. One channel, or one and alpha, is grey."""
    if pixels.ndim < 3 or pixels.shape[-1] < 3:
        return True
    return bool(np.all(pixels[..., 0] == pixels[..., 1]) and np.all(pixels[..., 0] == pixels[..., 2]))
