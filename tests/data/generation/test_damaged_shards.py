"""Shards that are damaged, or are others than their names say, are made again by `generate`, byte for byte."""

from __future__ import annotations

import json
import os
import shutil

import pytest

from support.fake_recipe import FakeRecipe
from support.generation_runs import data_files
from support.stored_samples import sample
from torchtransient.data import Shard, ShardWriter, generate, verify
from torchtransient.errors import StorageError

SMALL = {"n": 7, "per_shard": 2, "progress": False, "compression": "none", "workers": 0}
RECIPE = FakeRecipe(shape=(1, 4, 2, 3))
NAMES = [f"shard-{number:06d}.h5" for number in range(4)]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("damaged") / "set"
    generate(RECIPE, folder, **SMALL)
    return folder


@pytest.fixture
def folder(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "set")


def flip(path, place=0.9):
    raw = bytearray(path.read_bytes())
    raw[int(place * len(raw))] ^= 4
    path.write_bytes(raw)


def flip_in_header(folder):
    """In the key of its recipe, which another data set would have, too."""
    path = folder / NAMES[1]
    with Shard(path) as shard:
        key = json.dumps(shard.header["key"]).encode()
    raw = bytearray(path.read_bytes())
    raw[raw.index(key) + 2] ^= 1
    path.write_bytes(raw)


def cut(folder, left_out):
    os.truncate(folder / NAMES[1], (folder / NAMES[1]).stat().st_size - left_out)


@pytest.mark.slow
@pytest.mark.parametrize(
    "damage",
    [
        lambda folder: cut(folder, 1),
        lambda folder: shutil.copy(folder / NAMES[2], folder / NAMES[1]),
        lambda folder: shutil.copy(folder / NAMES[3], folder / NAMES[1]),
        lambda folder: flip(folder / NAMES[1], 0.99999),
    ],
    ids=["cut by 1", "another shard", "a shorter shard", "its checksum"],
)
def test_what_is_seen_at_once(whole, folder, damage):
    damage(folder)
    made_again(whole, folder)
    lines = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    assert [line["shard"] for line in lines if line["event"] == "damaged"] == [1]


def made_again(whole, folder):
    """The shard with the number 1, and no other one."""
    done = generate(RECIPE, folder, **SMALL)
    assert (done.samples, done.kept) == (2, 5) and data_files(folder) == data_files(whole)
    assert verify(folder).complete


@pytest.mark.parametrize("change", [lambda folder: flip(folder / NAMES[1]), flip_in_header])
def test_what_verify_has_found(whole, folder, change):
    change(folder)
    assert verify(folder).damaged == (NAMES[1],)
    made_again(whole, folder)


@pytest.mark.parametrize("manifest", [None, '{"shards": {"shard-000001.h5": 5}}'])
def test_bytes_are_compared_without_a_manifest(whole, folder, manifest):
    flip(folder / NAMES[1])
    (folder / "manifest.json").unlink()
    if manifest is not None:
        (folder / "manifest.json").write_text(manifest)
    assert generate(RECIPE, folder, **SMALL).kept == 5 and data_files(folder) == data_files(whole)


def test_no_shard_is_sound(whole, folder):
    """The manifest names none of them any more."""
    for name in NAMES:
        flip(folder / name)
    assert verify(folder).damaged == tuple(NAMES)
    assert json.loads((folder / "manifest.json").read_text())["shards"] == {}
    assert generate(RECIPE, folder, shard=(0, 2), **SMALL).kept == 0
    assert list(json.loads((folder / "manifest.json").read_text())["shards"]) == NAMES[::2]
    assert generate(RECIPE, folder, **SMALL).kept == 4 and data_files(folder) == data_files(whole)


def test_shards_of_other_shares_stay_out_of_the_manifest(whole, folder):
    """What verify has found there is for the run whose share it is."""
    flip(folder / NAMES[1])
    verify(folder)
    assert generate(RECIPE, folder, shard=(0, 2), **SMALL).kept == 4
    assert list(json.loads((folder / "manifest.json").read_text())["shards"]) == [NAMES[0], *NAMES[2:]]
    done = generate(RECIPE, folder, shard=(1, 2), **SMALL)
    assert (done.samples, done.kept) == (2, 1) and data_files(folder) == data_files(whole)


def test_shards_of_other_versions_of_packages(folder):
    """They are sound, and are not replaced."""
    with Shard(folder / NAMES[1]) as shard:
        header = shard.header
    with ShardWriter(folder / NAMES[1], 2, header | {"about": {"spp": 1}, "shard": 2}, compression="none") as writer:
        for row in range(2):
            writer.put(row, sample(2 + row))
    before = (folder / NAMES[1]).read_bytes()
    with pytest.raises(StorageError, match=rf"{NAMES[1]}' is of this recipe and differs in 'about', as when"):
        generate(RECIPE, folder, **SMALL)
    assert (folder / NAMES[1]).read_bytes() == before
