"""Which samples stand in which rows of which shards, and the shards that are open."""

from __future__ import annotations

import glob
import os
import warnings
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.checks import path_of, several, shown
from torchtransient.data.storage.manifest import named_shards, shards_of
from torchtransient.data.storage.shard_file import Shard
from torchtransient.errors import StorageError, TorchTransientWarning, level_of_user

WHAT = "data set"
_OPEN = 32


class ShardTable:
    """The samples of several shards in the order of files and rows, by number.

    ``shard`` and ``row`` int64 (N,), ``index`` int64 (N,): that of the sample in its recipe, ``repeat`` int64
    (N,): how many samples before it have the same one. ``about``: what all shards
    say about the render. Pickles without open files; a process that was forked opens its own.
    """

    def __init__(self, where: Any) -> None:
        self.paths = shard_paths(where)
        self._open: OrderedDict[int, Shard] = OrderedDict()
        self._process = os.getpid()
        shards, rows, index = [], [], []
        outside: list[Any] = []
        first: dict[str, Any] | None = None
        self.failed: dict[int, str] = {}
        self.arrays: dict[str, tuple[int, ...]] = {}
        self.time_axes: dict[str, int | None] = {}
        self.keys: tuple[str, ...] = ()
        self.about: dict[str, Any] = {}
        for number, path in enumerate(self.paths):
            with Shard(path) as shard:
                shards += [number] * len(shard.index)
                rows += list(shard.index.values())
                index += list(shard.index)
                outside += [shard.outside[row] for row in shard.index.values()]
                self.failed |= shard.failed
                if not shard.index:
                    continue
                kind = _kind(shard)
                if first is None:
                    first = kind
                    self.arrays = {name: shard.shape(name) for name in shard.names}
                    self.time_axes = {name: shard.time_axis(name) for name in shard.names}
                    self.keys, self.about = shard.keys, kind["about"]
                _check_alike(first, kind, self.paths[shards[0]], path)
        if not shards:
            raise StorageError(f"{WHAT}: expected samples, got none in {len(self.paths)} shards: all of them failed.")
        self.shard, self.row = np.array(shards, np.int64), np.array(rows, np.int64)
        self.index: NDArray[np.int64] = np.array(index, np.int64)
        self.outside: NDArray[np.float64] = np.array(outside, np.float64).reshape(-1, 2)
        self.repeat = _repeats(self.index)

    def __len__(self) -> int:
        return len(self.index)

    def open(self, number: int) -> Shard:
        """An open shard. Those that were not used for long are closed."""
        if self._process != os.getpid():
            # Those of the parent are not ours to close: HDF5 shares its state with it.
            self._open, self._process = OrderedDict(), os.getpid()
        if number in self._open:
            self._open.move_to_end(number)
            return self._open[number]
        shard = self._open[number] = Shard(self.paths[number])
        while len(self._open) > _OPEN:
            self._open.popitem(last=False)[1].close()
        return shard

    def close(self) -> None:
        """Close what is open."""
        while self._process == os.getpid() and self._open:
            self._open.popitem()[1].close()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_open": OrderedDict()}


def shard_paths(where: Any) -> list[Path]:
    """The shards that a folder, a pattern, a file, or a list of them means. Raises StorageError where there is none;
    warns where a folder's manifest names shards that are gone.
    """
    if isinstance(where, str | os.PathLike):
        text = os.fspath(where)
        path = path_of(text, WHAT)
        if path.is_dir():
            found = _of_folder(path)
        elif path.is_file():
            found = [path]
        else:
            found = sorted(Path(name) for name in glob.glob(str(text), recursive=True))
            if any(place.is_dir() for place in found):
                found = [shard for place in found for shard in (_of_folder(place) if place.is_dir() else [place])]
        if not found:
            raise StorageError(
                f"{WHAT}: expected a folder with shards, or a pattern of their names, got '{text}', where there is "
                "none."
            )
        return [path.absolute() for path in found]
    try:
        places: list[Any] = several(WHAT, where, "folders", error=StorageError)
    except StorageError:
        places = []
    paths = [path for one in places for path in shard_paths(one)]
    if len(set(paths)) != len(paths):
        raise StorageError(f"{WHAT}: expected every shard once, got some of them twice.")
    if not paths:
        raise StorageError(f"{WHAT}: expected a folder, a pattern, or a list of them, got {shown(where)}.")
    return paths


def _of_folder(folder: Path) -> list[Path]:
    """The shards of a folder, with a warning where its manifest names others."""
    found = shards_of(folder)
    gone = sorted(set(named_shards(folder)) - {path.name for path in found})
    if found and gone:
        warnings.warn(
            f"{WHAT}: '{folder}' lacks {len(gone)} of the {len(gone) + len(found)} shards of its manifest.json: "
            f"{shown(gone)}. Their samples are left out; generate makes them again.",
            TorchTransientWarning,
            level_of_user(),
        )
    return found


def _kind(shard: Shard) -> dict[str, Any]:
    """What must be alike in all shards of a data set."""
    about = shard.header.get("about")
    return {
        "arrays": {name: (shard.shape(name), shard.dtype(name)) for name in shard.names},
        "values": shard.keys,
        "about": about if isinstance(about, dict) else {},
    }


def _check_alike(first: dict[str, Any], other: dict[str, Any], here: Path, there: Path) -> None:
    pairs = [(name, first[name], other[name]) for name in ("arrays", "values")]
    pairs += [(name, first["about"].get(name), other["about"].get(name)) for name in ("axis", "channels", "measures")]
    for name, a, b in pairs:
        if a != b:
            raise StorageError(
                f"{WHAT}: expected the same {name} in all shards, got {shown(a)} in '{here}' and {shown(b)} in "
                f"'{there}'. Read them as two data sets."
            )


def _repeats(index: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each entry, how many before it are equal to it."""
    order = np.argsort(index, kind="stable")
    ranked = index[order]
    starts = np.flatnonzero(np.r_[True, ranked[1:] != ranked[:-1]])
    found = np.empty(len(index), np.int64)
    found[order] = np.arange(len(index)) - np.repeat(starts, np.diff(np.r_[starts, len(index)]))
    return found
