"""Numbers as people give them, checked: finite, positive, shares, counts, arrays, transforms.

What is none is a typed error that names it. A number is what Python, numpy or torch have for one; truth values,
texts, dates and entries that a mask hides are none, although Python or numpy take them.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from torchtransient.errors import ArgumentError, SceneError, ShapeError, TorchTransientError, UnitError

if TYPE_CHECKING:
    import torch

# Several numbers, as people have them. A text: nothing here imports torch.
Numbers: TypeAlias = "Sequence[float] | NDArray[Any] | torch.Tensor"

# Units by the ends of names, with what is most often mistaken.
_UNITS = {
    "hz": "hertz (20 MHz are 20e6)",
    "s": "seconds (50 ps are 50e-12)",
    "opl": "metres of optical path",
    "m": "metres",
    "m2": "square metres (10 um by 10 um are 100e-12)",
    "nm": "nanometres",
    "j": "joules",
    "sr": "steradians",
    "deg": "degrees",
    "rad": "radians",
    "e": "electrons",
}
# Files and tensors count in 64 bits.
MOST = 2**63 - 1
# So many objects are made of one call.
MOST_MADE = 2**24
# Certainly numbers.
_PLAIN = {int, float}
# So many numbers of an array are written in messages.
_WRITTEN = 16


def finite(name: str, value: Any) -> float:
    """``value`` as a float. Raises UnitError unless it is one finite number."""
    number = _number(value)
    if not math.isfinite(number):
        raise UnitError(f"{name}: expected a finite number, got {shown(value)}.")
    return number


def positive(name: str, value: Any) -> float:
    """``value`` as a float. Raises UnitError unless it is finite and greater than zero."""
    number = _number(value)
    if not math.isfinite(number) or number <= 0:
        raise UnitError(f"{name}: expected a finite number greater than zero, got {shown(value)}.")
    return number


def share(name: str, value: Any) -> float:
    """``value`` as a float, of an albedo for instance. Raises UnitError unless it lies in [0, 1]."""
    number = _number(value)
    if not 0.0 <= number <= 1.0:
        raise UnitError(f"{name}: expected a number between 0 and 1, got {shown(value)}.")
    return number


def shares(name: str, values: Any) -> float | tuple[float, float, float]:
    """One share, or three of a linear sRGB colour: a sequence or an array of three. Raises UnitError."""
    if not isinstance(values, (list, tuple)) and getattr(values, "ndim", None) != 1:
        return share(name, values)
    plain = list(values)
    if len(plain) != 3:
        raise UnitError(f"{name}: expected one number between 0 and 1 or three, got {shown(values)}.")
    red, green, blue = (share(name, value) for value in plain)
    return red, green, blue


def count(
    name: str, value: Any, least: int | None = 1, error: type[TorchTransientError] = SceneError, most: int | None = MOST
) -> int:
    """``value`` as an int. Raises ``error`` unless it is a whole number from ``least`` to ``most``; None: no bound."""
    number = as_whole(value)
    if number is None:
        whole = _number(value)
        number = int(whole) if math.isfinite(whole) and whole == round(whole) else None
    if number is None or number < (-MOST if least is None else least):
        bound = "" if least is None else f" of at least {least}"
        raise error(f"{name}: expected a whole number{bound}, got {shown(value)}.")
    if most is not None and number > most:
        raise error(f"{name}: expected a whole number of at most {'2^63 - 1' if most == MOST else most}, got "
                    f"{shown(value)}.")  # fmt: skip
    return number


def index(name: str, value: Any, size: int, error: type[TorchTransientError] = ArgumentError) -> int:
    """``value`` as a place among ``size`` things, from 0 on; below zero it counts from the end. Raises ``error``."""
    number = as_whole(value)
    if number is None or not -size <= number < size:
        raise error(f"{name}: expected a whole number from {-size} to {size - 1}, got {shown(value)}.")
    return number % size


def as_whole(value: Any) -> int | None:
    """``value`` as an int, of any library that has whole numbers; None for what is none: 2.0, texts, truth values."""
    if _is_no_number(value) or getattr(value, "ndim", None):
        return None
    try:
        return operator.index(value)
    except TypeError:
        return None
    except RuntimeError:  # of torch, for unsigned numbers of 64 bits
        return _item(value)


def _item(value: Any) -> int | None:
    try:
        return int(value.item())
    except RuntimeError:  # a number that is nowhere, as on "meta" or inside of vmap
        return None


def flag(name: str, value: Any) -> bool:
    """``value`` as a truth value. Raises ArgumentError for others: a text that says False would count as true."""
    if not _is_truth(value) or getattr(value, "ndim", None):
        raise ArgumentError(f"{name}: expected True or False, got {shown(value)}.")
    return bool(value)


def real_array(values: Any) -> NDArray[np.float64] | None:
    """Real numbers of any library as a float64 array, detached; None for what is none: texts, None, truth values, rows
    of different lengths, entries behind a mask, and numbers that float64 cannot hold.
    """
    try:
        if _has_no_number(values):
            return None
        plain = np.asarray(values.detach().cpu() if hasattr(values, "detach") else values)
        if plain.dtype.kind in "iuf":
            return plain.astype(np.float64)
        # Lists of tensors or of whole numbers beyond 64 bits.
        return np.asarray(plain.tolist(), dtype=np.float64) if plain.dtype == object and _are_numbers(plain) else None
    except (TypeError, ValueError, OverflowError, RuntimeError):
        return None


def numbers(name: str, values: Any) -> NDArray[np.float64]:
    """:func:`real_array` of numbers of any shape. Raises UnitError for what is none."""
    array = real_array(values)
    if array is None:
        raise UnitError(f"{name}: expected real numbers, got {shown(values)}.")
    return array


def _has_no_number(values: Any) -> bool:
    """Whether numpy makes numbers of what is none, truth values beside numbers for instance."""
    if not isinstance(values, (list, tuple)):
        return _is_no_number(values)
    return any(type(one) not in _PLAIN and _has_no_number(one) for one in values)


def _are_numbers(objects: NDArray[Any]) -> bool:
    return all(hasattr(value, "__float__") and not _is_no_number(value) for value in objects.reshape(-1))


def transform(name: str, given: Any) -> NDArray[np.float64]:
    """A transform (4, 4), also one of Mitsuba's. Raises ShapeError unless it has as many finite numbers."""
    matrix = real_array(getattr(given, "matrix", given))
    if matrix is not None and matrix.ndim == 3:  # Dr.Jit's, of one entry
        matrix = matrix[..., 0]
    if matrix is None or matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ShapeError(f"{name}: expected a (4, 4) array of finite numbers, got {shown(given)}.")
    return matrix


def shown(value: Any) -> str:
    """A value in a message, not more of it than tells what it is: of arrays and tensors of many numbers the shape."""
    shape = getattr(value, "shape", None)
    if isinstance(shape, tuple) and not isinstance(value, type) and math.prod(shape) > _WRITTEN:
        return f"{with_article(type(value).__name__)} {tuple(shape)}"
    try:
        text = repr(value)
    except ValueError:  # Python writes no whole numbers of thousands of digits
        text = f"a {type(value).__name__} that is too long to be written"
    except RecursionError:
        text = f"a {type(value).__name__} that is nested too deeply to be written"
    text = " ".join(text.split()) if "\n" in text else text
    return text if len(text) <= 60 else f"{text[:57]}..."


def unit_of(name: str) -> str:
    """The unit that the end of a name says, behind a range in a message; nothing for a number without one."""
    unit = _UNITS.get(name.rpartition("_")[2]) if "_" in name else None
    return f" {unit}" if unit else ""


def with_article(word: str) -> str:
    """"a confocal", "an exhaustive"."""
    return f"{'an' if word[:1] in 'aeiou' else 'a'} {word}"


def as_number(value: Any) -> float | None:
    """``value`` as a float, infinities and NaN too; None for what is no real number."""
    if _is_no_number(value) or getattr(value, "ndim", None):
        return None
    try:
        return float(value)
    except OverflowError:
        return math.inf
    except (TypeError, ValueError, RuntimeError):
        return None


def _number(value: Any) -> float:
    """NaN for what is no real number."""
    number = as_number(value)
    return math.nan if number is None else number


def _is_no_number(value: Any) -> bool:
    """Whether Python or numpy makes a number of what is none."""
    # torch.compile does not follow `is_masked`.
    if isinstance(value, (str, bytes)) or (isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value)):
        return True
    dtype = getattr(value, "dtype", None)
    return _is_truth(value) or "complex" in str(dtype) or getattr(dtype, "kind", None) in {"m", "M", "S", "U", "V"}


def _is_truth(value: Any) -> bool:
    return isinstance(value, bool) or "bool" in str(getattr(value, "dtype", ""))
