"""Time to the noise that mitransient's NLOS captures have in single bins: its own, and that of shared samples.

Letter Z, a plane and a body of 3 072 triangles before a wall of one metre, confocal and single scans. Noise is the
standard deviation between renders of other seeds, as root mean square over all bins and relative to that of the
capture; a bias, as the peer has where one part hides another, is not in it. The peer renders once with many paths, we
with twice as many samples until our noise is no more. mitransient 1.3.1 runs in the environment of `--peer-python`, or
of the variable TORCHTRANSIENT_PEER_PYTHON, without which there is nothing to compare.
"""

from __future__ import annotations

import os
import statistics
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from _comparison import OURS, PEER
from _runner import Worker, arguments, encoded, environment, report
from nlos_rates import body, letter, plate
from nlos_rates_over_peer import KINDS, scene, write_ply

BARS = {"Z": 20.0, "body": 30.0}


class Side:
    """A library with its scenes loaded."""

    def __init__(self, worker: Worker, scenes: dict[str, Any], folder: Path) -> None:
        self.worker, self.file = worker, str(folder / "transient.npy")
        for name, description in scenes.items():
            worker.ask(do="load", name=name, scene=encoded(description))

    def seconds_and_noise(self, name: str, spp: int, repeats: int) -> tuple[float, float]:
        """Median seconds of a render, and the relative noise of its bins."""
        seconds, runs = [], []
        for seed in range(repeats + 1):
            answer = self.worker.ask(do="save", name=name, spp=spp, seed=seed, file=self.file)
            if seed:  # the first one compiles
                seconds.append(answer["seconds"])
                runs.append(np.load(self.file).astype(float).ravel())
        of_bins = np.array(runs)
        noise = np.sqrt(of_bins.var(0, ddof=1).mean() / np.square(of_bins.mean(0)).mean())
        return statistics.median(seconds), float(noise)


def to_the_noise(ours: Side, name: str, least: int, most: int, goal: float, repeats: int) -> dict[str, float]:
    """Samples, seconds and noise of the first render with no more noise than ``goal``."""
    spp = least
    while True:
        seconds, noise = ours.seconds_and_noise(name, spp, repeats)
        if noise <= goal or spp >= most:
            return {"spp": spp, "seconds": seconds, "noise": noise}
        spp *= 2


def main() -> None:
    parser = arguments(__doc__)
    parser.set_defaults(variant="llvm_ad_mono", peer_python=os.environ.get("TORCHTRANSIENT_PEER_PYTHON"))
    options = parser.parse_args()
    if options.peer_python is None:
        parser.error("expected --peer-python, or the variable TORCHTRANSIENT_PEER_PYTHON")
    scan, spp, repeats = (4, 64, 3) if options.quick else (32, 16384, options.repeats or 8)
    hidden = {"Z": letter(), "plane": plate(1, 1, (0, 0, 1)), "body": body(1 if options.quick else 3)}
    gains: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        files = {shape: write_ply(folder / f"{shape}.ply", arrays) for shape, arrays in hidden.items()}
        scenes = {f"{shape}, {kind}": scene(file, scan, kind) for shape, file in files.items() for kind in KINDS}
        workers = [Worker(OURS, options.variant), Worker(PEER, options.variant, options.peer_python)]
        ours, peer = (Side(worker, scenes, folder) for worker in workers)
        for case in scenes:
            seconds, noise = peer.seconds_and_noise(case, spp, repeats)
            found = to_the_noise(ours, case, 2, 2 * spp, noise, repeats)
            bar = BARS.get(case.split(",")[0])
            gains[case] = {
                "times faster": round(seconds / found["seconds"], 1),
                "bar": bar,
                "peer": {"spp": spp, "seconds": round(seconds, 4), "noise": round(noise, 5)},
                "ours": {key: round(value, 5) for key, value in found.items()},
            }
            print(f"  {case}: {gains[case]}")
        for worker in workers:
            worker.close()
    settings = {"scan": scan, "repeats": repeats, "quick": options.quick}
    report("nlos_error_over_peer", settings, {"environment": environment(options.variant), **gains}, options.json)


if __name__ == "__main__":
    main()
