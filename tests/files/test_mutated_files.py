"""Mutants for every reader of files, and some kills of a writer, in processes of their own. `tests/soak` has ten
thousand of each.
"""

from __future__ import annotations

import pytest

from support.killed_writers import in_child
from support.mutated_files import run
from support.read_files import READERS

_TEXTS = ("WebDataset", "device", "setup", "scene", "capture of cdt", "capture of keyhole", "result")
SOME = {name: 60 if name in _TEXTS else 12 for name in READERS if name not in ("built scene", "data set")}


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
