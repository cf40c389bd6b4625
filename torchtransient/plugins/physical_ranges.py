"""Parameters that have a range outside of which no physical surface, medium, light or sensor has them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import mitsuba as mi
import numpy as np

from torchtransient.plugins.mitsuba_compat import NUMBERS, attribute_scale
from torchtransient.plugins.node_walk import unshared
from torchtransient.plugins.parameters import ParameterTracker, is_attribute
from torchtransient.plugins.spectral_colours import keeps_coefficients

# What single precision makes of the ends of a range.
_SLACK = 1e-5


@dataclass(frozen=True)
class PhysicalRange:
    """From ``low`` to ``high``. ``meaning``: what a parameter is, in words. ``is_open``: the ends are outside."""

    meaning: str
    low: float
    high: float = float("inf")
    is_open: bool = False

    def above(self, number: float) -> bool:
        """Whether a number is beyond the upper end."""
        return number >= self.high if self.is_open else number > self.high + _SLACK

    def below(self, number: float) -> bool:
        """Whether a number is beyond the lower end."""
        return number <= self.low if self.is_open else number < self.low - _SLACK


SHARE = PhysicalRange("a share of the light", 0, 1)
WEIGHT = PhysicalRange("a weight", 0, 1)
ROUGHNESS = PhysicalRange("a roughness", 0)
OPTICAL = PhysicalRange("an optical constant of a metal", 0)
INDEX = PhysicalRange("an index of refraction", 0, is_open=True)
EXTINCTION = PhysicalRange("an extinction coefficient", 0)
ANISOTROPY = PhysicalRange("the mean cosine of a phase function", -1, 1, is_open=True)
LIGHT = PhysicalRange("the light of an emitter", 0)
ANGLE = PhysicalRange("an angle of view in degrees", 0, 180, is_open=True)
LENGTH = PhysicalRange("a length", 0)

# Names under which plugins keep such a number, or the texture or volume of them.
_OF_BSDFS = {
    **dict.fromkeys(
        (
            "reflectance", "transmittance", "diffuse_reflectance", "specular_reflectance", "specular_transmittance",
            "base_color", "opacity", "weight", "quantum_yield", "elastic_fraction",
        ),
        SHARE,
    ),
    **dict.fromkeys(
        (
            "metallic", "spec_trans", "spec_tint", "sheen_tint", "clearcoat", "clearcoat_gloss", "anisotropic",
            "flatness", "share",
        ),
        WEIGHT,
    ),
    **dict.fromkeys(("alpha", "alpha_u", "alpha_v", "roughness"), ROUGHNESS),
    "eta": INDEX,
    "k": OPTICAL,
}  # fmt: skip
_OF_MEDIA = {"albedo": SHARE, "sigma_t": EXTINCTION}
_OF_EMITTERS = dict.fromkeys(("radiance", "intensity", "irradiance", "energy"), LIGHT)
_OF_SENSORS = {"x_fov": ANGLE, "aperture_radius": LENGTH, "focus_distance": LENGTH}

def ranges_of(params: Any) -> dict[str, PhysicalRange]:
    """The ranges of the parameters that have one, by key of ``mi.traverse``.

    The numbers of textures, volumes and attributes of meshes have the range of what they supply, through whatever
    textures they are read. Coefficients of spectral models have none.
    """
    tracker, found = ParameterTracker.of(params), {}
    for key in params.properties:
        limits = list(_ranges_at(tracker, params.properties[key][2], key.rsplit(".", 1)[-1]))
        if limits:  # one that serves for several things: the one with the least room
            found[key] = min(limits, key=lambda one: one.high)
    return found


def _ranges_at(tracker: ParameterTracker, node: Any, name: str) -> Iterator[PhysicalRange]:
    """The ranges of a parameter of a plugin."""
    if isinstance(node, mi.Texture | mi.Volume):
        supplies = name in NUMBERS and not keeps_coefficients(node, name)
    else:
        own = _range_in(node, name)
        if own is not None:
            yield own
        supplies = is_attribute(node, name) and not keeps_coefficients(node, name)
    waiting = [(node, name, 1.0)] if supplies else []
    while waiting:
        supplier, attribute, scale = waiting.pop()
        for holder, slot in tracker.holders_of(supplier, attribute):
            if isinstance(holder, mi.Texture | mi.Volume):
                factor = attribute_scale(holder)
                if factor > 0:
                    waiting.append((holder, "", scale * factor))
            elif (limits := _range_in(holder, slot)) is not None:
                yield limits if scale == 1 else replace(limits, low=limits.low / scale, high=limits.high / scale)


def _range_in(node: Any, name: str) -> PhysicalRange | None:
    if isinstance(node, mi.BSDF):
        is_metal = "Conductor" in node.class_name() + type(node).__name__
        return OPTICAL if name == "eta" and is_metal else _OF_BSDFS.get(name)
    if isinstance(node, mi.PhaseFunction):
        return {"g": ANISOTROPY, "weight": SHARE}.get(name)
    for kind, ranges in ((mi.Medium, _OF_MEDIA), (mi.Emitter, _OF_EMITTERS), (mi.Sensor, _OF_SENSORS)):
        if isinstance(node, kind):
            return ranges.get(name)
    return None


def described_ranges(params: Any) -> Iterator[tuple[str, PhysicalRange, float, float]]:
    """(key, range, smallest, largest) of what has a range in a scene, as it is now."""
    for key, limits in ranges_of(params).items():
        numbers = np.array(unshared(params[key]))
        if numbers.size:
            yield key, limits, float(numbers.min()), float(numbers.max())


def sun_axes(params: Any, keys: Iterable[str]) -> dict[str, np.ndarray]:
    """Of the keys that are directions of a sun, where its sky's third axis points."""
    suns = [key for key in keys if key.endswith(".sun_direction")]
    matrices = {key: params[f"{key.removesuffix('sun_direction')}to_world"].matrix for key in suns}
    return {key: np.array(unshared(matrix), dtype=float).reshape(4, 4)[:3, 2] for key, matrix in matrices.items()}
