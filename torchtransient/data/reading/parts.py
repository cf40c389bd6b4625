"""Parts of samples: windows of time in metres or bins, and rectangles of pixels."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from torchtransient.axes import TimeAxis
from torchtransient.checks import as_number, shown
from torchtransient.errors import StorageError, TorchTransientError

_WHAT = "data set"
# Borders that differ from a bin's by less, in bins, are that bin's.
_SAME_EDGE = 1e-6


def axis_of(about: Mapping[str, Any]) -> TimeAxis | None:
    """The time axis of a render by what is said about it; None for films without one. Raises StorageError."""
    given = about.get("axis")
    if not isinstance(given, Mapping) or "num_bins" not in given:
        return None
    try:
        return TimeAxis(given["start_opl"], given["bin_width_opl"], given["num_bins"])
    except (KeyError, TorchTransientError) as error:
        raise StorageError(f"{_WHAT}: the time axis of the shards is none: {error}") from None


def bins_of(window: Any, axis: TimeAxis | None) -> slice | None:
    """The bins of a window: ``(start_opl, end_opl)`` in metres, all bins that it touches, None for an end that is
    open; or a slice of bins. Raises StorageError for a window that is not all on the axis, and where there is none.
    """
    if window is None:
        return None
    if axis is None:
        raise StorageError(f"{_WHAT}: window= is for transients, and these samples have no time axis.")
    if isinstance(window, slice):
        start, stop, step = window.indices(axis.num_bins)
        if step != 1 or stop <= start:
            raise StorageError(f"{_WHAT}: expected window to be some of {axis.num_bins} bins, got {shown(window)}.")
        return slice(start, stop)
    ends = list(window) if isinstance(window, tuple | list) and len(window) == 2 else [object()]
    metres = [
        default if end is None else as_number(end)
        for end, default in zip(ends, (axis.start_opl, axis.end_opl), strict=False)
    ]
    if len(metres) != 2 or None in metres:
        raise StorageError(
            f"{_WHAT}: expected window as (start_opl, end_opl) in metres or a slice of bins, got {shown(window)}."
        )
    first, last = ((float(end) - axis.start_opl) / axis.bin_width_opl for end in metres if end is not None)
    if not (-_SAME_EDGE <= first < last <= axis.num_bins + _SAME_EDGE):
        raise StorageError(
            f"{_WHAT}: expected window to lie between {axis.start_opl:g} m and {axis.end_opl:g} m, got "
            f"{shown(window)}. None is an end that is open."
        )
    start = min(axis.num_bins - 1, max(0, math.floor(first + _SAME_EDGE)))
    return slice(start, min(axis.num_bins, max(start + 1, math.ceil(last - _SAME_EDGE))))


def cut_axis(axis: TimeAxis | None, bins: slice | None) -> TimeAxis | None:
    """The axis of some of its bins."""
    if axis is None or bins is None:
        return axis
    return TimeAxis(axis.start_opl + bins.start * axis.bin_width_opl, axis.bin_width_opl, bins.stop - bins.start)


def image_size(shapes: Mapping[str, tuple[int, ...]], measured: Sequence[str]) -> tuple[int, ...]:
    """Rows and columns of the images of samples, by the shapes of their arrays: of the steady image and labels, which
    are images in any case, else of what was ``measured``, in that order.
    """
    order = ["steady", *(name for name in shapes if name not in measured), *measured]
    return next((shapes[name][-2:] for name in order if len(shapes.get(name, ())) >= 2), ())


def pixels_of(pixels: Any, size: tuple[int, ...]) -> tuple[slice, slice] | None:
    """A rectangle ``(rows, columns)`` of slices with its bounds. Raises StorageError for others and for nothing."""
    if pixels is None:
        return None
    fits = isinstance(pixels, tuple | list) and len(pixels) == 2 and all(isinstance(one, slice) for one in pixels)
    if not fits or len(size) != 2:
        raise StorageError(f"{_WHAT}: expected pixels as slices (rows, columns) of an image, got {shown(pixels)}.")
    cuts = []
    for one, count in zip(pixels, size, strict=True):
        start, stop, step = one.indices(count)
        if step != 1 or stop <= start:
            raise StorageError(f"{_WHAT}: expected pixels to be some of {size} without steps, got {shown(pixels)}.")
        cuts.append(slice(start, stop))
    return cuts[0], cuts[1]
