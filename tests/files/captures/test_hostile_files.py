"""Files that are damaged or made to harm give StorageError, in little memory, and run nothing."""

from __future__ import annotations

import resource
import shutil
import struct
from pathlib import Path

import h5py
import numpy as np
import pytest

import torchtransient as tt
from support.capture_files import grids, made
from support.hostile_captures import TEXTS, WAYS, lead_elsewhere
from support.sealed_files import as_first_version
from support.sweeps import together
from torchtransient.errors import StorageError


def read(path):
    """True for a file that is a capture, False for a StorageError. Everything else is raised."""
    try:
        tt.nlos.read_capture(path)
    except StorageError:
        return False
    return True


def _memory():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


@pytest.fixture
def tal_file(tmp_path):
    return made(grids()["confocal"]).write(tmp_path / "a.h5", "tal")


@together("text", TEXTS, lambda text: text[:60])
def test_yaml_is_neither_executed_nor_expanded(tmp_path, tal_file, text):
    executed = tmp_path / "executed"
    with h5py.File(tal_file, "r+") as file:
        del file["scene_info"]
        if "\0" in text:
            with pytest.raises(ValueError, match="NULL"):
                file["scene_info"] = text
            file["scene_info"] = "a: [\x01]"
        else:
            file["scene_info"] = text.replace("{executed}", str(executed))
    before = _memory()
    read(tal_file)
    assert not executed.exists()
    assert _memory() - before < 50e6


def test_tags_of_python_are_left_as_data(tal_file, tmp_path):
    with h5py.File(tal_file, "r+") as file:
        del file["scene_info"]
        file["scene_info"] = "a: !!python/object/apply:os.f []\nb: !!python/tuple [1, 2]\nc: !!python/name:os.f ''"
    capture = tt.nlos.read_capture(tal_file)
    assert capture.metadata["scene_info"] == {"a": [], "b": [1, 2], "c": ""}
    again = capture.write(tmp_path / "b.h5", "tal")
    with h5py.File(tal_file) as a, h5py.File(again) as b:
        assert a["scene_info"][()] == b["scene_info"][()]  # the text itself, for y-tal


def test_numbers_that_are_not_in_the_file(tmp_path, tal_file):
    """Neither other files nor terabytes that are stored nowhere are read."""
    for number in range(WAYS):
        changed = shutil.copyfile(tal_file, tmp_path / "b.h5")
        with h5py.File(changed, "r+") as file:
            del file["H"]
            lead_elsewhere(file, "H", number)
        with pytest.raises(StorageError):
            tt.nlos.read_capture(changed)


@together("libver", ["earliest", "latest"])
@together("layout", ["tal", "torchtransient"])
def test_texts_that_say_they_are_gigabytes(tmp_path, layout, libver):
    """HDF5 would fill that much memory before it looks for the text."""
    path = made(grids()["confocal"]).write(tmp_path / "a.h5", layout)
    if layout == "torchtransient":
        as_first_version(path)
    with h5py.File(path) as file:
        text = file["scene_info"].asstr()[()] if layout == "tal" else file.attrs["metadata"]
    text += " " * (0x1A2B - len(text.encode()))  # a length that stands nowhere else in the file
    again = tmp_path / "b.h5"
    with h5py.File(path) as old, h5py.File(again, "w", libver=libver) as new:
        for name in old:
            old.copy(name, new)
        for name, value in old.attrs.items():
            new.attrs[name] = value
        if layout == "tal":
            del new["scene_info"]
            new["scene_info"] = text
        else:
            new.attrs["metadata"] = text
    assert read(again)
    data, length = again.read_bytes(), (0x1A2B).to_bytes(4, "little")
    before, place, changed = _memory(), data.find(length), 0
    while place >= 0:
        again.write_bytes(data[:place] + (0xF0000000).to_bytes(4, "little") + data[place + 4 :])
        changed += not read(again)
        place = data.find(length, place + 1)
    assert changed and _memory() - before < 50e6


class Touch:
    """Pickled, it makes a file when it is loaded."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_pickles_are_not_loaded(tmp_path):
    executed = tmp_path / "executed"
    path = made(grids()["confocal"]).write(tmp_path / "a.npz")
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    np.savez(path, **arrays | {"transient": np.array([Touch(executed)], dtype=object)})
    with pytest.raises(StorageError):
        tt.nlos.read_capture(path)
    assert not executed.exists()


def test_files_of_other_kinds(tmp_path):
    for number, data in enumerate(
        (b"", b"x" * 200, bytes(116) + b"\x00\x01IM", bytes(124) + b"\x00\x01IM", b"PK\x03\x04")
    ):
        path = tmp_path / f"{number}.mat"
        path.write_bytes(data)
        assert not read(path)
    assert not read(tmp_path)
    with pytest.raises(StorageError):
        tt.nlos.read_capture(3)


def old_matlab(order, stored, values, shape=None):
    """A variable `meas` of class double in a MATLAB file of version 5, whose numbers are stored in another kind."""

    def element(number, data):
        return struct.pack(f"{order}II", number, len(data)) + data + bytes(-len(data) % 8)

    shape = values.shape if shape is None else shape
    parts = element(6, struct.pack(f"{order}II", 6, 0)) + element(5, struct.pack(f"{order}{len(shape)}i", *shape))
    parts += struct.pack(f"{order}I", 4 << 16 | 1) + b"meas"
    parts += element(stored, values.T.astype(values.dtype.newbyteorder(order)).tobytes())
    version = b"\x00\x01IM" if order == "<" else b"\x01\x00MI"
    return b"MATLAB 5.0".ljust(124) + version + element(14, parts)


def test_old_matlab_files_of_either_order_and_damaged_ones(tmp_path):
    path, values = tmp_path / "a.mat", np.arange(48, dtype=np.uint16).reshape(4, 4, 3)

    def meas():
        return tt.nlos.read_capture(path, "rect_data", wall_size=1.0, bin_width_s=1e-12).transient[0]

    for order in "<>":
        path.write_bytes(old_matlab(order, 4, values))
        np.testing.assert_array_equal(meas().numpy(), values.transpose(2, 0, 1))
        # Types that there are not, or that are no numbers; sizes other than that of the numbers.
        for stored, shape in ((0, None), (8, None), (14, None), (19, None), (255, None), (4, (4, 4, 5)), (4, (-4, -4))):
            path.write_bytes(old_matlab(order, stored, values, shape))
            with pytest.raises(StorageError):
                meas()
    whole = old_matlab("<", 4, values)
    for end in range(130, len(whole), 7):
        path.write_bytes(whole[:end])
        assert not read(path)
    path.write_bytes(whole[:132] + b"\xff\xff\xff\x7f" + whole[136:])  # two gigabytes in a file of two hundred bytes
    assert not read(path)


@pytest.mark.parametrize("compressed", [False, True])
def test_structures_count_for_memory_and_are_ten_deep(tmp_path, monkeypatch, compressed):
    import scipy.io

    from torchtransient.array_files import hdf5

    deep = {"data": np.ones((9, 3, 1)), "laserPos": np.eye(3), "cameraPos": np.ones((3, 1)), "deltat": 0.01}
    for levels in (1, 12):
        more = {"a": 1.0}
        for _ in range(levels):
            more = {"a": more}
        dataset = {name: value.T if name == "data" else value for name, value in deep.items()}
        path = tmp_path / "a.mat"
        scipy.io.savemat(path, {"dataset": {**dataset, "more": more}}, do_compression=compressed)
        with pytest.raises(StorageError, match="more than 10 deep" if levels > 10 else "sensor_origin"):
            tt.nlos.read_capture(path)
    monkeypatch.setattr(hdf5, "_LARGE_BYTES", 100)
    monkeypatch.setattr(hdf5, "available_memory", lambda *_: 150)
    with pytest.raises(StorageError, match="of memory are left"):
        tt.nlos.read_capture(path)


def test_texts_of_yaml_have_a_length(tal_file, monkeypatch):
    from torchtransient.array_files import plain_texts

    monkeypatch.setattr(plain_texts, "_CHARACTERS", 6)
    for text, taken in (("a: 123", True), ("a: 1234", False)):
        with h5py.File(tal_file, "r+") as file:
            del file["scene_info"]
            file["scene_info"] = text
        assert read(tal_file) is taken
