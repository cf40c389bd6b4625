"""Find the pose of an occluder that no camera sees, from its time-resolved shadow alone.

A small lamp lights a wall, and an L of cardboard hangs between the two, out of view. The camera records when
light comes back from the wall, reflected once, and from where none does. The fit has six unknowns and starts 20 cm and
5 degrees off, in other directions for every seed.

No light that the camera sees has touched the L, so that the interior derivative by its pose is exactly zero: all of the
gradient is the boundary term, of light that its edges stop or let through. `--no-boundary` leaves it out, and the fit
stays where it starts.

The loss is the squared difference, at first of means over 4 bins and 4 x 4 pixels, whose slope reaches farther.

    python training_examples/fit_shadow.py --seeds 0 1 2 --output demo_output
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional
from tqdm import tqdm

import torchtransient as tt
from torchtransient.parametrize import AxisAnglePose, axis_angle_from_pose
from torchtransient.scenes import look_at, rotate, scale, translate
from torchtransient.scenes.meshes import triangle_mesh
from torchtransient.scenes.parts import diffuse, perspective, transient_film, transient_path
from torchtransient.vis.files import figure_type, save_figure

KEY = "occluder.to_world"
TRUTH = translate([0.1, 0.05, 1.2]) @ rotate([1.0, 0.4, 0.2], 25.0)
OFF_M, OFF_DEG = 0.2, 5.0
TARGET_SEED = 1_000_003
RATE = torch.tensor([0.05] * 3 + [0.03] * 3)  # of Adam's first steps: radians, metres


@dataclass
class Fit:
    """Transients (1, T, H, W); errors before the first step and after each one."""

    axis: tt.TimeAxis
    target: Tensor
    first: Tensor
    last: Tensor
    millimetres: list[float] = field(default_factory=list)
    degrees: list[float] = field(default_factory=list)

    def add(self, errors: tuple[float, float]) -> None:
        self.millimetres.append(errors[0])
        self.degrees.append(errors[1])


def occluder() -> tuple[np.ndarray, np.ndarray]:
    """An L, 70 x 90 cm with arms of 30 cm: vertices (8, 3), metres, and faces (6, 3)."""
    x, y = [-0.2, 0.1, 0.5, -0.2, 0.1, 0.5, -0.2, 0.1], [-0.35, -0.35, -0.35, -0.05, -0.05, -0.05, 0.55, 0.55]
    squares = [(0, 1, 4, 3), (1, 2, 5, 4), (3, 4, 7, 6)]
    faces = [three for a, b, c, d in squares for three in ((a, b, c), (a, c, d))]
    return np.stack([x, y, np.zeros(8)], axis=1), np.array(faces)


def renderer_of(resolution: int, spp: int, boundary: bool) -> tt.TransientRenderer:
    """128 bins of 3 cm, light that was reflected once."""
    film = transient_film(resolution, 128, 3.8, 0.03)
    lamp = look_at([0.4, 0.3, 2.4], [0, 0, 0]) @ scale(0.05)
    scene = {
        "type": "scene",
        "integrator": transient_path(2),
        "sensor": perspective(look_at([-2.3, -0.2, 1.3], [-0.15, -0.2, 0.0]), 42.0, film, spp, "multijitter"),
        "lamp": {"type": "rectangle", "to_world": lamp, "emitter": {"type": "area", "radiance": 400.0}},
        "wall": {"type": "rectangle", "to_world": scale(1.5), "bsdf": diffuse(0.7)},
        "occluder": triangle_mesh(*occluder(), to_world=TRUTH),
    }
    return tt.TransientRenderer(
        tt.load(scene, variant="llvm_ad_mono"), [KEY], spp=spp, spp_grad=256, boundary=boundary,
        spp_boundary=256 if boundary else None,
    )  # fmt: skip


def start_of(seed: int) -> Tensor:
    """A pose (4, 4) that is off in directions that depend on the seed."""
    turn, shift = functional.normalize(torch.randn(2, 3, generator=torch.Generator().manual_seed(seed)), dim=1)
    return AxisAnglePose(TRUTH)(torch.cat([math.radians(OFF_DEG) * turn, OFF_M * shift])).float()


def errors(pose: Tensor) -> tuple[float, float]:
    """Millimetres and degrees."""
    off = axis_angle_from_pose(pose.detach() @ torch.linalg.inv(torch.tensor(TRUTH).float()))
    shift = pose.detach()[:3, 3] - torch.tensor(TRUTH[:3, 3])
    return 1e3 * float(shift.norm()), math.degrees(float(off[:3].norm()))


def fit_shadow(renderer: tt.TransientRenderer, seed: int, steps: int, target_spp: int) -> Fit:
    """Run the fit of a seed."""
    with torch.no_grad():
        target = renderer({KEY: torch.tensor(TRUTH).float()}, seed=TARGET_SEED, spp=target_spp).transient
        pose = AxisAnglePose(start_of(seed))
        first = renderer({KEY: start_of(seed)}, seed=0).transient
    # In units of the rates, so that turns and shifts have rates of their own.
    numbers = torch.nn.Parameter(torch.zeros(6))
    result = Fit(renderer.axis, target, first, first)
    optimizer = torch.optim.Adam([numbers], 1.0, betas=(0.8, 0.95))
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.006 ** (1 / steps))
    progress = tqdm(range(steps), desc=f"fit_shadow, seed {seed}", unit="step", leave=False)
    for step in progress:
        result.add(errors(pose(RATE * numbers)))
        progress.set_postfix(mm=f"{result.millimetres[-1]:.2f}", deg=f"{result.degrees[-1]:.3f}")
        optimizer.zero_grad()
        rest = renderer({KEY: pose(RATE * numbers)}, seed=seed * 100_000 + step).transient - target
        if step < 0.3 * steps:
            rest = functional.avg_pool3d(rest, 4, 1)
        rest.square().sum().backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        found = pose(RATE * numbers)
        result.last = renderer({KEY: found}, seed=TARGET_SEED + 1).transient
    result.add(errors(found))
    return result


def draw(fit: Fit, path: Path) -> None:
    """The shadows, one row of pixels over time, and errors over the steps."""
    figure = figure_type()(figsize=(11, 6.2), layout="constrained")
    images, over_time, curves = figure.subfigures(1, 3, width_ratios=[1, 1.25, 1.25])
    cubes = {"start": fit.first, "found": fit.last, "truth": fit.target}
    brightest, row = float(fit.target.sum(1).max()), fit.target.shape[2] // 2
    kept = fit.target[0, :, row].sum(1).nonzero()
    begin, end = int(kept[0]), int(kept[-1]) + 1
    edges = fit.axis.edges_opl
    extent = (-0.5, fit.target.shape[3] - 0.5, float(edges[end]), float(edges[begin]))
    for axes, axes_in_time, (name, cube) in zip(
        images.subplots(3, 1), over_time.subplots(3, 1), cubes.items(), strict=True
    ):
        axes.imshow(cube[0].sum(0), vmin=0, vmax=brightest, cmap="gray")
        axes.set(xticks=[], yticks=[], title=f"{name}: sum over time")
        axes_in_time.imshow(cube[0, begin:end, row], extent=extent, aspect="auto", interpolation="none", cmap="magma")
        axes_in_time.set(title=f"{name}: row {row} over time", ylabel="path [m]")
    axes_in_time.set_xlabel("column")
    top, bottom = curves.subplots(2, 1)
    for axes, values, limit, unit in ((top, fit.millimetres, 1.0, "mm"), (bottom, fit.degrees, 0.1, "degrees")):
        axes.semilogy(values, color="black")
        axes.axhline(limit, color="0.6", linewidth=0.8, linestyle="--")
        axes.set(xlabel="step", ylabel=unit, title=f"error (dashes: {limit:g} {unit})")
    save_figure(figure, path, "fit_shadow")


def main(argv: Sequence[str] | None = None) -> list[Fit]:
    """Command line. Prints a line for every seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="directions of the start (%(default)s)")
    parser.add_argument("--steps", type=int, default=200, help="steps of Adam (%(default)s)")
    parser.add_argument("--spp", type=int, default=1024, help="samples per pixel of a step (%(default)s)")
    parser.add_argument("--resolution", type=int, default=16, help="pixels per side (%(default)s)")
    parser.add_argument("--target-spp", type=int, default=65536, help="samples per pixel of the target (%(default)s)")
    parser.add_argument("--no-boundary", action="store_true", help="the interior derivative alone: zero")
    parser.add_argument("--output", type=Path, default=Path("demo_output"), help="folder for the picture (%(default)s)")
    parser.add_argument("--smoke", action="store_true", help="small enough for seconds: coarse, shows that it runs")
    if parser.parse_known_args(argv)[0].smoke:
        parser.set_defaults(steps=100, spp=144, target_spp=4096)
    options = parser.parse_args(argv)
    tt.threads(1)  # a film so small is not worth several
    renderer = renderer_of(options.resolution, options.spp, not options.no_boundary)
    fits = []
    for seed in options.seeds:
        fits.append(fit_shadow(renderer, seed, options.steps, options.target_spp))
        mm, deg = fits[-1].millimetres, fits[-1].degrees
        print(
            f"fit_shadow, seed {seed}: {mm[-1]:.2f} mm and {deg[-1]:.3f} degrees off after {options.steps} steps "
            f"(start {mm[0]:.0f} mm, {deg[0]:.1f} degrees)",
            flush=True,
        )
    options.output.mkdir(parents=True, exist_ok=True)
    draw(fits[0], options.output / "fit_shadow.png")
    return fits


if __name__ == "__main__":
    main()
