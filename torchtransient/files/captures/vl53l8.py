"""Frames of a consumer time-of-flight chip that looks at a relay wall (ST VL53L8; Somasundaram et al. 2025). Read only.

``hists`` (zones, T): counts of what each zone saw after its own light, which has been cut out, so that bin 0 begins
when light leaves the wall; bins of 250 ps. ``pt_cloud`` (zones, 3), metres: where each zone meets the wall, z = 0,
hidden side +z, as the chip itself has measured it. ``cam_z``, metres: how far before the wall the chip stands, at
x = y = 0. A frame is one file (``.npz``).
"""

from __future__ import annotations

import numpy as np

from torchtransient.capture import Capture
from torchtransient.files.captures.contents import Contents
from torchtransient.files.captures.gaps import Gaps, flat_scan, tensor_of, time_axis, zone_grid

NAME = "vl53l8"
BIN_WIDTH_S = 250e-12
_KNOWN = {"hists", "pt_cloud", "cam_z"}


def recognises(contents: Contents) -> bool:
    """Return whether a file is a frame of this layout."""
    return set(contents.shapes) >= {"hists", "pt_cloud"}


def read(contents: Contents, gaps: Gaps) -> Capture:
    """A confocal capture of the zones: a grid where they are 4 x 4 or another square, rows as the file has them, else a
    list.
    """
    data, points = contents.array("hists"), contents.array("pt_cloud")
    if data is None or data.ndim != 2 or data.dtype.kind not in "iuf":
        raise gaps.error(f"expected hists (zones, T), got {None if data is None else data.shape}.")
    if points is None or points.shape != (len(data), 3) or points.dtype.kind not in "iuf":
        raise gaps.error(f"expected pt_cloud ({len(data)}, 3), got {None if points is None else points.shape}.")
    height = contents.array("cam_z")
    if height is not None and (height.size != 1 or height.dtype.kind not in "iuf"):
        raise gaps.error(f"expected one number as cam_z, got {height.dtype} of {height.shape}.")
    origin = None if height is None else np.array([0.0, 0.0, float(height.reshape(-1)[0])])
    zones = zone_grid(len(data))
    axis = time_axis(gaps, None, None, data.shape[1], BIN_WIDTH_S)
    scan = flat_scan("confocal", points.astype(np.float64).reshape(*zones, 3), gaps, origin=origin)
    left = sorted(set(contents.shapes) - _KNOWN)
    transient = tensor_of(data).T.reshape(1, data.shape[1], *zones)
    return Capture(transient, axis, scan, metadata=gaps.metadata(not_read=left or None))
