"""The manifest is told by the shards alone; every fault of a shard is found."""

from __future__ import annotations

import json
import os
import re
import shutil

import h5py
import numpy as np
import pytest

from support.stored_samples import folder, header, sample, write
from torchtransient.data import Shard, build_manifest, verify
from torchtransient.errors import StorageError


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    return folder(tmp_path_factory.mktemp("written") / "set")


@pytest.fixture
def data(written, tmp_path):
    return shutil.copytree(written, tmp_path / "set")


def test_a_manifest_of_its_shards(data, tmp_path):
    manifest = build_manifest(data)
    assert manifest == json.loads((data / "manifest.json").read_text())
    assert manifest["samples"] == 10 and manifest["key"] == "abc123" and manifest["about"]["spp"] == 16
    assert manifest["arrays"]["transient"] == {"shape": [1, 256, 16, 16], "dtype": "float32", "encoding": "exact"}
    last = manifest["shards"]["shard-000002.h5"]
    assert last["index"] == [[8, 9]] and last["seeds"] == [8 * 7919, 9 * 7919]
    assert last["bytes"] == (data / "shard-000002.h5").stat().st_size
    assert manifest["standard_error"] == {"least": 0.25, "most": 0.25} and manifest["outside"] == [0.01, 4.5]
    # Equal shards have equal manifests.
    build_manifest(folder(tmp_path / "other"))
    assert (data / "manifest.json").read_bytes() == (tmp_path / "other" / "manifest.json").read_bytes()
    report = verify(data)
    assert report.complete and report.samples == 10 and report.shards == 3 and report.faults == {}
    assert str(report) == f"{data}: 10 samples in 3 shards, 0 failed"


def test_failures_are_told(data):
    write(data / "shard-000000.h5", [sample(0), ValueError("dark"), sample(2), sample(3)])
    assert build_manifest(data)["failed"] == {"1": "dark"}
    report = verify(data)
    assert report.complete and report.failed == {1: "dark"} and report.samples == 9
    # Shards without samples belong to all.
    write(data / "shard-000000.h5", [StorageError("no light")] * 4, shard=0)
    found = verify(data)
    assert found.samples == 6 and sorted(found.failed) == [0, 1, 2, 3] and found.damaged == ()


def damaged(data, change):
    """A manifest of sound shards, of which the second one is changed."""
    build_manifest(data)
    path = data / "shard-000001.h5"
    raw = bytearray(path.read_bytes())
    change(raw)
    path.write_bytes(raw)
    report = verify(data)
    assert report.damaged == (path.name,) and report.missing == (4, 5, 6, 7) and not report.complete
    assert "manifest.json" in report.faults  # which told of a shard that is not sound
    return path


def test_damaged_shards(data):
    """Chunks carry a checksum of their own, too: a reader of single samples sees damage."""
    with h5py.File(data / "shard-000001.h5") as file:
        place = file["arrays/transient"].id.get_chunk_info(0).byte_offset + 1000
    path = damaged(data, lambda raw: raw.__setitem__(place, raw[place] ^ 1))
    with Shard(path) as shard, pytest.raises(StorageError, match="damaged"):
        shard.read("transient", 0)
    assert verify(data).damaged == (path.name,) and "manifest.json" not in verify(data).faults
    os.truncate(path, path.stat().st_size - 5000)
    with pytest.raises(StorageError):
        build_manifest(data)
    assert verify(data).damaged == (path.name,)


@pytest.mark.slow
def test_every_byte_counts(tmp_path):
    """A change of any byte of a small shard is found."""
    path = write(tmp_path / "shard-000000.h5", [sample(0, (1, 4, 2, 2))])
    raw = path.read_bytes()
    for place in range(0, len(raw), 23):
        changed = bytearray(raw)
        changed[place] ^= 1 << place % 8
        path.write_bytes(changed)
        assert "shard-000000.h5" in verify(tmp_path).faults, place


def test_other_recipes_and_doubled_samples(data):
    write(data / "shard-000001.h5", [sample(i) for i in range(4, 8)], key="other", shard=1)
    report = verify(data)
    assert "another recipe" in report.faults["shard-000001.h5"][0] and report.missing == (4, 5, 6, 7)
    with pytest.raises(StorageError, match="another recipe"):
        build_manifest(data)
    write(data / "shard-000001.h5", [sample(i) for i in range(2, 6)], shard=1)
    report = verify(data)
    assert "holds the samples 2 to 3, which shard-000000.h5 holds too" in report.faults["shard-000001.h5"][0]
    assert report.missing == (4, 5, 6, 7)


def test_the_recipe_of_the_folder_decides(data):
    (data / "recipe.json").write_text(json.dumps({"key": "theirs", "n": 12}))
    report = verify(data)
    assert len(report.damaged) == 3 and report.missing == tuple(range(12))
    (data / "recipe.json").write_text(json.dumps({"key": "abc123", "n": 12}))
    report = verify(data)
    assert report.faults == {} and report.missing == (10, 11) and "10 to 11" in str(report)


def test_missing_shards_and_other_names(data):
    (data / "shard-000000.h5").unlink()
    assert verify(data).missing == (0, 1, 2, 3)
    shutil.copy(data / "shard-000001.h5", data / "shard-000000.h5")
    report = verify(data)
    assert "shard 1 under another name" in report.faults["shard-000000.h5"][0]


def test_other_manifests(data):
    (data / "manifest.json").write_text("{}\n")
    assert "manifest.json" in verify(data).faults
    assert "manifest.json" not in verify(data).faults


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda one: one.arrays.pop("normals"), "arrays: normals: None, expected"),
        (lambda one: one.arrays.update(depth=np.ones((16, 16))), "arrays: depth: dtype: 'float64', expected 'float32'"),
        (lambda one: one.arrays.update(steady=one.arrays["steady"][..., :8]), r"arrays: steady: shape: \[1, 16, 8\]"),
        (lambda one: one.values.update(more=1.0), "values: .*more"),
        (None, "store: 'rounded', expected 'exact'"),
    ],
)
def test_shards_of_other_samples(data, change, words):
    """Of one key, and not of one kind."""
    samples = [sample(i) for i in range(4, 8)]
    for one in samples if change else ():
        change(one)
    write(data / "shard-000001.h5", samples, "exact" if change else "rounded", shard=1)
    found = verify(data)
    assert not found.complete and found.damaged == ("shard-000001.h5",) and found.missing == (4, 5, 6, 7)
    assert re.search(f"differs from the data set in {words}", found.faults["shard-000001.h5"][0])
    with pytest.raises(StorageError, match="differs from the data set"):
        build_manifest(data)


def test_shards_of_other_code(data):
    """The first shard is the one that differs: what recipe.json says counts."""
    about = header()["about"]
    write(data / "shard-000000.h5", [sample(i) for i in range(4)], shard=0, about=about | {"versions": {"torch": "3"}})
    found = verify(data)
    assert not found.complete and "about: versions: torch: '2', expected '3'" in found.faults["shard-000001.h5"][0]
    (data / "recipe.json").write_text(json.dumps({"key": "abc123", "n": 10, "about": about}))
    found = verify(data)
    assert found.damaged == ("shard-000000.h5",) and "versions: torch: '3'" in found.faults["shard-000000.h5"][0]


def test_folders(tmp_path, capsys):
    with pytest.raises(StorageError, match="expected the folder"):
        verify(tmp_path / "none")
    with pytest.raises(StorageError, match="holds no shard"):
        build_manifest(tmp_path)
    assert verify(tmp_path).samples == 0
    verify(folder(tmp_path / "set", 2), progress=True)
    assert "verify" in capsys.readouterr().err


def test_numbers_of_samples_that_are_none(tmp_path):
    """A hundred million that are missing are no data set; a manifest that is no text is none."""
    place = folder(tmp_path / "set", 2)
    for n, words in ((10**8 + 3, "recipe.json' counts 100000003 samples, and 2 are there"), (10**12, "counts")):
        (place / "recipe.json").write_text(json.dumps({"key": "abc123", "n": n}))
        with pytest.raises(StorageError, match=words):
            verify(place)
    (place / "recipe.json").unlink()
    write(place / "shard-000009.h5", [sample(10**8 + 4)], shard=9)
    with pytest.raises(StorageError, match="the numbers of its samples ask for 100000005 samples, and 3 are there"):
        verify(place)
    (place / "shard-000009.h5").unlink()
    (place / "manifest.json").write_bytes(b"\xff\xfe\xff")
    with pytest.raises(StorageError, match=r"manifest\.json' cannot be read"):
        verify(place)
