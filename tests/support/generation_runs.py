"""Runs of `generate` in processes of their own, and what they left."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import torchtransient

TESTS = Path(__file__).parents[1]
SCRIPT = """
import sys
import torchtransient
from support.fake_recipe import FakeRecipe
from torchtransient.data import generate
{before}
if __name__ == "__main__":
    print(generate({recipe!r}, {folder!r}, progress=False, **{arguments!r}))
"""


def environment():
    """Children take the package from where this process has it."""
    places = [str(Path(torchtransient.__file__).parents[1]), str(TESTS), os.environ.get("PYTHONPATH", "")]
    return os.environ | {"PYTHONPATH": os.pathsep.join(places)}


def start(recipe, folder, *, before="", **arguments):
    """A process that generates."""
    code = SCRIPT.format(recipe=recipe, folder=str(folder), arguments=arguments, before=before)
    return _process([sys.executable, "-c", code])


def start_command(folder, *arguments):
    """A process of the command line, in a folder."""
    return _process([sys.executable, "-m", "torchtransient", *arguments], cwd=folder)


def _process(command, **more):
    """In a group of its own, as a terminal would have it."""
    # What is started in the background ignores interrupts, and hands that on.
    handler = signal.signal(signal.SIGINT, signal.SIG_DFL)
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    try:
        return subprocess.Popen(command, env=environment(), start_new_session=True, **pipes, **more)
    finally:
        signal.signal(signal.SIGINT, handler)


def finish(child, seconds=120):
    """(status, what it said on stdout, on stderr)"""
    out, err = child.communicate(timeout=seconds)
    return child.returncode, out, err


def workers_of(pid):
    """Processes that a run has started to work for it."""
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        return [int(child) for child in children if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()]
    except OSError:
        return []


def alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def wait_until(condition, seconds=300.0, every=0.002):
    """The first value of `condition()` that is true."""
    until = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < until, "nothing happened"
        time.sleep(every)
    return found


def kill(pid):
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        return False
    return True


def data_files(folder):
    """Hashes of what is data, by name: shards, manifest, recipe."""
    paths = [*Path(folder).glob("shard-*.h5"), Path(folder) / "manifest.json", Path(folder) / "recipe.json"]
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}


def leftovers(folder):
    """Files that no data set has."""
    known = {"manifest.json", "recipe.json", "log.jsonl", "latest.png"}
    return sorted(p.name for p in Path(folder).iterdir() if p.name not in known and not p.name.startswith("shard-"))


def damage(folder):
    """A file of samples is missing, the next one is cut, one that was being written is left over, as is half a line."""
    (folder / "shard-000001.h5").unlink()
    os.truncate(folder / "shard-000002.h5", 3000)
    (folder / ".shard-000004.h5.12345678.part").write_bytes(b"half")
    with (folder / "log.jsonl").open("a") as log:
        log.write('{"half')
