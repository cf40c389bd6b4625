"""How numbers are stored: as they are, with shortened mantissas, or as counts.

A Monte Carlo render is known to a few per cent, and float32 stores it to 6e-8: most of the bytes of a cube are digits
of its noise. ``rounded`` keeps 10 bits of the mantissa: an error of at most 2^-11 of a number.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.checks import is_one_of, shown
from torchtransient.errors import ArgumentError, StorageError

STORES = ("exact", "rounded", "counts")
# What sensors make of a transient; of it alone there are counts.
COUNTED = "measurement"
# What films measure, where a header does not say it.
_FILMS = ("transient", "phasor", "gated", "rates", "beats")
MANTISSA_BITS = 10
ENCODINGS = ("exact", "rounded", "counts")  # of one array
_UNSIGNED = (np.uint8, np.uint16, np.uint32, np.uint64)


def measured_names(about: Any) -> tuple[str, ...]:
    """Arrays that were measured, by what a header says about the render: what its film measures, under whatever name,
    and measurements of sensors. Others are labels, and the steady image.
    """
    told = about.get("measures") if isinstance(about, Mapping) else None
    return (*((told,) if isinstance(told, str) else _FILMS), COUNTED)


def check_store(store: Any, what: str) -> str:
    """`store`, or StorageError for one that is unknown."""
    if not is_one_of(store, STORES):
        raise ArgumentError(f"{what}: expected store as one of {', '.join(STORES)}, got {shown(store)}.")
    return str(store)


def rounded_mantissa(array: NDArray[Any], bits: int = MANTISSA_BITS) -> NDArray[Any]:
    """Floating point numbers with ``bits`` bits of mantissa, the last one rounded half to even, in the same dtype: real
    and imaginary part apart. Infinities and signs stay, NaN stays NaN; what rounds above the largest number becomes
    infinite.

    Numbers below the smallest normal one keep the digits that stand at the same places. Raises StorageError for dtypes
    other than float32, float64, complex64 and complex128; what has no more bits than that (float16) is returned as is.
    """
    if array.dtype == np.float16:
        return array
    kinds = {"f4": (np.uint32, 23), "f8": (np.uint64, 52), "c8": (np.uint32, 23), "c16": (np.uint64, 52)}
    kind = kinds.get(array.dtype.str[1:])
    if kind is None:
        raise StorageError(f"rounding: expected floating point numbers, got {array.dtype}.")
    whole, mantissa = kind
    cut = mantissa - bits
    # A copy in memory order; complex numbers are pairs.
    found = np.array(array, dtype=array.dtype.newbyteorder("="), order="C")
    parts = found.reshape(-1).view(whole)
    nan = np.isnan(parts.view(f"f{parts.dtype.itemsize}"))
    kept = parts[nan] if nan.any() else None
    # Half to even: what is added is just below one half, and one more where the last bit that stays is odd.
    odd = parts >> whole(cut)
    odd &= whole(1)
    odd += whole((1 << (cut - 1)) - 1)
    parts += odd
    parts &= whole(~((1 << cut) - 1) & ((1 << (8 * parts.dtype.itemsize)) - 1))
    if kept is not None:
        parts[nan] = kept
    return found


def counts_of(array: NDArray[Any], what: str) -> NDArray[Any]:
    """Whole numbers from 0 on in the smallest unsigned type that holds the largest. Raises StorageError for others."""
    if array.dtype.kind == "c":
        raise StorageError(f"{what}: expected counts, whole numbers from 0 on, got {array.dtype}. Use store='rounded'.")
    largest = array.max() if array.size else 0
    # Comparisons with NaN are false.
    if not (array.size == 0 or (array.min() >= 0 and largest < 2.0**64)):
        raise StorageError(
            f"{what}: expected counts, whole numbers from 0 on, got numbers from {array.min()} to {largest}. Store "
            "other measurements with store='rounded' or 'exact'."
        )
    dtype = next(kind for kind in _UNSIGNED if int(largest) <= np.iinfo(kind).max)
    found = array.astype(dtype)
    if array.dtype.kind == "f" and not np.array_equal(found, array):
        odd = array[found != array].reshape(-1)[0]
        raise StorageError(
            f"{what}: expected counts, whole numbers from 0 on, got {odd}. Store other measurements with "
            "store='rounded' or 'exact'."
        )
    return found


def encoding_of(name: str, dtype: np.dtype[Any], store: str, measured: Sequence[str]) -> str:
    """How the array of a name is stored: "exact", "rounded" or "counts". Only what was ``measured`` may lose digits:
    labels, and the steady image, which is small, never do.
    """
    if store == "counts" and name == COUNTED:
        return "counts"
    return "rounded" if store == "rounded" and name in measured and dtype.kind in "fc" else "exact"


def encoded(array: NDArray[Any], encoding: str, what: str) -> NDArray[Any]:
    """What is stored of an array."""
    if encoding == "counts":
        return counts_of(array, what)
    return rounded_mantissa(array) if encoding == "rounded" else array


def decoded(array: NDArray[Any], encoding: str) -> NDArray[Any]:
    """What an array is read as: counts as float32, everything else as it is stored."""
    return array.astype(np.float32) if encoding == "counts" else array
