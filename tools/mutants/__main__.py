"""Sixty changes of a room's sources, one after the other, and whether its tests notice: the default ones, then the slow
ones that execute what has changed.

    make mutants ROOM=losses SEED=1        (or, from tools/: python -m mutants losses 1 [--count 60])

The package is changed in a copy. Results are appended to build/mutants/ROOM-SEED.jsonl, a line each, and a run that was
stopped goes on behind the last of them; ``--again`` repeats the survivors of an earlier run, for tests that were
written since. Not a part of the tests: a room takes minutes to hours.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import difflib
import functools
import json
import os
import re
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import pytest

from . import changes, executed, rooms

ROOT = Path(__file__).resolve().parents[2]
COPIED = ("torchtransient", "tests", "tools", "docs", "training_examples", "benchmarks", "pyproject.toml", "README.md",
          "CHANGELOG.md", "LICENSE", "Makefile", "constraints.txt", "constraints-lowest.txt",
          "hatch_build.py")  # fmt: skip
# A change that makes a loop endless is noticed, too: the tests would not end.
PATIENCE, LEAST_SECONDS = 8.0, 150.0
FIRST = 4  # test files
# Tests that do not execute a line notice its change by what others have left in a cache, or in another process. Files
# of so many seconds are asked: what only longer ones would notice counts as not noticed.
OTHERS_SECONDS = 90.0
# Replaces the default selection; tests that need a GPU, peers or hours are left out.
SLOW = ("-m", "slow and not soak and not gpu and not peer and not measured")
HAS_SLOW = re.compile(r"\bslow\b|support\.marks")
ADOPTS_ORPHANS = 36  # PR_SET_CHILD_SUBREAPER


def copied(folder: Path) -> None:
    """Copy the package and all that tests read."""
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__", "build"))
        elif source.exists():
            shutil.copy2(source, folder / name)


def preload() -> None:
    """Import modules that no change touches: each run is a fork of this process. Dr.Jit would start a thread."""
    import numpy as np
    import scipy.signal
    import scipy.stats
    import torch

    torch.set_num_threads(1)
    scipy.signal.fftconvolve(scipy.stats.norm.pdf(np.zeros(1)), np.zeros(1))


def adopt_orphans() -> None:
    """Processes whose parent has ended become children of this one, which ends them; on Linux alone."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(ADOPTS_ORPHANS, 1, 0, 0, 0)


def end_children() -> None:
    """End every process that runs of tests have left, those with a session of their own included."""
    file = Path(f"/proc/self/task/{os.getpid()}/children")
    while children := [int(word) for word in file.read_text().split()] if file.exists() else []:
        for child in children:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)


def run_tests(
    folder: Path, tests: list[str], seconds: float, plugin: object = None, marked: tuple[str, ...] = ()
) -> tuple[str, str]:
    """('caught', what noticed) or ('survived', ''), from test files in a copy: default tests, or those ``marked``."""
    output = folder / "output.txt"
    process = os.fork()
    if process == 0:
        _be_tested(folder, [*marked, *tests], output, plugin)
    until = time.monotonic() + seconds
    while (ended := os.waitpid(process, os.WNOHANG)) == (0, 0):
        if time.monotonic() > until:
            os.killpg(process, signal.SIGKILL)
            os.waitpid(process, 0)
            end_children()
            return "caught", f"not done after {seconds:.0f} s"
        time.sleep(0.02)
    end_children()
    code = os.waitstatus_to_exitcode(ended[1])
    if code in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED):
        return "survived", ""
    failed = re.findall(r"^(?:FAILED|ERROR) (\S+)", output.read_text(encoding="utf-8", errors="replace"), re.MULTILINE)
    return "caught", failed[0] if failed else f"exit code {code}"


def _be_tested(folder: Path, tests: list[str], output: Path, plugin: object) -> None:
    code = 1
    try:
        os.setsid()
        file = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(file, 1)
        os.dup2(file, 2)
        os.chdir(folder)
        os.environ["PYTHONPATH"] = sys.path[0] = str(folder)
        # One thread of Dr.Jit, as where tests run side by side: several runs share the cores.
        os.environ["PYTEST_XDIST_WORKER_COUNT"] = str(os.cpu_count() or 1)
        if isinstance(plugin, Path):
            plugin = executed.Recorder(plugin, folder, folder / "torchtransient")
        plugins = [plugin] if plugin else []
        code = int(pytest.main(["-x", "-q", "--tb=no", "-p", "no:cacheprovider", *tests], plugins=plugins))
        if isinstance(plugin, executed.Recorder):
            plugin.save()
        if Path(sys.modules["torchtransient"].__file__).parent != folder / "torchtransient":
            code = 99
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def ordered(folder: Path, known: executed.Executed, names: Iterable[str], change: changes.Change) -> list[str]:
    """Test files, those that speak of the changed module first, then those that are soon done."""
    module = (folder / change.path).read_text(encoding="utf-8")
    defined = set(re.findall(r"^(?:def|class) (\w{4,})", module, re.MULTILINE))
    around = re.findall(r"^(?:def|class) (\w+)", module.encode()[: change.start].decode(), re.MULTILINE)
    stem = Path(change.path).stem

    def related(test: str) -> tuple[int, float]:
        path = folder / test
        text = path.read_text(encoding="utf-8")
        words = set(re.findall(r"\w+", text))
        score = 4 * (stem in path.stem) + 3 * (stem in words) + len(defined & words)
        return -(score + 5 * bool(around and around[-1] in words)), known.files[test].seconds

    found = sorted(names, key=related)
    return found[:FIRST] + sorted(found[FIRST:], key=lambda test: known.files[test].seconds)


def rounds(
    folder: Path, known: executed.Executed, change: changes.Change, source: bytes
) -> Iterator[tuple[list[str], executed.Chosen, float]]:
    """Rounds of tests, one after the other: test files, their tests, seconds that they take without the change."""
    asked = known.tests(change.path, executed.range_of(source, change.line))
    files = ordered(folder, known, asked, change)
    for names in (files[:FIRST], files[FIRST:]):
        tests = set().union(*(asked[name] for name in names))
        yield names, executed.Chosen(only=tests), sum(known.files[n].tests[t] for n in names for t in asked[n])
    # What executes lines of the module in vain, or in other processes.
    near = {name for name, file in known.files.items() if change.path in file.lines}
    others, left = [], OTHERS_SECONDS
    for name in ordered(folder, known, near | known.elsewhere, change):
        file = known.files[name]
        rest = sum(seconds for test, seconds in file.tests.items() if test not in asked.get(name, ()))
        if 0 < rest <= left:
            others.append(name)
            left -= rest
    yield others, executed.Chosen(without=set().union(*asked.values())), OTHERS_SECONDS - left


def slow_round(
    folder: Path, known: executed.Executed, change: changes.Change, source: bytes
) -> tuple[list[str], executed.Chosen, float]:
    """The slow tests that execute a changed line, as :func:`rounds` says it."""
    asked = known.tests(change.path, executed.range_of(source, change.line))
    seconds = sum(known.files[name].tests[test] for name, tests in asked.items() for test in tests)
    return ordered(folder, known, asked, change), executed.Chosen(only=set().union(*asked.values())), seconds


def difference(source: bytes, changed: bytes, path: str) -> str:
    """The lines of a change, without those around it."""
    before, after = source.decode().splitlines(), changed.decode().splitlines()
    lines = list(difflib.unified_diff(before, after, path, path, n=0, lineterm=""))[2:]
    return "\n".join(line for line in lines if not line.startswith("@@"))


@contextlib.contextmanager
def made(folder: Path, change: changes.Change) -> Iterator[None]:
    """A change of the copy, which is as it was afterwards."""
    target = folder / change.path
    source = target.read_bytes()
    # Compiled files are told apart by their second and size, which a change may leave as they were.
    compiled = target.parent / "__pycache__" / f"{target.stem}.{sys.implementation.cache_tag}.pyc"
    try:
        target.write_bytes(change.apply(source))
        compiled.unlink(missing_ok=True)
        yield
    finally:
        target.write_bytes(source)
        compiled.unlink(missing_ok=True)


def try_change(
    folder: Path, known: executed.Executed, change: changes.Change, slow: Callable[[], executed.Executed]
) -> dict[str, object]:
    """The outcome of one change; ``slow`` says which slow tests execute what, once a change is not noticed."""
    source = (folder / change.path).read_bytes()
    outcome, by, tests = "survived", "", 0
    begun = time.monotonic()
    with made(folder, change):
        # Most changes are noticed by the tests that speak of them: the others are not even collected.
        for names, chosen, expected in rounds(folder, known, change, source):
            if names and outcome == "survived":
                tests += len(names)
                outcome, by = run_tests(folder, names, LEAST_SECONDS + PATIENCE * expected, chosen)
    if outcome == "survived":
        names, chosen, expected = slow_round(folder, slow(), change, source)
        with made(folder, change):
            if names:
                tests += len(names)
                outcome, by = run_tests(folder, names, LEAST_SECONDS + PATIENCE * expected, chosen, SLOW)
    return {
        "outcome": outcome, "by": by, "operator": change.operator, "path": change.path, "line": change.line,
        "seconds": round(time.monotonic() - begun, 1), "files": tests,
        "diff": difference(source, change.apply(source), change.path),
    }  # fmt: skip


def tell(results: list[dict[str, object]]) -> None:
    """Score and survivors."""
    survivors = [result for result in results if result["outcome"] == "survived"]
    for result in survivors:
        print(f"\n{result['path']}:{result['line']} ({result['operator']})\n{result['diff']}")
    caught = len(results) - len(survivors)
    print(f"\n{caught} of {len(results)} changes were noticed ({100 * caught / max(1, len(results)):.0f} %).")


def main() -> None:
    parser = argparse.ArgumentParser(prog="mutants", description=__doc__)
    parser.add_argument("room", choices=sorted(rooms.ROOMS))
    parser.add_argument("seed", type=int)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--again", action="store_true", help="repeat the survivors that are recorded")
    parser.add_argument("--show", action="store_true", help="print what is recorded")
    arguments = parser.parse_args()
    room = rooms.ROOMS[arguments.room]
    record = ROOT / "build" / "mutants" / f"{arguments.room}-{arguments.seed}.jsonl"
    record.parent.mkdir(parents=True, exist_ok=True)
    results = [json.loads(line) for line in record.read_text().splitlines()] if record.exists() else []
    if arguments.show:
        tell(results)
        return
    with tempfile.TemporaryDirectory(prefix="mutants-") as name:
        folder = Path(name)
        copied(folder)
        preload()
        adopt_orphans()
        tests = [path.relative_to(folder).as_posix() for path in room.test_files(folder)]
        known = executed.measured(folder, tests, record.with_name(f"{arguments.room}-executed.json"),
                                  lambda test, data: _seconds_unchanged(folder, test, data))  # fmt: skip

        @functools.cache
        def slow() -> executed.Executed:
            some = [test for test in tests if HAS_SLOW.search((folder / test).read_text(encoding="utf-8"))]
            return executed.measured(folder, some, record.with_name(f"{arguments.room}-executed-slow.json"),
                                     lambda test, data: _seconds_unchanged(folder, test, data, SLOW))  # fmt: skip

        chosen = changes.drawn(folder, room.files(folder), arguments.seed)
        chosen = [change for change, _ in zip(chosen, range(arguments.count), strict=False)]
        if arguments.again:
            left = {(r["path"], r["diff"]) for r in results if r["outcome"] == "survived"}
            every = [c for path in room.files(folder) for c in changes.in_file(path.relative_to(folder).as_posix(),
                                                                               path.read_bytes())]  # fmt: skip
            chosen, results = [c for c in every if (c.path, _of(folder, c)) in left], []
        for number, change in enumerate(chosen[len(results) :], start=len(results) + 1):
            result = try_change(folder, known, change, slow)
            results.append(result)
            if not arguments.again:
                with record.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(result) + "\n")
            print(f"{number} {result['outcome']} {result['path']}:{result['line']} {result['operator']} "
                  f"{result['seconds']} s {result['by']}", flush=True)  # fmt: skip
    tell(results)


def _seconds_unchanged(folder: Path, test: str, data: Path, marked: tuple[str, ...] = ()) -> float:
    begun = time.monotonic()
    outcome, by = run_tests(folder, [test], 3600.0, data, marked)
    if outcome != "survived":
        sys.exit(f"mutants: the tests have to pass before anything is changed, failed: {by}.")
    return time.monotonic() - begun


def _of(folder: Path, change: changes.Change) -> str:
    source = (folder / change.path).read_bytes()
    return difference(source, change.apply(source), change.path)


if __name__ == "__main__":
    main()
