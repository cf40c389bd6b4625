"""Shards: what is written is read, bytes are a function of the samples, nothing half written appears; those that are
damaged or made to harm give StorageError, in little memory, and read nothing else.
"""

from __future__ import annotations

import fcntl
import functools
import hashlib
import json
import os
import resource
import sys
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from support.marks import long_pairs
from support.stored_samples import cube, header, sample, write
from torchtransient.data import Shard, ShardWriter, verify
from torchtransient.data.shard_format import chunk_shape
from torchtransient.errors import ArgumentError, MissingPackageError, StorageError


def digest(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.parametrize("compression", ["blosc2", "gzip", "none"])
def test_what_is_written_is_read(tmp_path, compression):
    samples = [sample(i) for i in range(3)]
    with Shard(write(tmp_path / "a.h5", samples, compression=compression)) as shard:
        assert shard.header == header() and shard.index == {0: 0, 1: 1, 2: 2} and shard.failed == {}
        assert shard.names == tuple(sorted(samples[0].arrays))
        for row, made in enumerate(samples):
            for name, array in made.arrays.items():
                found = shard.read(name, row)
                assert found.dtype == array.dtype and np.array_equal(found, array)
            values = shard.values(row)
            assert values["box.filename"] == made.values["box.filename"] and values["count"] == row
            assert np.array_equal(values["red.reflectance.value"], made.values["red.reflectance.value"])
            assert shard.seeds[row] == made.seed and tuple(shard.outside[row]) == made.outside
        assert shard.structure == ["structure 0", "structure 1", "structure 0"]
        assert shard.verify() is None


COMPRESSIONS = ("blosc2", "gzip", "none")
STORES = ("exact", "rounded", "counts")


@pytest.mark.parametrize(
    ("compression", "store"),
    long_pairs(COMPRESSIONS, STORES, [(name, STORES[number % 3]) for number, name in enumerate(COMPRESSIONS)]),
)
def test_bytes_do_not_tell_the_order(tmp_path, store, compression):
    samples = [sample(i, counts=store == "counts") for i in range(4)]
    for k in (2, 3):  # counts that need wider types, at different places
        if store == "counts":
            samples[k].arrays["measurement"][0, 0, 0, 0] = 100 ** (k - 1)
    samples[1] = ValueError("no light")
    found = set()
    for number, rows in enumerate([[0, 1, 2, 3], [3, 2, 1, 0], [2, 0, 3, 1]]):
        found.add(digest(write(tmp_path / f"{number}.h5", samples, store, compression, rows)))
        time.sleep(0.02)
    assert len(found) == 1


def test_bytes_do_not_tell_the_environment(tmp_path, monkeypatch):
    samples = [sample(0, (1, 256, 32, 32))]
    before = digest(write(tmp_path / "a.h5", samples))
    settings = {"BLOSC_NTHREADS": "2", "BLOSC_CLEVEL": "9"}
    for name, value in settings.items():
        monkeypatch.setenv(name, value)
    assert digest(write(tmp_path / "b.h5", samples)) == before
    assert {name: os.environ[name] for name in settings} == settings


def test_failures_are_named(tmp_path):
    samples = [sample(0), ValueError("the box left the room"), sample(2)]
    with Shard(write(tmp_path / "a.h5", samples)) as shard:
        assert shard.index == {0: 0, 2: 2} and shard.failed == {1: "the box left the room"}
        for call in (lambda: shard.read("transient", 1), lambda: shard.values(1)):
            with pytest.raises(StorageError, match="the box left the room"):
                call()
        assert np.array_equal(shard.read("depth", 2), samples[2].arrays["depth"])
    with Shard(write(tmp_path / "a.h5", [ValueError("a"), ValueError("b")])) as shard:
        assert shard.index == {} and shard.names == () and shard.failed == {0: "a", 1: "b"}
        with pytest.raises(StorageError, match="no sample at all"):
            shard.shape("transient")


@pytest.mark.parametrize(
    ("arrays", "values", "message"),
    [
        ({"transient": cube(1)[:, :-1]}, {}, "'transient' as in"),
        ({"depth": np.zeros((16, 16))}, {}, "'depth' as in"),
        ({"another": np.zeros((16, 16))}, {}, "expected arrays"),
        ({}, {"new": 1}, "expected values"),
        ({}, {"count": "many"}, "expected values"),
        ({"depth": np.array(["a"])}, {}, "array of numbers"),
        ({"depth": np.zeros((0, 3))}, {}, "array of numbers"),
        ({"depth": np.zeros(3, np.clongdouble)}, {}, "array of numbers"),
    ],
)
def test_samples_of_a_recipe_are_alike(tmp_path, arrays, values, message):
    other = sample(1)
    other.arrays.update(arrays)
    other.values.update(values)
    with pytest.raises(StorageError, match=message):
        write(tmp_path / "a.h5", [sample(0), other])
    assert list(tmp_path.iterdir()) == []


def test_what_shards_are_made_of(tmp_path):
    with pytest.raises(StorageError, match="expected a sample with arrays, got none"):
        write(tmp_path / "a.h5", [replace(sample(0), arrays={})])
    path = write(tmp_path / "a.h5", [replace(sample(0), arrays={"line": np.arange(3.0)}, values={})])
    with Shard(path) as shard:
        assert shard.read("line", 0).tolist() == [0, 1, 2] and shard.values(0) == {}
        with pytest.raises(StorageError, match=r"'line' \(3,\) has no rows and columns; read all of it"):
            shard.read("line", 0, pixels=(slice(0, 1), slice(0, 1)))
        for row in (1, -1, 0.5):
            with pytest.raises(StorageError, match="expected a row from 0 to 0, got"):
                shard.read("line", row)


def test_rows_come_once(tmp_path):
    def put(rows):
        with ShardWriter(tmp_path / "a.h5", 2, header()) as shard:
            for row in rows:
                shard.put(row, sample(row))

    for rows, message in (([0, 0], "was put before"), ([0], r"\[1\] were neither"), ([0, 2], "from 0 to 1, got 2")):
        with pytest.raises(StorageError, match=message):
            put(rows)
    with pytest.raises(StorageError, match="every sample once"):
        write(tmp_path / "a.h5", [sample(3), sample(3)])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"rows": 0}, StorageError, "rows"),
        ({"store": "lossy"}, ArgumentError, "store"), ({"compression": "zip"}, ArgumentError, "compression"),
        ({"header": {"a": object()}}, StorageError, "plain data"),
        ({"header": {"a": float("nan")}}, StorageError, "plain data"),
        ({"path": "missing/a.h5"}, StorageError, "does not exist"), ({"path": "."}, StorageError, "folder"),
    ],
)  # fmt: skip
def test_arguments(tmp_path, monkeypatch, arguments, error, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(error, match=message):
        ShardWriter(**{"path": "a.h5", "rows": 1, "header": {}, **arguments})
    assert list(tmp_path.iterdir()) == []


def test_a_shard_that_is_there_is_replaced_at_the_end(tmp_path):
    path = write(tmp_path / "a.h5", [sample(0)])
    before = digest(path)

    def fail(error):
        with ShardWriter(path, 2, header()) as shard:
            shard.put(0, sample(0))
            assert len(list(tmp_path.iterdir())) == 2
            raise error

    for error in (OSError("texture missing"), KeyboardInterrupt(), ValueError("x")):
        with pytest.raises(type(error)) as found:
            fail(error)
        assert found.value is error and digest(path) == before and list(tmp_path.iterdir()) == [path]
    write(path, [sample(1)])
    assert digest(path) != before and list(tmp_path.iterdir()) == [path]


def test_a_shard_is_read_beside_its_writer_and_other_readers(tmp_path):
    """A lock that is held for a moment is waited for, and other readers of HDF5 read it too."""
    write(tmp_path / "a.h5", [sample(0), sample(1)])
    with open(tmp_path / "a.h5", "rb") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        threading.Timer(0.05, fcntl.flock, (held, fcntl.LOCK_UN)).start()
        with Shard(tmp_path / "a.h5") as shard, h5py.File(tmp_path / "a.h5", "r") as file:
            assert list(file["index"]) == list(shard.index)


def test_windows_and_pixels(tmp_path):
    x = cube(0)
    with Shard(write(tmp_path / "a.h5", [sample(0)])) as shard:
        found = shard.read("transient", 0, window=slice(100, 164), pixels=(slice(2, 4), slice(5, None)))
        assert np.array_equal(found, x[:, 100:164, 2:4, 5:])
        assert np.array_equal(shard.read("depth", 0, pixels=(slice(3, 5), slice(None))), sample(0).arrays["depth"][3:5])
        outside = (slice(16, 17), slice(None))
        for arguments in ({"window": slice(5, 5)}, {"window": slice(0, 9, 2)}, {"pixels": outside}):
            with pytest.raises(StorageError, match="some of"):
                shard.read("transient", 0, **arguments)
        for name, message in (("none", "has no 'none'"), ("depth", "no time axis")):
            with pytest.raises(StorageError, match=message):
                shard.read(name, 0, window=slice(0, 1))


@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        ((1, 1024, 32, 32), (1, 32, 32, 32)), ((1, 1024, 8, 8), (1, 1024, 8, 8)),
        ((1, 2048, 8, 8), (1, 256, 8, 8)), ((1, 1024, 4096), (1, 32, 4096)), ((3, 999, 999), (3, 32, 999)),
        ((1, 1024, 4, 4, 32, 32), (1, 32, 4, 4, 32, 32)),
        ((3, 1024, 256, 256), (3, 32, 42, 256)), ((), ()), ((16, 16), (16, 16)), ((4096, 4096), (256, 4096)),
        ((4, 3, 1000, 64, 64), (4, 3, 32, 42, 64)), ((10**7,), (1048576,)),
    ],
)  # fmt: skip
def test_chunks(shape, expected):
    found = chunk_shape(shape)
    assert found == expected
    assert 4 * np.prod(found) <= 2**22 and (4 * np.prod(shape) <= 2**18 or 4 * np.prod(found) >= 2**16)


# ----------------------------------------------------------------------------------------------------- shards of others


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
