"""Bias of fits whose losses see noisy renders, of every loss by samples per pixel, on a rendered scene.

The scene is that of `training_examples/two_walls.py`: a hidden wall shows in light of two and three bounces alone; six
unknowns, 107 counts a pixel. `least`: where the mean loss over the noise of renders at the truth is least (8 groups of
draws, mean and standard error), the scene being a straight line near its truth (`_linear_fits.py`). `fits`: stochastic
fits through the renderer, which know nothing of lines. `priors`: 30 steps from a start as good as a network's, with
that start as prior. Biases are over the spread of the best fit to one capture: a tenth of it does not matter.
`docs/make_noisy_render_page.py` writes the page of the numbers.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from _runner import arguments, environment, output

from _linear_fits import GROUPS, Linear, Loss, Scene, two_walls  # isort: skip  (what is measured comes by `_runner`)
from _noisy_scene_fits import fits, priors
from torch import Tensor
from tqdm import tqdm

import torchtransient as tt
from torchtransient import losses, sensing

RESULTS = Path(__file__).parent / "results" / "noisy_renders.json"
AXIS, CYCLES = two_walls.AXIS, two_walls.CYCLES
BAND = tt.FrequencyAxis.uniform(0.2, 0.2, 8)
PARTS = ("least", "fits", "priors")
SHAPE_ALONE = (0, 1, 2, 3, 5)  # what losses that are blind to brightness can find: the wall's albedo is known


@dataclasses.dataclass(frozen=True)
class Case:
    """`make(truth)`: the loss, a sum over renders (K, R, T, H, W) and targets (K, 1, T, H, W)."""

    make: Callable[[Linear], Loss]
    free: tuple[int, ...] = tuple(range(6))
    renders: int = 1
    same: bool = False  # a derivative of the same samples
    least_at_equality: bool = True
    linear: bool = False  # in the target, but for what has no slope: noise of counts has no part
    part: int = 1  # of the draws, where the loss is slow
    spad: bool = False


def plain(function: Callable[..., Tensor], *more: object, **options: Any) -> Callable[[Linear], Loss]:
    return lambda _: lambda x, y: function(x, y, *more, reduction="sum", **options)


def likelihood(function: Callable[..., Tensor], scale: float = 1.0, **options: Any) -> Callable[[Linear], Loss]:
    """Of rates that are not negative, as the straight line may be."""
    return lambda _: lambda x, y: function(x.clamp_min(0) / scale, y, reduction="sum", **options)


def weighted(truth: Linear) -> Loss:
    """Squares over a variance that is no function of the render."""
    root = truth.mean.sqrt()
    return lambda x, y: losses.squared_loss(x / root, y / root, reduction="sum")


def two_renders(truth: Linear) -> Loss:
    root = truth.mean.sqrt()
    return lambda x, y: losses.two_render_loss(x[:, :1] / root, x[:, 1:] / root, y / root, reduction="sum")


def jackknife(make: Callable[[Linear], Loss]) -> Callable[[Linear], Loss]:
    """Twice the loss of the mean of two renders, less the mean of both: no bias of first order in the variance."""

    def of(truth: Linear) -> Loss:
        loss = make(truth)
        return lambda x, y: 2 * loss(x.mean(1, keepdim=True), y) - sum(loss(r, y) for r in x.split(1, 1)) / 2

    return of


POISSON, ROOTS = likelihood(losses.poisson_loss), plain(losses.expected_root_loss)
CASES = {
    "`squared_loss`": Case(plain(losses.squared_loss), linear=True),
    '`squared_loss`, `grad_seed="same"`': Case(plain(losses.squared_loss), linear=True, same=True),
    "`squared_loss`, weighted": Case(weighted, linear=True),
    '`squared_loss`, weighted, `grad_seed="same"`': Case(weighted, linear=True, same=True),
    "`two_render_loss`, weighted": Case(two_renders, linear=True, renders=2),
    "`transient_phasor_loss`, 0.2 to 1.6 per m": Case(
        plain(losses.transient_phasor_loss, axis=AXIS, frequencies=BAND), linear=True
    ),
    "`transient_phasor_loss`, `phase_only`": Case(
        plain(losses.transient_phasor_loss, axis=AXIS, frequencies=BAND, phase_only=True, floor=1.0), free=SHAPE_ALONE
    ),
    "`multiscale_loss` of `squared_loss`": Case(plain(losses.multiscale_loss), linear=True, part=4),
    "`multiscale_loss` of `poisson_loss`": Case(
        lambda _: lambda x, y: losses.multiscale_loss(x.clamp_min(0), y, losses.poisson_loss, reduction="sum"),
        linear=True, part=4,
    ),
    "`poisson_loss`, `poisson_nll`": Case(POISSON, linear=True),
    '`poisson_loss`, `grad_seed="same"`': Case(POISSON, linear=True, same=True),
    "`poisson_loss`, jackknife of two": Case(jackknife(POISSON), linear=True, renders=2),
    "`first_photon_loss`": Case(
        likelihood(losses.first_photon_loss, CYCLES, cycles=CYCLES), linear=True, spad=True, least_at_equality=False
    ),
    "`root_loss`": Case(plain(losses.root_loss)),
    "`expected_root_loss`": Case(ROOTS, part=2, least_at_equality=False),
    '`expected_root_loss`, `grad_seed="same"`': Case(ROOTS, part=2, same=True, least_at_equality=False),
    "`expected_root_loss`, jackknife of two": Case(jackknife(ROOTS), part=2, renders=2, least_at_equality=False),
    "`log_ratio_loss`, background 1": Case(plain(losses.log_ratio_loss, background=1.0)),
    "`cumulative_loss`, `per_root_count`": Case(plain(losses.cumulative_loss, 1.0, per_root_count=True)),
    "`wasserstein_loss`": Case(plain(losses.wasserstein_loss, AXIS.bin_width_opl), free=SHAPE_ALONE),
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Size:
    """`captures`: single ones, for the spread; `many`: those that are fitted together, without noise of renders."""

    spp: tuple[int, ...] = (1, 4, 16, 64, 256)
    truths: int = 2
    draws: int = 64
    captures: int = 24
    many: int = 128
    exact_spp: int = 4096
    exact_renders: int = 32


QUICK = Size(spp=(16, 64), truths=1, draws=64, captures=2, many=64, exact_spp=256, exact_renders=8)


def truths(number: int) -> Tensor:
    """(N, 6) in the inner three fifths of the ranges; the first in the middle."""
    share = 0.2 + 0.6 * torch.rand(number, 6, generator=torch.Generator().manual_seed(0))
    share[0] = 0.5
    return two_walls.LOW + share * two_walls.SPAN


def captures(case: Case, mean: Tensor, number: int, seed: int) -> Tensor:
    """(K, 1, T, H, W) counts of that mean."""
    generator, many = torch.Generator().manual_seed(seed), mean.expand(number, *mean.shape)
    if case.spad:
        return sensing.SynchronousSPAD(CYCLES).sample(many / CYCLES, generator=generator).double()
    return torch.poisson(many, generator=generator)


def exact(case: Case, mean: Tensor) -> Tensor:
    """(1, 1, T, H, W): what counts are on average."""
    return (sensing.SynchronousSPAD(CYCLES).expected(mean / CYCLES) if case.spad else mean)[None]


def summary(parts: Tensor, spread: Tensor) -> dict[str, Any]:
    """Of (GROUPS, N, 6): mean, standard error and their root mean square over the spread, noise of it taken off."""
    parts = parts / spread
    mean, error = parts.mean(0), parts.std(0) / len(parts) ** 0.5
    square = (mean.square() - error.square()).mean()
    rms = float(square.clamp_min(0).sqrt())
    # of the mean of squares, by the error of each; for no bias at all what is left of the noise
    wide = float((4 * mean.square() * error.square() + 2 * error**4).sum().sqrt() / mean.numel())
    return {
        "rms": rms,
        "error": wide / (2 * rms) if rms**2 > wide else wide**0.5,
        "bias": mean.tolist(),
        "standard error": error.tolist(),
    }


def measure(
    case: Case, lines: Sequence[Linear], noise: dict[int, list[Tensor]], slopes: dict[int, list[Tensor]], size: Size
) -> dict[str, Any]:
    """Spread of the loss, bias of its own, and what the noise of renders adds, for counts and exact targets."""
    free, number = list(case.free), size.draws // case.part
    spread = torch.stack([line.spread() for line in lines])[:, free]
    none = torch.zeros(1, case.renders, 1, 1, 1, dtype=torch.float64)
    ways = [functools.partial(line.least, case.make(line), free=free) for line in lines]
    groups = [functools.partial(line.in_groups, case.make(line), free=free) for line in lines]
    single = [
        torch.stack([way(none, y[None]) for y in captures(case, line.mean, size.captures, 5)])
        for way, line in zip(ways, lines, strict=True)
    ]
    many = [captures(case, line.mean, size.many // case.part, 6) for line in lines]
    own = [torch.stack([way(none, part) for part in y.chunk(GROUPS)]) for way, y in zip(ways, many, strict=True)]
    found: dict[str, Any] = {
        "spread": float((torch.stack([s.std(0) for s in single])[:, free] / spread).square().mean().sqrt()),
        "own": summary(torch.stack(own, 1)[..., free], spread),
    }
    for kind in ["exact"] if case.linear else ["counts", "exact"]:
        whole = kind == "exact"
        targets = [
            exact(case, line.mean) if whole else captures(case, line.mean, number // case.renders, 7) for line in lines
        ]
        still = [torch.zeros(6)] * len(lines)
        if not whole or not case.least_at_equality:
            still = [
                group(none.expand(number // case.renders, -1, -1, -1, -1), target)
                for group, target in zip(groups, targets, strict=True)
            ]
        found[kind] = {}
        for spp, draws in noise.items():
            parts = []
            for k, group in enumerate(groups):
                noisy = draws[k][:number].unflatten(0, (-1, case.renders)).squeeze(2)
                moving = slopes[spp][k][:number] if case.same else None
                parts.append((group(noisy, targets[k], slopes=moving) - still[k])[:, free])
            found[kind][spp] = summary(torch.stack(parts, 1), spread)
    return found


def main() -> None:
    parser = arguments(__doc__, peer=False)
    parser.set_defaults(variant="llvm_ad_mono")
    parser.add_argument("--smoke", dest="quick", action="store_true", help="the same as --quick")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS, help="others stay as they are in the JSON")
    options = parser.parse_args()
    options.json = output(options.json, RESULTS, quick=options.quick)
    size = QUICK if options.quick else Size()
    tt.threads(1)
    scene, began = Scene.build(), time.process_time()
    lines = [
        Linear.at(scene, truth, size.exact_spp, range(size.exact_renders))
        for truth in tqdm(truths(size.truths), desc="truths")
    ]
    results: dict[str, Any] = {}
    if "least" in options.parts:
        results["least"] = least(scene, lines, size)
    if "fits" in options.parts:
        results["fits"] = fits(scene, lines, quick=options.quick)
    if "priors" in options.parts:
        results["priors"] = priors(scene, quick=options.quick)
    seconds = {part: round(time.process_time() - began) for part in options.parts[-1:]}
    before = json.loads(options.json.read_text(encoding="utf-8")) if options.json.is_file() else {}
    data = {
        **before,
        "benchmark": "noisy_renders",
        "settings": dataclasses.asdict(size) | {"quick": options.quick},
        "environment": environment(options.variant),
        "truths": [line.truth.tolist() for line in lines],
        "spread": [line.spread().tolist() for line in lines],
        **results,
        "CPU s up to": before.get("CPU s up to", {}) | seconds,
    }
    options.json.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    print(f"written to {options.json}")


def least(scene: Scene, lines: Sequence[Linear], size: Size) -> dict[str, Any]:
    """`measure` of every case, with the same draws of noise for all of them."""
    noise, slopes = {}, {}
    for spp in tqdm(size.spp, desc="noise"):
        first = [10**6 * spp + 10**4 * k for k in range(len(lines))]
        seeds = [range(n, n + size.draws) for n in first]
        at = [line.truth.float() for line in lines]
        noise[spp] = [scene.draws(t, spp, s) - line.mean for t, s, line in zip(at, seeds, lines, strict=True)]
        slopes[spp] = [scene.slopes(t, spp, s, same=True) for t, s in zip(at, seeds, strict=True)]
    found = {}
    for name, case in tqdm(CASES.items(), desc="losses"):
        start = time.process_time()
        found[name] = measure(case, lines, noise, slopes, size) | {"CPU s": round(time.process_time() - start, 1)}
        tqdm.write(row(name, found[name]))
    return found


def row(name: str, found: dict[str, Any]) -> str:
    cells = [
        f"{kind}: " + " ".join(f"{spp}: {x['rms']:.2f}±{x['error']:.2f}" for spp, x in found[kind].items())
        for kind in ("counts", "exact")
        if kind in found
    ]
    own = found["own"]
    return f"{name:<46} spread {found['spread']:.2f} own {own['rms']:.2f}±{own['error']:.2f}  " + "; ".join(cells)


if __name__ == "__main__":
    main()
