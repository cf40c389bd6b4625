"""Sixty changes of a room's sources, one after the other, and whether its default tests notice.

    make mutants ROOM=losses SEED=1        (or, from tests/: python -m mutation losses 1 [--count 60])

The package is changed in a copy. Results are appended to build/mutants/ROOM-SEED.jsonl, a line each, and a run that was
stopped goes on behind the last of them; ``--again`` repeats the survivors of an earlier run, for tests that were written
since. Not a part of the tests: a room takes minutes to hours.
"""

from __future__ import annotations

import argparse
import difflib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from . import changes, rooms

ROOT = Path(__file__).resolve().parents[2]
COPIED = ("torchtransient", "tests", "docs", "training_examples", "benchmarks", "pyproject.toml", "README.md",
          "CHANGELOG.md", "LICENSE", "Makefile", "constraints.txt", "constraints-lowest.txt", "hatch_build.py")  # fmt: skip
# A change that makes a loop endless is noticed, too: the tests would not end.
PATIENCE, LEAST_SECONDS = 4.0, 60.0


def copied(folder: Path) -> None:
    """What tests read, beside the package."""
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__", "build"))
        elif source.exists():
            shutil.copy2(source, folder / name)


def run_tests(folder: Path, tests: list[str], seconds: float) -> tuple[str, str]:
    """('caught', what noticed) or ('survived', ''), from the room's tests in a copy."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "--tb=no", "-p", "no:cacheprovider", *tests]
    environment = {**os.environ, "PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        start_new_session=True,
    )  # fmt: skip
    try:
        output, _ = process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return "caught", f"not done after {seconds:.0f} s"
    if process.returncode == 0:
        return "survived", ""
    failed = re.findall(r"^(?:FAILED|ERROR) (\S+)", output, re.MULTILINE)
    return "caught", failed[0] if failed else f"exit code {process.returncode}"


def ordered(folder: Path, room: rooms.Room, change: changes.Change) -> list[str]:
    """The test files of a room, those that speak of the changed module first."""
    module = (folder / change.path).read_text(encoding="utf-8")
    names = set(re.findall(r"^(?:def|class) (\w{4,})", module, re.MULTILINE))
    around = re.findall(r"^(?:def|class) (\w+)", module.encode()[: change.start].decode(), re.MULTILINE)
    stem = Path(change.path).stem

    def related(path: Path) -> tuple[int, str]:
        text = path.read_text(encoding="utf-8")
        words = set(re.findall(r"\w+", text))
        score = 4 * (stem in path.stem) + 3 * (stem in words) + len(names & words)
        return -(score + 5 * bool(around and around[-1] in words)), str(path)

    found = sorted(room.test_files(folder), key=related)
    return [path.relative_to(folder).as_posix() for path in found]


def difference(source: bytes, changed: bytes, path: str) -> str:
    """The lines of a change, without those around it."""
    before, after = source.decode().splitlines(), changed.decode().splitlines()
    lines = list(difflib.unified_diff(before, after, path, path, n=0, lineterm=""))[2:]
    return "\n".join(line for line in lines if not line.startswith("@@"))


def try_change(folder: Path, room: rooms.Room, change: changes.Change, seconds: float) -> dict[str, object]:
    """The outcome of one change; the copy is as it was afterwards."""
    target = folder / change.path
    source = target.read_bytes()
    changed = change.apply(source)
    tests = ordered(folder, room, change)
    begun = time.monotonic()
    # Compiled files are told apart by their second and size, which a change may leave as they were.
    compiled = [target.parent / "__pycache__" / f"{target.stem}.{sys.implementation.cache_tag}.pyc"]
    try:
        target.write_bytes(changed)
        for path in compiled:
            path.unlink(missing_ok=True)
        outcome, by = run_tests(folder, tests, seconds)
    finally:
        target.write_bytes(source)
        for path in compiled:
            path.unlink(missing_ok=True)
    return {
        "outcome": outcome, "by": by, "operator": change.operator, "path": change.path, "line": change.line,
        "seconds": round(time.monotonic() - begun, 1), "diff": difference(source, changed, change.path),
    }  # fmt: skip


def tell(results: list[dict[str, object]]) -> None:
    """Score and survivors."""
    survivors = [result for result in results if result["outcome"] == "survived"]
    for result in survivors:
        print(f"\n{result['path']}:{result['line']} ({result['operator']})\n{result['diff']}")
    caught = len(results) - len(survivors)
    print(f"\n{caught} of {len(results)} changes were noticed ({100 * caught / max(1, len(results)):.0f} %).")


def main() -> None:
    parser = argparse.ArgumentParser(prog="mutation", description=__doc__)
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
        tests = [path.relative_to(folder).as_posix() for path in room.test_files(folder)]
        begun = time.monotonic()
        outcome, by = run_tests(folder, tests, 3600.0)
        if outcome != "survived":
            sys.exit(f"mutation: the tests have to pass before anything is changed, failed: {by}.")
        seconds = max(LEAST_SECONDS, PATIENCE * (time.monotonic() - begun))
        chosen = changes.drawn(folder, room.files(folder), arguments.seed)
        chosen = [change for change, _ in zip(chosen, range(arguments.count), strict=False)]
        if arguments.again:
            left = {(r["path"], r["diff"]) for r in results if r["outcome"] == "survived"}
            chosen = [c for c in chosen if (c.path, _of(folder, c)) in left]
            results = []
        for number, change in enumerate(chosen[len(results) :], start=len(results) + 1):
            result = try_change(folder, room, change, seconds)
            results.append(result)
            if not arguments.again:
                with record.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(result) + "\n")
            print(f"{number} {result['outcome']} {result['path']}:{result['line']} {result['operator']} "
                  f"{result['seconds']} s {result['by']}", flush=True)  # fmt: skip
    tell(results)


def _of(folder: Path, change: changes.Change) -> str:
    source = (folder / change.path).read_bytes()
    return difference(source, change.apply(source), change.path)


if __name__ == "__main__":
    main()
