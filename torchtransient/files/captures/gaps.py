"""What a file leaves open, and who fills it: whoever reads it, or a value that the capture's metadata tells of."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchtransient.array_files.array_file import array_of
from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.checks import as_whole, finite, positive, real_array, shown
from torchtransient.errors import StorageError
from torchtransient.files.captures.contents import WHAT
from torchtransient.units import opl_to_seconds, seconds_to_opl

Numbers = NDArray[Any]
_NEEDED = object()
_WHO = ("sensor", "laser")
# Of coordinates: some steps of single precision.
_ROUNDING = 1e-6
# Zones of a chip in three rows of six.
_WIDE = 18
_MOST, _MOST_BYTES = 2**63 - 1, 8
# Torch computes with few of NumPy's unsigned numbers.
_SIGNED = {np.dtype(np.uint16): np.int32, np.dtype(np.uint32): np.int64, np.dtype(np.uint64): np.int64}


class Gaps:
    """``given``: what whoever reads a file says about it, by the names of :func:`read_capture`'s arguments.

    ``assumed``: what nobody said, and what is taken instead; becomes ``metadata["assumed"]``.
    """

    def __init__(self, given: Mapping[str, Any], layout: str, source: Path) -> None:
        self._given = {name: value for name, value in given.items() if value is not None}
        self._layout, self.source = layout, source
        self.assumed: dict[str, Any] = {}
        self._used: set[str] = set()

    def fill(self, name: str, stored: Any, default: Any = _NEEDED) -> Any:
        """``stored``, what the file says; else what is given; else ``default``, as an assumption.

        Raises StorageError where the file and an argument both say it, and where nothing does.
        """
        given = self._given.get(name)
        self._used.add(name)
        if stored is not None:
            if given is not None:
                raise self.error(f"the file says {name} itself. Leave {name}= out.")
            return stored
        if given is not None:
            return given
        if default is _NEEDED:
            raise self.error(f"the file does not say {name}. Give {name}= to read_capture.")
        self.assumed[name] = default.tolist() if isinstance(default, np.ndarray) else default
        return default

    def width(self, stored: float | None, default_s: Any = _NEEDED) -> float:
        """Width of the bins in metres: ``stored`` in metres, or ``bin_width_s``."""
        found = self.fill("bin_width_s", stored, default_s)
        return float(found) if stored is not None else seconds_to_opl(positive("read_capture: bin_width_s", found))

    def start(self, stored: float | None, default_s: float = 0.0) -> float:
        """Start of the bins in metres: ``stored`` in metres, or ``start_s``, or its default."""
        found = self.fill("start_s", stored, default_s)
        return float(found) if stored is not None else seconds_to_opl(finite("read_capture: start_s", found))

    def origin(self, name: str, stored: NDArray[Any] | None, points: NDArray[Any], normals: Any, legs: bool) -> Any:
        """Where a sensor or a laser stands (3,). Where nobody says so and its distance counts, an error; else a place
        before the middle of the points.
        """
        default = _NEEDED if legs else before(points, normals)
        found = real_array(self.fill(name, None if stored is None else stored.reshape(-1), default))
        if found is None or found.shape != (3,):
            raise self.error(f"expected {name} (3,), got {shown(found)}.")
        return found

    def frame(self, frames: int) -> int:
        """Number of the frame that is read: ``frame``, which a file of one needs not be told."""
        given = self.fill("frame", None, 0) if frames == 1 else self._given.get("frame")
        self._used.add("frame")
        self.assumed.pop("frame", None)
        if given is None:
            raise self.error(f"it holds {frames} frames. Give frame= to read_capture, 0 to {frames - 1}.")
        number = as_whole(given)
        if number is None or not 0 <= number < frames:
            raise self.error(f"expected frame as a whole number from 0 to {frames - 1}, got {shown(given)}.")
        return number

    def extent(self, stored: tuple[float, float] | None) -> tuple[float, float]:
        """Width along x and height along y of a scanned area, metres."""
        given = self.fill("wall_size", stored)
        sides = real_array(given)
        if sides is None or sides.shape not in ((), (2,)) or not bool(np.isfinite(sides).all() and (sides > 0).all()):
            raise self.error(f"expected wall_size in metres, one number or (width, height), got {shown(given)}.")
        width, height = np.broadcast_to(sides, 2).tolist()
        return width, height

    def check_all_used(self) -> None:
        """Raise StorageError for an argument that a layout has no use for."""
        left = sorted(set(self._given) - self._used)
        if left:
            names = ", ".join(f"{name}=" for name in left)
            raise self.error(f"{names} has no meaning for this layout. Leave it out.")

    def metadata(self, **entries: Any) -> dict[str, Any]:
        """``format``, ``assumed`` where something was, and ``entries`` that are not None."""
        said = {"assumed": self.assumed} if self.assumed else {}
        return {"format": self._layout, **said, **{name: value for name, value in entries.items() if value is not None}}

    def error(self, message: str) -> StorageError:
        return StorageError(f"{WHAT}: '{self.source}', layout {self._layout!r}: {message}")


def before(points: NDArray[Any], normals: Any) -> NDArray[Any]:
    """A place a diagonal, or a metre, before the middle of points, on the side of their normals."""
    flat = np.asarray(points, np.float64).reshape(-1, 3)
    towards = np.array([0.0, 0.0, 1.0])
    # Numbers of damaged files overflow; a scan refuses what comes out.
    with np.errstate(all="ignore"):
        if normals is not None:
            towards = np.asarray(normals, np.float64).reshape(-1, 3).mean(0)
        size = float(np.linalg.norm(flat.max(0) - flat.min(0))) or 1.0
        place: NDArray[Any] = flat.mean(0) + size * towards / max(float(np.linalg.norm(towards)), 1e-300)
    return place


def assumed_in(capture: Capture, name: str, value: Any) -> bool:
    """Whether a capture's metadata says that nobody knew this of the file it was read from, and it still is what was
    assumed.
    """
    said = capture.metadata.get("assumed")
    if not isinstance(said, Mapping) or name not in said:
        return False
    then, now = real_array(said[name]), real_array(value)
    return np.array_equal(then, now) if then is not None and now is not None else bool(said[name] == value)


def same_points(a: NDArray[Any], b: NDArray[Any]) -> bool:
    """Whether points are the same but for the rounding of single precision."""
    with np.errstate(all="ignore"):  # damaged files
        return a.shape == b.shape and bool((np.abs(a - b) <= _ROUNDING * np.abs(a).max()).all())


def hidden_volume(capture: Capture, sizes: Mapping[str, int]) -> dict[str, NDArray[np.float64]]:
    """What the metadata of a capture that was read keep of the hidden volume: so many numbers by name, NaN where there
    is something else. Metadata are anyone's.
    """
    said = capture.metadata.get("hidden_volume")
    found = {name: real_array(said.get(name)) if isinstance(said, Mapping) else None for name in sizes}
    return {
        name: np.full(size, np.nan) if (array := found[name]) is None or array.size != size else array.reshape(-1)
        for name, size in sizes.items()
    }


def hidden_side(scan: Scan) -> NDArray[np.float64]:
    """The direction (3,) from the wall to its hidden side: the mean normal, or where the sensor stands."""
    towards = scan.sensor_origin - scan.sensor_points if scan.sensor_normals is None else scan.sensor_normals
    mean: NDArray[np.float64] = towards.detach().cpu().reshape(-1, 3).mean(0).numpy()
    return mean


def tensor_of(array: NDArray[Any]) -> Tensor:
    """An array that was read as a tensor, on its memory where torch can compute with its numbers. Raises StorageError
    for counts beyond those of int64.
    """
    if array.dtype.kind == "u" and array.dtype.itemsize == _MOST_BYTES and array.size and int(array.max()) > _MOST:
        raise StorageError(f"{WHAT}: expected counts below 2^63, got {int(array.max())}.")
    native = array.astype(array.dtype.newbyteorder("="), copy=False)
    return torch.from_numpy(native.astype(_SIGNED.get(native.dtype, native.dtype), copy=False))


def grid_points(size: tuple[int, int], extent: tuple[float, float]) -> NDArray[np.float64]:
    """Centres (Y, X, 3) of the cells of an area around the origin in the plane z = 0; ``size`` (Y, X), ``extent``
    (width, height) in metres.
    """
    y, x = ((np.arange(n) + 0.5 - n / 2) * (side / n) for n, side in zip(size, reversed(extent), strict=True))
    return np.stack(np.broadcast_arrays(x[None, :], y[:, None], 0.0), -1)


def zone_grid(zones: int) -> tuple[int, ...]:
    """(rows, columns) of a chip's zones where they are a square or 3 x 6, else (zones,)."""
    side = math.isqrt(zones)
    return (side, side) if side * side == zones else (3, 6) if zones == _WIDE else (zones,)


def flat_scan(
    kind: str, points: NDArray[np.float64], gaps: Gaps, spot: Any = None, origin: NDArray[np.float64] | None = None
) -> Scan:
    """A scan of a grid or list on the plane z = 0 whose hidden side is that of +z; lengths count from wall to wall.

    ``origin`` (3,): where laser and sensor stand, as a file says it.
    """
    normals = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    laser = points if spot is None else np.asarray(spot, np.float64)
    sensor_origin, laser_origin = (gaps.origin(f"{who}_origin", origin, points, normals, False) for who in _WHO)
    laser_normals = np.broadcast_to([0.0, 0.0, 1.0], laser.shape)
    return scan_of(kind, points, laser, sensor_origin, laser_origin, normals, laser_normals, False)


def scan_of(
    kind: str,
    sensor_points: Numbers,
    laser_points: Numbers,
    sensor_origin: Numbers,
    laser_origin: Numbers,
    sensor_normals: Numbers | None,
    laser_normals: Numbers | None,
    legs: bool,
) -> Scan:
    """A scan of arrays."""
    arrays = (sensor_points, laser_points, sensor_origin, laser_origin, sensor_normals, laser_normals)
    names = ("sensor_points", "laser_points", "sensor_origin", "laser_origin", "sensor_normals", "laser_normals")
    tensors: dict[str, Any] = {
        name: None if array is None else torch.from_numpy(np.array(array, np.float64))
        for name, array in zip(names, arrays, strict=True)
    }
    return Scan(kind, **tensors, first_and_last_leg=legs)


def only_transient(capture: Capture, layout: str, legs: bool | None = None) -> Tensor:
    """The transient (T, ...) of a capture of one channel. Raises StorageError for what a layout cannot hold: batches,
    several channels, Stokes components, phasors, truth values, lengths that are counted otherwise (``legs``).
    """
    if capture.transient is None or capture.phasor is not None or capture.polarized:
        raise cannot(layout, "one transient alone", "phasors or Stokes components")
    one_channel(capture, capture.transient, layout)
    if capture.transient.dtype == torch.bool:
        raise cannot(layout, "numbers", "truth values; write them as numbers, transient.to(torch.uint8)")
    if legs is not None and capture.scan.first_and_last_leg != legs:
        words = "with the first and the last leg", "from wall to wall"
        raise cannot(layout, f"lengths {words[0] if legs else words[1]}", f"lengths {words[1] if legs else words[0]}")
    tensor: Tensor = capture.transient[0]
    return tensor


def one_channel(capture: Capture, tensor: Tensor, layout: str, before_channel: int = 0) -> None:
    """Raise StorageError unless a tensor has one channel and no batch, and counts that can be read again."""
    if tensor.dtype == torch.uint64:
        tensor_of(array_of(tensor, WHAT))
    dims = before_channel + 2 + len(capture.scan.shape)
    if tensor.ndim != dims or tensor.shape[before_channel] != 1:
        raise cannot(
            layout, "one channel and no batch",
            f"{tuple(tensor.shape)}; write each item by itself, and one channel, or their sum",
        )  # fmt: skip


def cannot(layout: str, holds: str, got: str) -> StorageError:
    return StorageError(
        f"{WHAT}: the layout {layout!r} holds {holds}, got {got}. The library's own format holds all of a capture: "
        "format='torchtransient'."
    )


def time_axis(
    gaps: Gaps, start: float | None, width: float | None, bins: int, default_s: Any = _NEEDED, start_bins: float = 0.0
) -> TimeAxis:
    """The axis of a file that says its start and width in metres, or leaves them open; ``start_bins``: the start then,
    in bins.
    """
    found = gaps.width(width, default_s)
    return TimeAxis(gaps.start(start, opl_to_seconds(start_bins * found)), found, bins)


def frequency_axis(gaps: Gaps, stored: FrequencyAxis | None) -> FrequencyAxis:
    """The frequencies of a file, or those that are given."""
    found = gaps.fill("frequencies", stored)
    if not isinstance(found, FrequencyAxis):
        raise gaps.error(f"expected frequencies as a FrequencyAxis, got {shown(found)}.")
    return found
