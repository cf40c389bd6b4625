"""Keyhole captures (Metzler et al. 2020, MATLAB 7.3): one point of the wall, a hidden thing that moves. Read only.

``data`` (positions, t) as HDF5 has it, counts in bins of 16 ps; ``xpos``, ``zpos`` (positions, 1): where the thing
stood, metres. Seen from the thing, the point moves: a confocal scan of a list of points. Other histograms of such a
measurement, ``direct_*`` and ``LongExpNoObject_*`` (t, 1), are captures of one point. No file says when light reaches
the wall: the direct light of ``direct_*`` does, and ``start_s=`` takes it.
"""

from __future__ import annotations

import numpy as np

from torchtransient.capture import Capture
from torchtransient.files.captures.contents import Contents
from torchtransient.files.captures.gaps import Gaps, flat_scan, tensor_of, time_axis

NAME = "keyhole"
BIN_WIDTH_S = 16e-12
_OTHERS = ("LongExpNoObject_before", "LongExpNoObject_after", "direct_before", "direct_after")


def recognises(contents: Contents) -> bool:
    """Whether a file is one of these."""
    names = set(contents.shapes)
    return names >= {"data", "xpos", "zpos"} or bool(names & set(_OTHERS))


def read(contents: Contents, gaps: Gaps) -> Capture:
    """A confocal capture of a list of points ``(-xpos, 0, zpos)``: the wall's point in the frame of the thing, which
    lies on the side of +z. ``metadata``: ``xpos`` and ``zpos`` as they stand in the file.
    """
    name = "data" if "data" in contents.shapes else next((name for name in _OTHERS if name in contents.shapes), "data")
    data = contents.array(name)
    if data is None or data.ndim != 2 or data.dtype.kind not in "iuf":
        raise gaps.error(f"expected {name} (positions, t), got {None if data is None else data.shape}.")
    if name != "data":
        data = data.T
    track = {}
    for part in ("xpos", "zpos") if name == "data" else ():
        array = contents.array(part)
        if array is None or array.size != len(data) or array.dtype.kind not in "iuf":
            raise gaps.error(f"expected {part} for each of the {len(data)} rows of data.")
        track[part] = array.reshape(-1).astype(np.float64)
    points = np.zeros((len(data), 3))
    if track:
        points[:, 0], points[:, 2] = -track["xpos"], track["zpos"]
    axis = time_axis(gaps, None, None, data.shape[1], BIN_WIDTH_S)
    left = sorted(set(contents.shapes) - {name, *track})
    metadata = gaps.metadata(**{part: array.tolist() for part, array in track.items()}, not_read=left or None)
    return Capture(tensor_of(data).transpose(0, 1)[None], axis, flat_scan("confocal", points, gaps), metadata=metadata)
