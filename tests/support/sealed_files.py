"""Files of the library that a test changes, without the checksums that would tell of it."""

from __future__ import annotations

import io
import re
import zipfile
from pathlib import Path

import numpy as np

from torchtransient.array_files.array_file import CHECKSUMS


def as_first_version(path: Path) -> Path:
    """The same file as the first version of the format has it, without checksums, in its place."""
    if path.suffix == ".npz":
        with zipfile.ZipFile(path) as file:
            members = {name: file.read(name) for name in file.namelist()}
        members.pop(f"{CHECKSUMS}.npy", None)
        stream = io.BytesIO()
        np.save(stream, np.array(_first(str(np.load(io.BytesIO(members["format.npy"]))))))
        with zipfile.ZipFile(path, "w") as file:
            for name, data in {**members, "format.npy": stream.getvalue()}.items():
                file.writestr(name, data)
        return path
    import h5py

    with h5py.File(path, "r+") as file:
        file.attrs.pop(CHECKSUMS, None)
        file.attrs["format"] = _first(file.attrs["format"])
    return path


def _first(form: str) -> str:
    return re.sub(r"\d+$", "1", form)
