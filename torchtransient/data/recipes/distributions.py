"""Distributions of numbers, and choices of anything."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from torchtransient.checks import Numbers, as_number, flag, index, positive, real_array, shown, transform
from torchtransient.data.recipes.distribution import ANYTHING, NUMBERS, POSE, Distribution, Place, bounds, spread
from torchtransient.data.recipes.streams import Draw
from torchtransient.errors import SceneError, ShapeError, UnitError

# A truncated normal distribution keeps at least this share of the untruncated one: beyond, digits of it are lost.
_LEAST_MASS = 1e-9


def _numbers_only(who: str, place: Place) -> None:
    if place.kind == POSE:
        raise SceneError(
            f"{place.key!r} is a transform (4, 4): expected Turn, Offset, Scale, LookAt, Compose of them, or a Choice "
            f"of matrices, got {who}."
        )


@dataclass(frozen=True, eq=False)
class Uniform(Distribution):
    """Between ``low`` and ``high``, evenly. Numbers, or arrays of the key's shape; entries of a colour, a position or a
    texture are drawn independently of each other unless ``same`` (a grey colour). Raises UnitError for low > high.
    """

    name: ClassVar[str] = "uniform"
    short: ClassVar[tuple[str, ...]] = ("low", "high")

    low: Any
    high: Any
    same: bool = False

    def __post_init__(self) -> None:
        low, high = bounds("Uniform", self.low, self.high)
        object.__setattr__(self, "low", low)
        object.__setattr__(self, "high", high)
        flag("Uniform: same", self.same)

    def draw(self, random: Draw, place: Place) -> NDArray[np.float64]:
        """Float64, of the place's shape."""
        _numbers_only("Uniform", place)
        u, low, high = spread("Uniform", place, random, self.same, self.low, self.high)
        return low + u * (high - low)


@dataclass(frozen=True, eq=False)
class LogUniform(Distribution):
    """Between ``low`` and ``high`` with an even logarithm: for numbers of unknown size (extinctions, intensities).
    ``same`` as in :class:`Uniform`. Raises UnitError unless 0 < low <= high.
    """

    name: ClassVar[str] = "log_uniform"
    short: ClassVar[tuple[str, ...]] = ("low", "high")

    low: Any
    high: Any
    same: bool = False

    def __post_init__(self) -> None:
        low, high = bounds("LogUniform", self.low, self.high)
        if (np.asarray(low) <= 0).any():
            raise UnitError(f"LogUniform: expected low greater than zero, got {shown(self.low)}. Use Uniform.")
        object.__setattr__(self, "low", low)
        object.__setattr__(self, "high", high)
        flag("LogUniform: same", self.same)

    def draw(self, random: Draw, place: Place) -> NDArray[np.float64]:
        """Float64, of the place's shape."""
        _numbers_only("LogUniform", place)
        u, low, high = spread("LogUniform", place, random, self.same, self.low, self.high)
        # Not beyond the ends by rounding, nor beyond what floats hold in between.
        drawn: NDArray[np.float64] = np.clip(np.exp((1 - u) * np.log(low) + u * np.log(high)), low, high)
        return drawn


@dataclass(frozen=True, eq=False)
class Normal(Distribution):
    """Around ``mean`` with the standard deviation ``std``, cut off below ``low`` and above ``high`` (a truncated normal
    distribution, not a clipped one). ``same`` as in :class:`Uniform`. Raises UnitError for a negative deviation, and
    where next to nothing is left between the ends.
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
        flag("Normal: same", self.same)
        for name, least in (("mean", -math.inf), ("std", 0.0)):
            given = getattr(self, name)
            array = real_array(given)
            if array is None or not np.isfinite(array).all() or (array < least).any():
                wanted = "finite numbers" if name == "mean" else "finite numbers of at least 0"
                raise UnitError(f"Normal: expected {name} as {wanted}, got {shown(given)}.")
            object.__setattr__(self, name, array.tolist())
        for name in ("low", "high"):
            given = getattr(self, name)
            number = None if given is None else as_number(given)
            if given is not None and (number is None or math.isnan(number)):
                raise UnitError(f"Normal: expected {name} as a number or None, got {shown(given)}.")
            # An end at infinity is none.
            object.__setattr__(self, name, number if number is not None and math.isfinite(number) else None)
        low, high = self._ends()
        means, stds = np.broadcast_arrays(np.asarray(self.mean, np.float64), np.asarray(self.std, np.float64))
        if ((stds == 0) & ((means < low) | (means > high))).any():
            raise UnitError(f"Normal: the mean {shown(self.mean)} is outside of [{low:g}, {high:g}], and std is 0.")
        if low > high:
            raise UnitError(f"Normal: expected low <= high, got {low:g} and {high:g}.")
        first, last = self._shares(np.asarray(self.mean, np.float64), np.asarray(self.std, np.float64))
        if ((last - first < _LEAST_MASS) & (np.asarray(self.std) > 0)).any():
            raise UnitError(
                f"Normal: next to nothing of the distribution lies between low={low:g} and high={high:g}, at a mean of "
                f"{shown(self.mean)} and a deviation of {shown(self.std)}. Use Uniform, or move the ends."
            )

    def draw(self, random: Draw, place: Place) -> NDArray[np.float64]:
        """Float64, of the place's shape."""
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
        """Of the normal distribution, below each end."""
        found = []
        for end in self._ends():
            with np.errstate(divide="ignore", invalid="ignore"):
                z = np.nan_to_num((end - mean) / std, nan=0.0, posinf=np.inf, neginf=-np.inf)
            found.append(np.asarray(torch.special.ndtr(torch.as_tensor(z, dtype=torch.float64)).numpy()))
        return tuple(found)


@dataclass(frozen=True, eq=False)
class Scale(Distribution):
    """The described value times a number between ``low`` and ``high``: a brighter light, a thicker fog. Of a transform,
    the size along its own axes, from its own origin; ``same`` (the default) for all axes or entries alike. Raises
    UnitError for low > high, and for numbers below zero.
    """

    name: ClassVar[str] = "scale"
    short: ClassVar[tuple[str, ...]] = ("low", "high")

    low: Any
    high: Any
    same: bool = True

    def __post_init__(self) -> None:
        low, high = bounds("Scale", self.low, self.high, least=0.0)
        object.__setattr__(self, "low", low)
        object.__setattr__(self, "high", high)
        flag("Scale: same", self.same)

    def draw(self, random: Draw, place: Place) -> NDArray[np.float64]:
        """Float64, of the place's shape."""
        base = place.base("Scale")
        if place.kind == POSE:
            axes = Place(place.key, NUMBERS, (base.shape[0] - 1,))
            u, low, high = spread("Scale", axes, random, self.same, self.low, self.high)
            return base @ np.diag([*(low + u * (high - low)), 1.0])
        u, low, high = spread("Scale", place, random, self.same, self.low, self.high)
        return base * (low + u * (high - low))


@dataclass(frozen=True, eq=False)
class Choice(Distribution):
    """One of ``values``: numbers, arrays and matrices of the key's shape, and texts, dictionaries of plugins, scans for
    keys that stand for entries of a description. ``weights``: how often each comes, None for evenly. Raises SceneError
    for no value, UnitError for weights that are none.
    """

    name: ClassVar[str] = "choice"
    short: ClassVar[tuple[str, ...]] = ("values",)

    values: Sequence[Any]
    weights: Numbers | None = None

    def __post_init__(self) -> None:
        values, weights = checked_choices("Choice", self.values, self.weights)
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "weights", weights)

    def share(self, number: int) -> float:
        """A number in [0, 1) that draws the value of that ``number``; any, for one of weight zero."""
        number = index("Choice.share: number", number, len(self.values))
        weights = np.ones(len(self.values)) if self.weights is None else np.asarray(self.weights, dtype=np.float64)
        return float((weights[:number].sum() + weights[number] / 2) / weights.sum())

    def draw(self, random: Draw, place: Place) -> Any:
        """Float64 of the place's shape for a parameter, and the value itself for other keys."""
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
    """Values and their weights as lists. Raises SceneError, UnitError."""
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
    """Numbers of numpy and torch as Python's, so that a recipe is the same one after it was written and read; arrays
    and nodes as copies of their own, transforms of Mitsuba as matrices.
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
    """A number below ``count``, by the weights."""
    u = float(random.random())
    if weights is None:
        return min(int(u * count), count - 1)
    shares = np.cumsum(np.asarray(weights, dtype=np.float64))
    chosen = int(np.searchsorted(shares, u * shares[-1], side="right"))
    # Not one of weight zero, where rounding has reached the end.
    return min(chosen, max(i for i, weight in enumerate(weights) if weight > 0))
