"""Renders captures with y-tal's own `tal render` on demand; driven by one JSON object per line.

{"do": "render", "file", "seed", "out"}   a scene file of y-tal -> {"seconds"}: CPU seconds of this process and of those
that y-tal starts for every point of the laser; the capture (T, X, Y) as .npy

The argument is a folder, the home that y-tal looks for its settings in.
"""

import json
import os
import shutil
import sys
from argparse import Namespace
from importlib.metadata import version
from pathlib import Path

ANSWERS = os.fdopen(os.dup(1), "w", buffering=1)
os.dup2(2, 1)
# y-tal asks for settings that it lacks: it finds nobody there.
REQUESTS = os.fdopen(os.dup(0))
os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
HOME = Path(sys.argv[1])
os.environ["HOME"] = str(HOME)
(HOME / ".tal.conf").write_text("MITSUBA_VERSION=3\nLOG_LEVEL=ERROR\n")

import numpy as np  # noqa: E402
import tal  # noqa: E402
from tal.log import LogLevel, set_log_level  # noqa: E402
from tal.render.render import render_nlos_scene  # noqa: E402


def cpu_seconds():
    """Of this process and of those that have ended."""
    return sum(os.times()[:4])


def main():
    set_log_level(LogLevel.ERROR)
    print(json.dumps({name: version(name) for name in ("y-tal", "mitransient", "mitsuba")}), file=ANSWERS)
    for line in REQUESTS:
        request = json.loads(line)
        arguments = Namespace(
            seed=request["seed"], threads=1, nice=0, gpus=[], dry_run=False, do_steady_renders=False,
            do_ground_truth_renders=False, do_logging=False, keep_partial_results=False,
        )  # fmt: skip
        # Folders are named by the second they are made in.
        folder = Path(request["file"]).parent / "render"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        file = shutil.copy(request["file"], folder / "capture.yaml")
        start = cpu_seconds()
        stored = render_nlos_scene(str(file), arguments)
        seconds = cpu_seconds() - start
        np.save(request["out"], tal.io.read_capture(stored).H)
        print(json.dumps({"seconds": seconds}), file=ANSWERS)


if __name__ == "__main__":
    main()
