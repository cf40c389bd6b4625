"""Random numbers of a sample, and distributions that turn them into values of a key.

Every purpose of every sample has a counter-based generator (Philox 4x64) of its own, whose key is a hash of the
recipe's seed, the sample's number and the purpose: sample i can be made alone, on any machine, in any order, and a
distribution that is added to a recipe leaves the draws of the others as they were.
"""

from __future__ import annotations

import hashlib
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, fields
from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from torchtransient.checks import Numbers, finite, numbers, positive, real_array, shown, transform
from torchtransient.errors import SceneError, ShapeError, UnitError

# Seeds of renders, as Mitsuba takes them.
_SEEDS = 2**32


class Draw(Protocol):
    """Source of random numbers of a distribution."""

    def random(self, shape: tuple[int, ...] = ()) -> NDArray[np.float64]:
        """Draw independent numbers in [0, 1).

        Args:
            shape: shape of the array.

        Returns:
            float64, of this shape.
        """
        ...


class Stream:
    """Random numbers of one purpose of one sample.

    Args:
        seed: seed of the recipe.
        index: number of the sample in the recipe, from 0.
        purpose: the key that varies, for instance.
    """

    def __init__(self, seed: int, index: int, purpose: str) -> None:
        digest = hashlib.blake2b(f"{seed}/{index}/{purpose}".encode(), digest_size=16).digest()
        self._generator = np.random.Generator(np.random.Philox(key=np.frombuffer(digest, "<u8").astype(np.uint64)))

    def random(self, shape: tuple[int, ...] = ()) -> NDArray[np.float64]:
        """Draw independent numbers in [0, 1).

        Args:
            shape: shape of the array.

        Returns:
            float64, of this shape.
        """
        return np.asarray(self._generator.random(shape), dtype=np.float64)

    def seed(self) -> int:
        """Draw a seed of a render, or of torch, below 2^32."""
        return int(self._generator.integers(_SEEDS))


class Fixed:
    """Constant in place of a stream.

    Args:
        number: the constant, in [0, 1).
    """

    def __init__(self, number: float) -> None:
        self._number = number

    def random(self, shape: tuple[int, ...] = ()) -> NDArray[np.float64]:
        """Return the constant.

        Args:
            shape: shape of the array.

        Returns:
            float64, of this shape.
        """
        return np.full(shape, self._number)


class Extreme:
    """Lower or upper end in place of a stream, to find the values that a distribution can reach. After 16 calls it is a
    stream: a distribution that draws until something fits has to come to an end.

    Args:
        upper: True for the upper end, False for the lower one.
    """

    calls = 16

    def __init__(self, upper: bool) -> None:
        self._number, self._left = (np.nextafter(1.0, 0.0) if upper else 0.0), self.calls
        self._otherwise = Stream(0, int(upper), "ends")

    def random(self, shape: tuple[int, ...] = ()) -> NDArray[np.float64]:
        """Return the end of [0, 1), for the first calls.

        Args:
            shape: shape of the array.

        Returns:
            float64, of this shape.
        """
        self._left -= 1
        return np.full(shape, self._number) if self._left >= 0 else self._otherwise.random(shape)


# Kinds of values: numbers of a shape, a pose (4, 4), or anything (texts, nodes of a scene).
NUMBERS, POSE, ANYTHING = "numbers", "pose", "anything"


@dataclass(frozen=True)
class Place:
    """Key for which a value is drawn.

    Args:
        key: key in the ``vary`` of the recipe.
        kind: NUMBERS, POSE or ANYTHING.
        shape: shape of the value, for NUMBERS and POSE.
        described: value in the scene description, float64, for NUMBERS and POSE; None for keys without one.
    """

    key: str
    kind: str = ANYTHING
    shape: tuple[int, ...] = ()
    described: NDArray[np.float64] | None = None

    def base(self, who: str) -> NDArray[np.float64]:
        """Return the described value.

        Args:
            who: name of the distribution, for messages.

        Returns:
            float64, of the place's shape.

        Raises:
            SceneError: for a key without one.
        """
        if self.described is None:
            raise SceneError(
                f"{self.key!r}: {who} starts at the described value, and this key has none: it is no parameter. Use "
                "Choice of whole entries instead."
            )
        return self.described


@dataclass(frozen=True, eq=False)
class Distribution(ABC):
    """Base of all distributions. They are plain data: they compare, pickle, and stand in YAML files under ``name``.

    To write one of your own, derive a class, decorate it with ``@dataclass(frozen=True, eq=False)``, give it a ``name``
    that no other has, and draw from ``random.random(shape)`` alone. Files that name it can be read once its module has
    been imported. A name that is taken raises SceneError as the class is made.
    """

    known: ClassVar[dict[str, type[Distribution]]] = {}
    name: ClassVar[str] = ""
    # Fields of the short form in files, {uniform: [0, 1]}.
    short: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        name = vars(cls).get("name")
        if name:
            # A class may be defined again, by a cell of a notebook or a reloaded module.
            other = Distribution.known.get(name)
            if other is not None and (other.__module__, other.__qualname__) != (cls.__module__, cls.__qualname__):
                raise SceneError(
                    f"{cls.__qualname__}: the name {name!r} is that of {other.__module__}.{other.__qualname__}. "
                    "Choose another one."
                )
            Distribution.known[name] = cls

    @classmethod
    def check_kind(cls) -> None:
        """Raise SceneError for a class without a name of its own, or with settings that are no fields."""
        if not vars(cls).get("name"):
            raise SceneError(f"{cls.__qualname__}: expected a distribution with a name of its own: name = '...' in it.")
        if "__init__" in vars(cls) and "__dataclass_fields__" not in vars(cls):
            raise SceneError(
                f"{cls.__qualname__}: expected a distribution whose settings are fields: decorate the class with "
                "@dataclass(frozen=True, eq=False), without an __init__ of its own."
            )

    @abstractmethod
    def draw(self, random: Draw, place: Place) -> Any:
        """Draw a value, which the random numbers and the place alone determine.

        Args:
            random: source of numbers in [0, 1).
            place: key for which it is drawn.

        Returns:
            float64 array of the place's shape, or an entry of a Choice.

        Raises:
            SceneError: for a key that it does not fit.
            ShapeError: for a shape that it does not fit.
        """

    def _keep(self, **settings: Any) -> None:
        """Replace settings by their checked values."""
        for name, value in settings.items():
            object.__setattr__(self, name, value)

    def entries(self) -> dict[str, Any]:
        """Return the settings by name, as constructors take them."""
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
    """Check two bounds.

    Args:
        who: name of the distribution.
        low: lower bound, a number or an array.
        high: upper bound of the same shape, not below ``low``.
        least: smallest ``low`` that is allowed.

    Returns:
        Floats or nested lists.

    Raises:
        UnitError: for other numbers.
        ShapeError: for two shapes.
    """
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
    if wrong.any():
        raise UnitError(f"{who}: expected low <= high, got low={shown(low)} and high={shown(high)}.")
    if (first < least).any():
        raise UnitError(f"{who}: expected low of at least {least:g}, got {shown(low)}.")
    return first.tolist(), second.tolist()


def spread(who: str, place: Place, random: Draw, same: bool, *values: Any) -> tuple[NDArray[np.float64], ...]:
    """Draw numbers of a place's shape.

    Args:
        who: name of the distribution.
        place: key for which they are drawn.
        random: source of numbers in [0, 1).
        same: draw one number for all entries.
        values: arrays that are broadcast to the shape.

    Returns:
        Numbers in [0, 1), and ``values`` as float64 arrays.

    Raises:
        ShapeError: for arrays that do not fit.
    """
    arrays = [np.asarray(value, dtype=np.float64) for value in values]
    shape = np.broadcast_shapes(*(array.shape for array in arrays)) if place.kind == ANYTHING else place.shape
    for array in arrays:
        try:
            np.broadcast_to(array, shape)
        except ValueError:
            raise ShapeError(
                f"{place.key!r}: {who} has numbers of shape {array.shape}, the key has {shape or 'one number'}. "
                "Give one number, or an array of the key's shape."
            ) from None
    u = np.broadcast_to(random.random(() if same else shape), shape)
    return (u, *arrays)


# Least share of the normal distribution that a truncated one keeps, for its digits.
_LEAST_MASS = 1e-9


def _numbers_only(who: str, place: Place) -> None:
    if place.kind == POSE:
        raise SceneError(
            f"{place.key!r} is a transform (4, 4): expected Turn, Offset, Scale, LookAt, Compose of them, or a Choice "
            f"of matrices, got {who}."
        )


@dataclass(frozen=True, eq=False)
class Uniform(Distribution):
    """Even distribution between two bounds.

    Args:
        low: lower bound: a number, or an array of the key's shape.
        high: upper bound: a number, or an array of the key's shape.
        same: draw one number for all entries of a colour (which is grey then), a position or a texture, instead of
            independent ones.

    Raises:
        UnitError: for low > high.
    """

    name: ClassVar[str] = "uniform"
    short: ClassVar[tuple[str, ...]] = ("low", "high")

    low: Any
    high: Any
    same: bool = False

    def __post_init__(self) -> None:
        low, high = bounds(type(self).__name__, self.low, self.high)
        self._keep(low=low, high=high)

    def draw(self, random: Draw, place: Place) -> NDArray[np.float64]:
        """Draw a value.

        Args:
            random: source of numbers in [0, 1).
            place: key for which it is drawn.

        Returns:
            float64, of the place's shape.
        """
        _numbers_only("Uniform", place)
        u, low, high = spread("Uniform", place, random, self.same, self.low, self.high)
        return low + u * (high - low)


@dataclass(frozen=True, eq=False)
class LogUniform(Uniform):
    """Even distribution of the logarithm, for numbers of unknown size (extinctions, intensities).

    Args:
        low: lower bound above zero: a number, or an array of the key's shape.
        high: upper bound: a number, or an array of the key's shape.
        same: draw one number for all entries of a colour, a position or a texture, see :class:`Uniform`.

    Raises:
        UnitError: unless 0 < low <= high.
    """

    name: ClassVar[str] = "log_uniform"

    def __post_init__(self) -> None:
        super().__post_init__()
        if (np.asarray(self.low) <= 0).any():
            raise UnitError(f"LogUniform: expected low greater than zero, got {shown(self.low)}. Use Uniform.")

    def draw(self, random: Draw, place: Place) -> NDArray[np.float64]:
        """Draw a value.

        Args:
            random: source of numbers in [0, 1).
            place: key for which it is drawn.

        Returns:
            float64, of the place's shape.
        """
        _numbers_only("LogUniform", place)
        u, low, high = spread("LogUniform", place, random, self.same, self.low, self.high)
        # Rounding stays within the ends, and the product within floats.
        drawn: NDArray[np.float64] = np.clip(np.exp((1 - u) * np.log(low) + u * np.log(high)), low, high)
        return drawn


@dataclass(frozen=True, eq=False)
class Normal(Distribution):
    """Normal distribution, truncated (not clipped) at ``low`` and ``high``.

    Args:
        mean: centre of the distribution before it is truncated: a number, or an array of the key's shape.
        std: standard deviation: a number, or an array of the key's shape.
        low: lower end, None for none.
        high: upper end, None for none.
        same: draw one number for all entries of a colour, a position or a texture, see :class:`Uniform`.

    Raises:
        UnitError: for a negative deviation, and where less than 1e-9 of the distribution lies between the ends.
    """

    name: ClassVar[str] = "normal"
    short: ClassVar[tuple[str, ...]] = ("mean", "std")

    mean: Any
    std: Any
    _: KW_ONLY
    low: float | None = None
    high: float | None = None
    same: bool = False

    def __post_init__(self) -> None:
        mean, std = numbers("Normal: mean", self.mean), numbers("Normal: std", self.std)
        if not (np.isfinite(mean).all() and np.isfinite(std).all() and (std >= 0).all()):
            raise UnitError(
                f"Normal: expected mean and std as finite numbers, std of at least 0, got {shown(self.mean)} and "
                f"{shown(self.std)}."
            )
        self._keep(mean=mean.tolist(), std=std.tolist())
        for name in ("low", "high"):
            end = getattr(self, name)
            # An end at infinity is none.
            self._keep(**{name: None if end is None or math.isinf(end) else finite(f"Normal: {name}", end)})
        first, last = self._shares(mean, std)
        if (last - first < _LEAST_MASS).any():
            low, high = self._ends()
            raise UnitError(
                f"Normal: next to nothing of the distribution lies between low={low:g} and high={high:g}, at a mean of "
                f"{shown(self.mean)} and a deviation of {shown(self.std)}. Use Uniform, or move the ends."
            )

    def draw(self, random: Draw, place: Place) -> NDArray[np.float64]:
        """Draw a value.

        Args:
            random: source of numbers in [0, 1).
            place: key for which it is drawn.

        Returns:
            float64, of the place's shape.
        """
        _numbers_only("Normal", place)
        u, mean, std = spread("Normal", place, random, self.same, self.mean, self.std)
        first, last = self._shares(mean, std)
        # Ends of the interval are at infinity without low and high: the outermost number of 53 bits stays finite.
        share = np.clip(first + u * (last - first), 2.0**-53, 1.0 - 2.0**-53)
        z = torch.special.ndtri(torch.from_numpy(np.array(share))).numpy()
        drawn: NDArray[np.float64] = np.clip(mean + std * z, *self._ends())
        return drawn

    def _ends(self) -> tuple[float, float]:
        return (-math.inf if self.low is None else self.low), (math.inf if self.high is None else self.high)

    def _shares(self, mean: NDArray[np.float64], std: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        """Shares of the normal distribution below each end."""
        found = []
        for end in self._ends():
            with np.errstate(divide="ignore", invalid="ignore"):
                z = np.nan_to_num((end - mean) / std, nan=0.0, posinf=np.inf, neginf=-np.inf)
            found.append(np.asarray(torch.special.ndtr(torch.as_tensor(z, dtype=torch.float64)).numpy()))
        return tuple(found)


@dataclass(frozen=True, eq=False)
class Scale(Distribution):
    """The described value times a number: a brighter light, a thicker fog. Of a transform, the size along its own axes,
    from its own origin.

    Args:
        low: smallest factor, at least 0.
        high: largest factor.
        same: draw one factor for all axes or entries.

    Raises:
        UnitError: for low > high and numbers below zero.
    """

    name: ClassVar[str] = "scale"
    short: ClassVar[tuple[str, ...]] = ("low", "high")

    low: Any
    high: Any
    same: bool = True

    def __post_init__(self) -> None:
        low, high = bounds("Scale", self.low, self.high, least=0.0)
        self._keep(low=low, high=high)

    def draw(self, random: Draw, place: Place) -> NDArray[np.float64]:
        """Draw a value.

        Args:
            random: source of numbers in [0, 1).
            place: key for which it is drawn.

        Returns:
            float64, of the place's shape.
        """
        base = place.base("Scale")
        if place.kind == POSE:
            axes = Place(place.key, NUMBERS, (base.shape[0] - 1,))
            u, low, high = spread("Scale", axes, random, self.same, self.low, self.high)
            return base @ np.diag([*(low + u * (high - low)), 1.0])
        u, low, high = spread("Scale", place, random, self.same, self.low, self.high)
        return base * (low + u * (high - low))


@dataclass(frozen=True, eq=False)
class Choice(Distribution):
    """One of several values.

    Args:
        values: numbers, arrays and matrices of the key's shape; texts, dictionaries of plugins and scans for keys that
            stand for entries of a description.
        weights: relative frequencies, None for even ones.

    Raises:
        SceneError: for no value.
        UnitError: for other weights.
    """

    name: ClassVar[str] = "choice"
    short: ClassVar[tuple[str, ...]] = ("values",)

    values: Sequence[Any]
    weights: Numbers | None = None

    def __post_init__(self) -> None:
        values, weights = checked_choices("Choice", self.values, self.weights)
        self._keep(values=values, weights=weights)

    def share(self, number: int) -> float:
        """Return the number in [0, 1) that draws a value.

        Args:
            number: index of the value in ``values``; for a value of weight zero, which no number draws, any comes back.

        Returns:
            The number.
        """
        weights = np.ones(len(self.values)) if self.weights is None else np.asarray(self.weights, dtype=np.float64)
        return float((weights[:number].sum() + weights[number] / 2) / weights.sum())

    def draw(self, random: Draw, place: Place) -> Any:
        """Draw a value.

        Args:
            random: source of numbers in [0, 1).
            place: key for which it is drawn.

        Returns:
            float64 of the place's shape for a parameter, the value itself for other keys.
        """
        value = self.values[pick(random, len(self.values), self.weights)]
        if place.kind == ANYTHING:
            return value
        array = real_array(value)
        fits = array is not None and (array.shape == place.shape or (array.shape == () and place.kind != POSE))
        if array is None or not fits:
            got = shown(value) if array is None else f"shape {array.shape}"
            raise ShapeError(f"{place.key!r}: expected choices of shape {place.shape or '()'}, got {got}.")
        return np.broadcast_to(array, place.shape).copy()


def checked_choices(who: str, values: Any, weights: Any) -> tuple[list[Any], list[float] | None]:
    """Check choices and their weights.

    Args:
        who: name for messages.
        values: sequence of choices.
        weights: relative frequencies, a sequence of the same length, or None.

    Returns:
        Lists.

    Raises:
        SceneError: for no values.
        UnitError: for other weights.
    """
    is_row = isinstance(values, Sequence | np.ndarray | range) and getattr(values, "ndim", 1) > 0
    if isinstance(values, str | bytes | Mapping) or not is_row:
        raise SceneError(f"{who}: expected a list of values, got {shown(values)}.")
    plain = [_plain(value) for value in values]
    if not plain:
        raise SceneError(f"{who}: expected at least one value, got an empty list.")
    if weights is None:
        return plain, None
    array = real_array(weights)
    if array is None or array.shape != (len(plain),) or not np.isfinite(array).all() or (array < 0).any():
        raise UnitError(f"{who}: expected {len(plain)} weights of at least 0, got {shown(weights)}.")
    positive(f"{who}: sum of the weights", float(array.sum()))
    return plain, [float(weight) for weight in array]


def _plain(value: Any) -> Any:
    """Numbers of numpy and torch as those of Python, so that a recipe is the same after it was written and read; copies
    of arrays and nodes, transforms of Mitsuba as matrices.
    """
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu().numpy()
    if isinstance(value, np.generic) or (isinstance(value, np.ndarray) and value.ndim == 0):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.copy()
    if isinstance(value, Mapping):
        return {name: _plain(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return transform("Choice", value) if hasattr(value, "matrix") else value


def pick(random: Draw, count: int, weights: Numbers | None) -> int:
    """Draw a number by weights.

    Args:
        random: source of numbers in [0, 1).
        count: numbers to choose from.
        weights: relative frequencies, None for even ones.

    Returns:
        Number below ``count``.
    """
    u = float(random.random())
    if weights is None:
        return min(int(u * count), count - 1)
    shares = np.cumsum(np.asarray(weights, dtype=np.float64))
    chosen = int(np.searchsorted(shares, u * shares[-1], side="right"))
    # Rounding at the end chooses no value of weight zero.
    return min(chosen, max(i for i, weight in enumerate(weights) if weight > 0))
