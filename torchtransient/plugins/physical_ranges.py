"""Parameters that have a range outside of which no physical surface, medium, light or sensor has them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from torchtransient.plugins.mitsuba_compat import keeps_coefficients
from torchtransient.plugins.node_walk import unshared

# What single precision makes of the ends of a range.
_SLACK = 1e-5
# Of a texture or volume the numbers, not where they lie.
NUMBERS = ("value", "values", "data", "color0", "color1")


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
_NAMES = frozenset((*_OF_BSDFS, *_OF_MEDIA, *_OF_EMITTERS, *_OF_SENSORS, "g"))


def physical_range(params: Any, key: str) -> PhysicalRange | None:
    """The range of a key of ``mi.traverse``, None for none. Coefficients of spectral models have none."""
    names = key.split(".")
    if _NAMES.isdisjoint(names) or key not in params.properties:
        return None
    node = params.properties[key][2]
    if names[-1] in _NAMES:
        return _range_in(node, names[-1])
    if names[-1] not in NUMBERS or not isinstance(node, mi.Texture | mi.Volume) or keeps_coefficients(node):
        return None
    for name in reversed(names[:-1]):
        node = params.hierarchy[node][0]
        if not isinstance(node, mi.Texture | mi.Volume):
            return None if node is None else _range_in(node, name)
    return None


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
    for key in params.properties:
        found = physical_range(params, key)
        if found is not None:
            numbers = np.array(unshared(params[key]))
            if numbers.size:
                yield key, found, float(numbers.min()), float(numbers.max())


def sun_axes(params: Any, keys: Iterable[str]) -> dict[str, np.ndarray]:
    """Of the keys that are directions of a sun, where its sky's third axis points."""
    suns = [key for key in keys if key.endswith(".sun_direction")]
    matrices = {key: params[f"{key.removesuffix('sun_direction')}to_world"].matrix for key in suns}
    return {key: np.array(unshared(matrix), dtype=float).reshape(4, 4)[:3, 2] for key, matrix in matrices.items()}
