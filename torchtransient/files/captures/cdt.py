"""Captures of confocal diffuse tomography (Lindell and Wetzstein 2020, MATLAB 7.3). Read only.

``meas`` (x, y, t) as HDF5 has it: counts of a confocal scan through a slab of foam, bins of 16 ps. ``out`` (t, 1): the
laser's own response, or light through a slab, at one point, bins of 8 ps. The files say neither width; the published
scans are 0.6 to 0.7 m wide. Other programs do not write this layout; ``rect_data`` holds the same.
"""

from __future__ import annotations

import numpy as np

from torchtransient.capture import Capture
from torchtransient.files.captures.contents import Contents
from torchtransient.files.captures.reading import Reading, flat_scan, grid_points, numbers_in, tensor_of, time_axis

NAME = "cdt"
ENDINGS = (".mat",)
BIN_WIDTH_S, SLAB_BIN_WIDTH_S = 16e-12, 8e-12


def recognises(contents: Contents) -> bool:
    """Return True for ``meas`` whose first two axes are a square, or ``out`` of one column.

    Args:
        contents: the file.
    """
    scan, slab = contents.shapes.get("meas"), contents.shapes.get("out")
    square = scan is not None and len(scan) == 3 and scan[0] == scan[1] != scan[2]
    return square or (slab is not None and len(slab) == 2 and slab[1] == 1)


def read(contents: Contents, reading: Reading) -> Capture:
    """Return a confocal capture on the plane z = 0 around the origin, hidden side +z; of ``out`` a capture of one
    point.

    Args:
        contents: the file.
        reading: arguments of the reader; ``wall_size=`` is needed.

    Raises:
        StorageError: for wrong entries, and without ``wall_size=``.
    """
    name = "meas" if "meas" in contents.shapes else "out"
    data = numbers_in(contents, name, reading, 3 if name == "meas" else 2)
    left = sorted(set(contents.shapes) - {name})
    if name == "out":
        axis = time_axis(reading, None, None, len(data), SLAB_BIN_WIDTH_S)
        scan = flat_scan("confocal", np.zeros((1, 3)), reading)
        return Capture(tensor_of(data).reshape(1, -1, 1), axis, scan, metadata=reading.metadata(not_read=left or None))
    size = data.shape[1], data.shape[0]
    scan = flat_scan("confocal", grid_points(size, reading.extent(None)), reading)
    axis = time_axis(reading, None, None, data.shape[2], BIN_WIDTH_S)
    tensor = tensor_of(data).permute(2, 1, 0)[None]
    return Capture(tensor, axis, scan, metadata=reading.metadata(not_read=left or None))
