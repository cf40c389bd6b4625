"""Checks that every sensor makes on its arguments: the layout (..., C, T, H, W), units, time axes."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.errors import ShapeError, UnitError
from torchtransient.floating import product as product
from torchtransient.floating import without_autocast as without_autocast
from torchtransient.quantities import as_number, shown

TIME = -3  # the time dimension of (..., C, T, H, W)
_OTHER_FILMS = (
    "Render with time_axis=...; phasors (out.phasor) go to ItofCorrelation, as the first stage of Compose([...]), and "
    "gated images (out.gated) are no bins: only what follows a gate may take them."
)


def check_tensor(x: object, where: str) -> Tensor:
    """`x` when it is a tensor, else ShapeError: a renderer's output, or the transient that a film does not measure."""
    if not isinstance(x, Tensor):
        raise ShapeError(f"{where}: expected a tensor (..., C, T, H, W), got {not_a_transient(x)}")
    return x


def check_transient(x: Tensor, where: str) -> Tensor:
    """`x` when it is a floating tensor (..., C, T, H, W), else ShapeError or UnitError."""
    if check_tensor(x, where).ndim < 4:
        raise ShapeError(
            f"{where}: expected a tensor (..., C, T, H, W), got {tuple(x.shape)}. Add the missing dimensions."
        )
    if x.is_complex():
        raise UnitError(
            f"{where}: expected a transient, got complex numbers ({x.dtype}): a phasor image? Render with "
            "time_axis=...; of the sensors ItofCorrelation alone takes phasors."
        )
    if not x.is_floating_point():
        raise UnitError(f"{where}: expected a floating dtype, got {x.dtype}. Convert with .float().")
    return x


def not_a_transient(x: object) -> str:
    """What was given instead of a transient, and what to do: the end of a message."""
    if x is None:
        return f"None, which is the transient of a render with a phasor or gated film. {_OTHER_FILMS}"
    if getattr(x, "transient", None) is not None:
        return f"{type(x).__name__}. Give its tensor, out.transient, or put the sensor into Compose([...])."
    if hasattr(x, "transient"):
        there = [name for name in ("phasor", "gated", "steady") if getattr(x, name, None) is not None]
        there += [name for name, value in getattr(x, "others", {}).items() if isinstance(value, Tensor)]
        held = f"holds {', '.join(there)} and no transient" if there else "holds no transient"
        return f"{type(x).__name__}, which {held}. {_OTHER_FILMS}"
    return f"{type(x).__name__}."


def check_number(
    value: float, name: str, where: str, *, low: float = 0.0, high: float = math.inf, open_low: bool = False
) -> float:
    """`value` as a float when it is finite and in [low, high] (or (low, high] with `open_low`), else UnitError."""
    number = as_number(value)
    if number is None:
        raise UnitError(f"{where}: expected {name} to be one number, got {shown(value)}.")
    below = number <= low if open_low else number < low
    if not math.isfinite(number) or below or number > high:
        left = "(" if open_low else "["
        raise UnitError(f"{where}: expected {name} in {left}{low:g}, {high:g}], got {number!r}.")
    return number


def check_count(value: float, name: str, where: str, *, low: int = 1) -> int:
    """`value` as an int when it is a whole number >= low, else UnitError."""
    number = check_number(value, name, where, low=low)
    if number != int(number):
        raise UnitError(f"{where}: expected {name} to be a whole number, got {value!r}.")
    return int(number)


def bin_width_of(axis: TimeAxis | None, bin_width_s: float | None, where: str) -> float:
    """Bin width in seconds from a TimeAxis or a number; exactly one of them. UnitError otherwise.

    A width of a second or more is refused: it is most likely given in nanoseconds, picoseconds or bins.
    """
    if (axis is None) == (bin_width_s is None):
        raise UnitError(f"{where}: expected either axis= (a TimeAxis) or bin_width_s=, got both or neither.")
    if axis is not None:
        return check_time_axis(axis, where).bin_width_s
    return check_seconds(bin_width_s if bin_width_s is not None else 0.0, "bin_width_s", where, open_low=True)


def check_time_axis(axis: object, where: str) -> TimeAxis:
    """`axis` when it is a TimeAxis, else UnitError."""
    if not isinstance(axis, TimeAxis):
        raise UnitError(
            f"{where}: expected axis to be a TimeAxis, got {type(axis).__name__}. Take the renderer's, or "
            "TimeAxis.from_seconds(start, bin width, bins)."
        )
    return axis


def check_generator(generator: object, where: str) -> None:
    """UnitError for a generator that is none, a seed for instance."""
    if generator is not None and not isinstance(generator, torch.Generator):
        raise UnitError(
            f"{where}: expected generator to be a torch.Generator, got {generator!r}. "
            "Use torch.Generator().manual_seed(...)."
        )


def check_seconds(value: float, name: str, where: str, *, open_low: bool = False) -> float:
    """A duration in seconds, finite, not negative, below 1 s; UnitError otherwise (picoseconds given as seconds)."""
    number = check_number(value, name, where, open_low=open_low)
    if number >= 1.0:
        raise UnitError(f"{where}: expected {name} in seconds, got {number!r} s. Picoseconds or bins? 50 ps is 50e-12.")
    return number
