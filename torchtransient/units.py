"""Optical path length and time. The only place of the speed of light.

Time is optical path length (`opl`) in metres everywhere in the library, unless a name ends in `_s` (seconds). The
optical path length of a flight is its geometric length times the index of refraction along it: divided by the speed of
light in vacuum it is the time of flight, in any medium.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, TypeVar

from torchtransient.checks import as_number, shown
from torchtransient.errors import UnitError

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from torch import Tensor

SPEED_OF_LIGHT = 299_792_458.0  # m/s in vacuum, exact by the definition of the metre (SI)
# Bounds that tell numbers in other units. Bins and pulses are 0.3 fs long and more, a quarter of a period of visible
# light: a shorter length is a time in seconds.
SHORTEST_OPL = 1e-7
# Pulses are far below the 1 ms that a picosecond is in nanoseconds, and light comes back from 1500 km away in 10 ms.
LONGEST_PULSE_S = 1e-3
LATEST_S = 1e-2

Quantity = TypeVar("Quantity", "float", "Tensor", "NDArray[Any]")


def opl_to_seconds(opl: Quantity) -> Quantity:
    """Convert optical path lengths to times of flight.

    Args:
        opl: metres, a number, tensor or array of any shape.

    Returns:
        Seconds, in the type, shape and dtype of ``opl``.

    Raises:
        UnitError: for half-precision tensors, since a metre is 3.3e-9 s, below the smallest float16, and for
            anything but numbers.
    """
    _refuse_half(opl, "opl_to_seconds")
    return opl / SPEED_OF_LIGHT


def seconds_to_opl(time_s: Quantity) -> Quantity:
    """Convert times of flight to optical path lengths.

    Args:
        time_s: seconds, a number, tensor or array of any shape.

    Returns:
        Metres, in the type, shape and dtype of ``time_s``.

    Raises:
        UnitError: as :func:`opl_to_seconds`.
    """
    _refuse_half(time_s, "seconds_to_opl")
    return time_s * SPEED_OF_LIGHT


def near_seconds(time_s: float, name: str, where: str, *, limit_s: float = LATEST_S) -> float:
    """Check that a number is a time in seconds, rather than in picoseconds, nanoseconds or metres.

    Args:
        time_s: the time, seconds.
        name: name of the argument, for messages.
        where: name of the function, for messages.
        limit_s: smallest absolute value that is refused, seconds.

    Returns:
        The time as a float, seconds.

    Raises:
        UnitError: from ``limit_s`` on, and unless the time is one number.
    """
    number, limit = as_number(time_s), as_number(limit_s)
    if limit is None or not limit > 0:
        raise UnitError(f"{where}: expected the limit of {name} as seconds above 0, got {shown(limit_s)}.")
    if number is None or math.isnan(number):
        raise UnitError(f"{where}: expected {name} to be one finite number in seconds, got {shown(time_s)}.")
    if abs(number) >= limit:
        raise UnitError(
            f"{where}: expected {name} in seconds, below {limit_s:g} s, got {shown(time_s)} s, which is "
            f"{seconds_to_opl(number):.4g} m of optical path. 50 ps are 50e-12 s, 4 ns are 4e-9 s. If it is "
            "meant, say it in metres of optical path."
        )
    return number


def _refuse_half(value: object, name: str) -> None:
    dtype = str(getattr(value, "dtype", ""))
    if not dtype and not hasattr(value, "__float__"):  # texts, None, and lists, which arrays are made of
        raise UnitError(f"{name}: expected a number, a tensor or an array, got {type(value).__name__}.")
    if dtype.endswith(("float16", "bfloat16")):
        raise UnitError(f"{name}: expected float32 or float64, got {dtype}, which cannot hold nanoseconds in seconds.")
