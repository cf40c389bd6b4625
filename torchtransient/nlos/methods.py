"""Methods for hidden volumes: the captures that each takes, the one that suits a capture, the memory it needs."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from torchtransient.array_files.free_memory import size_in_words
from torchtransient.capture import Capture, Scan
from torchtransient.checks import count, shown, with_article
from torchtransient.errors import ArgumentError, ShapeError, StorageError
from torchtransient.reconstruction import VoxelGrid
from torchtransient.reconstruction.capture_checks import checked_capture
from torchtransient.reconstruction.voxels import PlanarScan
from torchtransient.rendering.memory import available_bytes
from torchtransient.volume_methods import METHODS as METHODS
from torchtransient.volume_methods import Method as Method

# Sensor points whose neighbours are looked for where points are no grid.
_LOOKED_AT = 256


@dataclass(frozen=True)
class Choice:
    """The ``name`` of a method, and the ``reason`` for it."""

    name: str
    reason: str


def choose_method(capture: Capture) -> Choice:
    """Choose the method that suits a capture.

    Args:
        capture: capture of any kind.

    Returns:
        Name of the method, and the reason for it.
    """
    kind = capture.scan.kind
    this = with_article(kind)
    if kind == "pairs":
        return Choice("fbp", "pairs of spots and points, which only backprojection takes; the filter removes its haze")
    if not is_planar(capture.scan):
        reason = f"{this} scan whose points are not a regular grid of a flat wall, which only backprojection takes"
        return Choice("fbp", f"{reason}; the filter removes its haze")
    if kind == "confocal":
        others = "lct or phasor may show more of clean captures and of few photons (docs/nlos_reconstruction.md)"
        return Choice("fk", f"a confocal scan of a regular grid on a flat wall: it bears background; {others}")
    more = "midpoint-fk is quicker, and approximate"
    return Choice("phasor", f"{this} scan of a regular grid on a flat wall, from plane to plane; {more}")


def check_method(name: str, capture: Capture) -> Method:
    """Return the method of a name.

    Args:
        name: name of the method, one of ``METHODS``.
        capture: capture that the method is meant for.

    Raises:
        ArgumentError: for unknown names, and for scans that the method does not take.
    """
    if name not in METHODS:
        raise ArgumentError(f"reconstruct: expected method to be one of {', '.join(METHODS)}, got {shown(name)}.")
    method, kind = METHODS[name], capture.scan.kind
    if kind not in method.kinds:
        others = ", ".join(other for other, entry in METHODS.items() if kind in entry.kinds)
        raise ArgumentError(
            f"reconstruct: method '{name}' takes {' and '.join(method.kinds)} scans, not {kind}. Take one of {others}."
        )
    if method.planar and not is_planar(capture.scan):
        raise ArgumentError(
            f"reconstruct: method '{name}' takes regular grids on a flat wall, got {capture.scan!r}. Take bp or fbp."
        )
    return method


def is_planar(scan: Scan) -> bool:
    """Return True where the sensor points are a regular grid of a flat wall.

    Args:
        scan: scan of any kind.
    """
    with contextlib.suppress(ShapeError):
        PlanarScan.of_scan(scan, "choose_method")
        return True
    return False


def _pitch_of(scan: Scan) -> float:
    """Return the distance of sensor points from their neighbours, metres: the mean over a list, zero for one point."""
    if is_planar(scan):
        return max(PlanarScan.of_scan(scan, "pitch_of").pitch)
    points = scan.sensor_points.detach().cpu().reshape(-1, 3)
    some = points[:: max(1, len(points) // _LOOKED_AT)]
    distances = torch.cdist(some, points)
    # A point is no neighbour of itself, nor of another visit.
    apart = torch.where(distances > 0, distances, torch.inf).amin(1)
    apart = apart[torch.isfinite(apart)]
    return float(apart.mean()) if len(apart) else 0.0


def default_wavelength(capture: Capture) -> float:
    """Return the shortest wavelength that shows no ghosts and that the bins hold.

    Two pitches of the sensor points, four of confocal scans and of pairs, where the laser moves with the sensor, and
    four bins at least.

    Args:
        capture: capture with a transient.

    Returns:
        Metres of optical path.

    Raises:
        ShapeError: for a capture without a transient.
    """
    _, axis = checked_capture(capture, "default_wavelength")
    turns = 4.0 if capture.scan.kind in ("confocal", "pairs") else 2.0
    return max(turns * _pitch_of(capture.scan), 4 * axis.bin_width_opl)


# Planes whose points backprojection holds at once: filters run over all rows once for each such pass. Bytes of a
# point: float64 and the tables of an operator.
AT_ONCE, POINT = 16, 40


def check_volume_fits(name: str, capture: Capture, grid: VoxelGrid | None, options: Mapping[str, Any]) -> None:
    """Check that the memory left on the device of a capture holds the volume of a method.

    Args:
        name: name of the method.
        capture: capture with a transient.
        grid: voxels, for methods that take some, else None.
        options: options of the method.

    Raises:
        StorageError: where even the least memory of the method is not there.
    """
    light, _ = checked_capture(capture, "reconstruct")
    needed = least_bytes(name, capture, grid, options)
    available = available_bytes("cuda" if light.device.type == "cuda" else "llvm")
    if light.device.type == "meta" or available is None or needed <= available:
        return
    sizes = " x ".join(map(str, light.shape[-3:] if grid is None else grid.shape))
    way = "Crop the capture, add up bins, or take fewer points" if grid is None else "Take fewer voxels or depths"
    raise StorageError(
        f"reconstruct: method '{name}' would take {size_in_words(needed)} at least for {sizes} numbers, and "
        f"{size_in_words(available)} are available on this {light.device.type}. {way}."
    )


def least_bytes(name: str, capture: Capture, grid: VoxelGrid | None, options: Mapping[str, Any]) -> int:
    """Return a lower bound of the memory that a method takes beside its arguments.

    Args:
        name: name of the method.
        capture: capture with a transient.
        grid: voxels, for methods that take some, else None.
        options: options of the method.

    Returns:
        Bytes.
    """
    light, axis = checked_capture(capture, "reconstruct")
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
