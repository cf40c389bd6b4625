"""Encodings of the numbers in shards: exact, rounded, or counts.

A Monte Carlo render is known to a few per cent, and float32 stores it to 6e-8: most of the bytes of a cube are digits
of its noise. ``rounded`` keeps 10 bits of the mantissa, an error of at most 2^-11 of a number.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.checks import is_one_of, shown
from torchtransient.errors import ArgumentError, StorageError

# Of a shard, and of each array in it.
STORES = ("exact", "rounded", "counts")
# Result of sensors; it alone is stored as counts.
COUNTED = "measurement"
# Arrays of films, where a header does not name them.
_FILMS = ("transient", "phasor", "gated", "rates", "beats")
MANTISSA_BITS = 10
_UNSIGNED = (np.uint8, np.uint16, np.uint32, np.uint64)


def measured_names(about: Any) -> tuple[str, ...]:
    """Return the arrays that were measured: by the film under its own name, and by sensors. Other arrays are labels,
    and the steady image.

    Args:
        about: entry ``about`` of a header.

    Returns:
        Names.
    """
    named = about.get("measures") if isinstance(about, Mapping) else None
    return (*((named,) if isinstance(named, str) else _FILMS), COUNTED)


def check_store(store: Any, what: str) -> str:
    """Check the name of a store.

    Args:
        store: "exact", "rounded" or "counts".
        what: caller for messages.

    Returns:
        The name.

    Raises:
        ArgumentError: for other names.
    """
    if not is_one_of(store, STORES):
        raise ArgumentError(f"{what}: expected store as one of {', '.join(STORES)}, got {shown(store)}.")
    return str(store)


def rounded_mantissa(array: NDArray[Any]) -> NDArray[Any]:
    """Round the mantissa to 10 bits, half to even, of real and imaginary part apart. Infinities and signs stay, NaN
    stays NaN; numbers that round above the largest become infinite. Numbers below the smallest normal one keep the
    digits at the same places.

    Args:
        array: floating-point array of any shape.

    Returns:
        Array of the same dtype; float16 as it is.
    """
    if array.dtype == np.float16:
        return array
    kinds = {"f4": (np.uint32, 23), "f8": (np.uint64, 52), "c8": (np.uint32, 23), "c16": (np.uint64, 52)}
    whole, mantissa = kinds[array.dtype.str[1:]]
    cut = mantissa - MANTISSA_BITS
    # A copy in memory order; complex numbers are pairs.
    found = np.array(array, dtype=array.dtype.newbyteorder("="), order="C")
    parts = found.reshape(-1).view(whole)
    nan = np.isnan(parts.view(f"f{parts.dtype.itemsize}"))
    kept = parts[nan] if nan.any() else None
    # Half to even: add just less than one half, and one unit more where the last bit that stays is odd.
    odd = parts >> whole(cut)
    odd &= whole(1)
    odd += whole((1 << (cut - 1)) - 1)
    parts += odd
    parts &= whole(~((1 << cut) - 1) & ((1 << (8 * parts.dtype.itemsize)) - 1))
    if kept is not None:
        parts[nan] = kept
    return found


def counts_of(array: NDArray[Any], what: str) -> NDArray[Any]:
    """Convert whole numbers to the smallest unsigned type.

    Args:
        array: whole numbers from 0 on, of any real dtype.
        what: caller for messages.

    Returns:
        Unsigned array.

    Raises:
        StorageError: for other numbers.
    """
    # Comparisons with NaN are false.
    wrong = array[~((array.real >= 0) & (array.real < 2.0**64) & (np.floor(array.real) == array))]
    if wrong.size:
        raise StorageError(
            f"{what}: expected counts, whole numbers from 0 on, got {wrong[0]}. Store other measurements with "
            "store='rounded' or 'exact'."
        )
    largest = int(array.real.max(initial=0))
    return array.real.astype(next(kind for kind in _UNSIGNED if largest <= np.iinfo(kind).max))


def encoding_of(name: str, dtype: np.dtype[Any], store: str, measured: Sequence[str]) -> str:
    """Return the encoding of an array. Only measured arrays may lose digits.

    Args:
        name: name of the array.
        dtype: dtype of the array.
        store: "exact", "rounded" or "counts", the store of the shard.
        measured: names of measured arrays.

    Returns:
        "exact", "rounded" or "counts".
    """
    if store == "counts" and name == COUNTED:
        return "counts"
    return "rounded" if store == "rounded" and name in measured and dtype.kind in "fc" else "exact"


def encoded(array: NDArray[Any], encoding: str, what: str) -> NDArray[Any]:
    """Encode an array.

    Args:
        array: array of one sample.
        encoding: encoding of the array, "exact", "rounded" or "counts".
        what: caller for messages.

    Returns:
        Stored array.

    Raises:
        StorageError: for numbers that are no counts.
    """
    if encoding == "counts":
        return counts_of(array, what)
    return rounded_mantissa(array) if encoding == "rounded" else array


def decoded(array: NDArray[Any], encoding: str) -> NDArray[Any]:
    """Decode an array: counts as float32, everything else as it is stored.

    Args:
        array: stored array.
        encoding: encoding of the array, "exact", "rounded" or "counts".

    Returns:
        Array.
    """
    return array.astype(np.float32) if encoding == "counts" else array
