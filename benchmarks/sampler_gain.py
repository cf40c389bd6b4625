"""Squared error times CPU time of the sampler `owen` over `independent`, scene by scene, and tests of its means.

Both render the same scenes in one process and take turns. Per scene: the ratio of squared error x time of the histogram
and of the steady image (the variance between runs, summed over bins and pixels; larger than 1: `owen` is better), the
ratio of CPU seconds, and how far apart the means are: energy (in standard errors), and Student's t of blocks of
8 x 8 pixels x 10 bins, whose mean should be 0 and whose deviation that of t (about sqrt(n / (n - 2)), n = 2 runs - 2).

    python benchmarks/sampler_gain.py [--scenes cornell,glass] [--samplers owen,multijitter] [--runs 12] [--json FILE]
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from _runner import arguments

import torchtransient as tt

SceneDict = dict[str, Any]


def cornell(resolution: int = 64, **settings: Any) -> SceneDict:
    """The Cornell box, 300 bins."""
    settings.setdefault("num_bins", 300)
    return tt.scenes.cornell_box(resolution=resolution, **settings)


def small_lamp() -> SceneDict:
    """The Cornell box with a lamp of 6 cm, as bright in sum as the large one."""
    from torchtransient.scenes.transforms import rotate, scale, translate

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
    from torchtransient.scenes.transforms import scale

    scene = cornell(48)
    medium = {"type": "homogeneous", "sigma_t": 0.3, "albedo": 0.9, "phase": {"type": "hg", "g": 0.3}}
    scene["fog"] = {"type": "cube", "to_world": scale(0.999), "bsdf": {"type": "null"}, "interior": medium}
    scene["integrator"] = {**scene["integrator"], "type": "transient_prbvolpath"}
    return scene


def nlos() -> SceneDict:
    """A letter behind a corner, by general paths."""
    return tt.scenes.nlos_room()


SCENES: dict[str, tuple[Callable[[], SceneDict], int]] = {
    "cornell": (cornell, 256),
    "cornell 128": (lambda: cornell(128), 256),
    "2048 bins": (lambda: cornell(num_bins=2048, bin_width_opl=300 * 0.03 / 2048 * 1.0), 256),
    "6 cm lamp": (small_lamp, 256),
    "mirror": (lambda: with_box_of({"type": "conductor", "material": "none"}), 256),
    "glass": (lambda: with_box_of({"type": "dielectric"}), 256),
    "fog": (fog, 256),
    "nlos": (nlos, 256),
    "cornell, 1 spp": (lambda: cornell(24), 1),
    "cornell, 4 spp": (lambda: cornell(24), 4),
    "cornell, 6 spp": (lambda: cornell(24), 6),
    "cornell, 16 spp": (lambda: cornell(24), 16),
    "cornell, 48 spp": (lambda: cornell(24), 48),
    "cornell, 64 spp": (lambda: cornell(24), 64),
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


def measure(scene: SceneDict, spp: int, samplers: list[str], runs: int, variant: str) -> dict[str, Any]:
    """Error, time and means of every sampler."""
    import torch

    loaded = tt.load(scene, variant=variant)
    renderers = {name: tt.TransientRenderer(loaded, spp=spp, sampler=name, physics="ignore") for name in samplers}
    moments, seconds = {name: Moments() for name in samplers}, {name: [] for name in samplers}
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
        other, n = moments[name], 2 * runs - 2
        cost = float(np.median(seconds[name]) / np.median(seconds[samplers[0]]))
        bars = np.sqrt((base.variance(2) + other.variance(2)) / runs)
        lit = bars > 0
        t = (other.mean[2] - base.mean[2])[lit] / bars[lit]
        energy = float(other.mean[3][0] / base.mean[3][0] - 1)
        error = float(np.sqrt(base.variance(3)[0] + other.variance(3)[0]) / math.sqrt(runs) / base.mean[3][0])
        result[name] = {
            "spp": spp,
            "gain": float(base.variance(0).sum() / other.variance(0).sum() / cost),
            "gain_steady": float(base.variance(1).sum() / other.variance(1).sum() / cost),
            "cpu_ratio": cost,
            "cpu_seconds": float(np.median(seconds[name])),
            "block_t_mean": float(t.mean()),
            "block_t_deviation": float(t.std() / math.sqrt(n / (n - 2))),
            "energy": energy,
            "energy_standard_error": error,
        }
    return result


def main() -> None:
    parser = arguments(__doc__, peer=False)
    parser.add_argument("--scenes", default=",".join(SCENES))
    parser.add_argument("--samplers", default="owen")
    parser.add_argument("--runs", type=int, default=12)
    options = parser.parse_args()
    samplers, runs = ["independent", *options.samplers.split(",")], 3 if options.quick else options.runs
    report = {}
    heads = ("gain", "steady", "CPU", "t mean", "t dev", "energy", "+-")
    print(f"{'scene':18}{'sampler':12}" + "".join(f"{head:>9}" for head in heads))
    for name in options.scenes.split(","):
        make, spp = SCENES[name]
        report[name] = measure(make(), 4 if options.quick else spp, samplers, runs, options.variant)
        for sampler, x in report[name].items():
            print(
                f"{name:18}{sampler:12}{x['gain']:9.2f}{x['gain_steady']:9.2f}{x['cpu_ratio']:9.3f}"
                f"{x['block_t_mean']:9.3f}{x['block_t_deviation']:9.3f}{x['energy']:9.5f}"
                f"{x['energy_standard_error']:9.5f}",
                flush=True,
            )
    if options.json:
        options.json.write_text(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
