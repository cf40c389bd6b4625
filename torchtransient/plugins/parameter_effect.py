"""Effects of plugin parameters, as rows by plugin class and key that every plugin module enters for itself.

The questions are asked of :mod:`.parameters`; the rows of Mitsuba's plugins stand in :mod:`.mitsuba_parameters`.

Which row counts for a parameter, first match wins:

1. classes from the most special to the most general: the name by which Mitsuba calls the plugin (``Rectangle``,
   ``PointLight``), then the Python classes (``DiffDielectric``, ``Mesh``, ``Shape``, ``Object``);
2. in each class the rows of the key itself, then those of ``"*"``;
3. among several rows of one key the first whose condition holds.

A parameter without a row is a value: it changes how bright something is and moves nothing. A mark of Mitsuba's that a
parameter is read-only always counts, one that it is not differentiable counts unless the row is ``trusted``.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchtransient.errors import PluginRegistrationError

CORRECT = "correct"
ANY_KEY = "*"
ROLES = ("shape", "normal", "emitter", "sun", "sensor", "index", "delay", "medium", "velocity", "value")


@dataclass(frozen=True)
class ParameterEffect:
    """Effect of a parameter on geometry, and quality of its derivative.

    Attributes:
        moves_length: it can change an optical path length.
        moves_silhouette: it can move a visibility edge, seen directly, in a mirror or through glass.
        moves_medium: it can change an extinction (transmittances, sampled distances), which an albedo does not, and a
            phase function only where it is one of flakes.
        role: part of the geometry that it moves. "shape": points of a surface; "normal": the frame that a delta lobe
            works in; "emitter": an emitter without a shape; "sun": the disk in a sky; "sensor": the sensor and its
            rays; "index": an index of refraction; "delay": a lifetime; "medium": an extinction;
            "velocity": how fast it moves, which films of rates alone measure; "value": none.
        supported: it has a derivative.
        biased: the derivative is wrong in some scenes, apart from the missing part of moving edges, for which
            integrators answer (``silhouettes``).
        reason: the state in words.
        trusted: the derivative is right although Mitsuba marks the parameter as not differentiable.
        stand_in: name of the plugin that is built in place of Mitsuba's when the derivative is asked for; for a
            texture, in place of the plugin that holds it.
        stand_in_needed: Mitsuba's own derivative is not right.
    """

    moves_length: bool = False
    moves_silhouette: bool = False
    moves_medium: bool = False
    role: str = "value"
    supported: bool = True
    biased: bool = False
    reason: str = CORRECT
    trusted: bool = False
    stand_in: str = ""
    stand_in_needed: bool = True

    @property
    def moves(self) -> bool:
        """True if the parameter moves anything at all."""
        return self.moves_length or self.moves_silhouette or self.moves_medium


VALUE = ParameterEffect()


@dataclass(frozen=True)
class Site:
    """Place of a parameter in a scene.

    Attributes:
        node, key: plugin that has it, and its name there.
        owners: all objects that hold the plugin, directly or not, as (holder, name there), nearest first. A plugin that
            is shared has several holders.
    """

    node: Any
    key: str
    owners: tuple[tuple[Any, str], ...] = ()


@dataclass(frozen=True)
class Row:
    """Row of the table.

    Attributes:
        effect: effect of the parameter.
        when: function of the site that says whether the row counts, None if it always does.
        condition: condition of ``when`` in words.
    """

    effect: ParameterEffect
    when: Callable[[Site], bool] | None = None
    condition: str = ""


# class name -> key -> rows in the order of precedence
_rows: dict[str, dict[str, tuple[Row, ...]]] = {}


def declare_effects(plugin: type | str, effects: Mapping[str, ParameterEffect | Sequence[Row]]) -> None:
    """Enter the parameters of a plugin class into the table; called by the module that defines the plugin.

    Another call replaces the entries of the same keys, as happens when a module is executed again for another variant.

    Args:
        plugin: the class, or the name by which Mitsuba calls it.
        effects: an effect, or rows with conditions, by key (the last name of the parameter, "*" for all others).

    Raises:
        PluginRegistrationError: for an unknown role.
    """
    name = plugin if isinstance(plugin, str) else plugin.__name__
    for key, given in effects.items():
        rows = (Row(given),) if isinstance(given, ParameterEffect) else tuple(given)
        for row in rows:
            if row.effect.role not in ROLES:
                raise PluginRegistrationError(
                    f"declare_effects: parameter '{key}' of {name}: expected a role out of {', '.join(ROLES)}, got "
                    f"{row.effect.role!r}."
                )
        _rows.setdefault(name, {})[key] = rows


def all_rows() -> Iterator[tuple[str, str, Row]]:
    """Return (class, key, row) for the whole table, in the order of entry."""
    for name, by_key in _rows.items():
        for key, rows in by_key.items():
            for row in rows:
                yield name, key, row


def lineage(node: Any) -> tuple[str, ...]:
    """Return the names of a plugin's classes, the most special first.

    Args:
        node: Mitsuba object. One written in Python is called ``class_name()`` by the class that it derives from.
    """
    names = [cls.__name__ for cls in type(node).__mro__]
    own = node.class_name().split("[")[0]
    # Mitsuba calls a plugin written in Python by the class that it derives from.
    return tuple(names if own in names else [own, *names])


def class_of(node: Any) -> str:
    """Return the name of a plugin's class for messages; for plugins in Python, that of the Python class.

    Args:
        node: Mitsuba object.
    """
    return lineage(node)[0]


def matching_effect(site: Site) -> ParameterEffect:
    """Return the declared effect of a parameter, that of the most special class; ``VALUE`` where none is declared.

    Args:
        site: place of the parameter.
    """
    for name in lineage(site.node):
        by_key = _rows.get(name, {})
        for key in (site.key, ANY_KEY):
            for row in by_key.get(key, ()):
                if row.when is None or row.when(site):
                    return row.effect
    return VALUE


# ----------------------------------------------------------------------------------------------------------------------
# Which parameters the sweep of gradients has checked against finite differences (``docs/gradients_sweep.md``).
# A parameter stands somewhere: ``RoughPlastic.alpha``, in ``MaskBSDF.nested_bsdf``, on ``Rectangle.bsdf``. It counts as
# checked when each of these names took part in a comparison that was decided, and none that stayed undecided has it in
# all of its places. The file is written by ``make sweep``.

FILE = Path(__file__).with_name("swept_parameters.json")
UNCHECKED = "unchecked: not compared with finite differences there"
# These call what they hold by the names that the scene gives.
_NAMED_BY_USERS = ("ShapeGroupPlugin", "BatchSensor")


def location_of(site: Site) -> tuple[str, ...]:
    """Return the names of a parameter and of the holders of its plugin, the nearest first.

    Args:
        site: place of the parameter.

    Returns:
        "class.key" of the parameter, "class.slot" of each holder.
    """
    places = [(lineage(node)[0], name) for node, name in [(site.node, site.key), *site.owners]]
    return tuple(dict.fromkeys(cls if cls in _NAMED_BY_USERS else f"{cls}.{name}" for cls, name in places))


@functools.cache
def _swept() -> tuple[frozenset[str], tuple[frozenset[str], ...]]:
    data = json.loads(FILE.read_text(encoding="utf-8")) if FILE.exists() else {"checked": [], "undecided": []}
    return frozenset(data["checked"]), tuple(frozenset(places) for places in data["undecided"])


def is_checked(place: Sequence[str]) -> bool:
    """Return True if the sweep has compared a parameter in such a place with finite differences, and decided.

    Args:
        place: names by :func:`location_of`.
    """
    checked, undecided = _swept()
    return checked.issuperset(place) and not any(places.issubset(place) for places in undecided)
