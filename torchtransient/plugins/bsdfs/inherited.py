"""What a BSDF has of those that it holds: mistakes of Mitsuba's that shine through whatever is around them.

They are told by the classes of all BSDFs that a plugin shows. Plugins of others do what they like with what they hold,
and say so by an attribute of the name of the function here, True or False, which counts for all below as well.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torchtransient.plugins.mitsuba_compat import cancels_lobe_probability, is_two_sided_itself, weight_slot
from torchtransient.plugins.node_walk import bsdfs_below


def hides_lobe_probability(bsdf: Any) -> bool:
    """Whether the weight of a delta lobe lacks the derivative of the lobe's probability, which has to be put back.

    Of a mixture (mask, blend) it is asked for each part, since a part's probability hides its weight as well.
    """
    return _has(bsdf, "hides_lobe_probability", cancels_lobe_probability, lambda node: weight_slot(node) is not None)


def mirrors_matrices(bsdf: Any) -> bool:
    """Whether a BSDF is ``twosided`` or holds one (in a mask, in a blend).

    From behind, Mitsuba's ``twosided`` evaluates what it holds for the mirror images of the directions, and returns its
    Mueller matrix as if it belonged to the directions themselves: turned, and with the hands of circular light
    exchanged.
    """
    return _has(bsdf, "mirrors_matrices", is_two_sided_itself, lambda node: False)


def _has(bsdf: Any, attribute: str, itself: Callable[[Any], bool], ends: Callable[[Any], bool]) -> bool:
    """Whether ``bsdf`` declares ``attribute``, or one that it holds has what is asked ``itself``; not below what
    ``ends`` the search.
    """
    declared = getattr(bsdf, attribute, None)
    if declared is not None:
        return bool(declared)
    if ends(bsdf):
        return False
    return itself(bsdf) or any(_has(part, attribute, itself, ends) for part in bsdfs_below(bsdf))
