"""Files on real disks: full ones, names that are none, links, permissions; members of files that others changed."""

from __future__ import annotations

import io
import json
import os
import resource
import signal
import stat
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.capture_files import grids, holdable, made
from support.killed_writers import output
from torchtransient.array_files import hdf5
from torchtransient.errors import ArgumentError, ShapeError, StorageError, UnitError
from torchtransient.files.captures.formats import LAYOUTS
from torchtransient.files.result_file import write_result

ENDINGS = {"torchtransient": "h5"} | {layout.name: layout.endings[0][1:] for layout in LAYOUTS}
ONE_OF_EACH = {layout: capture for layout, _, capture in holdable()}


def volume():
    eye = torch.eye(3, dtype=torch.float64)
    axes = dict(zip(("along_x", "along_y", "normal"), eye, strict=True))
    grid = tt.nlos.VoxelGrid(torch.linspace(0.1, 1, 4), (5, 6), (0.1, 0.2), first=eye[0] * 0, **axes)
    return tt.nlos.HiddenVolume(torch.arange(120.0).reshape(1, 4, 5, 6), grid, "fk", metadata={"a": 1})


def capture():
    return made(grids()["confocal"])


WRITERS = {
    **{layout: lambda path, c=c, name=layout: c.write(path, format=name) for layout, c in ONE_OF_EACH.items()},
    "volume": lambda path: tt.nlos.write_volume(path, volume()),
    "result": lambda path: write_result(path, output(0)),
    "npz": lambda path: capture().write(path),
}
SUFFIX = ENDINGS | {"volume": "h5", "result": "h5", "npz": "npz"}


def full_disks(folder):
    """Every writer against limits of every size, over a file that is there. In a process of its own."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    for name, write in WRITERS.items():
        path = folder / f"a.{SUFFIX[name]}"
        write(path)
        before, size = path.read_bytes(), path.stat().st_size
        for limit in sorted({1, 600, 2048, 4096, 9000, size // 2, size - 100, size - 1} & set(range(1, size))):
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
            try:
                with pytest.raises(StorageError, match="could not be written"):
                    write(path)
            finally:
                resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
            assert path.read_bytes() == before and list(folder.iterdir()) == [path]
        path.unlink()


@pytest.mark.slow
def test_full_disks(tmp_path):
    """A typed error, the old file, nothing beside it, and a process that lives."""
    code = f"import sys; sys.path[:0] = {sys.path!r}; import torchtransient; from files.test_disks import full_disks; "
    code += f"from pathlib import Path; full_disks(Path({str(tmp_path)!r})); print('alive')"
    tests = Path(__file__).parents[1]
    environment = {**os.environ, "PYTHONPATH": f"{tests}:{os.environ.get('PYTHONPATH', '')}"}
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, cwd=tests)
    assert (found.returncode, found.stdout) == (0, "alive\n"), found.stderr


@pytest.mark.parametrize("name", ["a\0.h5", "x" * 300 + ".h5", "", 3, None, b"a.h5"])
def test_names_that_are_none(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    for layout in ("torchtransient", "tal"):
        with pytest.raises(StorageError):
            capture().write(name, format=layout)
    for call in (lambda: tt.nlos.write_volume(name, volume()), lambda: tt.nlos.read_volume(name)):
        with pytest.raises(StorageError):
            call()
    with pytest.raises(StorageError):
        tt.nlos.Capture.read(name)
    assert list(tmp_path.iterdir()) == []


def test_the_longest_names(tmp_path):
    for layout in ("torchtransient", "tal"):
        path = capture().write(tmp_path / ("x" * 250 + ".h5"), format=layout)
        assert tt.nlos.Capture.read(path) == capture()


def test_what_is_no_file_on_a_disk(tmp_path):
    os.mkfifo(tmp_path / "pipe.h5")
    (tmp_path / "folder.h5").mkdir()
    for place, words in (("pipe.h5", "no file on a disk"), ("folder.h5", "is a folder"), ("none.h5", "does not exist")):
        with pytest.raises(StorageError, match=words):
            tt.nlos.Capture.read(tmp_path / place)
        with pytest.raises(StorageError, match=words):
            tt.nlos.read_volume(tmp_path / place)
        if place != "none.h5":
            for layout in ("torchtransient", "tal"):
                with pytest.raises(StorageError, match=words):
                    capture().write(tmp_path / place, format=layout)


def test_links_are_followed_and_permissions_kept(tmp_path):
    for layout in ("torchtransient", "tal", "dirac"):
        real, link = tmp_path / f"real_{layout}.h5", tmp_path / f"link_{layout}.h5"
        capture().write(real, format=layout)
        real.chmod(0o660)
        link.symlink_to(real)
        size = real.stat().st_size
        replace(capture(), transient=capture().transient.double()).write(link, format=layout)
        assert link.is_symlink() and real.stat().st_size > size and stat.S_IMODE(real.stat().st_mode) == 0o660


# --------------------------------------------------------------------------------------------- what others make of it


def members(path):
    with zipfile.ZipFile(path) as file:
        return {name: file.read(name) for name in file.namelist()}


def packed(path, entries, method=zipfile.ZIP_STORED):
    with zipfile.ZipFile(path, "w", method) as file:
        for name, data in entries.items():
            file.writestr(name, data)
    return path


def as_npy(value):
    stream = io.BytesIO()
    np.save(stream, value)
    return stream.getvalue()


WRITTEN = {
    "capture": (lambda path: capture().write(path), tt.nlos.Capture.read),
    "volume": (lambda path: tt.nlos.write_volume(path, volume()), tt.nlos.read_volume),
}


@pytest.mark.parametrize("name", WRITTEN)
def test_zip_files_of_other_programs(tmp_path, name):
    write, read = WRITTEN[name]
    entries = members(write(tmp_path / "a.npz"))
    expected = read(tmp_path / "a.npz")
    assert str(read(packed(tmp_path / "b.npz", entries, zipfile.ZIP_DEFLATED))) == str(expected)
    for method in (zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2):
        with pytest.raises(StorageError, match=r"Use np\.savez"):
            read(packed(tmp_path / "c.npz", entries, method))
    # An array that declares what nobody stored.
    big = next(one for one in entries if one in ("transient.npy", "values.npy"))
    shape = b"'shape': (" + str(np.load(io.BytesIO(entries[big])).shape[0]).encode()
    changed = entries[big].replace(shape, b"'shape': (9000000000", 1)
    with pytest.raises(StorageError):
        read(packed(tmp_path / "d.npz", entries | {big: changed}))


@pytest.mark.parametrize("ending", ["h5", "npz"])
@pytest.mark.parametrize("name", WRITTEN)
def test_the_memory_that_is_left(tmp_path, monkeypatch, ending, name):
    write, read = WRITTEN[name]
    path = write(tmp_path / f"a.{ending}")
    monkeypatch.setattr(hdf5, "_LARGE_BYTES", 100)
    monkeypatch.setattr(hdf5, "available_memory", lambda *_: 300)
    with pytest.raises(StorageError, match="of memory are left"):
        read(path)


@pytest.mark.parametrize("name", WRITTEN)
def test_what_others_put_beside_is_left_alone(tmp_path, name):
    write, read = WRITTEN[name]
    expected = read(write(tmp_path / "a.h5"))
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file.create_group("theirs")["x"] = 1.0
        file["linked"] = h5py.ExternalLink("/etc/passwd", "x")
        file.attrs["notes"] = ["a", "b"]
    assert str(read(tmp_path / "a.h5")) == str(expected)
    entries = members(write(tmp_path / "a.npz")) | {"theirs.npy": b"no array", "README": b"a text"}
    assert str(read(packed(tmp_path / "b.npz", entries))) == str(expected)


@pytest.mark.parametrize("name", WRITTEN)
def test_bytes_in_the_other_order(tmp_path, name):
    write, read = WRITTEN[name]
    entries = members(write(tmp_path / "a.npz"))
    turned = {}
    for entry, data in entries.items():
        array = np.load(io.BytesIO(data))
        turned[entry] = as_npy(array.astype(array.dtype.newbyteorder(">")))
    expected, found = read(tmp_path / "a.npz"), read(packed(tmp_path / "b.npz", turned))
    for kind in ("transient", "values"):
        if hasattr(expected, kind):
            assert torch.equal(getattr(expected, kind), getattr(found, kind))


WRONG = {
    "capture": {
        "first_and_last_leg": ("False", np.nan, 2, [0, 1]), "polarized": ("True", -1), "num_bins": (7.5, "7", [7, 7]),
        "start_opl": ("0.5", np.inf, 1j), "channels": ('"a"', "[1]", "{}", 5), "metadata": ("[1]", "5", 5),
        "kind": (3,),
    },
    "volume": {"metadata": ("[1]", 5), "method": (5,)},
}  # fmt: skip


@pytest.mark.parametrize(("name", "entry"), [(name, entry) for name in WRONG for entry in WRONG[name]])
def test_entries_that_are_something_else(tmp_path, name, entry):
    write, read = WRITTEN[name]
    entries = members(write(tmp_path / "a.npz"))
    for value in WRONG[name][entry]:
        with pytest.raises(StorageError, match="is damaged"):
            read(packed(tmp_path / "b.npz", entries | {f"{entry}.npy": as_npy(np.array(value))}))
        write(tmp_path / "a.h5")
        with h5py.File(tmp_path / "a.h5", "a") as file:
            file.attrs[entry] = value
        with pytest.raises(StorageError):
            read(tmp_path / "a.h5")


# ------------------------------------------------------------------------------------------------------- before writing


@pytest.mark.parametrize("metadata", [{1: "a"}, {"a": {2.0: 1}}, {"a": [{None: 1}]}, {"a": {True: 1}}, {"a": {1, 2}}])
def test_names_in_metadata_are_texts(tmp_path, metadata):
    """JSON would make texts of them, two of the same one."""
    assert json.loads(json.dumps({1: "a", "1": "b"})) == {"1": "b"}
    with pytest.raises(StorageError, match="metadata"):
        replace(capture(), metadata=metadata)
    with pytest.raises(StorageError, match="metadata"):
        tt.nlos.write_capture(tmp_path / "a.h5", capture(), metadata)
    with pytest.raises(StorageError, match="metadata"):
        replace(volume(), metadata=metadata)


def test_tensors_without_numbers_in_memory(tmp_path):
    sparse = capture().transient.to_sparse()
    with pytest.raises(ShapeError, match="dense"):
        replace(capture(), transient=sparse)
    with pytest.raises(StorageError, match="to_dense"):
        tt.nlos.write_volume(tmp_path / "a.h5", replace(volume(), values=volume().values.to_sparse()))
    meta = capture().to("meta")
    for layout in ("torchtransient", "tal", "zaragoza", "dirac"):
        with pytest.raises(StorageError, match="meta"):
            meta.write(tmp_path / "a.h5", format=layout)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"times": 5}, ShapeError, "times"), ({"times": [1.0, 2.0]}, ShapeError, "times"),
        ({"times": torch.zeros(3, 2)}, ShapeError, "times"),
        ({"times": torch.tensor([torch.nan])}, UnitError, "finite"),
        ({"directions": torch.zeros(7, 3, 4, 5, 6)}, ShapeError, "one for each of the values"),
        ({"values": torch.zeros(0, 1, 4, 5, 6)}, ShapeError, "values"), ({"method": 5}, ArgumentError, "method"),
        ({"method": "a\0b"}, ArgumentError, "method"), ({"values": torch.ones(1, 4, 5, 6) > 0}, ShapeError, "values"),
    ],
)  # fmt: skip
def test_what_is_no_volume(changes, error, words):
    with pytest.raises(error, match=words):
        replace(volume(), **changes)
