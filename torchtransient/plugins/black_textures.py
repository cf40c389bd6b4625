"""Textures that are exactly zero where Mitsuba then loses the derivative: inside normal and bump maps, and in lights
that are sampled by their own brightness.

Mitsuba's maps drop samples whose weight is zero (:func:`.mitsuba_compat.forgets_black_samples`), and a light of which
all texels are black has no density to sample it by: the derivative by what is black, as far as it is due to the light
beyond, is lost. A number that leaves no weight to speak of, but is not zero, keeps both.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from torchtransient.errors import GradientError
from torchtransient.plugins.mitsuba_compat import PIXELS, forgets_black_samples, normal_texture, weight_slot

# Far above the least number of single precision, far below anything that can be seen.
ALMOST_BLACK = 1e-30


class Attached(NamedTuple):
    """A number of a plugin that carries gradients: the plugin, its key, the value, all that holds it and of that what
    holds it directly.
    """

    node: Any
    key: str
    value: Any
    owners: Sequence[tuple[Any, str]]
    holders: Sequence[tuple[Any, str]]


def loses_black(node: Any, key: str, owners: Sequence[tuple[Any, str]]) -> bool:
    """Whether the derivative by a plugin's numbers is lost where they are zero; ``owners``: all that holds it. Of a
    mesh, its attributes are numbers that textures hold, and shapes themselves are in no map.
    """
    return _is_in_a_map(node, owners) or _is_light(node, key, owners)


def _is_in_a_map(node: Any, owners: Sequence[tuple[Any, str]]) -> bool:
    if not isinstance(node, mi.Texture | mi.Volume | mi.Mesh):
        return False
    return any(forgets_black_samples(holder) and normal_texture(holder) != name for holder, name in owners)


def _is_light(node: Any, key: str, owners: Sequence[tuple[Any, str]]) -> bool:
    if isinstance(node, mi.Emitter):
        return key == PIXELS
    return isinstance(node, mi.Texture) and any(isinstance(holder, mi.Emitter) for holder, _ in owners)


def lifted(value: Any) -> Any:
    """An array of numbers, of which none is exactly zero."""
    return dr.select(value == 0, ALMOST_BLACK, value)


def check_black(attached: Iterable[Attached]) -> None:
    """Raise ``GradientError`` where a derivative would be lost."""
    for one in attached:
        # Paths are handed a part of a mixture: its weight is none of what maps drop.
        only_weighs = bool(one.holders) and all(weight_slot(holder) == name for holder, name in one.holders)
        if _is_in_a_map(one.node, one.owners) and not only_weighs and _zeros(one.value, dr.any):
            where = "inside a normalmap or bumpmap, which drops samples of weight zero and with them the derivative"
        elif _is_light(one.node, one.key, one.owners) and _zeros(one.value, dr.all):
            where = "everywhere in a light, which then has no density to sample it by"
        else:
            continue
        raise GradientError(
            f"{f'{one.node.id()}.{one.key}'.lstrip('.')!r} is zero {where}. Set it to {ALMOST_BLACK:g}, as "
            "tt.TransientRenderer does."
        )


def _zeros(value: Any, how: Any) -> bool:
    """Whether ``how`` many (``dr.any`` or ``dr.all``) of the numbers of a value are zero."""
    if not (dr.is_array_v(value) and dr.is_float_v(value)):
        return False
    with dr.suspend_grad():
        flat = dr.ravel(value)
        return bool(dr.width(flat) and how(flat == 0)[0])
