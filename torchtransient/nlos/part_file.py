"""The part file of a simulation: finished tiles on disk, and which they are.

Two files: ``NAME.npy``, NumPy's own format with the sensor points first, and ``NAME`` itself, JSON that says whose the
numbers are and which tiles are finished. A tile is written first and named afterwards, and the JSON replaces the one
before in one step, so that a kill at any moment loses the tile in progress and nothing else.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from torchtransient.errors import StorageError

FORMAT = "torchtransient part 1"


class PartFile:
    """The finished tiles of the simulation that ``key`` stands for; ``points``: how many sensor points it has.

    Raises StorageError where ``path`` is something else, or belongs to another simulation.
    """

    def __init__(self, path: Path, key: str, points: int) -> None:
        self._path, self._key, self._points = path, key, points
        self._data = path.with_name(path.name + ".npy")
        self._done: list[int] = []
        self.cube: Any = None
        if path.exists():
            self._read()

    def _read(self) -> None:
        try:
            said = json.loads(self._path.read_text(encoding="utf-8"))
            fits = said["format"] == FORMAT
            done = [int(n) for n in said["done"]]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise StorageError(f"{self._path}: expected a part file of a simulation ({FORMAT}), got another.") from error
        if not fits or said.get("key") != self._key:
            raise StorageError(
                f"{self._path}: belongs to another simulation (another scene, scan, axis, spp or seed). Give another "
                "part=, or delete it to start anew."
            )
        if not done:
            return
        try:
            self.cube = np.lib.format.open_memmap(self._data, mode="r+")
        except (OSError, ValueError) as error:
            raise StorageError(f"{self._data}: expected the numbers of {self._path}, could not read them.") from error
        self._done = done

    def has(self, tile: int) -> bool:
        """Whether a tile is finished."""
        return tile in self._done

    def write(self, tile: int, first: int, values: np.ndarray) -> None:
        """Keep a tile whose sensor points start at ``first``."""
        if self.cube is None:
            shape = (self._points, *values.shape[1:])
            self.cube = np.lib.format.open_memmap(self._data, mode="w+", dtype=values.dtype, shape=shape)
        self.cube[first : first + len(values)] = values
        self.cube.flush()
        self._done.append(tile)
        said = {"format": FORMAT, "key": self._key, "done": self._done}
        fresh = self._path.with_name(self._path.name + ".new")
        fresh.write_text(json.dumps(said), encoding="utf-8")
        os.replace(fresh, self._path)

    def remove(self) -> None:
        """Delete both files."""
        self.cube = None
        for path in (self._path, self._data):
            path.unlink(missing_ok=True)
