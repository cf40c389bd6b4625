"""Squared error times CPU time of the sampler `owen` over `independent`, scene by scene, and tests of its means.

Both render the same scenes in one process and take turns. Per scene: the ratio of squared error x time of the histogram
and of the steady image (the variance between runs, summed over bins and pixels; larger than 1: `owen` is better), the
ratio of CPU seconds, and how far apart the means are: energy (with its standard error), and Student's t of blocks of
8 x 8 pixels x 10 bins, whose mean should be 0 and whose deviation that of t (sqrt(n / (n - 2)), n of Welch), by
which it is divided.

Derivatives (scenes "gradient ..."): variance of the derivatives of the histogram times one period of a cosine over the
window, by the red wall's reflectance and the lamp's radiance, times the CPU seconds of a render and its backward pass;
"step ..." is the same of launched training steps of 16 bins at one sample, of which the CPU counts.

    python benchmarks/sampler_gain.py [--scenes cornell,glass] [--samplers owen,multijitter] [--runs 12] [--json FILE]

The staircase needs `--archive staircase_ccby.tar.gz` (The Wooden Staircase by Wig42, CC-BY 3.0).
"""

from __future__ import annotations

import functools
import json
import math
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from _runner import arguments, environment

import torchtransient as tt

SceneDict = dict[str, Any]
HEADS = ("gain", "steady", "CPU", "t mean", "t dev", "energy", "+-")
# Samples and number of all runs of a scene of few samples, which take milliseconds and have rare outliers.
MOST_SAMPLES, MOST_RUNS = 4800, 600
# Training steps that are timed.
STEPS = 400
# By which scenes are differentiated.
KEYS = ("red.reflectance.value", "light.emitter.radiance.value")


def cornell(resolution: int = 64, **settings: Any) -> SceneDict:
    """The Cornell box, 300 bins."""
    settings.setdefault("num_bins", 300)
    return tt.scenes.cornell_box(resolution=resolution, **settings)


def small_lamp() -> SceneDict:
    """The Cornell box with a lamp of 6 cm, as bright in sum as the large one."""
    from torchtransient.scenes import rotate, scale, translate

    scene = cornell()
    scene["light"]["to_world"] = translate([0.0, 0.99, 0.01]) @ rotate([1, 0, 0], 90) @ scale([0.03, 0.03, 0.03])
    ratio = 0.23 * 0.19 / 0.03**2
    scene["light"]["emitter"]["radiance"]["value"] = [ratio * x for x in (18.387, 13.9873, 6.75357)]
    return scene


def with_box_of(bsdf: SceneDict) -> SceneDict:
    """The Cornell box with a large box of another material, 48 x 48 pixels."""
    scene = cornell(48)
    scene["large-box"] = {**scene["large-box"], "bsdf": bsdf}
    return scene


def fog() -> SceneDict:
    """The Cornell box full of thin fog, 48 x 48 pixels."""
    from torchtransient.scenes import scale

    scene = cornell(48)
    medium = {"type": "homogeneous", "sigma_t": 0.3, "albedo": 0.9, "phase": {"type": "hg", "g": 0.3}}
    scene["fog"] = {"type": "cube", "to_world": scale(0.999), "bsdf": {"type": "null"}, "interior": medium}
    scene["integrator"] = {**scene["integrator"], "type": "transient_prbvolpath"}
    return scene


def nlos(kind: str) -> SceneDict:
    """A letter behind a corner, 32 x 32 points x 256 bins, up to five bounces, by general paths."""
    scan = tt.nlos.Scan.grid(tt.nlos.Wall.plane(1.0, 1.0), 32, kind=kind)
    scene = tt.nlos.capture_scene(tt.scenes.nlos_z(), scan, bounces=(3, 4, 5))
    scene["integrator"] |= {"third_bounce": "paths", "late_light": "paths"}
    scene["wall"]["sensor"]["film"] |= {"start_opl": 1.6, "bin_width_opl": 0.01, "temporal_bins": 256}
    return scene


def staircase(archive: Path | None, variant: str) -> Any:
    """The wooden staircase, 36 x 64 pixels x 400 bins."""
    from staircase_memory import find_scene

    if archive is None:
        raise SystemExit("staircase: give --archive staircase_ccby.tar.gz, or leave it out of --scenes.")
    _unpacked.append(tempfile.TemporaryDirectory())
    sizes = {"resx": 36, "resy": 64, "max_depth": 8, "spp": 16}
    path = find_scene(archive, Path(_unpacked[-1].name))
    return tt.load(path, variant=variant, **{key: str(value) for key, value in sizes.items()})


# Folders of scenes, until the process ends.
_unpacked: list[tempfile.TemporaryDirectory[str]] = []

Made = Callable[[], Any]
SCENES: dict[str, tuple[Made, int]] = {
    "cornell": (cornell, 256),
    "cornell 128": (lambda: cornell(128), 256),
    "2048 bins": (lambda: cornell(num_bins=2048, bin_width_opl=300 * 0.03 / 2048), 256),
    "6 cm lamp": (small_lamp, 256),
    "mirror": (lambda: with_box_of({"type": "conductor", "material": "none"}), 256),
    "glass": (lambda: with_box_of({"type": "dielectric"}), 256),
    "fog": (fog, 256),
    "nlos confocal": (lambda: nlos("confocal"), 256),
    "nlos single": (lambda: nlos("single"), 256),
    "cornell 1 spp": (lambda: cornell(24), 1),
    "cornell 4 spp": (lambda: cornell(24), 4),
    "cornell 6 spp": (lambda: cornell(24), 6),
    "cornell 16 spp": (lambda: cornell(24), 16),
    "cornell 48 spp": (lambda: cornell(24), 48),
    "cornell 64 spp": (lambda: cornell(24), 64),
    "gradient 16 spp": (lambda: cornell(24), 16),
    "gradient 64 spp": (lambda: cornell(24), 64),
    "gradient 256 spp": (lambda: cornell(24), 256),
    "step 8 x 8": (lambda: cornell(8, num_bins=16, bin_width_opl=0.5), 1),
    "step 32 x 32": (lambda: cornell(32, num_bins=16, bin_width_opl=0.5), 1),
    "step 128 x 128": (lambda: cornell(128, num_bins=16, bin_width_opl=0.5), 1),
}


class Moments:
    """Mean and variance of runs (Welford), and of their sums over blocks of 8 x 8 pixels x 10 bins."""

    def __init__(self) -> None:
        self.count = 0

    def add(self, cube: np.ndarray, steady: np.ndarray) -> None:
        self.count += 1
        values = [cube, steady, _blocks(cube), np.atleast_1d(steady.sum())]
        if self.count == 1:
            self.mean, self.m2 = values, [np.zeros_like(v) for v in values]
            return
        for i, value in enumerate(values):
            step = value - self.mean[i]
            self.mean[i] = self.mean[i] + step / self.count
            self.m2[i] = self.m2[i] + step * (value - self.mean[i])

    def variance(self, i: int) -> np.ndarray:
        return self.m2[i] / (self.count - 1)


def _blocks(cube: np.ndarray) -> np.ndarray:
    bins, height, width = cube.shape[-3:]
    cube = cube.sum(0)[: bins // 10 * 10, : max(8, height // 8 * 8), : max(8, width // 8 * 8)]
    bins, height, width = cube.shape
    by = (min(8, height), min(8, width))
    return cube.reshape(bins // 10, 10, height // by[0], by[0], width // by[1], by[1]).sum((1, 3, 5))


def measure(scene: Any, spp: int, samplers: list[str], runs: int, variant: str) -> dict[str, Any]:
    """Error, time and means of every sampler."""
    import torch

    loaded = tt.load(scene) if isinstance(scene, tt.Scene) else tt.load(scene, variant=variant)
    renderers = {name: tt.TransientRenderer(loaded, spp=spp, sampler=name, physics="ignore") for name in samplers}
    moments: dict[str, Moments] = {name: Moments() for name in samplers}
    seconds: dict[str, list[float]] = {name: [] for name in samplers}
    with torch.no_grad():
        for name in samplers:
            for seed in range(2):
                renderers[name](seed=seed)
        for run in range(runs):
            for name in samplers:
                begin = time.process_time()
                out = renderers[name](seed=1000 + run)
                seconds[name].append(time.process_time() - begin)
                moments[name].add(out.transient.double().numpy(), out.steady.double().numpy())
    base, result = moments[samplers[0]], {}
    for name in samplers[1:]:
        other = moments[name]
        cost = float(np.median(seconds[name]) / np.median(seconds[samplers[0]]))
        variances = base.variance(2), other.variance(2)
        bars = np.sqrt(sum(variances) / runs)
        lit = bars > 0
        t = (other.mean[2] - base.mean[2])[lit] / bars[lit]
        # Degrees of freedom of Welch: between runs - 1 and 2 runs - 2.
        n = (runs - 1) * sum(variances)[lit] ** 2 / (variances[0] ** 2 + variances[1] ** 2)[lit]
        n = np.maximum(n, 3)
        energy = float(other.mean[3][0] / base.mean[3][0] - 1)
        error = float(np.sqrt(base.variance(3)[0] + other.variance(3)[0]) / math.sqrt(runs) / base.mean[3][0])
        result[name] = {
            "spp": spp,
            "gain": float(base.variance(0).sum() / other.variance(0).sum() / cost),
            "gain_steady": float(base.variance(1).sum() / other.variance(1).sum() / cost),
            "cpu_ratio": cost,
            "cpu_seconds": float(np.median(seconds[name])),
            "block_t_mean": float(t.mean()),
            "block_t_deviation": float(t.std() / np.sqrt(np.mean(n / (n - 2)))),
            "blocks": int(lit.sum()),
            "energy": energy,
            "energy_standard_error": error,
        }
    return result


def measure_gradients(scene: Any, spp: int, samplers: list[str], runs: int, variant: str) -> dict[str, Any]:
    """Variance and time of derivatives with every sampler."""
    import torch

    from torchtransient.accuracy.cost import cosine_over_the_window

    loaded = tt.load(scene, variant=variant)
    renderers = {name: tt.TransientRenderer(loaded, KEYS, spp=spp, sampler=name, physics="ignore") for name in samplers}
    found: dict[str, dict[str, list[Any]]] = {name: {key: [] for key in KEYS} for name in samplers}
    seconds: dict[str, list[float]] = {name: [] for name in samplers}
    for run in range(-2, runs):
        for name, renderer in renderers.items():
            begin = time.process_time()
            loss = cosine_over_the_window(renderer(seed=1000 + run))
            gradients = torch.autograd.grad(loss, [renderer.values[key] for key in KEYS])
            if run >= 0:
                seconds[name].append(time.process_time() - begin)
                for key, gradient in zip(KEYS, gradients, strict=True):
                    found[name][key].append(gradient.double().numpy().ravel())
    result = {}
    for name in samplers[1:]:
        cost = float(np.median(seconds[name]) / np.median(seconds[samplers[0]]))
        row: dict[str, Any] = {"spp": spp, "cpu_ratio": cost, "cpu_seconds": float(np.median(seconds[name]))}
        for key in KEYS:
            one, other = np.array(found[samplers[0]][key]), np.array(found[name][key])
            error = np.sqrt((one.var(0, ddof=1) + other.var(0, ddof=1)) / runs)
            row[key] = {
                "gain": float(one.var(0, ddof=1).sum() / other.var(0, ddof=1).sum() / cost),
                "difference_in_standard_errors": ((other.mean(0) - one.mean(0)) / error).tolist(),
            }
        result[name] = row
    return result


def main() -> None:
    parser = arguments(__doc__, peer=False)
    parser.add_argument("--scenes", help="comma-separated; all")
    parser.add_argument("--samplers", default="owen")
    parser.add_argument("--runs", type=int, default=12)
    parser.add_argument("--archive", type=Path, help="staircase_ccby.tar.gz")
    options = parser.parse_args()
    scenes = SCENES | {"staircase": (functools.partial(staircase, options.archive, options.variant), 256)}
    wanted = options.scenes.split(",") if options.scenes else list(scenes)
    samplers, runs = ["independent", *options.samplers.split(",")], 3 if options.quick else options.runs
    known = json.loads(options.json.read_text()) if options.json and options.json.exists() else {}
    print(f"{'scene':20}{'sampler':12}" + "".join(f"{head:>9}" for head in HEADS))
    for name in wanted:
        make, spp = scenes[name]
        spp = 4 if options.quick else spp
        if name.startswith(("gradient", "step")):
            more = 4 * runs if options.quick or name.startswith("gradient") else STEPS
            rows = measure_gradients(make(), spp, samplers, more, options.variant)
        else:
            more = 0 if options.quick or spp > 64 else min(MOST_SAMPLES // spp, MOST_RUNS)
            rows = measure(make(), spp, samplers, max(runs, more), options.variant)
        for sampler, row in rows.items():
            print(f"{name:20}{sampler:12}{_line(row)}", flush=True)
        # Scenes that a run leaves out keep what an earlier one has found.
        known.setdefault("scenes", {})[name] = rows
        if options.json:
            known["environment"] = environment(options.variant)
            options.json.write_text(json.dumps(known, indent=1) + "\n")


def _line(row: dict[str, Any]) -> str:
    if KEYS[0] in row:
        red, lamp = row[KEYS[0]], row[KEYS[1]]
        worst = max(abs(t) for x in (red, lamp) for t in x["difference_in_standard_errors"])
        return f"{red['gain']:9.2f}{lamp['gain']:9.2f}{row['cpu_ratio']:9.3f}  (red wall, lamp; apart {worst:.1f} s.e.)"
    return (
        f"{row['gain']:9.2f}{row['gain_steady']:9.2f}{row['cpu_ratio']:9.3f}{row['block_t_mean']:9.3f}"
        f"{row['block_t_deviation']:9.3f}{row['energy']:10.5f}{row['energy_standard_error']:9.5f}"
    )


if __name__ == "__main__":
    main()
