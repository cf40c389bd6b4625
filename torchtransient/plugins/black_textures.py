"""Textures that are exactly zero inside a normal map.

Mitsuba's normal map forgets the density of samples whose weight is zero: paths end there
(:func:`.mitsuba_compat.forgets_black_samples`), and the derivative by what is black, as far as it is due to the light
beyond, is lost. A number that leaves no weight to speak of, but is not zero, keeps both.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.errors import GradientError
from torchtransient.plugins.mitsuba_compat import forgets_black_samples, normal_texture, weight_slot

# Far above the least number of single precision, far below anything that can be seen.
ALMOST_BLACK = 1e-30


def loses_black(node: Any, owners: Sequence[tuple[Any, str]]) -> bool:
    """Whether the derivative by a plugin's numbers is lost where they are zero; ``owners``: all that holds it. Weights
    of mixtures are none of these, since paths are handed a part. Of a mesh, its attributes are numbers that textures
    hold, and shapes themselves are in no normal map.
    """
    has_numbers = isinstance(node, mi.Texture | mi.Volume | mi.Mesh)
    if not has_numbers or any(weight_slot(holder) == name for holder, name in owners):
        return False
    return any(forgets_black_samples(holder) and normal_texture(holder) != name for holder, name in owners)


def lifted(value: Any) -> Any:
    """An array of numbers, of which none is exactly zero."""
    return dr.select(value == 0, ALMOST_BLACK, value)


def check_black(attached: Sequence[tuple[Any, str, Any, Sequence[tuple[Any, str]]]]) -> None:
    """Raise ``GradientError`` where a derivative would be lost. ``attached``: (plugin, key, value, owners) of what
    carries gradients.
    """
    for node, key, value, owners in attached:
        if loses_black(node, owners) and _has_zeros(value):
            raise GradientError(
                f"{f'{node.id()}.{key}'.lstrip('.')!r} is zero inside a normalmap, which forgets samples of weight "
                f"zero and with them the derivative. Set it to {ALMOST_BLACK:g}, as tt.TransientRenderer does."
            )


def _has_zeros(value: Any) -> bool:
    if not (dr.is_array_v(value) and dr.is_float_v(value)):
        return False
    with dr.suspend_grad():
        return bool(dr.any(dr.ravel(value) == 0)[0])
