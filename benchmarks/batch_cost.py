"""A batch, and several sensors in one call, beside as many calls.

Cornell box, colour of the red wall. Large films: 8 entries of 256^2 x 300 bins at 16 samples per pixel, rendered alone,
with the derivative of the sum, and with that of the sum of squares (whose adjoint is as large as the result). Small
ones: 8 values, and 8 cameras, of 8^2 x 16 bins at one sample. Both sides take turns in one process; then each runs
alone in a process of its own for its peak memory. The loop lets go of every result before the next one; the batch holds
all of them. Bars: 1.02 x the loop for large films, 0.5 x for small ones and for cameras.
"""

from __future__ import annotations

import copy
import json
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from _runner import arguments, environment, interleave, ratio, report, summary

import torchtransient as tt

import torch  # isort: skip

KEY, ENTRIES = "red.reflectance.value", 8
LARGE_BAR, SMALL_BAR = 1.02, 0.5
Job = Callable[[int], Any]
Pair = tuple[Job, Job, float]


def box(resolution: int, bins: int) -> dict[str, Any]:
    return tt.scenes.cornell_box(resolution, num_bins=bins, bin_width_opl=6.0 / bins)


def cameras(resolution: int, bins: int) -> dict[str, Any]:
    """The box with 8 cameras beside each other."""
    scene = box(resolution, bins)
    first = scene.pop("sensor")
    for n in range(ENTRIES):
        sensor = copy.deepcopy(first)
        pose = np.array(sensor["to_world"])
        pose[0, 3] += 0.02 * n
        scene[f"sensor{n}"] = {**sensor, "to_world": pose}
    return scene


def of_values(resolution: int, bins: int, spp: int, loss: str, variant: str) -> tuple[Job, Job]:
    """(loop, batch) over values of the colour. ``loss``: "", "sum" or "squares"."""
    scene = tt.load(box(resolution, bins), variant=variant)
    renderer = tt.TransientRenderer(scene, parameters=[KEY], spp=spp, physics="ignore")
    values = torch.rand(ENTRIES, 3, generator=torch.Generator().manual_seed(0)) * 0.5 + 0.2

    def run(value: torch.Tensor, seed: int) -> None:
        value = value.clone().requires_grad_(bool(loss))
        differentiate(renderer({KEY: value}, seed=seed), loss)

    def loop(seed: int) -> None:
        for n in range(ENTRIES):
            run(values[n], ENTRIES * seed + n)

    return loop, lambda seed: run(values, ENTRIES * seed)


def of_cameras(resolution: int, bins: int, spp: int, loss: str, variant: str) -> tuple[Job, Job]:
    """(loop, one call) over cameras."""
    scene = tt.load(cameras(resolution, bins), variant=variant)
    settings: dict[str, Any] = {"parameters": [KEY], "spp": spp, "physics": "ignore"}
    together = tt.TransientRenderer(scene, sensors="all", **settings)
    single = [tt.TransientRenderer(scene, sensors=n, **settings) for n in range(ENTRIES)]

    def run(renderer: tt.TransientRenderer, seed: int) -> None:
        renderer.zero_grad()
        with torch.set_grad_enabled(bool(loss)):
            out = renderer(seed=seed)
        differentiate(out, loss)

    def loop(seed: int) -> None:
        for n, renderer in enumerate(single):
            run(renderer, ENTRIES * seed + n)

    return loop, lambda seed: run(together, ENTRIES * seed)


def differentiate(out: tt.RenderOutput, loss: str) -> None:
    if loss:
        (out.transient.sum() if loss == "sum" else out.transient.square().sum()).backward()


def pairs(quick: bool, variant: str) -> dict[str, Callable[[], Pair]]:
    """What is compared, made when it is its turn."""
    large = (16, 60, 4) if quick else (256, 300, 16)
    found: dict[str, Callable[[], Pair]] = {}
    for name, loss in (("render", ""), ("render and sum", "sum"), ("render and squares", "squares")):
        found[f"large, {name}"] = lambda loss=loss: (*of_values(*large, loss, variant), LARGE_BAR)
        found[f"small, {name}"] = lambda loss=loss: (*of_values(8, 16, 1, loss, variant), SMALL_BAR)
        found[f"cameras, {name}"] = lambda loss=loss: (*of_cameras(8, 16, 1, loss, variant), SMALL_BAR)
    return found


def timed(job: Job, count: int) -> Job:
    """Seconds of one of `count` runs."""

    def run(seed: int) -> float:
        begin = time.perf_counter()
        for n in range(count):
            job(count * seed + n)
        return (time.perf_counter() - begin) / count

    return run


def peak_bytes() -> int:
    """Largest resident set of this process so far (Linux)."""
    with open("/proc/self/status", encoding="ascii") as file:
        return next(int(line.split()[1]) * 1024 for line in file if line.startswith("VmHWM:"))


def alone(name: str, side: int, options: Any) -> int:
    """Peak memory of a side of a pair in a process of its own."""
    command = [sys.executable, __file__, "--alone", name, str(side), "--variant", options.variant]
    command += ["--quick"] * options.quick
    command += [] if options.threads is None else ["--threads", str(options.threads)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return int(json.loads(done.stdout.splitlines()[-1]))


def main() -> None:
    parser = arguments(__doc__, peer=False)
    parser.add_argument("--only", default="", help="pairs whose names have this in them")
    parser.add_argument("--alone", nargs=2, metavar=("PAIR", "SIDE"), help="peak memory of one side, in this process")
    parser.add_argument("--threads", type=int, help="threads of torch and of Dr.Jit, else theirs")
    options = parser.parse_args()
    tt.threads(options.threads)
    every = pairs(options.quick, options.variant)
    if options.alone:
        job = every[options.alone[0]]()[int(options.alone[1])]
        for seed in range(3):
            job(seed)
        print(json.dumps(peak_bytes()))
        return
    cases: dict[str, Any] = {}
    ratios, memory = [], {}
    for name, made in every.items():
        if options.only not in name:
            continue
        loop, batch, bar = made()
        small = bar == SMALL_BAR
        repeats = options.repeats or (2 if options.quick else 30 if small else 7)
        count = 5 if small and not options.quick else 1
        names = {f"{name}: loop": timed(loop, count), f"{name}: batch": timed(batch, count)}
        seconds = interleave(names, repeats, warm_up=3 if small else 1)
        cases |= {case: summary(values) for case, values in seconds.items()}
        ratios.append(ratio(seconds, f"{name}: batch", f"{name}: loop", bar))
        peaks = [alone(name, side, options) for side in (0, 1)]
        memory[name] = {"loop": peaks[0], "batch": peaks[1], "batch_over_loop": round(peaks[1] / peaks[0], 3)}
    results = {"cases": cases, "ratios": ratios, "peak_bytes": memory, "environment": environment(options.variant)}
    settings = {"entries": ENTRIES, "large": "256^2 x 300 x 16 spp", "small": "8^2 x 16 x 1 spp"}
    settings |= {"threads": repr(tt.threads()), "quick": options.quick}
    report("batch_cost", settings, results, options.json)


if __name__ == "__main__":
    main()
