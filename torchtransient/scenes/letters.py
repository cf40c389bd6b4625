"""Outlines of block letters, without holes: corners (x, y) in [0, 1]^2 against the clock, strokes 0.2 wide."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchtransient.checks import shown
from torchtransient.errors import ArgumentError

_S = 0.2  # width of a stroke
_H = 0.5 * _S

OUTLINES: dict[str, tuple[tuple[float, float], ...]] = {
    "C": ((0, 0), (1, 0), (1, _S), (_S, _S), (_S, 1 - _S), (1, 1 - _S), (1, 1), (0, 1)),
    "E": ((0, 0), (1, 0), (1, _S), (_S, _S), (_S, 0.5 - _H), (0.8, 0.5 - _H), (0.8, 0.5 + _H), (_S, 0.5 + _H),
          (_S, 1 - _S), (1, 1 - _S), (1, 1), (0, 1)),
    "F": ((0, 0), (_S, 0), (_S, 0.5 - _H), (0.8, 0.5 - _H), (0.8, 0.5 + _H), (_S, 0.5 + _H), (_S, 1 - _S), (1, 1 - _S),
          (1, 1), (0, 1)),
    "H": ((0, 0), (_S, 0), (_S, 0.5 - _H), (1 - _S, 0.5 - _H), (1 - _S, 0), (1, 0), (1, 1), (1 - _S, 1),
          (1 - _S, 0.5 + _H), (_S, 0.5 + _H), (_S, 1), (0, 1)),
    "I": ((0.5 - _H, 0), (0.5 + _H, 0), (0.5 + _H, 1), (0.5 - _H, 1)),
    "K": ((0, 0), (_S, 0), (_S, 0.38), (0.34, 0.5), (0.75, 0), (1, 0), (0.48, 0.62), (0.95, 1), (0.65, 1), (_S, 0.64),
          (_S, 1), (0, 1)),
    "L": ((0, 0), (1, 0), (1, _S), (_S, _S), (_S, 1), (0, 1)),
    "N": ((0, 0), (_S, 0), (_S, 0.66), (1 - _S, 0), (1, 0), (1, 1), (1 - _S, 1), (1 - _S, 0.34), (_S, 1), (0, 1)),
    "S": ((0, 0), (1, 0), (1, 0.5 + _H), (_S, 0.5 + _H), (_S, 1 - _S), (1, 1 - _S), (1, 1), (0, 1), (0, 0.5 - _H),
          (1 - _S, 0.5 - _H), (1 - _S, _S), (0, _S)),
    "T": ((0.5 - _H, 0), (0.5 + _H, 0), (0.5 + _H, 1 - _S), (1, 1 - _S), (1, 1), (0, 1), (0, 1 - _S),
          (0.5 - _H, 1 - _S)),
    "U": ((0, 0), (1, 0), (1, 1), (1 - _S, 1), (1 - _S, _S), (_S, _S), (_S, 1), (0, 1)),
    "V": ((0.5 - _H, 0), (0.5 + _H, 0), (1, 1), (1 - _S, 1), (0.5, 0.25), (_S, 1), (0, 1)),
    "X": ((0, 0), (0.23, 0), (0.5, 0.36), (0.77, 0), (1, 0), (0.62, 0.5), (1, 1), (0.77, 1), (0.5, 0.64), (0.23, 1),
          (0, 1), (0.38, 0.5)),
    "Y": ((0.5 - _H, 0), (0.5 + _H, 0), (0.5 + _H, 0.45), (1, 1), (0.77, 1), (0.5, 0.65), (0.23, 1), (0, 1),
          (0.5 - _H, 0.45)),
    "Z": ((0, 0), (1, 0), (1, _S), (0.27, _S), (1, 1 - _S), (1, 1), (0, 1), (0, 1 - _S), (0.73, 1 - _S), (0, _S)),
}  # fmt: skip


def outline(letter: str, size: float = 1.0) -> NDArray[np.float64]:
    """Corners (N, 2) of a letter of height and width `size` around the origin, metres, against the clock.

    Raises ArgumentError for a letter that is not there (those with holes are not).
    """
    if not isinstance(letter, str) or letter not in OUTLINES:
        raise ArgumentError(f"letter: expected one of {', '.join(OUTLINES)}, got {shown(letter)}")
    return (np.array(OUTLINES[letter], dtype=np.float64) - 0.5) * size
