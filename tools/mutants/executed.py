"""Tests that execute a line of the package: the others cannot notice that it has changed.

Every test file runs in a process of its own, since what a first file has left in a cache no second one executes. What a
fixture of several tests executes counts for each of them. Lines that are executed when a module is imported count for
the tests that execute anything that they define, and files that start processes are asked about every line: what
happens there is not seen here.
"""

from __future__ import annotations

import ast
import hashlib
import json
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

STARTS_PROCESSES = re.compile(r"subprocess|multiprocessing|spawn|fork|child|process", re.IGNORECASE)
FIXTURE = "fixture "


@dataclass
class File:
    """One test file: the seconds of all of it and of each test, and by source and line the tests that execute it."""

    seconds: float
    tests: dict[str, float]
    lines: dict[str, dict[int, set[str]]]

    def executing(self, source: str, wanted: range) -> set[str]:
        """The tests that execute one of these lines."""
        lines = self.lines.get(source, {})
        return set().union(*(lines[line] for line in wanted if line in lines))


@dataclass
class Executed:
    """Every test file of a room, and those of which processes are not seen."""

    files: dict[str, File]
    elsewhere: set[str]

    def tests(self, source: str, wanted: range) -> dict[str, set[str]]:
        """The tests that execute one of these lines of a source, by their file."""
        found = {name: file.executing(source, wanted) for name, file in self.files.items()}
        return {name: tests for name, tests in found.items() if tests}


def measured(folder: Path, tests: list[str], record: Path, run: Callable[[str, Path], float]) -> Executed:
    """Measure the lines that ``run(test file, data file)`` executes, which returns seconds; cached in ``record``."""
    state = _digest(folder)
    kept = json.loads(record.read_text()) if record.exists() else {}
    if kept.get("state") != state:
        kept = {"state": state, "files": {}}
    for test in tests:
        if test not in kept["files"]:
            data = folder / "executed.data"
            seconds = run(test, data)
            kept["files"][test] = {"seconds": seconds, **json.loads(data.read_text())}
            record.write_text(json.dumps(kept))
    return Executed(
        files={test: _file(kept["files"][test]) for test in tests},
        elsewhere={test for test in tests if STARTS_PROCESSES.search((folder / test).read_text(encoding="utf-8"))},
    )


def _file(kept: dict[str, Any]) -> File:
    names = list(kept["tests"])
    return File(
        seconds=kept["seconds"],
        tests=kept["tests"],
        lines={
            path: {int(line): {names[k] for k in by} for line, by in lines.items()}
            for path, lines in kept["lines"].items()
        },
    )


def _digest(folder: Path) -> str:
    total = hashlib.sha256()
    for path in sorted([*folder.glob("torchtransient/**/*.py"), *folder.glob("tests/**/*.py")]):
        total.update(path.relative_to(folder).as_posix().encode() + path.read_bytes())
    return total.hexdigest()


class Recorder:
    """A plugin of pytest that keeps, for every line of a package, the tests that execute it."""

    def __init__(self, data: Path, folder: Path, package: Path) -> None:
        import coverage

        self.data, self.folder = data, folder
        self.seconds: dict[str, float] = {}
        self.fixtures: dict[str, list[str]] = {}
        self.contexts = [""]
        self.begun = 0.0
        self.coverage = coverage.Coverage(data_file=None, source=[str(package)], config_file=False)
        self.coverage.start()

    def pytest_collection_finish(self, session: pytest.Session) -> None:
        """Collect the tests that use a fixture."""
        for item in session.items:
            self.seconds[item.nodeid] = 0.0
            for name in getattr(item, "fixturenames", ()):
                self.fixtures.setdefault(FIXTURE + name, []).append(item.nodeid)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item):
        """One test, with what stands before and after it."""
        begun = time.monotonic()
        self._enter(item.nodeid)
        try:
            return (yield)
        finally:
            self._leave()
            self.seconds[item.nodeid] = time.monotonic() - begun

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: pytest.FixtureDef):
        """One fixture: what several tests share is executed in the first of them."""
        if fixturedef.scope == "function":
            return (yield)
        self._enter(FIXTURE + fixturedef.argname)
        try:
            return (yield)
        finally:
            self._leave()

    def _enter(self, context: str) -> None:
        self.contexts.append(context)
        self.coverage.switch_context(context)

    def _leave(self) -> None:
        self.contexts.pop()
        self.coverage.switch_context(self.contexts[-1])

    def save(self) -> None:
        """To the data file, as JSON: seconds of every test, and the numbers of tests by source and line."""
        self.coverage.stop()
        found = self.coverage.get_data()
        number = {name: k for k, name in enumerate(self.seconds)}
        lines: dict[str, dict[int, list[int]]] = {}
        for path in found.measured_files():
            by = {line: self._tests(contexts) for line, contexts in found.contexts_by_lineno(path).items()}
            name = Path(path).relative_to(self.folder).as_posix()
            if any(by.values()):
                lines[name] = {line: sorted(number[one] for one in tests) for line, tests in by.items() if tests}
        self.data.write_text(json.dumps({"tests": self.seconds, "lines": lines}))

    def _tests(self, contexts: list[str]) -> set[str]:
        named = [context for context in contexts if context]
        return set().union(*(self.fixtures.get(one, []) if one.startswith(FIXTURE) else [one] for one in named))


class Chosen:
    """A plugin of pytest: only these tests, or all but these."""

    def __init__(self, only: set[str] | None = None, without: set[str] | None = None) -> None:
        self.only, self.without = only, without or set()

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Keep the chosen tests alone."""
        items[:] = [
            item
            for item in items
            if item.nodeid not in self.without and (self.only is None or item.nodeid in self.only)
        ]


def range_of(source: bytes, line: int) -> range:
    """The lines whose execution makes use of what stands at a line.

    In a function: the innermost statement there, of a compound one its head. What is executed at an import, the head
    of a function included, is used by the function, by the class, or by the whole module.
    """
    found: ast.AST | None = None
    inside: list[ast.AST] = []
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.stmt) or not node.lineno <= line <= (node.end_lineno or node.lineno):
            continue
        if found is None or node.lineno >= found.lineno:
            found = node
        inside.append(node)
    if found is None:
        return range(line, line + 1)
    head = isinstance(found, ast.FunctionDef | ast.ClassDef)
    owners = [node for node in inside if isinstance(node, ast.FunctionDef | ast.ClassDef)]
    functions = [node for node in owners if isinstance(node, ast.FunctionDef) and not (head and node is found)]
    if functions:
        body = getattr(found, "body", None)
        last = max(found.lineno, body[0].lineno - 1) if body else found.end_lineno
        return range(found.lineno, last + 1)
    if owners:
        owner = max(owners, key=lambda node: node.lineno)
        return range(owner.lineno, owner.end_lineno + 1)
    return range(1, source.count(b"\n") + 2)
