"""A layout that is asked for and that a file has not is refused: no file is read with its axes in another order."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.io

from support.capture_files import holdable, read_only
from torchtransient.capture import Capture
from torchtransient.errors import StorageError
from torchtransient.files.captures.formats import LAYOUTS
from torchtransient.files.captures.matlab import write_mat

FILES = [(layout, f"{layout}-{name}", capture) for layout, name, capture in holdable() if layout != "torchtransient"]
FILES += [(layout, f"{layout}-{number}", arrays) for number, (layout, arrays) in enumerate(read_only())]
HDF5 = {entry.name for entry in LAYOUTS if ".h5" in entry.endings}
OTHERS = sorted(layout.name for layout in LAYOUTS)


@pytest.mark.parametrize(("layout", "name", "content"), FILES, ids=[name for _, name, _ in FILES])
def test_no_file_is_read_as_another(tmp_path, layout, name, content):
    path = tmp_path / ("a.mat" if isinstance(content, dict) else f"a.{'h5' if layout in HDF5 else 'mat'}")
    if isinstance(content, dict):
        write_mat(path, content)
    else:
        content.write(path, format=layout)
    said = {"wall_size": 0.6, "bin_width_s": 16e-12}
    for other in sorted(set(OTHERS) - {layout})[len(name) % 2 :: 2]:
        with pytest.raises(StorageError, match=f"in the layout '{other}', got one of '{layout}'"):
            Capture.read(path, other, **said)


@pytest.mark.parametrize("layout", OTHERS)
def test_files_of_no_layout(tmp_path, layout):
    path = tmp_path / "a.mat"
    write_mat(path, {"something": [[1.0, 2.0]]})
    with pytest.raises(StorageError):
        Capture.read(path, layout, wall_size=1.0, bin_width_s=16e-12)


def test_files_of_no_layout_name_what_reads_them(tmp_path):
    writers = {
        "scipy.io.loadmat": lambda path: scipy.io.savemat(path, {"something": [[1.0, 2.0]]}, appendmat=False),
        "h5py.File": lambda path: write_mat(path, {"something": [[1.0, 2.0]]}),
        "numpy.load": lambda path: np.savez(path.open("wb"), something=[1.0, 2.0]),
        "json.load": lambda path: path.write_text('{"something": [1.0, 2.0]}'),
    }
    for number, (reader, write) in enumerate(writers.items()):
        write(tmp_path / f"{number}.mat")
        with pytest.raises(StorageError, match=rf"holds something\..*read it with {reader} and make tt\.nlos\.Capture"):
            Capture.read(tmp_path / f"{number}.mat")
