"""Whether the parts of a hidden volume belong together."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchtransient.capture.metadata import metadata_text
from torchtransient.checks import shown
from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.reconstruction.voxels import VoxelGrid


def check_volume(volume: Any) -> None:
    """Raise ShapeError where ``values``, ``times`` and ``directions`` of a volume do not fit its ``grid`` and each
    other, hold nothing or no real numbers, or ``method`` is no name; UnitError for times that are not finite,
    StorageError for metadata that is not plain.
    """
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
