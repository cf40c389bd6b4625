"""Keyhole captures (Metzler et al. 2020, MATLAB 7.3): one point of the wall, a hidden object that moves. Read only.

``data`` (positions, t) as HDF5 has it, counts in bins of 16 ps; ``xpos``, ``zpos`` (positions, 1): places of the
object, metres. Seen from the object, the point moves: a confocal scan of a list of points. Other histograms of such a
measurement, ``direct_*`` and ``LongExpNoObject_*`` (t, 1), are captures of one point. No file says when light reaches
the wall: the direct light of ``direct_*`` does, and ``start_s=`` takes it.
"""

from __future__ import annotations

import numpy as np

from torchtransient.capture import Capture
from torchtransient.files.captures.contents import Contents
from torchtransient.files.captures.reading import Reading, flat_scan, numbers_in, tensor_of, time_axis

NAME = "keyhole"
ENDINGS = (".mat",)
BIN_WIDTH_S = 16e-12
_OTHERS = ("LongExpNoObject_before", "LongExpNoObject_after", "direct_before", "direct_after")


def recognises(contents: Contents) -> bool:
    """Return True for a file of this layout.

    Args:
        contents: the file.
    """
    names = set(contents.shapes)
    return names >= {"data", "xpos", "zpos"} or bool(names & set(_OTHERS))


def read(contents: Contents, reading: Reading) -> Capture:
    """Return a confocal capture of points ``(-xpos, 0, zpos)``: the wall's point in the frame of the object, which lies
    on the side of +z.

    Args:
        contents: the file.
        reading: arguments of the reader.

    Returns:
        The capture; ``metadata`` hold ``xpos`` and ``zpos`` of the file.

    Raises:
        StorageError: for wrong entries.
    """
    name = "data" if "data" in contents.shapes else next((name for name in _OTHERS if name in contents.shapes), "data")
    data = numbers_in(contents, name, reading, 2)
    if name != "data":
        data = data.T
    track = {}
    for part in ("xpos", "zpos") if name == "data" else ():
        array = numbers_in(contents, part, reading)
        if array.size != len(data):
            raise reading.error(f"expected {part} for each of the {len(data)} rows of data.")
        track[part] = array.reshape(-1).astype(np.float64)
    points = np.zeros((len(data), 3))
    if track:
        points[:, 0], points[:, 2] = -track["xpos"], track["zpos"]
    axis = time_axis(reading, None, None, data.shape[1], BIN_WIDTH_S)
    scan = flat_scan("confocal", points, reading)
    left = sorted(set(contents.shapes) - {name, *track})
    metadata = reading.metadata(**{part: array.tolist() for part, array in track.items()}, not_read=left or None)
    return Capture(tensor_of(data).transpose(0, 1)[None], axis, scan, metadata=metadata)
