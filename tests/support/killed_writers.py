"""A writer of results that is killed at any moment, again and again: what is in its place is one of two whole files."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import torch


def output(seed: int):
    """A render of half a megabyte, all of whose numbers depend on the seed."""
    from torchtransient import RenderOutput, RenderStats
    from torchtransient.axes import TimeAxis

    stats = RenderStats(
        spp=16, seconds=0.5, samples_per_second=1e4, variant="llvm_ad_rgb", integrator="transient_path",
        temporal_filter="box", seeds=(seed,), energy_before=(0.0,), energy_after=(0.25,), energy_total=(1.0,),
    )  # fmt: skip
    film = torch.rand(32, 32, 40, 3, generator=torch.Generator().manual_seed(seed))
    cube = film.movedim((-1, -2), (-4, -3))
    return RenderOutput(cube, cube.sum(-3), None, axis=TimeAxis(3.5, 0.02, 40), stats=stats)


def killed_writers(folder: Path, kills: int, seed: int) -> Counter[str]:
    """What was found after each kill: "old" and "new" files, by the order in which they were written, and "parts" that
    were left. Raises AssertionError for a file that is neither, and for parts that the next writer leaves.

    In a process that may fork: one thread, nothing of Dr.Jit.
    """
    from torchtransient.files import read_result, write_result

    rng, found = random.Random(seed), Counter({"old": 0, "new": 0, "parts": 0})
    outputs = [output(0), output(1)]
    for number in range(kills):
        path = folder / ("a.h5" if number % 4 else "a.npz")
        write_result(path, outputs[0])
        now, ready = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(now)
            os.write(ready, b"x")
            while True:
                write_result(path, outputs[1])
                write_result(path, outputs[0])
        os.close(ready)
        os.read(now, 1)
        os.close(now)
        time.sleep(rng.uniform(0, 0.03))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        left = [one for one in folder.iterdir() if one.suffix == ".part"]
        found["parts"] += len(left)
        transient = read_result(path).transient
        which = [torch.equal(transient, one.transient) for one in outputs]
        assert any(which), f"kill {number}: the file is neither of the two"
        found["old" if which[0] else "new"] += 1
        write_result(path, outputs[0])
        assert {one.suffix for one in folder.iterdir()} <= {".h5", ".npz"}, sorted(folder.iterdir())
    return found


def in_child(folder: Path, kills: int, seed: int) -> dict[str, int]:
    """:func:`killed_writers` in a process of one thread."""
    tests = Path(__file__).parents[1]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": f"{tests}:{tests.parent}"}
    arguments = [sys.executable, "-m", "support.killed_writers", str(folder), str(kills), str(seed)]
    child = subprocess.run(arguments, capture_output=True, text=True, env=environment)
    assert child.returncode == 0, child.stderr[-2000:]
    found: dict[str, int] = json.loads(child.stdout)
    return found


if __name__ == "__main__":
    torch.set_num_threads(1)
    print(json.dumps(killed_writers(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))))
