"""Shards that are damaged or made to harm give StorageError, in little memory, and read nothing else."""

from __future__ import annotations

import functools
import json
import resource
import sys
import tempfile
from pathlib import Path

import h5py
import numpy as np
import pytest

from support.stored_samples import header, sample, write
from torchtransient.data import Shard, ShardWriter, verify
from torchtransient.errors import MissingPackageError, StorageError


@functools.cache
def two_samples():
    with tempfile.TemporaryDirectory() as folder:
        return write(Path(folder) / "a.h5", [sample(0), sample(1)]).read_bytes()


def changed(tmp_path, change):
    path = tmp_path / "a.h5"
    path.write_bytes(two_samples())
    with h5py.File(path, "r+") as file:
        change(file)
    return path


def replaced(name, **settings):
    def change(file):
        del file[name]
        file.create_dataset(name, **settings)

    return change


def about_changed(**entries):
    def change(file):
        about = {**json.loads(file["about"][:].tobytes()), **entries}
        del file["about"]
        file["about"] = np.frombuffer(json.dumps(about).encode(), np.uint8)

    return change


def linked(name, link):
    def change(file):
        del file[name]
        file[name] = link

    return change


CHUNKS = {"chunks": (1, 1, 256, 16, 16), "fletcher32": True}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (replaced("arrays/transient", shape=(2, 1, 2**30, 2**10, 64), dtype="f4", chunks=(1, 1, 32, 512, 64)), "store"),
        (replaced("arrays/transient", shape=(2, 1, 256, 16, 16), dtype="f4", **CHUNKS), "expected 2 chunks"),
        (replaced("arrays/transient", shape=(2, 1, 256, 16, 16), dtype="f4"), "expected chunks of"),
        (replaced("arrays/transient", data=np.zeros((2, 1, 256, 16, 16)), **CHUNKS, compression="lzf"), "filters"),
        (replaced("arrays/transient", data=np.zeros((3, 1, 256, 16, 16)), **CHUNKS), "missing or of another kind"),
        (replaced("arrays/transient", shape=(2, 4), dtype="u1", external=[("/etc/passwd", 0, 8)]), "in other files"),
        (linked("arrays/transient", h5py.ExternalLink("/etc/passwd", "/a")), "a link to elsewhere"),
        (linked("arrays/transient", h5py.SoftLink("/about")), "a link to elsewhere"),
        (linked("values/count", h5py.ExternalLink("other.h5", "/a")), "a link to elsewhere"),
        (linked("arrays", h5py.ExternalLink("other.h5", "/a")), "a link to elsewhere"),
        (replaced("about", shape=(2**40,), dtype="u1", chunks=(2**20,)), "declares"),
        (replaced("values/count", shape=(2, 2**40), dtype="f4", chunks=(1, 2**20)), "declares"),
        (replaced("index", data=np.zeros(2)), "missing or of another kind"),
        (replaced("index", data=np.zeros(2, np.int64)), "doubled or missing"),
        (replaced("there", data=np.zeros(5, np.uint8)), "rows disagree"),
        (about_changed(format="other 3"), "of format 'other 3'"),
        (about_changed(arrays={"transient": {"dtype": "f4"}}), "encoding"),
        (about_changed(failed=[[0, 5, "x"]]), "doubled or missing"),
        (about_changed(failed=3), "not iterable"),
        *((about_changed(**entry), "does not describe") for entry in (
            {"texts": {"a": ["x"]}}, {"texts": {"a": "xy"}}, {"texts": {"a": ["x", 3]}}, {"structure": "xy"},
            {"structure": ["x"] * 3}, {"store": 3}, {"arrays": {"transient": {"encoding": "half"}}},
            {"values": ["count", 3]}, {"header": "x"},
        )),
        (about_changed(values=["../../about"]), "expected a row of"),
        (replaced("about", data=np.frombuffer(b"[" * 100_000, np.uint8)), "damaged"),
    ],
)  # fmt: skip
def test_what_is_not_believed(tmp_path, change, message):
    path = changed(tmp_path, change)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    def read():
        with Shard(path) as shard:
            shard.values(0)
            shard.read("transient", 0)

    with pytest.raises(StorageError, match=message):
        read()
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024 < 100e6
    assert not verify(tmp_path).samples  # under a name of no shard


@pytest.mark.parametrize("content", [b"", b"x" * 100, b"\x89HDF\r\n\x1a\n" + bytes(200)])
def test_what_is_no_shard(tmp_path, content):
    path = tmp_path / "shard-000000.h5"
    path.write_bytes(content)
    with pytest.raises(StorageError, match="damaged"):
        Shard(path)
    assert verify(tmp_path).damaged == (path.name,)
    with h5py.File(path, "w") as file:
        file["x"] = 3
    with pytest.raises(StorageError, match="'about' is missing"):
        Shard(path)
    path.unlink()
    path.mkdir()
    with pytest.raises(StorageError, match="is a folder"):
        Shard(path)


@pytest.mark.parametrize(("package", "message"), [("hdf5plugin", "gzip"), ("h5py", "torchtransient")])
def test_without_packages(tmp_path, monkeypatch, package, message):
    path = write(tmp_path / "a.h5", [sample(0)])
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingPackageError, match=f"package {package}.*{message}"):
        ShardWriter(tmp_path / "b.h5", 1, header())
    with pytest.raises(MissingPackageError, match=f"package {package}"), Shard(path) as shard:
        shard.read("transient", 0)
    if package == "hdf5plugin":
        with Shard(write(path, [sample(0)], compression="gzip")) as shard:
            assert shard.read("transient", 0).shape == (1, 256, 16, 16)
