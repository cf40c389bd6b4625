"""The surfaces of the sweep, and what they stand in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tools.every_plugin import bsdfs
from tools.gradient_sweep.stages import Description, matte
from torchtransient.plugins._registry import OWN_BSDFS
from torchtransient.plugins.mitsuba_compat import DIFFERENTIABLE_PLUGINS, POLARIZED_PLUGINS

# Pitch of a texel on the plate, whose texture spans it once: what the camera sees lies within one patch, since the
# slope of a bilinear texture jumps from patch to patch.
TEXELS = 16
# Plugins of this library that stand in for Mitsuba's and take the same parameters.
TWINS = {**DIFFERENTIABLE_PLUGINS, **POLARIZED_PLUGINS}


@dataclass(frozen=True)
class Surface:
    """A BSDF of the sweep. ``transmits``: what it lets through cannot be inside ``twosided``. ``outermost``: it cannot
    be inside others. ``bare_only``: its parameters are those of another one, at other values. ``polarizes``: to be
    swept in a polarized variant too. ``grazing``: its parameters matter at grazing angles. ``only``: the beginning of
    the names of its parameters that matter; ``without``: of those that do not. ``filters``: it lets polarized light
    through unbent, and hardly matters to other light.
    """

    make: Callable[[], Description]
    transmits: bool = False
    outermost: bool = False
    bare_only: bool = False
    polarizes: bool = False
    grazing: bool = False
    only: str = ""
    without: tuple[str, ...] = ()
    filters: bool = False


def picture(channels: int = 3, low: float = 0.3, high: float = 0.7, seed: int = 5) -> Description:
    """A bitmap of random numbers as they are."""
    data = np.random.default_rng(seed).uniform(low, high, (TEXELS, TEXELS, channels)).astype(np.float32)
    return {"type": "bitmap", "data": data, "raw": True, "filter_type": "bilinear"}


def normals(seed: int = 6) -> Description:
    """A map of normals that lean by some degrees."""
    bitmap = picture(3, 0.4, 0.6, seed)
    bitmap["data"][..., 2] = 0.97
    return bitmap


def rgb(*values: float) -> Description:
    return {"type": "rgb", "value": list(values)}


GLASS = {"int_ior": 1.5, "ext_ior": 1.0, "specular_reflectance": 0.9, "specular_transmittance": 0.8}
ROUGH_GLASS = {**GLASS, "alpha": 0.25}
METAL = {"eta": 0.5, "k": 2.0, "specular_reflectance": 0.9}
PLASTIC = {"int_ior": 1.6, "diffuse_reflectance": rgb(0.5, 0.4, 0.3), "specular_reflectance": 0.8}
PRINCIPLED = {
    "base_color": rgb(0.5, 0.4, 0.3), "roughness": 0.5, "anisotropic": 0.3, "sheen": 0.4, "sheen_tint": 0.5,
    "spec_tint": 0.4, "flatness": 0.4,
}  # fmt: skip
COATED = {"metallic": 0.3, "clearcoat": 0.5, "clearcoat_gloss": 0.4}


def late() -> Description:
    """Paint that scatters late."""
    return {"type": "delayed", "nested": matte(), "lifetime": 0.5}


def surfaces() -> dict[str, Surface]:
    """Every BSDF that holds no other, by the name of its plugin; a word behind the name for what it is made of."""

    def one(plugin: str, properties: Description, **marks: Any) -> Surface:
        return Surface(lambda: {"type": plugin, **properties}, **marks)

    thin = {"transmits": True, "polarizes": True}
    filters = {**thin, "filters": True}
    found = {
        "diffuse": one("diffuse", {"reflectance": rgb(0.6, 0.5, 0.4)}, polarizes=True),
        "dielectric": one("dielectric", GLASS, **thin),
        "thindielectric": one("thindielectric", GLASS, **thin),
        "roughdielectric": one("roughdielectric", ROUGH_GLASS, **thin),
        "conductor": one("conductor", METAL, polarizes=True),
        "roughconductor": one("roughconductor", {**METAL, "alpha": 0.3}, polarizes=True),
        "roughconductor (anisotropic)": one(
            "roughconductor", {**METAL, "alpha_u": 0.2, "alpha_v": 0.4}, bare_only=True, only="alpha"
        ),
        "plastic": one("plastic", PLASTIC, polarizes=True),
        "plastic (nonlinear)": one("plastic", {**PLASTIC, "nonlinear": True}),
        "roughplastic": one("roughplastic", {**PLASTIC, "alpha": 0.3}, polarizes=True),
        "pplastic": one("pplastic", {**PLASTIC, "alpha": 0.3}, polarizes=True),
        "principled": one("principled", {**PRINCIPLED, **COATED, "specular": 0.6}, grazing=True),
        "principled (without lobes)": one(
            "principled",
            {"base_color": rgb(0.5, 0.4, 0.3), "roughness": 0.5, "specular": 0.6},
            bare_only=True,
            grazing=True,
            without=("clearcoat_gloss", "sheen_tint"),
        ),
        "principled (transmitting)": one(
            "principled", {**PRINCIPLED, **COATED, "spec_trans": 0.6, "eta": 1.4}, transmits=True, grazing=True
        ),
        "principledthin": one(
            "principledthin",
            {**PRINCIPLED, "spec_trans": 0.4, "diff_trans": 0.7, "eta": 1.4},
            transmits=True,
            grazing=True,
        ),
        "hair": one("hair", {}, transmits=True),
        "hair (absorption)": one(
            "hair", {"sigma_a": rgb(0.2, 0.3, 0.4)}, transmits=True, bare_only=True, only="sigma_a"
        ),
        "polarizer": one("polarizer", {"theta": 20.0, "transmittance": 0.8}, **filters),
        "retarder": one("retarder", {"theta": 20.0, "delta": 70.0, "transmittance": 0.8}, **filters),
        "circular": one("circular", {"transmittance": 0.8}, **filters),
        "retroreflector": one("retroreflector", {"reflectance": rgb(0.6, 0.5, 0.4), "share": 0.6, "alpha": 0.3}),
        "delayed": Surface(lambda: late() | {"elastic_fraction": 0.3, "quantum_yield": 0.8}, outermost=True),
        "delayed (elastic part)": Surface(
            lambda: late() | {"elastic": {"type": "conductor", **METAL}}, outermost=True
        ),
        **at_the_ends(),
    }  # fmt: skip
    found |= {twin: _twin(found[plugin], twin) for plugin, twin in TWINS.items()}
    # Others of this library are measured as they are described for all tests.
    return {**found, **{name: Surface(lambda name=name: bsdfs()[name]) for name in OWN_BSDFS if name not in found}}


def _twin(surface: Surface, plugin: str) -> Surface:
    # In polarized variants Mitsuba's filters are built as their twins: those have been looked at.
    return replace(surface, make=lambda: surface.make() | {"type": plugin}, bare_only=surface.filters)


def at_the_ends() -> dict[str, Surface]:
    """Surfaces with a number at the end of its range, where a part of them is never chosen."""
    mirror = {"type": "conductor", **METAL}

    def alone(make: Callable[[], Description], only: str) -> Surface:
        return Surface(make, bare_only=True, only=only)

    metal = {"type": "roughconductor", **METAL, "alpha": 0.3}
    rough_plastic = {"type": "roughplastic", **PLASTIC, "alpha": 0.3}
    thin_glass = {"type": "thindielectric", **GLASS}
    two_faces = {"type": "twosided", "front": matte(), "back": metal}
    return {
        "mask (opacity 0)": alone(lambda: mask(matte()) | {"opacity": 0.0}, "opacity"),
        "mask (opacity 1)": alone(lambda: mask(mirror) | {"opacity": 1.0}, "opacity"),
        "blendbsdf (weight 0)": alone(lambda: blend(mirror) | {"weight": 0.0}, "weight"),
        "blendbsdf (weight 1)": alone(lambda: blend(mirror) | {"weight": 1.0}, "weight"),
        "diffuse (black)": alone(lambda: matte(0.0), "reflectance"),
        "roughplastic (black coat)": alone(lambda: rough_plastic | {"specular_reflectance": 0.0}, "specular"),
        "roughplastic (black base)": alone(lambda: rough_plastic | {"diffuse_reflectance": 0.0}, "diffuse"),
        "dielectric (black)": alone(lambda: {"type": "dielectric", **GLASS, "specular_transmittance": 0.0}, "specular"),
        "thindielectric (black)": alone(lambda: thin_glass | {"specular_reflectance": 0.0}, "specular"),
        "twosided (two faces)": alone(lambda: mask(two_faces), ""),
    }


def mask(inner: Description) -> Description:
    return {"type": "mask", "opacity": 0.6, "nested": inner}


def blend(inner: Description) -> Description:
    """With paint; paint with a mirror."""
    other = {"type": "conductor", **METAL} if inner["type"] == "diffuse" else matte(0.4)
    return {"type": "blendbsdf", "weight": 0.4, "a": inner, "b": other}


def bump(inner: Description) -> Description:
    """Steeper for paint, which hardly notices how it leans."""
    steepness = 4.0 if inner["type"] == "diffuse" else 1.0
    return {"type": "bumpmap", "heights": picture(1, 0.0, 1.0, seed=8), "scale": steepness, "nested": inner}


def normal_map(inner: Description) -> Description:
    return {"type": "normalmap", "normalmap": normals(), "nested": inner}


def two_sided(inner: Description) -> Description:
    return {"type": "twosided", "nested": inner}


HOLDERS: dict[str, Callable[[Description], Description]] = {
    "mask": mask,
    "blendbsdf": blend,
    "bumpmap": bump,
    "normalmap": normal_map,
    "twosided": two_sided,
}


def holders() -> dict[str, Surface]:
    """Every BSDF that holds others, around a mirror, to be held in turn."""
    mirror = {"type": "conductor", **METAL}
    return {
        name: Surface(lambda wrap=wrap: wrap(mirror), transmits=name == "mask", outermost=name == "twosided")
        for name, wrap in HOLDERS.items()
    }
