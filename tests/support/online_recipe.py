"""A recipe of cheap arrays for the online data set, which goes wrong where it is asked to."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from torchtransient.data import Sample
from torchtransient.errors import SceneError

SHAPE = (1, 16, 8, 8)


class UnpicklableError(Exception):
    def __init__(self, one, two):
        super().__init__("cannot be sent")


@dataclass(frozen=True)
class OnlineRecipe:
    """``fail``, ``bug``, ``die``, ``hang``, ``odd``: numbers of samples that fail as scenes do, raise something else,
    end their process by signal 9, never end, or have another shape; ``late``: those
    with light outside of the window. ``group``: samples by number modulo it are rendered together. ``pids``: a folder
    where each producer leaves its process number.
    """

    seconds: float = 0.0
    fail: tuple = ()
    bug: tuple = ()
    die: tuple = ()
    hang: tuple = ()
    odd: tuple = ()
    late: tuple = ()
    unpicklable: tuple = ()
    pids: str = ""
    group: int = 1
    broken: str = ""

    def maker(self):
        if self.broken:
            raise SceneError(self.broken)
        return FakeMaker(self)


def arrays_of(index, shape):
    """All numbers of a sample are its index: a torn one has two."""
    return {
        "transient": np.full(shape, index, np.float32),
        "depth": np.full(shape[-2:], index, np.float32),
        "shape": np.full(shape[-2:], index, np.int32),
    }


class FakeMaker:
    def __init__(self, recipe):
        self.recipe = recipe
        if recipe.pids:
            (Path(recipe.pids) / str(os.getpid())).touch()

    def order(self, indices):
        return sorted(indices, key=lambda index: (index % self.recipe.group, index))

    def sample(self, index):
        recipe = self.recipe
        time.sleep(recipe.seconds)
        if index in recipe.fail:
            raise SceneError(f"sample {index} has no light")
        if index in recipe.bug:
            raise ValueError(f"sample {index} met a mistake")
        if index in recipe.unpicklable:
            raise UnpicklableError(1, 2)
        if index in recipe.die:
            os.kill(os.getpid(), signal.SIGKILL)
        if index in recipe.hang:
            time.sleep(1000.0)
        shape = (2, *SHAPE[1:]) if index in recipe.odd else SHAPE
        values = {"wall.reflectance": np.float32([index, 0.5, 0.25]), "box.filename": f"{index % 3}.ply"}
        outside = (0.25, 0.5) if index in recipe.late else (0.0, 0.0)
        return Sample(index, index, arrays=arrays_of(index, shape), values=values, outside=outside)

    def close(self):
        pass
