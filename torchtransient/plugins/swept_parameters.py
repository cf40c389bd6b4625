"""Which parameters the sweep of gradients has checked against finite differences (``docs/gradients_sweep.md``).

A parameter stands somewhere: ``RoughPlastic.alpha``, in ``MaskBSDF.nested_bsdf``, on ``Rectangle.bsdf``. It counts as
checked when each of these names took part in a comparison that was decided, and none that stayed undecided has it in
all of its places. The file is written by ``make sweep``.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Sequence
from pathlib import Path

from torchtransient.plugins.parameter_effect import Site, lineage

FILE = Path(__file__).with_name("swept_parameters.json")
UNCHECKED = "unchecked: not compared with finite differences there"
# These call what they hold by the names that the scene gives.
_NAMED_BY_USERS = ("ShapeGroupPlugin", "BatchSensor")


def location_of(site: Site) -> tuple[str, ...]:
    """Names of a parameter and of what its plugin is in, the nearest first: "class.key", "class.slot"."""
    places = [(lineage(node)[0], name) for node, name in [(site.node, site.key), *site.owners]]
    return tuple(dict.fromkeys(cls if cls in _NAMED_BY_USERS else f"{cls}.{name}" for cls, name in places))


@functools.cache
def _swept() -> tuple[frozenset[str], tuple[frozenset[str], ...]]:
    data = json.loads(FILE.read_text(encoding="utf-8")) if FILE.exists() else {"checked": [], "undecided": []}
    return frozenset(data["checked"]), tuple(frozenset(places) for places in data["undecided"])


def is_checked(place: Sequence[str]) -> bool:
    """Whether the sweep has compared a parameter in such a place with finite differences, and decided."""
    checked, undecided = _swept()
    return checked.issuperset(place) and not any(places.issubset(place) for places in undecided)
