"""Error times CPU time of `transient_path_reuse` over `transient_path`, scene by scene, and tests of its means.

All render the same scenes in one process and take turns: `transient_path` with the samplers `independent` (baseline)
and `owen`, `transient_path_reuse` with `owen`, and what `tt.plan(error="relative")` chooses. Per scene: the relative
error of single bins (variance between runs over the squared mean of the 3 x 3 pixels x 3 bins around, 15 bins of 2048,
plus the square of 1 % of the mean over the cube) times CPU seconds, of the baseline over that of reuse: over all bins,
the first, second and last third of the time axis, without the worst 0.1 % of the bins; and of the squared error.
Energy and Student's t of blocks of 8 x 8 pixels x 10 bins are those of reuse against `owen`: mean 0, deviation 1 once
divided by that of t.

`--fit` measures gradients of a squared relative loss at its optimum instead, 64 samples per pixel, forward by each of
the three, backward by plain paths with seeds of their own: variance times CPU seconds of a step, of the baseline over
the others'.

    python benchmarks/path_reuse.py [--fit] [--scenes cornell,glass] [--runs 12] [--archive FILE] [--json FILE]
"""

from __future__ import annotations

import functools
import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _runner import arguments
from sampler_gain import Moments, cornell, small_lamp, staircase, with_box_of
from tqdm import trange

import torchtransient as tt

SceneDict = dict[str, Any]
PATH, REUSE = "transient_path", "transient_path_reuse"
CASES = {"independent": (PATH, "independent"), "owen": (PATH, "owen"), "reuse": (REUSE, "owen")}
PLANNED = "plan"
SCENES: dict[str, tuple[Callable[[], SceneDict], int]] = {
    "cornell": (cornell, 256),
    "cornell 16": (lambda: cornell(16), 256),
    "cornell 16 spp": (cornell, 16),
    "cornell 64 spp": (cornell, 64),
    "cornell 128": (lambda: cornell(128), 64),
    "2048 bins": (lambda: cornell(num_bins=2048, bin_width_opl=6 / 2048), 256),
    "6 cm lamp": (small_lamp, 256),
    "mirror": (lambda: with_box_of({"type": "conductor", "material": "none"}), 256),
    "glass": (lambda: with_box_of({"type": "dielectric"}), 256),
}


def nearby(mean: np.ndarray) -> np.ndarray:
    """Mean over the 3 x 3 pixels x 3 bins around each bin, (C, T, H, W); 15 bins of long axes."""
    around = (3 if mean.shape[1] < 1000 else 15, 3, 3)
    padding = [half for size in reversed(around) for half in (size // 2, size // 2)]
    padded = torch.nn.functional.pad(torch.from_numpy(mean)[None], padding, mode="replicate")
    return torch.nn.functional.avg_pool3d(padded, around, stride=1)[0].numpy()


def errors(variance: np.ndarray, near: np.ndarray) -> dict[str, float]:
    """Figures of one case: relative error of all bins, of thirds, without the worst; squared error."""
    relative = variance / (near**2 + (1e-2 * near.mean()) ** 2)
    third = relative.shape[1] // 3
    parts = {name: relative[:, third * i : third * (i + 1)].mean() for i, name in enumerate(("early", "mid", "late"))}
    trimmed = np.sort(relative.ravel())[: int(0.999 * relative.size)].mean()
    figures = {"relative": relative.mean(), **parts, "trimmed": trimmed, "squared": variance.mean()}
    return {name: float(value) for name, value in figures.items()}


def measure(scene: Any, spp: int, runs: int, variant: str) -> dict[str, Any]:
    """Errors, gains, time and means of every case."""
    names = [*CASES, PLANNED]
    renderers, moments, seconds = {}, {name: Moments() for name in names}, {name: [] for name in names}
    loaded = tt.load(scene, variant=variant)
    kept = {"time_axis": "scene", "max_depth": "scene", "variant": variant}
    for name, (plugin, sampler) in CASES.items():
        plan = tt.plan(loaded, integrator=plugin, pilot=False, **kept)
        renderers[name] = plan.renderer(spp=spp, sampler=sampler, physics="ignore")
    plan = tt.plan(loaded, error="relative", **kept)
    renderers[PLANNED] = plan.renderer(spp=spp, physics="ignore")
    with torch.no_grad():
        for renderer in renderers.values():
            for seed in range(2):
                renderer(seed=seed)
        for run in range(runs):
            for name, renderer in renderers.items():
                begin = time.process_time()
                out = renderer(seed=1000 + run)
                seconds[name].append(time.process_time() - begin)
                moments[name].add(out.transient.double().numpy(), out.steady.double().numpy())
    near = nearby(np.mean([m.mean[0] for m in moments.values()], 0))
    found = {name: errors(moments[name].variance(0), near) for name in names}
    cost = {name: float(np.median(seconds[name])) for name in names}
    result: dict[str, Any] = {"spp": spp, "runs": runs, "planned": plan.integrator}
    for name in names:
        result[name] = {"cpu_seconds": cost[name], "error": found[name]}
        base = found["independent"]
        scale = cost["independent"] / cost[name]
        result[name]["gain"] = {key: scale * base[key] / value for key, value in found[name].items()}
    result["reuse"] |= agreement(moments["reuse"], moments["owen"], runs)
    return result


def agreement(one: Moments, other: Moments, runs: int) -> dict[str, float]:
    """Energy over that of others, and Student's t of blocks."""
    n = 2 * runs - 2
    bars = np.sqrt((one.variance(2) + other.variance(2)) / runs)
    lit = bars > 0
    t = (one.mean[2] - other.mean[2])[lit] / bars[lit]
    error = float(np.sqrt(one.variance(3)[0] + other.variance(3)[0]) / math.sqrt(runs) / other.mean[3][0])
    return {
        "block_t_mean": float(t.mean()),
        "block_t_deviation": float(t.std() / math.sqrt(n / (n - 2))),
        "energy": float(one.mean[3][0] / other.mean[3][0] - 1),
        "energy_standard_error": error,
    }


def gradients_of_a_fit(runs: int, spp: int, variant: str) -> dict[str, Any]:
    """Gains of gradients by a lamp, a wall's colour, and a texture of 16 x 16 texels."""
    keys = {"lamp": "light.emitter.radiance.value", "colour": "red.reflectance.value"}
    keys["texture"] = "floor.bsdf.reflectance.data"
    scene = cornell(40)
    texture = {"type": "bitmap", "data": np.full((16, 16, 3), 0.5, np.float32), "raw": True}
    scene["floor"] |= {"bsdf": {"type": "diffuse", "reflectance": texture}}
    loaded = tt.load(scene, variant=variant)
    renderers = {}
    for name, (plugin, sampler) in CASES.items():
        plan = tt.plan(loaded, integrator=plugin, pilot=False, time_axis="scene", max_depth="scene", variant=variant)
        renderers[name] = plan.renderer(parameters=list(keys.values()), spp=spp, sampler=sampler, physics="ignore")
    with torch.no_grad():
        target = sum(renderers["reuse"](seed=9000 + i, spp=16 * spp).transient for i in range(6)) / 6
    near = torch.from_numpy(nearby(target.numpy()))
    weight = 1 / (near**2 + (1e-2 * near.mean()) ** 2)
    found: dict[str, list[list[torch.Tensor]]] = {name: [] for name in CASES}
    seconds: dict[str, list[float]] = {name: [] for name in CASES}
    for run in trange(runs + 1, leave=False):
        for name, renderer in renderers.items():
            begin = time.process_time()
            loss = ((renderer(seed=1000 + run).transient - target) ** 2 * weight).mean()
            gradients = torch.autograd.grad(loss, [renderer.values[key] for key in keys.values()])
            if run > 0:  # the first one compiles
                seconds[name].append(time.process_time() - begin)
                found[name].append([gradient.double() for gradient in gradients])
    errors = {
        name: [float(torch.stack(column).var(0).sum()) for column in zip(*found[name], strict=True)] for name in CASES
    }
    cost = {name: float(np.median(seconds[name])) for name in CASES}
    report = {}
    for name in CASES:
        scale = cost["independent"] / cost[name]
        gains = [scale * a / b for a, b in zip(errors["independent"], errors[name], strict=True)]
        report[name] = {"cpu_seconds": cost[name], "gain": dict(zip(keys, gains, strict=True))}
    return report


def main() -> None:
    parser = arguments(__doc__, peer=False)
    parser.add_argument("--scenes", default=",".join((*SCENES, "staircase")))
    parser.add_argument("--runs", type=int, default=12)
    parser.add_argument("--fit", action="store_true", help="gradients of a relative loss")
    parser.add_argument("--archive", type=Path, help="staircase_ccby.tar.gz")
    options = parser.parse_args()
    runs = 3 if options.quick else options.runs
    report: dict[str, Any] = {}
    if options.json and options.json.exists():
        report = json.loads(options.json.read_text())
    if options.fit:
        report["fit"] = gradients_of_a_fit(runs, 1 if options.quick else 64, options.variant)
        for name, x in report["fit"].items():
            print(f"{name:16}" + "".join(f"{key:>9} {gain:6.2f}" for key, gain in x["gain"].items()))
    scenes = SCENES | {"staircase": (functools.partial(staircase, options.archive, options.variant), 256)}
    heads = (
        "gain", "early", "mid", "late", "trimmed", "squared", "owen", "plan", "CPU", "t mean", "t dev", "energy", "+-"
    )  # fmt: skip
    if not options.fit:
        print(f"{'scene':16}" + "".join(f"{head:>9}" for head in heads))
    for name in () if options.fit else options.scenes.split(","):
        make, spp = scenes[name]
        x = report[name] = measure(make(), 4 if options.quick else spp, runs, options.variant)
        reuse = x["reuse"]
        gains = "".join(f"{value:9.2f}" for value in reuse["gain"].values())
        cpu = reuse["cpu_seconds"] / x["independent"]["cpu_seconds"]
        print(
            f"{name:16}{gains}{x['owen']['gain']['relative']:9.2f}{x[PLANNED]['gain']['relative']:9.2f}{cpu:9.3f}{reuse['block_t_mean']:9.3f}"
            f"{reuse['block_t_deviation']:9.3f}{reuse['energy']:9.5f}{reuse['energy_standard_error']:9.5f}"
            f"  {x['planned']}",
            flush=True,
        )
    if options.json:
        options.json.write_text(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
