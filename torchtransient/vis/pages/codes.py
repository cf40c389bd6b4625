"""Numbers in eight bits, as a page stores them, with the error that this makes.

Code 0 is zero and 255 what is not finite. Light has logarithmic steps between, numbers of both signs half as many on
either side, counts up to 254 themselves, phases and ratios equal steps. Counts up to 65534 are kept in sixteen bits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

NOT_FINITE = 255
# Powers of ten below the largest value that have codes of their own.
MOST_DECADES = 6.0
_STEPS = 253
_SIGNED_STEPS = 126
_SIGNED_DECADES = 4.0
# Numbers that are encoded at a time.
_ENTRIES_AT_ONCE = 2**20
# Counts in sixteen bits: what is not finite has the last code.
_MOST_COUNTS = 2**16 - 2
# Sign, exponent and the first bits of the fraction of a float32; half of what numbers with these bits differ by.
_BITS = 18
_SAME_BITS = 2.0**-10


@dataclass(frozen=True)
class Table:
    """Values of the 256 codes, or 65536 of the kind "wide".

    Attributes:
        name: name of the quantity that the codes stand for.
        values: values of the codes, (256,) float32, NaN for the last code.
        error: largest difference between a number and the value of its code, relative to the number for light and
            numbers of both signs, else absolute.
        floor: smallest size of a number whose code is not zero.
        kind: "log", "signed", "whole", "wide", "phase" or "ratio".
        decades: powers of ten between the smallest value and the largest.
    """

    name: str
    values: NDArray[np.float32]
    error: float
    floor: float
    kind: str
    decades: float = 0.0

    def encode(self, x: Tensor) -> NDArray[Any]:
        """Return the codes of numbers in their shape: uint8, or uint16 of the kind "wide".

        Args:
            x: real numbers of any shape.
        """
        if self.kind == "wide":
            counts = torch.where(torch.isfinite(x), x, float(_MOST_COUNTS + 1)).to(torch.int32)
            return counts.numpy().astype("<u2")
        if self.kind == "phase":
            code = torch.remainder(torch.round(x * (255 / (2 * math.pi))), 255)
        elif self.kind == "ratio":
            code = torch.round((x.clamp(-1, 1) + 1) * 127)
        else:
            return self._looked_up(x)
        return torch.where(torch.isfinite(x), code, float(NOT_FINITE)).to(torch.uint8).numpy()

    def plain(self) -> list[float | None] | str:
        """Return the values as `view.js` reads them."""
        if self.kind == "wide":
            return "counts"
        return [float(value) if np.isfinite(value) else None for value in self.values]

    def _looked_up(self, x: Tensor) -> NDArray[np.uint8]:
        """Codes by the upper bits of each number: a logarithm of each is thirty times slower."""
        codes = self._codes_of_bits
        numbers = np.ascontiguousarray(x.float().numpy())
        out = np.empty(numbers.shape, np.uint8)
        bits, flat = numbers.reshape(-1).view(np.uint32), out.reshape(-1)
        for first in range(0, len(bits), _ENTRIES_AT_ONCE):
            part = slice(first, first + _ENTRIES_AT_ONCE)
            np.take(codes, bits[part] >> (32 - _BITS), out=flat[part], mode="clip")
        return out

    @cached_property
    def _codes_of_bits(self) -> NDArray[np.uint8]:
        every = (np.arange(2**_BITS, dtype=np.uint32) << (32 - _BITS)).view(np.float32)
        with np.errstate(all="ignore"):
            # Whole numbers begin an interval of equal bits, others are taken for its middle.
            return self._codes(every if self.kind == "whole" else every * np.float32(1 + _SAME_BITS))

    def _codes(self, x: NDArray[np.float32]) -> NDArray[np.uint8]:
        size = np.abs(x.astype(np.float64))
        if self.kind == "whole":
            code = size
        elif self.kind == "signed":
            step = self._step(size, 127, _SIGNED_STEPS)
            code = np.where(size < self.floor, 0.0, np.where(x < 0, step + 127, step))
        else:
            code = np.where((x < 0) | (size < self.floor), 0.0, self._step(size, 254, _STEPS))
        return np.where(np.isfinite(x), code, NOT_FINITE).astype(np.uint8)

    def _step(self, size: NDArray[np.float64], last: int, steps: int) -> NDArray[np.float64]:
        step: NDArray[np.float64] = np.log10(size / float(self.values[last])) * (steps / self.decades) + last
        return np.clip(np.round(step), 1, last)


def light_table(name: str, top: float, lowest: float) -> Table:
    """Return the table of numbers from zero up, in logarithmic steps.

    Args:
        name: name of the quantity.
        top: largest number.
        lowest: smallest number above zero.
    """
    top = top if top > 0 else 1.0
    decades = min(MOST_DECADES, max(0.5, math.log10(top / lowest) if lowest > 0 else 1.0))
    values = np.full(256, np.nan, np.float32)
    values[0] = 0.0
    values[1:255] = top * 10.0 ** (-decades * np.arange(_STEPS, -1, -1) / _STEPS)
    half = 10.0 ** (decades / _STEPS / 2)
    return Table(name, values, half * (1 + _SAME_BITS) - 1, top * 10.0**-decades / half, "log", decades)


def signed_table(name: str, top: float) -> Table:
    """Return the table of numbers of both signs, in logarithmic steps.

    Args:
        name: name of the quantity.
        top: largest size.
    """
    top = top if top > 0 else 1.0
    values = np.full(256, np.nan, np.float32)
    values[0] = 0.0
    sizes = top * 10.0 ** (-_SIGNED_DECADES * np.arange(_SIGNED_STEPS, -1, -1) / _SIGNED_STEPS)
    values[1:128], values[128:255] = sizes, -sizes
    half = 10.0 ** (_SIGNED_DECADES / _SIGNED_STEPS / 2)
    return Table(
        name, values, half * (1 + _SAME_BITS) - 1, top * 10.0**-_SIGNED_DECADES / half, "signed", _SIGNED_DECADES
    )


def _linear(name: str, kind: str, values: Any, error: float) -> Table:
    table = np.full(256, np.nan, np.float32)
    table[:255] = values
    return Table(name, table, error, 0.0, kind)


WHOLE = _linear("counts", "whole", np.arange(255.0), 0.0)
WIDE = Table("counts", np.append(np.arange(_MOST_COUNTS + 1, dtype=np.float32), np.float32("nan")), 0.0, 0.0, "wide")
PHASE = _linear("phase", "phase", np.arange(255) * (2 * math.pi / 255), math.pi / 255)
RATIO = _linear("ratio", "ratio", np.arange(255) / 127 - 1.0, 0.5 / 127)


def table_of(name: str, cubes: list[Tensor]) -> Table:
    """Return the table that fits real numbers of several cubes: whole numbers, light, or numbers of both signs.

    Args:
        name: name of the quantity.
        cubes: tensors of any shape.
    """
    top, bottom, lowest = 0.0, 0.0, math.inf
    for cube in cubes:
        for part in cube.float().reshape(-1).split(_ENTRIES_AT_ONCE):  # type: ignore[no-untyped-call]
            low, high = (float(v) for v in torch.aminmax(part))
            if not (math.isfinite(low) and math.isfinite(high)):
                part = torch.nan_to_num(part, nan=0.0, posinf=0.0, neginf=0.0)
                low, high = (float(v) for v in torch.aminmax(part))
            top, bottom = max(top, high), min(bottom, low)
            # Positive numbers have the order of their bits; zero becomes the largest one.
            first = int((part.numpy().view(np.uint32) - np.uint32(1)).min()) + 1
            smallest = float(np.uint32(first % 2**32).view(np.float32))
            lowest = min(lowest, smallest) if smallest > 0 else lowest
    if bottom < 0:
        return signed_table(name, max(top, -bottom))
    if 0 < top <= _MOST_COUNTS and all(_whole(cube) for cube in cubes):
        return WHOLE if top < NOT_FINITE else WIDE
    return light_table(name, top, lowest if math.isfinite(lowest) else top)


def _whole(cube: Tensor) -> bool:
    parts = cube.reshape(-1).split(_ENTRIES_AT_ONCE)  # type: ignore[no-untyped-call]
    return all(bool((part == part.round()).all()) for part in parts)
