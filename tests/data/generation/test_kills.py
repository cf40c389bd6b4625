"""Workers and supervisors that are killed at any moment: the bytes are those of an undisturbed run."""

from __future__ import annotations

import os
import random
import signal
import time
from collections import Counter

import pytest

import torchtransient as tt
from support.fake_recipe import FakeRecipe
from support.generation_runs import (
    alive,
    data_files,
    finish,
    kill,
    leftovers,
    start,
    start_command,
    wait_until,
    workers_of,
)
from torchtransient.data import Recipe, generate, verify

# Samples take a little, and so does every write to a shard.
RECIPE = FakeRecipe(shape=(1, 16, 8, 8), seconds=0.02, slow_disk=0.004)
ASKED = {"n": 48, "per_shard": 6, "workers": 2}


@pytest.fixture(scope="module")
def calm(tmp_path_factory):
    folder = tmp_path_factory.mktemp("calm") / "set"
    generate(FakeRecipe(shape=RECIPE.shape), folder, progress=False, **ASKED | {"workers": 1})
    assert verify(folder).complete
    return data_files(folder)


def half_written(folder):
    """Shards between their first and their last byte."""
    found = []
    for path in folder.glob(".shard-*.part"):
        try:
            found += [path] * (path.stat().st_size > 0)
        except FileNotFoundError:
            continue
    return found


@pytest.mark.slow
def test_a_killed_worker_is_replaced(tmp_path, calm):
    """One while it makes samples, one while it writes."""
    child = start(RECIPE, tmp_path, **ASKED)
    try:
        wait_until(lambda: list(tmp_path.glob("shard-*.h5")))
        assert kill(workers_of(child.pid)[0])
        wait_until(lambda: half_written(tmp_path))
        assert kill(workers_of(child.pid)[-1])
        status, out, err = finish(child)
    finally:
        child.kill()
    assert status == 0, err
    assert "2 workers replaced" in out and data_files(tmp_path) == calm and leftovers(tmp_path) == []


@pytest.mark.slow
def test_a_killed_supervisor(tmp_path, calm):
    """Its workers end by themselves, and the next run goes on."""
    child = start(RECIPE, tmp_path, **ASKED)
    wait_until(lambda: len(list(tmp_path.glob("shard-*.h5"))) >= 2)
    workers = workers_of(child.pid)
    assert len(workers) == 2
    kill(child.pid)
    child.communicate()
    wait_until(lambda: not any(map(alive, workers)), 15)
    assert leftovers(tmp_path) == []
    kept = len(list(tmp_path.glob("shard-*.h5")))
    assert 2 <= kept < 8
    done = generate(RECIPE, tmp_path, progress=False, **ASKED | {"workers": 1})
    assert done.kept == 6 * kept and data_files(tmp_path) == calm


@pytest.mark.slow
def test_a_killed_supervisor_of_a_worker_that_hangs(tmp_path):
    child = start(FakeRecipe(hanging=(0,)), tmp_path, **ASKED)
    (worker,) = wait_until(lambda: workers_of(child.pid)[:1])
    wait_until(lambda: (tmp_path / "log.jsonl").exists())
    time.sleep(2)
    kill(child.pid)
    child.communicate()
    wait_until(lambda: not alive(worker), 15)


@pytest.mark.slow
@pytest.mark.parametrize("group", [False, True])
def test_ctrl_c(tmp_path, calm, group):
    """At a terminal it reaches the workers too."""
    child = start(RECIPE, tmp_path, **ASKED)
    wait_until(lambda: list(tmp_path.glob("shard-*.h5")))
    workers = workers_of(child.pid)
    os.killpg(child.pid, signal.SIGINT) if group else os.kill(child.pid, signal.SIGINT)
    status, _, err = finish(child, 15)
    assert status == -signal.SIGINT and err.count("Traceback") == 1 and "KeyboardInterrupt" in err
    assert not any(map(alive, workers)) and leftovers(tmp_path) == []
    generate(RECIPE, tmp_path, progress=False, **ASKED)
    assert data_files(tmp_path) == calm


@pytest.mark.slow
def test_two_runs_at_once(tmp_path, calm):
    """On one folder, from its beginning on: both end, and nothing is lost or doubled."""
    both = [start(RECIPE, tmp_path, **ASKED) for _ in range(2)]
    for child in both:
        status, _, err = finish(child)
        assert status == 0, err
    assert data_files(tmp_path) == calm and verify(tmp_path).complete and leftovers(tmp_path) == []


RENDERED = """
scene: {builtin: cornell_box, resolution: 16, num_bins: 200, bin_width_opl: 0.06}
vary:
  red.reflectance.value: {uniform: [0.1, 0.9]}
  small-box.to_world: {turn: {axis: [0, 1, 0], low: -20, high: 20}}
labels: [depth]
spp: 64
variant: llvm_ad_mono
n: 100
"""


@pytest.mark.slow
def test_a_killed_run_of_real_renders(tmp_path):
    """Two workers and a supervisor are killed; the rest is made by one worker. Threads of this process do not count."""
    (tmp_path / "recipe.yaml").write_text(RENDERED)
    recipe = Recipe.read(tmp_path / "recipe.yaml")
    with tt.threads(2):
        generate(recipe, tmp_path / "calm", workers=1, per_shard=5, progress=False)
        assert tt.threads().drjit == 2
    rough = tmp_path / "rough"
    options = ("--out", "rough", "--per-shard", "5", "--quiet")
    child = start_command(tmp_path, "dataset", "recipe.yaml", *options)
    for shards in (2, 6):
        wait_until(lambda: len(list(rough.glob("shard-*.h5"))) >= shards, 300)  # noqa: B023
        kill(workers_of(child.pid)[0])
    wait_until(lambda: len(list(rough.glob("shard-*.h5"))) >= 10)
    kill(child.pid)
    child.communicate()
    assert len(list(rough.glob("shard-*.h5"))) < 20
    done = generate(recipe, rough, workers=1, progress=False)
    assert done.kept >= 50 and done.failed == 0
    expected, found = data_files(tmp_path / "calm"), data_files(rough)
    # It tells where the recipe lay on the machine that began.
    del expected["recipe.json"], found["recipe.json"]
    assert len(found) == 21 and found == expected and leftovers(rough) == []
    assert verify(rough).complete


@pytest.mark.soak
def test_a_hundred_kills(tmp_path, calm):
    """Of workers and of supervisors, starting, rendering and between the first and the last byte of a shard."""
    chance = random.Random(7)
    hits: Counter = Counter()
    while hits.total() < 100:
        folder = tmp_path / f"{hits.total()}"
        folder.mkdir()
        while not _life(folder, chance, hits):
            pass
        found = verify(folder)
        assert data_files(folder) == calm and found.complete and found.failed == {} and leftovers(folder) == []
    assert hits["supervisor"] >= 10


def _life(folder, chance, hits):
    """A run that is disturbed until its supervisor is killed; True where it came to its end."""
    child = start(RECIPE, folder, **ASKED)
    try:
        for _ in range(chance.randrange(3, 10)):
            at_a_file, until = chance.random() < 0.7, time.monotonic() + chance.uniform(0, 6)
            while child.poll() is None and time.monotonic() < until and not (at_a_file and half_written(folder)):
                time.sleep(0.001)
            workers = workers_of(child.pid)
            victim = chance.choice([child.pid, *workers, *workers])
            if child.poll() is None and kill(victim):
                hits["supervisor" if victim == child.pid else "worker"] += 1
                if victim == child.pid:
                    child.communicate()
                    # They see it at once, and take a moment to leave.
                    wait_until(lambda: not any(map(alive, workers)), 15)  # noqa: B023
                    return False
                wait_until(lambda: not alive(victim), 15)  # noqa: B023
        status, _, err = finish(child, 120)
        assert status == 0, err
        return True
    finally:
        child.kill()
        child.wait()
