"""How fast the walls of a corner move, from the beat of a heterodyne (Doppler) time-of-flight camera.

Light is modulated at 60 MHz, the sensor one beat in an exposure of 5 ms beside it: what stands still drops out, and the
phasor of the beat over that of an exposure without a beat is the change of the phase, a speed (Heide et al. 2015). In a
corner a third of the light takes a detour over the other wall, whose motion then shows on walls that stand, and dilutes
the speed of those that move. The renderer has the detours: `tt.over_time` makes the beat of three poses, with gradients
by the motions of both walls and their albedos, which are fitted to the pictures of the camera.

    python training_examples/doppler_tof.py --seeds 0 1 2 --output demo_output

Prints errors of the speed of approach of the surface in each pixel, root mean square over the picture in m/s: of the
formula, of motions of both walls that are fitted to what the formula says, and of motions that are fitted by the
renderer.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

import torchtransient as tt
from torchtransient import sensing
from torchtransient.scenes import look_at, scale
from torchtransient.vis.files import figure_type, save_figure

HERTZ, EXPOSURE_S = 60e6, 5e-3
FREQUENCIES = tt.FrequencyAxis.from_hertz([HERTZ])
BEAT, PLAIN = tt.Exposure(EXPOSURE_S, beat_hz=1 / EXPOSURE_S), tt.Exposure(EXPOSURE_S)
ELECTRONS = 1e8  # of a radiance of one: 7e5 in each of four taps, in the mean
CAMERA = sensing.Compose(
    [
        sensing.ItofCorrelation(sensing.sine_code(4), HERTZ, tt.TimeAxis(0.0, 0.1, 100), electrons_per_unit=ELECTRONS),
        sensing.PixelElectronics(read_noise_e=20.0),
    ],
    grad="straight_through",
)
FOV_DEG, CORNER = 40.0, torch.tensor([0.0, 0.0, 3.5])
SIDES = {"wall": -1.0, "door": 1.0}  # left and right of the corner, which opens towards the camera at the origin
HALF, SEEN = 1.7, 0.6  # metres from the middle of a wall to its ends; from the corner to the middle of what is seen
# Of each body: speed along its normal there (m/s), turns about the vertical and the horizontal line in it (rad/s).
TRUTH = {"wall": (0.0, 0.0, 0.0), "door": (1.2, 2.0, -0.8)}
ALBEDOS, KEYS = (0.8, 0.7), tuple(f"{name}.{what}" for name in SIDES for what in ("to_world", "bsdf.reflectance.value"))
FULL = argparse.Namespace(resolution=24, spp=64, true_spp=4096, steps=120)
# The noise of the camera is what a fit of few pixels errs by.
SMOKE = argparse.Namespace(resolution=12, spp=128, true_spp=2048, steps=40)


def frame(name: str) -> tuple[Tensor, Tensor, Tensor]:
    """Normal, which faces the camera, line along the wall away from the corner, and middle of what is seen of it."""
    along = torch.tensor([SIDES[name] * 0.62, 0.0, -0.785])
    along = along / along.norm()
    normal = torch.tensor([-SIDES[name] * along[2].abs(), 0.0, -along[0].abs()])
    return normal, along, CORNER + SEEN * along


def scene(resolution: int) -> dict[str, Any]:
    """Two walls that meet in a vertical line, and a lamp beside the camera."""
    film = {"type": "transient_hdr_film", "width": resolution, "height": resolution, "rfilter": {"type": "box"}}
    camera = {"type": "perspective", "fov": FOV_DEG, "near_clip": 1e-3, "film": film,
              "to_world": look_at((0, 0, 0), (0, 0, 1)), "sampler": {"type": "independent"}}  # fmt: skip
    nodes: dict[str, Any] = {}
    for name, albedo in zip(SIDES, ALBEDOS, strict=True):
        normal, along, seen = frame(name)
        middle = seen + (HALF + 0.02 - SEEN) * along  # with a gap, so that they do not run into each other
        paint = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [albedo] * 3}}
        pose = look_at(middle.tolist(), (middle + normal).tolist()) @ scale(HALF)
        nodes[name] = {"type": "rectangle", "to_world": pose, "bsdf": paint}
    lamp = {"type": "point", "position": [0.0, 0.0, 0.0], "intensity": 1.0}
    integrator = {"type": "transient_path", "max_depth": 6}
    return {"type": "scene", "integrator": integrator, "sensor": camera, "lamp": lamp, **nodes}


def motion(name: str, numbers: Tensor) -> tt.Motion:
    """A body's motion by its three numbers; what it does within its own plane changes no picture."""
    normal, along, middle = frame(name)
    speed, upright, level = numbers
    return tt.Motion(
        linear=speed * normal, angular=torch.tensor([0.0, 1.0, 0.0]) * upright + along * level, center=middle
    )


def speeds_by_number(resolution: int) -> Tensor:
    """(2, 3, H, W): speed of approach of the surface in each pixel for each number of each body, zero on the other."""
    place = math.tan(math.radians(FOV_DEG / 2)) * ((torch.arange(resolution) + 0.5) / resolution * 2 - 1)
    y, x = torch.meshgrid(-place, -place, indexing="ij")
    rays = torch.stack([x, y, torch.ones_like(x)], -1)
    rays = rays / rays.norm(dim=-1, keepdim=True)
    found = torch.zeros(2, 3, resolution, resolution)
    for row, name in enumerate(SIDES):
        normal, along, middle = frame(name)
        facing = rays @ normal
        arm = rays * ((middle @ normal) / facing)[..., None] - middle
        turning = [torch.linalg.cross(line.expand_as(arm), arm) for line in (torch.tensor([0.0, 1.0, 0.0]), along)]
        # A plane that moves by v at a point shortens the ray by - v . n / (d . n).
        found[row] = torch.stack([torch.ones_like(facing), *(turn @ normal for turn in turning)]) / -facing
        found[row] *= SIDES[name] * x > 0
    return found


def phasors(taps: Tensor) -> Tensor:
    """Complex (H, W) of the four taps of one frequency."""
    return sensing.tap_phasor(taps, 4)[0, 0]


def formula(beat: Tensor, plain: Tensor) -> Tensor:
    """Speeds of approach from both phasors if all light goes there and back."""
    return sensing.heterodyne_speed(beat, plain, HERTZ, duration_s=EXPOSURE_S)


def values_of(albedos: Tensor) -> dict[str, Tensor]:
    return {f"{name}.bsdf.reflectance.value": albedo for name, albedo in zip(SIDES, albedos, strict=True)}


def pictures(renderer: tt.TransientRenderer, numbers: Tensor, albedos: Tensor, seed: int, spp: int) -> list[Any]:
    """What an exposure with a beat and one without are made of: two outputs."""
    moving = {name: motion(name, row) for name, row in zip(SIDES, numbers, strict=True)}
    return [
        tt.over_time(renderer, moving, exposure, values=values_of(albedos), seed=seed, spp=spp)
        for exposure in (BEAT, PLAIN)
    ]


def fit(
    renderer: tt.TransientRenderer, beat: Tensor, plain: Tensor, seed: int, sizes: argparse.Namespace
) -> tuple[Tensor, Tensor]:
    """Adam on the phasors with and without the beat, from walls that stand and grey paint."""
    numbers, albedos = torch.zeros(2, 3, requires_grad=True), torch.full((2,), 0.5, requires_grad=True)
    groups = [{"params": [numbers], "lr": 0.15}, {"params": [albedos], "lr": 0.03}]
    optimizer = torch.optim.Adam(groups, betas=(0.8, 0.95))
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, sizes.steps)
    for step in tqdm(range(sizes.steps), desc="doppler_tof", unit="step", leave=False):
        optimizer.zero_grad()
        made = pictures(renderer, numbers, albedos, step + 10_000 * seed, sizes.spp)
        pairs = zip(made, (beat, plain), strict=True)
        terms = [(phasors(CAMERA.expected(out)) - seen).abs().square().mean() / seen.abs().square().mean()
                 for out, seen in pairs]  # fmt: skip
        (terms[0] + terms[1]).backward()
        optimizer.step()
        schedule.step()
        with torch.no_grad():
            albedos.clamp_(0.05, 0.95)
    return numbers.detach(), albedos.detach()


def rms(error: Tensor) -> float:
    return float(error.square().mean().sqrt())


def draw(path: Path, truth: Tensor, found: dict[str, Tensor]) -> None:
    """Speeds on one scale, blue comes nearer."""
    shown = {"true": truth, **found}
    figure = figure_type()(figsize=(2.9 * len(shown), 3.1), layout="constrained")
    limit = 1.2 * float(truth.abs().max())
    for panel, (name, speeds) in zip(panels := figure.subplots(1, len(shown)), shown.items(), strict=True):
        image = panel.imshow(speeds, cmap="RdBu", vmin=-limit, vmax=limit)
        error = "" if name == "true" else f"\n{rms(speeds - truth):.2f} m/s (rms)"
        panel.set(xticks=[], yticks=[], title=f"{name}{error}")
    figure.colorbar(image, ax=panels, label="speed of approach, m/s")
    path.parent.mkdir(parents=True, exist_ok=True)
    save_figure(figure, path, "doppler_tof")
    print(f"doppler_tof: {path}")


def main(argv: Sequence[str] | None = None) -> list[dict[str, float]]:
    """Command line; returns the errors of every seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="small enough for seconds")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="noise and samples (%(default)s)")
    parser.add_argument("--output", type=Path, default=Path("demo_output"), help="folder for the picture (%(default)s)")
    options = parser.parse_args(argv)
    sizes = SMOKE if options.smoke else FULL
    renderer = tt.TransientRenderer(
        tt.load(scene(sizes.resolution), variant="llvm_ad_mono"), KEYS, frequencies=FREQUENCIES
    )
    each = speeds_by_number(sizes.resolution)
    truth_numbers = torch.tensor(list(TRUTH.values()))
    truth = torch.einsum("bnhw,bn->hw", each, truth_numbers)
    with torch.no_grad():
        made = pictures(renderer, truth_numbers, torch.tensor(ALBEDOS), 999, sizes.true_spp)
    tables = []
    for seed in options.seeds:
        generator = torch.Generator().manual_seed(seed)
        beat, plain = (phasors(CAMERA(out, generator=generator)) for out in made)
        quiet = formula(*(phasors(CAMERA.expected(out)) for out in made))
        found = {"formula": formula(beat, plain)}
        design = each.flatten(0, 1).flatten(1).T
        rigid = torch.linalg.lstsq(design, found["formula"].reshape(-1, 1)).solution
        found["formula, bodies"] = (design @ rigid).reshape(truth.shape)
        numbers, albedos = fit(renderer, beat, plain, seed, sizes)
        found["fit"] = torch.einsum("bnhw,bn->hw", each, numbers)
        tables.append({"formula without noise": rms(quiet - truth)} | {k: rms(v - truth) for k, v in found.items()})
        print(f"seed {seed}: " + ", ".join(f"{name} {value:.3f} m/s" for name, value in tables[-1].items()))
        print(f"  motions {[[round(x, 2) for x in row] for row in numbers.tolist()]}, albedos "
              f"{[round(x, 3) for x in albedos.tolist()]}")  # fmt: skip
    draw(options.output / "doppler_tof.png", truth, found)
    return tables


if __name__ == "__main__":
    main()
