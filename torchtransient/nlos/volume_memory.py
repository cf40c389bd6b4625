"""Whether a hidden volume fits into memory, asked before anything of it is made."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch

from torchtransient.capture import Capture
from torchtransient.checks import count
from torchtransient.errors import StorageError
from torchtransient.nlos.forecast import size as size_in_words
from torchtransient.reconstruction import VoxelGrid
from torchtransient.rendering.memory import available_bytes
from torchtransient.volume_methods import METHODS

# Planes whose points backprojection holds at once: filters run over all rows once for each such pass. Bytes of a
# point: float64 and the tables of an operator.
AT_ONCE, POINT = 16, 40


def check_volume_fits(name: str, capture: Capture, grid: VoxelGrid | None, options: Mapping[str, Any]) -> None:
    """Raises StorageError where a method would take more memory than is left on the device of a capture; what is told
    is the least that it takes.
    """
    light = capture.transient
    assert light is not None
    needed = least_bytes(name, capture, grid, options)
    available = available_bytes("cuda" if light.device.type == "cuda" else "llvm")
    if light.device.type == "meta" or available is None or needed <= available:
        return
    if grid is not None:
        size: tuple[int, ...] = grid.shape
        way = "Take fewer voxels or depths"
    else:
        size, way = tuple(light.shape[-3:]), "Crop the capture, add up bins, or take fewer points"
    sizes = " x ".join(map(str, size))
    raise StorageError(
        f"reconstruct: method '{name}' would take {size_in_words(needed)} at least for {sizes} numbers, and "
        f"{size_in_words(available)} are available on this {light.device.type}. {way}."
    )


def least_bytes(name: str, capture: Capture, grid: VoxelGrid | None, options: Mapping[str, Any]) -> int:
    """The memory that a method takes at its fullest, without what is already there: a lower bound of it."""
    light, axis = capture.transient, capture.axis
    assert light is not None and axis is not None
    number = 8 if light.dtype == torch.float64 else 4
    if grid is not None:
        times = getattr(options.get("camera"), "times", None)
        frames = 1 if times is None else len(times)
        items = math.prod(light.shape[: light.ndim - len(capture.scan.shape) - 1])
        volume = frames * items * math.prod(grid.shape)
        if name == "phasor":
            return 3 * number * volume
        planes = min(AT_ONCE, len(grid.depths))
        # The planes of the last pass beside those before them; then all planes, and the volume that they are put into.
        return max(2 * number * volume, number * volume + POINT * planes * math.prod(grid.size))
    rows, columns = capture.scan.sensor_shape
    rows, columns = (2 * rows, 2 * columns) if name == "midpoint-fk" else (rows, columns)
    plane, bins = rows * columns, axis.num_bins
    if "taps" in METHODS[name].options:
        taps = count("reconstruct: taps", options.get("taps", METHODS[name].options["taps"]))
        spectrum = (rows + 1) * (columns + 1) * bins
        # Tables are made in double precision and kept in single; then come a spectrum and the field.
        tables = (4 + 2 * number * taps) * spectrum
        return max(tables + 16 * taps * spectrum, tables + 2 * number * (2 * plane * (bins + 1) + plane * bins))
    v_bins = count("reconstruct: v_bins", options.get("v_bins", bins), 4)
    components = 3 if name == "directional-lct" else 1
    spectra = (1 + components) * 2 * number * (v_bins + 1) * plane
    return spectra + number * (v_bins + components * bins) * plane
