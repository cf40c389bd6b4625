"""`renderer.to_tolerance`: stops where it should? 200 runs in each scene, drawn from a pool of passes rendered before.

The truth is that of the pool: the mean, the variance of a pass in each bin, and the number of passes after which the
quantile of the true relative errors is the tolerance. A run takes its passes from the pool without replacement. Printed
per scene, samples per pass and tolerance:

- passes that are needed, and at which runs stopped (median and quartiles);
- share met: runs whose true error at the stop is at most the tolerance, and 1.1 of it; runs that said `reached`;
- forecast: that of the first look at 16 passes and more over the passes of the run (quartiles), share of the runs where
  it was within 25 %, and the same of the last look at half of the passes or less;
- bias of the energy in percent, and in standard errors of its mean over the runs;
- squared error of bins over the squared `standard_error` (1: calibrated), mean over bins that count;
- seconds of a pass, and what adding one and looking takes.

The rows `energy` are for a loss, the sum over all bins.

    python benchmarks/tolerance.py [--scenes cornell,fog] [--runs 200] [--pool 1024] [--json FILE]
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from _runner import arguments, environment

import torchtransient as tt

SceneDict = dict[str, Any]
AXIS = {"num_bins": 60, "bin_width_opl": 0.1}


def fog() -> SceneDict:
    """The Cornell box full of thin fog."""
    from torchtransient.scenes import scale

    scene = tt.scenes.cornell_box(8, **AXIS)
    medium = {"type": "homogeneous", "sigma_t": 0.3, "albedo": 0.9, "phase": {"type": "hg", "g": 0.3}}
    scene["fog"] = {"type": "cube", "to_world": scale(0.999), "bsdf": {"type": "null"}, "interior": medium}
    scene["integrator"] = {**scene["integrator"], "type": "transient_prbvolpath"}
    return scene


SCENES: dict[str, Callable[[], SceneDict]] = {
    "cornell": lambda: tt.scenes.cornell_box(8, **AXIS),
    "fog": fog,
    "glass": lambda: tt.scenes.cornell_box(8, glass=True, **AXIS),
    "wall": lambda: tt.scenes.moving_wall(side_panel=True, start_opl=7.0, num_bins=60, bin_width_opl=0.05),
}
# Samples per pixel of a pass (None: the default) and tolerances of bins, or of the loss "energy".
ROWS: list[tuple[int | None, str, tuple[float, ...]]] = [
    (16, "bins", (0.5,)),
    (None, "bins", (0.25, 0.15)),
    (None, "energy", (0.005, 0.002)),
]


class Pool:
    """Passes of a scene, all in memory, and what is true of them."""

    def __init__(self, scene: tt.Scene, spp: int | None, size: int) -> None:
        from torchtransient.rendering.passes import samples_of_pass

        self.renderer = tt.TransientRenderer(scene, physics="ignore")
        self.spp = spp or samples_of_pass("owen", 64)
        self.film = self.renderer.film
        begin = time.perf_counter()
        self.passes = [self.renderer(seed=10**6 + i, spp=self.spp).detach() for i in range(size)]
        self.seconds = (time.perf_counter() - begin) / size
        self.cubes = np.stack([out.transient.mean(0).double().numpy() for out in self.passes])
        self.mean, self.variance = self.cubes.mean(0), self.cubes.var(0, ddof=1)
        self.energies = self.cubes.sum((1, 2, 3))

    def needed(self, on: str, rtol: float) -> float:
        """Passes after which the true error is the tolerance."""
        import torch

        from torchtransient.rendering.error_bars import local_mean

        if on == "energy":
            return float(self.energies.var(ddof=1) / self.energies.mean() ** 2 / rtol**2)
        mean = local_mean(torch.from_numpy(self.mean), (0, 1, 2)).numpy()
        counted = mean > 0.02 * mean.mean()
        return float(np.quantile(self.variance[counted] / mean[counted] ** 2, 0.9, method="higher") / rtol**2)

    def run(self, on: str, rtol: float, rng: np.random.Generator) -> dict[str, float]:
        """One run of passes in random order."""
        from torchtransient.rendering.passes import PassSums
        from torchtransient.rendering.tolerance import Request, render_to_tolerance

        order = rng.permutation(len(self.passes))
        taken = iter(order)
        request = Request(rtol, on=None if on == "bins" else energy, max_spp=len(order) // 2 * self.spp)
        sums = PassSums(0, self.spp, self.film, {}, {})
        result = render_to_tolerance(lambda seed: self.passes[next(taken)], sums, request, progress=False)
        n = result.passes
        mean = result.output.transient.mean(0).double().numpy()
        error = result.standard_error.double().numpy() ** 2 * (1 - n / len(order))
        lit = mean > 0.02 * mean.mean()
        first = next((look for look in result.looks if look.passes >= 16), result.looks[-1])
        half = next((look for look in reversed(result.looks) if look.passes <= max(n / 2, 8)), first)
        return {
            "passes": n,
            "reached": result.reached,
            "heavy": result.heavy_tailed,
            "forecast": first.forecast / n,
            "forecast at half": half.forecast / n,
            "energy": float(mean.sum() / self.mean.sum() - 1),
            "calibration": float(((mean - self.mean)[lit] ** 2).mean() / error[lit].mean()),
            "looks": len(result.looks),
            "seconds": result.seconds,
        }


def energy(out: tt.RenderOutput) -> Any:
    """Sum over all bins: a linear loss."""
    return out.transient.sum()


def row(pool: Pool, on: str, rtol: float, runs: int) -> dict[str, Any]:
    """Figures of one tolerance."""
    rng = np.random.default_rng(0)
    found = [pool.run(on, rtol, rng) for _ in range(runs)]
    needed = pool.needed(on, rtol)
    of = {key: np.array([one[key] for one in found], dtype=float) for key in found[0]}
    n = of["passes"]
    return {
        "spp": pool.spp,
        "needed": needed,
        "passes": np.quantile(n, [0.25, 0.5, 0.75]).tolist(),
        "met": float((n >= needed).mean()),
        "met within 1.1": float((n >= needed / 1.21).mean()),
        "reached": float(of["reached"].mean()),
        "heavy": float(of["heavy"].mean()),
        "forecast": np.quantile(of["forecast"], [0.25, 0.5, 0.75]).tolist(),
        "forecast within 25 %": float((abs(of["forecast"] - 1) <= 0.25).mean()),
        "forecast at half within 25 %": float((abs(of["forecast at half"] - 1) <= 0.25).mean()),
        "energy bias": float(of["energy"].mean()),
        "energy bias z": float(of["energy"].mean() / (of["energy"].std(ddof=1) / math.sqrt(runs))),
        "calibration": float(of["calibration"].mean()),
        "looks": float(of["looks"].mean()),
        "ms of a pass": 1e3 * pool.seconds,
        "ms of adding": 1e3 * float((of["seconds"] / n).mean()),
    }


def printed(name: str, on: str, rtol: float, x: dict[str, Any]) -> str:
    passes = "/".join(f"{q:.0f}" for q in x["passes"])
    forecast = "/".join(f"{q:.2f}" for q in x["forecast"])
    return (
        f"{name:8} {on:6} {x['spp']:4} {rtol:6g} {x['needed']:7.1f} {passes:>14} {x['met']:6.1%} "
        f"{x['met within 1.1']:6.1%} {x['reached']:6.1%} {x['heavy']:6.1%} {forecast:>14} "
        f"{x['forecast within 25 %']:6.1%} {x['forecast at half within 25 %']:6.1%} "
        f"{100 * x['energy bias']:+7.3f} {x['energy bias z']:+5.1f} "
        f"{x['calibration']:5.2f} {x['looks']:5.1f} {x['ms of a pass']:6.1f} {x['ms of adding']:6.2f}"
    )


def main(arguments_of_line: Sequence[str] | None = None) -> None:
    """Measure and print."""
    import torch

    parser = arguments(__doc__, peer=False)
    parser.add_argument("--scenes", default=",".join(SCENES))
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--pool", type=int, default=1024)
    options = parser.parse_args(arguments_of_line)
    torch.set_num_threads(1)  # passes are small, and other programs compute beside
    size, runs = (64, 3) if options.quick else (options.pool, options.runs)
    results: dict[str, Any] = {}
    print(
        f"{'scene':8} {'on':6} {'spp':>4} {'rtol':>6} {'needed':>7} {'passes':>14} {'met':>6} {'x 1.1':>6} "
        f"{'reach':>6} {'heavy':>6} {'forecast':>14} {'25 %':>6} {'half':>6} {'energy%':>7} {'z':>5} "
        f"{'calib':>5} {'looks':>5} {'pass':>6} {'add':>6}"
    )
    for name in options.scenes.split(","):
        scene = tt.load(SCENES[name](), variant=options.variant)
        pools: dict[int | None, Pool] = {}
        for spp, on, tolerances in ROWS:
            with torch.no_grad():
                if spp not in pools:
                    pools = {spp: Pool(scene, spp, size)}
                pool = pools[spp]
                for rtol in tolerances:
                    found = row(pool, on, rtol, runs)
                    results[f"{name}, {on}, {pool.spp} spp a pass, rtol {rtol:g}"] = found
                    print(printed(name, on, rtol, found), flush=True)
    settings = {"runs": runs, "pool": size, "quick": options.quick, "environment": environment(options.variant)}
    if options.json is not None:
        data = {"benchmark": "tolerance", "settings": settings, "rows": results}
        options.json.write_text(json.dumps(data, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
