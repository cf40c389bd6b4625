"""Every reader of files against mutants of files that it reads, in a process of its own: what it must never do is die,
wait, raise what has no type, or return other content where a checksum stands beside it.
"""

from __future__ import annotations

import io
import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
import traceback
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from support.read_files import READERS, Reader  # isort: skip  # the package, before Mitsuba

import h5py
import numpy as np

from support.hostile_captures import structure_changed
from torchtransient.errors import TorchTransientError

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


# --------------------------------------------------------------------------------------------------------- mutations

NUMBERS = (
    "0", "-1", "1", "3.7", "1e400", "-1e308", "1e-320", ".nan", "nan", ".inf", "-.inf", "Infinity", "NaN",
    "2147483648", "4294967296", "9223372036854775808", "1" + "0" * 30, "9" * 5000, "1e12", "0x10", "1_000", "1:30",
    "true", "null", "~",
)  # fmt: skip
WORDS = (
    "[]", "{}", '""', "''", "[1, 2]", "{a: 1}", '{"a": 1}', "[[]]", "None", "False", "ü", "\x00", "\x85", "\ufeff",
    "&a", "*a", "!!binary", "!!python/object/apply:os.getcwd []", "<<: *a", "- ", ": ", "? ", "|", ">", "#", "%", "'",
    '"', "{", "}", "[", "]", "<", ">", "/>", "&amp;", "&#0;", "$name", "../../../etc/passwd", "2020-01-01", "1e5",
    "<!DOCTYPE a [<!ENTITY b SYSTEM 'file:///etc/passwd'>]>", "[" * 3000, "{a: " * 2000, "<a>" * 2000, "x" * 5000,
)  # fmt: skip
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_TOKEN = re.compile(r"[A-Za-z_][\w.]*|-?\d+(?:\.\d+)?|[^\s\w]")


def bytes_mutated(data: bytes, rng: random.Random) -> bytes:
    """Bits flipped, bytes and runs of them replaced, taken out, put in, moved, doubled, cut off."""
    found = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 5, 20))):
        if not found:
            break
        place = rng.randrange(len(found))
        length = min(rng.choice((1, 2, 4, 8, 64, 600)), len(found) - place)
        other = rng.randrange(len(found))
        match rng.randrange(9):
            case 0 | 1:
                found[place] ^= 1 << rng.randrange(8)
            case 2:
                found[place] = rng.choice((0, 255, rng.randrange(256)))
            case 3:
                found[place : place + length] = rng.randbytes(length)
            case 4:
                found[place : place + length] = bytes((rng.choice((0, 255)),)) * length
            case 5:
                del found[place : place + length]
            case 6:
                found[place:place] = rng.choice((rng.randbytes(length), found[other : other + length]))
            case 7:
                found[place : place + length] = found[other : other + length]
            case _ if rng.random() < 0.3:
                del found[place:]
            case _:
                # A number of the width that headers have.
                width = rng.choice((1, 2, 4, 8))
                value = rng.choice((0, 1, 2**31 - 1, 2**32 - 1, 2**63 - 1, 2**64 - 1, len(found), rng.randrange(2**16)))
                found[place : place + width] = (value % 256**width).to_bytes(width, rng.choice(("little", "big")))
    return bytes(found)


def text_mutated(data: bytes, rng: random.Random) -> bytes:
    """Numbers and words replaced by others, lines doubled, missing, moved and indented; a quarter as bytes."""
    if rng.random() < 0.25:
        return bytes_mutated(data, rng)
    text = data.decode("utf-8")
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        lines = text.split("\n")
        line = rng.randrange(len(lines))
        match rng.randrange(8):
            case 0 | 1:
                text = _replaced(text, _NUMBER, rng.choice(NUMBERS), rng)
            case 2:
                text = _replaced(text, _TOKEN, rng.choice((*WORDS, *NUMBERS)), rng)
            case 3:
                tokens = _TOKEN.findall(text) or [""]
                text = _replaced(text, _TOKEN, rng.choice(tokens), rng)
            case 4:
                del lines[line]
                text = "\n".join(lines)
            case 5:
                lines.insert(rng.randrange(len(lines)), lines[line])
                text = "\n".join(lines)
            case 6:
                lines[line] = rng.choice((" ", "  ", "\t", "- ")) + lines[line]
                text = "\n".join(lines)
            case _:
                place = rng.randrange(len(text) + 1)
                text = text[:place] + rng.choice((*WORDS, *NUMBERS)) + text[place:]
    return text.encode("utf-8", "surrogatepass")


def _replaced(text: str, kind: re.Pattern[str], by: str, rng: random.Random) -> str:
    places = list(kind.finditer(text))
    if not places:
        return text + by
    place = rng.choice(places)
    return text[: place.start()] + by + text[place.end() :]


def archive_mutated(data: bytes, rng: random.Random) -> bytes:
    """A `.npz` whose members are whole, and one of them another array, or missing, or doubled."""
    with zipfile.ZipFile(io.BytesIO(data)) as file:
        members = [(name, file.read(name)) for name in file.namelist()]
    number = rng.randrange(len(members))
    name, content = members[number]
    match rng.randrange(6):
        case 0:
            del members[number]
        case 1:
            members.append((rng.choice(members)[0], content))
        case 2:
            members[number] = (name, bytes_mutated(content, rng))
        case 3:
            members[number] = (name, _npy(_other(np.load(io.BytesIO(content), allow_pickle=False), rng)))
        case 4:
            other = rng.randrange(len(members))
            members[number], members[other] = (name, members[other][1]), (members[other][0], content)
        case _:
            array = np.load(io.BytesIO(content), allow_pickle=False)
            plain = array.tolist() if array.dtype.kind != "c" else 0
            text = str(array) if array.dtype.kind == "U" else json.dumps(plain)
            changed = text_mutated(text.encode(), rng).decode("utf-8", "replace")
            members[number] = (name, _npy(np.array(changed)))
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as file:
        for name, content in members:
            file.writestr(zipfile.ZipInfo(name), content)
    return stream.getvalue()


def _npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=False)
    return stream.getvalue()


def _other(array: np.ndarray, rng: random.Random) -> np.ndarray:
    """An array of another kind, shape or value."""
    kinds = ("i1", "u8", "f2", "f8", ">f4", "c8", "?", "S5", "V3", "f16", "U3", "M8[s]", "c16")
    shape = tuple(rng.choice((0, 1, 2, 3, 5, 7)) for _ in range(rng.randrange(7)))
    values = (np.nan, np.inf, -1.0, 0.0, 1e308, -1e308, 1e30, 0.5, 2.0**53)
    match rng.randrange(3):
        case 0:
            return np.zeros(array.shape, rng.choice(kinds))
        case 1:
            return np.zeros(shape, array.dtype)
        case _:
            return np.full(array.shape, rng.choice(values))


def hdf5_mutated(source: Path, target: Path, rng: random.Random) -> None:
    """A dataset is another in shape, kind, size or place, or an attribute is."""
    with h5py.File(source) as file:
        names = list(file.attrs)
    if not names or rng.random() < 0.5:
        structure_changed(source, target, rng)
        return
    target.write_bytes(source.read_bytes())
    with h5py.File(target, "r+") as file:
        name = rng.choice(names)
        old = file.attrs[name]
        del file.attrs[name]
        match rng.randrange(4):
            case 0:
                pass
            case 1 if isinstance(old, str):
                changed = text_mutated(old.encode(), rng).decode("utf-8", "replace").replace("\x00", "")
                file.attrs[name] = changed[:30000]
            case 2:
                file.attrs[name] = h5py.Empty("f4")
            case _:
                other = _other(np.asarray(0.0), rng)
                file.attrs[name] = other if other.dtype.kind not in "UM" else "text"


def mutant(source: Path, target: Path, seed: int) -> None:
    """Write the mutant of a seed."""
    rng = random.Random(seed)
    ending, data = source.suffix.lower(), source.read_bytes()
    if ending in (".h5", ".hdf5") and rng.random() < 0.4:
        hdf5_mutated(source, target, rng)
        return
    change: Callable[[bytes, random.Random], bytes] = bytes_mutated
    if ending == ".npz" and rng.random() < 0.5:
        change = archive_mutated
    elif ending in (".yaml", ".json", ".xml"):
        change = text_mutated
    target.write_bytes(change(data, rng))
