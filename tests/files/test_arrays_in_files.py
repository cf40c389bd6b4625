"""What arrays, texts and attributes of a file may be, and how large: the last that is read, the first that is not."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.capture_files import grids, made
from torchtransient.array_files import array_file, hdf5, part_files
from torchtransient.capture import Capture, Scan
from torchtransient.capture.capture import metadata_text
from torchtransient.errors import ArgumentError, ShapeError, StorageError
from torchtransient.files.captures.contents import MatContents
from torchtransient.files.plain_data import plain, restored, scan_data, scan_from_data

# ----------------------------------------------------------------------------------------------------- sizes and memory


def test_arrays_are_no_larger_than_what_is_stored_of_them():
    # Two thousand and sixty-four times as large, or a mebibyte.
    for stored, most in ((0, 2**20), (508, 2**20), (509, 2 * 1032 * 509), (10_000, 2 * 1032 * 10_000)):
        hdf5.check_size(most, stored, "file: 'a'")
        with pytest.raises(StorageError, match=f"file: 'a' declares {most + 1:,} bytes .* and stores {stored:,}"):
            hdf5.check_size(most + 1, stored, "file: 'a'")


def test_large_arrays_fit_into_the_memory_that_is_left(monkeypatch):
    asked = []
    monkeypatch.setattr(hdf5, "available_memory", lambda: asked.append(1) or 3 * 2**26)
    hdf5.check_memory(2**26 - 1, "a")
    assert not asked
    hdf5.check_memory(2**26, "a")
    hdf5.check_memory(3 * 2**26, "a")
    assert len(asked) == 2
    with pytest.raises(StorageError, match=r"a takes 0\.201 GB, and 0\.201 GB of memory are left"):
        hdf5.check_memory(3 * 2**26 + 1, "a")
    monkeypatch.setattr(hdf5, "available_memory", lambda: None)
    hdf5.check_memory(2**60, "a")


@pytest.mark.parametrize(("kind", "taken"), [
    ("f8", True), ("c16", True), ("?", True), ("u8", True), ("f2", True), ("S5", False), ("V3", False),
    ("f16", False), ("c32", False),
])  # fmt: skip
def test_numbers_of_up_to_64_bits(kind, taken):
    assert hdf5.is_number(np.dtype(kind)) is taken


def npy(version, head):
    """The start of a file of NumPy."""
    head = head.encode().ljust(118 - len("\n")) + b"\n"
    length = struct.pack("<H" if version[0] == 1 else "<I", len(head))
    return b"\x93NUMPY" + bytes(version) + length + head


def test_arrays_of_numpy(tmp_path):
    path, head = tmp_path / "a.npy", "{'descr': '<f8', 'fortran_order': False, 'shape': (3,), }"
    for version in ((1, 0), (2, 0)):
        path.write_bytes(npy(version, head) + np.arange(3.0).tobytes())
        assert array_file.read_npy(path, "file").tolist() == [0.0, 1.0, 2.0]
    path.write_bytes(npy((3, 0), head) + np.arange(3.0).tobytes())
    with pytest.raises(StorageError, match=r"is an array of version \(3, 0\), which NumPy writes for none"):
        array_file.read_npy(path, "file")
    path.write_bytes(npy((1, 0), head.replace("(3,)", "(99,)")) + np.arange(3.0).tobytes())
    with pytest.raises(StorageError, match="declares 792 bytes of numbers and stores 152: it is damaged"):
        array_file.read_npy(path, "file")
    path.write_bytes(npy((1, 0), head.replace("<f8", "|O")))
    with pytest.raises(StorageError, match="holds object; expected numbers or a text"):
        array_file.read_npy(path, "file")


def test_files_that_do_not_fit_into_memory():
    for error, kind, words in (
        (MemoryError(), "", "'a.h5' does not fit into memory, or is damaged"),
        (ZeroDivisionError("x"), "", "is not a result of torchtransient, or is damaged: x"),
        (KeyError("x"), "", "is not a result of torchtransient, or is damaged: 'x'"),
        (struct.error("x"), "a mesh", "is not a mesh, or is damaged: x"),
        (ShapeError("wrong axis"), "a mesh", "'a.h5': wrong axis"),
        (ShapeError("wrong axis"), "", "is not a result of torchtransient, or is damaged: wrong axis"),
        (StorageError("told"), "", "^told$"),
    ):
        with pytest.raises(StorageError, match=words), array_file.damage_said(Path("a.h5"), "result file", kind):
            raise error


def test_attributes_are_numbers_or_texts(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.attrs["number"], file.attrs["text"], file.attrs["bytes"] = 2.5, "straße", np.bytes_(b"abc")
        file.attrs["reference"] = file.ref
        file.attrs["texts"] = np.array(["a", "b"], dtype=h5py.string_dtype())
    with h5py.File(tmp_path / "a.h5") as file:
        found = hdf5.read_attributes(file, "file", ["number", "text", "bytes", "none"])
        assert found == {"number": 2.5, "text": "straße", "bytes": "abc"}
        with pytest.raises(StorageError, match="the attribute 'reference' holds object; expected numbers or a"):
            hdf5.read_attributes(file, "file", ["reference"])
        with pytest.raises(StorageError, match="the attribute 'texts' is a text that is stored in an unknown"):
            hdf5.read_attributes(file, "file", ["texts"])


def test_parts_of_datasets(tmp_path):
    array = np.arange(24.0).reshape(2, 3, 4)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["a"], file["text"], file["texts"] = array, "wall", np.array([b"a", b"b"])
        file["empty"] = h5py.Empty(float)
        file["group/b"] = 3.0
        marked = file.create_dataset("matlab", data=np.zeros(2))
        marked.attrs["MATLAB_empty"] = 1
    with h5py.File(tmp_path / "a.h5") as file:

        def read(name, *part):
            return hdf5.read_dataset(file, name, "file", *part)

        np.testing.assert_array_equal(read("a"), array)
        np.testing.assert_array_equal(read("a", (slice(None), 1)), array[:, 1])
        np.testing.assert_array_equal(read("a", (1,)), array[1])
        assert read("text") == "wall" and float(read("group/b")) == 3.0
        assert read("empty") is None and read("none") is None and read("matlab") is None and read("a/b") is None
        for name, words in (("group", "to be a dataset, got a group"), ("texts", r"'texts' holds \|S1; expected")):
            with pytest.raises(StorageError, match=words):
                read(name)


# ----------------------------------------------------------------------------------------------------- unfinished files


def test_a_folder_that_cannot_be_written(tmp_path, monkeypatch):
    def refused(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(part_files.os, "open", refused)
    words = "file: '.*a.h5' could not be written: .*Permission denied"
    with pytest.raises(StorageError, match=words), part_files.whole_file(tmp_path / "a.h5", "file"):
        raise AssertionError("nothing is open")


def test_locks_that_fail_otherwise_are_errors_of_the_system(tmp_path, monkeypatch):
    import errno
    import fcntl

    def refused(*_):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(fcntl, "flock", refused)
    words = "could not be written: .*Input/output error"
    with pytest.raises(StorageError, match=words), part_files.whole_file(tmp_path / "a.h5", "file"):
        raise AssertionError("nothing is open")
    (tmp_path / ".a.h5.01234567.part").write_text("left")
    with pytest.raises(OSError, match="Input/output"):
        part_files.sweep_parts(tmp_path)


def test_parts_are_told_by_their_names(tmp_path):
    ours = ".a.h5.0123abcd.part"
    others = (
        ".a.h5.0123abcde.part", ".a.h5.0123abc.part", ".a.h5.0123ABCD.part", "a.h5.0123abcd.part", ".0123abcd.part",
        f".{41 * 'x'}.0123abcd.part", ".a.h5.0123abcd.parts",
    )  # fmt: skip
    for name in (ours, f".{40 * 'x'}.0123abcd.part", *others):
        (tmp_path / name).write_text("left")
    removed = {path.name for path in part_files.sweep_parts(tmp_path)}
    assert removed == {ours, f".{40 * 'x'}.0123abcd.part"}
    assert {path.name for path in tmp_path.iterdir()} == set(others)


def test_a_file_that_is_there_stays_unless_it_is_asked_for(tmp_path):
    path = tmp_path / "a.txt"
    for over, expected in ((False, "one"), (False, "one"), (True, "two")):
        with part_files.whole_file(path, "file", over=over, synchronized=False) as part:
            assert part.name.startswith(".a.txt.") and part.suffix == ".part"
            part.write_text("one" if not path.exists() else "two")
        assert path.read_text() == expected and list(tmp_path.iterdir()) == [path]


# ---------------------------------------------------------------------------------------------------- records and files


def test_settings_of_captures():
    capture = made(grids()["confocal"])
    for change, error, words in (
        ({"scan": None}, ArgumentError, "scan: expected a Scan, got None"),
        ({"axis": (0.0, 0.1, 7)}, ArgumentError, "expected axis as a TimeAxis or None"),
        ({"frequencies": capture.axis}, ArgumentError, "expected frequencies as a FrequencyAxis or None"),
        ({"channels": ["a"]}, ArgumentError, "expected channels as a tuple of names"),
        ({"channels": (1,)}, ArgumentError, "expected channels as a tuple of names"),
        ({"metadata": [1]}, StorageError, "Capture: expected metadata as names and values"),
    ):  # fmt: skip
        with pytest.raises(error, match=words):
            replace(capture, **change)
    masked = np.ma.masked_array(capture.transient.numpy(), mask=False)
    with pytest.raises(ShapeError, match="its mask would be lost"):
        replace(capture, transient=masked)


def test_metadata_are_names_and_values():
    assert metadata_text({"a": (1, 2)}, "file") == '{"a": [1, 2]}'
    for metadata in (None, [("a", 1)], "a"):
        with pytest.raises(StorageError, match="file: expected metadata as names and values, got"):
            metadata_text(metadata, "file")


def test_plain_data_come_back():
    given = {
        "a": [1, 2.5, None, True, "x"], "pair": (1, (2, 3)), "one": np.float32(0.5), "tensor": torch.arange(3),
        "big": np.arange(6, dtype=">i4").reshape(2, 3), "inner": {"matrix": np.eye(2)},
        "flags": np.array([True, False]),
    }  # fmt: skip
    parts = []
    for arrays in (None, parts):
        found = plain(given, arrays, "wall")
        back = restored(found, {f"wall_{k}": part for k, part in enumerate(parts)})
        assert back["a"] == given["a"] and back["pair"] == (1, (2, 3)) and back["one"] == 0.5
        np.testing.assert_array_equal(back["tensor"], [0, 1, 2])
        np.testing.assert_array_equal(back["big"], given["big"])
        np.testing.assert_array_equal(back["inner"]["matrix"], np.eye(2))
        assert back["flags"].dtype == bool
    assert len(parts) == 4 and found["tensor"] == {"__array__": "wall_0"} and restored(plain((), None, "x"), {}) == ()
    with pytest.raises(StorageError, match=r"wall\.inner is a object, which no file can hold"):
        plain({"inner": object()}, None, "wall")
    told = plain(np.arange(2.0), None, "wall")
    for kind in ("O", "U3", "V8", "M8[s]"):
        with pytest.raises(StorageError, match="expected a type of numbers, got"):
            restored({**told, "dtype": kind}, {})


def test_scans_as_plain_data():
    scan = replace(grids()["exhaustive"], wall={"type": "rectangle", "to_world": np.eye(4)})
    data = scan_data(scan)
    assert scan_from_data(data) == scan and isinstance(scan_from_data(data), Scan)
    with pytest.raises(StorageError, match=r"scan: expected the data of a scan, got \['more'\] beside it"):
        scan_from_data({**data, "more": 1})
    with pytest.raises(StorageError, match="scan: 'scan'"):
        scan_from_data({**data, "kind": "none"})
    with pytest.raises(StorageError, match="is not the plain data of a scan, or is damaged"):
        scan_from_data({name: value for name, value in data.items() if name != "kind"})


def test_volumes_alone_are_written_as_volumes(tmp_path):
    with pytest.raises(ArgumentError, match="volume file: expected a HiddenVolume, got Tensor"):
        tt.nlos.write_volume(tmp_path / "a.h5", torch.ones(3))
    assert list(tmp_path.iterdir()) == []
    assert Capture.read(made(grids()["single"]).write(tmp_path / "a.npz")).scan.kind == "single"


# --------------------------------------------------------------------------------------------------- MATLAB's old files


def element(kind, data):
    return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)


def matrix(kind, *parts, name=b"m", shape=(1, 1), flags=0):
    """A variable of a class, whose parts follow its head."""
    head = element(6, struct.pack("<II", kind | flags, 0)) + element(5, struct.pack(f"<{len(shape)}i", *shape))
    return element(14, head + element(1, name) + b"".join(parts))


def contents(path, *variables):
    path.write_bytes(b"MATLAB 5.0".ljust(124) + b"\x00\x01IM" + b"".join(variables))
    return MatContents(path)


def fields(*names, length=8):
    return element(5, struct.pack("<i", length)) + element(1, b"".join(name.ljust(length, b"\0") for name in names))


NUMBER = matrix(6, element(9, struct.pack("<d", 2.5)), name=b"")


def test_structures_of_old_files(tmp_path):
    path = tmp_path / "a.mat"
    found = contents(path, matrix(2, fields(b"one", b"two"), NUMBER, NUMBER))
    assert found.fields("m") == {"one", "two"} and float(found.array("m/two").item()) == 2.5
    assert found.array("m/three") is None
    with pytest.raises(StorageError, match="expected one structure with 'm/one/more', got an array of numbers"):
        found.array("m/one/more")
    for variable, words in (
        (matrix(2, fields(b"one", length=0), NUMBER), "names of a letter or more, got 0"),
        (matrix(2, fields(b"one"), element(9, struct.pack("<d", 2.5))), "in a structure, got an element of type 9"),
        (matrix(6, element(9, struct.pack("<dd", 1, 2))), r"expected 1 numbers \(1, 1\), got 2"),
        (matrix(6, element(1, b"abc"), shape=(1, 4)), r"expected 4 numbers \(4, 1\), got 3"),
        (matrix(6, element(14, b"abc")), "expected numbers, got an element of type 14"),
        (matrix(6), "a variable ends too early"), (matrix(6, struct.pack("<II", 9, 16)), "does not end where its"),
        (matrix(6, struct.pack("<I", 5 << 16 | 2) + b"abcd"), "an element of 5 bytes does not end"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            contents(path, variable).array("m")
    for variable, words in (
        (element(9, struct.pack("<d", 2.5)), "expected a variable at byte 128, got an element of type 9"),
        (matrix(6, shape=(3,)), "two dimensions or more, got"), (matrix(6, shape=(3, -1)), "two dimensions or more"),
        (struct.pack("<II", 14, 900), "a variable of 900 bytes does not end in a file of 136"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            contents(path, variable)


@pytest.mark.parametrize("levels", [10, 11])
def test_structures_are_ten_deep(tmp_path, levels):
    deep = NUMBER
    for _ in range(levels - 1):
        deep = matrix(2, fields(b"a"), deep, name=b"")
    found = contents(tmp_path / "a.mat", matrix(2, fields(b"a"), deep))
    if levels == 10:
        assert float(found.array("m" + 10 * "/a").item()) == 2.5
        return
    with pytest.raises(ValueError, match="structures in structures, more than 10 deep"):
        found.fields("m")


def test_small_elements_complex_numbers_and_texts_of_old_files(tmp_path):
    path = tmp_path / "a.mat"
    small = struct.pack("<I", 2 << 16 | 2) + b"\x07\x08\0\0"
    assert contents(path, matrix(6, small, shape=(2, 1))).array("m").tolist() == [[7.0, 8.0]]
    parts = (element(9, struct.pack("<dd", 1, 2)), element(9, struct.pack("<dd", 3, 4)))
    assert contents(path, matrix(6, *parts, shape=(1, 2), flags=0x800)).array("m").tolist() == [[1 + 3j], [2 + 4j]]
    assert contents(path, matrix(4, element(16, "ß".encode()), shape=(1, 1))).text("m") == "ß"
    assert contents(path, matrix(4, element(4, "aß".encode("utf-16-le")), shape=(1, 2))).text("m") == "aß"
    # What is empty is nothing; what is without a name is a function's own.
    assert contents(path, matrix(6, element(9, b""), shape=(0, 3))).array("m") is None
    assert contents(path, matrix(4, element(16, b""), shape=(0, 0))).text("m") is None
    assert contents(path, NUMBER).shapes == {}
    found = contents(path, matrix(1, name=b"c", shape=(1, 2)), matrix(6, element(9, struct.pack("<d", 2.5))))
    assert found.shapes == {"c": (2, 1), "m": (1, 1)}
    with pytest.raises(StorageError, match="expected an array of numbers in 'c', got a cell array"):
        found.array("c")
    with pytest.raises(StorageError, match="expected a text in 'm', got an array of numbers"):
        found.text("m")
