"""Data sets of a recipe that renders nothing: equal bytes however they are made, and what is not made says why."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import torchtransient as tt
from support.fake_recipe import FakeRecipe
from support.generation_runs import data_files, environment, finish, leftovers, start
from torchtransient.data import Shard, generate, verify
from torchtransient.errors import ArgumentError, MissingPackageError, SceneError, StorageError, UnitError


@dataclass(frozen=True)
class Deviceless(FakeRecipe):
    device: None = None


RECIPE = FakeRecipe()
QUICK = {"n": 23, "per_shard": 4, "progress": False}


@pytest.fixture(scope="module")
def calm(tmp_path_factory):
    """The data set as one worker makes it that nobody disturbs."""
    folder = tmp_path_factory.mktemp("calm") / "set"
    done = generate(RECIPE, folder, workers=1, **QUICK)
    assert (done.samples, done.failed, done.kept, done.restarts, done.shards) == (23, 0, 0, 0, 6)
    return folder


def events(folder):
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


def test_what_is_there(calm, tmp_path):
    """A worker's bytes are those of this process."""
    (tmp_path / "latest.png").mkdir()  # a picture that cannot be written is no reason to fail
    with tt.threads(2) as before:
        generate(RECIPE, tmp_path, workers=0, **QUICK)
        assert tt.threads() == before
    assert data_files(tmp_path) == data_files(calm)
    assert leftovers(calm) == []
    assert verify(calm).complete and verify(calm).samples == 23
    maker = RECIPE.maker()
    with Shard(calm / "shard-000002.h5") as shard:
        assert shard.header["samples"] == [8, 12] and shard.header["key"] == RECIPE.key()
        for index in range(8, 12):
            np.testing.assert_array_equal(
                shard.read("transient", shard.index[index]), maker.sample(index).arrays["transient"]
            )
    assert (calm / "latest.png").read_bytes().startswith(b"\x89PNG")


# ------------------------------------------------------------------------------------------------- samples that fail


@pytest.mark.slow
def test_what_fails_is_named(tmp_path, calm):
    """Every kind of failure in one run, of the first samples too; all other samples are there."""
    recipe = FakeRecipe(raising=(0, 3), crashing=(1, 7), dying=(12,), hanging=(18,))
    done = generate(recipe, tmp_path, timeout_s=1.5, retries=0, **QUICK)
    assert (done.samples, done.failed) == (17, 6) and done.restarts >= 4
    found = verify(tmp_path)
    assert found.complete and sorted(found.failed) == [0, 1, 3, 7, 12, 18]
    assert found.failed[3] == "SceneError: sample 3 cannot be made by <object at 0x...>"
    assert {found.failed[index] for index in (1, 7, 12, 18)} == {found.failed[7]} and "died" in found.failed[7]
    with Shard(tmp_path / "shard-000001.h5") as made, Shard(calm / "shard-000001.h5") as expected:
        assert sorted(made.index) == [4, 5, 6]
        for index, row in made.index.items():
            other = expected.read("transient", expected.index[index])
            np.testing.assert_array_equal(made.read("transient", row), other)
    ways = {(e["sample"], e["how"].split(" for")[0]) for e in events(tmp_path) if e["event"] == "death"}
    assert ways >= {(7, "by SIGSEGV"), (12, "by SIGKILL"), (18, "by no sign of life")}
    again = generate(recipe, tmp_path, timeout_s=1.5, retries=0, **QUICK)
    assert (again.kept, again.samples, again.failed) == (17, 0, 0)


@pytest.mark.slow
def test_what_passes_leaves_no_trace(tmp_path, calm):
    """What goes wrong once is tried again: the bytes are those of an undisturbed run."""
    notes = tmp_path / "notes"
    notes.mkdir()
    recipe = FakeRecipe(raising=(1, 3), crashing=(7,), dying=(12,), hanging=(18,), once=str(notes))
    done = generate(recipe, tmp_path / "set", timeout_s=1.5, **QUICK)
    assert (done.samples, done.failed, done.restarts) == (23, 0, 3) and len(list(notes.iterdir())) == 5
    assert data_files(tmp_path / "set") == data_files(calm)


@pytest.mark.slow
def test_no_sample_can_be_made(tmp_path):
    with pytest.raises(SceneError, match="no light in it") as caught:
        generate(FakeRecipe(unbuilt="no light in it"), tmp_path, **QUICK)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["log.jsonl"]
    # File and line, where it is raised and in the log.
    (said,) = (e["trace"] for e in events(tmp_path) if e["event"] == "error" and "no light" in e["error"])
    assert 'fake_recipe.py", line' in said and said in str(caught.value.__cause__)
    assert events(tmp_path)[-1]["event"] == "stopped"


# --------------------------------------------------------------------------------------------------------- arguments


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"n": 2.5}, UnitError, "n: expected"), ({"n": None}, ArgumentError, "how many"),
        ({"workers": -1}, UnitError, "workers"), ({"workers": 0, "engine": "ray"}, UnitError, "workers"),
        ({"per_shard": 0}, UnitError, "per_shard"), ({"shard": (2, 2)}, UnitError, "shard"),
        ({"retries": -1}, UnitError, "retries"),
        ({"timeout_s": 0}, UnitError, "timeout_s"), ({"timeout_s": float("nan")}, UnitError, "timeout_s"),
        ({"engine": "dask"}, ArgumentError, "engine"), ({"address": "auto"}, UnitError, "ray"),
        ({"store": "half"}, ArgumentError, "store"), ({"compression": "lzma"}, ArgumentError, "compression"),
        ({"recipe": Path("rec.yaml")}, ArgumentError, r"tt.data.Recipe.read"),
        ({"recipe": Deviceless(), "store": "counts"}, SceneError, "with a device"),
        ({"engine": "ray"}, MissingPackageError, "needs the package ray"),
        ({"folder": Path(__file__)}, StorageError, "cannot be made"),
    ],
)  # fmt: skip
def test_arguments(tmp_path, monkeypatch, changes, error, words):
    monkeypatch.setitem(sys.modules, "ray", None)
    given = {"recipe": RECIPE, "folder": tmp_path / "a", **QUICK, **changes}
    with pytest.raises(error, match=words):
        generate(given.pop("recipe"), given.pop("folder"), **given)
    assert not list(tmp_path.glob("a/shard*"))


def fails(tmp_path, text):
    """Last line of what a script says that fails."""
    script = tmp_path / "script.py"
    script.write_text(
        "import torchtransient\nfrom support.fake_recipe import FakeRecipe\n"
        "from torchtransient.data import OnlineDataset, generate\n"
        f"FOLDER = {str(tmp_path / 'set')!r}\n{text}\n"
    )
    found = subprocess.run([sys.executable, script], env=environment(), capture_output=True, text=True, timeout=100)
    assert found.returncode == 1
    return found.stderr.rstrip().splitlines()[-1]


CALLS = ["generate({}(), FOLDER, 4, progress=False)", "OnlineDataset({}(), 4).draw()"]


@pytest.mark.slow
@pytest.mark.parametrize("call", CALLS)
def test_a_script_without_a_guard(tmp_path, call):
    """Its workers import it; they may not begin runs of their own without end."""
    assert "__main__" in fails(tmp_path, call.format("FakeRecipe"))


@pytest.mark.slow
@pytest.mark.parametrize("call", CALLS)
def test_a_class_that_workers_do_not_find(tmp_path, call):
    """It is no missing guard."""
    text = f"if __name__ == '__main__':\n    class Mine(FakeRecipe):\n        pass\n    {call.format('Mine')}"
    last = fails(tmp_path, text)
    assert last.startswith("torchtransient.errors.SceneError") and "attribute 'Mine'" in last
    assert "outside of `if __name__ == '__main__':`" in last


# ------------------------------------------------------------------------------------------------------- full disks


@pytest.mark.slow
def test_a_full_disk(tmp_path):
    """A typed error, finished shards whole, nothing half-written, no worker left; the same call goes on."""
    recipe = FakeRecipe(shape=(1, 64, 16, 16))
    asked = {"n": 7, "per_shard": 5, "workers": 1}
    limit = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, resource.RLIM_INFINITY))"
    status, out, err = finish(start(recipe, tmp_path / "a", before=limit, **asked))
    assert status == 1 and out == ""
    assert "StorageError" in err and "File too large" in err and "the same call goes on" in err
    assert list((tmp_path / "a").glob("shard-*.h5")) == [] and leftovers(tmp_path / "a") == []
    generate(recipe, tmp_path / "a", progress=False, **asked)
    generate(recipe, tmp_path / "b", progress=False, **asked)
    assert data_files(tmp_path / "a") == data_files(tmp_path / "b")
