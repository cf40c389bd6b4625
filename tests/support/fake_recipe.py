"""A recipe that renders nothing and is quick, and what goes wrong at which of its samples."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from torchtransient.array_files import hdf5
from torchtransient.data import Sample
from torchtransient.errors import SceneError

TROUBLES = ("raising", "hanging", "crashing", "dying")


@dataclass(frozen=True)
class FakeRecipe:
    """``shape`` of the transient; ``seconds`` for a sample. ``raising``, ``hanging``, ``crashing``, ``dying``: samples
    at which it raises, hangs, has a segmentation fault, is killed; ``once``: a folder, in which what went wrong is
    noted and goes well from then on. ``late``: samples with light outside. ``unbuilt``: the maker cannot be made.
    ``slow_disk``: seconds that each write to a shard takes.
    """

    shape: tuple = (1, 8, 4, 4)
    seconds: float = 0.0
    seed: int = 0
    raising: tuple = ()
    hanging: tuple = ()
    crashing: tuple = ()
    dying: tuple = ()
    late: tuple = ()
    once: str | None = None
    unbuilt: str = ""
    slow_disk: float = 0.0
    versions: dict = field(default_factory=lambda: {"fake": "1"})

    def to_dict(self):
        """What decides about the bytes: not what passes."""
        passing = {"seconds", "once", "versions", "slow_disk"}
        found = asdict(self) | dict.fromkeys(TROUBLES if self.once else (), ())
        return json.loads(json.dumps({k: v for k, v in found.items() if k not in passing}))

    def key(self):
        return hashlib.sha256(json.dumps(self.to_dict(), sort_keys=True).encode()).hexdigest()

    def maker(self):
        if self.slow_disk:
            _slow_down(self.slow_disk)
        if self.unbuilt:
            raise SceneError(self.unbuilt)
        return FakeMaker(self)


class FakeMaker:
    def __init__(self, recipe):
        self.recipe = recipe
        self.closed = False

    def order(self, indices):
        """Even ones first: two structures."""
        return sorted(indices, key=lambda i: (i % 2, i))

    def about(self):
        return {"measures": "transient", "spp": 1, "plan": ["fake"], "versions": self.recipe.versions}

    def standard_error(self, index):
        return 0.25

    def close(self):
        self.closed = True

    def sample(self, index):
        recipe = self.recipe
        if self.closed:
            raise RuntimeError("the maker is closed")
        time.sleep(recipe.seconds)
        for kind in TROUBLES:
            if index in getattr(recipe, kind) and not self._was(kind, index):
                getattr(self, f"_{kind}")(index)
        drawn = np.random.Generator(np.random.Philox(key=[recipe.seed, index]))
        cube = drawn.random(recipe.shape, dtype=np.float32)
        return Sample(
            index, int(drawn.integers(2**32)), arrays={"transient": cube, "depth": cube.sum(axis=(0, 1))},
            values={"albedo": drawn.random(3, dtype=np.float32), "name": f"box{index % 3}"},
            outside=(0.0, 0.5) if index in recipe.late else (0.0, 0.0), structure=f"s{index % 2}",
        )  # fmt: skip

    def _was(self, kind, index):
        if self.recipe.once is None:
            return False
        note = Path(self.recipe.once) / f"{kind}{index}"
        if note.exists():
            return True
        note.touch()
        return False

    def _raising(self, index):
        raise SceneError(f"sample {index} cannot be made by <object at {hex(id(self))}>")

    def _hanging(self, index):
        time.sleep(1000)

    def _crashing(self, index):
        os.kill(os.getpid(), signal.SIGSEGV)

    def _dying(self, index):
        os.kill(os.getpid(), signal.SIGKILL)


def _slow_down(seconds):
    """Writing HDF5 takes time from now on, in this process."""
    class Slow(_FAST):
        def write(self, data):
            time.sleep(seconds)
            return super().write(data)

    hdf5._Sink = Slow


_FAST = hdf5._Sink
