"""Light travelling through a bottle: a laser pulse in water with a little milk, frame by frame.

The scene of the first films of light in flight (Velten et al. 2013): a bottle of rough glass filled with diluted milk,
a laser that shines up from its base. Writes frames and a video, and recovers how much milk is in the water from the
transient alone: the derivative of the light by the extinction of the medium goes through every scattering.

    python training_examples/bottle.py --output demo_output
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from tqdm import tqdm

import torchtransient as tt

KEY = "bottle.interior_medium.sigma_t.value.value"
AXIS = tt.TimeAxis(start_opl=0.0, bin_width_opl=0.005, num_bins=100)
TARGET_SEED = 1_000_003
FIRST_BIN = 16


@dataclass
class Fit:
    """Milk in the water after every step (steps + 1,), as a multiple of the true amount."""

    found: torch.Tensor

    @property
    def errors(self) -> torch.Tensor:
        """Relative error after every step."""
        return (self.found - 1.0).abs()


def bottle(folder: Path, height: int, spp: int, max_depth: int) -> tt.Scene:
    """The scene, `height` pixels high; its mesh is written to `folder`."""
    size = (height * 5 // 8, height)
    scene = tt.scenes.milk_bottle(folder / "bottle.ply", resolution=size, spp=spp, max_depth=max_depth)
    return tt.load(scene, variant="llvm_ad_rgb")


def film(scene: tt.Scene, spp: int, folder: Path) -> tt.RenderOutput:
    """Render the pulse and write video and frames."""
    with torch.no_grad():
        out = tt.TransientRenderer(scene, time_axis=AXIS, spp=spp)(seed=0, progress=True)
    tt.vis.video(out, folder / "bottle.mp4", fps=20, progress=True)
    tt.vis.frame_grid(out, folder / "bottle_frames.png", count=8, columns=8, title="light in a bottle of diluted milk")
    return out


def fit(scene: tt.Scene, steps: int, spp: int, target_spp: int) -> Fit:
    """Find the amount of milk from the transient, starting at twice the truth; in log space.

    It is one factor on the extinction of all three colours, whose albedo is kept. Every number of the transient counts
    relative to itself and the mean, so that the brightest do not outweigh the rest.
    """
    renderer = tt.TransientRenderer(scene, [KEY], time_axis=AXIS, spp=spp)
    truth = renderer.values[KEY].detach().clone()
    with torch.no_grad():
        target = coarse(renderer(seed=TARGET_SEED, spp=target_spp, progress=True).transient)
    weight = 1 / (target + 0.2 * target.mean())
    logarithm = torch.nn.Parameter(torch.tensor(2.0).log())
    optimizer = torch.optim.Adam([logarithm], lr=0.08, betas=(0.8, 0.95))
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, T_max=max(steps, 1))
    history = [logarithm.detach().exp()]
    for step in tqdm(range(steps), desc="bottle: milk", unit="step"):
        optimizer.zero_grad()
        light = coarse(renderer({KEY: logarithm.exp() * truth}, seed=step).transient)
        torch.mean(weight * (light - target).square()).backward()
        optimizer.step()
        schedule.step()
        history.append(logarithm.detach().exp())
    return Fit(torch.stack(history))


def coarse(transient: torch.Tensor) -> torch.Tensor:
    """Sums over rows and blocks of 4 rows and 4 bins, (C, T / 4, H / 4): noise averages out, the pulse is seen to rise.

    The bins that see the laser itself are left out: near a point light single samples are very bright.
    """
    by_row = transient[:, FIRST_BIN:].mean(dim=3)
    return torch.nn.functional.avg_pool2d(by_row[None], (4, 4))[0]


def draw_fit(result: Fit, path: Path) -> None:
    """The amount of milk over the steps."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.5, 3.2), layout="constrained")
    axes = figure.subplots()
    axes.plot(result.found, color="C0")
    axes.axhline(1.0, color="0.3", ls=":", lw=1)
    axes.set(xlabel="step", ylabel="milk, true amount = 1")
    figure.savefig(path, dpi=90)


def main(argv: Sequence[str] | None = None) -> Fit:
    """Command line. Prints one line with the recovered amount of milk."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--height", type=int, default=160, help="pixels of the video (%(default)s)")
    parser.add_argument("--spp", type=int, default=512, help="samples per pixel of the video (%(default)s)")
    parser.add_argument("--max-depth", type=int, default=24, help="vertices of a path (%(default)s)")
    parser.add_argument("--fit-height", type=int, default=32, help="pixels of the fit (%(default)s)")
    parser.add_argument("--steps", type=int, default=60, help="steps of Adam (%(default)s)")
    parser.add_argument("--fit-spp", type=int, default=64, help="samples per pixel and step (%(default)s)")
    parser.add_argument("--target-spp", type=int, default=4096, help="samples per pixel of the target (%(default)s)")
    parser.add_argument("--output", type=Path, default=Path("demo_output"), help="folder (%(default)s)")
    options = parser.parse_args(argv)
    options.output.mkdir(parents=True, exist_ok=True)
    film(bottle(options.output, options.height, options.spp, options.max_depth), options.spp, options.output)
    small = bottle(options.output, options.fit_height, options.fit_spp, options.max_depth)
    result = fit(small, options.steps, options.fit_spp, options.target_spp)
    draw_fit(result, options.output / "bottle_fit.png")
    print(
        f"bottle: amount of milk {float(result.found[-1]):.3f} of the truth after {options.steps} steps "
        f"(start {float(result.found[0]):.1f}); {options.output / 'bottle.mp4'}"
    )
    return result


if __name__ == "__main__":
    main()
