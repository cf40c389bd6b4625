"""Helpers of the readers of layouts: values that a file leaves open, filled by arguments or by assumptions that the
capture's metadata name; checked numbers of a file; axes and scans made of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.capture import Scan
from torchtransient.checks import as_whole, finite, positive, real_array, shown
from torchtransient.errors import StorageError
from torchtransient.files.captures.contents import WHAT, Contents
from torchtransient.files.captures.own import POINTS
from torchtransient.units import opl_to_seconds, seconds_to_opl

_NEEDED = object()
_WHO = ("sensor", "laser")
# Of coordinates: some steps of single precision.
_ROUNDING = 1e-6
# Zones of a chip in three rows of six.
_WIDE = 18
_MOST, _MOST_BYTES = 2**63 - 1, 8
# Torch computes with few of NumPy's unsigned numbers.
_SIGNED = {np.dtype(np.uint16): np.int32, np.dtype(np.uint32): np.int64, np.dtype(np.uint64): np.int64}


class Reading:
    """One reading of a file: arguments of the caller, and what was assumed in their place.

    Args:
        given: values by the names of :func:`read_capture`'s arguments.
        layout: name of the layout.
        source: the file.

    Attributes:
        assumed: values that neither file nor caller gave; becomes ``metadata["assumed"]``.
    """

    def __init__(self, given: Mapping[str, Any], layout: str, source: Path) -> None:
        self._given = {name: value for name, value in given.items() if value is not None}
        self._layout, self.source = layout, source
        self.assumed: dict[str, Any] = {}
        self._used: set[str] = set()

    def fill(self, name: str, stored: Any, default: Any = _NEEDED) -> Any:
        """Return the file's value; else the given one; else the default, as an assumption.

        Args:
            name: argument of :func:`read_capture`.
            stored: value of the file, None without one.
            default: value that is assumed; without it the argument is needed.

        Raises:
            StorageError: if both file and argument, or neither, have it.
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

    def width(self, stored_opl: float | None, default_s: Any = _NEEDED) -> float:
        """Return the width of the bins, metres of optical path.

        Args:
            stored_opl: width in the file, metres of optical path, or None for ``bin_width_s``.
            default_s: width that is assumed, seconds.
        """
        found = self.fill("bin_width_s", stored_opl, default_s)
        return float(found) if stored_opl is not None else seconds_to_opl(positive("read_capture: bin_width_s", found))

    def start(self, stored_opl: float | None, default_s: float = 0.0) -> float:
        """Return the start of the first bin, metres of optical path.

        Args:
            stored_opl: start in the file, metres of optical path, or None for ``start_s``.
            default_s: start that is assumed, seconds.
        """
        found = self.fill("start_s", stored_opl, default_s)
        return float(found) if stored_opl is not None else seconds_to_opl(finite("read_capture: start_s", found))

    def origin(self, name: str, stored: NDArray[Any] | None, points: NDArray[Any], normals: Any, legs: bool) -> Any:
        """Return the place of a sensor or a laser, (3,).

        Args:
            name: "sensor_origin" or "laser_origin".
            stored: place in the file, any shape.
            points: points of the scan.
            normals: normals there, or None.
            legs: the distance counts, so that a missing place is an error; otherwise one before the middle of the
                points is assumed.
        """
        default = _NEEDED if legs else _before(points, normals)
        found = real_array(self.fill(name, None if stored is None else stored.reshape(-1), default))
        if found is None or found.shape != (3,):
            raise self.error(f"expected {name} (3,), got {shown(found)}.")
        return found

    def frame(self, frames: int) -> int:
        """Return the index of the frame that is read: ``frame``, which a file of one frame does not need.

        Args:
            frames: number of frames in the file.

        Raises:
            StorageError: for an index out of range, and without one.
        """
        given = self._given.get("frame", 0 if frames == 1 else None)
        self._used.add("frame")
        if given is None:
            raise self.error(f"it holds {frames} frames. Give frame= to read_capture, 0 to {frames - 1}.")
        number = as_whole(given)
        if number is None or not 0 <= number < frames:
            raise self.error(f"expected frame as a whole number from 0 to {frames - 1}, got {shown(given)}.")
        return number

    def extent(self, stored: tuple[float, float] | None) -> tuple[float, float]:
        """Return width along x and height along y of a scanned area, metres.

        Args:
            stored: width and height in the file, or None for ``wall_size``.

        Raises:
            StorageError: for other sizes, and without any.
        """
        given = self.fill("wall_size", stored)
        sides = real_array(given)
        if sides is None or sides.shape not in ((), (2,)) or not bool(np.isfinite(sides).all() and (sides > 0).all()):
            raise self.error(f"expected wall_size in metres, one number or (width, height), got {shown(given)}.")
        width, height = np.broadcast_to(sides, 2).tolist()
        return width, height

    def check_all_used(self) -> None:
        """Raise StorageError for an argument without use in this layout."""
        left = sorted(set(self._given) - self._used)
        if left:
            names = ", ".join(f"{name}=" for name in left)
            raise self.error(f"{names} has no meaning for this layout. Leave it out.")

    def metadata(self, **entries: Any) -> dict[str, Any]:
        """Return ``format``, ``assumed`` unless it is empty, and ``entries`` that are not None.

        Later assumptions may be missing: a reader makes its scan and its axis before.

        Args:
            entries: other contents of the file by name; ``not_read`` are names of entries that were left alone.
        """
        said = {"assumed": self.assumed} if self.assumed else {}
        return {"format": self._layout, **said, **{name: value for name, value in entries.items() if value is not None}}

    def error(self, message: str) -> StorageError:
        """Return an error that names file and layout.

        Args:
            message: description of the fault and of what to do about it.
        """
        return StorageError(f"{WHAT}: '{self.source}', layout {self._layout!r}: {message}")


def real_in(contents: Contents, name: str, reading: Reading) -> NDArray[Any] | None:
    """Return an array of real numbers, None if it is missing or empty.

    Args:
        contents: the file.
        name: name of the array.
        reading: arguments of the reader, for messages.

    Raises:
        StorageError: for other numbers.
    """
    array = contents.array(name)
    if array is not None and array.dtype.kind not in "iuf":
        raise reading.error(f"expected real numbers in {name}, got {array.dtype}.")
    return array


def numbers_in(contents: Contents, name: str, reading: Reading, dims: int | None = None) -> NDArray[Any]:
    """Return an array of real numbers.

    Args:
        contents: the file.
        name: name of the array.
        reading: arguments of the reader, for messages.
        dims: number of its dimensions, None for any.

    Raises:
        StorageError: for anything else, and for an array that is missing or empty.
    """
    array = real_in(contents, name, reading)
    if array is None or dims not in (None, array.ndim):
        got = "nothing" if array is None else f"{array.dtype} of {array.shape}"
        raise reading.error(f"expected {name} as real numbers{f' with {dims} dimensions' if dims else ''}, got {got}.")
    return array


def optional_number(contents: Contents, name: str, reading: Reading) -> float | None:
    """Return one real number, None if it is missing.

    Args:
        contents: the file.
        name: name of the number.
        reading: arguments of the reader, for messages.

    Raises:
        StorageError: for anything else.
    """
    array = real_in(contents, name, reading)
    if array is not None and array.size != 1:
        raise reading.error(f"expected one number as {name}, got {array.shape}.")
    return None if array is None else float(array.reshape(-1)[0])


def _before(points: NDArray[Any], normals: Any) -> NDArray[Any]:
    """Return a place a diagonal, or a metre, before the middle of points, on the side of their normals.

    Args:
        points: points (..., 3), metres.
        normals: normals (..., 3), None for +z.
    """
    flat = np.asarray(points, np.float64).reshape(-1, 3)
    towards = np.array([0.0, 0.0, 1.0])
    # Numbers of damaged files overflow; a scan refuses what comes out.
    with np.errstate(all="ignore"):
        if normals is not None:
            towards = np.asarray(normals, np.float64).reshape(-1, 3).mean(0)
        size = float(np.linalg.norm(flat.max(0) - flat.min(0))) or 1.0
        place: NDArray[Any] = flat.mean(0) + size * towards / max(float(np.linalg.norm(towards)), 1e-300)
    return place


def same_points(a: NDArray[Any], b: NDArray[Any]) -> bool:
    """Return True for points that are equal up to the rounding of single precision.

    Args:
        a: points (..., 3).
        b: points (..., 3).
    """
    with np.errstate(all="ignore"):  # damaged files
        return a.shape == b.shape and bool((np.abs(a - b) <= _ROUNDING * np.abs(a).max()).all())


def tensor_of(array: NDArray[Any]) -> Tensor:
    """Return an array of a file as a tensor, on its memory if torch can compute with its numbers.

    Args:
        array: array of any shape; unsigned numbers of 16 bits and more become signed ones.

    Raises:
        StorageError: for counts beyond those of int64.
    """
    if array.dtype.kind == "u" and array.dtype.itemsize == _MOST_BYTES and array.size and int(array.max()) > _MOST:
        raise StorageError(f"{WHAT}: expected counts below 2^63, got {int(array.max())}.")
    native = array.astype(array.dtype.newbyteorder("="), copy=False)
    return torch.from_numpy(native.astype(_SIGNED.get(native.dtype, native.dtype), copy=False))


def grid_points(size: tuple[int, int], extent: tuple[float, float]) -> NDArray[np.float64]:
    """Return centres (Y, X, 3) of the cells of an area around the origin in the plane z = 0.

    Args:
        size: numbers of rows and columns, (Y, X).
        extent: size (width, height) of the area, metres.
    """
    y, x = ((np.arange(n) + 0.5 - n / 2) * (side / n) for n, side in zip(size, reversed(extent), strict=True))
    return np.stack(np.broadcast_arrays(x[None, :], y[:, None], 0.0), -1)


def zone_grid(zones: int) -> tuple[int, ...]:
    """Return (rows, columns) of a chip's zones if they are a square or 3 x 6, else (zones,).

    Args:
        zones: number of zones.
    """
    side = math.isqrt(zones)
    return (side, side) if side * side == zones else (3, 6) if zones == _WIDE else (zones,)


def flat_scan(
    kind: str,
    points: NDArray[np.float64],
    reading: Reading,
    spot: Any = None,
    origin: NDArray[np.float64] | None = None,
) -> Scan:
    """Return a scan on the plane z = 0 whose hidden side is that of +z; lengths count from wall to wall.

    Args:
        kind: kind of the scan.
        points: grid or list (..., 3), metres.
        reading: arguments of the reader.
        spot: laser spot (3,) of a single scan.
        origin: place (3,) of laser and sensor in the file; None takes the arguments, or else assumes one.
    """
    normals = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    laser = points if spot is None else np.asarray(spot, np.float64)
    sensor_origin, laser_origin = (reading.origin(f"{who}_origin", origin, points, normals, False) for who in _WHO)
    laser_normals = np.broadcast_to([0.0, 0.0, 1.0], laser.shape)
    return scan_of(kind, points, laser, sensor_origin, laser_origin, normals, laser_normals, legs=False)


def scan_of(kind: str, *arrays: NDArray[Any] | None, legs: bool) -> Scan:
    """Return a scan of arrays.

    Args:
        kind: kind of the scan.
        arrays: points of sensor and laser (..., 3), metres, their origins (3,), their normals in the shapes of the
            points, or None.
        legs: whether lengths count the first and the last leg.
    """
    tensors: dict[str, Any] = {
        name: None if array is None else torch.from_numpy(np.array(array, np.float64))
        for name, array in zip(POINTS, arrays, strict=True)
    }
    return Scan(kind, **tensors, first_and_last_leg=legs)


def time_axis(
    reading: Reading,
    start_opl: float | None,
    bin_width_opl: float | None,
    bins: int,
    default_s: Any = _NEEDED,
    start_bins: float = 0.0,
) -> TimeAxis:
    """Return the axis of a file, whose start and width are asked for or assumed where it leaves them open.

    Args:
        reading: arguments of the reader.
        start_opl: start of the first bin, metres of optical path, or None.
        bin_width_opl: width of a bin, metres of optical path, or None.
        bins: number of bins.
        default_s: width that is assumed, seconds.
        start_bins: start that is assumed, in bins.
    """
    found = reading.width(bin_width_opl, default_s)
    return TimeAxis(reading.start(start_opl, opl_to_seconds(start_bins * found)), found, bins)


def frequency_axis(reading: Reading, stored: FrequencyAxis | None) -> FrequencyAxis:
    """Return the frequencies of a file, or the given ones.

    Args:
        reading: arguments of the reader.
        stored: frequencies of the file, or None.
    """
    found = reading.fill("frequencies", stored)
    if not isinstance(found, FrequencyAxis):
        raise reading.error(f"expected frequencies as a FrequencyAxis, got {shown(found)}.")
    return found
