"""Some mutants for every reader of files, and some kills of a writer, in processes of their own. `tests/soak` has ten
thousand of each.
"""

from __future__ import annotations

import pytest

from support.killed_writers import in_child
from support.mutated_files import run
from support.read_files import READERS

# Of each reader, in one process.
FEW = 3
_TEXTS = ("WebDataset", "device", "setup", "scene", "capture of cdt", "capture of keyhole", "result")
SOME = {name: 60 if name in _TEXTS else 12 for name in READERS if name not in ("built scene", "data set")}


def test_a_few_mutants(tmp_path):
    # Shards and captures are read in test_hostile_files.py and test_hostile_shards.py, too; a recipe takes a second.
    names = [name for name in SOME if name not in ("shard", "recipe", "capture of tal")]
    for name, report in run(names, tmp_path, FEW).items():
        assert report.findings == []
        assert report.read + report.refused == FEW, name
        assert report.refused > 0


@pytest.mark.slow
def test_mutants(tmp_path):
    for count in sorted(set(SOME.values())):
        names = [name for name, number in SOME.items() if number == count]
        folder = tmp_path / str(count)
        folder.mkdir()
        for name, report in run(names, folder, count).items():
            assert report.findings == []
            assert report.read + report.refused == count, name
            assert report.read > 0 or name in ("shard", "recipe")
            assert report.refused > 0


@pytest.mark.slow
def test_killed_writers(tmp_path):
    found = in_child(tmp_path, kills=5, seed=0)
    assert found["old"] + found["new"] == 5
