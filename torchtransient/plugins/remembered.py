"""What was computed of a scene, kept by what it was computed of."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import TypeVar

import numpy as np

Found = TypeVar("Found")
# Of a scene that moves, nothing is asked for twice; of several scans of a still one, a few things are.
_MOST = 4


class Remembered:
    """The last few results of each kind: a key has to hold all that its result depends on."""

    # What is kept follows from its keys: recorded calls do not depend on it beside them.
    only_remembers = True

    def __init__(self) -> None:
        self._found: dict[str, dict[bytes, object]] = {}

    def of(self, kind: str, key: bytes, make: Callable[[], Found]) -> Found:
        """What ``make()`` returns, or returned for this key before. It is shared: not to be changed."""
        found = self._found.setdefault(kind, {})
        if key not in found:
            made = make()
            while len(found) >= _MOST:
                del found[next(iter(found))]
            found[key] = made
        return found[key]  # type: ignore[return-value]


def digest(*arrays: np.ndarray) -> bytes:
    """A number that differs for arrays of other values or types."""
    found = hashlib.blake2b(digest_size=16)
    for array in arrays:
        found.update(f"{array.dtype.str}{array.shape}".encode())
        found.update(np.ascontiguousarray(array).data)
    return found.digest()
