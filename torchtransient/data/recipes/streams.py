"""Random numbers of one purpose of one sample: sample i of a recipe can be made alone, on any machine, in any order.

Each is a counter-based generator (Philox 4x64) of its own, whose key is a hash of the recipe's seed, the sample's
number and the purpose: a distribution that is added to a recipe leaves what the others draw as it was.
"""

from __future__ import annotations

import hashlib
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

# Seeds of renders, as Mitsuba takes them.
_SEEDS = 2**32


class Draw(Protocol):
    """What distributions draw from."""

    def random(self, shape: tuple[int, ...] = ()) -> NDArray[np.float64]:
        """Numbers in [0, 1), independent of each other."""
        ...


class Stream:
    """The numbers of ``purpose`` (the key that varies, for instance) of sample ``index`` under ``seed``."""

    def __init__(self, seed: int, index: int, purpose: str) -> None:
        digest = hashlib.blake2b(f"{seed}/{index}/{purpose}".encode(), digest_size=16).digest()
        self._generator = np.random.Generator(np.random.Philox(key=np.frombuffer(digest, "<u8").astype(np.uint64)))

    def random(self, shape: tuple[int, ...] = ()) -> NDArray[np.float64]:
        """Numbers in [0, 1), independent of each other."""
        return np.asarray(self._generator.random(shape), dtype=np.float64)

    def seed(self) -> int:
        """A seed of a render, or of torch."""
        return int(self._generator.integers(_SEEDS))


class Fixed:
    """Instead of a stream: one number always."""

    def __init__(self, number: float) -> None:
        self._number = number

    def random(self, shape: tuple[int, ...] = ()) -> NDArray[np.float64]:
        """The number throughout."""
        return np.full(shape, self._number)


class Extreme:
    """Instead of a stream: numbers at the lower or the upper end, for what a distribution can reach. After some calls
    it is a stream: one that draws until something fits has to come to an end.
    """

    calls = 16

    def __init__(self, upper: bool) -> None:
        self._number, self._left = (np.nextafter(1.0, 0.0) if upper else 0.0), self.calls
        self._otherwise = Stream(0, int(upper), "ends")

    def random(self, shape: tuple[int, ...] = ()) -> NDArray[np.float64]:
        """The same number throughout, for the first calls."""
        self._left -= 1
        return np.full(shape, self._number) if self._left >= 0 else self._otherwise.random(shape)
