"""A data set of real renders, disturbed: the bytes are those of an undisturbed run."""

from __future__ import annotations

import pytest

import torchtransient as tt
from support.generation_runs import data_files, kill, leftovers, start_command, wait_until, workers_of
from torchtransient.data import Recipe, generate, verify

pytestmark = pytest.mark.slow
RECIPE = """
scene: {builtin: cornell_box, resolution: 16, num_bins: 200, bin_width_opl: 0.06}
vary:
  red.reflectance.value: {uniform: [0.1, 0.9]}
  small-box.to_world: {turn: {axis: [0, 1, 0], low: -20, high: 20}}
labels: [depth]
spp: 64
variant: llvm_ad_mono
n: 100
"""


def test_killed_and_gone_on(tmp_path):
    """Two workers and a supervisor are killed; the rest is made by one worker. Threads of this process do not count."""
    (tmp_path / "recipe.yaml").write_text(RECIPE)
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
