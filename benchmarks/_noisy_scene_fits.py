"""Stochastic fits of `noisy_renders.py` through the renderer: what a straight line near the truth cannot show."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch
from _linear_fits import Linear, Scene, two_walls
from torch import Tensor
from tqdm import tqdm
from two_wall_fits import Fit, roots, weighted

from torchtransient import losses

# (loss of expected counts and a target, both (B, 1, T, H, W), of the variance of the target; renders of each)
Misfit = Callable[[Tensor, Tensor, Tensor], Tensor]
MISFITS: dict[str, tuple[Misfit, int]] = {
    "`squared_loss`, weighted": (lambda x, y, v: ((x - y).square() / v).sum() / 2, 1),
    "`two_render_loss`, weighted": (
        lambda x, y, v: losses.two_render_loss(*(z / v.sqrt() for z in (*x.chunk(2), y)), reduction="sum") / 2, 2),
    "`poisson_loss`": (lambda x, y, v: losses.poisson_loss(x, y, reduction="sum"), 1),
    # on average over counts of mean y, but for a constant
    "`expected_root_loss`": (lambda x, y, v: (
        losses.expected_anscombe(x) - losses.expected_anscombe(y)).square().sum() / 2, 1),
    "`cumulative_loss`": (lambda x, y, v: losses.cumulative_loss(
        x, y, 1.0, per_root_count=True, reduction="sum"), 1),
}  # fmt: skip


def stochastic(
    scene: Scene,
    lines: Sequence[Linear],
    names: tuple[str, ...],
    spp: Callable[[int], int],
    steps: int,
    copies: int,
    tail: int,
) -> dict[str, Any]:
    """Adam from the truth to exact targets; the mean of the last `tail` steps, `copies` of every truth.

    `names`: the misfit, or one of the first two fifths of the steps and one of the others. Steps are in units in which
    the best fit to one capture has a covariance of one.
    """
    renders = max(MISFITS[name][1] for name in names)
    truth = torch.stack([line.truth for line in lines]).repeat_interleave(copies, 0).float()
    roots = torch.stack([torch.linalg.cholesky(line.covariance(range(6))) for line in lines])
    target = torch.stack([line.mean for line in lines]).repeat_interleave(copies, 0).float()
    variance, roots = target.clone(), roots.repeat_interleave(copies, 0).float()
    place = torch.zeros(len(truth), 6, requires_grad=True)
    optimizer = torch.optim.Adam([place], betas=(0.9, 0.98))
    total, first, began = torch.zeros_like(place), steps - tail, time.process_time()
    for step in tqdm(range(steps), desc=", then ".join(names), leave=False):
        misfit = MISFITS[names[0 if step < 0.4 * steps else -1]][0]
        optimizer.param_groups[0]["lr"] = 0.4 * (1 - 0.9 * step / steps)
        found = truth + torch.einsum("bij,bj->bi", roots, place)
        seeds = range(10**7 + 10**4 * step, 10**7 + 10**4 * step + renders * len(truth))
        mean = scene.counts(found.repeat(renders, 1), spp(step), seeds)
        optimizer.zero_grad()
        misfit(mean, target, variance).backward()
        optimizer.step()
        if step >= first:
            total += found.detach() - truth
    seconds = (time.process_time() - began) / len(truth)
    shift = (total / (steps - first)).double().reshape(len(lines), copies, 6)
    relative = shift / torch.stack([line.spread() for line in lines])[:, None]
    bias, error = relative.mean(1), relative.std(1) / copies**0.5
    square = (bias.square() - error.square()).mean()
    return {
        "rms": float(square.clamp_min(0).sqrt()),
        "error": float((error.square().mean() / bias.numel()).sqrt()),
        "bias": bias.tolist(),
        "standard error": error.tolist(),
        "CPU s": round(seconds, 2),
    }


def fits(scene: Scene, lines: Sequence[Linear], *, quick: bool) -> dict[str, Any]:
    """By loss and samples; with a derivative of the same samples; with samples that are doubled at the end."""
    steps, copies = (12, 2) if quick else (180, 3)
    found = {}
    constant: list[tuple[str, int]] = [(name, 64) for name in MISFITS]
    constant += [("`poisson_loss`", 1024), ("`expected_root_loss`", 1024), ("`poisson_loss`", 16)]
    constant += [("`expected_root_loss`", 16), ("`squared_loss`, weighted", 16)]
    for name, spp in constant:
        found[f"{name}, {spp}"] = stochastic(scene, lines, (name,), lambda _, spp=spp: spp, steps, copies, steps // 3)
        tqdm.write(line_of(f"{name}, {spp}", found[f"{name}, {spp}"]))
    for name in ("`poisson_loss`", "`expected_root_loss`"):
        for least in (16, 64):
            label, schedule = f"{name}, {least} to 1024", losses.SampleSchedule(least, 1024, steps, hold=0.4)
            found[label] = stochastic(scene, lines, (name,), schedule, steps, copies, max(1, steps // 12))
            tqdm.write(line_of(label, found[label]))
    both = ("`expected_root_loss`", "`squared_loss`, weighted")
    label = ", 16; then ".join(both) + ", 16"
    found[label] = stochastic(scene, lines, both, lambda _: 16, steps, copies, steps // 3)
    tqdm.write(line_of(label, found[label]))
    scene.renderer.grad_seed = "same"
    label = '`squared_loss`, weighted, 64, `grad_seed="same"`'
    found[label] = stochastic(scene, lines, both[1:], lambda _: 64, steps, copies, steps // 3)
    scene.renderer.grad_seed = None
    tqdm.write(line_of(label, found[label]))
    return found


def line_of(label: str, found: dict[str, Any]) -> str:
    hidden = [bias[5] for bias in found["bias"]]
    return f"{label:<50} {found['rms']:.2f}±{found['error']:.2f}, hidden albedo {hidden}, CPU {found['CPU s']} s a fit"


# How wrong the network of `amortised.py` is: standard deviations, in shares of the ranges.
NETWORK = torch.tensor([0.0085, 0.023, 0.031, 0.033, 0.019, 0.05])


def priors(scene: Scene, *, quick: bool) -> dict[str, Any]:
    """Mean error of six unknowns in percent of their ranges: 30 steps from a prior's centre, drawn around the truth."""
    number, seeds = (4, 1) if quick else (24, 3)
    errors: dict[str, list[float]] = {}
    seconds: dict[str, list[float]] = {}
    for seed in range(seeds):
        torch.manual_seed(seed)
        truth = two_walls.LOW + two_walls.SPAN * torch.rand(number, 6)
        start = truth + two_walls.SPAN * NETWORK * torch.randn(number, 6)
        mean = torch.cat([scene.draws(t, 4096, [seed]).float() for t in truth])
        counts = torch.poisson(mean, generator=torch.Generator().manual_seed(seed))
        fit = Fit(scene.renderer, scene.sensor, counts)
        with torch.no_grad():
            held = torch.cat([scene.draws(s, 512, [seed + 99]).float() for s in start])
        squares = functools.partial(weighted, variance=held)
        ways: dict[str, tuple[Any, int, int | None]] = {
            "weighted squares, 64 samples": (squares, 64, None),
            "`poisson_loss`, 64": (poisson, 64, None),
            "`poisson_loss`, 64 then 1024": (poisson, 64, 1024),
            "`expected_root_loss`, 64": (roots, 64, None),
            "`expected_root_loss`, 64 then 1024": (roots, 64, 1024),
        }
        errors.setdefault("the start", []).append(percent(start, truth))
        for name, (misfit, spp, late) in ways.items():
            began = time.process_time()
            found = fit(start, 30, misfit, spp=spp, late=late, sigma=NETWORK)
            seconds.setdefault(name, []).append(time.process_time() - began)
            errors.setdefault(name, []).append(percent(found, truth))
            tqdm.write(f"seed {seed}, {name}: {errors[name][-1]:.2f} %, CPU {seconds[name][-1]:.0f} s")
    return {
        name: {"percent": each, "CPU s": [round(s, 1) for s in seconds.get(name, [])]} for name, each in errors.items()
    }


def poisson(mean: Tensor, counts: Tensor) -> Tensor:
    return losses.poisson_loss(mean, counts, reduction="sum")


def percent(found: Tensor, truth: Tensor) -> float:
    return 100 * float(((found - truth) / two_walls.SPAN).abs().mean())
