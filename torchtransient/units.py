"""Optical path length and time. The one place where the speed of light stands.

Time is optical path length (`opl`) in metres everywhere in the library, unless a name ends in `_s` (seconds). The
optical path length of a flight is its geometric length times the index of refraction along it, so that dividing by the
speed of light in vacuum gives the time of flight, in any medium.
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
# What a number in another unit looks like. Bins and pulses are 0.3 fs long and more, a quarter of a period of visible
# light: a shorter length is a time in seconds.
SHORTEST_OPL = 1e-7
# Pulses are far below the 1 ms that a picosecond is in nanoseconds, and light comes back from 1500 km away in 10 ms.
LONGEST_PULSE_S = 1e-3
LATEST_S = 1e-2

Quantity = TypeVar("Quantity", "float", "Tensor", "NDArray[Any]")


def opl_to_seconds(opl: Quantity) -> Quantity:
    """Time of flight in seconds of an optical path length in metres. Keeps the type, shape and dtype given.

    A half-precision tensor is refused with UnitError: a metre is 3.3e-9 s, below the smallest float16.
    """
    _refuse_half(opl, "opl_to_seconds")
    return opl / SPEED_OF_LIGHT


def seconds_to_opl(time_s: Quantity) -> Quantity:
    """Optical path length in metres of a time of flight in seconds. Keeps the type, shape and dtype given.

    A half-precision tensor is refused with UnitError, as in `opl_to_seconds`.
    """
    _refuse_half(time_s, "seconds_to_opl")
    return time_s * SPEED_OF_LIGHT


def near_seconds(time_s: float, name: str, where: str, *, limit_s: float = LATEST_S) -> float:
    """A time in seconds. UnitError from `limit_s` on, either side of zero: picoseconds, nanoseconds or metres, and for
    what is no number.
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
