"""What a training step of a small film costs, and what of: tracing, kernels, torch, the layer.

Cornell box with films of 8^2, 32^2 and 128^2 pixels and 16 bins, one sample per pixel. A step is a render, the sum of
squares of what it measured, and its derivative by nothing ("render": no derivative at all), by a colour, by the pose of
a wall (tent filter), by a colour through a phasor film of 16 frequencies, and by a colour with a medium in the room.
Steps that are launched from recordings and steps that are traced (`freeze=False`) take turns in one process. `tracing`
is what a traced step takes beyond a launched one; `kernels` the time that Dr.Jit gives for the kernels of a launched
step, in steps of their own of the same round; `torch` the loss and its derivative on tensors of the same layout,
without a render; `layer` the rest of the launched step. A colour step stands beside `mi.render` of Mitsuba's steady
`prb` on the same film, with `dr.backward`, which is traced at every call.

With `--baseline PATH`, the root of a checkout of the commit before recordings (`git worktree add PATH a78a191`), the
steps of 8^2 run there as well, in a process that takes turns with ours, and the first three calls of either in
processes that find no compiled kernel. Bars, for 8^2: 0.25 x the baseline for a render, 0.2 x for steps to a colour
and to a pose; a colour step in a third of the time of `mi.render`; steps through the time of flight, a phasor film and
a medium at most twice the time of their kernels.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from _comparison import add_baseline
from _runner import (
    HERE,
    ROOT,
    ChildProcess,
    arguments,
    commit_of,
    encoded,
    environment,
    interleave,
    ratio,
    report,
    steady,
    summary,
)

from torchtransient.scenes import cornell_box

COLOUR, POSE, BINS = "red.reflectance.value", "red-wall.to_world", 16
FREQUENCIES = tuple(0.1 * (1 + n) for n in range(16))
# Of a step of 8^2 over the baseline's, and of the whole step over its kernels.
BASELINE_BARS = {"render": 0.25, "colour": 0.2, "pose": 0.2}
KERNEL_BARS = {"pose": 2.0, "phasor film": 2.0, "medium": 2.0}
MITSUBA_BAR = 1 / 3


@dataclass(frozen=True)
class Kind:
    """A kind of step: what its derivative is taken by, and what it goes through."""

    name: str
    key: str = COLOUR
    gradient: bool = True
    tent: bool = False
    frequencies: tuple[float, ...] = ()
    medium: bool = False

    def request(self, resolution: int, freeze: bool | None) -> dict[str, Any]:
        """What a worker loads."""
        scene = with_medium(box(resolution)) if self.medium else box(resolution)
        film = {"frequencies": list(self.frequencies), "tent": self.tent}
        return {"scene": encoded(scene), "keys": [self.key], "gradient": self.gradient, "freeze": freeze, **film}


KINDS = (
    Kind("render", gradient=False),
    Kind("colour"),
    Kind("pose", key=POSE, tent=True),
    Kind("phasor film", frequencies=FREQUENCIES),
    Kind("medium", medium=True),
)


def box(resolution: int) -> dict[str, Any]:
    return cornell_box(resolution, num_bins=BINS, bin_width_opl=6.4 / BINS, spp=1)


def with_medium(scene: Mapping[str, Any]) -> dict[str, Any]:
    """The box with a block of medium in the place of its two solids."""
    room = {key: value for key, value in scene.items() if key not in ("small-box", "large-box")}
    medium = {"type": "homogeneous", "albedo": 0.8, "sigma_t": 2.0, "phase": {"type": "hg", "g": 0.5}}
    pose = np.diag([0.5, 0.5, 0.5, 1.0])
    block = {"type": "cube", "to_world": pose, "bsdf": {"type": "null"}, "interior": medium}
    return {**room, "integrator": {**room["integrator"], "type": "transient_prbvolpath"}, "block": block}


def start(side: str, variant: str, checkout: Path = ROOT, cache: str | None = None) -> ChildProcess:
    """A worker with the package of a checkout; with `cache`, an empty folder, it finds no kernel of an earlier run."""
    search = os.pathsep.join((str(checkout), os.environ["PYTHONPATH"]))
    variables = {**os.environ, "PYTHONPATH": search, **({} if cache is None else {"DRJIT_CACHE_DIR": cache})}
    worker = ChildProcess([sys.executable, str(HERE / "_step_worker.py"), side, variant], env=variables, cwd=checkout)
    if Path(worker.greeting["package"]).resolve() != (checkout / "torchtransient").resolve():
        raise RuntimeError(f"expected the package of {checkout}, the worker imported {worker.greeting['package']}")
    return worker


def measure(kind: Kind, resolution: int, options: Any, repeats: int) -> dict[str, Any]:
    """One line of the table, and its ratios."""
    count = 2 if options.quick else 20 if resolution <= 32 else 5
    small = resolution == 8
    # A run at toy size judges no bar.
    judged = small and not options.quick
    ours = start("torchtransient", options.variant)
    workers = {"launched": ours, "traced": ours}
    requests = {"launched": kind.request(resolution, True), "traced": kind.request(resolution, False)}
    if options.baseline is not None and small:
        workers["baseline"] = start("torchtransient", options.variant, options.baseline)
        requests["baseline"] = kind.request(resolution, None)
    if kind.name == "colour":
        workers["mi.render"] = start("mitsuba", options.variant)
        requests["mi.render"] = {**kind.request(resolution, None), "scene": encoded(steady(box(resolution), "prb"))}
    for worker in set(workers.values()) if options.threads else ():
        worker.ask(do="threads", count=options.threads)
    for name, worker in workers.items():
        worker.ask(do="load", name=name, **requests[name])
    said: list[str] = []
    steps: list[dict[str, Any]] = []
    torch_alone: list[float] = []

    def case(name: str) -> Any:
        def run(seed: int) -> float:
            answer = workers[name].ask(do="step", name=name, seed=seed, count=count)
            if name == "launched":
                said[:] = answer["recorded"]
                # In the same round, so that the noise of the machine is that of the step; the last of four, so that
                # it is launched whatever the history of kernels changes.
                steps.append(ours.ask(do="kernels", name=name, seed=seed, count=4)["steps"][-1])
                torch_alone.append(ours.ask(do="torch", name=name, seed=seed, count=count)["seconds"])
            return float(answer["seconds"])

        return run

    # Three calls until a step is launched.
    print(f"{resolution}^2, {kind.name}", file=sys.stderr)
    seconds = interleave({name: case(name) for name in workers}, repeats, warm_up=4 if options.quick else 2)
    for worker in set(workers.values()):
        worker.close()
    launched = seconds["launched"]
    # Without the warm-up.
    steps, torch_alone = steps[-repeats:], torch_alone[-repeats:]
    kernels = [step["kernel_seconds"] for step in steps]
    rest = [whole - kernel - alone for whole, kernel, alone in zip(launched, kernels, torch_alone, strict=True)]
    parts = {
        "tracing": median(traced - whole for traced, whole in zip(seconds["traced"], launched, strict=True)),
        "kernels": median(kernels),
        "torch": median(torch_alone),
        "layer": median(rest),
    }
    ratios = [ratio(seconds, "launched", "traced")]
    if "baseline" in seconds:
        ratios.append(ratio(seconds, "launched", "baseline", BASELINE_BARS.get(kind.name) if judged else None))
    if "mi.render" in seconds:
        ratios.append(ratio(seconds, "launched", "mi.render", MITSUBA_BAR if judged else None))
    if kind.name in KERNEL_BARS:
        over = summary([whole / kernel for whole, kernel in zip(launched, kernels, strict=True)])
        bar = {"bar": KERNEL_BARS[kind.name], "within": over["median"] <= KERNEL_BARS[kind.name]} if judged else {}
        ratios.append({"of": "launched", "to": "its kernels", **over, **bar})
    return {
        "resolution": resolution,
        "kind": kind.name,
        "seconds": {name: summary(values) for name, values in seconds.items()},
        "parts": parts,
        "launches": steps[-1]["launches"],
        "compiled_when_launched": sum(step["compiled"] for step in steps),
        "recorded": said,
        "ratios": ratios,
    }


def first_calls(kind: Kind, options: Any) -> dict[str, Any]:
    """Kernels and seconds of the first three steps, in fresh processes that find no compiled kernel."""
    sides = {"torchtransient": (ROOT, True), "baseline": (options.baseline, None)}
    found: dict[str, Any] = {"kind": kind.name}
    for side, (checkout, freeze) in sides.items():
        with tempfile.TemporaryDirectory() as cache:
            worker = start("torchtransient", options.variant, checkout, cache)
            worker.ask(do="load", name="first", **kind.request(8, freeze))
            found[side] = worker.ask(do="kernels", name="first", seed=0, count=3)["steps"]
            worker.close()
    return found


def table(rows: list[dict[str, Any]]) -> None:
    """Milliseconds, the launched step in its parts."""
    columns = ("film", "step", "traced", "launched", "tracing", "kernels", "torch", "layer", "mi.render", "baseline")
    print("".join(f"{name:>12}" for name in columns) + "   (ms)")
    for row in rows:
        whole, parts = {name: s["median"] for name, s in row["seconds"].items()}, row["parts"]
        times = [whole["traced"], whole["launched"], *(parts[name] for name in columns[4:8])]
        cells = [f"{1e3 * value:.2f}" for value in times]
        cells += [f"{1e3 * whole[name]:.2f}" if name in whole else "" for name in columns[8:]]
        print("".join(f"{cell:>12}" for cell in (f"{row['resolution']}^2", row["kind"], *cells)))


def main() -> None:
    parser = arguments(__doc__, peer=False)
    add_baseline(parser)
    parser.add_argument("--threads", type=int, help="threads of torch and of Dr.Jit in every process, else theirs")
    options = parser.parse_args()
    repeats = options.repeats or (2 if options.quick else 15)
    sizes = (8,) if options.quick else (8, 32, 128)
    rows = [measure(kind, resolution, options, repeats) for resolution in sizes for kind in KINDS]
    named = [(f"{row['resolution']}^2, {row['kind']}: ", each) for row in rows for each in row["ratios"]]
    results: dict[str, Any] = {
        "ratios": [{**each, "of": name + each["of"]} for name, each in named],
    }
    first = [] if options.baseline is None else [first_calls(kind, options) for kind in KINDS]
    settings = {"bins": BINS, "spp": 1, "frequencies": len(FREQUENCIES), "repeats": repeats}
    settings |= {"threads": options.threads, "quick": options.quick}
    report("step_cost", settings, results, None)
    table(rows)
    for call in first:
        for side in ("torchtransient", "baseline"):
            steps = call[side]
            counts = "+".join(str(step["compiled"]) for step in steps)
            taken = sum(step["compile_seconds"] for step in steps)
            print(f"  first three calls, {call['kind']}, {side}: {counts} kernels compiled in {taken:.3f} s")
    if options.json is not None:
        results |= {"rows": rows, "first_three_calls": first, "environment": environment(options.variant)}
        results["commits"] = {"torchtransient": commit_of(ROOT)}
        if options.baseline is not None:
            results["commits"]["baseline"] = commit_of(options.baseline)
        write(results, settings, options.json)


def write(results: Mapping[str, Any], settings: Mapping[str, Any], path: Path) -> None:
    import json

    data = {"benchmark": "step_cost", "settings": dict(settings), **results}
    path.write_text(json.dumps(data, indent=2) + "\n", encoding="utf-8")
    print(f"  written to {path}")


if __name__ == "__main__":
    main()
