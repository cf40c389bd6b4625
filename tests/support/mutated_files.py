"""Every reader of files against mutants of files that it reads, in a process of its own: what it must never do is die,
wait, raise what has no type, or return other content where a checksum stands beside it.
"""

from __future__ import annotations

import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
import traceback
import warnings
from dataclasses import dataclass, field
from pathlib import Path

from support.read_files import READERS, Reader

# Beside the longest path of a test's folder.
MOST_LETTERS = 400
# Of CPU time; of waiting ten times as much.
SECONDS = 20
_MEMORY = 4 * 2**30
TESTS = Path(__file__).parents[1]


@dataclass
class Report:
    """What came of the mutants of one reader: how many were read and refused, by how many bytes the process has grown,
    seconds of CPU time of all of them and of the slowest, and what must not be, a line each.
    """

    reader: str
    read: int = 0
    refused: int = 0
    grown: int = 0
    seconds: float = 0.0
    slowest: float = 0.0
    findings: list[str] = field(default_factory=list)


# ------------------------------------------------------------------------------------------------------ in the child


def _in_child(names: list[str], folder: Path, first: int, last: int) -> None:
    """Mutants ``first`` to ``last`` - 1 of each reader; what comes of it in ``report.jsonl``, what is being read in
    ``now``.
    """
    import torchtransient.nlos  # noqa: F401  # before Mitsuba, and with the layouts of captures

    warnings.simplefilter("ignore")
    now = os.open(folder / "now", os.O_CREAT | os.O_RDWR)
    for name in names:
        reader, place = READERS[name], folder / re.sub(r"\W", "_", name)
        if not (place / "sources").exists():
            (place / "sources").mkdir(parents=True)
            written = reader.sources(place / "sources")
            (place / "sources.txt").write_text("\n".join(map(str, written)))
        _run(name, reader, place, (first, last), now, folder / "report.jsonl")
        first = 0


def _run(name: str, reader: Reader, place: Path, seeds: tuple[int, int], now: int, report: Path) -> None:
    from support.mutations import mutant
    from torchtransient.errors import TorchTransientError

    sources = [Path(line) for line in (place / "sources.txt").read_text().split("\n")]
    whole = {path: reader.read(_copy(path, place)) for path in sources}
    space = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (space + _MEMORY, resource.RLIM_INFINITY))
    found, before, began = Report(name), _resident(), time.process_time()
    for seed in range(*seeds):
        source = sources[seed % len(sources)]
        target = place / f"{seed}_{source.name}"
        mutant(source, target, seed)
        os.pwrite(now, f"{name}\n{seed}\n".ljust(80).encode(), 0)
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        signal.setitimer(signal.ITIMER_REAL, 10 * SECONDS)
        started = time.process_time()
        try:
            content = reader.read(target)
            found.read += 1
            if reader.sealed(source) and content is not None and content != whole[source]:
                found.findings.append(f"{name} {seed} ({source.name}): other content without a word")
        except TorchTransientError as error:
            found.refused += 1
            said = str(error)
            if len(said) > MOST_LETTERS + len(str(target)) or "\n" in said or "Traceback" in said or not said:
                found.findings.append(f"{name} {seed} ({source.name}): message of {len(said)}: {said[:600]!r}")
        except BaseException as error:  # noqa: BLE001  # that is what is looked for
            where = " < ".join(f"{f.name}:{f.lineno}" for f in reversed(traceback.extract_tb(error.__traceback__)[-4:]))
            found.findings.append(
                f"{name} {seed} ({source.name}): {type(error).__name__}: {str(error)[:200]!r} in {where}"
            )
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.setitimer(signal.ITIMER_PROF, 0)
        found.slowest = max(found.slowest, time.process_time() - started)
        target.unlink(missing_ok=True)
        if seed % 500 == 499 or seed == seeds[1] - 1 or found.findings:
            found.grown, found.seconds = _resident() - before, time.process_time() - began
            with report.open("a", encoding="utf-8") as file:
                file.write(json.dumps(found.__dict__) + "\n")
            found.read = found.refused = 0
            found.findings = []
            began = time.process_time()
    resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))


def _copy(source: Path, place: Path) -> Path:
    """A whole file where mutants of it will be."""
    target = place / f"0_{source.name}"
    shutil.copyfile(source, target)
    return target


def _resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


# ----------------------------------------------------------------------------------------------------- in the parent


def run(names: list[str], folder: Path, count: int, most_findings: int = 40) -> dict[str, Report]:
    """Read ``count`` mutants with each reader, in a child process that is started anew where one ends it."""
    waiting, first = list(names), 0
    deaths: list[str] = []
    environment = {**os.environ, "PYTHONPATH": f"{TESTS}:{TESTS.parent}:{os.environ.get('PYTHONPATH', '')}"}
    while waiting:
        (folder / "now").unlink(missing_ok=True)
        code = "import sys; from pathlib import Path; from support.mutated_files import _in_child; "
        code += f"_in_child({waiting!r}, Path({str(folder)!r}), {first}, {count})"
        child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
        if child.returncode == 0:
            break
        if child.returncode > 0 or not (folder / "now").exists() or len(deaths) >= most_findings:
            raise AssertionError(f"the child ended with {child.returncode}: {child.stderr[-2000:]}\n{deaths}")
        name, seed, *_ = (folder / "now").read_text().split("\n")
        killed_by = signal.Signals(-child.returncode)
        what = "waits" if killed_by in (signal.SIGALRM, signal.SIGPROF) else killed_by.name
        deaths.append(f"{name} {seed}: {what}")
        waiting, first = waiting[waiting.index(name) :], int(seed) + 1
        if first >= count:
            waiting, first = waiting[1:], 0
    found = {name: Report(name) for name in names}
    lines = (folder / "report.jsonl").read_text().splitlines() if (folder / "report.jsonl").exists() else []
    for line in lines:
        part = Report(**json.loads(line))
        whole = found[part.reader]
        whole.read, whole.refused = whole.read + part.read, whole.refused + part.refused
        whole.grown, whole.slowest = max(whole.grown, part.grown), max(whole.slowest, part.slowest)
        whole.seconds += part.seconds
        whole.findings += part.findings
    for death in deaths:
        name = death.rpartition(" ")[0].rpartition(" ")[0] if death.endswith("waits") else death.rpartition(": ")[0]
        found[name.rpartition(" ")[0] if name not in found else name].findings.append(death)
    return found
