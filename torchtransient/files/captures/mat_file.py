"""MATLAB files of version 7.3: HDF5 with a header in front and the class of each array beside it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.array_files.array_file import replacing
from torchtransient.array_files.hdf5_writing import new_hdf5
from torchtransient.files.captures.contents import WHAT

_HEADER = b"MATLAB 7.3 MAT-file, Platform: torchtransient, HDF5 schema 1.00 ."
_USER_BLOCK = 512
_CLASSES = {"float64": "double", "float32": "single", "bool": "logical"}


def write_mat(target: Path, variables: Mapping[str, Any]) -> None:
    """Write arrays and structures (mappings of arrays) by name. Arrays are in the order of HDF5, the reverse of
    MATLAB's. Raises StorageError for a full disk.
    """
    with replacing(target, WHAT) as unfinished:
        with new_hdf5(unfinished, WHAT, userblock_size=_USER_BLOCK) as file:
            for name, value in variables.items():
                if isinstance(value, Mapping):
                    group = file.create_group(name)
                    group.attrs["MATLAB_class"] = np.bytes_("struct")
                    for field, array in value.items():
                        _write(group, field, np.asarray(array))
                else:
                    _write(file, name, np.asarray(value))
        with unfinished.open("r+b") as raw:
            raw.write(_HEADER.ljust(116) + bytes(8) + b"\x00\x02IM")


def _write(group: Any, name: str, array: NDArray[Any]) -> None:
    # MATLAB has no arrays of fewer than two dimensions.
    array = array.reshape(*(1,) * (2 - array.ndim), *array.shape)
    kind = _CLASSES.get(array.dtype.name, array.dtype.name)
    dataset = group.create_dataset(name, shape=array.shape, dtype=np.uint8 if kind == "logical" else array.dtype)
    dataset.attrs["MATLAB_class"] = np.bytes_(kind)
    write_parts(dataset, array)


def write_parts(dataset: Any, array: NDArray[Any], part_bytes: int = 2**26) -> None:
    """Fill a dataset some first indices at a time, so that an array whose axes were moved is not copied as a whole."""
    if array.ndim == 0 or array.size == 0:
        dataset[...] = array
        return
    step = max(1, part_bytes * len(array) // max(1, array.nbytes))
    for first in range(0, len(array), step):
        dataset[first : first + step] = array[first : first + step]
