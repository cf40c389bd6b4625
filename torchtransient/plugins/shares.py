"""Parameters that say which share of the light goes on: outside of [0, 1] no physical surface or medium has them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mitsuba as mi
import numpy as np

from torchtransient.plugins.mitsuba_compat import keeps_coefficients

# Names under which plugins keep such a number, or the texture or volume of them.
_OF_BSDFS = (
    "reflectance", "transmittance", "diffuse_reflectance", "specular_reflectance", "specular_transmittance",
    "base_color", "opacity", "weight", "quantum_yield", "elastic_fraction",
)  # fmt: skip
_OF_MEDIA = ("albedo",)
_NAMES = frozenset((*_OF_BSDFS, *_OF_MEDIA))
# Of a texture or volume the numbers, not where they lie.
NUMBERS = ("value", "values", "data", "color0", "color1")


def is_share(params: Any, key: str) -> bool:
    """Whether a key of ``mi.traverse`` is a share of the light. Coefficients of spectral models are none."""
    names = key.split(".")
    if _NAMES.isdisjoint(names) or key not in params.properties:
        return False
    node = params.properties[key][2]
    if names[-1] in _NAMES:
        return _belongs(node, names[-1])
    if names[-1] not in NUMBERS or not isinstance(node, mi.Texture | mi.Volume) or keeps_coefficients(node):
        return False
    for name in reversed(names[:-1]):
        node = params.hierarchy[node][0]
        if not isinstance(node, mi.Texture | mi.Volume):
            return node is not None and _belongs(node, name)
    return False


def _belongs(node: Any, name: str) -> bool:
    return (isinstance(node, mi.BSDF) and name in _OF_BSDFS) or (isinstance(node, mi.Medium) and name in _OF_MEDIA)


def described_shares(params: Any) -> Iterator[tuple[str, float, float]]:
    """(key, smallest, largest) of all shares of a scene, as they are now."""
    for key in params.properties:
        if is_share(params, key):
            numbers = np.array(params[key])
            if numbers.size:
                yield key, float(numbers.min()), float(numbers.max())
