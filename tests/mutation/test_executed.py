"""Which tests are asked about a changed line."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tools.mutants import executed

SOURCE = b"""\
FLOOR = 1


def f(x, y=2):
    if x > 1 and (
        y < 2
    ):
        return {
            "a": x + y,
        }
    return x


class A:
    b: int = 3

    def g(self):
        for k in range(3):
            yield k
"""
MODULE = range(1, 20)


@pytest.mark.parametrize(
    ("line", "first", "last"),
    [(4, 4, 11), (5, 5, 7), (6, 5, 7), (8, 8, 10), (9, 8, 10), (11, 11, 11), (14, 14, 19), (15, 14, 19),
     (17, 17, 19), (18, 18, 18), (19, 19, 19)],
)  # fmt: skip
def test_lines_that_use_what_stands_at_a_line(line, first, last):
    assert executed.range_of(SOURCE, line) == range(first, last + 1)


def test_what_a_module_sets_is_used_by_all_of_it():
    assert executed.range_of(SOURCE, 1) == range(1, SOURCE.count(b"\n") + 2)


def test_tests_that_execute_a_line():
    known = executed.Executed(
        files={
            "a": executed.File(1.0, {"a::1": 0.5, "a::2": 0.5}, {"x.py": {1: {"a::1"}, 2: {"a::1", "a::2"}}}),
            "b": executed.File(1.0, {"b::1": 1.0}, {"x.py": {3: {"b::1"}}}),
        },
        elsewhere=set(),
    )
    assert known.tests("x.py", range(1, 2)) == {"a": {"a::1"}}
    assert known.tests("x.py", range(2, 4)) == {"a": {"a::1", "a::2"}, "b": {"b::1"}}
    assert known.tests("x.py", range(4, 9)) == known.tests("y.py", range(1, 2)) == {}


TESTS = """\
import pytest
from package import x

@pytest.fixture(scope="module")
def shared():
    return x.g()

def test_alone():
    assert x.f() == 1

@pytest.mark.parametrize("k", [1, 2])
def test_shared(shared, k):
    assert shared == 1

def test_nothing(): ...
"""
RUN = """\
import sys
from pathlib import Path
import pytest
from mutants import executed
folder = Path.cwd()
recorder = executed.Recorder(folder / "data", folder, folder / "package")
sys.path.insert(0, str(folder))
code = pytest.main(["-q", "-p", "no:cacheprovider", "--rootdir", str(folder), "test_x.py"], plugins=[recorder])
recorder.save()
raise SystemExit(int(code))
"""


@pytest.mark.slow
def test_what_tests_and_their_fixtures_execute(tmp_path):
    package = tmp_path / "package"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "x.py").write_text("a = 1\n\n\ndef f():\n    return a\n\n\ndef g():\n    return a\n")
    (tmp_path / "test_x.py").write_text(TESTS)

    def run(name, data):
        environment = {**os.environ, "PYTHONPATH": str(Path(executed.__file__).parents[1])}
        subprocess.run([sys.executable, "-c", RUN], cwd=tmp_path, env=environment, check=True)
        (tmp_path / "data").rename(data)
        return 1.5

    known = executed.measured(tmp_path, ["test_x.py"], tmp_path / "kept.json", run)
    file = known.files["test_x.py"]
    assert file.seconds == 1.5 and len(file.tests) == 4
    shared = {f"test_x.py::test_shared[{k}]" for k in (1, 2)}
    assert file.lines == {"package/x.py": {5: {"test_x.py::test_alone"}, 9: shared}}
    assert not known.elsewhere
    again = executed.measured(tmp_path, ["test_x.py"], tmp_path / "kept.json", lambda *_: pytest.fail("measured again"))
    assert again == known and "state" in json.loads((tmp_path / "kept.json").read_text())


class Item:
    def __init__(self, nodeid):
        self.nodeid = nodeid


@pytest.mark.parametrize(
    ("only", "without", "left"), [(None, None, "abc"), ({"a", "d"}, None, "a"), (None, {"a"}, "bc"), ({"a"}, {"a"}, "")]
)
def test_tests_that_are_chosen(only, without, left):
    items = [Item(name) for name in "abc"]
    executed.Chosen(only, without).pytest_collection_modifyitems(items)
    assert "".join(item.nodeid for item in items) == left
