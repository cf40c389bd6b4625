"""Fit the albedos of the Cornell box to a time-resolved picture of it.

The target is a transient render of the box with its true albedos. The fit starts from grey everywhere and moves the
nine numbers (white, red and green paint, three channels each) with an ordinary Adam on a plain squared error, until
the render and the target agree bin by bin.

    python training_examples/fit_albedo.py --output demo_output

`fit_albedo.html` shows the fit step by step in a browser.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch.nn.functional import avg_pool3d
from tqdm import tqdm

import torchtransient as tt

PAINTS = ("white", "red", "green")
KEYS = {paint: f"{paint}.reflectance.value" for paint in PAINTS}
START = 0.5
TARGET_SEED = 1_000_003


@dataclass
class Fit:
    """What a fit leaves behind: albedos (9,) and loss of every step, and transients (C, T, H, W)."""

    axis: tt.TimeAxis
    truth: torch.Tensor
    target: torch.Tensor
    first: torch.Tensor
    last: torch.Tensor
    monitor: tt.vis.FitMonitor
    losses: list[float] = field(default_factory=list)
    albedos: list[torch.Tensor] = field(default_factory=list)

    @property
    def errors(self) -> torch.Tensor:
        """Largest albedo error before the first step and after each one."""
        return (torch.stack(self.albedos) - self.truth).abs().amax(dim=1)


def squared_error(render: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Squared difference of two transients (C, T, H, W) over the square of the target, both averaged over blocks first.

    Blocks of 3 bins and 4x4 pixels still tell the paints apart and hold a seventh of the noise of single bins.
    """
    render, target = avg_pool3d(render, (3, 4, 4)), avg_pool3d(target, (3, 4, 4))
    return (render - target).square().mean() / target.square().mean()


def albedos_of(renderer: tt.TransientRenderer) -> torch.Tensor:
    """The nine albedos of a renderer, detached, (9,)."""
    return torch.cat([renderer.values[KEYS[paint]].detach() for paint in PAINTS]).clone()


def fit_albedo(steps: int, spp: int, resolution: int, target_spp: int) -> Fit:
    """Run the fit; `target_spp` samples per pixel make the target, `spp` every step."""
    # The axis starts after the lamp's own light has arrived (4.0 m): that is bright, noisy at the lamp's rim, and says
    # nothing of the paints.
    box = tt.scenes.cornell_box(resolution, start_opl=4.2, bin_width_opl=0.08, num_bins=75, max_depth=8)
    scene = tt.load(box, variant="llvm_ad_rgb")
    truth = tt.TransientRenderer(scene, parameters=list(KEYS.values()))
    start = {key: torch.full((3,), START) for key in KEYS.values()}
    renderer = tt.TransientRenderer(scene, parameters=start, spp=spp)
    with torch.no_grad():
        target = truth(seed=TARGET_SEED, spp=target_spp).transient
        first = renderer(seed=0, spp=target_spp).transient
    pixels = [(resolution // 3, resolution // 8), (resolution // 3, resolution // 2)]
    paints = {key: value.detach() for key, value in truth.values.items()}
    monitor = tt.vis.FitMonitor(renderer, target=target, pixels=pixels, truth=paints)
    fit = Fit(renderer.axis, albedos_of(truth), target, first, first, monitor)
    fit.albedos.append(albedos_of(renderer))

    optimizer = torch.optim.Adam(renderer.parameters(), lr=0.05, betas=(0.8, 0.95))
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, T_max=steps, eta_min=0.0005)
    progress = tqdm(range(steps), desc="fit_albedo", unit="step")
    for step in progress:
        optimizer.zero_grad()
        # A new seed every step: the noise averages out along the way instead of being fitted.
        out = renderer(seed=step)
        loss = squared_error(out.transient, target)
        loss.backward()
        monitor.step(loss, out)
        optimizer.step()
        schedule.step()
        with torch.no_grad():
            for value in renderer.parameters():
                value.clamp_(0.001, 0.999)
        fit.losses.append(float(loss.detach()))
        fit.albedos.append(albedos_of(renderer))
        progress.set_postfix(loss=f"{fit.losses[-1]:.2e}", error=f"{float(fit.errors[-1]):.4f}")
    with torch.no_grad():
        fit.last = renderer(seed=TARGET_SEED + 1, spp=target_spp).transient
    return fit


def draw(fit: Fit, path: Path) -> None:
    """Loss, albedos, and three moments of the target, the start and the fit."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 6.4), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=[1.0, 1.25])
    loss_axes, albedo_axes = left.subplots(2, 1)
    loss_axes.semilogy(range(1, len(fit.losses) + 1), fit.losses, color="0.3")
    loss_axes.set(xlabel="step", ylabel="relative squared error", title="loss (its floor is noise)")
    curves = torch.stack(fit.albedos)
    for number, paint in enumerate(PAINTS):
        for channel, colour in enumerate(("tab:red", "tab:green", "tab:blue")):
            entry = 3 * number + channel
            style = ("-", "--", ":")[number]
            label = f"{paint} paint" if channel == 0 else None
            albedo_axes.plot(curves[:, entry], color=colour, linestyle=style, label=label)
            albedo_axes.axhline(float(fit.truth[entry]), color=colour, linewidth=0.5, alpha=0.6)
    albedo_axes.set(xlabel="step", ylabel="albedo", ylim=(0, 1), title="albedos in R, G, B; thin lines: truth")
    for handle in albedo_axes.legend(loc="center right", bbox_to_anchor=(1.0, 0.42), fontsize=8).legend_handles:
        handle.set_color("0.3")

    moments = (4.62, 5.34, 6.54)
    grid = right.subplots(3, 3)
    rows = (("start", fit.first), ("fitted", fit.last), ("target", fit.target))
    for column, opl in enumerate(moments):
        number = min(int((opl - fit.axis.start_opl) / fit.axis.bin_width_opl), fit.axis.num_bins - 1)
        brightest = float(torch.quantile(fit.target[:, number].flatten(), 0.99))
        for row, (name, cube) in enumerate(rows):
            frame = (cube[:, number].permute(1, 2, 0) / max(brightest, 1e-12)).clamp(0, 1) ** (1 / 2.2)
            grid[row, column].imshow(frame.detach().numpy(), interpolation="nearest")
            grid[row, column].set(xticks=[], yticks=[])
            if column == 0:
                grid[row, column].set_ylabel(name)
        grid[0, column].set_title(f"path length {opl:.2f} m", fontsize=10)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)


def main(argv: Sequence[str] | None = None) -> Fit:
    """Command line. Prints one line with the largest error of the nine albedos."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=100, help="steps of Adam (%(default)s)")
    parser.add_argument("--spp", type=int, default=32, help="samples per pixel and step (%(default)s)")
    parser.add_argument("--resolution", type=int, default=48, help="pixels per side (%(default)s)")
    parser.add_argument("--target-spp", type=int, default=4096, help="samples per pixel of the target (%(default)s)")
    parser.add_argument("--output", type=Path, default=Path("demo_output"), help="folder for the picture (%(default)s)")
    parser.add_argument("--smoke", action="store_true", help="small enough for seconds: coarse, shows that it runs")
    if parser.parse_known_args(argv)[0].smoke:
        parser.set_defaults(steps=8, spp=8, resolution=12, target_spp=256)
    options = parser.parse_args(argv)
    fit = fit_albedo(options.steps, options.spp, options.resolution, options.target_spp)
    picture = options.output / "fit_albedo.png"
    draw(fit, picture)
    fit.monitor.save(options.output / "fit_albedo.html")
    print(
        f"fit_albedo: largest albedo error {float(fit.errors[-1]):.4f} after {options.steps} steps "
        f"(start {float(fit.errors[0]):.4f}); {picture}"
    )
    return fit


if __name__ == "__main__":
    main()
