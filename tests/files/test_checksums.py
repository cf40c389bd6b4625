"""Files that carry checksums: what was changed in them is said, what is not theirs is not read."""

from __future__ import annotations

import io
import json
import os
import shutil
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.capture_files import grids, made
from support.killed_writers import output
from support.sealed_files import as_first_version
from support.sweeps import together
from torchtransient.array_files import array_file, hdf5
from torchtransient.array_files.part_files import whole_file
from torchtransient.errors import StorageError
from torchtransient.files.result_file import read_result, write_result

SEED = 3


def volume():
    eye = torch.eye(3, dtype=torch.float64)
    axes = dict(zip(("along_x", "along_y", "normal"), eye, strict=True))
    grid = tt.nlos.VoxelGrid(torch.linspace(0.1, 1, 4), (5, 6), (0.1, 0.2), first=eye[0] * 0, **axes)
    return tt.nlos.HiddenVolume(torch.arange(120.0).reshape(1, 4, 5, 6), grid, "fk", metadata={"a": 1})


KINDS = {
    "result": (lambda path: write_result(path, output(SEED), {"scene": "box.xml"}), read_result),
    "capture": (lambda path: made(grids()["confocal"], metadata={"a": "b"}).write(path), tt.nlos.Capture.read),
    "volume": (lambda path: tt.nlos.write_volume(path, volume()), tt.nlos.read_volume),
}
MEASURED = {"result": "transient", "capture": "transient", "volume": "values"}


def flipped(path: Path, place: int, bit: int = 3) -> None:
    with path.open("r+b") as file:
        file.seek(place)
        (old,) = file.read(1)
        file.seek(place)
        file.write(bytes([old ^ 1 << bit]))


@pytest.mark.parametrize("kind", KINDS)
def test_a_bit_of_each_array(tmp_path, kind):
    write, read = KINDS[kind]
    path = write(tmp_path / "a.h5")
    with h5py.File(path) as file:
        places = {name: (data.id.get_offset(), data.nbytes) for name, data in file.items()}
    for name in json.loads(h5py_attribute(path, "checksums"))["arrays"]:
        place, size = places[name]
        for bit in (7,):
            changed = shutil.copyfile(path, tmp_path / "b.h5")
            flipped(changed, place + size // 2, bit)
            if kind == "capture" and name in ("sensor_legs", "laser_legs"):
                read(changed)  # which are for others, and not read
                continue
            with pytest.raises(StorageError, match=f"'{name}' is not what was written .*SHA-256"):
                read(changed)


def h5py_attribute(path, name):
    with h5py.File(path) as file:
        return file.attrs[name]


@pytest.mark.parametrize("kind", KINDS)
def test_a_letter_of_a_text(tmp_path, kind):
    """In the bytes of the file: "metadata" and what it says."""
    write, read = KINDS[kind]
    path = write(tmp_path / "a.h5")
    text = h5py_attribute(path, "metadata").encode()
    assert path.read_bytes().count(text) == 1
    flipped(path, path.read_bytes().index(text) + text.index(b'"') + 1, 0)
    with pytest.raises(StorageError, match="'metadata' is not what was written"):
        read(path)


@pytest.mark.parametrize("kind", KINDS)
def test_members_of_an_archive(tmp_path, kind):
    """With checksums of the archive's own that are right, as of a program that has written it anew."""
    write, read = KINDS[kind]
    path = write(tmp_path / "a.npz")
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    changed = arrays[MEASURED[kind]].copy()
    changed.flat[5] += 1
    for name, value in {MEASURED[kind]: changed, "metadata": np.array('{"a": 2}')}.items():
        np.savez(tmp_path / "b.npz", **arrays | {name: value})
        with pytest.raises(StorageError, match=f"'{name}' is not what was written"):
            read(tmp_path / "b.npz")
    np.savez(tmp_path / "b.npz", **{name: value for name, value in arrays.items() if name != "metadata"})
    with pytest.raises(StorageError, match="'metadata' is missing"):
        read(tmp_path / "b.npz")
    stream = io.BytesIO()
    np.save(stream, changed)
    with zipfile.ZipFile(path, "a") as file, pytest.warns(UserWarning, match="Duplicate"):
        file.writestr(f"{MEASURED[kind]}.npy", stream.getvalue())
    with pytest.raises(StorageError, match="stands twice"):
        read(path)


@pytest.mark.parametrize("kind, ending", list(zip(KINDS, ("h5", "npz", "h5"), strict=False)))
def test_files_of_the_first_version(tmp_path, recwarn, kind, ending):
    """They have no checksums, and are read without a word; those of the second one do not lose them."""
    write, read = KINDS[kind]
    path = write(tmp_path / f"a.{ending}")
    expected = read(path)
    assert read(as_first_version(path)) == expected and not recwarn.list
    path = write(tmp_path / "a.h5")
    with h5py.File(path, "r+") as file:
        del file.attrs["checksums"]
    with pytest.raises(StorageError, match="has lost its checksums"):
        read(path)


def test_checksums_that_are_none(tmp_path):
    path = write_result(tmp_path / "a.h5", output(SEED))
    wrong_arrays = '{"entries": {}, "arrays": {"a": ["x", "y"]}}'
    for text in ("", "[]", "{", '{"entries": 1, "arrays": {}}', wrong_arrays, "1" * 9999, "[" * 9999):
        with h5py.File(path, "r+") as file:
            file.attrs["checksums"] = text
        with pytest.raises(StorageError, match="the checksums cannot be read"):
            read_result(path)


def test_what_was_put_there_later(tmp_path):
    path = made(grids()["confocal"]).write(tmp_path / "a.h5")
    with h5py.File(path, "r+") as file:
        file["steady"] = np.zeros((1, 3, 4), np.float32)
    with pytest.raises(StorageError, match="'steady' was put there later"):
        tt.nlos.Capture.read(path)


def test_parts_of_any_size_have_one_checksum(tmp_path, monkeypatch):
    """The reader takes the size from the file, whatever its own is."""
    monkeypatch.setattr(array_file, "_PART_BYTES", 5000)
    made_of = output(SEED)
    for ending in ("h5", "npz"):
        path = write_result(tmp_path / f"a.{ending}", made_of)
        monkeypatch.setattr(array_file, "_PART_BYTES", 2**26)
        assert torch.equal(read_result(path).transient, made_of.transient)
        if ending == "h5":
            rows = json.loads(h5py_attribute(path, "checksums"))["arrays"]["transient"][0]
            assert 1 <= rows < 32
        monkeypatch.setattr(array_file, "_PART_BYTES", 5000)


# ----------------------------------------------------------------------------------------------- what is not the file's


def external(file):
    file.create_dataset("transient", (4, 4, 4, 4), "u1", external=[("/etc/passwd", 0, 256)])


def virtual(file):
    layout = h5py.VirtualLayout(shape=(4, 4, 4, 4), dtype="u1")
    layout[:] = h5py.VirtualSource("/etc/passwd", "a", shape=(4, 4, 4, 4))
    file.create_virtual_dataset("transient", layout)


def linked(link):
    def change(file):
        file["transient"] = link

    return change


def filtered(file):
    settings = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    settings.set_chunk((4, 4, 4, 4))
    # What no library on this machine knows, and what HDF5 would look for in its folders of plugins.
    settings.set_filter(31999, h5py.h5z.FLAG_OPTIONAL, (1,))
    space = h5py.h5s.create_simple((4, 4, 4, 4))
    h5py.h5d.create(file.id, b"transient", h5py.h5t.IEEE_F32LE, space, settings)


def terabytes(file):
    file.create_dataset("transient", (2**14, 2**14, 2**14), "f4", chunks=True)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (external, "lies in other files"), (virtual, "lies in other files"), (filtered, "the filter 31999"),
        (linked(h5py.ExternalLink("/etc/passwd", "/a")), "a link to elsewhere"),
        (linked(h5py.SoftLink("/steady")), "a link to elsewhere"), (terabytes, "declares .* bytes"),
        (lambda file: file.create_group("transient"), "expected 'transient' to be a dataset"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("first", [False, True])
def test_bytes_from_elsewhere(tmp_path, change, words, first):
    path = write_result(tmp_path / "a.h5", output(SEED))
    if first:
        as_first_version(path)
    with h5py.File(path, "r+") as file:
        del file["transient"]
        change(file)
    with pytest.raises(StorageError, match=words):
        read_result(path)


def test_what_is_unknown_is_not_read(tmp_path, monkeypatch):
    path = write_result(tmp_path / "a.h5", output(SEED))
    with h5py.File(path, "r+") as file:
        file["theirs"] = np.zeros(3)
        file["elsewhere"] = h5py.ExternalLink("/etc/passwd", "x")
        file.attrs["notes"] = ["a", "b"]
    read, looked_at = hdf5.read_dataset, []

    def counted(parent, name, *rest):
        looked_at.append(name)
        return read(parent, name, *rest)

    monkeypatch.setattr(array_file, "read_dataset", counted)
    assert read_result(path).metadata
    assert sorted(looked_at) == ["edges_opl", "steady", "transient"]


def wrong(**changes):
    """A result of the first version with other arrays and entries."""

    def make(path):
        as_first_version(write_result(path, output(SEED)))
        with np.load(path) as file:
            arrays = {name: file[name] for name in file.files}
        np.savez(path, **{name: value for name, value in (arrays | changes).items() if value is not None})
        return path

    return make


@together(
    "make",
    [
        wrong(transient=np.zeros((3, 40, 32, 32), "i8") > 0), wrong(transient=np.zeros((3, 40, 32, 32), "c8")),
        wrong(transient=np.zeros((3, 40, 32), "f4")), wrong(transient=np.zeros((3, 39, 32, 32), "f4")),
        wrong(steady=np.zeros((3, 32, 31), "f4")), wrong(steady=np.zeros((4, 32, 32), "f4")), wrong(steady=None),
        wrong(channels=np.array('["a", "b"]')), wrong(channels=np.array("[1, 2, 3]")), wrong(channels=np.array(3)),
        wrong(metadata=np.array("[1]")), wrong(metadata=np.array("{")), wrong(metadata=np.zeros(3)),
        wrong(num_bins=np.array(40.5)), wrong(num_bins=np.array(-40)), wrong(num_bins=np.array("40")),
        wrong(bin_width_opl=np.array(np.nan)), wrong(bin_width_opl=np.array(0.0)), wrong(start_opl=np.array(1e300)),
        wrong(format=np.array("torchtransient result 3")), wrong(format=np.zeros((0,))), wrong(format=None),
        wrong(num_bins=np.array(2**62)), wrong(transient=np.array("text")), wrong(metadata=np.array("[" * 9000)),
    ],
)  # fmt: skip
def test_results_that_do_not_fit_together(tmp_path, make):
    with pytest.raises(StorageError) as found:
        read_result(make(tmp_path / "a.npz"))
    assert len(str(found.value)) < 400 + len(str(tmp_path)) and "\n" not in str(found.value)


# ----------------------------------------------------------------------------------------------------- unfinished files


@pytest.mark.parametrize("kind", KINDS)
def test_parts_of_killed_writers(tmp_path, kind):
    write, read = KINDS[kind]
    dead, others = tmp_path / ".a.h5.0123abcd.part", [tmp_path / "a.part", tmp_path / ".b.part", tmp_path / ".c.tmp"]
    for path in (dead, *others):
        path.write_bytes(b"x")
    (tmp_path / ".d.h5.0123abcd.part").mkdir()
    path = write(tmp_path / "e.h5")
    assert not dead.exists() and all(one.exists() for one in others) and (tmp_path / ".d.h5.0123abcd.part").is_dir()
    read(path)


def test_two_writers_at_once(tmp_path):
    """The one that begins later leaves the other's part alone."""
    target = tmp_path / "a.h5"
    with array_file.replacing(target, "test") as first:
        first.write_bytes(b"first")
        with array_file.replacing(target, "test") as second:
            second.write_bytes(b"second")
        assert first.read_bytes() == b"first" and target.read_bytes() == b"second"
    assert target.read_bytes() == b"first" and os.listdir(tmp_path) == ["a.h5"]
    with pytest.raises(FileNotFoundError), whole_file(target, "test") as part:
        part.with_name("none").read_bytes()
    assert target.read_bytes() == b"first" and os.listdir(tmp_path) == ["a.h5"]
