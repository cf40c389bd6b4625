"""Whether claimed errors hold: those of renders with `errors=True`, and those of `tt.accuracy.gradient_errors`.

`renders`: per integrator and sampler, the variance of twelve regions (sums over 10 bins and a quarter of the picture)
between runs with seeds of their own, over the mean of the claimed variances. `gradients`: per scene, the variance of a
derivative between measurements over the mean of the claimed variances, both summed over its entries, as a ratio of
standard errors, and the share of measurements that say "heavy tailed: no error".

    python benchmarks/error_claims.py [renders|gradients] [--scenes path,volume] [--runs N] [--json FILE]
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from _runner import arguments
from boundary_cost import LayerProblem
from sampler_gain import cornell
from tqdm import trange

import torchtransient as tt
from tools.boundary_cases.closed_rooms import ROOMS
from tools.boundary_cases.moving_edges import CASES, CONCAVE, MovingEdge
from torchtransient.accuracy import gradient_errors
from torchtransient.rendering.output import RenderOutput

SceneDict = dict[str, Any]
Loss = Callable[[RenderOutput], torch.Tensor]
BINS = 40
# Measurements of a gradient that look at its tail.
WITH_TAILS = 8


def small_box(integrator: str = "transient_path", *, fog: bool = False) -> SceneDict:
    """The Cornell box, 16 x 16 pixels and 40 bins."""
    scene = cornell(16, num_bins=BINS, bin_width_opl=0.225)
    scene["integrator"] |= {"type": integrator}
    if fog:
        from torchtransient.scenes import scale

        medium = {"type": "homogeneous", "sigma_t": 0.3, "albedo": 0.9, "phase": {"type": "hg", "g": 0.3}}
        scene["fog"] = {"type": "cube", "to_world": scale(0.999), "bsdf": {"type": "null"}, "interior": medium}
        scene["integrator"] |= {"type": "transient_prbvolpath"}
    return scene


def corner() -> SceneDict:
    """A letter behind a corner, 16 x 16 points x 40 bins."""
    scan = tt.nlos.Scan.grid(tt.nlos.Wall.plane(1.0, 1.0), 16, kind="single")
    scene = tt.nlos.capture_scene(tt.scenes.nlos_z(), scan, bounces=(3, 4, 5))
    scene["wall"]["sensor"]["film"] |= {"start_opl": 1.6, "bin_width_opl": 0.064, "temporal_bins": BINS}
    return scene


RENDERS: dict[str, Callable[[], SceneDict]] = {
    "path": small_box,
    "volume": lambda: small_box(fog=True),
    "reuse": lambda: small_box("transient_path_reuse"),
    "corner": corner,
}


def regions(size: int) -> list[torch.Tensor]:
    """Quarters of the picture in three windows of 10 bins, (T, H, W) each."""
    t, x = torch.arange(BINS), torch.arange(size)
    return [
        ((t >= a) & (t < a + 10))[:, None, None] * (x // (size // 2) == b)[:, None] * (x // (size // 2) == c) * 1.0
        for a in (5, 15, 25) for b in (0, 1) for c in (0, 1)
    ]  # fmt: skip


def renders(make: Callable[[], SceneDict], sampler: str, runs: int, spp: int, variant: str) -> dict[str, Any]:
    """Ratio of variance and claims of regions, its mean and largest and smallest."""
    renderer = tt.TransientRenderer(tt.load(make(), variant=variant), spp=spp, sampler=sampler, physics="ignore")
    sums, claims, weights = [], [], None
    with torch.no_grad():
        for seed in trange(runs, desc=sampler, leave=False):
            out = renderer(seed=seed, errors="bins")
            weights = weights or regions(out.transient.shape[-1])
            mean = out.transient.mean(-4)
            sums.append([float((mean * w).sum()) for w in weights])
            claims.append([float(out.standard_error(w)) ** 2 for w in weights])
    variance, claimed = np.var(sums, 0, ddof=1), np.mean(claims, 0)
    lit = claimed > 0
    ratio = variance[lit] / claimed[lit]
    return {"mean": float(ratio.mean()), "least": float(ratio.min()), "most": float(ratio.max()), "runs": runs}


# --------------------------------------------------------------------------------------------------------- gradients


def of_edge(case: MovingEdge) -> tuple[tt.TransientRenderer, Loss, int]:
    """Renderer, loss and samples per pixel of a case of moving edges."""
    problem = LayerProblem(case)
    problem.weigh(1 << 12)
    width, height = problem.renderer(seed=0, spp=1).steady.shape[-2:]
    return problem.renderer, lambda out: (out.transient * problem.weights).sum(), max(16, 4096 // (width * height))


def of_box(key: str, *, fog: bool = False) -> tuple[tt.TransientRenderer, Loss, int]:
    """The same of a parameter of the Cornell box; the loss is a sine over time."""
    scene = small_box(fog=fog)
    renderer = tt.TransientRenderer(tt.load(scene), [key], physics="ignore")
    weights = torch.sin(3 * torch.as_tensor(np.asarray(renderer.axis.centers_opl), dtype=torch.float32))
    return renderer, lambda out: (out.transient * weights[:, None, None]).sum(), 16


GRADIENTS: dict[str, Callable[[], tuple[tt.TransientRenderer, Loss, int]]] = {
    "plate": lambda: of_edge(CASES["plate4"]),
    "cube": lambda: of_edge(CASES["cube"]),
    "indirect occluder": lambda: of_edge(CASES["indirect4_area"]),
    "torus": lambda: of_edge(CONCAVE["torus"](4)),
    "star": lambda: of_edge(CONCAVE["star"](3)),
    "V-grooves": lambda: of_edge(CONCAVE["grooves30"](3)),
    "closed room": lambda: of_edge(ROOMS["meter"](8)),
    "Cornell albedo": lambda: of_box("red.reflectance.value"),
    "Cornell wall": lambda: of_box("back.to_world"),
    "fog density": lambda: of_box("fog.interior_medium.sigma_t.value.value", fog=True),
}


def gradients(make: Callable[[], tuple[tt.TransientRenderer, Loss, int]], runs: int) -> dict[str, Any]:
    """Deviation over claim, and what was said of tails."""
    renderer, loss, spp = make()
    values, claims, heavy = [], [], []
    for seed in trange(runs, desc="measurements", leave=False):
        looks = seed < WITH_TAILS
        (found,) = gradient_errors(renderer, loss, spp=spp, seed=seed, tails=looks, progress=False).values()
        if looks:
            heavy.append(bool(found.tail is not None and found.tail.heavy))
        values.append(found.value.double().reshape(-1))
        claims.append(found.standard_error.double().reshape(-1).square())
    known = [c for c in claims if torch.isfinite(c).all()]
    deviation = float(torch.stack(values).var(0).sum())
    claimed = float(torch.stack(known).mean(0).sum()) if known else math.nan
    return {"ratio": math.sqrt(deviation / claimed), "heavy": sum(heavy) / len(heavy), "runs": runs, "spp": spp}


def main() -> None:
    parser = arguments(__doc__, peer=False)
    parser.add_argument("what", nargs="?", choices=("renders", "gradients"))
    parser.add_argument("--scenes", help="comma-separated; all")
    parser.add_argument("--runs", type=int, help="200 renders, 64 measurements of a gradient")
    options = parser.parse_args()
    chosen = options.scenes.split(",") if options.scenes else None
    report: dict[str, Any] = {}
    if options.json and options.json.exists():
        report = json.loads(options.json.read_text())
    if options.what != "gradients":
        for name in chosen or RENDERS:
            for sampler in ("owen", "independent"):
                runs = 4 if options.quick else options.runs or 200
                found = renders(RENDERS[name], sampler, runs, 8 if options.quick else 64, options.variant)
                report.setdefault("renders", {})[f"{name}, {sampler}"] = found
                print(
                    f"{name:20}{sampler:14}{found['mean']:8.3f}  ({found['least']:.2f} to {found['most']:.2f})",
                    flush=True,
                )
    if options.what != "renders":
        for name in chosen or GRADIENTS:
            found = gradients(GRADIENTS[name], 3 if options.quick else options.runs or 64)
            report.setdefault("gradients", {})[name] = found
            print(f"{name:20}{found['ratio']:8.3f}  heavy tailed {found['heavy']:.0%}", flush=True)
    if options.json:
        options.json.write_text(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
