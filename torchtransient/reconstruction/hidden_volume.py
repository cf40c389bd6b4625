"""A hidden volume as a record of tensors: what a method found, where its voxels stand, and how it was made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchtransient.capture.capture import metadata_text, summed
from torchtransient.checks import shown
from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.reconstruction.voxels import VoxelGrid
from torchtransient.tensor_record import TensorRecord


@dataclass(frozen=True, eq=False, repr=False)
class HiddenVolume(TensorRecord):
    """What a method found behind a corner.

    ``values`` (..., C, Z, Y, X) real, on the voxels of ``grid``; with ``times`` (N,), finite metres of optical path, a
    film (..., C, N, Z, Y, X). ``directions`` (..., C, 3, Z, Y, X): vectors in world coordinates whose lengths are the
    values, of methods that find normals. ``method``: its name; ``metadata``: its settings and why it was taken, plain
    data; that of a batch is a list under ``batch``. Two volumes are equal when all but ``metadata`` is.

    ``to``, ``detach``, ``clone``, ``map``, ``stack`` and ``cat`` as in captures and results of renders: they concern
    values and directions; grid and times stay on the CPU, and are the same in a batch. Raises ShapeError where tensors
    and grid do not fit, UnitError for times that are not finite, StorageError for metadata that is not plain.
    """

    notes: ClassVar[tuple[str, ...]] = ("metadata",)

    values: Tensor
    grid: VoxelGrid
    method: str
    _: KW_ONLY
    metadata: Mapping[str, Any] = field(default_factory=dict)
    times: Tensor | None = None
    directions: Tensor | None = None

    def __post_init__(self) -> None:
        _check_volume(self)

    def tensors(self) -> dict[str, Tensor]:
        """Values and directions."""
        return {name: tensor for name, tensor in super().tensors().items() if name != "times"}

    def _settings(self) -> dict[str, Any]:
        # One by one: torch 2.6 makes no list inside of `torch.func.grad`.
        times = None if self.times is None else tuple(time.item() for time in self.times.unbind())
        return {**super()._settings(), "times": times}

    @classmethod
    def merged_notes(cls, records: Sequence[HiddenVolume]) -> dict[str, Any]:
        return {"metadata": {"batch": [dict(record.metadata) for record in records]}}

    def _shown(self) -> dict[str, str]:
        frames = {} if self.times is None else {"times": f"{len(self.times)} of them"}
        return {**{name: text for name, text in super()._shown().items() if name != "times"}, **frames}

    def picture(self) -> Tensor:
        """(Z, Y, X): the first item of a batch, summed over its channels; of a film the highest value of all times."""
        per_item = 4 if self.times is None else 5
        values = self.values.detach()
        while values.ndim > per_item:
            values = values[0]
        together = summed(values, 0)
        return together if self.times is None else together.amax(0)


def _check_volume(volume: HiddenVolume) -> None:
    """Raise ShapeError unless values, times and directions are real and fit the grid and each other."""
    if not isinstance(volume.grid, VoxelGrid):
        raise ArgumentError(f"HiddenVolume: expected grid as a VoxelGrid, got {shown(volume.grid)}.")
    frames = () if volume.times is None else _frames(volume.times)
    _check("values", volume.values, (*frames, *volume.grid.shape))
    if volume.directions is not None:
        _check("directions", volume.directions, (3, *volume.grid.shape))
        items = tuple(volume.values.shape[: -3 - len(frames)])
        if tuple(volume.directions.shape[:-4]) != items:
            sizes = ", ".join(map(str, (*items, 3, *volume.grid.shape)))
            raise ShapeError(
                f"HiddenVolume: expected directions ({sizes}), one for each of the values, got "
                f"{tuple(volume.directions.shape)}."
            )
    if not isinstance(volume.method, str) or "\0" in volume.method:
        raise ArgumentError(f"HiddenVolume: expected method as a name, got {shown(volume.method)}.")
    metadata_text(volume.metadata, "HiddenVolume")


def _frames(times: Any) -> tuple[int]:
    if not isinstance(times, Tensor) or times.ndim != 1 or times.is_complex():
        got = f"{tuple(times.shape)} {times.dtype}" if isinstance(times, Tensor) else shown(times)
        raise ShapeError(f"HiddenVolume: expected times as a tensor (N,) of real numbers, got {got}.")
    if not bool(torch.isfinite(times).all()):
        raise UnitError("HiddenVolume: expected finite times in metres of optical path, got some that are not.")
    return (len(times),)


def _check(name: str, tensor: Any, shape: tuple[int, ...]) -> None:
    fits = isinstance(tensor, Tensor) and tensor.ndim > len(shape) and tuple(tensor.shape[-len(shape) :]) == shape
    if not fits or tensor.is_complex() or tensor.dtype == torch.bool or tensor.numel() == 0:
        got = f"{tuple(tensor.shape)} {tensor.dtype}" if isinstance(tensor, Tensor) else shown(tensor)
        sizes = ", ".join(map(str, shape))
        raise ShapeError(f"HiddenVolume: expected {name} (..., C, {sizes}) of real numbers, got {got}.")
