"""Checksums of what a file holds, entry by entry: whether the numbers that were read are those that were written.

They stand in the file as one text, JSON: ``{"entries": {name: digest}, "arrays": {name: [rows, digest]}}``, digests in
hexadecimal. A digest is the SHA-256 of what the value is (its dtype, little-endian, and its shape; of texts nothing but
the text) and of its bytes in order; arrays of two and more dimensions are taken ``rows`` of their last but one axis at
a time, so that large ones are hashed as they are written, a part after the other.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.errors import StorageError

CHECKSUMS = "checksums"


class Digest:
    """The checksum of an array that comes in parts."""

    def __init__(self, dtype: np.dtype[Any], shape: tuple[int, ...]) -> None:
        self._found = hashlib.sha256(f"{dtype.newbyteorder('<').str}{tuple(shape)}".encode())

    def add(self, part: NDArray[Any]) -> None:
        """The next part."""
        little = np.ascontiguousarray(part, part.dtype.newbyteorder("<"))
        self._found.update(little.reshape(-1).view(np.uint8).data)

    def text(self) -> str:
        """Of all the parts."""
        return self._found.hexdigest()


def parts_of(shape: tuple[int, ...], rows: int) -> Iterator[Any]:
    """Indices of ``rows`` rows of an image at a time: the film keeps H first, so they are read in order, and only they
    are copied.
    """
    if len(shape) < 2:
        yield ...
        return
    for row in range(0, shape[-2], rows):
        yield ..., slice(row, row + rows), slice(None)


def array_digest(array: NDArray[Any], rows: int) -> str:
    """Of an array, ``rows`` rows at a time."""
    found = Digest(array.dtype, array.shape)
    for part in parts_of(array.shape, rows):
        found.add(array[part])
    return found.text()


def entry_digest(value: Any) -> str:
    """Of a number or a text."""
    array = np.asarray(value)
    if array.dtype.kind in "UO":
        return hashlib.sha256(b"text" + str(array.reshape(-1)[0]).encode("utf-8", "surrogatepass")).hexdigest()
    return array_digest(array, max(1, array.size))


def checksums_text(entries: Mapping[str, Any], arrays: Mapping[str, tuple[int, str]]) -> str:
    """What stands in the file; ``arrays``: rows and digests by name."""
    digests = {name: entry_digest(value) for name, value in entries.items()}
    return json.dumps({"entries": digests, "arrays": {name: list(found) for name, found in arrays.items()}})


def check(values: Mapping[str, Any], text: Any, what: str, known: Callable[[str], bool]) -> None:
    """Compare arrays and entries that were read, those that are ``known``, with the checksums of their file. Raises
    StorageError where one differs, is missing or was added.
    """
    try:
        stored = json.loads(str(np.asarray(text).reshape(-1)[0]))
        entries, arrays = dict(stored["entries"]), {name: (int(n), str(d)) for name, (n, d) in stored["arrays"].items()}
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError, IndexError):
        raise StorageError(f"{what}: the checksums cannot be read: the file is damaged. Take a copy of it.") from None
    for name in sorted({name for name in (*entries, *arrays) if known(name)} ^ set(values)):
        lacking = "is missing" if name not in values else "was put there later: it has no checksum"
        raise StorageError(f"{what}: '{name[:40]}' {lacking}. The file is damaged, or another program has changed it.")
    for name, value in values.items():
        if name in arrays:
            rows, expected = arrays[name]
            found = array_digest(np.asarray(value), rows) if rows >= 1 else ""
        else:
            expected, found = entries[name], entry_digest(value)
        if found != expected:
            raise StorageError(
                f"{what}: '{name}' is not what was written (its SHA-256 differs): the file is damaged, or another "
                "program has changed it. Take a copy, or read what is left with h5py or numpy."
            )
