"""Frames of a consumer time-of-flight chip before a relay wall (ST VL53L8; Somasundaram et al. 2025). Read only.

``hists`` (zones, T): counts of each zone after its own light, which has been cut out, so that bin 0 begins when light
leaves the wall; bins of 250 ps. ``pt_cloud`` (zones, 3), metres: where each zone meets the wall, z = 0, hidden side
+z, as the chip itself has measured it. ``cam_z``, metres: distance of the chip from the wall, at x = y = 0. A frame is
one file (``.npz``).
"""

from __future__ import annotations

import numpy as np

from torchtransient.capture import Capture
from torchtransient.files.captures.contents import Contents
from torchtransient.files.captures.reading import (
    Reading,
    flat_scan,
    numbers_in,
    optional_number,
    tensor_of,
    time_axis,
    zone_grid,
)

NAME = "vl53l8"
ENDINGS = (".npz",)
BIN_WIDTH_S = 250e-12
_KNOWN = {"hists", "pt_cloud", "cam_z"}


def recognises(contents: Contents) -> bool:
    """Return True for a frame of this layout.

    Args:
        contents: the file.
    """
    return set(contents.shapes) >= {"hists", "pt_cloud"}


def read(contents: Contents, reading: Reading) -> Capture:
    """Return a confocal capture of the zones: a grid if they are 4 x 4 or another square, rows in the file's order,
    else a list.

    Args:
        contents: the file.
        reading: arguments of the reader.

    Raises:
        StorageError: for wrong entries.
    """
    data, points = numbers_in(contents, "hists", reading, 2), numbers_in(contents, "pt_cloud", reading, 2)
    if points.shape != (len(data), 3):
        raise reading.error(f"expected pt_cloud ({len(data)}, 3), got {points.shape}.")
    height = optional_number(contents, "cam_z", reading)
    origin = None if height is None else np.array([0.0, 0.0, height])
    zones = zone_grid(len(data))
    axis = time_axis(reading, None, None, data.shape[1], BIN_WIDTH_S)
    scan = flat_scan("confocal", points.astype(np.float64).reshape(*zones, 3), reading, origin=origin)
    left = sorted(set(contents.shapes) - _KNOWN)
    transient = tensor_of(data).T.reshape(1, data.shape[1], *zones)
    return Capture(transient, axis, scan, metadata=reading.metadata(not_read=left or None))
