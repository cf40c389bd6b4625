"""Reconstructed volumes on disk: HDF5 (`.h5`, `.hdf5`) or NumPy's `.npz`, chosen by the file's ending.

Both hold the same names: `values` (..., C, Z, Y, X), or (..., C, N, Z, Y, X) with `times` (N,) of a film camera;
`directions` (..., C, 3, Z, Y, X) of methods that find normals, in world coordinates. The grid is float64, in metres:
`depths` (Z,), `pitch` (2,) as (dy, dx), and the vectors (3,) `first`, `along_x`, `along_y`, `normal`; voxel (k, j, i)
stands at ``first + j dy along_y + i dx along_x + depths[k] normal``. `method` is a text, `metadata` one of JSON; texts
are attributes of the HDF5 file and zero-dimensional arrays of the `.npz`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torchtransient.array_files.array_file import (
    array_of,
    check_target,
    damage_said,
    read_arrays,
    tensor_in,
    write_arrays,
)
from torchtransient.capture.capture import metadata_text
from torchtransient.files.plain_data import notes_of, text_of
from torchtransient.reconstruction.voxels import HiddenVolume, VoxelGrid

FORMAT = "torchtransient volume 2"
# Those of the first version have no checksums.
FORMATS = ("torchtransient volume 1", FORMAT)
_WHAT = "volume file"
_VECTORS = ("first", "along_x", "along_y", "normal")


def write_volume(path: str | Path, volume: HiddenVolume) -> Path:
    """Write a volume; an existing file is replaced once the new one is complete.

    Args:
        path: place of the file, ending in .h5, .hdf5 or .npz.
        volume: gradients are not stored.

    Returns:
        The path.

    Raises:
        StorageError: for an unknown ending, a folder that is missing, a full disk, and metadata that is not plain data.
    """
    target = check_target(path, _WHAT)
    note = metadata_text(volume.metadata, _WHAT)
    grid = volume.grid
    given = {"values": volume.values, "times": volume.times, "directions": volume.directions, "depths": grid.depths}
    given |= {name: getattr(grid, name) for name in _VECTORS}
    arrays = {name: array_of(tensor, _WHAT) for name, tensor in given.items() if tensor is not None}
    arrays["pitch"] = np.array(grid.pitch, np.float64)
    write_arrays(target, arrays, {"format": FORMAT, "method": volume.method, "metadata": note}, _WHAT)
    return target


def read_volume(path: str | Path) -> HiddenVolume:
    """Read a volume of :func:`write_volume`, as tensors on the CPU.

    Args:
        path: the file. Names that other programs put there are left alone.

    Raises:
        StorageError: for a file that is missing, damaged or no volume.
    """
    needed, optional = ("values", "depths", "pitch", *_VECTORS), ("times", "directions")
    known = {*needed, *optional, "format", "method", "metadata"}
    found = read_arrays(path, FORMATS, _WHAT, known.__contains__)
    with damage_said(Path(path), _WHAT):
        values = {name: tensor_in(found[name]) for name in needed}
        more = {name: tensor_in(found[name]) for name in optional if name in found}
        rows, columns = values["values"].shape[-2:]
        dy, dx = values["pitch"].tolist()
        vectors = {name: values[name] for name in _VECTORS}
        grid = VoxelGrid(values["depths"], (rows, columns), (dy, dx), **vectors)
        return HiddenVolume(
            values["values"], grid, text_of(found, "method"), metadata=notes_of(found, "metadata"), **more
        )
