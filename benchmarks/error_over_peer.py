"""Squared error times CPU time of a transient over mitransient's with each of its samplers that is unbiased.

Cornell box, 64 x 64 pixels, 300 bins, depth 8. Both render in processes and environments of their own and take turns.
The error is the variance of single bins between runs, that of relative errors over the squared mean of the 3 x 3
pixels x 3 bins around; both libraries' means are compared by energy.

    python benchmarks/error_over_peer.py --peer-python PYTHON [--runs 12] [--spp 256] [--json FILE]
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from _runner import Worker, arguments, encoded, report, summary
from path_reuse import REUSE, errors, nearby
from sampler_gain import Moments, cornell
from tqdm import tqdm

# Name of a case: library, integrator, sampler.
CASES = {
    "mitransient, independent": ("mitransient", "transient_path", "independent"),
    "mitransient, multijitter": ("mitransient", "transient_path", "multijitter"),
    "owen": ("torchtransient", "transient_path", "owen"),
    "transient_path_reuse": ("torchtransient", REUSE, "owen"),
}


def described(integrator: str, sampler: str, resolution: int) -> dict[str, Any]:
    """The box with an integrator and a sampler."""
    scene = cornell(resolution)
    scene["integrator"] |= {"type": integrator}
    scene["sensor"] |= {"sampler": {"type": sampler, "sample_count": 16}}
    return dict(encoded(scene))


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--runs", type=int, default=12)
    parser.add_argument("--spp", type=int, default=256)
    options = parser.parse_args()
    if options.peer_python is None:
        raise SystemExit("give --peer-python, the python of an environment with mitransient 1.3.1")
    runs, spp = (3, 4) if options.quick else (options.runs, options.spp)
    workers = {
        "mitransient": Worker("mitransient", options.variant, options.peer_python),
        "torchtransient": Worker("torchtransient", options.variant),
    }
    for name, (library, integrator, sampler) in CASES.items():
        scene = described(integrator, sampler, 16 if options.quick else 64)
        workers[library].ask(do="load", name=name, scene=scene)
    moments = {name: Moments() for name in CASES}
    cpu: dict[str, list[float]] = {name: [] for name in CASES}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "cube.npy"
        for run in tqdm(range(-1, runs), unit="round"):
            for name, (library, _, _) in CASES.items():
                answer = workers[library].ask(do="save", name=name, spp=spp, seed=100 + run, file=str(file))
                if run < 0:  # compiles
                    continue
                cube = np.load(file).transpose(3, 2, 0, 1).astype(np.float64)
                moments[name].add(cube, cube.sum(1))
                cpu[name].append(answer["cpu_seconds"])
    for worker in workers.values():
        worker.close()
    near = nearby(np.mean([m.mean[0] for m in moments.values()], 0))
    found = {name: errors(moments[name].variance(0), near) for name in CASES}
    cost = {name: float(np.median(cpu[name])) for name in CASES}
    energy = {name: float(moments[name].mean[3][0]) for name in CASES}
    rows = []
    for name in list(CASES)[2:]:
        for peer in list(CASES)[:2]:
            row = {what: found[peer][what] / found[name][what] * cost[peer] / cost[name] for what in found[name]}
            row |= {"cpu": cost[name] / cost[peer], "energy": energy[name] / energy[peer]}
            print(f"{name:22} over {peer:26}" + "".join(f"  {what} {value:.3g}" for what, value in row.items()))
            rows.append({"of": name, "over": peer, **row})
    settings = {"runs": runs, "spp": spp, "quick": options.quick}
    report("error_over_peer", settings, {"cases": {n: summary(cpu[n]) for n in CASES}, "gains": rows}, options.json)


if __name__ == "__main__":
    main()
