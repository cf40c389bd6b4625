"""Which tests are asked about a changed line."""

from __future__ import annotations

import pytest

from mutation import executed

SOURCE = b"""\
def f(x, y=2):
    if x > 1 and (
        y < 2
    ):
        return {
            "a": x + y,
        }
    return x
"""


@pytest.mark.parametrize(
    ("line", "lines"), [(1, (1, 1)), (2, (2, 4)), (3, (2, 4)), (5, (5, 7)), (6, (5, 7)), (8, (8, 8)), (9, (9, 9))]
)
def test_the_statement_at_a_line(line, lines):
    assert executed.statement(SOURCE, line) == lines


def test_files_that_execute_a_line_and_those_that_start_processes():
    known = executed.Executed(
        seconds={"a": 1.0, "b": 1.0, "c": 1.0},
        lines={"a": {"x.py": {1, 2}}, "b": {"x.py": {3}}, "c": {}},
        elsewhere={"c"},
    )
    assert known.files("x.py", 2, 2) == ["a", "c"]
    assert known.files("x.py", 1, 3) == ["a", "b", "c"]
    # What no test executes by itself is executed at an import, if at all: all are asked.
    assert known.files("x.py", 4, 9) == known.files("y.py", 1, 1) == ["a", "b", "c"]


def test_what_a_file_executes_in_its_tests(tmp_path):
    package = tmp_path / "package"
    package.mkdir()
    source = package / "x.py"
    source.write_text("a = 1\n\n\ndef f():\n    return a\n\n\ndef g():\n    return a\n")
    test = tmp_path / "test_x.py"
    test.write_text("def test_f(): ...\n")

    def run(name, data):
        recorder = executed.Recorder(data, package)
        module = {}
        code = compile(source.read_text(), str(source), "exec")
        exec(code, module)
        recorder.pytest_runtest_logstart()
        module["f"]()
        recorder.save()
        return 1.5

    known = executed.measured(tmp_path, ["test_x.py"], tmp_path / "kept.json", run)
    assert known.lines == {"test_x.py": {"package/x.py": {5}}} and known.seconds == {"test_x.py": 1.5}
    again = executed.measured(tmp_path, ["test_x.py"], tmp_path / "kept.json", lambda *_: pytest.fail("measured again"))
    assert again == known
