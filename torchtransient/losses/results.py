"""Results in place of tensors: losses take a render, a capture or what a method found, and read what they compare.

By attributes alone, so that any object with them will do: this room knows no renderer. Beside the tensor a result knows
where its time is (`dim`) and its axis, which stand for arguments that are not given.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any, ParamSpec, Protocol, TypeVar

from torch import Tensor

from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.errors import ShapeError, UnitError

Arguments = ParamSpec("Arguments")
Returned = TypeVar("Returned")


class HasTransient(Protocol):
    """`RenderOutput`, `Capture`, `Result` of a file: `transient` with `axis`."""

    @property
    def transient(self) -> Tensor | None: ...


class HasPhasor(Protocol):
    """The same of a phasor film: `phasor` with `frequencies`."""

    @property
    def phasor(self) -> Tensor | None: ...


class HasGated(Protocol):
    """The same of a gated film: `gated` with `gates`."""

    @property
    def gated(self) -> Tensor | None: ...


class HasSteady(Protocol):
    """A render's picture."""

    @property
    def steady(self) -> Tensor | None: ...


class HasValues(Protocol):
    """`HiddenVolume`."""

    @property
    def values(self) -> Tensor: ...


class HasDepth(Protocol):
    """`ItofReading`."""

    @property
    def depth_m(self) -> Tensor: ...


Transient = Tensor | HasTransient
Phasors = Tensor | HasPhasor
Light = Tensor | HasTransient | HasPhasor | HasGated
Picture = Tensor | HasSteady
Volume = Tensor | HasValues
DepthMap = Tensor | HasDepth

LIGHT = ("transient", "phasor", "gated", "rates", "beats")
TRANSIENT, PHASOR, STEADY, VALUES, DEPTH = ("transient",), ("phasor",), ("steady",), ("values",), ("depth_m",)
# What says where on its axis a tensor lies: two results are compared on one.
_AXES = {
    "transient": ("axis",), "rates": ("axis", "rate_axis"), "beats": ("axis", "chirps"), "phasor": ("frequencies",),
    "gated": ("gates",),
}  # fmt: skip
_EVERY = (*LIGHT, *STEADY, *VALUES, *DEPTH)
_IMAGES = -3
# Of the width of a bin or of a frequency: axes that went through files and units are equal but for rounding.
_ROUNDING = 1e-3


def reads(**measures: tuple[str, ...]) -> Callable[[Callable[Arguments, Returned]], Callable[Arguments, Returned]]:
    """A function of which the arguments named may be results: it gets the first of their attributes that is there.

    Arguments `dim`, `bin_width_opl` and `axis` that are not given are those of the results. Raises ShapeError for a
    result that has none of the attributes, UnitError for results on two axes.
    """

    def wrapped(function: Callable[Arguments, Returned]) -> Callable[Arguments, Returned]:
        signature = inspect.signature(function)
        names = ", ".join(signature.parameters)
        places = {name: list(signature.parameters).index(name) for name in measures}

        @functools.wraps(function)
        def reading(*args: Arguments.args, **keywords: Arguments.kwargs) -> Returned:
            given = [args[i] if i < len(args) else keywords.get(name) for name, i in places.items()]
            # tensors, as a rule, of which nothing is asked here: compiled and mapped functions see none of this
            if all(isinstance(x, Tensor) for x in given):
                return function(*args, **keywords)
            try:
                bound = signature.bind(*args, **keywords)
            except TypeError as error:  # which does not say of what
                raise TypeError(f"{function.__name__}: {error}. Its arguments are {names}.") from None
            _read(bound.arguments, measures, set(signature.parameters), function.__name__)
            return function(*bound.args, **bound.kwargs)

        return reading

    return wrapped


def _read(arguments: dict[str, Any], measures: dict[str, tuple[str, ...]], known: set[str], where: str) -> None:
    """Put tensors in the places of results, and what the results know in places that are empty."""
    results = {name: arguments[name] for name in measures if _is_result(arguments.get(name))}
    taken = {name: _attribute(x, measures[name], list(results.values()), name, where) for name, x in results.items()}
    for attribute, settings in _AXES.items():
        alike = [results[name] for name in taken if taken[name] == attribute]
        for setting in settings:
            _check_one_axis([getattr(x, setting, None) for x in alike], where)
    for name, attribute in taken.items():
        x = results[name]
        arguments[name] = getattr(x, attribute)
        for setting, value in _settings(x, attribute, known, where).items():
            if setting in known and arguments.get(setting) is None:
                arguments[setting] = value


def _settings(x: object, attribute: str, known: set[str], where: str) -> dict[str, Any]:
    """What a result knows beside its tensor, by the names of arguments."""
    if attribute == "values" and "spacing" in known:
        return {"spacing": _spacing(getattr(x, "grid", None), where)}
    if attribute not in LIGHT:
        return {}
    axis = getattr(x, "axis", None) if attribute == "transient" else None
    scan = getattr(getattr(x, "scan", None), "shape", None)  # exhaustive captures and lists of points
    return {
        "dim": _IMAGES if scan is None else -1 - len(scan),
        "axis": axis,
        "bin_width_opl": None if axis is None else axis.bin_width_opl,
    }


def _spacing(grid: Any, where: str) -> tuple[float, float, float] | None:
    """Of the voxels of a volume. Raises ShapeError for planes that are not even."""
    if grid is None:
        return None
    steps = grid.depths.diff()
    if len(steps) and float((steps - steps[0]).abs().max()) > _ROUNDING * float(steps[0]):
        raise ShapeError(
            f"{where}: expected a volume of evenly spaced planes, got steps from {float(steps.min()):.3g} to "
            f"{float(steps.max()):.3g} m. Give its values, and spacing= as they are meant."
        )
    y, x = grid.pitch
    return float(steps.mean()) if len(steps) else y, y, x


def _is_result(x: object) -> bool:
    """Whether it has one of the attributes, be it None: a dictionary has `values`, which are no tensor."""
    if isinstance(x, Tensor):
        return False
    return any(hasattr(x, name) and isinstance(getattr(x, name), Tensor | None) for name in _EVERY)


def _there(x: object, names: tuple[str, ...]) -> list[str]:
    return [name for name in names if isinstance(getattr(x, name, None), Tensor)]


def _attribute(x: object, wanted: tuple[str, ...], results: list[object], name: str, where: str) -> str:
    """Which attribute is taken of a result: one that all others have as well, where there is one."""
    there = _there(x, wanted)
    if not there:
        held = " and ".join(_there(x, _EVERY)) or "nothing of the kind"
        raise ShapeError(
            f"{where}: expected {name} to be a tensor or a result with {' or '.join(wanted)}, got "
            f"{type(x).__name__} with {held}. Ask the renderer for that, or give the tensor that is meant."
        )
    shared = [attribute for attribute in there if all(_there(other, (attribute,)) for other in results)]
    return (shared or there)[0]


def _check_one_axis(axes: list[Any], where: str) -> None:
    known = [axis for axis in axes if axis is not None]
    for other in known[1:]:
        if not _same_axis(known[0], other):
            raise UnitError(
                f"{where}: expected results on one axis, got {known[0]} and {other}. Render on that of the "
                "measurement, or give tensors."
            )


def _same_axis(a: Any, b: Any) -> bool:
    if isinstance(a, TimeAxis) and isinstance(b, TimeAxis):
        near = _ROUNDING * a.bin_width_opl
        ends = abs(a.start_opl - b.start_opl) <= near and abs(a.end_opl - b.end_opl) <= near
        return a.num_bins == b.num_bins and ends
    if isinstance(a, FrequencyAxis) and isinstance(b, FrequencyAxis) and a.num_frequencies == b.num_frequencies:
        pairs = zip(a.frequencies, b.frequencies, strict=True)
        turned = abs(a.start_opl - b.start_opl) * max(abs(f) for f in a.frequencies)
        return all(abs(f - g) <= _ROUNDING * abs(f) for f, g in pairs) and turned <= _ROUNDING
    return bool(a == b)
