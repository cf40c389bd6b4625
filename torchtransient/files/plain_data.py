"""Plain data in files: dictionaries and scans as JSON, and entries that are checked for their kind."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchtransient.array_files.array_file import array_of, damage_said
from torchtransient.capture import Scan
from torchtransient.errors import StorageError

_WHAT = "capture file"
# Keys of JSON objects that stand for what JSON does not have.
_ARRAY, _TUPLE, _NUMBERS = "__array__", "__tuple__", "__numbers__"


def plain(value: Any, parts: list[NDArray[Any]] | None, where: str) -> Any:
    """Return data that JSON can hold.

    Args:
        value: numbers, texts, lists, tuples, dictionaries, arrays and tensors, nested.
        parts: list that arrays are appended to, which are then named ``where_0``, ``where_1``, ...; None writes them as
            their bytes in base64, little-endian.
        where: name of the value, in messages and of parts.

    Raises:
        StorageError: for anything else.
    """
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Mapping):
        return {str(name): plain(entry, parts, f"{where}.{name}") for name, entry in value.items()}
    if isinstance(value, tuple):
        return {_TUPLE: [plain(entry, parts, where) for entry in value]}
    if isinstance(value, list):
        return [plain(entry, parts, where) for entry in value]
    if isinstance(value, torch.Tensor):
        value = array_of(value, _WHAT)
    # Transforms of Mitsuba keep their numbers in `matrix`.
    array = np.asarray(getattr(value, "matrix", value))
    if array.dtype.kind not in "biufc":
        raise StorageError(
            f"capture file: {where} is a {type(value).__name__}, which no file can hold; expected numbers, texts, "
            "lists, dictionaries and arrays. Write the capture with a scan whose wall is None or of plain data."
        )
    if parts is None:
        little = array.astype(array.dtype.newbyteorder("<"), copy=False)
        text = base64.b64encode(little.tobytes()).decode("ascii")
        return {_NUMBERS: text, "dtype": little.dtype.str, "shape": list(array.shape)}
    parts.append(array)
    return {_ARRAY: f"{where.partition('.')[0]}_{len(parts) - 1}"}


def restored(value: Any, arrays: Mapping[str, Any]) -> Any:
    """Return the data from which :func:`plain` has made JSON.

    Args:
        value: plain data.
        arrays: parts by name.

    Raises:
        StorageError: for arrays of other dtypes than numbers.
    """
    if isinstance(value, dict):
        if set(value) == {_ARRAY}:
            return np.asarray(arrays[value[_ARRAY]])
        if set(value) == {_NUMBERS, "dtype", "shape"}:
            raw = base64.b64decode(value[_NUMBERS], validate=True)
            numbers = np.frombuffer(raw, _number_type(value["dtype"])).reshape(value["shape"])
            return numbers.astype(numbers.dtype.newbyteorder("="))  # to memory that may be written to
        if set(value) == {_TUPLE}:
            return tuple(restored(entry, arrays) for entry in value[_TUPLE])
        return {name: restored(entry, arrays) for name, entry in value.items()}
    return [restored(entry, arrays) for entry in value] if isinstance(value, list) else value


def _number_type(name: Any) -> np.dtype[Any]:
    dtype = np.dtype(str(name))
    if dtype.kind not in "biufc":
        raise StorageError(f"capture file: expected a type of numbers, got {name!r}.")
    return dtype


def scan_data(scan: Scan) -> dict[str, Any]:
    """Return a scan as plain data that JSON can hold, without gradients.

    Args:
        scan: scan with its wall.
    """
    found: dict[str, Any] = plain({f.name: getattr(scan, f.name) for f in fields(scan)}, None, "scan")
    return found


def scan_from_data(data: Mapping[str, Any]) -> Scan:
    """Return the scan of :func:`scan_data`.

    Args:
        data: plain data.

    Raises:
        StorageError: for other data.
    """
    with damage_said(Path("scan"), "scan", "the plain data of a scan"):
        found = restored(dict(data), {})
        unknown = set(found) - {f.name for f in fields(Scan)}
        if unknown:
            raise StorageError(f"scan: expected the data of a scan, got {sorted(unknown)} beside it.")
        entries: dict[str, Any] = {
            name: torch.from_numpy(value) if isinstance(value, np.ndarray) else value for name, value in found.items()
        }
        return Scan(**entries)


# ----------------------------------------------------------------------------------------------------- entries of files


def text_of(values: Mapping[str, Any], name: str) -> str:
    """Return an entry that is a text.

    Args:
        values: entries by name.
        name: name of the entry.

    Raises:
        ValueError: for anything else, which readers report as damage.
    """
    array = np.asarray(values[name])
    if array.dtype.kind != "U" or array.size != 1:
        raise ValueError(f"expected {name} as a text, got {array.dtype} of {array.shape}")
    return str(array.reshape(-1)[0])


def number_of(values: Mapping[str, Any], name: str) -> float:
    """Return an entry that is one finite number.

    Args:
        values: entries by name.
        name: name of the entry.

    Raises:
        ValueError: for anything else.
    """
    array = np.asarray(values[name])
    if array.dtype.kind not in "iuf" or array.size != 1 or not np.isfinite(array).all():
        raise ValueError(f"expected {name} as one finite number, got {array.dtype} {array.reshape(-1)[:4].tolist()}")
    return float(array.reshape(-1)[0])


def whole_of(values: Mapping[str, Any], name: str) -> int:
    """Return an entry that is one whole number.

    Args:
        values: entries by name.
        name: name of the entry.

    Raises:
        ValueError: for anything else.
    """
    number = number_of(values, name)
    if number != int(number):
        raise ValueError(f"expected {name} as a whole number, got {number!r}")
    return int(number)


def flag_of(values: Mapping[str, Any], name: str) -> bool:
    """Return an entry that is a truth value, or 0 or 1; the text "False" is none.

    Args:
        values: entries by name.
        name: name of the entry.

    Raises:
        ValueError: for anything else.
    """
    array = np.asarray(values[name])
    if array.dtype.kind not in "biuf" or array.size != 1 or array.reshape(-1)[0] not in (0, 1):
        raise ValueError(f"expected {name} as 0 or 1, got {array.dtype} {array.reshape(-1)[:4].tolist()}")
    return bool(array.reshape(-1)[0])


def names_of(values: Mapping[str, Any], name: str) -> tuple[str, ...]:
    """Return an entry that is a list of names in JSON.

    Args:
        values: entries by name.
        name: name of the entry.

    Raises:
        ValueError: for anything else.
    """
    found = json.loads(text_of(values, name))
    if not isinstance(found, list) or not all(isinstance(one, str) for one in found):
        raise ValueError(f"expected {name} as a list of names, got {type(found).__name__}")
    return tuple(found)


def notes_of(values: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return an entry that is an object in JSON.

    Args:
        values: entries by name.
        name: name of the entry.

    Raises:
        ValueError: for anything else.
    """
    found = json.loads(text_of(values, name))
    if not isinstance(found, dict):
        raise ValueError(f"expected {name} as names and values, got {type(found).__name__}")
    return found
