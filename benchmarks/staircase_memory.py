"""Peak memory of the wood staircase, 720 x 1280 pixels x 400 bins x 3 channels, over the size of its cube.

Needs the scene: `--archive staircase_ccby.tar.gz` (The Wooden Staircase by Wig42, CC-BY 3.0). Every case renders once
in a process of its own, whose peak resident set is read at the end; what was resident before the render is shown beside
it. Cases: the integrator alone, the torch layer (`TransientRenderer`, the cube as a torch tensor), and with
`--peer-python` mitransient. Bar: 1.3 x the cube. The full size needs about 8 GB of memory, the peer about 11 GB.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path
from typing import Any

from _runner import Worker, arguments, environment, report

LAYER = """
import json, resource, sys
import torchtransient as tt
path, variant, parameters, spp = json.loads(sys.argv[1])
renderer = tt.TransientRenderer(tt.load(path, variant=variant, **parameters), parameters=[], spp=spp)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
out = renderer(seed=0)
shape, total = tuple(out.transient.shape), float(out.steady.mean())
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
print("RESULT " + json.dumps({"before_bytes": before, "peak_bytes": peak, "shape": shape, "mean": total}))
"""


def find_scene(archive: Path, folder: Path) -> Path:
    """Unpack the archive into `folder` and return the scene file."""
    with tarfile.open(archive) as tar:
        tar.extractall(folder, filter="data")
    found = sorted(folder.rglob("scene.xml"))
    if not found:
        raise FileNotFoundError(f"{archive}: expected a scene.xml inside, found none")
    return found[0]


def integrator_case(
    library: str, variant: str, python: str | None, scene: Path, sizes: dict[str, int]
) -> dict[str, Any]:
    """Peak of a worker that loads the scene and renders once."""
    worker = Worker(library, variant, python)
    worker.ask(do="load", name="staircase", scene={"xml": str(scene), "parameters": sizes})
    before = worker.ask(do="memory")["peak_bytes"]
    answer = worker.ask(do="render", name="staircase", spp=sizes["spp"], seed=0)
    peak = worker.ask(do="memory")["peak_bytes"]
    worker.close()
    return {"before_bytes": before, "peak_bytes": peak, "mean": answer["mean"], "seconds": answer["seconds"]}


def layer_case(variant: str, scene: Path, sizes: dict[str, int]) -> dict[str, Any]:
    """Peak of a process that renders through `TransientRenderer`."""
    import json

    request = json.dumps([str(scene), variant, {key: str(value) for key, value in sizes.items()}, sizes["spp"]])
    done = subprocess.run(
        [sys.executable, "-c", LAYER, request], check=True, capture_output=True, text=True, env=dict(os.environ)
    )
    line = next(line for line in done.stdout.splitlines() if line.startswith("RESULT "))
    result: dict[str, Any] = json.loads(line.removeprefix("RESULT "))
    return result


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--archive", type=Path, required=True, help="staircase_ccby.tar.gz")
    options = parser.parse_args()
    sizes = {"resx": 720, "resy": 1280, "spp": 16, "max_depth": 65}
    if options.quick:
        sizes = {"resx": 72, "resy": 128, "spp": 2, "max_depth": 8}
    cube = sizes["resx"] * sizes["resy"] * 400 * 3 * 4
    with tempfile.TemporaryDirectory() as folder:
        scene = find_scene(options.archive, Path(folder))
        cases = {
            "torchtransient: integrator": integrator_case("torchtransient", options.variant, None, scene, sizes),
            "torchtransient: layer": layer_case(options.variant, scene, sizes),
        }
        if options.peer_python:
            peer = integrator_case("mitransient", options.variant, options.peer_python, scene, sizes)
            cases["mitransient: integrator"] = peer
    results: dict[str, Any] = {"cube_bytes": cube, "environment": environment(options.variant)}
    for name, case in cases.items():
        over = case["peak_bytes"] / cube
        results[name] = {
            **case,
            "peak_over_cube": over,
            "added_over_cube": (case["peak_bytes"] - case["before_bytes"]) / cube,
        }
        if name == "torchtransient: layer":
            results[name].update(bar=1.3, within=over <= 1.3)
    report("staircase_memory", {**sizes, "quick": options.quick}, results, options.json)


if __name__ == "__main__":
    main()
