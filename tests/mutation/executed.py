"""Which test files execute a line of the package: the others cannot notice that it has changed.

Every file runs in a process of its own, since what a first file has left in a cache no second one executes. Lines that
are executed when a module is imported belong to all files, and files that start processes are asked about every line:
what happens there is not seen here.
"""

from __future__ import annotations

import ast
import hashlib
import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

STARTS_PROCESSES = re.compile(r"subprocess|multiprocessing|spawn|fork|child|process", re.IGNORECASE)


@dataclass
class Executed:
    """Seconds of each test file, and the lines that it executes in tests, by source; those of imports apart."""

    seconds: dict[str, float]
    lines: dict[str, dict[str, set[int]]]
    elsewhere: set[str]

    def files(self, source: str, first: int, last: int) -> list[str]:
        """The test files that may notice a change of these lines of a source."""
        wanted = set(range(first, last + 1))
        found = [test for test, by in self.lines.items() if wanted & by.get(source, set())]
        return sorted(set(found) | self.elsewhere) if found else sorted(self.lines)


def measured(folder: Path, tests: list[str], record: Path, run: Callable[[str, Path], float]) -> Executed:
    """What ``run(test file, data file)`` executes, which returns seconds; kept in ``record`` for the same texts."""
    state = _digest(folder)
    kept = json.loads(record.read_text()) if record.exists() else {}
    if kept.get("state") != state:
        kept = {"state": state, "tests": {}}
    for test in tests:
        if test not in kept["tests"]:
            data = folder / "executed.data"
            seconds = run(test, data)
            kept["tests"][test] = {"seconds": seconds, "lines": _lines(data, folder)}
            record.write_text(json.dumps(kept))
    chosen = {test: kept["tests"][test] for test in tests}
    return Executed(
        seconds={test: entry["seconds"] for test, entry in chosen.items()},
        lines={test: {path: set(lines) for path, lines in entry["lines"].items()} for test, entry in chosen.items()},
        elsewhere={test for test in tests if STARTS_PROCESSES.search((folder / test).read_text(encoding="utf-8"))},
    )


def _digest(folder: Path) -> str:
    total = hashlib.sha256()
    for path in sorted([*folder.glob("torchtransient/**/*.py"), *folder.glob("tests/**/*.py")]):
        total.update(path.relative_to(folder).as_posix().encode() + path.read_bytes())
    return total.hexdigest()


def _lines(data: Path, folder: Path) -> dict[str, list[int]]:
    import coverage

    found = coverage.CoverageData(str(data))
    found.read()
    found.set_query_context("test")
    return {
        Path(path).relative_to(folder).as_posix(): sorted(lines)
        for path in found.measured_files()
        if (lines := found.lines(path))
    }


class Recorder:
    """A plugin of pytest: what is executed from the first test on has the context "test"."""

    def __init__(self, data: Path, package: Path) -> None:
        import coverage

        self.coverage = coverage.Coverage(data_file=str(data), source=[str(package)], config_file=False)
        self.coverage.start()

    def pytest_runtest_logstart(self) -> None:
        """Said before every test, and before its fixtures."""
        self.coverage.switch_context("test")

    def save(self) -> None:
        """To the data file."""
        self.coverage.stop()
        self.coverage.save()


def statement(source: bytes, line: int) -> tuple[int, int]:
    """The first and last line of the innermost statement at a line; of a compound one those of its head."""
    found = (line, line)
    begins = 0
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.stmt):
            continue
        body = getattr(node, "body", None)
        last = max(node.lineno, body[0].lineno - 1) if body else node.end_lineno or node.lineno
        if begins <= node.lineno <= line <= last:
            begins, found = node.lineno, (node.lineno, last)
    return found
