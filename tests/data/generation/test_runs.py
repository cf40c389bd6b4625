"""Runs of `generate` in this process: what is made, kept and made again byte for byte, and what is said of it."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace

import pytest
from click.testing import CliRunner

from support.fake_recipe import FakeRecipe
from support.generation_runs import damage, data_files, leftovers
from support.stored_samples import sample
from torchtransient.__main__ import main
from torchtransient.data import Shard, ShardWriter, generate, verify
from torchtransient.errors import SceneError, StorageError

SMALL = {"n": 7, "per_shard": 2, "progress": False, "compression": "none", "workers": 0}
RECIPE = FakeRecipe(shape=(1, 4, 2, 3))
NAMES = [f"shard-{number:06d}.h5" for number in range(4)]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "set"
    done = generate(RECIPE, folder, **SMALL)
    assert (done.samples, done.failed, done.kept, done.restarts, done.shards) == (7, 0, 0, 0, 4)
    assert done.bytes == sum(path.stat().st_size for path in folder.glob("*.h5")) and done.folder == folder
    assert "7 samples in 4 shards" in str(done)
    return folder


def events(folder, *names):
    found = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    return [event for event in found if not names or event["event"] in names]


def copied(whole, folder, *numbers):
    folder.mkdir()
    for number in numbers:
        shutil.copy(whole / NAMES[number], folder)
    return folder


# -------------------------------------------------------------------------------------------------- what is made


def test_a_run_and_its_log(whole):
    assert verify(whole).complete and verify(whole).samples == 7 and leftovers(whole) == []
    first, *shards, last = events(whole)
    assert (first["event"], first["n"], first["workers"], first["engine"]) == ("begin", 7, 0, "local")
    assert [one["shard"] for one in shards] == [0, 1, 2, 3] and {one["event"] for one in shards} == {"shard"}
    assert (last["event"], last["samples"], last["shards"], last["failed"]) == ("end", 7, 4, 0)


def test_two_shares_are_the_whole(whole, tmp_path):
    first = generate(RECIPE, tmp_path, shard=(1, 2), **SMALL)
    assert (first.samples, first.shards, first.kept) == (3, 2, 0)
    assert sorted(path.name for path in tmp_path.glob("*.h5")) == ["shard-000001.h5", "shard-000003.h5"]
    second = generate(RECIPE, tmp_path, shard=(0, 2), **SMALL)
    assert (second.samples, second.kept) == (4, 0) and data_files(tmp_path) == data_files(whole)


def test_going_on(whole, tmp_path):
    """What is missing or damaged is made, everything else stays; also without what the first call said."""
    folder = tmp_path / "set"
    generate(RECIPE, folder, **SMALL)
    stamp = (folder / "shard-000003.h5").stat().st_mtime_ns
    damage(folder)
    done = generate(RECIPE, folder, **SMALL | {"per_shard": None})
    assert (done.samples, done.kept, done.shards) == (4, 3, 2)
    assert data_files(folder) == data_files(whole) and leftovers(folder) == []
    assert (folder / "shard-000003.h5").stat().st_mtime_ns == stamp
    lines = (folder / "log.jsonl").read_text().splitlines()
    assert [line for line in lines if not line.endswith("}")] == ['{"half']
    assert [json.loads(line)["shard"] for line in lines if '"damaged"' in line] == [2]
    again = generate(RECIPE, folder, **SMALL)
    assert (again.samples, again.kept, again.shards) == (0, 7, 0)


# ---------------------------------------------------------------------------------------------- what does not fit


def test_shards_that_do_not_fit(whole, tmp_path):
    """What the shards say counts where recipe.json was lost; what does not open says nothing."""
    folder = copied(whole, tmp_path / "set", 1)
    with pytest.raises(StorageError, match=r"shard-000001\.h5' belongs to another data set: its recipe is another"):
        generate(replace(RECIPE, seed=1), folder, **SMALL)
    with pytest.raises(StorageError, match="has a data set, and resume=False"):
        generate(RECIPE, folder, resume=False, **SMALL)
    assert generate(RECIPE, folder, **SMALL).kept == 2 and data_files(folder) == data_files(whole)
    # Others are not put beside them.
    (folder / "shard-000003.h5").unlink()
    with pytest.raises(StorageError, match=r"versions is .'fake': '1'. there and .'fake': '2'. here"):
        generate(replace(RECIPE, versions={"fake": "2"}), folder, **SMALL)
    assert not (folder / "shard-000003.h5").exists()
    # A run of an earlier format left out samples.
    described = (whole / "recipe.json").read_text()
    (folder / "recipe.json").write_text(described.replace("data set 2", "data set"))
    with pytest.raises(StorageError, match="format is 'torchtransient data set' there"):
        generate(RECIPE, folder, **SMALL)
    (folder / "shard-000000.h5").write_bytes(b"no shard")
    (folder / "recipe.json").unlink()
    assert generate(RECIPE, folder, **SMALL).samples == 3 and data_files(folder) == data_files(whole)


def test_a_run_that_is_stopped(whole, tmp_path, monkeypatch):
    """In the middle of a shard: finished ones stay, nothing is half-written; the same call goes on."""
    make = RECIPE.maker().__class__.sample

    def interrupted(self, index):
        if index == 3:
            raise KeyboardInterrupt
        return make(self, index)

    monkeypatch.setattr("support.fake_recipe.FakeMaker.sample", interrupted)
    with pytest.raises(KeyboardInterrupt):
        generate(RECIPE, tmp_path, **SMALL)
    assert [path.name for path in tmp_path.glob("*.h5")] == ["shard-000000.h5"] and leftovers(tmp_path) == []
    assert events(tmp_path)[-1]["event"] == "stopped" and not (tmp_path / "manifest.json").exists()
    monkeypatch.undo()
    assert generate(RECIPE, tmp_path, **SMALL).kept == 2 and data_files(tmp_path) == data_files(whole)


def test_samples_that_fail(whole, tmp_path):
    recipe = replace(RECIPE, raising=(0, 3), late=(5,))
    done = generate(recipe, tmp_path, retries=1, **SMALL)
    assert (done.samples, done.failed, done.kept) == (5, 2, 0)
    reason = "SceneError: sample {} cannot be made by <object at 0x...>"
    assert verify(tmp_path).failed == {0: reason.format(0), 3: reason.format(3)}
    assert [one["sample"] for one in events(tmp_path, "failed")] == [0, 3]
    # Sample 0 is tried first where it is measured, too.
    assert [one["sample"] for one in events(tmp_path, "retry")] == [0, 0, 3]
    again = generate(recipe, tmp_path, retries=1, **SMALL)
    assert (again.kept, again.samples, again.failed) == (5, 0, 0)
    for n, last in ((7, 6), (40, 15)):
        with pytest.raises(SceneError, match=rf"none of the samples 0 to {last} .* SceneError: sample {last} "):
            generate(replace(RECIPE, raising=tuple(range(n))), tmp_path / "none", **SMALL | {"n": n})


# ------------------------------------------------------------------------------------------- recipe.json, and words


@pytest.mark.parametrize("content", [b"[1]", b'{"format": 0, "key": 1, "n": 2}', b"\xff"])
def test_recipe_json_that_is_none(tmp_path, content):
    (tmp_path / "recipe.json").write_bytes(content)
    with pytest.raises(StorageError, match=r"recipe\.json"):
        generate(RECIPE, tmp_path, **SMALL)


def test_summaries_of_folders(whole, tmp_path):
    """From the description, and without it from the shards."""

    def info(folder):
        result = CliRunner().invoke(main, ["dataset", "info", str(folder)])
        return result.stdout if result.exit_code == 0 else result.stderr

    size = sum(path.stat().st_size for path in whole.glob("*.h5")) / 1e6
    lines = info(whole).splitlines()
    assert lines[0] == f"{whole}: 7 of 7 samples in 4 shards, 0 failed, {size:.4g} MB"
    assert {"  depth: 2 x 3 float32", "  transient: 1 x 4 x 2 x 3 float32", "  values: albedo, name"} <= set(lines)
    alone = copied(whole, tmp_path / "set", 3)
    assert info(alone).splitlines()[1:] == lines[1:]
    described = json.loads((whole / "recipe.json").read_text())
    axis = {"start_opl": 1.5, "bin_width_opl": 0.25, "num_bins": 6}
    described["about"] |= {"axis": axis, "frequencies": {"per_metre": [2.0, 0.5, 3]}}
    (alone / "recipe.json").write_text(json.dumps(described))
    text = info(alone)
    assert "6 bins of 0.25 m of optical path, from 1.5 to 3 m" in text and "3 frequencies, 0.5 to 3 cycles" in text
    assert "holds no shard" in info(tmp_path)


# ---------------------------------------------------------------------------------------------------- damaged shards


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
    assert [event["shard"] for event in events(folder, "damaged")] == [1]


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
