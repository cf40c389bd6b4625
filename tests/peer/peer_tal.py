"""What y-tal makes of files, in its own environment. `python peer_tal.py make|dump SOURCE TARGET`.

`make`: an .npz of the fields of a capture becomes a file that y-tal writes. `dump`: y-tal reads a file, and its
fields become an .npz.
"""

import sys

import numpy as np
import tal
from tal.enums import FileFormat, GridFormat, HFormat, VolumeFormat
from tal.io import read_capture, write_capture
from tal.io.capture_data import NLOSCaptureData, read_hdf5
from tal.io.format import convert_dict, detect_dict_format

ENUMS = {
    "H_format": HFormat, "sensor_grid_format": GridFormat, "laser_grid_format": GridFormat,
    "volume_format": VolumeFormat,
}  # fmt: skip


def made(fields):
    capture = NLOSCaptureData()
    for name in capture.as_dict():
        setattr(capture, name, None)
    for name, value in fields.items():
        if name in ENUMS:
            value = ENUMS[name][str(value)]
        elif value.ndim == 0:
            value = value[()]
        setattr(capture, name, value)
    # What a render of y-tal writes there: texts, numbers, arrays that its own loader makes of tags of Python.
    capture.scene_info = {
        "tal_version": tal.__version__,
        "config": {
            "name": "ä",
            "mitsuba_variant": "llvm_mono",
            "bins": 7,
            "width": 1e-05,
            "missing": None,
            "flag": True,
            "size": (3, 4),
        },
        "ground_truth": {"depth": np.arange(6.0).reshape(2, 3)},
    }
    return capture


def read(source):
    """The fields of a file. `read_capture` of 0.20 raises for other layouts: it takes their `scene_info` for a text."""
    stored = read_hdf5(source)
    if detect_dict_format(stored) == FileFormat.HDF5_TAL:
        return read_capture(source).as_dict()
    return convert_dict(stored, format_to=FileFormat.HDF5_TAL)


def dump(found):
    fields = {"version": tal.__version__}
    for name, value in found.items():
        if name in ENUMS and value is not None:
            fields[name] = value.name
        elif name == "scene_info":
            fields[name] = repr(value)
        elif isinstance(value, np.ndarray | np.generic | float | int | bool):
            fields[name] = np.asarray(value)
        elif value is not None and type(value).__name__ != "Empty":
            raise TypeError(f"{name}: {type(value)}")
    return fields


def main(mode, source, target):
    if mode == "make":
        with np.load(source) as fields:
            write_capture(target, made(dict(fields)))
    else:
        np.savez(target, **dump(read(source)))


if __name__ == "__main__":
    main(*sys.argv[1:])
