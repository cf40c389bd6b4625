"""Entries of files as what they are said to be: texts, numbers, flags, names. What is something else is a ValueError,
which readers tell as damage; a text that says False is no flag.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np


def text_of(values: Mapping[str, Any], name: str) -> str:
    """A text. Raises ValueError."""
    array = np.asarray(values[name])
    if array.dtype.kind != "U" or array.size != 1:
        raise ValueError(f"expected {name} as a text, got {array.dtype} of {array.shape}")
    return str(array.reshape(-1)[0])


def number_of(values: Mapping[str, Any], name: str) -> float:
    """One finite number. Raises ValueError."""
    array = np.asarray(values[name])
    if array.dtype.kind not in "iuf" or array.size != 1 or not np.isfinite(array).all():
        raise ValueError(f"expected {name} as one finite number, got {array.dtype} {array.reshape(-1)[:4].tolist()}")
    return float(array.reshape(-1)[0])


def whole_of(values: Mapping[str, Any], name: str) -> int:
    """One whole number. Raises ValueError."""
    number = number_of(values, name)
    if number != int(number):
        raise ValueError(f"expected {name} as a whole number, got {number!r}")
    return int(number)


def flag_of(values: Mapping[str, Any], name: str) -> bool:
    """A truth value, or 0 or 1. Raises ValueError."""
    array = np.asarray(values[name])
    if array.dtype.kind not in "biuf" or array.size != 1 or array.reshape(-1)[0] not in (0, 1):
        raise ValueError(f"expected {name} as 0 or 1, got {array.dtype} {array.reshape(-1)[:4].tolist()}")
    return bool(array.reshape(-1)[0])


def names_of(values: Mapping[str, Any], name: str) -> tuple[str, ...]:
    """Names in a list of JSON. Raises ValueError."""
    found = json.loads(text_of(values, name))
    if not isinstance(found, list) or not all(isinstance(one, str) for one in found):
        raise ValueError(f"expected {name} as a list of names, got {type(found).__name__}")
    return tuple(found)


def notes_of(values: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Names and values in JSON. Raises ValueError."""
    found = json.loads(text_of(values, name))
    if not isinstance(found, dict):
        raise ValueError(f"expected {name} as names and values, got {type(found).__name__}")
    return found
