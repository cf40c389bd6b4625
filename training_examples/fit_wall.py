"""Find the distance and the tilt of a wall from the time of flight alone.

The measurement is when the light comes back, never how much of it: every pixel's histogram is divided by its sum, and
what is compared is its mean arrival. To prove the point, the measured wall is painted brighter than the model's. The
model starts 0.3 m and 6 degrees off. Its 4x4 matrix is made from distance and tilt by torch operations, so the gradient
goes from the arrival times through the path lengths and the matrix to the two numbers.

    python training_examples/fit_wall.py --output demo_output

`fit_wall.html` shows the fit step by step in a browser.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from tqdm import tqdm

import torchtransient as tt

KEY = "wall.to_world"
CAMERA_HEIGHT = 4.0
TRUE_DISTANCE, TRUE_TILT_DEG = 4.0, 6.0
START_DISTANCE, START_TILT_DEG = 4.3, 0.0
MEASURED_ALBEDO, MODEL_ALBEDO = 0.8, 0.5
TARGET_SEED = 1_000_003


@dataclass
class Fit:
    """What a fit leaves behind. Distances in metres, tilts in degrees, transients (1, T, H, W)."""

    axis: tt.TimeAxis
    target: torch.Tensor
    first: torch.Tensor
    last: torch.Tensor
    monitor: tt.vis.FitMonitor
    losses: list[float] = field(default_factory=list)
    distances: list[float] = field(default_factory=list)
    tilts_deg: list[float] = field(default_factory=list)

    @property
    def distance_errors(self) -> list[float]:
        """Error of the distance before the first step and after each one, metres."""
        return [abs(distance - TRUE_DISTANCE) for distance in self.distances]

    @property
    def tilt_errors(self) -> list[float]:
        """Error of the tilt before the first step and after each one, degrees."""
        return [abs(tilt - TRUE_TILT_DEG) for tilt in self.tilts_deg]


def wall_renderer(albedo: float, resolution: int) -> tt.TransientRenderer:
    """A wall of some albedo under a camera and a point light, 7 to 10 m of path in bins of 1 cm."""
    scene = tt.scenes.moving_wall(
        wall_reflectance=albedo, resolution=resolution, start_opl=7.0, bin_width_opl=0.01, num_bins=300, max_depth=2
    )
    return tt.TransientRenderer(tt.load(scene, variant="llvm_ad_mono"), parameters=[KEY])


def wall_to_world(distance: torch.Tensor, tilt_deg: torch.Tensor) -> torch.Tensor:
    """The wall `distance` metres below the camera, turned by `tilt_deg` about the y axis: (4, 4), differentiable."""
    angle = torch.deg2rad(tilt_deg)
    c, s = torch.cos(angle), torch.sin(angle)
    zero, one = torch.zeros_like(c), torch.ones_like(c)
    rows = (
        (c, zero, s, zero),
        (zero, one, zero, zero),
        (-s, zero, c, CAMERA_HEIGHT - distance),
        (zero, zero, zero, one),
    )
    return torch.stack([torch.stack(row) for row in rows])


def mean_arrival(transient: torch.Tensor, axis: tt.TimeAxis) -> torch.Tensor:
    """Mean optical path length of every pixel's light, metres: (1, T, H, W) -> (H, W).

    The histogram is divided by its sum first: a wall twice as bright gives the same number.
    """
    histogram = transient[0]
    share = histogram / histogram.sum(dim=0)
    centers = axis.start_opl + (torch.arange(axis.num_bins, dtype=torch.float32) + 0.5) * axis.bin_width_opl
    return (share * centers[:, None, None]).sum(dim=0)


def fit_wall(steps: int, spp: int, resolution: int, target_spp: int) -> Fit:
    """Run the fit; `target_spp` samples per pixel make the target, `spp` every step."""
    renderer = wall_renderer(MODEL_ALBEDO, resolution)
    distance = torch.nn.Parameter(torch.tensor(START_DISTANCE))
    tilt_deg = torch.nn.Parameter(torch.tensor(START_TILT_DEG))

    def render(seed: int, spp: int) -> torch.Tensor:
        return renderer({KEY: wall_to_world(distance, tilt_deg)}, seed=seed, spp=spp).transient

    with torch.no_grad():
        truth = wall_to_world(torch.tensor(TRUE_DISTANCE), torch.tensor(TRUE_TILT_DEG))
        target = wall_renderer(MEASURED_ALBEDO, resolution)({KEY: truth}, seed=TARGET_SEED, spp=target_spp).transient
        first = render(0, target_spp)
    measured = mean_arrival(target, renderer.axis)
    # The two numbers, of which the layer's matrix is made. The measured wall is the brighter one.
    monitor = tt.vis.FitMonitor(
        {"distance [m]": distance, "tilt [degrees]": tilt_deg},
        target=target * (MODEL_ALBEDO / MEASURED_ALBEDO),
        pixels=[(resolution // 2, 0), (resolution // 2, resolution - 1)],
        truth={"distance [m]": TRUE_DISTANCE, "tilt [degrees]": TRUE_TILT_DEG},
        axis=renderer.axis,
    )
    fit = Fit(renderer.axis, target, first, first, monitor, [], [distance.item()], [tilt_deg.item()])

    # One rate per unit: metres for the distance, degrees for the tilt.
    optimizer = torch.optim.Adam(
        [{"params": [distance], "lr": 0.02}, {"params": [tilt_deg], "lr": 0.4}], betas=(0.8, 0.9)
    )
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, T_max=steps)
    progress = tqdm(range(steps), desc="fit_wall", unit="step")
    for step in progress:
        optimizer.zero_grad()
        light = render(step, spp)
        loss = (mean_arrival(light, renderer.axis) - measured).square().mean()
        loss.backward()
        monitor.step(loss, light)
        optimizer.step()
        schedule.step()
        fit.losses.append(loss.item())
        fit.distances.append(distance.item())
        fit.tilts_deg.append(tilt_deg.item())
        progress.set_postfix(mm=f"{1e3 * fit.distance_errors[-1]:.2f}", deg=f"{fit.tilt_errors[-1]:.3f}")
    with torch.no_grad():
        fit.last = render(TARGET_SEED + 1, target_spp)
    return fit


def draw(fit: Fit, path: Path) -> None:
    """Errors over the steps, arrival maps, and one pixel's histogram."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 6.4), layout="constrained")
    top, bottom = figure.subfigures(2, 1)
    distance_axes, tilt_axes, pixel_axes = top.subplots(1, 3)
    distance_axes.semilogy([1e3 * error for error in fit.distance_errors], color="tab:blue")
    distance_axes.axhline(1.0, color="0.6", linewidth=0.8, linestyle="--")
    distance_axes.set(xlabel="step", ylabel="mm", title="error of the distance (dashes: 1 mm)")
    tilt_axes.semilogy(fit.tilt_errors, color="tab:orange")
    tilt_axes.axhline(0.05, color="0.6", linewidth=0.8, linestyle="--")
    tilt_axes.set(xlabel="step", ylabel="degrees", title="error of the tilt (dashes: 0.05 degrees)")
    centers = fit.axis.start_opl + (torch.arange(fit.axis.num_bins) + 0.5) * fit.axis.bin_width_opl
    row, column = fit.target.shape[2] // 2, fit.target.shape[3] - 1
    named = (
        ("start", fit.first, "0.6", "-"),
        ("target", fit.target, "tab:green", "-"),
        ("fitted", fit.last, "black", "--"),
    )
    for name, cube, colour, style in named:
        histogram = cube[0, :, row, column]
        pixel_axes.plot(centers, histogram / histogram.sum(), color=colour, linestyle=style, label=name)
    shown = (fit.target + fit.first)[0, :, row, column].nonzero().squeeze()
    pixel_axes.set(xlim=(float(centers[shown[0]]) - 0.05, float(centers[shown[-1]]) + 0.05))
    pixel_axes.set(xlabel="optical path length [m]", ylabel="share of the light", title="histogram of one pixel")
    pixel_axes.legend(fontsize=8)

    target, first, last = (mean_arrival(cube, fit.axis) for cube in (fit.target, fit.first, fit.last))
    maps = bottom.subplots(1, 3)
    drawn = maps[0].imshow(target, cmap="viridis")
    bottom.colorbar(drawn, ax=maps[0], label="m")
    maps[0].set(xticks=[], yticks=[], title="mean arrival of the target")
    for axes, error, title in zip(
        maps[1:], (first - target, last - target), ("start - target", "fitted - target"), strict=True
    ):
        limit = 1e3 * float(error.abs().max())
        drawn = axes.imshow(1e3 * error, cmap="RdBu", vmin=-limit, vmax=limit)
        axes.set(xticks=[], yticks=[], title=title)
        bottom.colorbar(drawn, ax=axes, label="mm")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)


def main(argv: Sequence[str] | None = None) -> Fit:
    """Command line. Prints one line with both errors."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=150, help="steps of Adam (%(default)s)")
    parser.add_argument("--spp", type=int, default=64, help="samples per pixel and step (%(default)s)")
    parser.add_argument("--resolution", type=int, default=16, help="pixels per side (%(default)s)")
    parser.add_argument("--target-spp", type=int, default=4096, help="samples per pixel of the target (%(default)s)")
    parser.add_argument("--output", type=Path, default=Path("demo_output"), help="folder for the picture (%(default)s)")
    parser.add_argument("--smoke", action="store_true", help="small enough for seconds: coarse, shows that it runs")
    if parser.parse_known_args(argv)[0].smoke:
        parser.set_defaults(steps=8, spp=16, resolution=6, target_spp=256)
    options = parser.parse_args(argv)
    fit = fit_wall(options.steps, options.spp, options.resolution, options.target_spp)
    picture = options.output / "fit_wall.png"
    draw(fit, picture)
    fit.monitor.save(options.output / "fit_wall.html")
    millimetres = [1e3 * error for error in fit.distance_errors]
    print(
        f"fit_wall: distance error {millimetres[-1]:.3f} mm, tilt error {fit.tilt_errors[-1]:.4f} degrees after "
        f"{options.steps} steps (start {millimetres[0]:.0f} mm, {fit.tilt_errors[0]:.1f} degrees); {picture}"
    )
    return fit


if __name__ == "__main__":
    main()
