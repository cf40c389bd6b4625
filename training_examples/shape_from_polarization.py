"""A relief too fine for its time of flight, found from polarized histograms.

A lidar with a pulse of 1 ns looks at a relief of plastic, 3 cm wide and half a millimetre high, under 50 degrees. Light
that comes out of plastic is polarized by the refraction at its surface, more so the more oblique it leaves, across the
plane of exit: S1 and S2 over S0 know the normal. Path lengths know where the relief is as a whole. Unknown are the
heights of a mesh; the albedo of every pixel is unknown too and taken out, so that no shading helps.

    python training_examples/shape_from_polarization.py --seeds 0 1 2 --output demo_output

Prints the errors of heights and normals for three fits from the same flat start and the same light: one detector that
counts all of it (S0); four behind polarizers, which share it and lose half; and a gated chip whose pixels have one
polarizer each (a mosaic) with read noise and a converter, by the Stokes channels that are interpolated from its pixels.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

import torchtransient as tt
from torchtransient import sensing
from torchtransient.scenes import look_at
from torchtransient.scenes.meshes import plate
from torchtransient.scenes.parts import perspective, transient_film, transient_path
from torchtransient.vis.files import figure_type, save_figure

KEY = "relief.vertex_positions"
AXIS = tt.TimeAxis(0.4, 0.0375, 32)  # 125 ps a bin
PULSE = tt.Pulse.gaussian(0.3)  # 1 ns
WIDTH, SIDE, CELLS, WAVES = 0.03, 0.05, 40, 20
DISTANCE, INCIDENCE, PIXELS = 0.5, math.radians(50.0), (24, 16)
PHOTONS = 1e6  # of a pixel without filters
FOUR = sensing.linear_analyzers([0.0, 45.0, 90.0, 135.0], transmission=0.25)
MOSAIC = sensing.PolarizationMosaic.polarsens(300.0)
CHIP = sensing.PixelElectronics(full_well_e=2e5, read_noise_e=10.0, gain_e_per_dn=12.0, bits=14, black_level_dn=64)
SENSORS = {
    "S0 alone": sensing.Compose([sensing.Analyzers(torch.tensor([[1.0, 0.0, 0.0, 0.0]])), sensing.ShotNoise()]),
    "Stokes": sensing.Compose([sensing.Analyzers(FOUR), sensing.ShotNoise()]),
    "mosaic": sensing.Compose([MOSAIC, CHIP]),
}


def scene() -> dict[str, Any]:
    """A plate of plastic in the plane z = 0, a camera with a lamp at the same place above it, aside by 50 degrees."""
    eye = [0.0, -DISTANCE * math.sin(INCIDENCE), DISTANCE * math.cos(INCIDENCE)]
    vertices, faces = plate(SIDE, SIDE, cells=CELLS)
    film = transient_film(PIXELS, AXIS.num_bins, AXIS.start_opl, AXIS.bin_width_opl)
    fov = 2 * math.degrees(math.atan(WIDTH / PIXELS[0] * PIXELS[1] / 2 / DISTANCE))
    return {
        "type": "scene",
        "integrator": transient_path(2),
        "sensor": perspective(look_at(eye, [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]), fov, film, 64),
        "lamp": {"type": "point", "position": eye, "intensity": 1.0},
        "relief": {
            "type": "mesh_arrays", "vertices": vertices, "faces": faces[:, ::-1],
            "bsdf": {"type": "pplastic", "diffuse_reflectance": 0.5, "int_ior": 1.5, "alpha": 0.15},
        },
    }  # fmt: skip


def grid() -> tuple[Tensor, Tensor]:
    """(N, N) each: x and y of the vertices, metres."""
    x, y = torch.meshgrid(*[torch.linspace(-SIDE / 2, SIDE / 2, CELLS + 1)] * 2, indexing="xy")
    return x, y


def true_heights() -> Tensor:
    """(N, N) metres: a ring, a ridge and a dent, 1.5 mm above the plane."""
    x, y = (value / WIDTH for value in grid())
    ring = torch.exp(-(((x + 0.12).square() + (y - 0.08).square()).sqrt() - 0.22).square() / 0.006)
    ridge = torch.exp(-(0.8 * x + 0.6 * y - 0.2).square() / 0.006)
    dent = torch.exp(-((x - 0.25).square() + (y + 0.3).square()) / 0.01)
    return 1.5e-3 + 5e-4 * (ring + ridge - dent)


def waves() -> Tensor:
    """(N, WAVES): cosines over a side of the mesh, the longest first."""
    place = (torch.arange(CELLS + 1) + 0.5) / (CELLS + 1)
    return torch.cos(math.pi * place[:, None] * torch.arange(WAVES))


def normals(heights: Tensor) -> Tensor:
    """(N - 2, N - 2, 3) unit normals of a height field, at its inner vertices."""
    dy, dx = torch.gradient(heights, spacing=SIDE / CELLS)
    vectors = torch.stack([-dx, -dy, torch.ones_like(dx)], dim=-1)[1:-1, 1:-1]
    return vectors / vectors.norm(dim=-1, keepdim=True)


def seen() -> Tensor:
    """(N, N): which vertices the camera sees, with a margin of a millimetre."""
    x, y = grid()
    return (x.abs() < WIDTH / 2 - 1e-3) & (y.abs() < WIDTH / PIXELS[0] * PIXELS[1] / math.cos(INCIDENCE) / 2 - 1e-3)


def stokes(renderer: tt.TransientRenderer, heights: Tensor, seed: int, spp: int) -> Tensor:
    """Stokes components (4, 1, T, H, W) of heights (N, N): what falls on a sensor."""
    vertices = torch.stack([*grid(), heights], dim=-1).reshape(-1, 3)
    return renderer({KEY: vertices}, seed=seed, spp=spp).transient


def difference(name: str, light: Tensor, measured: Tensor) -> Tensor:
    """The loss: each pixel's light is made the measured one, in all detectors and bins together; no say to albedos."""
    if name == "mosaic":
        ours, theirs = (x / x[:1].sum(2, keepdim=True) for x in (MOSAIC.stokes(light), MOSAIC.stokes(measured)))
        noise = (theirs[:1].clamp_min(0) + 1e-3).sqrt()  # of counts; the faintest bins have that of the chip
        return tt.losses.squared_loss(ours / noise, theirs / noise)
    total = measured.sum((0, 2), keepdim=True)
    return tt.losses.root_loss(light / light.sum((0, 2), keepdim=True) * total, measured)


Fit = tuple[Tensor, list[tuple[float, float]], float]  # heights, errors before the first step and after each, seconds


def errors_of(heights: Tensor) -> tuple[float, float]:
    """Root mean square errors where the camera looks: of heights in millimetres, of normals in degrees."""
    height = (heights - true_heights())[seen()].square().mean().sqrt()
    cosine = (normals(heights) * normals(true_heights())).sum(-1)[seen()[1:-1, 1:-1]]
    return 1e3 * float(height), math.degrees(float(cosine.clamp(-1, 1).arccos().square().mean().sqrt()))


def fit(light_of: Callable[..., Tensor], name: str, measured: Tensor, seed: int, steps: int, spp: int) -> Fit:
    """Adam on the cosines of the heights, from a flat relief, 1.5 mm too deep; long waves move more than short ones."""
    order = torch.arange(WAVES)
    scale = 1e-4 / (1 + (order[:, None].square() + order.square()) / 9).sqrt()
    shape = torch.nn.Parameter(torch.zeros(WAVES, WAVES))
    optimizer = torch.optim.Adam([shape], lr=0.3, betas=(0.9, 0.95))
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    found = waves() @ (scale * shape.detach()) @ waves().T
    errors, began = [errors_of(found)], time.process_time()
    for step in tqdm(range(steps), desc=name, unit="step", leave=False):
        light = light_of(waves() @ (scale * shape) @ waves().T, step + 10_000 * seed, spp)
        optimizer.zero_grad()
        difference(name, SENSORS[name].expected(light), measured).backward()
        optimizer.step()
        schedule.step()
        found = waves() @ (scale * shape.detach()) @ waves().T
        errors.append(errors_of(found))
    return found, errors, time.process_time() - began


def draw(path: Path, fits: dict[str, Fit]) -> None:
    """The reliefs under a slanting lamp, cut to what the camera sees, and the errors over the steps."""
    figure = figure_type()(figsize=(14, 3.5), layout="compressed")
    panels = figure.subplots(1, 5, width_ratios=(1, 1, 1, 1, 1.2))
    shown = {"truth": true_heights(), **{name: one[0] for name, one in fits.items()}}
    for panel, (name, heights) in zip(panels, shown.items(), strict=False):
        picture = (normals(heights) @ torch.tensor([-0.6, 0.5, 0.62])).clamp_min(0)
        picture[~seen()[1:-1, 1:-1]] = torch.nan
        rows, columns = (part.any(dim).nonzero() for dim in (1, 0) for part in [picture.isfinite()])
        cut = picture[int(rows[0]) : int(rows[-1]) + 1, int(columns[0]) : int(columns[-1]) + 1]
        panel.imshow(cut, cmap="gray", vmin=0.3, vmax=0.9, origin="lower")
        panel.set(xticks=[], yticks=[], title=name if name == "truth" else f"{name}: {fits[name][1][-1][1]:.1f}°")
    for name, one in fits.items():
        panels[4].semilogy([degrees for _, degrees in one[1]], label=name)
    panels[4].set(xlabel="step", ylabel="error of the normals [degrees]")
    panels[4].legend()
    save_figure(figure, path, "shape_from_polarization")


def main(argv: Sequence[str] | None = None) -> dict[str, list[tuple[float, float]]]:
    """Command line. Returns the last errors (mm, degrees) of every fit, one of each seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="noise of the counts (%(default)s)")
    parser.add_argument("--smoke", action="store_true", help="one seed, few steps")
    parser.add_argument("--output", type=Path, default=Path("demo_output"), help="of the picture (%(default)s)")
    options = parser.parse_args(argv)
    seeds, steps, spp = (options.seeds[:1], 60, 8) if options.smoke else (options.seeds, 200, 32)
    tt.threads(1)
    renderer = tt.TransientRenderer(tt.load(scene(), variant="llvm_ad_mono_polarized"), [KEY], irf=PULSE)
    with torch.no_grad():
        light = stokes(renderer, true_heights(), 1_000_003, 4096)
    exposure = PHOTONS / light[0].sum(1).mean()
    errors: dict[str, list[tuple[float, float]]] = {name: [] for name in SENSORS}
    for seed in seeds:
        fits = {}
        for name, sensor in SENSORS.items():
            measured = sensor.sample(exposure * light, torch.Generator().manual_seed(seed))
            fits[name] = fit(lambda *of: exposure * stokes(renderer, *of), name, measured, seed, steps, spp)
            errors[name].append(fits[name][1][-1])
            said = "{:.3f} mm, {:.2f} degrees ({:.1f} s of one core)".format(*errors[name][-1], fits[name][2])
            print(f"shape_from_polarization, seed {seed}, {name}: {said}")
        if seed == seeds[0]:
            options.output.mkdir(parents=True, exist_ok=True)
            draw(options.output / "shape_from_polarization.png", fits)
    return errors


if __name__ == "__main__":
    main()
