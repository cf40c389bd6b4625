"""Find the pose of a concave body before a wall: a network guesses, the renderer corrects.

The body is a block in the shape of an L, whose arms cast shadows on each other and on the wall and light each other.
Its pose is six numbers; the true one is 10 cm and 15 degrees from the middle of the poses that are known to occur, in
other directions for every seed. A small network learns from renders of a few hundred random poses, in seconds and
without a gradient of the renderer, and is off by a centimetre or two. Its guess is where gradient descent through the
renderer starts. The derivative is the interior one and that of the edges that move: outlines, creases, shadows.

    python training_examples/fit_body.py --seeds 10 --output demo_output

Prints errors of every seed before and after, and how many end within 2 mm and 0.5 degrees. `--no-network` starts in the
middle, `--no-boundary` leaves the edges out.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional
from tqdm import tqdm

import torchtransient as tt
from torchtransient.parametrize import AxisAnglePose, axis_angle_from_pose
from torchtransient.scenes import look_at, rotate, scale, translate
from torchtransient.scenes.meshes import triangle_mesh
from torchtransient.scenes.parts import diffuse, perspective, transient_film, transient_path
from torchtransient.vis.files import figure_type, save_figure

KEY, BINS, RESOLUTION = "body.to_world", 96, 16
MIDDLE = translate([0.0, 0.0, 0.2]) @ rotate([0.5, 1.0, 0.2], 30.0)
POSE = AxisAnglePose(torch.tensor(MIDDLE).float())
OFF_M, OFF_DEG = 0.1, 15.0
UNIT = torch.tensor([math.radians(OFF_DEG)] * 3 + [OFF_M] * 3)  # radians, metres
RATE = torch.tensor([0.02] * 3 + [0.01] * 3)  # of Adam's first steps
GOOD_MM, GOOD_DEG = 2.0, 0.5
TARGET_SEED, LEARNT_SEED = 1_000_003, 50_000


@dataclass
class Fit:
    """Transients (1, T, H, W); errors before the first step and after each one."""

    target: Tensor
    first: Tensor
    last: Tensor
    millimetres: list[float] = field(default_factory=list)
    degrees: list[float] = field(default_factory=list)

    def add(self, errors: tuple[float, float]) -> None:
        self.millimetres.append(errors[0])
        self.degrees.append(errors[1])

    @property
    def good(self) -> bool:
        return self.millimetres[-1] < GOOD_MM and self.degrees[-1] < GOOD_DEG


def block() -> tuple[np.ndarray, np.ndarray]:
    """An L of 60 x 80 cm, 30 cm thick, with arms of 25 cm: vertices (16, 3), metres, and faces (28, 3)."""
    outline = [(0, 0), (0.25, 0), (0.6, 0), (0.6, 0.25), (0.25, 0.25), (0.25, 0.8), (0, 0.8), (0, 0.25)]
    vertices = np.array([(x - 0.22, y - 0.3, z) for z in (-0.15, 0.15) for x, y in outline])
    squares = [(0, 1, 4, 7), (1, 2, 3, 4), (7, 4, 5, 6)]
    back = [three for a, b, c, d in squares for three in ((a, c, b), (a, d, c))]
    front = [(a + 8, c + 8, b + 8) for a, b, c in back]
    around = [(i, (i + 1) % 8) for i in range(8)]
    sides = [three for i, j in around for three in ((i, j, j + 8), (i, j + 8, i + 8))]
    return vertices, np.array(back + front + sides)


def renderer_of(spp: int, boundary: bool) -> tt.TransientRenderer:
    """16 x 16 pixels, 96 bins of 3.5 cm, light of one and two reflections."""
    film = transient_film(RESOLUTION, BINS, 5.4, 0.035)
    scene = {
        "type": "scene",
        "integrator": transient_path(3),
        "sensor": perspective(look_at([0, 0, 3.5], [0, 0, 0]), 30.0, film, spp, "multijitter"),
        "light": {"type": "point", "position": [0.8, 0.5, 3.2], "intensity": 10.0},
        "wall": {"type": "rectangle", "to_world": translate([0, 0, -0.6]) @ scale(1.5), "bsdf": diffuse(0.5)},
        "body": triangle_mesh(*block(), reflectance=0.8, to_world=MIDDLE) | {"face_normals": True},
    }
    return tt.TransientRenderer(
        tt.load(scene, variant="llvm_ad_mono"), [KEY], spp=spp, boundary=boundary,
        spp_boundary=spp if boundary else None,
    )  # fmt: skip


def random_numbers(count: int, generator: torch.Generator) -> Tensor:
    """(count, 6): turns and shifts from the middle, in balls a little larger than where the truths are."""
    directions = functional.normalize(torch.randn(count, 2, 3, generator=generator), dim=2)
    radii = 1.3 * torch.rand(count, 2, 1, generator=generator) ** (1 / 3)
    return (directions * radii).flatten(1) * UNIT


def true_numbers(seed: int) -> Tensor:
    """(6,): 15 degrees and 10 cm in directions that depend on the seed."""
    generator = torch.Generator().manual_seed(seed)
    return functional.normalize(torch.randn(2, 3, generator=generator), dim=1).flatten() * UNIT


class Guess(nn.Module):
    """Pose from a transient: (B, T, H, W) -> (B, 6). Bins are channels; roots make dark and bright ones alike."""

    def __init__(self, level: float) -> None:
        super().__init__()
        self.level = level
        self.layers = nn.Sequential(
            nn.Conv2d(BINS, 32, 3, padding=1), nn.ReLU(),
            nn.Conv2d(32, 32, 3, stride=2, padding=1), nn.ReLU(),
            nn.Conv2d(32, 32, 3, stride=2, padding=1), nn.ReLU(),
            nn.Flatten(), nn.Linear(32 * (RESOLUTION // 4) ** 2, 64), nn.ReLU(), nn.Linear(64, 6),
        )  # fmt: skip

    def forward(self, transient: Tensor) -> Tensor:
        return self.layers((transient / self.level).sqrt()) * UNIT


def trained(renderer: tt.TransientRenderer, poses: int, steps: int) -> Guess:
    """The network, after it has seen renders of so many random poses."""
    numbers = random_numbers(poses, torch.Generator().manual_seed(0))
    with torch.no_grad():
        renders = tqdm(numbers, desc="fit_body, renders", unit="pose", leave=False)
        light = torch.cat(
            [renderer({KEY: POSE(six)}, seed=LEARNT_SEED + i, spp=64).transient for i, six in enumerate(renders)]
        )
    torch.manual_seed(0)
    network = Guess(float(light.sqrt().mean() ** 2))
    optimizer = torch.optim.AdamW(network.parameters(), weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 4e-3, steps)
    for _ in tqdm(range(steps), desc="fit_body, network", unit="step", leave=False):
        drawn = torch.randint(poses, (32,))
        optimizer.zero_grad()
        ((network(light[drawn]) - numbers[drawn]) / UNIT).square().mean().backward()
        optimizer.step()
        schedule.step()
    return network


def errors(pose: Tensor, truth: Tensor) -> tuple[float, float]:
    """Millimetres and degrees."""
    off = axis_angle_from_pose(pose.detach() @ torch.linalg.inv(truth))
    return 1e3 * float((pose.detach() - truth)[:3, 3].norm()), math.degrees(float(off[:3].norm()))


def fit_body(renderer: tt.TransientRenderer, network: Guess | None, seed: int, steps: int, target_spp: int) -> Fit:
    """Run the fit of a seed, from the network's guess or, without one, from the middle."""
    truth = POSE(true_numbers(seed))
    with torch.no_grad():
        target = renderer({KEY: truth}, seed=TARGET_SEED + seed, spp=target_spp).transient
        start = torch.zeros(6) if network is None else network(target)[0]
        first = renderer({KEY: POSE(start)}, seed=0).transient
    # In units of the rates, so that turns and shifts have rates of their own.
    numbers = torch.nn.Parameter(start / RATE)
    result = Fit(target, first, first)
    optimizer = torch.optim.Adam([numbers], 1.0, betas=(0.8, 0.95))
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.01 ** (1 / steps))
    progress = tqdm(range(steps), desc=f"fit_body, seed {seed}", unit="step", leave=False)
    for step in progress:
        result.add(errors(POSE(RATE * numbers), truth))
        progress.set_postfix(mm=f"{result.millimetres[-1]:.2f}", deg=f"{result.degrees[-1]:.3f}")
        optimizer.zero_grad()
        out = renderer({KEY: POSE(RATE * numbers)}, seed=seed * 100_000 + step)
        (out.transient - target).square().sum().backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        found = POSE(RATE * numbers)
        result.last = renderer({KEY: found}, seed=TARGET_SEED - 1).transient
    result.add(errors(found, truth))
    return result


def draw(fits: Sequence[Fit], path: Path) -> None:
    """One seed's images, summed over time, and errors of all seeds over the steps."""
    figure = figure_type()(figsize=(13, 3.4), layout="constrained")
    images, curves = figure.subfigures(1, 2, width_ratios=[1.2, 1])
    shown = {"guess": fits[0].first, "found": fits[0].last, "truth": fits[0].target}
    brightest = float(fits[0].target.sum(1).max())
    for axes, (name, cube) in zip(images.subplots(1, 3), shown.items(), strict=True):
        axes.imshow(cube[0].sum(0), vmin=0, vmax=brightest, cmap="gray")
        axes.set(xticks=[], yticks=[], title=name)
    panels = curves.subplots(1, 2)
    for axes, limit, unit in zip(panels, (GOOD_MM, GOOD_DEG), ("mm", "degrees"), strict=True):
        for fit in fits:
            axes.semilogy(fit.millimetres if unit == "mm" else fit.degrees, linewidth=1)
        axes.axhline(limit, color="0.6", linewidth=0.8, linestyle="--")
        axes.set(xlabel="step", ylabel=unit, title=f"error, dashes: {limit:g}")
    save_figure(figure, path, "fit_body")


def main(argv: Sequence[str] | None = None) -> list[Fit]:
    """Command line. Prints a line for every seed, and how many are good."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10, help="how many true poses (%(default)s)")
    parser.add_argument("--steps", type=int, default=100, help="steps of Adam (%(default)s)")
    parser.add_argument("--spp", type=int, default=256, help="samples per pixel of a step (%(default)s)")
    parser.add_argument("--target-spp", type=int, default=8192, help="samples per pixel of the target (%(default)s)")
    parser.add_argument("--poses", type=int, default=400, help="renders that the network learns from (%(default)s)")
    parser.add_argument("--network-steps", type=int, default=300, help="steps of the network (%(default)s)")
    parser.add_argument("--no-network", action="store_true", help="start in the middle of the poses")
    parser.add_argument("--no-boundary", action="store_true", help="the interior derivative alone")
    parser.add_argument("--output", type=Path, default=Path("demo_output"), help="folder for the picture (%(default)s)")
    parser.add_argument("--smoke", action="store_true", help="small enough for seconds: coarse, shows that it runs")
    if parser.parse_known_args(argv)[0].smoke:
        parser.set_defaults(seeds=1, steps=60, spp=64, target_spp=1024, poses=100, network_steps=100)
    options = parser.parse_args(argv)
    tt.threads(1)  # a film so small is not worth several
    renderer = renderer_of(options.spp, not options.no_boundary)
    network = None if options.no_network else trained(renderer, options.poses, options.network_steps)
    fits = []
    for seed in range(options.seeds):
        fits.append(fit_body(renderer, network, seed, options.steps, options.target_spp))
        mm, deg = fits[-1].millimetres, fits[-1].degrees
        print(
            f"fit_body, seed {seed}: from {mm[0]:.1f} mm and {deg[0]:.2f} degrees to {mm[-1]:.2f} mm and "
            f"{deg[-1]:.3f} degrees",
            flush=True,
        )
    good = sum(fit.good for fit in fits)
    print(f"fit_body: {good} of {len(fits)} within {GOOD_MM:g} mm and {GOOD_DEG:g} degrees")
    options.output.mkdir(parents=True, exist_ok=True)
    draw(fits, options.output / "fit_body.png")
    return fits


if __name__ == "__main__":
    main()
