"""A change that the default tests do not notice is put to the slow ones."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tools.mutants import executed

TESTS = """\
import pytest
from torchtransient import x

def test_quick():
    assert x.f(2) > 0

@pytest.mark.slow
def test_long():
    assert x.f(2) == 3

@pytest.mark.slow
def test_other():
    assert x.g() == 1
"""
RUN = """\
import functools, json, os, sys
from pathlib import Path
from mutants import __main__ as run, changes, executed
folder, files = Path.cwd(), ["tests/test_x.py"]
known = executed.measured(folder, files, folder / "a", lambda *a: run._seconds_unchanged(folder, *a))
slow = functools.cache(
    lambda: executed.measured(folder, files, folder / "b", lambda *a: run._seconds_unchanged(folder, *a, run.SLOW))
)
source = (folder / "torchtransient/x.py").read_bytes()
found = [run.try_change(folder, known, c, slow) for c in changes.in_file("torchtransient/x.py", source)]
sys.stdout.write("found " + json.dumps([[one["diff"], one["outcome"], one["by"]] for one in found]))
"""


@pytest.mark.slow
def test_a_change_that_slow_tests_notice(tmp_path):
    files = {
        "torchtransient/__init__.py": "", "tests/test_x.py": TESTS,
        "torchtransient/x.py": "def f(a):\n    return a + 1\n\n\ndef g():\n    return 1\n",
        "pyproject.toml": '[tool.pytest.ini_options]\nmarkers = ["slow", "soak", "gpu", "peer", "measured"]\n'
                          'addopts = "-m \'not slow\'"\n',
    }  # fmt: skip
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}:{Path(executed.__file__).parents[1]}"}
    done = subprocess.run(
        [sys.executable, "-c", RUN], cwd=tmp_path, env=environment, check=True, capture_output=True, text=True
    )
    found = json.loads(done.stdout.split("found ")[1])
    # a - 1 = 1 and a = 2 are above zero, too.
    assert len(found) >= 2
    for difference, outcome, by in found:
        assert outcome == "caught", difference
        assert by == ("tests/test_x.py::test_quick" if by.endswith("quick") else "tests/test_x.py::test_long")
    assert any(by.endswith("test_long") for _, _, by in found)
