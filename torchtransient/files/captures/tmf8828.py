"""Frames of a consumer time-of-flight chip before a wall (ams TMF8820, 8821, 8828) as JSON. Read only.

One frame, or a list of them, as the course on single-photon imaging at ICCP 2025 has them: ``hists`` (zones, T), counts
of 128 bins; ``reference_hist`` (T,), of the pulse inside the chip; ``pose`` (4, 4), from the chip, which looks along
its +z, to the world, metres; ``dist_to_plane``, metres along that axis; ``distances``, the chip's own answers, of which
``depths_1`` (zones,) are millimetres.

No file says the width of a bin, where zero is, or where zones look. Lines through the peaks of that course's 159 frames
(a plane at 0.1 to 0.4 m) have bins of 93.0 ps and zero 13.56 bins after the start, within 0.06 bins (rms), in the
middle zone, and paths that grow by 1.3 and 0.5 % more in its neighbours from row to row and from column to column:
tangents of 0.16 and 0.10. The course itself computes with 91 ps and 12.1, other frames of such a chip with 88 ps and
13, and with tangents of 0.30 and 0.24.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.capture import Capture
from torchtransient.files.captures.contents import Contents, JsonContents
from torchtransient.files.captures.reading import Reading, numbers_in, scan_of, tensor_of, time_axis, zone_grid

NAME = "tmf8828"
ENDINGS = (".json",)
BIN_WIDTH_S, ZERO_BIN = 93.0e-12, 13.56
# Tangents of half the field of view along the chip's x (from row to row of zones) and y (from column to column), which
# zones divide evenly: which way they run is a guess.
HALF_FIELD = (0.24, 0.15)
_MM = 1e-3
_KEPT = ("reference_hist", "pose", "dist_to_plane", "time_captured")


def recognises(contents: Contents) -> bool:
    """Return True for a file of frames of this layout.

    Args:
        contents: the file.
    """
    return set(contents.shapes) >= {"hists", "reference_hist"}


def read(contents: Contents, reading: Reading) -> Capture:
    """Return a confocal capture of one frame, with the legs from and to the chip.

    Points are where the zones meet the plane ``dist_to_plane`` in front of the chip, without that as far as each zone's
    own depth.

    Args:
        contents: the file.
        reading: arguments of the reader; ``frame=`` chooses one of several.

    Raises:
        StorageError: for wrong entries, and if neither distance is there.
    """
    hists = numbers_in(contents, "hists", reading, 3)
    frames, zones, bins = hists.shape
    chosen = reading.frame(frames)
    axis = time_axis(reading, None, None, bins, BIN_WIDTH_S, start_bins=-ZERO_BIN)
    pose = _pose(contents, chosen, reading)
    shape = zone_grid(zones)
    reading.assumed["half_field_tangents"] = list(HALF_FIELD)
    points, normals = _points(contents, chosen, shape, pose, reading)
    origin = pose[:3, 3]
    scan = scan_of("confocal", points, points, origin, origin, normals, normals, legs=True)
    kept = {name: entry for name in _KEPT if (entry := _entry(contents, name, chosen)) is not None}
    left = sorted(set(contents.shapes) - {"hists", "distances", *_KEPT})
    transient = tensor_of(np.ascontiguousarray(hists[chosen].T)).reshape(1, bins, *shape)
    return Capture(transient, axis, scan, metadata=reading.metadata(frame=chosen, **kept, not_read=left or None))


def _entry(contents: Contents, name: str, chosen: int) -> Any:
    """Return an entry of the frame as it stands in the file: numbers, or a text."""
    if isinstance(contents, JsonContents):
        return contents.entry(name, chosen)
    array = contents.array(name)
    return None if array is None else array[chosen].tolist()


def _points(
    contents: Contents, chosen: int, shape: tuple[int, ...], pose: NDArray[np.float64], reading: Reading
) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Return points where the zones meet the wall (*shape, 3), and the wall's normals there."""
    rows, columns = shape if len(shape) > 1 else (shape[0], 1)
    x, y = (half * (2 * (np.arange(n) + 0.5) / n - 1) for half, n in zip(HALF_FIELD, (rows, columns), strict=True))
    ways = np.stack(np.broadcast_arrays(x[:, None], y[None, :], 1.0), -1) @ pose[:3, :3].T
    if contents.array("dist_to_plane") is not None:
        distance = numbers_in(contents, "dist_to_plane", reading, 1)[chosen]
        depths = np.full((rows, columns), distance, np.float64)
        normals = np.broadcast_to(-pose[:3, 2], (*shape, 3))
    elif (measured := contents.array("distances/depths_1")) is not None:
        if measured.shape != (len(measured), rows * columns) or measured.dtype.kind not in "iuf":
            raise reading.error(f"expected depths_1 for each of {rows * columns} zones, got {measured.shape[1:]}.")
        depths, normals = _MM * measured[chosen].astype(np.float64).reshape(rows, columns), None
    else:
        raise reading.error("neither dist_to_plane nor depths_1 of distances says how far away the wall is.")
    if not (np.isfinite(depths).all() and (depths > 0).all()):
        raise reading.error(
            f"expected distances above zero to where each zone meets the wall, got {depths.min():.4g} m."
        )
    return (pose[:3, 3] + depths[..., None] * ways).reshape(*shape, 3), normals


def _pose(contents: Contents, chosen: int, reading: Reading) -> NDArray[np.float64]:
    if contents.array("pose") is None:
        reading.assumed["pose"] = np.eye(4).tolist()
        return np.eye(4)
    pose: NDArray[np.float64] = numbers_in(contents, "pose", reading, 3)[chosen].astype(np.float64)
    turn = pose[:3, :3]
    if pose.shape != (4, 4) or not np.allclose(turn @ turn.T, np.eye(3), atol=1e-3) or np.linalg.det(turn) < 0:
        raise reading.error("expected pose as a turn and a shift (4, 4).")
    return pose
