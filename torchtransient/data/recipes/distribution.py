"""What a distribution is: numbers in [0, 1) become a value of a key; and how distributions are written down."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from torchtransient.checks import real_array, shown
from torchtransient.data.recipes.streams import Draw
from torchtransient.errors import SceneError, ShapeError, UnitError

# Kinds of values: numbers of a shape, a pose (4, 4), or anything (texts, nodes of a scene).
NUMBERS, POSE, ANYTHING = "numbers", "pose", "anything"


@dataclass(frozen=True)
class Place:
    """What a value is drawn for: its key, what it is (NUMBERS, POSE or ANYTHING), and for the first two the shape and
    the described value, float64.
    """

    key: str
    kind: str = ANYTHING
    shape: tuple[int, ...] = ()
    described: NDArray[np.float64] | None = None

    def base(self, who: str) -> NDArray[np.float64]:
        """The described value. Raises SceneError where there is none."""
        if self.described is None:
            raise SceneError(
                f"{self.key!r}: {who} starts at the described value, and this key has none: it is no parameter. Use "
                "Choice of whole entries instead."
            )
        return self.described


@dataclass(frozen=True, eq=False)
class Distribution(ABC):
    """Base of all. Distributions are plain data: they compare, pickle, and stand in YAML files under ``name``.

    To write one of your own, derive a class, decorate it with ``@dataclass(frozen=True, eq=False)``, give it a ``name``
    that no other has, and draw from ``random.random(shape)`` alone. Files that name it can be read once the module that
    defines it has been imported. SceneError, as the class is made, for a name that is taken.
    """

    known: ClassVar[dict[str, type[Distribution]]] = {}
    name: ClassVar[str] = ""
    # The field that stands for the whole where a file gives no mapping: {uniform: [0, 1]}.
    short: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        name = vars(cls).get("name")
        if name:
            # The same one again where a cell of a notebook is run twice, or a module anew.
            other = Distribution.known.get(name)
            if other is not None and (other.__module__, other.__qualname__) != (cls.__module__, cls.__qualname__):
                raise SceneError(
                    f"{cls.__qualname__}: the name {name!r} is that of {other.__module__}.{other.__qualname__}. "
                    "Choose another one."
                )
            Distribution.known[name] = cls

    @classmethod
    def check_kind(cls) -> None:
        """Raise SceneError unless the class can be told from all others, and all of its settings are fields."""
        if not vars(cls).get("name"):
            raise SceneError(f"{cls.__qualname__}: expected a distribution with a name of its own: name = '...' in it.")
        if "__init__" in vars(cls) and "__dataclass_fields__" not in vars(cls):
            raise SceneError(
                f"{cls.__qualname__}: expected a distribution whose settings are fields: decorate the class with "
                "@dataclass(frozen=True, eq=False), without an __init__ of its own."
            )

    @abstractmethod
    def draw(self, random: Draw, place: Place) -> Any:
        """A value for a place: a float64 array of its shape, or what a Choice holds. The same numbers, the same value.
        Raises SceneError, ShapeError for a place that it does not fit.
        """

    def entries(self) -> dict[str, Any]:
        """Its settings by name, as constructors take them."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and _same(self.entries(), other.entries())

    def __hash__(self) -> int:
        return hash(type(self))


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return list(a) == list(b) and all(_same(a[key], b[key]) for key in a)
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return np.array_equal(np.asarray(a), np.asarray(b))
    if isinstance(a, list | tuple) and isinstance(b, list | tuple):
        return len(a) == len(b) and all(_same(x, y) for x, y in zip(a, b, strict=True))
    return bool(a == b)


def bounds(who: str, low: Any, high: Any, *, least: float = -np.inf) -> tuple[Any, Any]:
    """Two numbers, or arrays of one shape, with ``low`` <= ``high``, as floats or nested lists. Raises UnitError."""
    arrays = [real_array(given) for given in (low, high)]
    for name, array, given in zip(("low", "high"), arrays, (low, high), strict=True):
        if array is None or not np.isfinite(array).all():
            raise UnitError(f"{who}: expected {name} as a finite number or an array of such, got {shown(given)}.")
    first, second = arrays
    assert first is not None and second is not None
    try:
        wrong = first > second
    except ValueError:
        raise ShapeError(
            f"{who}: expected low and high of one shape, got {first.shape} and {second.shape}."
        ) from None
    with np.errstate(over="ignore"):
        if not np.isfinite(second - first).all():
            raise UnitError(f"{who}: between low={shown(low)} and high={shown(high)} lies more than floats hold.")
    if wrong.any():
        raise UnitError(f"{who}: expected low <= high, got low={shown(low)} and high={shown(high)}.")
    if (first < least).any():
        raise UnitError(f"{who}: expected low of at least {least:g}, got {shown(low)}.")
    return first.tolist(), second.tolist()


def spread(who: str, place: Place, random: Draw, same: bool, *numbers: Any) -> tuple[NDArray[np.float64], ...]:
    """Numbers in [0, 1) of the place's shape (one for all if ``same``), and ``numbers`` as arrays that go with them."""
    if place.kind == ANYTHING:
        arrays = [np.asarray(number, dtype=np.float64) for number in numbers]
        shape = np.broadcast_shapes(*(array.shape for array in arrays))
    else:
        shape, arrays = place.shape, [np.asarray(number, dtype=np.float64) for number in numbers]
        for array in arrays:
            try:
                fits = np.broadcast_shapes(array.shape, shape) == shape
            except ValueError:
                fits = False
            if not fits:
                raise ShapeError(
                    f"{place.key!r}: {who} has numbers of shape {array.shape}, the key has {shape or 'one number'}. "
                    "Give one number, or an array of the key's shape."
                )
    u = np.broadcast_to(random.random(() if same else shape), shape)
    return (u, *arrays)
