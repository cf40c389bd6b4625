"""Find the index of refraction of the glass box in the Cornell box, from a transient and from a steady image.

The inverse problem of the mitransient paper, with smooth glass: the left box starts at an index of 1.2, the truth
is 1.5. The derivative goes through Fresnel's weights, the refracted directions and the optical path length in the
glass.

A box of glass focuses light: a few paths carry much of it, and the brightest pixels and bins are the noisiest. The
measurement is therefore repeated, and squared differences are weighted by the inverse of the variance that the
repetitions show, for both kinds of image alike. The steady image is the sum over the bins of the same renders.

    python training_examples/fit_glass_index.py --steps 100 --spp 8192 --resolution 8 --output fit_glass_index.png
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import torch

import torchtransient as tt

KEY = "large-box.bsdf.eta"
START, TRUTH = 1.2, 1.5


@dataclass
class Measurement:
    """Mean of repeated renders and the weights of squared differences from it."""

    mean: torch.Tensor
    weight: torch.Tensor


def make_renderer(index: float, resolution: int, spp: int) -> tt.TransientRenderer:
    scene = tt.scenes.cornell_box(resolution, glass=True, index=index, max_depth=8)
    variant = "cuda_ad_mono" if torch.cuda.is_available() else "llvm_ad_mono"
    axis = tt.TimeAxis(start_opl=3.5, bin_width_opl=0.1, num_bins=60)
    return tt.TransientRenderer(tt.load(scene, variant=variant), parameters=[KEY], time_axis=axis, spp=spp)


def measure(resolution: int, spp: int, repetitions: int) -> dict[str, Measurement]:
    """What the sensor records of the true scene: mean and variance over independent renders."""
    truth = make_renderer(TRUTH, resolution, spp)
    with torch.no_grad():
        renders = [truth(seed=10_000 + k) for k in range(repetitions)]
    result = {}
    for kind in ("transient", "steady"):
        stack = torch.stack([getattr(out, kind) for out in renders])
        variance = stack.var(dim=0)
        # The floor keeps bins whose few samples happened to agree from weighing more than all others.
        result[kind] = Measurement(stack.mean(dim=0), 1 / (variance + 1e-2 * variance.mean()))
    return result


def fit(kind: str, target: Measurement, args: argparse.Namespace) -> list[float]:
    """Adam from START on the weighted squared difference of one kind of image; the index after every step."""
    renderer = make_renderer(START, args.resolution, args.spp)
    # Derivatives far from the truth dwarf those near it: with Adam's usual memory of a thousand steps it would crawl.
    optimizer = torch.optim.Adam(renderer.parameters(), lr=args.learning_rate, betas=(0.8, 0.95))
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, args.steps, eta_min=args.learning_rate / 100)
    history = [START]
    begin = time.perf_counter()
    for step in range(args.steps):
        optimizer.zero_grad()
        image = getattr(renderer(seed=args.seed * 100_000 + step), kind)
        loss = (target.weight * (image - target.mean) ** 2).mean()
        loss.backward()
        optimizer.step()
        schedule.step()
        history.append(renderer.values[KEY].item())
        if step % max(1, args.steps // 10) == 0 or step == args.steps - 1:
            print(f"  {kind:9s} step {step + 1:4d}  loss {loss.item():.3f}  index {history[-1]:.4f}", flush=True)
    print(f"  {kind:9s} {args.steps} steps in {time.perf_counter() - begin:.0f} s")
    return history


def draw(histories: dict[str, list[float]], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2), constrained_layout=True)
    for kind, history in histories.items():
        left.plot(history, label=f"from the {kind} image")
        right.semilogy([max(abs(x - TRUTH), 1e-5) for x in history], label=kind)
    left.axhline(TRUTH, color="black", linewidth=0.8, linestyle="--", label="truth")
    left.set(xlabel="step", ylabel="index of refraction")
    left.legend()
    right.axhline(0.002, color="grey", linewidth=0.8, linestyle=":")
    right.set(xlabel="step", ylabel="|index - truth|")
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=100, help="optimiser steps per fit")
    parser.add_argument("--spp", type=int, default=8192, help="samples per pixel of a render")
    parser.add_argument("--resolution", type=int, default=8, help="pixels along one side")
    parser.add_argument("--repetitions", type=int, default=64, help="renders that make up the measurement")
    parser.add_argument("--learning-rate", type=float, default=0.02, help="Adam's first step, in units of the index")
    parser.add_argument("--seed", type=int, default=0, help="another number gives other samples in the fit")
    parser.add_argument("--output", type=Path, default=Path("fit_glass_index.png"), help="where the curves go")
    parser.add_argument("--smoke", action="store_true", help="small enough for seconds: coarse, shows that it runs")
    if parser.parse_known_args()[0].smoke:
        parser.set_defaults(steps=6, spp=1024, resolution=4, repetitions=6)
    args = parser.parse_args()

    print(f"measuring: {args.repetitions} renders of {args.resolution}^2 pixels, {args.spp} spp, index {TRUTH}")
    targets = measure(args.resolution, args.spp, args.repetitions)
    histories = {kind: fit(kind, targets[kind], args) for kind in ("transient", "steady")}
    draw(histories, args.output)
    for kind, history in histories.items():
        print(f"from the {kind} image: index {history[-1]:.4f}, off by {abs(history[-1] - TRUTH):.4f}")
    print(f"curves in {args.output}")


if __name__ == "__main__":
    main()
