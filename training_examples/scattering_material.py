"""What a turbid block is made of, from when light comes back out of it: scattering and absorption by gradient.

A projector lights one half of a block's face; a camera looks at the edge of the light from above, each of its pixels 5
mm wide. Unknown are the scattering and the absorption coefficient (per metre) and the power of the light. The fit goes
through `transient_prbvolpath`: squared errors over the variance of the counts, whose gradient the noise of a render
does not bias. The same fit with the same counts summed over time is the steady camera, once with the power unknown and
once with it known. Diffusion theory, which is what the field fits to such counts, is fitted to them too.

    python training_examples/scattering_material.py --seeds 0 1 2

Prints the errors of both coefficients in per cent, for each seed and in the mean.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm
from turbid_block import AXIS, PIXEL, PIXELS, Block, diffused

import torchtransient as tt
from torchtransient import sensing

TRUTH, START = (200.0, 6.0), (100.0, 15.0)  # scattering, absorption, per metre
FULL = argparse.Namespace(steps=80, spp=1024, target_spp=1 << 18)
SMOKE = argparse.Namespace(steps=30, spp=512, target_spp=1 << 14)


@dataclass(frozen=True)
class Camera:
    """Whether counts are summed over time and whether the power is known; how many times the steps the fit gets."""

    steady: bool
    power_known: bool
    times: int = 1


METHODS = {
    "transient": Camera(False, False),
    "steady": Camera(True, False, 4),
    "steady, power known": Camera(True, True),
}
DIFFUSION = "diffusion theory"


@dataclass
class Fit:
    """Coefficients (steps + 1, 2) along the way, what was found (2,), CPU seconds."""

    way: list[list[float]]
    found: Tensor
    seconds: float

    @property
    def errors(self) -> list[float]:
        """Of both coefficients, per cent."""
        return [100 * abs(float(x) / truth - 1) for x, truth in zip(self.found, TRUTH, strict=True)]


def fit(counts: Tensor, per_light: float, sizes: argparse.Namespace, seed: int, method: str) -> Fit:
    """`per_light`: counts of a unit of light, which is used only where the power is known."""
    camera, model, began = METHODS[method], Block(START), time.process_time()
    steps = camera.times * sizes.steps
    optimizer = torch.optim.Adam(model.parameters(), lr=0.08, betas=(0.8, 0.95))
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps, 0.005)
    measured = counts.sum(1, keepdim=True) if camera.steady else counts
    before = None  # mean of the renders before this one, of whose noise it does not depend
    way = [list(START)]
    bar = tqdm(range(steps), desc=f"seed {seed}, {method}", unit="step")
    for step in bar:
        light = model(seed * 100_000 + step, sizes.spp)
        light = light.sum(1, keepdim=True) if camera.steady else light
        now = light.detach()
        before = now if before is None else before
        factor = per_light if camera.power_known else float(counts.sum() / before.sum())
        expected = factor * before
        weight = 1 / (expected + 1)
        residual = factor * light - measured
        if not camera.power_known:  # what another power would do is no error
            residual = residual - expected * (weight * expected * residual).sum() / (weight * expected**2).sum()
        loss = (weight * residual.square()).mean()
        before = 0.8 * before + 0.2 * now
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        way.append(model.coefficients.detach().tolist())
        bar.set_postfix(scattering=f"{way[-1][0]:.1f}", absorption=f"{way[-1][1]:.2f}")
    last = torch.tensor(way[-max(1, steps // 4) :])
    return Fit(way, last.log().mean(0).exp(), time.process_time() - began)


def fit_diffusion(counts: Tensor) -> Fit:
    """Likeliest coefficients, power unknown, where the theory holds: once the counts are down at half their peak.

    Means of three bins say where that is: single counts would begin it at the first bin that noise made small.
    """
    began = time.process_time()
    course = torch.nn.functional.avg_pool1d(counts[0, :, 0].T, 3, 1, 1, count_include_pad=False).T[None, :, None]
    bins, peak = torch.arange(AXIS.num_bins).reshape(-1, 1, 1), course.argmax(1, keepdim=True)
    late = ((bins > peak) & (course < course.amax(1, keepdim=True) / 2)).cumsum(1) > 0
    logs = torch.tensor(START, dtype=torch.float64).log().requires_grad_()
    optimizer = torch.optim.LBFGS([logs], max_iter=100, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        optimizer.zero_grad()
        light = diffused(*logs.exp())[late]
        loss = tt.losses.poisson_nll(light * (counts[late].sum() / light.sum()), counts[late])
        loss.backward()
        return loss

    optimizer.step(closure)
    found = logs.detach().exp()
    return Fit([list(START), found.tolist()], found, time.process_time() - began)


def draw(light: Tensor, counts: Tensor, fits: dict[str, Fit], path: Path) -> None:
    """Counts of three pixels against time, their sum over time, and the ways to what was found."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 3.6), layout="constrained")
    over_time, over_x, plane = figure.subplots(1, 3)
    total = counts.sum()
    with torch.no_grad():
        start = Block(START)(77, 1 << 14)
    start = start * (total / start.sum())
    x = 1000 * PIXEL * (torch.arange(PIXELS) - PIXELS / 2 - 1.5)
    seconds = 1e9 * AXIS.centers_s
    for pixel, colour in ((7, "C1"), (4, "C0"), (1, "C2")):
        over_time.plot(seconds, counts[0, :, 0, pixel], ".", ms=3, color=colour)
        over_time.plot(seconds, light[0, :, 0, pixel], lw=1, color=colour, label=f"{x[pixel]:+.1f} mm")
        over_time.plot(seconds, start[0, :, 0, pixel], ":", lw=1, color=colour)
    over_time.set(yscale="log", ylim=(0.7, None), xlabel="time [ns]", title="counts, fit, start (dotted)")
    over_time.legend(fontsize=8, title="from the edge", title_fontsize=8)
    for cube, style, name in ((counts, "k.", "counts"), (light, "C3-", "fit"), (start, "0.6", "start")):
        over_x.plot(x, cube.sum(1).flatten(), style, label=name)
    over_x.axvspan(0, 10, color="gold", alpha=0.2, lw=0)
    over_x.set(yscale="log", xlabel="from the edge of the light [mm]", title="all a steady camera sees", xlim=(-30, 10))
    over_x.legend(fontsize=8)
    for (name, one), colour in zip(fits.items(), ("C3", "C0", "C4", "C2"), strict=True):
        steps, found = torch.tensor(one.way), one.found
        if name != DIFFUSION:
            plane.plot(steps[:, 0], steps[:, 1], lw=0.8, color=colour)
        plane.plot(found[0], found[1], "o", color=colour, label=name)
    plane.plot(*TRUTH, "k+", ms=12, mew=2, label="truth")
    plane.set(xlabel="scattering [1/m]", ylabel="absorption [1/m]", title="from the start to what was found")
    plane.legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)
    print(f"scattering_material: {path}")


def main(argv: Sequence[str] | None = None) -> list[dict[str, Fit]]:
    """Command line; returns the fits of every seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="small enough for seconds")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="photons and renders (%(default)s)")
    parser.add_argument("--steps", type=int, help=f"of Adam ({FULL.steps})")
    parser.add_argument("--photons", type=float, default=1e5, help="counts in all (%(default)g)")
    parser.add_argument("--output", type=Path, default=Path("demo_output"), help="folder for the picture (%(default)s)")
    options = parser.parse_args(argv)
    sizes = argparse.Namespace(**vars(SMOKE if options.smoke else FULL))
    sizes.steps = options.steps or sizes.steps
    with torch.no_grad():
        truth = Block(TRUTH)
        seeds = range(1_000_000_000, 1_000_000_000 + sizes.target_spp // (1 << 14))
        light = torch.stack([truth(seed, 1 << 14) for seed in tqdm(seeds, desc="what is measured")]).mean(0)
    per_light, results = options.photons / float(light.sum()), []
    for seed in options.seeds:
        counts = sensing.poisson(light * per_light, torch.Generator().manual_seed(seed))
        fits = {method: fit(counts, per_light, sizes, seed, method) for method in METHODS}
        fits[DIFFUSION] = fit_diffusion(counts)
        results.append(fits)
        print(f"seed {seed:<18}scattering  off by, %  absorption  off by, %   CPU s")
        for name, one in fits.items():
            (s, a), (off_s, off_a) = one.found.tolist(), one.errors
            print(f"{name:<23}{s:10.1f}{off_s:11.1f}{a:12.2f}{off_a:11.1f}{one.seconds:8.0f}")
    print("mean over the seeds, off by, %: " + ", ".join(
        f"{name} {sum(r[name].errors[0] for r in results) / len(results):.1f} and "
        f"{sum(r[name].errors[1] for r in results) / len(results):.1f}" for name in results[0]))  # fmt: skip
    model = Block(results[-1]["transient"].found.tolist())
    with torch.no_grad():
        light = model(88, 1 << 14)
    draw(light * (counts.sum() / light.sum()), counts, results[-1], options.output / "scattering_material.png")
    return results


if __name__ == "__main__":
    main()
