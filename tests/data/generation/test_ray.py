"""The engine for clusters: workers of a cluster on this machine, some of which are killed."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

from support.fake_recipe import FakeRecipe
from support.generation_runs import data_files, environment, kill, leftovers, workers_of
from torchtransient.data import generate, verify
from torchtransient.errors import StorageError

pytestmark = pytest.mark.slow
ASKED = {"n": 48, "per_shard": 6, "progress": False, "engine": "ray"}


@pytest.fixture(scope="module")
def cluster():
    """Workers find the package and the tests where this process has them."""
    ray = pytest.importorskip("ray")
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = environment()["PYTHONPATH"]
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    yield ray
    ray.shutdown()
    if before is None:
        del os.environ["PYTHONPATH"]
    else:
        os.environ["PYTHONPATH"] = before


@pytest.fixture(scope="module")
def calm(tmp_path_factory):
    folder = tmp_path_factory.mktemp("calm") / "set"
    generate(FakeRecipe(shape=(1, 16, 8, 8)), folder, n=48, per_shard=6, workers=1, progress=False)
    return data_files(folder)


def tasks():
    """Processes of tasks that make shards, and their own workers."""
    found = []
    for place in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            # Ray writes the name of the function into the title of the process.
            if place.read_bytes().startswith(b"ray::make_share"):
                task = int(place.parent.name)
                found += [task, *workers_of(task)]
        except OSError:
            continue
    return found


def test_the_same_bytes(cluster, tmp_path, calm):
    done = generate(FakeRecipe(shape=(1, 16, 8, 8)), tmp_path, workers=5, **ASKED)
    assert (done.samples, done.restarts) == (48, 0)
    assert data_files(tmp_path) == calm and cluster.is_initialized()
    # Errors of workers are those of the run.
    (tmp_path / "shard-000001.h5").unlink()
    with pytest.raises(StorageError, match="versions is"):
        generate(FakeRecipe(shape=(1, 16, 8, 8), versions={"fake": "2"}), tmp_path, **ASKED)


def test_killed_workers(cluster, tmp_path, calm):
    kills, ended = [], threading.Event()

    def disturb():
        while len(kills) < 6 and not ended.wait(1.5):
            # A task, or the process of its own that makes the samples.
            kills.extend(pid for pid in tasks()[len(kills) % 2 :][:1] if kill(pid))

    thread = threading.Thread(target=disturb)
    thread.start()
    try:
        recipe = FakeRecipe(shape=(1, 16, 8, 8), seconds=0.05, slow_disk=0.004)
        done = generate(recipe, tmp_path, workers=2, **ASKED)
    finally:
        ended.set()
        thread.join()
    assert len(kills) >= 3 and (done.samples, done.failed) == (48, 0)
    assert data_files(tmp_path) == calm and verify(tmp_path).complete and leftovers(tmp_path) == []


def test_what_fails_is_named(cluster, tmp_path):
    recipe = FakeRecipe(raising=(3,), crashing=(7,), hanging=(20,))
    generate(recipe, tmp_path, timeout_s=2, retries=0, **ASKED)
    found = verify(tmp_path)
    assert found.complete and found.samples == 45
    assert sorted(found.failed) == [3, 7, 20] and found.failed[7] == found.failed[20]
    assert found.failed[3] == "SceneError: sample 3 cannot be made by <object at 0x...>"
