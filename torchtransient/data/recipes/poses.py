"""Distributions of poses: transforms (4, 4) that differ from the described one. All lengths in metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from torchtransient.checks import real_array, shown
from torchtransient.data.recipes.distribution import ANYTHING, NUMBERS, POSE, Distribution, Place, bounds, spread
from torchtransient.data.recipes.streams import Draw
from torchtransient.errors import ArgumentError, SceneError, ShapeError, UnitError
from torchtransient.scenes.transforms import look_at, rotate

_ABOUT = ("self", "world")


def _pose_only(who: str, place: Place) -> None:
    if place.kind != POSE or place.shape != (4, 4):
        what = f"has the shape {place.shape or '()'}" if place.kind == NUMBERS else "is an entry of the description"
        raise SceneError(f"{place.key!r} {what}: expected Uniform, Normal, Choice, ... there; {who} is for transforms.")


@dataclass(frozen=True, eq=False)
class Turn(Distribution):
    """The described pose turned by an angle between ``low`` and ``high`` degrees, counterclockwise about ``axis`` (a
    direction of the world). ``about``: "self", the origin of the thing itself (where its transform puts (0, 0, 0));
    "world", the world's origin; or a point [x, y, z]. Raises UnitError for low > high and an axis without length.
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
        if isinstance(low, list) or isinstance(high, list):
            raise ShapeError(f"Turn: expected low and high as single angles in degrees, got {shown(self.low)}.")
        axis = _three("Turn: axis", self.axis)
        if not np.linalg.norm(axis) > 0:
            raise UnitError("Turn: expected an axis with a length, got (0, 0, 0).")
        about = self.about
        if isinstance(about, str):
            if about not in _ABOUT:
                raise ArgumentError(f"Turn: expected about='self', 'world' or a point [x, y, z], got {about!r}.")
        else:
            about = _three("Turn: about", about)
        for name, value in (("low", low), ("high", high), ("axis", axis), ("about", about)):
            object.__setattr__(self, name, value)

    def draw(self, random: Draw, place: Place) -> NDArray[np.float64]:
        """Float64 (4, 4)."""
        _pose_only("Turn", place)
        base = place.base("Turn")
        angle = self.low + float(random.random()) * (self.high - self.low)
        centre = base[:3, 3] if self.about == "self" else np.zeros(3) if self.about == "world" else np.array(self.about)
        turn = rotate(self.axis, angle)
        turn[:3, 3] = centre - turn[:3, :3] @ centre
        return turn @ base


@dataclass(frozen=True, eq=False)
class Offset(Distribution):
    """The described value moved by something between ``low`` and ``high``. Of a transform: [x, y, z] in the world, in
    metres. Of other numbers: added to them; vertices (V, 3) and lists of points move together by [x, y, z]. Raises
    UnitError for low > high.
    """

    name: ClassVar[str] = "offset"
    short: ClassVar[tuple[str, ...]] = ("low", "high")

    low: Any
    high: Any

    def __post_init__(self) -> None:
        low, high = bounds("Offset", self.low, self.high)
        object.__setattr__(self, "low", low)
        object.__setattr__(self, "high", high)

    def draw(self, random: Draw, place: Place) -> NDArray[np.float64]:
        """Float64, of the place's shape."""
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
    """A pose at ``origin`` that looks at ``target``, for sensors, spots and projectors: points [x, y, z], or
    distributions of points (an Offset starts at the world's origin). ``up``: a direction that is up in the picture.
    A draw that puts both in one place, or looks along ``up``, raises SceneError.
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
                object.__setattr__(self, name, _three(f"LookAt: {name}", given))
        object.__setattr__(self, "up", _three("LookAt: up", self.up))

    def draw(self, random: Draw, place: Place) -> NDArray[np.float64]:
        """Float64 (4, 4)."""
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
    """Several in a row, each from where the one before has put things: ``Compose([Turn(...), Offset(...)])``. Raises
    SceneError for what is no distribution.
    """

    name: ClassVar[str] = "compose"
    short: ClassVar[tuple[str, ...]] = ("steps",)

    steps: Sequence[Distribution]

    def __post_init__(self) -> None:
        given: Any = self.steps
        if isinstance(given, Distribution) or not isinstance(given, Sequence) or isinstance(given, str) or not given:
            raise SceneError(f"Compose: expected a list of distributions, got {shown(given)}.")
        wrong = [step for step in given if not isinstance(step, Distribution)]
        if wrong:
            raise SceneError(f"Compose: expected distributions, got {shown(wrong[0])}.")
        object.__setattr__(self, "steps", tuple(given))

    def draw(self, random: Draw, place: Place) -> Any:
        """What the last step makes of what the ones before it have made."""
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
