"""Distributions of poses: transforms (4, 4) that differ from the described one. Lengths in metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from torchtransient.checks import real_array, shown
from torchtransient.data.distributions import ANYTHING, NUMBERS, POSE, Distribution, Draw, Place, bounds, spread
from torchtransient.errors import ArgumentError, SceneError, ShapeError, UnitError
from torchtransient.scenes.transforms import look_at, rotate

_ABOUT = ("self", "world")


def _pose_only(who: str, place: Place) -> None:
    if place.kind != POSE or place.shape != (4, 4):
        what = f"has the shape {place.shape or '()'}" if place.kind == NUMBERS else "is an entry of the description"
        raise SceneError(f"{place.key!r} {what}: expected Uniform, Normal, Choice, ... there; {who} is for transforms.")


@dataclass(frozen=True, eq=False)
class Turn(Distribution):
    """The described pose turned counterclockwise about an axis.

    Args:
        axis: direction [x, y, z] in the world.
        low: smallest angle in degrees.
        high: largest angle in degrees.
        about: centre: "self" (where the transform puts (0, 0, 0)), "world" (the world's origin), or a point [x, y, z].

    Raises:
        UnitError: for low > high and an axis without length.
        ShapeError: for other axes.
    """

    name: ClassVar[str] = "turn"
    short: ClassVar[tuple[str, ...]] = ("axis", "low", "high")

    axis: Any = (0.0, 1.0, 0.0)
    low: float = 0.0
    high: float = 360.0
    _: KW_ONLY
    about: Any = "self"

    def __post_init__(self) -> None:
        low, high = bounds("Turn", self.low, self.high)
        axis = _three("Turn: axis", self.axis)
        if not np.linalg.norm(axis) > 0:
            raise UnitError("Turn: expected an axis with a length, got (0, 0, 0).")
        about = self.about
        if isinstance(about, str):
            if about not in _ABOUT:
                raise ArgumentError(f"Turn: expected about='self', 'world' or a point [x, y, z], got {about!r}.")
        else:
            about = _three("Turn: about", about)
        self._keep(low=low, high=high, axis=axis, about=about)

    def draw(self, random: Draw, place: Place) -> NDArray[np.float64]:
        """Draw a pose.

        Args:
            random: source of numbers in [0, 1).
            place: key for which it is drawn.

        Returns:
            float64 (4, 4).
        """
        _pose_only("Turn", place)
        base = place.base("Turn")
        angle = self.low + float(random.random()) * (self.high - self.low)
        centre = base[:3, 3] if self.about == "self" else np.zeros(3) if self.about == "world" else np.array(self.about)
        turn = rotate(self.axis, angle)
        turn[:3, 3] = centre - turn[:3, :3] @ centre
        return turn @ base


@dataclass(frozen=True, eq=False)
class Offset(Distribution):
    """The described value moved. Transforms move by [x, y, z] in the world, in metres; other numbers are added to;
    vertices (V, 3) and lists of points move together by [x, y, z].

    Args:
        low: smallest offset.
        high: largest offset, of the same shape.

    Raises:
        UnitError: for low > high.
    """

    name: ClassVar[str] = "offset"
    short: ClassVar[tuple[str, ...]] = ("low", "high")

    low: Any
    high: Any

    def __post_init__(self) -> None:
        low, high = bounds("Offset", self.low, self.high)
        self._keep(low=low, high=high)

    def draw(self, random: Draw, place: Place) -> NDArray[np.float64]:
        """Draw a value.

        Args:
            random: source of numbers in [0, 1).
            place: key for which it is drawn.

        Returns:
            float64, of the place's shape.
        """
        base = place.base("Offset")
        if place.kind == POSE:
            _pose_only("Offset", place)
            moved = base.copy()
            moved[:3, 3] += self._by(random, Place(place.key, NUMBERS, (3,)))
            return moved
        own = np.broadcast_shapes(np.shape(self.low), np.shape(self.high))
        shape = own if len(own) < len(place.shape) and own else place.shape
        return base + self._by(random, Place(place.key, NUMBERS, shape))

    def _by(self, random: Draw, place: Place) -> NDArray[np.float64]:
        u, low, high = spread("Offset", place, random, False, self.low, self.high)
        return low + u * (high - low)


@dataclass(frozen=True, eq=False)
class LookAt(Distribution):
    """Pose that looks from one point to another, for sensors, spots and projectors. A draw that puts both in one place,
    or looks along ``up``, raises SceneError.

    Args:
        origin: point [x, y, z], or a distribution of points (an Offset starts at the world's origin).
        target: point that it looks at, in the same forms.
        up: direction that is up in the picture.
    """

    name: ClassVar[str] = "look_at"
    short: ClassVar[tuple[str, ...]] = ("origin", "target")

    origin: Any
    target: Any
    up: Any = (0.0, 1.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("origin", "target"):
            given = getattr(self, name)
            if not isinstance(given, Distribution):
                self._keep(**{name: _three(f"LookAt: {name}", given)})
        self._keep(up=_three("LookAt: up", self.up))

    def draw(self, random: Draw, place: Place) -> NDArray[np.float64]:
        """Draw a pose.

        Args:
            random: source of numbers in [0, 1).
            place: key for which it is drawn.

        Returns:
            float64 (4, 4).
        """
        _pose_only("LookAt", place)
        origin, target = (self._point(given, random, place) for given in (self.origin, self.target))
        try:
            return look_at(origin, target, self.up)
        except SceneError as error:
            raise SceneError(f"{place.key!r}: {error}") from error

    @staticmethod
    def _point(given: Any, random: Draw, place: Place) -> NDArray[np.float64]:
        if isinstance(given, Distribution):
            at = Place(f"{place.key} (LookAt)", NUMBERS, (3,), np.zeros(3))
            return np.asarray(given.draw(random, at), dtype=np.float64)
        return np.asarray(given, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Compose(Distribution):
    """Several distributions in a row, each from the value of the one before: ``Compose([Turn(...), Offset(...)])``.

    Args:
        steps: distributions.

    Raises:
        SceneError: for other steps.
    """

    name: ClassVar[str] = "compose"
    short: ClassVar[tuple[str, ...]] = ("steps",)

    steps: Sequence[Distribution]

    def __post_init__(self) -> None:
        wrong = [step for step in self.steps if not isinstance(step, Distribution)]
        if wrong:
            raise SceneError(f"Compose: expected distributions, got {shown(wrong[0])}.")
        self._keep(steps=tuple(self.steps))

    def draw(self, random: Draw, place: Place) -> Any:
        """Draw a value.

        Args:
            random: source of numbers in [0, 1).
            place: key for which it is drawn.

        Returns:
            Value of the last step.
        """
        if place.kind == ANYTHING:
            raise SceneError(f"{place.key!r} is an entry of the description: Compose is for parameters; use Choice.")
        value = place.base("Compose")
        for step in self.steps:
            value = np.asarray(step.draw(random, replace(place, described=value)), dtype=np.float64)
        return value


def _three(who: str, given: Any) -> list[float]:
    array = real_array(given)
    if array is None or array.shape != (3,) or not np.isfinite(array).all():
        raise ShapeError(f"{who}: expected three finite numbers [x, y, z], got {shown(given)}.")
    return [float(number) for number in array]
