"""Results as inputs of losses: renders, captures, volumes and readings in place of tensors.

A result is any object with the attribute that is compared (`transient`, `phasor`, `steady`, ...). Its `axis`, the width
of its bins and its dimension of time replace arguments that are not given.
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


class HasRates(Protocol):
    """Result of a film of rates: `rates` with `rate_axis` and `axis`."""

    @property
    def rates(self) -> Tensor | None: ...


class HasBeats(Protocol):
    """Result of a film of beats: `beats` with `chirps` and `axis`."""

    @property
    def beats(self) -> Tensor | None: ...


class HasPhasor(Protocol):
    """Result of a phasor film: `phasor` with `frequencies`."""

    @property
    def phasor(self) -> Tensor | None: ...


class HasGated(Protocol):
    """Result of a gated film: `gated` with `gates`."""

    @property
    def gated(self) -> Tensor | None: ...


class HasSteady(Protocol):
    """Render with a picture, `steady`."""

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
Binned = Tensor | HasTransient | HasRates | HasBeats
Phasors = Tensor | HasPhasor
Light = Tensor | HasTransient | HasPhasor | HasGated
Picture = Tensor | HasSteady
Volume = Tensor | HasValues
DepthMap = Tensor | HasDepth

LIGHT = ("transient", "phasor", "gated", "rates", "beats")
# Attributes of results for losses along the bins of a histogram; of rates the bins of the rate.
BINNED = ("transient", "rates", "beats")
TRANSIENT, PHASOR, STEADY, VALUES, DEPTH = ("transient",), ("phasor",), ("steady",), ("values",), ("depth_m",)
# The axes of each attribute, which two results have to share.
_AXES = {
    "transient": ("axis",), "rates": ("axis", "rate_axis"), "beats": ("axis", "chirps"), "phasor": ("frequencies",),
    "gated": ("gates",),
}  # fmt: skip
_EVERY = (*LIGHT, *STEADY, *VALUES, *DEPTH)
_IMAGES, _RATES = -3, -4
# Of the width of a bin or of a frequency: axes that went through files and units are equal but for rounding.
_ROUNDING = 1e-3


def reads(**measures: tuple[str, ...]) -> Callable[[Callable[Arguments, Returned]], Callable[Arguments, Returned]]:
    """Decorate a function so that the named arguments may be results, of which it receives a tensor.

    Args:
        measures: attributes per argument, by preference. Of two results the same attribute is read where both have it.

    Options `dim`, `bin_width_opl`, `axis` and `spacing` that are not given are those of the results. The function
    raises ShapeError for a result without any of the attributes, UnitError for results on two axes.
    """

    def wrapped(function: Callable[Arguments, Returned]) -> Callable[Arguments, Returned]:
        signature = inspect.signature(function)
        places = {name: list(signature.parameters).index(name) for name in measures}

        @functools.wraps(function)
        def reading(*args: Arguments.args, **keywords: Arguments.kwargs) -> Returned:
            given = [args[i] if i < len(args) else keywords.get(name) for name, i in places.items()]
            # compiled and mapped functions see nothing of what follows
            if all(isinstance(x, Tensor) for x in given):
                return function(*args, **keywords)
            try:
                bound = signature.bind(*args, **keywords)
            except TypeError:
                return function(*args, **keywords)  # Python's own message names the function
            _read(bound.arguments, measures, set(signature.parameters), function.__name__)
            return function(*bound.args, **bound.kwargs)

        return reading

    return wrapped


def _read(arguments: dict[str, Any], measures: dict[str, tuple[str, ...]], known: set[str], where: str) -> None:
    """Replace results by their tensors, and options that are not given by the settings of results."""
    results = {name: arguments[name] for name in measures if not isinstance(arguments[name], Tensor)}
    taken = {name: _attribute(x, measures[name], list(results.values()), name, where) for name, x in results.items()}
    for attribute, settings in _AXES.items():
        alike = [results[name] for name in taken if taken[name] == attribute]
        for setting in settings:
            _check_one_axis([getattr(x, setting, None) for x in alike], where)
    for name, attribute in taken.items():
        x = results[name]
        arguments[name] = getattr(x, attribute)
        dim = arguments.get("dim")
        if dim is None:
            dim = _RATES if attribute == "rates" and measures[name] == BINNED else _IMAGES
        elif isinstance(dim, int) and dim >= 0:
            dim -= arguments[name].ndim
        for setting, value in _settings(x, attribute, known, dim, where).items():
            if setting in known and arguments.get(setting) is None:
                arguments[setting] = value


def _settings(x: object, attribute: str, known: set[str], dim: Any, where: str) -> dict[str, Any]:
    """Return the options that a result sets; ``dim``: dimension of time or rates of images."""
    if attribute == "values" and "spacing" in known:
        return {"spacing": _spacing(getattr(x, "grid", None), where)}
    if attribute not in LIGHT:
        return {}
    axis = getattr(x, "axis", None) if attribute in BINNED else None
    scan = getattr(getattr(x, "scan", None), "shape", None)  # exhaustive captures and lists of points
    if attribute == "rates" and dim == _RATES:
        rates = getattr(x, "rate_axis", None)
        return {"dim": dim, "bin_width_opl": None if rates is None else rates.bin_width}
    return {
        "dim": dim if scan is None else -1 - len(scan),
        "axis": axis,
        "bin_width_opl": None if axis is None else axis.bin_width_opl,
    }


def _spacing(grid: Any, where: str) -> tuple[float, float, float] | None:
    """Return the spacing of voxels along Z, Y, X, metres. Raises ShapeError for uneven planes."""
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


def _there(x: object, names: tuple[str, ...]) -> list[str]:
    return [name for name in names if isinstance(getattr(x, name, None), Tensor)]


def _attribute(x: object, wanted: tuple[str, ...], results: list[object], name: str, where: str) -> str:
    """Return the attribute to read: one that all results have, if any."""
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
