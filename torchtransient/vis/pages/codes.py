"""Numbers in eight bits: what a page stores, and how far it is from what was given.

Code 0 is zero and 255 what is not finite. Light has logarithmic steps between, numbers of both signs half as many on
either side, counts up to 254 themselves, phases and ratios equal steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

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
# Bins that are encoded at a time.
_ENTRIES_AT_ONCE = 2**24


@dataclass(frozen=True)
class Table:
    """Values of the 256 codes.

    Attributes:
        name: what the codes are of.
        values: (256,) float32, NaN for code 255.
        error: largest difference between a number and the value of its code, relative to the number for light and
            numbers of both signs, else absolute.
        floor: smallest size of a number whose code is not zero.
        kind: "log", "signed", "whole", "phase" or "ratio".
        decades: powers of ten between the smallest value and the largest.
    """

    name: str
    values: NDArray[np.float32]
    error: float
    floor: float
    kind: str
    decades: float = 0.0

    def encode(self, x: Tensor) -> NDArray[np.uint8]:
        """Return the codes of real numbers of any shape, uint8."""
        out = torch.empty(x.shape, dtype=torch.uint8)
        rows = max(1, _ENTRIES_AT_ONCE // max(1, x[0].numel())) if x.ndim else 1
        for first in range(0, len(x), rows):
            out[first : first + rows] = self._codes(x[first : first + rows].float())
        return out.numpy()

    def _codes(self, x: Tensor) -> Tensor:
        finite = torch.isfinite(x)
        if self.kind == "whole":
            code = x.clone()
        elif self.kind == "phase":
            code = torch.remainder(torch.round(x * (255 / (2 * math.pi))), 255)
        elif self.kind == "ratio":
            code = torch.round((x.clamp(-1, 1) + 1) * 127)
        elif self.kind == "signed":
            size = x.abs()
            step = self._step(size, 127, _SIGNED_STEPS)
            code = torch.where(size < self.floor, 0.0, torch.where(x < 0, step + 127, step))
        else:
            code = torch.where(x < self.floor, 0.0, self._step(x, 254, _STEPS))
        return torch.where(finite, code, float(NOT_FINITE)).to(torch.uint8)

    def _step(self, size: Tensor, last: int, steps: int) -> Tensor:
        top = float(self.values[last])
        return (size / top).log10_().mul_(steps / self.decades).add_(last).round_().clamp_(1, last)


def light_table(name: str, top: float, lowest: float) -> Table:
    """Return the table of numbers from zero to ``top``, of which ``lowest`` is the smallest above zero."""
    top = top if top > 0 else 1.0
    decades = min(MOST_DECADES, max(0.5, math.log10(top / lowest) if lowest > 0 else 1.0))
    values = np.full(256, np.nan, np.float32)
    values[0] = 0.0
    values[1:255] = top * 10.0 ** (-decades * np.arange(_STEPS, -1, -1) / _STEPS)
    half = 10.0 ** (decades / _STEPS / 2)
    return Table(name, values, half - 1, top * 10.0**-decades / half, "log", decades)


def signed_table(name: str, top: float) -> Table:
    """Return the table of numbers between ``-top`` and ``top``."""
    top = top if top > 0 else 1.0
    values = np.full(256, np.nan, np.float32)
    values[0] = 0.0
    sizes = top * 10.0 ** (-_SIGNED_DECADES * np.arange(_SIGNED_STEPS, -1, -1) / _SIGNED_STEPS)
    values[1:128], values[128:255] = sizes, -sizes
    half = 10.0 ** (_SIGNED_DECADES / _SIGNED_STEPS / 2)
    return Table(name, values, half - 1, top * 10.0**-_SIGNED_DECADES / half, "signed", _SIGNED_DECADES)


def _linear(name: str, kind: str, values: NDArray[np.float64], error: float) -> Table:
    table = np.full(256, np.nan, np.float32)
    table[:255] = values
    return Table(name, table, error, 0.0, kind)


WHOLE = _linear("counts", "whole", np.arange(255.0), 0.0)
PHASE = _linear("phase", "phase", np.arange(255) * (2 * math.pi / 255), math.pi / 255)
RATIO = _linear("ratio", "ratio", np.arange(255) / 127 - 1.0, 0.5 / 127)


def table_of(name: str, cubes: list[Tensor]) -> Table:
    """Return the table that fits real numbers of several cubes: whole, light, or of both signs."""
    top, bottom, lowest, whole = 0.0, 0.0, math.inf, True
    for cube in cubes:
        for part in cube.reshape(-1).split(_ENTRIES_AT_ONCE):
            low, high = (float(v) for v in torch.aminmax(part))
            if not (math.isfinite(low) and math.isfinite(high)):
                part = torch.nan_to_num(part, nan=0.0, posinf=0.0, neginf=0.0)
                low, high = (float(v) for v in torch.aminmax(part))
            top, bottom = max(top, high), min(bottom, low)
            lowest = min(lowest, float(torch.where(part > 0, part, math.inf).min()))
            whole = whole and high < 255 and bool((part[: 2**16] == part[: 2**16].round()).all())
    if bottom < 0:
        return signed_table(name, max(top, -bottom))
    if whole and top > 0 and all(bool((cube == cube.round()).logical_or(~torch.isfinite(cube)).all()) for cube in cubes):
        return WHOLE
    return light_table(name, top, lowest if math.isfinite(lowest) else top)
