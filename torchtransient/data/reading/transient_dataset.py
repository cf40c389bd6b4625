"""Shards as a map-style data set of torch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import Dataset

from torchtransient.array_files.array_file import tensor_in
from torchtransient.axes import TimeAxis
from torchtransient.checks import count, several, shown
from torchtransient.data.reading.parts import axis_of, bins_of, cut_axis, image_size, pixels_of
from torchtransient.data.reading.sample_draws import (
    Epochs,
    checked_seed,
    checked_transform,
    outside_tensor,
    sample_generator,
    sample_number,
    takes_generator,
    transformed,
)
from torchtransient.data.reading.shard_table import WHAT, ShardTable
from torchtransient.data.storage.encodings import measured_names
from torchtransient.data.storage.shard_file import Shard
from torchtransient.errors import ArgumentError, StorageError, UnitError

_MEASURED = "measurement"
_VALUES, _INDEX, _OUTSIDE, _TRANSIENT = "values", "index", "outside", "transient"


class TransientDataset(Epochs, Dataset[dict[str, Any]]):
    """The samples of shards, by number, in the order of the files and their rows; those that failed are left out.

    ``where``: a folder, a pattern of names, a shard, or a list of these. A sample is a dictionary of its arrays by
    name, ``transient`` (C, T, H, W), ``steady`` (C, H, W) and labels, of ``values``, what was drawn for it, by key, of
    ``outside``, (2,), the shares of its light before and after the time window that it was rendered with, and of
    ``index``, its number in the recipe. ``torch.utils.data.DataLoader`` makes batches of them as they are.

    ``fields``: names of those that are read; all of them by default. ``window``: ``(start_opl, end_opl)`` in metres, or
    a slice of bins: only the slabs that hold them are read, of the transient, and of a measurement with as many bins.
    ``axis`` is the time axis of what is returned. ``pixels``: slices (rows, columns) of everything that is an image of
    the film's size. ``transform``: a sensor, or any function of the transient, without gradients; its result stands
    under ``measurement``, in place of one that was stored. A sensor answers under its policy, the mean with "expected";
    ``transform=sensor.sample`` draws in any case. ``seed``: each sample has a generator of its own for the transform
    (its argument ``generator``), so that it has the same noise whoever reads it, in every epoch until
    :meth:`set_epoch`; None draws from torch's. ``as_stored``: counts in the type that they are stored in, not as
    float32.

    Files are opened when they are first read, in every process anew: it can be pickled, and read by workers that were
    forked or spawned. Raises StorageError for what cannot be read, or does not belong together, UnitError for a
    seed or an epoch below zero, and IndexError beyond the samples.
    """

    def __init__(
        self, where: Any, *, fields: Sequence[str] | None = None, window: Any = None, pixels: Any = None,
        transform: Callable[..., Any] | None = None, as_stored: bool = False, seed: int | None = None,
    ) -> None:  # fmt: skip
        super().__init__()
        self._table = ShardTable(where)
        self.about: dict[str, Any] = self._table.about
        shapes = self._table.arrays
        whole = axis_of(self.about)
        self._bins = bins_of(window, whole)
        self.axis: TimeAxis | None = cut_axis(whole, self._bins)
        # What was measured is on the time axis of the film, if it has as many bins.
        self._timed = measured_names(self.about)
        self._size = image_size(shapes, self._timed)
        self._pixels = pixels_of(pixels, self._size)
        self.transform, self.seed = checked_transform(WHAT, transform), checked_seed(WHAT, seed)
        self.as_stored = bool(as_stored)
        self._fields = self._read_fields(fields, shapes)
        if seed is not None and not takes_generator(transform):
            raise StorageError(
                f"{WHAT}: seed= is for a transform that takes generator=, as sensors do, got {shown(transform)}."
            )

    def __len__(self) -> int:
        return len(self._table)

    def __getitem__(self, number: int) -> dict[str, Any]:
        return self.sample(number, self.epoch)

    @property
    def index(self) -> Tensor:
        """(N,) int64: the number of every sample in its recipe."""
        return torch.from_numpy(self._table.index.copy())

    @property
    def outside(self) -> Tensor:
        """(N, 2) float64: shares of every sample's light before and after the time window of the render."""
        return torch.from_numpy(self._table.outside.copy())

    @property
    def failed(self) -> dict[int, str]:
        """Samples that could not be made, with their reasons."""
        return dict(self._table.failed)

    @property
    def fields(self) -> tuple[str, ...]:
        """What a sample has, beside its index."""
        made = () if self.transform is None else (_MEASURED,)
        return tuple(dict.fromkeys((*self._fields, *made)))

    @property
    def repeats(self) -> Tensor:
        """(N,) int64: how many samples before it have the same ``index``, those of other folders."""
        return torch.from_numpy(self._table.repeat.copy())

    @property
    def shards(self) -> Tensor:
        """(N,) int64: the file of every sample, by its place among them."""
        return torch.from_numpy(self._table.shard.copy())

    def sample(self, number: int, epoch: int | None = None) -> dict[str, Any]:
        """A sample; ``epoch`` tells the noise of ``seed`` of one epoch from that of another; None is 0."""
        number = sample_number(WHAT, number, len(self._table))
        epoch = 0 if epoch is None else count(f"{WHAT}: epoch", epoch, 0, UnitError)
        place, row = int(self._table.shard[number]), int(self._table.row[number])
        shard = self._table.open(place)
        found: dict[str, Any] = {name: self._read(shard, name, row) for name in self._fields if name != _VALUES}
        index = int(self._table.index[number])
        if self.transform is not None:
            given = found[_TRANSIENT] if _TRANSIENT in found else self._read(shard, _TRANSIENT, row)
            # Samples of several folders may have one number in their recipes.
            repeat = int(self._table.repeat[number])
            generator = sample_generator(WHAT, self.seed, index, epoch, repeat)
            found[_MEASURED] = transformed(self.transform, given, generator)
        if _VALUES in self._fields:
            values = shard.values(row)
            found[_VALUES] = {k: v if isinstance(v, str) else tensor_in(v) for k, v in values.items()}
        found |= {_OUTSIDE: outside_tensor(shard.outside[row]), _INDEX: index}
        return found

    def close(self) -> None:
        """Close the files that this process has open. They are opened again when they are read."""
        self._table.close()

    # -------------------------------------------------------------------------------------------------------- reading

    def _read_fields(self, fields: Sequence[str] | None, shapes: dict[str, Any]) -> tuple[str, ...]:
        known = (*shapes, _VALUES)
        if fields is None:
            names = known
        else:
            listed = [fields] if isinstance(fields, str) else several(f"{WHAT}: fields", fields, "names", str)
            names = tuple(listed)
            made = (_INDEX,) if self.transform is None else (_INDEX, _MEASURED)
            unknown = [name for name in names if name not in (*known, *made)]
            if unknown:
                raise ArgumentError(f"{WHAT}: expected fields among {', '.join(known)}, got {shown(unknown[0])}.")
        if self.transform is not None and _TRANSIENT not in shapes:
            raise StorageError(f"{WHAT}: transform= is for transients, and the samples have {', '.join(shapes)}.")
        left_out = (_INDEX,) if self.transform is None else (_INDEX, _MEASURED)
        return tuple(name for name in names if name not in left_out)

    def _read(self, shard: Shard, name: str, row: int) -> Tensor:
        shape = self._table.arrays[name]
        bins = self._bins if name in self._timed and self._table.time_axes[name] is not None else None
        pixels = self._pixels if shape[-2:] == self._size else None
        array = shard.read(name, row, window=bins, pixels=pixels, as_stored=self.as_stored)
        return torch.from_numpy(array) if array.dtype.isnative else tensor_in(array)
