"""Fit a wall to the phasors of an iToF camera whose light also takes a detour over a side wall.

A camera with light modulated at 20 and 100 MHz sees a wall 4 m away. Its pixels have two taps and hand out their
differences, with shot and read noise and a converter. Light that comes by a bright panel beside the wall arrives late,
and the phase takes the wall to be further away than it is: multipath. The renderer knows the detour. Its phasor film
gives what the taps collect, and `tt.losses.phasor_loss` compares what the same sensor makes of it with the measured
phasors. Unknown are distance, two tilts, and the albedos of wall and panel.

    python training_examples/fit_phasors.py --seeds 0 1 2 --output demo_output

Prints the errors of the distances of the camera's own depth, of a plane through it, and of the fits with a phasor film
and, in the same CPU time, with a histogram film.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

import torchtransient as tt
from torchtransient import sensing
from torchtransient.parametrize import pose_from_axis_angle
from torchtransient.scenes import rotate, scale, translate
from torchtransient.vis.files import figure_type, save_figure

HERTZ = (100e6, 20e6)
STEPS = 4  # of the phase, one exposure of both taps each
ELECTRONS = 6.4e5  # of a radiance of one: 10 000 in each tap
FREQUENCIES = tt.FrequencyAxis.from_hertz([0.0, *HERTZ])
WINDOW = tt.TimeAxis(6.0, 0.05, 200)
CODE = sensing.TwoTapCode(sensing.sine_code(STEPS))
CAMERA = sensing.Compose(
    [
        sensing.ItofCorrelation(CODE, HERTZ, WINDOW, contrast=0.8, background_e=2e4, electrons_per_unit=ELECTRONS),
        sensing.PixelElectronics(full_well_e=6e4, read_noise_e=20.0, gain_e_per_dn=15.0, bits=12),
        sensing.TapDifference(),
    ]
)
CAMERA_HEIGHT, FOV_DEG, SPP = 4.0, 20.0, 64
WALL = torch.tensor(scale(6.0)).float()  # before it is moved
KEYS = ("wall.to_world", "wall.bsdf.reflectance.value", "side.bsdf.reflectance.value")
# distance (m), tilts about y and x (degrees), albedos of the wall and of the panel
TRUTH, START = (4.0, 5.0, -3.0, 0.6, 0.85), (4.4, 0.0, 0.0, 0.4, 0.5)
RATES = (0.03, 0.5, 0.5, 0.02, 0.05)


@dataclass
class Fit:
    """`errors_mm` (rms) and `seconds` of the processor: of the start and of each step. `rest`: (H, W) metres, last."""

    values: list[float]
    errors_mm: list[float]
    rest: Tensor
    seconds: list[float] = field(default_factory=lambda: [0.0])


def scene(resolution: int) -> dict[str, Any]:
    """A wall that fills the picture under a camera with its lamp, and a panel of 1.6 m that stands beside the view."""
    described = tt.scenes.moving_wall(side_panel=True, resolution=resolution, max_depth=4)
    described["sensor"]["fov"], described["light"]["position"] = FOV_DEG, [0.0, 0.0, CAMERA_HEIGHT]
    described["wall"]["to_world"] = WALL.numpy()
    described["side"]["to_world"] = translate([1.4, 0.0, 1.0]) @ rotate([0, 1, 0], -80) @ scale(0.8)
    return described


def wall_to_world(distance: Tensor, tilt_y: Tensor, tilt_x: Tensor) -> Tensor:
    """(4, 4): the wall `distance` below the camera, tilted about y and then about x by degrees."""
    zero = torch.zeros_like(distance)
    turned = torch.stack([zero, torch.deg2rad(tilt_y), *4 * [zero]])
    moved = torch.stack([torch.deg2rad(tilt_x), *4 * [zero], CAMERA_HEIGHT - distance])
    return pose_from_axis_angle(moved) @ pose_from_axis_angle(turned) @ WALL


def rays(resolution: int) -> Tensor:
    """(H, W, 3): unit vectors from the camera through the middles of the pixels, x and y as the scene has them."""
    place = math.tan(math.radians(FOV_DEG / 2)) * ((torch.arange(resolution) + 0.5) / resolution * 2 - 1)
    y, x = torch.meshgrid(-place, place, indexing="ij")
    vectors = torch.stack([x, y, -torch.ones_like(x)], dim=-1)
    return vectors / vectors.norm(dim=-1, keepdim=True)


def distances_to_wall(values: Sequence[float], resolution: int) -> Tensor:
    """(H, W) metres along the rays to the wall of some parameters."""
    matrix = wall_to_world(*torch.tensor(values[:3]))
    point = matrix[:3, 3] - torch.tensor([0.0, 0.0, CAMERA_HEIGHT])
    return (point @ matrix[:3, 2]) / (rays(resolution) @ matrix[:3, 2])


def plane_through(distances: Tensor) -> Tensor:
    """(H, W): distances to the plane that lies nearest to measured ones, by least squares."""
    points = (distances[..., None] * rays(distances.shape[-1])).reshape(-1, 3)
    a, b, c = torch.linalg.lstsq(torch.cat([points[:, :2], torch.ones(len(points), 1)], 1), points[:, 2]).solution
    return c / (rays(distances.shape[-1]) @ torch.stack([-a, -b, torch.tensor(1.0)]))


def rms_mm(error: Tensor) -> float:  # of metres
    return 1e3 * float(error.square().mean().sqrt())


def renderer_of(resolution: int, film: str) -> tt.TransientRenderer:
    """With a phasor film or a histogram film."""
    what = {"frequencies": FREQUENCIES} if film == "phasor" else {"time_axis": WINDOW}
    return tt.TransientRenderer(tt.load(scene(resolution), variant="llvm_ad_mono"), KEYS, **what)


def by(values: Sequence[Tensor]) -> dict[str, Tensor]:  # what the renderer is given
    return dict(zip(KEYS, (wall_to_world(*values[:3]), values[3], values[4]), strict=True))


def fit(renderer: tt.TransientRenderer, measured: Tensor, seed: int, steps: int, seconds: float | None = None) -> Fit:
    """Adam on the phasors of the taps, for a number of steps or for some seconds of the processor."""
    values = [torch.nn.Parameter(torch.tensor(value)) for value in START]
    groups = [{"params": [value], "lr": rate} for value, rate in zip(values, RATES, strict=True)]
    optimizer = torch.optim.Adam(groups, betas=(0.8, 0.95))
    target, resolution = sensing.tap_phasor(measured, STEPS, "differential"), measured.shape[-1]
    rest = distances_to_wall(START, resolution) - (truth := distances_to_wall(TRUTH, resolution))
    result = Fit(list(START), [rms_mm(rest)], rest)
    began, share = time.process_time(), 0.0
    progress = tqdm(total=steps, desc="fit_phasors", unit="step", leave=False)
    while share < 1:
        for group, rate in zip(optimizer.param_groups, RATES, strict=True):
            group["lr"] = rate * (0.5 + 0.5 * math.cos(math.pi * share))
        optimizer.zero_grad()
        out = renderer(by(values), seed=len(result.errors_mm) + 10_000 * seed, spp=SPP)
        found = sensing.tap_phasor(CAMERA.expected(out), STEPS, "differential")
        tt.losses.phasor_loss(found, target).backward()
        optimizer.step()
        result.values = [value.item() for value in values]
        result.rest = distances_to_wall(result.values, resolution) - truth
        result.errors_mm.append(rms_mm(result.rest))
        result.seconds.append(time.process_time() - began)
        share = result.seconds[-1] / seconds if seconds else (len(result.errors_mm) - 1) / steps
        progress.update()
    return result


def draw(path: Path, naive: Tensor, flat: Tensor, fits: dict[str, Fit]) -> None:
    """Errors of the distances as pictures on one scale, and over the time of the processor."""
    figure = figure_type()(figsize=(12, 3.5), layout="compressed")
    panels = figure.subplots(1, 4, width_ratios=(1, 1, 1, 1.3))
    limit = 1e3 * float(naive.abs().max())
    shown = {"camera's own depth": naive, "plane through it": flat, "fit": fits["phasor film"].rest}
    for panel, (name, error) in zip(panels, shown.items(), strict=False):
        image = panel.imshow(1e3 * error, cmap="RdBu_r", vmin=-limit, vmax=limit)
        panel.set(xticks=[], yticks=[], title=f"{name}\n{rms_mm(error):.2f} mm (rms)")
    figure.colorbar(image, ax=panels[2], label="error of the distance [mm]")
    for (name, fit_), style in zip(fits.items(), ("-", "--"), strict=True):
        panels[3].semilogy(fit_.seconds, fit_.errors_mm, style, label=f"fit, {name}")
    panels[3].axhline(rms_mm(naive), color="0.6", label="camera's own depth")
    panels[3].set(xlabel="seconds of one core", ylabel="mm (rms)")
    panels[3].legend(fontsize=8)
    save_figure(figure, path, "fit_phasors")


def main(argv: Sequence[str] | None = None) -> dict[str, list[float]]:
    """Command line. Prints a line for every seed; returns the errors in mm of every method, one of each seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="noise of the camera (%(default)s)")
    parser.add_argument("--smoke", action="store_true", help="one seed, few steps and pixels")
    parser.add_argument("--output", type=Path, default=Path("demo_output"), help="of the picture (%(default)s)")
    options = parser.parse_args(argv)
    seeds, steps, resolution = (options.seeds[:1], 60, 8) if options.smoke else (options.seeds, 300, 16)
    tt.threads(1)
    models = {f"{film} film": renderer_of(resolution, film) for film in ("phasor", "histogram")}
    with torch.no_grad():
        light = models["phasor film"](by([torch.tensor(value) for value in TRUTH]), seed=1_000_003, spp=16_384)
    truth = distances_to_wall(TRUTH, resolution)
    errors: dict[str, list[float]] = {name: [] for name in ("camera", "plane", *models)}
    for seed in seeds:
        measured = CAMERA.sample(light, torch.Generator().manual_seed(seed))
        depth = sensing.read_itof(measured, HERTZ, STEPS, readout="differential", max_depth_m=7.0).depth_m[0]
        naive, flat = depth - truth, plane_through(depth) - truth
        fits = {"phasor film": fit(models["phasor film"], measured, seed, steps)}
        budget = fits["phasor film"].seconds[-1]
        # The same time for both, but where a test looks: it takes as many steps on every machine.
        limit = None if options.smoke else budget
        fits["histogram film"] = fit(models["histogram film"], measured, seed, steps, limit)
        found = (rms_mm(naive), rms_mm(flat), *(one.errors_mm[-1] for one in fits.values()))
        for values, error in zip(errors.values(), found, strict=True):
            values.append(error)
        print(
            f"fit_phasors, seed {seed}: {found[0]:.2f} mm (rms) by the camera, {found[1]:.2f} by a plane through it, "
            f"{found[2]:.3f} by the fit with a phasor film ({budget:.1f} s), {found[3]:.3f} with a histogram film"
        )
        if seed == seeds[0]:
            options.output.mkdir(parents=True, exist_ok=True)
            draw(options.output / "fit_phasors.png", naive, flat, fits)
    return errors


if __name__ == "__main__":
    main()
